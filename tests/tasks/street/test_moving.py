"""Moving things are left out of mesh fields: of views, of scans, of depth, in one and in blocks."""

import json
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from splatseg.core import Scene, View
from splatseg.core.scans import MovingBox, inside_boxes, pixels_of_boxes
from splatseg.errors import FileFormatError, InputError, MissingFileError, ShapeError
from splatseg.io.evidence import open_evidence
from splatseg.io.images import load_mask
from splatseg.io.moving import write_moving
from splatseg.io.scans import read_scans
from splatseg.street.build import DnmpOptions
from splatseg.street.depth_views import DepthView
from splatseg.tasks import StreetDrive, StreetOptions, make_street_field, open_drive, street_field
from splatseg.tasks.street_inputs import (
    drive_inputs,
    drive_sources,
    masked_depths,
    masked_depths_of,
)
from splatseg.tasks.work import Work
from support.observers import Stopping

LAYER = "labels_semantic"
QUICK = DnmpOptions(voxels=(2.0,), geometry_iterations=1, iterations=2, rays=64)
MARGIN = 0.1


def opened(scene: Scene) -> Work:
    """The scene, told about to one who may stop."""
    return Work(scene=scene, backend="cpu", observer=Stopping())


@pytest.fixture(scope="module")
def scene(generated_drive, tmp_path_factory) -> Scene:
    """A scene without Gaussians; not to be changed."""
    return open_drive(generated_drive, new_scene=tmp_path_factory.mktemp("moving") / "scene")


def ahead(view: View, metres: float, side: float = 2.0, **rest: float) -> MovingBox:
    """A cube before a view."""
    forward = view.camera.world_from_cam[:3, 2]
    return MovingBox(
        centre=view.camera.centre + metres * forward,
        size=(side, side, side),
        rotation=torch.tensor([1.0, 0, 0, 0]),
        **rest,
    )


def written(boxes: Sequence[MovingBox], folder: Path) -> Path:
    write_moving(boxes, folder / "boxes.json")
    return folder / "boxes.json"


def asked(generated_drive: Path, **rest) -> StreetOptions:
    return StreetOptions(evidence=LAYER, scans=generated_drive, **rest)


def test_boxes_of_their_moment_are_left_out_of_views(scene, generated_drive, tmp_path) -> None:
    first, second = scene.train_views[1:3]
    number = float(first.name[-4:])
    box = ahead(first, 6.0, start=number, end=number)
    options = asked(generated_drive, moving=written([box], tmp_path), moving_clock="frames")
    with drive_inputs(opened(scene), options) as inputs:
        masks = {view.name: load_mask(view) for view in inputs.views}
        folder = next(view.mask for view in inputs.views if view.mask is not None).parent
        assert inputs.moving is not None
        left_out = inputs.moving
    assert not folder.exists()
    assert [name for name, mask in masks.items() if mask is not None] == [first.name]
    hidden = pixels_of_boxes(first.camera, [box], margin=MARGIN)
    assert torch.equal(masks[first.name] == 0, hidden)
    assert masks[second.name] is None
    count = len(scene.train_views)
    assert (left_out.views, left_out.of) == (1, count)
    assert left_out.share == pytest.approx(float(hidden.float().mean()) / count)
    assert left_out.sentence == (
        f"moving things are left out of 1 of the {count} training views, {left_out.share:.1%} of "
        "their pixels"
    )


def test_the_clock_is_that_of_the_capture_unless_frames_are_asked_for(
    generated_drive, tmp_path
) -> None:
    capture = shutil.copytree(generated_drive, tmp_path / "capture")
    content = json.loads((capture / "transforms.json").read_text())
    for frame in content["frames"]:
        frame["time"] += 100
    (capture / "transforms.json").write_text(json.dumps(content))
    scene = open_drive(capture, new_scene=tmp_path / "scene")
    first, second = scene.train_views[1:3]
    time, number = 100 + float(first.name[-4:]), float(second.name[-4:])
    boxes = [ahead(first, 6.0, start=time, end=time), ahead(second, 6.0, start=number, end=number)]
    options = StreetOptions(evidence=LAYER, moving=written(boxes, tmp_path))
    found = {}
    for clock in ("recorded", "frames"):
        with drive_inputs(opened(scene), replace(options, moving_clock=clock)) as inputs:
            found[clock] = [view.name for view in inputs.views if view.mask is not None]
    assert found == {"recorded": [first.name], "frames": [second.name]}


def test_scans_lose_their_points_in_boxes(scene, generated_drive, tmp_path) -> None:
    whole = read_scans(generated_drive)
    scan = whole.scan("0001")
    box = MovingBox(
        centre=scan.points[200], size=(4.0, 4.0, 4.0), rotation=torch.tensor([1.0, 0, 0, 0]),
        start=scan.time - 0.6, end=scan.time + 0.6,
    )  # fmt: skip
    inside = inside_boxes(scan.points, [box], margin=MARGIN)
    assert int(inside.sum()) > 3
    options = asked(generated_drive, moving=written([box], tmp_path))
    with drive_inputs(opened(scene), options) as inputs:
        assert inputs.scans is not None
        assert torch.equal(inputs.scans.scan("0001").points, scan.points[~inside])
        assert len(inputs.scans.scan("0000")) == len(whole.scan("0000"))


def test_classes_are_left_out_of_views(scene, generated_drive) -> None:
    evidence = open_evidence(generated_drive / LAYER)
    sky = evidence.classes.by_name("sky").id
    with drive_inputs(opened(scene), asked(generated_drive, moving_classes=("sky",))) as inputs:
        for view in inputs.views:
            shown = evidence.label_map(view.name).ids == sky
            mask = load_mask(view)
            assert bool(shown.any()) == (mask is not None)
            if mask is not None:
                assert not bool(mask.bool()[shown].any())
        assert inputs.moving.record["classes"] == ["sky"]
        assert inputs.moving.share > 0.05


def test_views_that_are_learned_from_lose_them_whatever_their_split(scene, generated_drive) -> None:
    options = asked(generated_drive, moving_classes=("sky",), views=("all",))
    novel = next(view.name for view in scene.views if view.split == "test_novel")
    with drive_inputs(opened(scene), options) as inputs:
        assert inputs.moving.of == len(scene.views)
        found = next(view for view in inputs.views if view.name == novel)
    assert found.split == "test_novel"


def test_a_field_learns_without_them_and_remembers(scene, generated_drive) -> None:
    plain = street_field(scene, options=asked(generated_drive), field_options=QUICK)
    options = asked(generated_drive, moving_classes=("sky",))
    made = street_field(scene, options=options, field_options=QUICK)
    assert plain.moving is None
    assert "moving" not in plain.facts
    pixels = sum(v.camera.width * v.camera.height for v in made.views)
    assert plain.fit.radiance.rays == pixels
    assert made.fit.radiance.rays == pixels - round(made.moving.share * pixels)
    record = made.field.info.details["moving"]
    assert record == made.facts["moving"] == {
        "boxes": 0, "classes": ["sky"], "clock": "recorded",
        "masked_views": made.moving.views, "masked_share": round(made.moving.share, 6),
    }  # fmt: skip
    assert all(view.mask is None for view in made.views)
    assert all(view.mask is None for view in open_drive(scene.root).views)


def test_blocks_learn_without_them(generated_drive, tmp_path) -> None:
    """Boxes of the first block alone: the second is made all the same, and going on notices."""
    scene = open_drive(generated_drive, new_scene=tmp_path / "scene")
    view = scene.train_views[0]
    number = float(view.name[-4:])
    boxes = written([ahead(view, 6.0, start=number, end=number)], tmp_path)
    options = asked(
        generated_drive, moving=boxes, moving_clock="frames", moving_classes=("sky",),
        block_length=20.0, block_overlap=6.0,
    )  # fmt: skip
    observer = Stopping("field", after=2, error=KeyboardInterrupt)
    with pytest.raises(KeyboardInterrupt):
        make_street_field(scene, options=options, field_options=QUICK, observer=observer)
    write_moving([ahead(view, 9.0, start=number, end=number)], boxes)
    with pytest.raises(InputError, match=r"another \(boxes, masks(, scans)?\)"):
        make_street_field(scene, options=options, field_options=QUICK)
    write_moving([ahead(view, 6.0, start=number, end=number)], boxes)
    made = make_street_field(scene, options=options, field_options=QUICK)
    assert isinstance(made, StreetDrive)
    assert made.facts["moving"]["boxes"] == 1
    assert made.facts["moving"]["masked_views"] == len(scene.train_views)
    for index in range(2):
        info = made.field._field(index).info
        assert info.details["moving"] == made.facts["moving"]
        assert info.details["rays"] < 96 * 64 * len(info.views)


def test_depth_that_masks_leave_out_is_not_known(scene, tmp_path) -> None:
    view = scene.train_views[0]
    used = torch.ones(view.camera.height, view.camera.width, dtype=torch.uint8) * 255
    used[:, :48] = 0
    Image.fromarray(used.numpy()).save(tmp_path / "mask.png")
    masked = replace(view, mask=tmp_path / "mask.png")
    small = view.camera.resized(48, 32)
    depth = DepthView(camera=small, depth=torch.full((32, 48), 3.0))
    (found,) = masked_depths([masked], [depth])
    assert not bool(found.depth[:, :24].any())
    assert bool((found.depth[:, 24:] == 3).all())
    (same,) = masked_depths([view], [depth])
    assert torch.equal(same.depth, depth.depth)
    views = [masked, scene.train_views[1]]
    of = list(masked_depths_of(views, lambda one: [depth] if one.name == view.name else []))
    assert len(of) == 1
    assert torch.equal(of[0].depth, found.depth)
    with pytest.raises(ValueError, match="shorter"):
        list(masked_depths(views, [depth]))


def test_every_source_of_depth_is_masked(scene, generated_drive, tmp_path) -> None:
    """The capture's maps, evidence, scans and points, with the left half of the view left out."""
    view = scene.train_views[0]
    used = np.full((view.camera.height, view.camera.width), 255, np.uint8)
    used[:, :48] = 0
    Image.fromarray(used).save(tmp_path / "mask.png")
    steps = np.full((view.camera.height, view.camera.width), 3000, np.uint16)
    Image.fromarray(steps).save(tmp_path / "depth.png")
    mask, depth = tmp_path / "mask.png", tmp_path / "depth.png"
    masked = replace(view, mask=mask, depth=depth, depth_unit=0.001)
    (tmp_path / "evidence/depth_model").mkdir(parents=True)
    np.savez(
        tmp_path / f"evidence/depth_model/{view.name}.npz",
        depth=steps.astype(np.float16) / 1000, kind="metric",
    )  # fmt: skip
    rooted = replace(scene, root=tmp_path)
    scans = read_scans(generated_drive)
    cloud = torch.cat([scans.scan(name).points for name in scans.scan_names])
    for kind in ("maps", "depth_model", "scans", "points"):
        _, depths, _ = drive_sources(
            opened(rooted), [masked], depth=kind, scans=scans, points=cloud, cell=0.5
        )
        (found,) = depths()
        half = found.depth.shape[1] // 2
        assert not bool(found.depth[:, :half].any()), kind
        assert bool(found.depth[:, half:].any()), kind


def test_what_is_refused(scene, generated_drive, tmp_path) -> None:
    view = scene.train_views[0]
    (tmp_path / "broken.json").write_text('{"boxes": 3}')
    late = written([ahead(view, 5.0, start=1e6, end=1e6 + 1)], tmp_path)
    unknown = "^moving_classes: expected classes of .*road.*, got 'unicorn'"
    for values, kind, words in (
        ({"moving_classes": ("sky", "unicorn")}, InputError, unknown),
        ({"moving": late}, InputError, "is their clock another"),
        ({"moving": tmp_path / "none.json"}, MissingFileError, "none.json"),
        ({"moving": tmp_path / "broken.json"}, FileFormatError, "expected a list of boxes"),
        ({"moving_clock": "frames"}, InputError, "^moving_clock: expected boxes with it"),
        ({"moving_clock": "noon"}, (InputError, ShapeError), "^moving_clock: expected"),
    ):  # fmt: skip
        with pytest.raises(kind, match=words):
            make_street_field(scene, options=asked(generated_drive, **values), field_options=QUICK)
    assert not list((scene.root / "fields").glob("*"))
