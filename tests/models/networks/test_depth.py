"""Depth Anything and DPT: what the library's own class gives, in metres or inverse."""

import shutil

import pytest
import torch

from splatseg.core.models import BatchedModel, DenseDepth
from splatseg.errors import FileFormatError, RangeError
from splatseg.models import LoadOptions, find_model
from splatseg.models._images import IMAGENET
from splatseg.models.networks.dense import _UNUSED_OF_DPT, DepthOptions

KINDS = [("depth-anything", "depth_anything", "relative"),
         ("depth-anything", "depth_anything_metric", "metric"),
         ("dpt", "dpt", "relative")]  # fmt: skip


def made(folder, family: str, *, batch: int | None = None, size: int | None = None, **options):
    loading = LoadOptions(weights=str(folder), batch=batch, size=size, device="cpu")
    return find_model(family, DepthOptions(**options), loading=loading)


def image(rng, height: int, width: int) -> torch.Tensor:
    return torch.from_numpy(rng.integers(0, 256, (height, width, 3)).astype("uint8"))


@pytest.mark.parametrize(("family", "kind", "tells"), KINDS)
def test_it_is_what_the_network_gives(checkpoints, rng, family, kind, tells) -> None:
    side = 64 if family == "dpt" else 84
    model = made(checkpoints(kind), family, size=side)
    assert isinstance(model, DenseDepth)
    assert isinstance(model, BatchedModel)
    assert ("metres" in model.note) == (tells == "metric")
    picture = image(rng, side if family == "dpt" else 56, side)
    found = model.depth_map(picture)
    assert found.kind == tells
    mean, std = ((0.5,) * 3, (0.5,) * 3) if family == "dpt" else IMAGENET
    mean, std = (torch.tensor(values).view(3, 1, 1) for values in (mean, std))
    with torch.inference_mode():
        batch = ((picture.permute(2, 0, 1) / 255 - mean) / std)[None]
        wanted = model._network(batch).predicted_depth
    assert tuple(wanted.shape[1:]) == (found.height, found.width)
    torch.testing.assert_close(found.values, wanted[0], rtol=1e-3, atol=1e-2)
    assert float(found.values.std()) > 0.01
    assert model.default_settings == model.settings


@pytest.mark.parametrize(("family", "kind", "tells"), KINDS)
def test_maps_have_the_image_s_own_pixels(checkpoints, rng, family, kind, tells) -> None:
    model = made(checkpoints(kind), family, size=70)
    picture = image(rng, 33, 61)
    found = model.depth_map(picture)
    assert (found.height, found.width) == (33, 61)
    frame = model._size.frame(33, 61, size=70)
    wanted = (64, 64) if family == "dpt" else (42, 70)  # 37.9 to whole patches of 14
    assert (frame.inner_height, frame.inner_width) == wanted


def test_the_published_size(checkpoints) -> None:
    small = made(checkpoints("depth_anything"), "depth-anything")._size.frame(480, 640)
    assert (small.inner_height, small.inner_width) == (518, 686)
    dpt = made(checkpoints("dpt"), "dpt")._size.frame(480, 640)
    assert (dpt.inner_height, dpt.inner_width) == (384, 384)


def test_depth_beyond_the_most_is_unknown(checkpoints, rng) -> None:
    picture = image(rng, 56, 56)
    kind = "depth_anything_metric"
    before = made(checkpoints(kind), "depth-anything", size=56).depth_map(picture).values
    most = float(before.median())
    model = made(checkpoints(kind), "depth-anything", size=56, max_depth=most)
    after = model.depth_map(picture).values
    assert torch.equal(after, torch.where(before > most, 0.0, before))
    assert model.settings["max_depth"] == most
    with pytest.raises(RangeError, match="max_depth: expected weights that tell metres"):
        made(checkpoints("dpt"), "dpt", max_depth=3.0)
    with pytest.raises(RangeError, match="max_depth: expected more than 0"):
        DepthOptions(max_depth=0)


def test_images_together_are_as_one_by_one(checkpoints, rng) -> None:
    model = made(checkpoints("depth_anything"), "depth-anything", batch=3, size=56)
    pictures = [image(rng, 40, 50) for _ in range(3)]
    alone = [model.depth_map(one).values for one in pictures]
    model.encode(pictures)
    for one, picture in zip(alone, pictures, strict=True):
        torch.testing.assert_close(model.depth_map(picture).values, one, rtol=1e-4, atol=1e-3)


def test_published_weights_may_lack_what_nothing_needs(checkpoints, rng, tmp_path) -> None:
    from safetensors.torch import load_file, save_file

    folder = tmp_path / "weights"
    shutil.copytree(checkpoints("dpt"), folder)
    weights = load_file(folder / "model.safetensors")
    kept = {k: v for k, v in weights.items() if not k.startswith(_UNUSED_OF_DPT)}
    assert len(kept) < len(weights)
    save_file(kept, folder / "model.safetensors", metadata={"format": "pt"})
    picture = image(rng, 64, 64)
    one, other = (made(where, "dpt", size=64).depth_map(picture).values
                  for where in (checkpoints("dpt"), folder))  # fmt: skip
    assert torch.equal(one, other)
    del kept["head.head.0.weight"]
    save_file(kept, folder / "model.safetensors", metadata={"format": "pt"})
    with pytest.raises(FileFormatError, match=r"1 of its tensors \(head.head.0.weight\)"):
        made(folder, "dpt", size=64)
    with pytest.raises(FileFormatError, match="expected weights of dpt, got those of"):
        made(checkpoints("depth_anything"), "dpt")
