"""Drives in blocks through the task: real mesh fields of two blocks, joined, stopped, gone on."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from splatseg.core import Renderable, Scene
from splatseg.errors import FileFormatError, InputError, MissingFileError
from splatseg.io.scans import read_scans
from splatseg.io.scene_fields import scene_field_names
from splatseg.street.block_field import DriveField
from splatseg.street.blocks import DriveBlockOptions, distances
from splatseg.street.build import DnmpOptions
from splatseg.street.field import MeshField
from splatseg.street.files import load_drive
from splatseg.tasks import (
    ScanLabelOptions,
    StreetDrive,
    StreetField,
    StreetOptions,
    label_scans,
    make_street_field,
    open_drive,
    street_field,
    street_field_of_scene,
)
from splatseg.tasks.street_drive import street_drive
from splatseg.tasks.work import Work, scene_field
from support.arrays import arrays_of
from support.observers import Stopping

LEARNING = DnmpOptions(voxels=(2.0,), geometry_iterations=3, iterations=200, rays=256)
QUICK = replace(LEARNING, geometry_iterations=1, iterations=3, rays=64)
LAYER = "labels_semantic"


@pytest.fixture(scope="module")
def options(generated_drive) -> StreetOptions:
    """25 metres in two blocks that share 6."""
    return StreetOptions(
        evidence=LAYER, scans=generated_drive, block_length=20.0, block_overlap=6.0
    )


@pytest.fixture(scope="module")
def empty(generated_drive, tmp_path_factory) -> Path:
    """A scene without fields; not to be changed."""
    root = tmp_path_factory.mktemp("drive") / "scene"
    open_drive(generated_drive, new_scene=root)
    return root


@pytest.fixture(scope="module")
def both(empty, options, tmp_path_factory) -> tuple[Scene, Renderable, StreetDrive]:
    """A scene, its field in one, and in two blocks; not to be changed."""
    scene = open_drive(shutil.copytree(empty, tmp_path_factory.mktemp("both") / "scene"))
    whole = replace(options, field="one", block_length=None, block_overlap=None)
    make_street_field(scene, options=whole, field_options=LEARNING)
    made = make_street_field(scene, options=options, field_options=LEARNING)
    assert isinstance(made, StreetDrive)
    return scene, scene_field(scene, "one"), made


@pytest.fixture(scope="module")
def quick(empty, options, tmp_path_factory) -> Path:
    """A scene with a field in two blocks that learned next to nothing; not to be changed."""
    root = shutil.copytree(empty, tmp_path_factory.mktemp("quick") / "scene")
    make_street_field(open_drive(root), options=options, field_options=QUICK)
    return root


@pytest.fixture
def scene(empty, tmp_path) -> Scene:
    return open_drive(shutil.copytree(empty, tmp_path / "scene"))


@pytest.fixture
def filled(quick, tmp_path) -> Scene:
    return open_drive(shutil.copytree(quick, tmp_path / "scene"))


def contents(root: Path, name: str = "street") -> dict[str, bytes]:
    folder = root / "fields" / name
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def stopped(scene: Scene, options: StreetOptions, **more: object) -> str:
    """Stop in the second block; gives what was said."""
    observer = Stopping("field", after=QUICK.iterations or 0, error=KeyboardInterrupt)
    with pytest.raises(KeyboardInterrupt) as caught:
        make_street_field(scene, options=options, field_options=QUICK, observer=observer, **more)
    return str(caught.value)


def test_blocks_are_a_field_of_the_scene(both, options) -> None:
    scene, _, made = both
    assert scene_field_names(scene.root) == ("one", "street")
    assert made.folder == scene.root / "fields/street"
    assert set(contents(scene.root)) == {"drive.json", "0000.safetensors", "0001.safetensors"}
    drive = load_drive(made.folder / "drive.json")
    assert (len(drive), drive.overlap) == (2, 6.0)
    assert drive.blocks[1].end - drive.blocks[0].start == pytest.approx(24.7, abs=0.5)
    facts = made.facts
    assert (facts["blocks"], facts["blocks_made"], facts["layer"]) == (2, 2, LAYER)
    assert facts["views"] == len(scene.train_views)
    assert set(facts["stage_seconds"]) == {"points", "geometry", "field"}
    json.dumps(facts)
    found = scene_field(scene, "street")
    assert isinstance(found, DriveField)
    info = found.layer(LAYER).info
    assert set(info.views) == {view.name for view in scene.train_views}
    assert info.details["blocks"] == 2


def test_each_block_has_its_own_views_and_points(both) -> None:
    scene, one, made = both
    drive = load_drive(made.folder / "drive.json")
    assert isinstance(one, MeshField)
    parts = [made.field._field(block.index) for block in drive.blocks]
    assert made.primitives == sum(len(part.mesh) for part in parts)
    for block, part in zip(drive.blocks, parts, strict=True):
        centres = torch.stack([scene.view(name).camera.centre for name in part.info.views])
        assert 0 < len(centres) < len(scene.train_views)
        assert bool(drive.counts(block, centres).all())
        assert len(part.mesh) < len(one.mesh) < made.primitives


def test_blocks_have_no_primitives_out_of_their_reach(scene, options, quick, monkeypatch) -> None:
    near = DriveBlockOptions(length=20.0, overlap=6.0, reach=6.0)
    monkeypatch.setattr(StreetOptions, "blocks", near)
    made = make_street_field(scene, options=options, field_options=QUICK)
    drive = load_drive(made.folder / "drive.json")
    far = scene_field(open_drive(quick), "street")
    for block in drive.blocks:
        off = []
        for field in (made.field, far):
            vertices = field._field(block.index).mesh.vertices.reshape(-1, 42, 3)
            off.append(float(distances(vertices.mean(dim=1).double(), block.span).max()))
        assert off[0] < 6.0 + 2.0 < off[1]


def test_there_is_no_seam(both, generated_drive) -> None:
    """Where both blocks count, label maps and points are as good as those of one field."""
    scene, one, made = both
    drive = load_drive(made.folder / "drive.json")

    def correct(field: Renderable) -> float:
        found = []
        for view in scene.views:
            if len(drive.shares(view.camera.centre[None])) == 2:
                with Image.open(generated_drive / "semantic" / f"{view.name}.png") as opened:
                    truth = torch.from_numpy(np.array(opened)).int()
                found.append((field.view(view.camera).label_map(LAYER).ids == truth).float().mean())
        assert len(found) >= 3
        return float(torch.stack(found).mean())

    assert correct(one) > 0.7
    assert correct(made.field) > correct(one) - 0.05
    source = read_scans(generated_drive)
    scans = [source.scan(name) for name in source.scan_names]
    points = torch.cat([scan.points for scan in scans])
    truth = torch.cat([scan.labels["semantic"] for scan in scans])
    first, _ = drive.shares(points)
    weights = torch.zeros(len(points), dtype=torch.float64)
    weights[first.rows] = first.weights
    near = (weights > 0.1) & (weights < 0.9)
    assert int(near.sum()) > 500
    labels = [field.labels_at(points[near], LAYER).ids for field in (one, made.field)]
    right = [float((ids == truth[near]).float().mean()) for ids in labels]
    assert right[0] > 0.3
    assert right[1] > right[0] - 0.05
    # Neighbours of one class on two sides of the border: as often of one label as in one field.
    left, beyond = near & (weights >= 0.5), near & (weights < 0.5)
    gaps = torch.cdist(points[left], points[beyond])
    i, j = torch.nonzero(gaps < 1.0, as_tuple=True)
    alike = truth[left][i] == truth[beyond][j]
    assert int(alike.sum()) > 50
    jumps = []
    for field in (one, made.field):
        ids = [field.labels_at(points[side], LAYER).ids for side in (left, beyond)]
        jumps.append(float((ids[0][i] != ids[1][j])[alike].float().mean()))
    assert jumps[1] < jumps[0] + 0.05


def test_scans_are_labelled_block_by_block(both, generated_drive, tmp_path, monkeypatch) -> None:
    scene, _, made = both
    scans = read_scans(generated_drive)
    expected = {
        name: made.field.labels_at(scans.scan(name).points, LAYER).ids for name in scans.scan_names
    }

    def refuse(*_: object) -> None:
        raise AssertionError("a scan was labelled as one cloud")

    monkeypatch.setattr(DriveField, "labels_at", refuse)
    found = scene_field(scene, "street")
    asked = ScanLabelOptions(form="npz")
    label_scans(scene, generated_drive, tmp_path / "labels", field=found, options=asked)
    written = arrays_of(tmp_path / "labels/labels.npz")["semantic"]
    for number, name in enumerate(scans.scan_names):
        scan = scans.scan(name)
        ids = scan.recorded_labels(expected[name]).clamp_min(0)
        assert np.array_equal(written[number].reshape(-1), ids.numpy())


def test_blocks_are_asked_by_another_rule(both, generated_drive, tmp_path) -> None:
    scene, _, made = both
    scans = read_scans(generated_drive)
    points = scans.scan(scans.scan_names[0]).points
    assert made.field.layer(LAYER).info.options["vertex_rule"] == "weighed"
    field = street_field_of_scene(
        scene, options=StreetOptions(block_length=20.0),
        field_options=DnmpOptions(vertex_rule="adjusted"),
    )  # fmt: skip
    own, adjusted = (one.labels_at(points, LAYER).ids for one in (made.field, field))
    assert int((adjusted < 0).sum()) > int((own < 0).sum())
    labels = label_scans(scene, scans, tmp_path / "labels", field=field)
    assert labels.vertex_rule == "adjusted"
    assert label_scans(scene, scans, tmp_path / "own", field=made.field).vertex_rule == "weighed"
    assert labels.counts.unlabelled >= int((adjusted < 0).sum())


def test_what_was_stopped_goes_on_to_the_same_bytes(scene, quick, options) -> None:
    said = stopped(scene, options)
    assert said.startswith(f"1 of 2 blocks of {scene.root / 'fields/street'} are made; the same")
    first = (scene.root / "fields/street/0000.safetensors").stat()
    with pytest.raises(MissingFileError, match="all 2 blocks of the drive, 1 lack"):
        scene_field(scene, "street")
    assert street_field_of_scene(scene, options=options) is None
    made = make_street_field(scene, options=options, field_options=QUICK)
    assert made.facts["blocks_made"] == 1
    assert (scene.root / "fields/street/0000.safetensors").stat().st_mtime_ns == first.st_mtime_ns
    assert contents(scene.root) == contents(quick)
    assert made.facts["primitives"] == sum(len(made.field._field(index).mesh) for index in range(2))
    assert isinstance(street_field_of_scene(scene, options=options), DriveField)


def test_a_new_scene_of_a_capture_is_gone_on_with(
    generated_drive, options, quick, tmp_path
) -> None:
    """The call that makes the scene and the one that finds it see the same cameras."""
    stopped(open_drive(generated_drive, new_scene=tmp_path / "new"), options)
    scene = open_drive(generated_drive, new_scene=tmp_path / "new")
    make_street_field(scene, options=options, field_options=QUICK)
    assert contents(tmp_path / "new") == contents(quick)


def test_nothing_is_there_of_what_is_stopped_in_its_first_block(scene, options) -> None:
    observer = Stopping("field", error=KeyboardInterrupt)
    with pytest.raises(KeyboardInterrupt):
        make_street_field(scene, options=options, field_options=QUICK, observer=observer)
    assert scene_field_names(scene.root) == ()
    assert list((scene.root / "fields").iterdir()) == []


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"seed": 1}, "seed"),
        ({"layer": "other"}, "layer"),
        ({"block_overlap": 5.0}, "block_overlap"),
        ({"scans": None}, "scans"),
        ({"views": ("all",)}, "cameras"),
    ],
)
def test_what_was_stopped_is_not_gone_on_with_as_something_else(
    scene, options, change, named
) -> None:
    stopped(scene, options)
    before = contents(scene.root)
    other = replace(options, **change)
    words = rf"expected blocks of the same drive to go on with, got those of another \(.*{named}"
    with pytest.raises(InputError, match=words):
        make_street_field(scene, options=other, field_options=QUICK)
    assert contents(scene.root) == before
    if "seed" in change:
        made = make_street_field(scene, options=other, field_options=QUICK, overwrite=True)
        assert made.facts["blocks_made"] == 2
        assert made.field.layer(LAYER).info.seed == 1


def test_inputs_that_changed_in_place_are_noticed(
    empty, generated_drive, options, tmp_path
) -> None:
    capture = shutil.copytree(generated_drive, tmp_path / "capture")
    scene = open_drive(capture, new_scene=tmp_path / "scene")
    asked = replace(options, scans=capture)
    stopped(scene, asked)
    with np.load(capture / "lidar.npz") as found:
        arrays = dict(found)
    arrays["lidar_to_world"][0, 2, 3] += 1e-3
    np.savez(capture / "lidar.npz", **arrays)
    name = scene.train_views[0].name
    ids = np.array(Image.open(capture / LAYER / f"{name}.png"))
    Image.fromarray(np.roll(ids, 1)).save(capture / LAYER / f"{name}.png")
    with pytest.raises(InputError, match=r"another \(label maps, scans\); `overwrite` begins"):
        make_street_field(scene, options=asked, field_options=QUICK)


def test_a_name_of_the_other_form_is_refused_or_replaced(filled, options) -> None:
    scene, root = filled, filled.root
    one = replace(options, block_length=None, block_overlap=None)
    taken = rf"^field: {root} has one called 'street'; give another name, or `overwrite`"
    for asked in (one, options):
        with pytest.raises(InputError, match=taken):
            make_street_field(scene, options=asked, field_options=QUICK)
    made = make_street_field(scene, options=one, field_options=QUICK, overwrite=True)
    assert isinstance(made, StreetField)
    assert [path.name for path in (root / "fields").iterdir()] == ["street.safetensors"]
    assert isinstance(scene_field(scene, "street"), MeshField)
    for asked in (one, options):
        with pytest.raises(InputError, match=taken):
            make_street_field(scene, options=asked, field_options=QUICK)
    with pytest.raises(InputError, match=taken):
        street_drive(Work(scene=scene), options, QUICK, overwrite=False)
    make_street_field(scene, options=options, field_options=QUICK, overwrite=True)
    assert [path.name for path in (root / "fields").iterdir()] == ["street"]
    assert isinstance(scene_field(scene, "street"), DriveField)


def test_what_is_replaced_stays_until_blocks_can_be_made(filled, options) -> None:
    before = contents(filled.root)
    bad = replace(options, depth="maps", scans=None)
    with pytest.raises(InputError, match="^depth: expected maps of the"):
        make_street_field(filled, options=bad, field_options=QUICK, overwrite=True)
    assert contents(filled.root) == before


def test_a_stopped_drive_is_no_one_field(scene, options) -> None:
    stopped(scene, options)
    one = replace(options, block_length=None, block_overlap=None)
    with pytest.raises(InputError, match="that was stopped; the command that began it goes on"):
        make_street_field(scene, options=one, field_options=QUICK)


def test_a_broken_table_is_one_sentence(filled, options) -> None:
    path = filled.root / "fields/street/drive.json"
    path.write_text(path.read_text()[:100])
    for work in (scene_field, lambda scene, _: make_street_field(scene, options=options)):
        with pytest.raises(FileFormatError, match=r"drive\.json"):
            work(filled, "street")
    make_street_field(filled, options=options, field_options=QUICK, overwrite=True)
    assert len(load_drive(path)) == 2


@pytest.mark.parametrize(
    ("values", "words"),
    [
        (
            {"block_length": 10, "block_overlap": 10},
            "^block_overlap: expected less than 10 m",
        ),
        ({"block_length": 0}, "^block_length: expected more than 0, got 0"),
        ({"block_length": 9, "block_overlap": -1}, "^block_overlap: expected more than 0"),
        ({"block_overlap": 5}, "^block_overlap: expected a length of blocks with it, got 5 m"),
    ],
)
def test_lengths_that_cannot_be_are_refused(values, words) -> None:
    with pytest.raises(InputError, match=words):
        StreetOptions(**values)


def test_blocks_overlap_by_a_quarter_where_nothing_is_said() -> None:
    cut = StreetOptions(block_length=40.0).blocks
    assert cut is not None
    assert (cut.length, cut.overlap) == (40.0, 10.0)
    assert StreetOptions().blocks is None


def test_blocks_that_nothing_is_known_of_are_refused(scene, options, tmp_path) -> None:
    """Before anything is made: label maps of the first half alone."""
    maps = tmp_path / "scene/evidence" / LAYER
    known = sorted((scene.source / LAYER).glob("train_*.png"))[:4]
    maps.mkdir(parents=True)
    for path in known:
        shutil.copy(path, maps / path.name)
    shutil.copy(scene.source / "metadata.json", maps.parent / "metadata.json")
    with pytest.raises(InputError, match=r"^evidence: expected label maps .* of block 2 of 2, got"):
        make_street_field(scene, options=options, field_options=QUICK)
    assert list((scene.root / "fields").iterdir()) == []
    with pytest.raises(InputError, match="^block_length: expected none of one field, got 20 m"):
        street_field(scene, options=options)
    whole = replace(options, block_length=None, block_overlap=None)
    with pytest.raises(InputError, match="^block_length: expected the length of blocks"):
        street_drive(Work(scene=scene), whole, None, overwrite=False)
    for make in (make_street_field,):
        with pytest.raises(InputError, match="^scene: expected one with a folder"):
            make(replace(scene, root=None), options=options)
