"""Evidence written: several kinds of one model, several images at once, depth."""

import threading
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
import torch
from PIL import Image as Picture

from splatseg.core import DepthMap, FeatureMap, MaskSet
from splatseg.core.models import DeepFeatures
from splatseg.errors import FileFormatError, InputError, ShapeError
from splatseg.io.evidence import open_evidence, save_depth_map, save_label_map
from splatseg.io.images import load_image
from splatseg.models import EvidenceRequest, record_evidence, recorded_model
from splatseg.models._images import LastImages
from splatseg.render.cpu import set_threads


class Counting:
    """A network in small: both answers come from one pass over each image."""

    name, note, batch_size = "counting", "", 2
    settings: ClassVar[dict[str, int]] = {}

    def __init__(self) -> None:
        self.passes: list[int] = []
        self._last = LastImages(self._run)

    def _run(self, images):
        self.passes.append(len(images))
        return [image.float().mean(dim=2) for image in images]

    def encode(self, images) -> None:
        self._last.encode(images)

    def masks(self, image) -> MaskSet:
        return MaskSet.from_dense((self._last.of(image) > 100)[None])

    def features(self, image) -> DeepFeatures:
        values = self._last.of(image)[..., None]
        height, width = values.shape[:2]
        one = FeatureMap(features=values, stride=1, height=height, width=width)
        return DeepFeatures(maps=(one,), depths=("grey",))


class Concurrent:
    """Masks that are found in one thread an image; each call waits for another one."""

    name, note, concurrent = "concurrent", "", True
    settings: ClassVar[dict[str, int]] = {}

    def __init__(self, together: int = 1) -> None:
        self.calls = 0
        self._barrier = threading.Barrier(together)

    def masks(self, image) -> MaskSet:
        self.calls += 1
        self._barrier.wait(timeout=10)
        return MaskSet.from_dense((image.float().mean(dim=2) > 100)[None])

    def features(self, image) -> DeepFeatures:
        return Counting().features(image)


def test_masks_of_several_views_are_found_at_once(views, tmp_path, same_threads_afterwards) -> None:
    folders = []
    for count in (1, 2):
        set_threads(count)
        folders.append(tmp_path / str(count))
        record_evidence(Concurrent(count), views[:2], folders[-1], EvidenceRequest(what="masks"))
    for name in ("v0", "v1"):
        one, other = (open_evidence(folder).masks(name) for folder in folders)
        assert torch.equal(one.dense(0), other.dense(0))
        expected = load_image(next(v for v in views if v.name == name)).float().mean(dim=2) > 100
        assert torch.equal(one.dense(0), expected)


def test_masks_that_are_there_are_not_found_again(views, tmp_path) -> None:
    model = Concurrent()
    record_evidence(model, views, tmp_path / "e", EvidenceRequest(what="masks"))
    record_evidence(model, views, tmp_path / "e", EvidenceRequest(what=["masks", "features"]))
    assert model.calls == 3


def test_several_kinds_read_each_photograph_once(views, tmp_path) -> None:
    read: list[str] = []

    def image_of(view):
        read.append(view.name)
        return load_image(view)

    record_evidence(
        Counting(),
        views,
        tmp_path / "e",
        EvidenceRequest(what=["masks", "features"], image_of=image_of),
    )
    assert read == ["v0", "v1", "v2"]


def test_several_kinds_cost_one_pass_an_image(views, tmp_path) -> None:
    model = Counting()
    seen = record_evidence(
        model, views, tmp_path / "e", EvidenceRequest(what=["masks", "features"])
    )
    assert model.passes == [2, 1], "two views together, then the third"
    (further,) = seen.further
    assert (seen.kind, seen.folder, seen.masks) == ("masks", tmp_path / "e", 3)
    assert (further.kind, further.folder) == ("features", tmp_path / "e.features")
    for folder, kind in ((seen.folder, "masks"), (further.folder, "features")):
        evidence = open_evidence(folder)
        assert (evidence.kind, len(evidence.view_names)) == (kind, 3)
    alone = record_evidence(Counting(), views, tmp_path / "f", EvidenceRequest(what="features"))
    for name in ("v0", "v1", "v2"):
        one, other = (open_evidence(f).features(name) for f in (alone.folder, further.folder))
        assert torch.equal(one.features, other.features)


def test_pictures_that_are_given_go_together_too(views, tmp_path) -> None:
    """`see` gives them: photographs, and renders of views that have none."""
    model, given = Counting(), []

    def image_of(view):
        given.append(view.name)
        return load_image(view)

    record_evidence(model, views, tmp_path / "e", EvidenceRequest(what="masks", image_of=image_of))
    assert model.passes == [2, 1]
    assert given == ["v0", "v1", "v2"], "each once"


def test_what_is_done_of_each_kind_stays(views, tmp_path) -> None:
    record_evidence(Counting(), views, tmp_path / "e", EvidenceRequest(what="masks"))
    before = (tmp_path / "e" / "v1.json").stat().st_mtime_ns
    seen = record_evidence(
        Counting(), views, tmp_path / "e", EvidenceRequest(what=["masks", "features"])
    )
    assert (seen.kept, seen.further[0].kept) == (3, 0)
    assert (tmp_path / "e" / "v1.json").stat().st_mtime_ns == before
    assert len(open_evidence(tmp_path / "e.features").view_names) == 3


def test_one_that_fails_leaves_whole_views_of_both(views, tmp_path) -> None:
    class Failing(Counting):
        def features(self, image):
            if len(self.passes) > 1:
                raise InputError("image: too dark.")
            return super().features(image)

    with pytest.raises(InputError, match="too dark"):
        record_evidence(
            Failing(), views, tmp_path / "e", EvidenceRequest(what=["masks", "features"])
        )
    done = [open_evidence(tmp_path / name, unfinished="allow") for name in ("e", "e.features")]
    assert [evidence.view_names for evidence in done] == [("v0", "v1", "v2"), ("v0", "v1")]
    model = Counting()
    seen = record_evidence(
        model, views, tmp_path / "e", EvidenceRequest(what=["masks", "features"])
    )
    assert model.passes == [1]
    assert (seen.kept, seen.further[0].kept) == (3, 2)


def test_kinds_that_cannot_be(views, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="expected different kinds, got masks, masks"):
        record_evidence(Counting(), views, tmp_path / "e", EvidenceRequest(what=["masks", "masks"]))
    with pytest.raises(InputError, match="got 'labels'"):
        record_evidence(
            Counting(), views, tmp_path / "e", EvidenceRequest(what=["masks", "labels"])
        )
    assert not (tmp_path / "e").exists()


def test_images_of_different_sizes_are_not_put_together(views, tmp_path, rng) -> None:
    from PIL import Image

    camera = views[0].camera
    small = replace(camera, width=camera.width // 2)
    Image.new("RGB", (small.width, small.height), (200, 0, 200)).save(tmp_path / "small.png")
    other = replace(views[1], camera=small, image=tmp_path / "small.png")
    model = Counting()
    record_evidence(
        model, [views[0], other, views[2]], tmp_path / "e", EvidenceRequest(what="masks")
    )
    assert model.passes == [1, 1, 1]


# Depth maps of models: written, gone on with, copied.


class Near:
    """Bright is near."""

    name, note = "near", ""
    settings: ClassVar[dict[str, int]] = {}

    def __init__(self, *, sure: bool = False) -> None:
        self.asked = 0
        self._sure = sure

    def depth_map(self, image) -> DepthMap:
        self.asked += 1
        values = image.float().mean(dim=2) / 7
        sure = torch.full_like(values, 0.3) if self._sure else None
        return DepthMap(values=values, kind="relative", confidence=sure)


def test_it_is_written_and_gone_on_with(views, tmp_path) -> None:
    model = Near()
    seen = record_evidence(model, views[:2], tmp_path / "e")
    assert (seen.kind, seen.views, seen.masks) == ("depth", 2, None)
    (tmp_path / "e" / "v1.npz").write_bytes(b"half")
    record_evidence(model, views, tmp_path / "e", EvidenceRequest(what="depth"))
    assert model.asked == 4, "the damaged and the new view"
    evidence = open_evidence(tmp_path / "e")
    assert evidence.view_names == ("v0", "v1", "v2")
    found = evidence.depth_map("v1")
    assert found.kind == "relative"
    assert (found.height, found.width) == (48, 64)


def test_a_map_of_another_size_is_refused(views, tmp_path) -> None:
    class Small(Near):
        def depth_map(self, image) -> DepthMap:
            return DepthMap(values=torch.ones(4, 4), kind="metric")

    with pytest.raises(ShapeError, match="view 'v0': expected 64x48 pixels as the photograph has"):
        record_evidence(Small(), views, tmp_path / "e")


def test_recorded_maps_are_copied_at_their_own_size(views, tmp_path) -> None:
    """A network's half-size maps stay so: between a thing and its ground there is no depth."""
    (tmp_path / "there").mkdir()
    for i, view in enumerate(views):
        values = torch.full((24, 32), float(i))
        confidence = torch.full_like(values, 0.25)
        given = DepthMap(values=values, kind="metric", confidence=confidence)
        save_depth_map(given, tmp_path / "there", view.name)
    model = recorded_model(tmp_path / "there", views=views)
    assert model.evidence.kind == "depth"
    seen = record_evidence(model, views, tmp_path / "e", EvidenceRequest(what="depth"))
    assert seen.notes == ("1 views have no depth at all (v0).",)
    found = open_evidence(tmp_path / "e").depth_map("v2")
    assert (found.height, found.width, found.kind) == (24, 32, "metric")
    assert float(found.values.mean()) == 2
    assert float(found.confidence.mean()) == 0.25
    with pytest.raises(InputError, match="expected evidence of masks, got depth"):
        record_evidence(model, views, tmp_path / "f", EvidenceRequest(what="masks"))


def test_pictures_of_others_with_and_without_a_unit(views, tmp_path) -> None:
    (tmp_path / "there").mkdir()
    for view in views:
        Picture.fromarray(np.full((48, 64), 1500, np.uint16)).save(
            tmp_path / "there" / f"{view.name}.png"
        )
    for unit, kind, value in ((0.001, "metric", 1.5), (None, "relative", 1500.0)):
        model = recorded_model(tmp_path / "there", kind="depth", depth_unit=unit)
        assert model.settings.get("depth_unit") == unit
        record_evidence(model, views, tmp_path / kind)
        found = open_evidence(tmp_path / kind).depth_map("v0")
        assert found.kind == kind
        assert float(found.values.mean()) == pytest.approx(value)


def test_what_is_refused(views, tmp_path) -> None:
    (tmp_path / "there").mkdir()
    for view in views:
        given = DepthMap(values=torch.ones(30, 30), kind="metric")
        save_depth_map(given, tmp_path / "there", view.name)
    model = recorded_model(tmp_path / "there")
    with pytest.raises(FileFormatError, match="view 'v0': expected 64x48 pixels as the photograph"):
        record_evidence(model, views, tmp_path / "e")
    assert not (tmp_path / "e").exists()
    (tmp_path / "labels").mkdir()
    from splatseg.core import LabelMap

    save_label_map(LabelMap(ids=torch.ones(48, 64)), tmp_path / "labels", "v0")
    with pytest.raises(InputError, match="expected evidence of depth, got labels"):
        record_evidence(
            recorded_model(tmp_path / "labels"),
            views[:1],
            tmp_path / "g",
            EvidenceRequest(what="depth"),
        )


def test_renders_of_views_without_photographs_are_kept_beside_each_kind(views, tmp_path) -> None:
    """Each is drawn once; the views that have a photograph need none."""
    drawn: list[str] = []

    def image_of(view):
        drawn.append(view.name)
        return load_image(next(one for one in views if one.name == view.name))

    virtual = [replace(views[0], image=None), views[1], replace(views[2], image=None)]
    request = EvidenceRequest(what=["masks", "features"], image_of=image_of)
    seen = record_evidence(Counting(), virtual, tmp_path / "e", request)
    assert seen.drawn == 2
    assert drawn == ["v0", "v1", "v2"]
    for folder in (seen.folder, seen.further[0].folder):
        evidence = open_evidence(folder)
        assert [evidence.render(name) is None for name in ("v0", "v1", "v2")] == [
            False, True, False,
        ]  # fmt: skip
        with Picture.open(evidence.render("v0")) as kept:
            assert np.array_equal(np.array(kept), load_image(views[0]).numpy())
