"""Evidence of features holds every depth that a model gives, and its class token."""

import json
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
import torch

from splatseg.core import FeatureMap
from splatseg.core.models import DeepFeatures
from splatseg.errors import InputError, ShapeError
from splatseg.io.evidence import FeatureEvidence, open_evidence
from splatseg.models import EvidenceRequest, ModelCache, find_model, record_evidence


class Pyramid:
    """Two depths, the shallower on finer cells, and the image's mean as the class token."""

    name, note = "pyramid", ""
    settings: ClassVar[dict[str, int]] = {}

    def __init__(self, *, shallow_width: int | None = None) -> None:
        self.calls = 0
        self._shallow_width = shallow_width

    def features(self, image) -> DeepFeatures:
        self.calls += 1
        height, width = (int(side) for side in image.shape[:2])
        values = image.float() / 256
        shallow = FeatureMap(
            features=values[::2, ::2], stride=2, height=height,
            width=self._shallow_width or width,
        )  # fmt: skip
        deep = FeatureMap(features=values[::8, ::8, :1], stride=8, height=height, width=width)
        token = values.mean(dim=(0, 1)) * 8
        return DeepFeatures(maps=(shallow, deep), depths=("block1", "block2"), class_token=token)


def check(evidence, views, model) -> None:
    """The evidence holds what the model gives, but for float16."""
    assert isinstance(evidence, FeatureEvidence)
    assert evidence.blocks == ("block1", "block2")
    from splatseg.io.images import load_image

    for view in views:
        wanted = model.features(load_image(view))
        for block, one in zip(wanted.depths, wanted.maps, strict=True):
            found = evidence.block_features(view.name, block)
            assert found.stride == one.stride
            assert torch.equal(found.features, one.features.half().float())
        deepest = evidence.features(view.name)
        assert deepest.channels == 1
        token = evidence.class_token(view.name)
        assert torch.equal(token, wanted.class_token.half().float())


def test_see_writes_all_depths_and_the_class_token(views, tmp_path) -> None:
    model = Pyramid()
    seen = record_evidence(model, views, tmp_path / "e")
    assert seen.kind == "features"
    check(open_evidence(tmp_path / "e"), views, model)


def test_the_cache_holds_them_too(views, tmp_path) -> None:
    model = Pyramid()
    cache = ModelCache(folder=tmp_path / "cache")
    record_evidence(model, views, tmp_path / "a", EvidenceRequest(cache=cache))
    record_evidence(model, views, tmp_path / "b", EvidenceRequest(cache=cache))
    assert model.calls == len(views)
    for view in views:
        first, second = (tmp_path / name / f"{view.name}.npz" for name in "ab")
        assert first.read_bytes() == second.read_bytes()
    check(open_evidence(tmp_path / "b"), views, model)


def test_recorded_evidence_is_a_model_of_all_depths(views, tmp_path) -> None:
    record_evidence(Pyramid(), views, tmp_path / "e")
    recorded = find_model(tmp_path / "e")
    deep = recorded.features(torch.zeros(48, 64, 3, dtype=torch.uint8), view="v0")
    assert deep.depths == ("block1", "block2")
    assert deep.class_token.shape == (3,)
    record_evidence(recorded, views, tmp_path / "copy")
    for view in views:
        first, second = (tmp_path / name / f"{view.name}.npz" for name in ("e", "copy"))
        assert first.read_bytes() == second.read_bytes()


def test_every_depth_must_be_of_the_photograph(views, tmp_path) -> None:
    with pytest.raises(ShapeError, match="view 'v0': expected 64x48 pixels .*, got 63x48"):
        record_evidence(Pyramid(shallow_width=63), views, tmp_path / "e")


def begun_by_an_earlier_one(folder: Path, *, complete: bool) -> None:
    """Evidence of two views as version 1 wrote it."""
    header = json.loads((folder / "evidence.json").read_text())
    header["version"] = 1
    header["metadata"]["complete"] = complete
    (folder / "evidence.json").write_text(json.dumps(header))
    for path in folder.glob("*.npz"):
        with np.load(path) as archive:
            old = {name: archive[name] for name in ("features", "stride", "size")}
        np.savez(path, **old)


def test_evidence_of_one_depth_is_read_and_not_mixed_with_others(views, tmp_path) -> None:
    folder = tmp_path / "e"
    record_evidence(Pyramid(), views, folder)
    begun_by_an_earlier_one(folder, complete=True)
    old = open_evidence(folder)
    assert old.blocks == ()
    assert old.class_token("v0") is None
    assert old.features("v0").channels == 1
    assert record_evidence(Pyramid(), views, folder).kept == 3, "it is complete"
    begun_by_an_earlier_one(folder, complete=False)
    (folder / "v2.npz").unlink()
    with pytest.raises(InputError, match="an earlier splatseg began this evidence"):
        record_evidence(Pyramid(), views, folder)
    assert record_evidence(Pyramid(), views, folder, EvidenceRequest(overwrite=True)).kept == 0
    check(open_evidence(folder), views, Pyramid())


def test_a_view_with_a_broken_depth_is_done_again(views, tmp_path) -> None:
    folder = tmp_path / "e"
    record_evidence(Pyramid(), views, folder)
    with np.load(folder / "v1.npz") as archive:
        cut = {name: archive[name] for name in archive.files if name != "features_0"}
    np.savez(folder / "v1.npz", **cut)
    assert record_evidence(Pyramid(), views, folder).kept == 2
    check(open_evidence(folder), views, Pyramid())
