"""SAM, SAM-HQ and SAM 2: their own classes from tiny checkpoints, held to direct calls."""

import shutil

import pytest
import torch
import torch.nn.functional as F

from splatseg.core.models import AutomaticMasks, DenseFeatures, Prompt, PromptableMasks
from splatseg.errors import FileFormatError, InputError, RangeError
from splatseg.models import LoadOptions, _mask_generator, find_model
from splatseg.models._images import IMAGENET
from splatseg.models.networks.sam import SamOptions

KINDS = [("sam", "sam"), ("sam-hq", "sam_hq"), ("sam2", "sam2"), ("sam3", "sam3_tracker")]
SIDES = {"sam2": 64, "sam3": 112}
"""Of the square that images are stretched to; the others pad them."""

ALL = {"points_per_side": 4, "min_iou": 0.0, "min_stability": 0.0, "max_overlap": 1.0}


def made(checkpoints, family: str, kind: str, *, batch: int | None = None, **options):
    loading = LoadOptions(weights=str(checkpoints(kind)), batch=batch, device="cpu")
    return find_model(family, SamOptions(**ALL | options), loading=loading)


def image(rng, height: int, width: int) -> torch.Tensor:
    return torch.from_numpy(rng.integers(0, 256, (height, width, 3)).astype("uint8"))


def pixel_values(picture: torch.Tensor, family: str) -> torch.Tensor:
    """What the papers' processors make of a picture of 64 x 32: padded, or stretched."""
    colours = ((0.5,) * 3, (0.5,) * 3) if family == "sam3" else IMAGENET
    mean, std = (torch.tensor(values).view(3, 1, 1) for values in colours)
    batch = picture.permute(2, 0, 1)[None].float()
    if family in SIDES:
        size = (SIDES[family],) * 2
        batch = F.interpolate(batch, size, mode="bilinear", antialias=True).round()
        return (batch / 255 - mean) / std
    return F.pad((batch / 255 - mean) / std, (0, 0, 0, 64 - picture.shape[0]))


@pytest.mark.parametrize(("family", "kind"), KINDS)
def test_prompts_are_answered_as_the_network_does(checkpoints, rng, family, kind) -> None:
    model = made(checkpoints, family, kind)
    for protocol in (AutomaticMasks, DenseFeatures, PromptableMasks):
        assert isinstance(model, protocol)
    picture = image(rng, 32, 64)
    found = model.prompted_masks(model.embed(picture), Prompt(points=torch.tensor([[40.0, 10.0]])))
    across, down = (SIDES[family] / 64, SIDES[family] / 32) if family in SIDES else (1.0, 1.0)
    with torch.inference_mode():
        output = model._network(
            pixel_values=pixel_values(picture, family),
            input_points=torch.tensor([[[[40.0 * across, 10.0 * down]]]]),
            input_labels=torch.ones(1, 1, 1, dtype=torch.int32),
            multimask_output=True,
        )
    scores, order = output.iou_scores[0, 0].sort(descending=True)
    torch.testing.assert_close(found.scores, scores.clamp(0, 1), rtol=0, atol=1e-4)
    logits = output.pred_masks[0, 0, order][None]
    if family not in SIDES:
        logits = logits[:, :, : logits.shape[2] // 2]
    wanted = F.interpolate(logits, (32, 64), mode="bilinear")[0] > 0
    assert len(found) == 3
    for i in range(3):
        differing = int((found.masks[i].decode() != wanted[i]).sum())
        assert differing <= 4, "rounding at the border at most"


@pytest.mark.parametrize(("family", "kind"), KINDS)
def test_hints_count(checkpoints, rng, family, kind) -> None:
    model = made(checkpoints, family, kind)
    embedding = model.embed(image(rng, 40, 50))
    points = torch.tensor([[10.0, 10.0], [30.0, 30.0]])
    rough = torch.zeros(40, 50, dtype=torch.bool)
    rough[5:20, 5:20] = True
    prompts = [
        Prompt(points=points),
        Prompt(points=points, positive=torch.tensor([True, False])),
        Prompt(box=torch.tensor([5.0, 5, 30, 30]), points=points),
        Prompt(mask=rough, points=points),
        Prompt(mask=~rough, points=points),
    ]
    answers = {model.prompted_masks(embedding, prompt).masks[0].area for prompt in prompts}
    assert len(answers) >= 4
    assert len(model.prompted_masks(embedding, prompts[0])) == 1, "several hints: one mask"


@pytest.mark.parametrize(("family", "kind"), KINDS)
def test_masks_of_nobodys_prompt(checkpoints, rng, monkeypatch, family, kind) -> None:
    picture = image(rng, 48, 70)
    found = made(checkpoints, family, kind).masks(picture)
    assert (found.height, found.width) == (48, 70)
    assert len(found) > 4
    monkeypatch.setattr(_mask_generator, "PROMPTS_PER_BATCH", 5)
    again = made(checkpoints, family, kind).masks(picture)
    assert [mask.area for mask in again.masks] == pytest.approx(
        [mask.area for mask in found.masks], abs=5
    )


@pytest.mark.parametrize(("family", "kind"), KINDS)
def test_a_box_says_enough_for_one_mask(checkpoints, rng, family, kind) -> None:
    model = made(checkpoints, family, kind)
    embedding = model.embed(image(rng, 40, 50))
    assert len(model.prompted_masks(embedding, Prompt(box=torch.tensor([5.0, 5, 30, 30])))) == 1
    point = Prompt(points=torch.tensor([[9.0, 9.0]]))
    assert len(model.prompted_masks(embedding, point)) == 3


@pytest.mark.parametrize("written", ["published", "saved"])
def test_sam3s_tracker_out_of_weights_that_hold_the_detector_too(
    checkpoints, rng, tmp_path, written
) -> None:
    """The library writes tracker_model. twice before a name, and publishes it once."""
    from safetensors.torch import load_file, save_file

    folder = shutil.copytree(checkpoints("sam3_video"), tmp_path / "sam3")
    path = folder / "model.safetensors"
    twice = "tracker_model.tracker_model."
    held = load_file(path)
    assert any(name.startswith(twice) for name in held)
    once = {name.replace(twice, "tracker_model."): value for name, value in held.items()}
    if written == "published":
        save_file(once, path, metadata={"format": "pt"})
    model = made(lambda kind: folder, "sam3", "sam3")
    mine = model._network.state_dict()
    for name, theirs in (
        ("mask_decoder.iou_token.weight", "tracker_model.mask_decoder.iou_token.weight"),
        ("vision_encoder.neck.fpn_layers.0.proj1.weight", "tracker_neck.fpn_layers.0.proj1.weight"),
        ("no_memory_embedding", "tracker_model.no_memory_embedding"),
    ):
        assert torch.equal(mine[name], once[theirs])
    name = "vision_encoder.backbone.layers.0.mlp.fc1.weight"
    assert torch.equal(mine[name], once[f"detector_model.{name}"])
    assert len(model.masks(image(rng, 48, 70))) > 4


def test_features_are_the_embedding(checkpoints, rng) -> None:
    """Of a square picture of the trained size nothing is resampled."""
    model = made(checkpoints, "sam", "sam")
    picture = image(rng, 64, 64)
    found = model.features(picture).maps[0]
    assert (found.stride, tuple(found.features.shape)) == (8, (8, 8, 256))
    wanted = model.embed(picture).arrays["map0"][0].permute(1, 2, 0)
    torch.testing.assert_close(found.features, wanted, rtol=0, atol=1e-4)
    half = model.features(picture[:32]).maps[0]
    assert tuple(half.features.shape) == (4, 8, 256)
    wanted = model.embed(picture[:32]).arrays["map0"][0, :, :4].permute(1, 2, 0)
    torch.testing.assert_close(half.features, wanted, rtol=0, atol=1e-4)


def test_one_pass_of_the_encoder_serves_all(checkpoints, rng, monkeypatch) -> None:
    model = made(checkpoints, "sam2", "sam2", batch=2)
    calls: list[int] = []
    run = model._last._run
    monkeypatch.setattr(
        model._last, "_run", lambda images: calls.append(len(images)) or run(images)
    )
    pictures = [image(rng, 32, 64) for _ in range(2)]
    model.encode(pictures)
    for picture in pictures:
        model.masks(picture), model.features(picture), model.embed(picture)
    assert calls == [2]


def test_settings_and_refusals(checkpoints, rng) -> None:
    model = made(checkpoints, "sam", "sam")
    # What were options once is recorded still, so that evidence and caches of then are known.
    assert model.settings["multimask"] is True
    assert model.settings["stability_offset"] == 1.0
    assert model.settings != made(checkpoints, "sam", "sam", min_iou=0.1).settings
    with pytest.raises(RangeError, match="size: sam takes 64 alone, got 128"):
        find_model("sam", loading=LoadOptions(weights=str(checkpoints("sam")), size=128))
    with pytest.raises(FileFormatError, match="expected weights of sam2 or sam2_video, got those"):
        made(checkpoints, "sam2", "sam")
    embedding = model.embed(image(rng, 32, 64))
    with pytest.raises(InputError, match="expected one of model 'sam2', got 'sam'"):
        made(checkpoints, "sam2", "sam2").prompted_masks(
            embedding, Prompt(points=torch.tensor([[1.0, 1.0]]))
        )
    with pytest.raises(RangeError, match="pixels of an image of 64x32"):
        model.prompted_masks(embedding, Prompt(points=torch.tensor([[90.0, 1.0]])))
