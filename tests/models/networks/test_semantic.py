"""SegFormer and DPT's semantic head: what the library's own class gives."""

import json
import shutil

import pytest
import torch
import torch.nn.functional as F

from splatseg.core.models import BatchedModel, PanopticSegments, SemanticLabels
from splatseg.errors import FileFormatError
from splatseg.models import LoadOptions, find_model
from splatseg.models._images import IMAGENET
from splatseg.models.networks.segmenters import SemanticOptions

KINDS = [("segformer", "segformer"), ("dpt-semantic", "dpt_semantic")]


def made(folder, family: str, *, batch: int | None = None, size: int | None = 64, **options):
    loading = LoadOptions(weights=str(folder), batch=batch, size=size, device="cpu")
    return find_model(family, SemanticOptions(**options), loading=loading)


def image(rng, height: int, width: int) -> torch.Tensor:
    return torch.from_numpy(rng.integers(0, 256, (height, width, 3)).astype("uint8"))


@pytest.mark.parametrize(("family", "kind"), KINDS)
def test_it_is_what_the_network_gives(checkpoints, rng, family: str, kind: str) -> None:
    model = made(checkpoints(kind), family)
    assert isinstance(model, SemanticLabels)
    assert isinstance(model, BatchedModel)
    assert not isinstance(model, PanopticSegments)
    assert "all taken for stuff" in model.note
    picture = image(rng, 64, 64)
    found = model.label_map(picture)
    mean, std = IMAGENET if family == "segformer" else ((0.5,) * 3, (0.5,) * 3)
    mean, std = (torch.tensor(values).view(3, 1, 1) for values in (mean, std))
    with torch.inference_mode():
        logits = model._network(((picture.permute(2, 0, 1) / 255 - mean) / std)[None]).logits
    best = F.interpolate(logits, (64, 64), mode="bilinear")[0].softmax(0).max(0)
    assert float((found.ids == best.indices + 1).float().mean()) > 0.99
    torch.testing.assert_close(found.confidence, best.values, rtol=0, atol=1e-4)
    assert len(found.ids.unique()) > 1
    assert [row.id for row in model.classes.rows] == [1, 2, 3, 4, 5, 6]


def test_proportions_are_kept_where_the_network_can(checkpoints, rng, monkeypatch) -> None:
    sizes = []
    for family, kind in KINDS:
        model = made(checkpoints(kind), family, size=96)
        run = model._network.forward
        monkeypatch.setattr(
            model._network, "forward",
            lambda x, run=run, **more: sizes.append(tuple(x.shape[-2:])) or run(x, **more),
        )  # fmt: skip
        found = model.label_map(image(rng, 40, 80))
        assert (found.height, found.width) == (40, 80)
    assert sizes == [(48, 96), (96, 96)], "DPT without a backbone takes squares"


def test_what_is_not_sure_is_none(checkpoints, rng) -> None:
    picture = image(rng, 64, 64)
    before = made(checkpoints("segformer"), "segformer").label_map(picture)
    half = float(before.confidence.median())
    model = made(checkpoints("segformer"), "segformer", min_confidence=half)
    assert torch.equal(model.label_map(picture).ids == -1, before.confidence < half)
    assert model.settings["min_confidence"] == half
    assert model.default_settings["min_confidence"] == 0


def test_a_background_is_none(checkpoints, rng, tmp_path) -> None:
    folder = tmp_path / "weights"
    shutil.copytree(checkpoints("segformer"), folder)
    config = json.loads((folder / "config.json").read_text())
    config["id2label"]["0"] = "background"
    (folder / "config.json").write_text(json.dumps(config))
    picture = image(rng, 64, 64) // 4
    before = made(checkpoints("segformer"), "segformer").label_map(picture).ids
    after = made(folder, "segformer").label_map(picture).ids
    assert bool((before == 1).any())
    assert torch.equal(after, torch.where(before == 1, -1, before))


def test_images_together_are_as_one_by_one(checkpoints, rng) -> None:
    model = made(checkpoints("segformer"), "segformer", batch=3)
    pictures = [image(rng, 40, 50) for _ in range(3)]
    alone = [model.label_map(one).ids for one in pictures]
    model.encode(pictures)
    together = [model.label_map(one).ids for one in pictures]
    assert all(float((a == b).float().mean()) > 0.999 for a, b in zip(alone, together, strict=True))


def test_weights_of_the_other_head_are_refused(checkpoints) -> None:
    with pytest.raises(FileFormatError, match="expected weights of DPTForSemantic"):
        made(checkpoints("dpt"), "dpt-semantic")
    with pytest.raises(FileFormatError, match="expected weights of segformer, got those of 'dpt'"):
        made(checkpoints("dpt"), "segformer")
