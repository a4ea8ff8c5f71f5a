"""Depth maps of models: written, gone on with, cached, copied."""

from typing import ClassVar

import numpy as np
import pytest
import torch
from PIL import Image as Picture

from splatseg.core import DepthMap
from splatseg.errors import FileFormatError, InputError, ShapeError
from splatseg.io.evidence import open_evidence, save_depth_map, save_label_map
from splatseg.models import EvidenceRequest, ModelCache, record_evidence, recorded_model
from splatseg.models.recorded import RecordedDepth


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


@pytest.mark.parametrize("sure", [True, False])
@pytest.mark.parametrize("precision", ["float16", "int8"])
def test_a_cache_keeps_it_as_evidence_does(tmp_path, rng, sure, precision) -> None:
    image = torch.from_numpy(rng.integers(0, 256, (9, 7, 3)).astype("uint8"))
    model = Near(sure=sure)
    cache = ModelCache(folder=tmp_path / "cache", precision=precision)
    first, second = (cache.ask("depth", model, image) for _ in range(2))
    assert model.asked == 1
    direct = Near(sure=sure).depth_map(image)
    for found in (first, second):
        assert found.kind == "relative"
        assert torch.equal(found.values, direct.values.half().float())
        assert (found.confidence is not None) == sure
    if sure:
        assert torch.equal(first.confidence, direct.confidence.half().float())


def test_recorded_maps_are_copied_at_their_own_size(views, tmp_path) -> None:
    """A network's half-size maps stay so: between a thing and its ground there is no depth."""
    (tmp_path / "there").mkdir()
    for i, view in enumerate(views):
        values = torch.full((24, 32), float(i))
        confidence = torch.full_like(values, 0.25)
        given = DepthMap(values=values, kind="metric", confidence=confidence)
        save_depth_map(given, tmp_path / "there", view.name)
    model = recorded_model(tmp_path / "there", views=views)
    assert isinstance(model, RecordedDepth)
    seen = record_evidence(model, views, tmp_path / "e", EvidenceRequest(what="depth"))
    assert seen.notes == ("1 views have no depth at all (v0).",)
    found = open_evidence(tmp_path / "e").depth_map("v2")
    assert (found.height, found.width, found.kind) == (24, 32, "metric")
    assert float(found.values.mean()) == 2
    assert float(found.confidence.mean()) == 0.25
    from splatseg.io.images import load_image

    assert model.depth_map(load_image(views[1])).values.unique().tolist() == [1]
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
