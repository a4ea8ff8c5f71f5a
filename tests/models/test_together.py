"""Several kinds of evidence of one model, and several images at once."""

from pathlib import Path
from typing import ClassVar

import pytest
import torch

from splatseg.core import FeatureMap, MaskSet
from splatseg.core.models import DeepFeatures
from splatseg.errors import InputError
from splatseg.io.evidence import open_evidence
from splatseg.io.images import load_image
from splatseg.models import EvidenceRequest, ModelCache, record_evidence
from splatseg.models._images import LastImages


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


def test_several_kinds_read_each_photograph_once(views, tmp_path) -> None:
    read: list[str] = []

    def image_of(view, _folder):
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

    def image_of(view, folder):
        given.append((view.name, folder))
        return load_image(view)

    record_evidence(model, views, tmp_path / "e", EvidenceRequest(what="masks", image_of=image_of))
    assert model.passes == [2, 1]
    assert given == [(name, tmp_path / "e") for name in ("v0", "v1", "v2")], "each once"


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


def test_what_is_cached_is_not_looked_at_again(views, tmp_path) -> None:
    cache = ModelCache(folder=tmp_path / "cache")
    record_evidence(
        Counting(), views[:1], tmp_path / "a", EvidenceRequest(what="features", cache=cache)
    )
    model = Counting()
    record_evidence(model, views, tmp_path / "b", EvidenceRequest(what="features", cache=cache))
    assert model.passes == [1, 1], "the second of the first two, then the third"
    model = Counting()
    record_evidence(model, views, tmp_path / "c", EvidenceRequest(what="features", cache=cache))
    assert model.passes == []


def test_kinds_that_cannot_be(views, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="expected different kinds, got masks, masks"):
        record_evidence(Counting(), views, tmp_path / "e", EvidenceRequest(what=["masks", "masks"]))
    with pytest.raises(InputError, match="got 'labels'"):
        record_evidence(
            Counting(), views, tmp_path / "e", EvidenceRequest(what=["masks", "labels"])
        )
    assert not (tmp_path / "e").exists()


def test_images_of_different_sizes_are_not_put_together(views, tmp_path, rng) -> None:
    from dataclasses import replace

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
