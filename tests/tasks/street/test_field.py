"""Mesh fields of a drive: of a capture or a scene, from every source of depth, saved and read."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from splatseg.core import Gaussians, ScanSource, Scene
from splatseg.errors import InputError
from splatseg.io.evidence import create_evidence
from splatseg.io.scans import read_scans
from splatseg.io.scene_fields import scene_field_names
from splatseg.street.build import DnmpOptions, visible_shares
from splatseg.tasks import (
    EvaluationOptions,
    RenderingOptions,
    StreetOptions,
    evaluate_scene,
    open_drive,
    render_views,
    save_street_field,
    street_field,
)
from splatseg.tasks.street_inputs import drive_inputs, drive_sources
from splatseg.tasks.work import Observer, Work, scene_field

QUICK = DnmpOptions(voxels=(2.0, 4.0), geometry_iterations=1, iterations=3, rays=64)
EVIDENCE = StreetOptions(evidence="labels_semantic")


@pytest.fixture(scope="module")
def drive(generated_drive, tmp_path_factory) -> Scene:
    """A scene without Gaussians; not to be changed."""
    return open_drive(generated_drive, new_scene=tmp_path_factory.mktemp("drive") / "scene")


@pytest.fixture(scope="module")
def made(drive, generated_drive):
    """Its mesh field, of scans."""
    options = replace(EVIDENCE, scans=generated_drive, layer="classes")
    return street_field(drive, options=options, field_options=QUICK)


def sparse_gaussians(scans: ScanSource) -> Gaussians:
    """Gaussians where lasers hit something."""
    points = torch.cat([scans.scan(name).points for name in scans.scan_names]).float()
    rotations = torch.zeros(len(points), 4)
    rotations[:, 0] = 1
    return Gaussians(
        means=points, rotations=rotations, scales=torch.full((len(points), 3), 0.2),
        opacities=torch.full((len(points),), 0.9), sh=torch.zeros(len(points), 1, 3),
    )  # fmt: skip


def test_the_field_of_a_drive_knows_what_it_was_made_from(made, drive) -> None:
    assert made.field.layer_names == ("classes",)
    info = made.field.layer("classes").info
    assert (info.method, info.evidence, info.seed) == ("dnmp", "labels_semantic", 0)
    assert info.views == tuple(view.name for view in drive.train_views)
    assert info.options["iterations"] == 3
    assert info.names[1] == "road"
    assert "points of scans" in info.details["sources"]
    assert made.facts["primitives"] == len(made.field.mesh) > 20
    assert made.facts["iterations"] == 3
    assert made.field.radius == 2.0
    assert set(made.facts["stage_seconds"]) == {"points", "geometry", "field"}


def test_it_is_written_into_the_scene_and_rendered_and_scored_from_there(
    made, drive, generated_drive, tmp_path
) -> None:
    import shutil

    root = shutil.copytree(drive.root, tmp_path / "scene")
    path = save_street_field(made, root)
    assert path == root / "fields/street.safetensors"
    assert scene_field_names(root) == ("street",)
    scene = replace(drive, root=root)
    field = scene_field(scene, "street")
    drawn = render_views(
        scene,
        tmp_path / "views",
        options=RenderingOptions(what=("rgb", "depth", "alpha", "classes")),
        field=field,
    )
    assert drawn.views == len(scene.test_views)
    name = scene.test_views[0].name
    ids = np.asarray(Image.open(tmp_path / f"views/classes/{name}.png"))
    assert set(np.unique(ids)) <= {0, *field.model.ids}
    scores = evaluate_scene(
        scene,
        field=field,
        options=EvaluationOptions(layer="classes", truth=generated_drive / "semantic"),
    )
    assert 0 <= scores["mIoU"] <= 1
    assert scores["PSNR"] > 5
    with pytest.raises(InputError, match=r"^field: expected one of .* \(street\), got 'other'"):
        scene_field(scene, "other")


def test_the_same_seed_gives_the_same_field_and_another_another(
    made, drive, generated_drive
) -> None:
    options = replace(EVIDENCE, scans=generated_drive)
    again = street_field(drive, options=options, field_options=QUICK)
    assert torch.equal(again.field.mesh.vertices, made.field.mesh.vertices)
    assert torch.equal(again.field.model.features, made.field.model.features)
    other = street_field(drive, options=replace(options, seed=1), field_options=QUICK)
    assert not torch.equal(other.field.model.features, made.field.model.features)


def test_depth_comes_from_what_is_there(drive, generated_drive) -> None:
    scans = read_scans(generated_drive)
    views = drive.train_views[:2]
    asked = {"cell": 0.5}
    some = torch.rand(200, 3, generator=torch.Generator().manual_seed(1)) * 8
    full = replace(drive, gaussians=sparse_gaussians(scans))
    bare = tuple(replace(view, depth=None, depth_unit=None) for view in views)
    found = {
        "scans": drive_sources(
            Work(scene=drive, backend="cpu"), bare, depth="auto", scans=scans, points=some, **asked
        ),
        "scans, and of the Gaussians where no laser looked": drive_sources(
            Work(scene=full, backend="cpu"), bare, depth="auto", scans=scans, points=some, **asked
        ),
        "the Gaussians": drive_sources(
            Work(scene=full, backend="cpu"), bare, depth="auto", scans=None, points=some, **asked
        ),
        "points": drive_sources(
            Work(scene=drive, backend="cpu"), bare, depth="auto", scans=None, points=some, **asked
        ),
    }
    known: dict[str, list[torch.Tensor]] = {}
    for kind, (_, read, said) in found.items():
        assert said.endswith(f"depth of {kind}")
        depths = list(read())
        assert [d.camera for d in depths] == [view.camera for view in bare]
        assert len(list(read())) == 2
        known[kind] = [view.depth for view in depths]
    assert len(found["scans"][0]) > len(found["points"][0]) == 200
    assert len(found["the Gaussians"][0]) > 200
    measured, both, shown = (known[kind] for kind in list(found)[:3])
    for one, filled, other in zip(measured, both, shown, strict=True):
        assert torch.equal(filled, torch.where(one > 0, one, other))
    assert any(not torch.equal(one, filled) for one, filled in zip(measured, both, strict=True))
    centres = drive_sources(
        Work(scene=full, backend="cpu"), bare, depth="points", scans=None, points=None, **asked
    )
    assert "centres of Gaussians" in centres[2]
    for kind, words in {
        "scans": "expected scans to be given",
        "maps": "expected maps of the 2 views",
        "gaussians": "expected a scene with Gaussians",
        "scans+gaussians": "expected a scene with Gaussians",
        "labels_semantic": "or evidence of depth, got 'labels_semantic' of labels",
        "nothing": "expected one of those at hand .*got 'nothing'",
    }.items():
        with pytest.raises(InputError, match=f"^depth: .*{words}"):
            drive_sources(
                Work(scene=drive, backend="cpu"), bare, depth=kind, scans=None, points=some, **asked
            )
    with pytest.raises(InputError, match="^points: expected points to put primitives at"):
        drive_sources(
            Work(scene=drive, backend="cpu"), bare, depth="points", scans=None, points=None, **asked
        )


def test_maps_of_the_capture_give_depth_and_points(drive, tmp_path) -> None:
    view = drive.train_views[0]
    steps = np.full((view.camera.height, view.camera.width), 3000, np.uint16)
    Image.fromarray(steps).save(tmp_path / "a.png")
    mapped = replace(view, depth=tmp_path / "a.png", depth_unit=0.001)
    points, _, said = drive_sources(
        Work(scene=drive, backend="cpu"), [mapped], depth="auto", scans=None, points=None, cell=0.5
    )
    assert said.endswith("depth maps of the capture")
    assert "points of depth" in said
    _, z = view.camera.project(points)
    torch.testing.assert_close(z, torch.full_like(z, 3.0), atol=0.3, rtol=0)


def test_what_a_ray_saw_next_to_nothing_of_was_adjusted() -> None:
    """float16 holds no number so small; Adam moved the vertex by its whole rate all the same."""
    shares = visible_shares(torch.tensor([0.0, 1e-30, 1e-7, 10.0, 1e9]))
    assert shares.tolist() == [0.0, 2.0**-24, 2.0**-24, 0.5, 1.0]
    assert torch.equal(shares, shares.half().float())


def test_options_count(drive, generated_drive) -> None:
    scans = StreetOptions(evidence="labels_semantic", scans=generated_drive)
    one = street_field(drive, options=replace(scans, views=("train_0000",)), field_options=QUICK)
    assert len(one.views) == 1
    assert one.field.seen is not None
    assert 0 < float(one.field.seen.max()) <= 1
    assert one.field.vertex_rule == "weighed"
    asked = street_field(drive, options=scans, field_options=replace(QUICK, vertex_rule="adjusted"))
    assert asked.field.vertex_rule == asked.field.info.options["vertex_rule"] == "adjusted"
    adjusted = asked.field.info.details["adjusted_vertices"]
    assert 0 < adjusted == int((asked.field.seen > 0).sum()) < asked.field.info.details["vertices"]
    coarse = street_field(
        drive, options=scans, field_options=replace(QUICK, voxels=(4.0,), radius=1.5)
    )
    assert coarse.field.mesh.sizes == (4.0,)
    assert coarse.field.radius == 1.5


def test_progress_counts_the_steps_of_all_levels(drive, generated_drive) -> None:
    class Listening(Observer):
        def __init__(self) -> None:
            self.heard: list[tuple[str, int, int]] = []

        def progress(self, stage: str, done: int, total: int) -> None:
            self.heard.append((stage, done, total))

    observer = Listening()
    options = replace(EVIDENCE, scans=generated_drive)
    few = replace(QUICK, geometry_iterations=2, iterations=3)
    street_field(drive, options=options, field_options=few, observer=observer)
    geometry = [told[1:] for told in observer.heard if told[0] == "geometry"]
    assert geometry[0] == (1, 4)
    assert geometry[-1] == (4, 4)
    assert {total for stage, _, total in observer.heard if stage == "field"} == {3}


def test_the_only_label_maps_teach(drive, tmp_path) -> None:
    """Depth of scans, which a fit leaves in its scene, is evidence too."""
    (tmp_path / "evidence").mkdir()
    create_evidence(tmp_path / "evidence" / "depth_scans", kind="depth")
    with drive_inputs(Work(scene=replace(drive, root=tmp_path)), StreetOptions()) as inputs:
        assert inputs.name == "labels_semantic"


def test_what_is_refused(drive, generated_drive, tmp_path) -> None:
    scans = replace(EVIDENCE, scans=generated_drive)

    def make(scene: Scene = drive, options: StreetOptions = scans, **more: object) -> None:
        street_field(scene, options=options, field_options=QUICK, **more)

    with pytest.raises(InputError, match="^evidence: expected one of those at hand"):
        make(options=replace(scans, evidence="masks"))
    with pytest.raises(InputError, match=r"^points: expected points in several voxels of 2 m, got"):
        make(options=EVIDENCE, points=torch.rand(50, 3))
    blind = replace(drive, views=tuple(replace(view, image=None) for view in drive.views))
    with pytest.raises(InputError, match="^views: expected photographs of the"):
        make(blind)
    few = replace(drive.classes, rows=drive.classes.rows[:2])
    maps = tmp_path / "evidence" / "labels_semantic"
    maps.parent.mkdir()
    maps.symlink_to(generated_drive / "labels_semantic")
    unnamed = replace(drive, classes=few, source=None, root=tmp_path)
    with pytest.raises(InputError, match=r"labels_semantic: expected ids of .* in the label map"):
        make(unnamed)
    with pytest.raises(InputError, match="^field: expected a name of letters"):
        StreetOptions(field="../up")
    with pytest.raises(InputError, match="^new_scene: expected a scene folder to write"):
        open_drive(generated_drive)
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken/file").write_text("mine")
    with pytest.raises(InputError, match="expected a new folder, got one that is there"):
        open_drive(generated_drive, new_scene=tmp_path / "taken")
    with pytest.raises(InputError, match="^new_scene: expected none with"):
        open_drive(drive.root, new_scene=tmp_path / "new")


def test_a_capture_opens_the_scene_that_was_made_of_it(generated_drive, tmp_path) -> None:
    first = open_drive(generated_drive, new_scene=tmp_path / "scene")
    again = open_drive(generated_drive, new_scene=tmp_path / "scene")
    assert again.root == first.root
    assert len(again.gaussians) == 0
    assert open_drive(tmp_path / "scene").root == first.root
    assert Path(again.source) == generated_drive
