"""DINO in its four kinds: what the library's own class gives, patch by patch."""

import pytest
import torch

from splatseg.core.models import BatchedModel, DenseFeatures
from splatseg.errors import BackendError, FileFormatError, InputError, RangeError
from splatseg.models import LoadOptions, find_model
from splatseg.models._images import IMAGENET
from splatseg.models.networks.dense import DinoOptions

KINDS = [("dino", "dino"), ("dinov2", "dinov2"), ("dinov2", "dinov2_with_registers"),
         ("dinov3", "dinov3")]  # fmt: skip


def image(rng, height: int, width: int) -> torch.Tensor:
    return torch.from_numpy(rng.integers(0, 256, (height, width, 3)).astype("uint8"))


def made(checkpoints, family: str, kind: str, *, size: int, batch: int | None = None, **options):
    loading = LoadOptions(weights=str(checkpoints(kind)), size=size, batch=batch, device="cpu")
    return find_model(family, DinoOptions(**options), loading=loading)


@pytest.mark.parametrize(("family", "kind"), KINDS)
def test_it_is_what_the_network_gives(checkpoints, rng, family: str, kind: str) -> None:
    """Of an image whose cells are the patches nothing is resized, so the network's own output."""
    model = made(checkpoints, family, kind, size=0 + 5 * _patch(family))
    assert isinstance(model, DenseFeatures)
    patch = _patch(family)
    picture = image(rng, 3 * patch, 5 * patch)
    found = model.features(picture)
    assert found.depths == ("block1", "block2", "block3", "block4")
    last = found.maps[-1]
    assert (last.stride, last.height, last.width) == (patch, 3 * patch, 5 * patch)
    mean, std = (torch.tensor(values).view(3, 1, 1) for values in IMAGENET)
    batch = ((picture.permute(2, 0, 1) / 255 - mean) / std)[None]
    more = {"interpolate_pos_encoding": True} if family == "dino" else {}
    with torch.inference_mode():
        wanted = model._network(batch, **more).last_hidden_state[0]
    skip = 5 if kind in ("dinov2_with_registers", "dinov3") else 1
    torch.testing.assert_close(last.features.reshape(15, -1), wanted[skip:], rtol=0, atol=2e-5)
    torch.testing.assert_close(found.class_token, wanted[0], rtol=0, atol=2e-5)
    spread = [float(one.features.std(dim=(0, 1)).mean()) for one in found.maps]
    assert min(spread) > 0.01, "patches differ at each depth"
    assert not torch.equal(found.maps[0].features, found.maps[1].features)


def _patch(family: str) -> int:
    return 14 if family == "dinov2" else 16


def test_cells_lie_on_whole_pixels_of_images_of_any_size(checkpoints, rng) -> None:
    model = made(checkpoints, "dinov2", "dinov2", size=84)
    found = model.features(image(rng, 33, 61)).maps[-1]
    assert found.stride == 10  # 14 * 61 / 84
    assert tuple(found.features.shape[:2]) == (4, 7)
    assert (found.height, found.width) == (33, 61)


def test_a_change_in_the_image_is_felt_most_in_its_cell(checkpoints, rng) -> None:
    model = made(checkpoints, "dinov2", "dinov2", size=140, depths=4)
    picture = image(rng, 140, 140) // 8 + 100
    other = picture.clone()
    other[42:56, 98:112] = 255  # row 3, column 7
    before, after = (model.features(one).maps[0].features for one in (picture, other))
    change = (after - before).norm(dim=2)
    assert divmod(int(change.argmax()), 10) == (3, 7)


def test_depths_and_normalisation(checkpoints, rng) -> None:
    picture = image(rng, 40, 40)
    one = made(checkpoints, "dinov2", "dinov2", size=56, depths=1).features(picture)
    two = made(checkpoints, "dinov2", "dinov2", size=56, depths=2).features(picture)
    assert (one.depths, two.depths) == (("block4",), ("block2", "block4"))
    assert torch.equal(one.maps[-1].features, two.maps[-1].features)
    deviation = one.maps[-1].features.std(dim=2, correction=0)
    torch.testing.assert_close(deviation, torch.ones_like(deviation), rtol=0, atol=1e-3)
    with pytest.raises(RangeError, match=r"depths: expected at most the 4 blocks of dinov2, got 5"):
        made(checkpoints, "dinov2", "dinov2", size=56, depths=5)
    with pytest.raises(RangeError, match="depths"):
        DinoOptions(depths=0)
    with pytest.raises(InputError, match="normalise: this option was removed; features always"):
        DinoOptions(normalise=False)


def test_images_together_are_as_one_by_one(checkpoints, rng, monkeypatch) -> None:
    model = made(checkpoints, "dinov3", "dinov3", size=64, batch=3)
    assert isinstance(model, BatchedModel)
    assert model.batch_size == 3
    pictures = [image(rng, 40, 50) for _ in range(3)]
    alone = [model.features(one).maps[-1].features for one in pictures]
    calls: list[int] = []
    run = model._last._run

    def counted(images):
        calls.append(len(images))
        return run(images)

    monkeypatch.setattr(model._last, "_run", counted)
    model.encode(pictures)
    together = [model.features(one).maps[-1].features for one in pictures]
    assert calls == [3], "asking costs no further pass"
    for one, other in zip(alone, together, strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=1e-5)


def test_what_does_not_fit_memory_goes_in_halves(checkpoints, rng, monkeypatch) -> None:
    model = made(checkpoints, "dinov2", "dinov2", size=56, batch=4)
    run, calls = model._last._run, []

    def small(images):
        calls.append(len(images))
        if len(images) > most:
            raise torch.OutOfMemoryError("CUDA out of memory")
        return run(images)

    monkeypatch.setattr(model._last, "_run", small)
    pictures = [image(rng, 28, 28) for _ in range(4)]
    most = 1
    model.encode(pictures)
    assert calls == [4, 2, 1, 1, 2, 1, 1]
    most = 0
    with pytest.raises(BackendError, match="not enough memory for an image of 20x28; --size"):
        model.features(image(rng, 28, 20))


def test_settings_tell_answers_apart(checkpoints, rng) -> None:
    model = made(checkpoints, "dinov2", "dinov2", size=56)
    assert model.settings == made(checkpoints, "dinov2", "dinov2", size=56, batch=9).settings
    others = [
        made(checkpoints, "dinov2", "dinov2", size=70),
        made(checkpoints, "dinov2", "dinov2", size=56, depths=2),
        made(checkpoints, "dinov2", "dinov2_with_registers", size=56),
    ]
    assert all(other.settings != model.settings for other in others)
    half = find_model(
        "dinov2",
        loading=LoadOptions(weights=str(checkpoints("dinov2")), size=56, dtype="bfloat16"),
    )
    assert half.settings != model.settings
    picture = image(rng, 56, 56)
    exact, rounded = (m.features(picture).maps[-1].features for m in (model, half))
    assert rounded.dtype == torch.float32
    assert 0 < float((exact - rounded).abs().max()) < 0.5


def test_the_weights_of_another_network_are_refused(checkpoints) -> None:
    with pytest.raises(FileFormatError, match=r"config.json: expected weights of vit, got those"):
        made(checkpoints, "dino", "dinov2", size=56)
