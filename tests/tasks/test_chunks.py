"""A scene in chunks answers as the same in memory, and what needs all of it at once is refused."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from splatseg.core import Gaussians, InstanceTree, Labels, Scene, Selection
from splatseg.core.executor import LocalExecutor
from splatseg.edit import Document, load_document
from splatseg.errors import FileFormatError, InputError, MissingFileError
from splatseg.io import chunks as files
from splatseg.io.evidence import open_evidence
from splatseg.io.scene import load_scene, save_scene, save_scene_layer
from splatseg.io.splats import read_splats, write_splats
from splatseg.methods import MethodInputs, find_method
from splatseg.methods.associate import AssociateMethodOptions, AssociateOptions
from splatseg.prompting.prompts import AxisBox, Ball, Lasso, ViewPrompt
from splatseg.render import render
from splatseg.tasks import (
    ChunkOptions,
    EditOptions,
    ExportOptions,
    RenderingOptions,
    SegmentOptions,
    SelectOptions,
    chunk_scene,
    edit_chunks,
    edit_scene,
    export_scene,
    level_within,
    render_views,
    see,
    segment,
    select,
)
from support.chunked import in_memory

MEMORY = 10**9
COLUMNS = ("means", "rotations", "scales", "opacities", "sh")


@pytest.fixture(scope="module")
def whole(fitted_room, tmp_path_factory) -> Path:
    """A scene with layers of classes and of instances."""
    folder = shutil.copytree(fitted_room, tmp_path_factory.mktemp("whole") / "scene")
    scene = load_scene(folder)
    for method, evidence, name in (
        ("uplift", "labels_semantic", "classes"),
        ("associate", "masks_nested", "objects"),
    ):
        made = segment(scene, method, options=SegmentOptions(evidence=evidence), backend="cpu")
        save_scene_layer(made.layer, folder, name)
    return folder


@pytest.fixture(scope="module")
def chunked_room(whole, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("chunked") / "scene"
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(files, "CHUNK_ROWS", 128)
        made = chunk_scene(whole, folder, memory=MEMORY)
    assert made.chunks > 10
    assert made.layers == ("classes", "objects")
    return folder


@pytest.fixture
def chunked(chunked_room, tmp_path) -> Scene:
    """A copy that a test may change, streamed."""
    return load_scene(shutil.copytree(chunked_room, tmp_path / "chunked"), memory=MEMORY)


@pytest.fixture
def held(chunked) -> Scene:
    """The same with its Gaussians in memory, in the same order; layers are in the same folder."""
    return replace(chunked, gaussians=in_memory(chunked.gaussians))


def same(one: Any, other: Any) -> None:
    """Layers are the same, to the bit."""
    if isinstance(one, InstanceTree):
        assert one.nodes == other.nodes
        one, other = one.labels, other.labels
    assert type(one) is type(other)
    assert one.columns().keys() == other.columns().keys()
    for name, column in one.columns().items():
        assert torch.equal(column, other.columns()[name]), name


def test_rows_and_layers_follow_each_other_and_come_back(whole, chunked, tmp_path) -> None:
    before = load_scene(whole)
    chunk_scene(chunked.root, tmp_path / "back", options=ChunkOptions(whole=True), memory=MEMORY)
    after = load_scene(tmp_path / "back")
    assert [view.name for view in after.views] == [view.name for view in before.views]
    assert after.source == before.source
    # Files have logs: what was read of them and is written again has the same bits.
    places = {tuple(mean): row for row, mean in enumerate(before.gaussians.means.tolist())}
    order = torch.tensor([places[tuple(mean)] for mean in after.gaussians.means.tolist()])
    assert sorted(order.tolist()) == list(range(len(before.gaussians)))
    for name in COLUMNS:
        torch.testing.assert_close(
            getattr(after.gaussians, name), getattr(before.gaussians, name)[order]
        )
    for name in ("classes", "objects"):
        first, second = before.layers[name], after.layers[name]
        taken = replace(first, labels=first.labels[order]) if name == "objects" else first[order]
        same(second, taken)
        same(chunked.layers[name], taken)


def test_a_ply_file_with_a_capture(whole, generated_room, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(files, "CHUNK_ROWS", 128)
    ply = whole / "gaussians.ply"
    made = chunk_scene(ply, tmp_path / "made", data=generated_room, memory=MEMORY)
    scene = load_scene(made.folder, memory=MEMORY)
    assert made.layers == ()
    assert len(scene.views) == len(load_scene(whole).views)
    assert len(scene.gaussians) == made.gaussians == len(read_splats(ply))
    alone = chunk_scene(ply, tmp_path / "alone", memory=MEMORY)
    assert load_scene(alone.folder, memory=MEMORY).views == ()
    write_splats(read_splats(ply).replace(antialiased=False, low_pass=0.3), tmp_path / "a.spz")
    with pytest.raises(InputError, match="expected a binary PLY file"):
        chunk_scene(tmp_path / "a.spz", tmp_path / "other", memory=MEMORY)


def test_half_precision_is_what_was_asked_for(whole, tmp_path) -> None:
    made = chunk_scene(
        whole, tmp_path / "half", options=ChunkOptions(harmonics="float16"), memory=MEMORY
    )
    scene = load_scene(made.folder, memory=MEMORY)
    assert scene.gaussians.sh.dtype == torch.float16
    full = chunk_scene(whole, tmp_path / "full", memory=MEMORY)
    full_scene = load_scene(full.folder, memory=MEMORY)
    camera = scene.views[0].camera
    pair = [render(one.gaussians, camera).image for one in (scene, full_scene)]
    assert 0 < float((pair[0] - pair[1]).abs().max()) < 1 / 255


def test_evidence_of_the_scene_comes_along(whole, tmp_path) -> None:
    own = shutil.copytree(whole, tmp_path / "own")
    (own / "evidence" / "mine").mkdir()
    (own / "evidence" / "mine" / "a.txt").write_text("a")
    (own / "evidence" / ".hidden").mkdir()
    chunk_scene(own, tmp_path / "made", memory=MEMORY)
    assert [path.name for path in (tmp_path / "made" / "evidence").iterdir()] == ["mine"]
    back = ChunkOptions(whole=True)
    chunk_scene(tmp_path / "made", tmp_path / "back", options=back, memory=MEMORY)
    assert (tmp_path / "back" / "evidence" / "mine" / "a.txt").read_text() == "a"


def test_a_level_is_a_scene_with_layers(whole, tmp_path, monkeypatch) -> None:
    """A Gaussian has the labels of the one of all that it stands for."""
    monkeypatch.setattr(files, "CHUNK_ROWS", 128)
    made = chunk_scene(whole, tmp_path / "city", options=ChunkOptions(levels=2), memory=MEMORY)
    options = ChunkOptions(whole=True, level=2)
    level = chunk_scene(made.folder, tmp_path / "level", options=options, memory=MEMORY)
    assert level.layers == ("classes", "objects")
    assert level.chunks == 0
    assert level.gaussians < made.gaussians / 10
    scene = load_scene(level.folder)
    assert len(scene.gaussians) == level.gaussians
    rows = files.level_rows(made.folder / "gaussians", 2)
    everything = load_scene(made.folder, memory=MEMORY)
    assert torch.equal(scene.layers["classes"].ids, everything.layers["classes"].ids[rows])
    objects = scene.layers["objects"]
    assert isinstance(objects, InstanceTree)
    assert torch.equal(objects.labels.ids, everything.layers["objects"].labels.ids[rows])
    options = ChunkOptions(whole=True, level=3)
    with pytest.raises(InputError, match="level: expected one that"):
        chunk_scene(made.folder, tmp_path / "none", options=options, memory=MEMORY)
    assert not (tmp_path / "none").exists()
    # The finest level that is small enough.
    counts = [made.gaussians, len(files.level_rows(made.folder / "gaussians", 1)), level.gaussians]
    for number, count in enumerate(counts):
        assert level_within(made.folder, count) == number
        if number < 2:
            assert level_within(made.folder, count - 1) == number + 1
    with pytest.raises(InputError, match=f"got 2 coarser ones, the last of {counts[2]}; `splatse"):
        level_within(made.folder, counts[2] - 1)


def test_which_way_is_told(whole, chunked, tmp_path) -> None:
    with pytest.raises(InputError, match="is in chunks already; --whole"):
        chunk_scene(chunked.root, tmp_path / "made", memory=MEMORY)
    with pytest.raises(InputError, match="expected a scene in chunks with whole"):
        chunk_scene(whole, tmp_path / "made", options=ChunkOptions(whole=True), memory=MEMORY)
    for given in ({"levels": 1}, {"harmonics": "float16"}):
        with pytest.raises(InputError, match="whole: takes no"):
            ChunkOptions(whole=True, **given)
    with pytest.raises(MissingFileError, match="there is no such scene or file"):
        chunk_scene(tmp_path / "none", tmp_path / "made", options=ChunkOptions(whole=True))
    with pytest.raises(InputError, match="level: goes with `whole`"):
        ChunkOptions(level=1)
    with pytest.raises(InputError, match="expected a new folder"):
        chunk_scene(whole, whole, memory=MEMORY)
    assert not (tmp_path / "made").exists()


def test_a_scene_in_chunks_is_no_place_to_save_another(whole, chunked) -> None:
    with pytest.raises(InputError, match="got a scene in chunks"):
        save_scene(load_scene(whole), chunked.root)
    with pytest.raises(InputError, match="its Gaussians are in chunks, which this cannot stream"):
        load_scene(chunked.root)
    shutil.copy(whole / "gaussians.ply", chunked.root)
    with pytest.raises(FileFormatError, match="got both"):
        load_scene(chunked.root, memory=MEMORY)


def test_a_scene_file_that_counts_otherwise(chunked) -> None:
    path = chunked.root / "scene.json"
    content = json.loads(path.read_text())
    path.write_text(json.dumps(content | {"gaussians": 7}))
    with pytest.raises(FileFormatError, match=r"gaussians: expected 7 Gaussians"):
        load_scene(chunked.root, memory=MEMORY)


@pytest.mark.parametrize("moment", [1, 4, 9])
def test_ctrl_c_while_it_is_written_leaves_nothing(whole, tmp_path, monkeypatch, moment) -> None:
    append, calls = files.ChunkWriter.append, []

    def interrupted(self: files.ChunkWriter, gaussians: Gaussians) -> None:
        calls.append(len(gaussians))
        if len(calls) == moment:
            raise KeyboardInterrupt
        append(self, gaussians)

    monkeypatch.setattr(files, "CHUNK_ROWS", 128)
    monkeypatch.setattr(files.ChunkWriter, "append", interrupted)
    with pytest.raises(KeyboardInterrupt):
        chunk_scene(whole, tmp_path / "made", memory=MEMORY)
    assert list(tmp_path.iterdir()) == []


def test_pictures_depths_and_label_maps_of_views(chunked, held, tmp_path) -> None:
    options = RenderingOptions(split="all", what=("rgb", "depth", "alpha", "classes", "objects"))
    for name, scene in (("ours", chunked), ("theirs", held)):
        render_views(scene, tmp_path / name, options=options, backend="cpu")
    ours = sorted((tmp_path / "ours").rglob("*.png"))
    assert len(ours) == 5 * len(chunked.views)
    for path in ours:
        other = tmp_path / "theirs" / path.relative_to(tmp_path / "ours")
        assert path.read_bytes() == other.read_bytes(), path


def test_a_view_that_the_memory_is_too_small_for(chunked, tmp_path, monkeypatch) -> None:
    """It is said before anything is drawn, also of the last."""
    needs = []
    for view in chunked.views:
        seen = chunked.gaussians.chunks.seen(view.camera, near=0.01, low_pass=0.1)
        needs.append(len(chunked.gaussians.chunks.rows(seen)))
    bytes_of_one = 4 * (11 + 3 * chunked.gaussians.sh.shape[1]) + 170
    small = load_scene(chunked.root, memory=bytes_of_one * max(needs) - 1)
    monkeypatch.setattr("splatseg.tasks.render._draw_view", None)
    with pytest.raises(InputError, match=rf"^memory: a view has {max(needs)} Gaussians before it"):
        render_views(small, tmp_path / "made", backend="cpu", options=RenderingOptions(split="all"))
    assert not (tmp_path / "made").exists()


@pytest.mark.parametrize("complete", [True, False])
@pytest.mark.parametrize(
    ("method", "evidence"), [("uplift", "labels_semantic"), ("associate", "masks_nested")]
)
def test_a_lift(chunked, held, method, evidence, complete) -> None:
    options = SegmentOptions(evidence=evidence, complete=complete)
    ours = segment(chunked, method, options=options, backend="cpu")
    theirs = segment(held, method, options=options, backend="cpu")
    same(ours.layer, theirs.layer)
    assert ours.layer.info.views == theirs.layer.info.views
    assert len(ours.layer) == len(chunked.gaussians)
    assert bool((ours.labels.ids >= 0).any())


def test_the_cameras_of_a_method_are_those_that_it_looks_through(generated_room, whole) -> None:
    """Pixels of another size show other Gaussians at the margin."""
    scene = load_scene(whole)
    view = scene.train_views[0]
    masks, maps = (
        MethodInputs(
            gaussians=scene.gaussians, views=(view,), evidence=open_evidence(generated_room / name)
        )
        for name in ("masks_nested", "labels_semantic")
    )
    associate, uplift = find_method("associate"), find_method("uplift")
    small = AssociateMethodOptions(association=AssociateOptions(longest_side=80))
    assert associate.camera is not None
    assert uplift.camera is not None
    for camera, width in (
        (associate.camera(masks, small, view), 80),
        (associate.camera(masks, associate.options(), view), 320),
        (uplift.camera(maps, uplift.options(), view), 320),
    ):
        assert (camera.width, camera.height) == (width, width * 3 // 4)
        assert camera.fx == pytest.approx(view.camera.fx * width / 320)


@pytest.mark.parametrize(
    ("method", "options", "said"),
    [
        ("vote", {"evidence": "labels_semantic"}, "method vote: needs all Gaussians at once"),
        ("uplift", {"evidence": "labels_semantic", "update": True}, "update: needs"),
        ("associate", {"evidence": "masks_nested", "classes": "classes"}, "classes: needs"),
    ],
)
def test_a_lift_that_cannot_stream(chunked, method, options, said) -> None:
    with pytest.raises(InputError, match=said):
        segment(chunked, method, options=SegmentOptions(**options), backend="cpu")


def test_views_of_chunks_are_worked_on_in_this_process(chunked, tmp_path) -> None:
    """Other processes would be sent all of them."""
    other = LocalExecutor()
    with pytest.raises(InputError, match="executor: needs all Gaussians at once"):
        render_views(chunked, tmp_path / "made", executor=other)
    with pytest.raises(InputError, match="executor: needs all Gaussians at once"):
        see(chunked, "classical", "new", executor=other)
    with pytest.raises(InputError, match="executor: needs all Gaussians at once"):
        segment(
            chunked,
            "uplift",
            options=SegmentOptions(evidence="labels_semantic"),
            executor=other,
        )


def test_a_lift_with_too_little_memory(chunked) -> None:
    """For neighbours of all, or for what the views see; nothing is computed then."""
    little = load_scene(chunked.root, memory=200 * len(chunked.gaussians))
    options = SegmentOptions(evidence="labels_semantic")
    with pytest.raises(InputError, match=r"^complete: neighbours of all .*--no-complete"):
        segment(little, "uplift", options=options, backend="cpu")
    less = load_scene(chunked.root, memory=100 * len(chunked.gaussians))
    with pytest.raises(InputError, match=r"^memory: "):
        segment(less, "uplift", options=replace(options, complete=False), backend="cpu")


def click(scene: Scene, *, x: float = 160.0, y: float = 150.0) -> ViewPrompt:
    view = scene.train_views[0]
    return ViewPrompt(view=view, points=torch.tensor([[x, y]]), positive=torch.tensor([True]))


@pytest.mark.parametrize("post_processing", ["full", "none"])
@pytest.mark.parametrize("layer", ["classes", "objects"])
def test_a_click(chunked, held, layer, post_processing) -> None:
    """Specks and holes are looked for around what is selected alone: the same here."""
    options = SelectOptions(source="layer", from_layer=layer, post_processing=post_processing)
    for x, y in ((160.0, 150.0), (90.0, 120.0), (250.0, 200.0)):
        ours, theirs = (
            select(scene, click(scene, x=x, y=y), options=options, backend="cpu").selection
            for scene in (chunked, held)
        )
        same(ours, theirs)
        assert ours.count


def test_a_box_in_a_view_and_places(chunked, held) -> None:
    options = SelectOptions(source="layer", from_layer="objects")
    view = chunked.train_views[0]
    boxed = ViewPrompt(view=view, box=torch.tensor([100.0, 90, 220, 200]))
    polygon = torch.tensor([[60.0, 60], [260, 60], [160, 220]])
    middle = chunked.gaussians.means.median(dim=0).values.tolist()
    for prompts in (
        boxed,
        AxisBox(low=[v - 0.8 for v in middle], high=[v + 0.8 for v in middle]),
        [Ball(centre=middle, radius=1.0), Lasso(view=view, polygon=polygon)],
        [click(chunked), Ball(centre=middle, radius=3.0)],
    ):
        ours, theirs = (
            select(scene, prompts, options=options, backend="cpu").selection
            for scene in (chunked, held)
        )
        same(ours, theirs)
        assert ours.count


def test_a_selection_that_cannot_stream(chunked) -> None:
    options = SelectOptions(source="layer", from_layer="objects")
    with pytest.raises(InputError, match="next_click: needs all Gaussians at once"):
        select(chunked, click(chunked), options=options, advise=True)
    little = load_scene(chunked.root, memory=1_900_000)
    with pytest.raises(InputError, match="select with post_processing none"):
        select(little, click(little), options=options)


EDITS: dict[str, dict[str, Any]] = {
    "remove": {"remove": True, "layer": "classes", "ids": (3,), "specks": 0},
    "remove a box": {"remove": True, "sphere": (0.0, 0.0, 1.0, 1.5)},
    "extract": {"extract": True, "layer": "objects", "ids": (1, 2)},
    "invert": {"extract": True, "layer": "classes", "ids": (3,), "invert": True},
    "duplicate": {"duplicate": True, "layer": "objects", "ids": (2,), "move": (0.5, 0, 0)},
    "move": {"layer": "objects", "ids": (2,), "rotate": (0, 0, 1, 30)},
    "move all": {"move": (1, 2, 3), "scale": 2.0},
    "colour": {"layer": "classes", "ids": (3,), "colour": (1, 0, 0)},
    "colour all": {"colour_scale": (0.5, 0.5, 0.5)},
}


@pytest.mark.parametrize("name", EDITS)
def test_an_edit(chunked, held, tmp_path, name) -> None:
    """The bits are the same but where rows are turned, a product of matrices."""
    options = EditOptions(**EDITS[name], cut="off", pictures=1)
    document = Document(scene=held, layers=dict(held.layers))
    theirs = edit_scene(document, tmp_path / "theirs", options=options, backend="cpu").document
    made = edit_chunks(chunked, tmp_path / "ours", options=options, backend="cpu")
    ours = load_scene(tmp_path / "ours", memory=MEMORY)
    assert len(ours.gaussians) == len(theirs.scene.gaussians)
    for column in COLUMNS:
        one, other = getattr(ours.gaussians, column), getattr(theirs.scene.gaussians, column)
        if "rotate" in EDITS[name]:
            torch.testing.assert_close(one, other)
        else:
            assert torch.equal(one, other), column
    assert tuple(ours.layers) == ("classes", "objects")
    for layer in ours.layers:
        same(ours.layers[layer], theirs.layers[layer])
    assert ours.provenance == theirs.scene.provenance
    written = load_scene(tmp_path / "theirs")
    for one, other in zip(ours.views, written.views, strict=True):
        assert torch.equal(one.camera.cam_from_world, other.camera.cam_from_world)
    assert ours.metres_per_unit == theirs.scene.metres_per_unit
    assert made.report is not None
    assert made.report.is_file()
    chosen = made.operations[0]["selected"]
    assert (chosen is None) == name.endswith("all")
    if "remove" in name:
        assert len(ours.gaussians) == len(chunked.gaussians) - chosen
    # What is read of the new one is as its index says, also where rows moved.
    assert ours.gaussians.chunks is not None
    ours.gaussians.chunks.read([(0, len(ours.gaussians))])


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"remove": True, "layer": "objects", "ids": (1,), "specks": 0}, "cut auto .off splits"),
        ({"remove": True, "box": (0, 0, 0, 1, 1, 1), "cut": "box"}, "cut box"),
        ({"remove": True, "layer": "objects", "ids": (1,), "cut": "off"}, "specks 30 .0 leaves"),
        ({"remove": True, "sphere": (0, 0, 0, 1), "refit": 5}, "refit"),
        ({"remove": True, "sphere": (0, 0, 0, 1), "fill": "exemplar"}, "fill"),
        ({"undo": True}, "undo"),
    ],
)
def test_an_edit_that_cannot_stream(chunked, tmp_path, options, said) -> None:
    with pytest.raises(InputError, match=f"^{said}.*needs all Gaussians at once"):
        edit_chunks(chunked, tmp_path / "made", options=EditOptions(**options))
    assert not (tmp_path / "made").exists()


def test_an_edit_of_nothing_or_of_two_things(chunked, held, whole, tmp_path) -> None:
    for options, said in (
        ({"remove": True, "sphere": (99, 0, 0, 1)}, "got none of"),
        ({"remove": True, "opacity": (0, 1)}, "expected to leave Gaussians, got all"),
        ({"extract": True, "sphere": (0, 0, 0, 9), "move": (1, 0, 0)}, "expected one of them"),
        ({"merge": whole}, "merge: needs all"),
    ):
        with pytest.raises(InputError, match=said):
            edit_chunks(chunked, tmp_path / "made", options=EditOptions(**options))
    with pytest.raises(InputError, match="expected one in chunks"):
        edit_chunks(held, tmp_path / "made", options=EditOptions(move=(1, 0, 0)))


def test_ctrl_c_in_an_edit_leaves_nothing(chunked, tmp_path, monkeypatch) -> None:
    written = files.ChunkWriter.written.fget

    def interrupted(self: files.ChunkWriter) -> int:
        if written(self) > 1000:
            raise KeyboardInterrupt
        return written(self)

    monkeypatch.setattr(files.ChunkWriter, "written", property(interrupted))
    with pytest.raises(KeyboardInterrupt):
        edit_chunks(chunked, tmp_path / "made", options=EditOptions(move=(1, 0, 0)))
    assert [path.name for path in tmp_path.iterdir()] == ["chunked"]


def test_exports(chunked, held, tmp_path) -> None:
    for what, name, options in (
        ("splat", "a.ply", {"layer": "classes", "instances": "objects"}),
        ("objects", "objects", {"layer": "objects"}),
        ("table", "a.csv", {"layer": "objects"}),
        ("coco", "coco", {"layer": "objects"}),
    ):
        for folder, scene in (("ours", chunked), ("theirs", held)):
            (tmp_path / folder).mkdir(exist_ok=True)
            asked = ExportOptions(**options)
            export_scene(scene, tmp_path / folder / name, what, options=asked, backend="cpu")
    ours = [path for path in (tmp_path / "ours").rglob("*") if path.is_file()]
    assert len(ours) > 10
    for path in ours:
        other = tmp_path / "theirs" / path.relative_to(tmp_path / "ours")
        assert path.read_bytes() == other.read_bytes(), path


def test_exports_that_cannot_stream(chunked, tmp_path) -> None:
    objects = ExportOptions(layer="objects")
    for what in ("points", "meshes"):
        with pytest.raises(InputError, match=f"what {what}: needs all Gaussians at once"):
            export_scene(chunked, tmp_path / "a.ply", what, options=objects)
    for name in ("a.splat", "a.spz", "a.sog", "a.compressed.ply"):
        with pytest.raises(InputError, match=r"expected a \.ply file for Gaussians in chunks"):
            export_scene(chunked, tmp_path / name)
    with pytest.raises(InputError, match="is the scene's own"):
        export_scene(chunked, chunked.root / "gaussians" / "a.ply")
    assert [path.name for path in tmp_path.iterdir()] == ["chunked"]


def test_only_some_objects_are_exported_to_any_format(chunked, held, tmp_path) -> None:
    """They are in memory then."""
    options = ExportOptions(layer="objects", only=("2",))
    for name, scene in (("ours.ply", chunked), ("theirs.ply", held)):
        export_scene(scene, tmp_path / name, options=options)
    assert (tmp_path / "ours.ply").read_bytes() == (tmp_path / "theirs.ply").read_bytes()


def test_columns_of_the_scene_survive(whole, tmp_path, monkeypatch) -> None:
    """Further columns go with rows through chunks, an edit and an export."""
    monkeypatch.setattr(files, "CHUNK_ROWS", 128)
    gaussians = load_scene(whole).gaussians
    numbered = gaussians.replace(extra={"number": torch.arange(len(gaussians)).int()})
    save_scene(Scene(gaussians=numbered), tmp_path / "scene")
    chunk_scene(tmp_path / "scene", tmp_path / "chunked", memory=MEMORY)
    scene = load_scene(tmp_path / "chunked", memory=MEMORY)
    edit_chunks(scene, tmp_path / "moved", options=EditOptions(duplicate=True, opacity=(0.5, 1)))
    moved = load_scene(tmp_path / "moved", memory=MEMORY)
    export_scene(moved, tmp_path / "a.ply")
    found = read_splats(tmp_path / "a.ply")
    solid = gaussians.opacities >= 0.5
    assert len(found) == len(gaussians) + int(solid.sum())
    number = found.extra["number"].long()
    torch.testing.assert_close(found.opacities, gaussians.opacities[number])
    assert torch.equal(number.unique(), torch.arange(len(gaussians)))


def test_selections_are_layers_of_it(chunked) -> None:
    mask = torch.zeros(len(chunked.gaussians), dtype=torch.bool)
    mask[5] = True
    save_scene_layer(Selection(mask=mask), chunked.root, "mine")
    assert torch.equal(chunked.layers["mine"].mask, mask)
    assert isinstance(chunked.layers["classes"], Labels)
    with pytest.raises(InputError, match="as the scene has Gaussians"):
        save_scene_layer(Selection(mask=mask[1:]), chunked.root, "mine")


def test_a_document_needs_all_of_it(chunked) -> None:
    with pytest.raises(InputError, match="in chunks, which this cannot stream"):
        load_document(chunked.root)
