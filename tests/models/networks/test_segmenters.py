"""MaskFormer, Mask2Former, OneFormer and EoMT: their own classes from tiny checkpoints."""

import itertools
import json
import shutil

import pytest
import torch
import torch.nn.functional as F

from splatseg.core.models import BatchedModel, PanopticSegments, SemanticLabels
from splatseg.errors import FileFormatError, InputError
from splatseg.models import LoadOptions, find_model
from splatseg.models._images import IMAGENET
from splatseg.models.networks.segmenters import SegmenterOptions, window_starts
from support.checkpoints_labels import save_tokenizer

KINDS = [("maskformer", "maskformer"), ("mask2former", "mask2former"), ("oneformer", "oneformer"),
         ("eomt", "eomt"), ("eomt", "eomt_dinov3")]  # fmt: skip
MANY = {"min_score": 0.2, "min_visible": 0.05, "mask_threshold": 0.3}
SIZE = 64


def made(folder, family: str, *, batch: int | None = None, size: int | None = SIZE, **options):
    if family == "oneformer":
        save_tokenizer(folder)
    loading = LoadOptions(weights=str(folder), batch=batch, size=size, device="cpu")
    return find_model(family, SegmenterOptions(**MANY | options), loading=loading)


def image(rng, height: int, width: int) -> torch.Tensor:
    coarse = torch.from_numpy(rng.uniform(0, 255, (1, 3, 5, 6))).float()
    smooth = F.interpolate(coarse, (height, width), mode="bilinear")[0]
    return smooth.permute(1, 2, 0).to(torch.uint8).contiguous()


def normalised(picture: torch.Tensor) -> torch.Tensor:
    mean, std = (torch.tensor(values).view(3, 1, 1) for values in IMAGENET)
    return ((picture.permute(2, 0, 1) / 255 - mean) / std)[None]


@pytest.mark.parametrize(("family", "kind"), KINDS)
def test_it_is_what_the_network_gives(checkpoints, rng, family: str, kind: str) -> None:
    """Of an image of the input's size nothing is resized; EoMT's is padded with black below."""
    model = made(checkpoints(kind), family)
    for protocol in (SemanticLabels, PanopticSegments, BatchedModel):
        assert isinstance(model, protocol)
    assert "no known table" in model.note
    picture = image(rng, 32, 64)
    found = model.label_map(picture)
    batch = normalised(picture)
    if family == "eomt":
        batch = normalised(F.pad(picture, (0, 0, 0, 0, 0, 32)))
    words = {}
    if family == "oneformer":  # the, task, is, semantic
        words["task_inputs"] = torch.tensor([[2, 3, 4, 6] + [0] * 73])
    with torch.inference_mode():
        output = model._network(batch, **words)
    masks = F.interpolate(output.masks_queries_logits, batch.shape[-2:], mode="bilinear")[0, :, :32]
    shares = output.class_queries_logits[0].softmax(-1)[:, :-1]
    scores = torch.einsum("qc,qhw->chw", shares, masks.sigmoid())
    best = scores.max(0)
    assert float((found.ids == best.indices + 1).float().mean()) > 0.995
    torch.testing.assert_close(found.confidence, best.values.clamp(0, 1), rtol=0, atol=1e-3)
    assert float(found.confidence.std()) > 1e-3
    names = [row.name for row in model.classes.rows]
    assert names == ["wall", "floor", "chair", "table", "lamp", "lamp, desk"]
    assert model.categories is model.classes


@pytest.mark.parametrize(("family", "kind"), KINDS)
def test_segments(checkpoints, rng, family: str, kind: str) -> None:
    model = made(checkpoints(kind), family)
    counts = []
    for _ in range(4):
        found = model.panoptic(image(rng, 40, 70))
        assert (found.ids.height, found.ids.width) == (40, 70)
        ids = sorted({int(i) for i in found.ids.ids.unique()} - {-1})
        assert ids == [segment.id for segment in found.segments]
        assert all(1 <= one.category <= 6 and one.isthing for one in found.segments)
        counts.append(len(ids))
    assert max(counts) > 1
    fewer = made(checkpoints(kind), family, min_score=1.0).panoptic(image(rng, 40, 70))
    assert fewer.segments == ()


def test_options_count(checkpoints, rng) -> None:
    picture = image(rng, 48, 64)
    plain = made(checkpoints("mask2former"), "mask2former")
    before = plain.label_map(picture)
    half = float(before.confidence.median())
    found = made(checkpoints("mask2former"), "mask2former", min_confidence=half).label_map(picture)
    assert torch.equal(found.ids == -1, before.confidence < half)
    for name, value in {"min_visible": 1.0, "mask_threshold": 0.99, "min_score": 0.99}.items():
        other = made(checkpoints("mask2former"), "mask2former", **{name: value})
        assert other.settings != plain.settings
        assert not torch.equal(other.panoptic(picture).ids.ids, plain.panoptic(picture).ids.ids)
    assert plain.default_settings["min_score"] == 0.8
    assert plain.default_settings | MANY == plain.settings


def test_the_sizes_of_the_weights_and_of_the_user(checkpoints, rng, monkeypatch, tmp_path) -> None:
    folder = tmp_path / "weights"
    shutil.copytree(checkpoints("mask2former"), folder)
    content = {"size": {"shortest_edge": 64, "longest_edge": 90}, "size_divisor": 32}
    (folder / "preprocessor_config.json").write_text(json.dumps(content))
    sizes = []
    for size in (None, 96):
        model = made(folder, "mask2former", size=size)
        run = model._network.forward
        monkeypatch.setattr(
            model._network, "forward",
            lambda x, run=run, **more: sizes.append(tuple(x.shape[-2:])) or run(x, **more),
        )  # fmt: skip
        model.label_map(image(rng, 60, 80))
        assert model.settings["size"] == (size or 0)
    assert sizes == [(64, 96), (64, 96)]
    bare = made(checkpoints("mask2former"), "mask2former", size=None)
    assert bare._frame(600, 800).inner_height == 800, "the published size"


def test_one_pass_serves_both_questions(checkpoints, rng, monkeypatch) -> None:
    pictures = [image(rng, 32, 64) for _ in range(2)]
    passes = {"mask2former": [2], "oneformer": [2, 2]}  # OneFormer is told its task
    for family, wanted in passes.items():
        model = made(checkpoints(family), family, batch=2)
        assert model.batch_size == 2
        alone = [model.panoptic(one) for one in pictures]
        calls: list[int] = []
        run = model._network.forward

        def counted(batch, calls=calls, run=run, **words):
            calls.append(len(batch))
            return run(batch, **words)

        monkeypatch.setattr(model._network, "forward", counted)
        model.encode(pictures)
        together = [model.panoptic(one) for one in pictures]
        for one in pictures:
            model.label_map(one)
        assert calls == wanted
        for one, other in zip(alone, together, strict=True):
            assert float((one.ids.ids == other.ids.ids).float().mean()) > 0.99


def test_oneformer_is_told_its_task(checkpoints, rng) -> None:
    """Label maps and segments come of different passes, and so of different queries."""
    model = made(checkpoints("oneformer"), "oneformer")
    assert {k: v[0, :4].tolist() for k, v in model._tokens.items()} == {
        "semantic": [2, 3, 4, 6], "panoptic": [2, 3, 4, 5],
    }  # fmt: skip
    assert all(tokens.shape == (1, 77) for tokens in model._tokens.values())
    assert not model._tokens["semantic"][0, 4:].any()
    picture = image(rng, 32, 64)
    semantic, panoptic = (model._of(task, picture) for task in ("semantic", "panoptic"))
    assert not torch.equal(semantic.classes, panoptic.classes)


def test_oneformer_without_its_tokenizer(checkpoints, tmp_path) -> None:
    folder = tmp_path / "weights"
    names = shutil.ignore_patterns("tokenizer*", "special*")
    shutil.copytree(checkpoints("oneformer"), folder, ignore=names)
    with pytest.raises(FileFormatError, match="expected a tokenizer beside the weights"):
        find_model("oneformer", loading=LoadOptions(weights=str(folder), device="cpu"))
    (folder / "tokenizer.json").write_text("{}")
    with pytest.raises(
        FileFormatError, match="expected the tokenizer of the weights, but it cannot be read"
    ):
        find_model("oneformer", loading=LoadOptions(weights=str(folder), device="cpu"))


def test_eomt_looks_through_windows_where_its_weights_say_so(
    checkpoints, rng, monkeypatch, tmp_path
) -> None:
    """Windows are averaged where they overlap, and each is what the network says of it alone."""
    folder = tmp_path / "weights"
    shutil.copytree(checkpoints("eomt"), folder)
    content = {"do_split_image": True, "size": {"shortest_edge": 64, "longest_edge": None}}
    (folder / "preprocessor_config.json").write_text(json.dumps(content))
    model = made(folder, "eomt")
    picture = image(rng, 100, 64)
    found = model.label_map(picture)
    parts = []
    for start in (0, 36):
        with torch.inference_mode():
            output = model._network(normalised(picture[start : start + 64]))
        masks = F.interpolate(output.masks_queries_logits, (64, 64), mode="bilinear")[0]
        shares = output.class_queries_logits[0].softmax(-1)[:, :-1]
        parts.append(torch.einsum("qc,qhw->chw", shares, masks.sigmoid()))
    total = torch.cat(
        (parts[0][:, :36], (parts[0][:, 36:] + parts[1][:, :28]) / 2, parts[1][:, 28:]), 1
    )
    torch.testing.assert_close(found.confidence, total.max(0).values.clamp(0, 1), rtol=0, atol=1e-4)
    assert float((found.ids == total.argmax(0) + 1).float().mean()) > 0.99
    wide = model.label_map(picture.transpose(0, 1).contiguous())
    assert (wide.height, wide.width) == (64, 100)
    assert float((found.ids == wide.ids.T).float().mean()) < 1, "the network is no symmetric one"
    plain = made(checkpoints("eomt"), "eomt").label_map(picture)
    assert not torch.equal(plain.confidence, found.confidence)
    assert model.panoptic(picture).ids.height == 100
    square = model.label_map(image(rng, 70, 70))
    assert (square.height, square.width) == (70, 70)


@pytest.mark.parametrize("length", [64, 65, 100, 128, 129, 700])
def test_windows_cover_all_of_an_axis(length: int) -> None:
    starts = window_starts(length, 64)
    assert starts[0] == 0
    assert starts[-1] + 64 == max(length, 64)
    gaps = [later - earlier for earlier, later in itertools.pairwise(starts)]
    assert all(0 < gap <= 64 for gap in gaps)
    assert len(starts) == -(-length // 64)


def test_what_is_refused(checkpoints, tmp_path) -> None:
    with pytest.raises(
        InputError, match=r"size: expected 64, the only one that eomt takes, got 96"
    ):
        made(checkpoints("eomt"), "eomt", size=96)
    with pytest.raises(FileFormatError, match=r"expected weights of mask2former, got those of"):
        made(checkpoints("maskformer"), "mask2former")
    folder = tmp_path / "weights"
    shutil.copytree(checkpoints("mask2former"), folder)
    (folder / "model.safetensors").write_bytes(b"nothing")
    with pytest.raises(FileFormatError, match="expected weights of Mask2FormerForUniversal"):
        made(folder, "mask2former")
