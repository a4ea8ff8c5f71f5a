"""CLIPSeg: the likeliest word of every pixel, held to the network's own logits."""

import pytest
import torch

from splatseg.core.models import SemanticLabels
from splatseg.errors import FileFormatError, InputError, RangeError
from splatseg.models import LoadOptions, find_model
from splatseg.models.networks.word_masks import ClipSegOptions
from support.checkpoints_text import COLOURS

WORDS = ("chair", "red mug", "table")


def made(checkpoints, *, size=None, batch=None, **options):
    place = LoadOptions(weights=str(checkpoints("clipseg")), size=size, batch=batch, device="cpu")
    return find_model("clipseg", ClipSegOptions(**{"words": WORDS} | options), loading=place)


def image(rng, height: int, width: int) -> torch.Tensor:
    return torch.from_numpy(rng.integers(0, 256, (height, width, 3)).astype("uint8"))


def own_logits(model, picture: torch.Tensor, sentence: str) -> torch.Tensor:
    """Logits of one sentence by the library's whole network."""
    mean, std = (torch.tensor(COLOURS[name]).view(3, 1, 1) for name in ("image_mean", "image_std"))
    batch = ((picture.permute(2, 0, 1) / 255 - mean) / std)[None]
    from transformers import AutoTokenizer

    ids = AutoTokenizer.from_pretrained(model._place.folder)(sentence, return_tensors="pt")
    with torch.inference_mode():
        return model._network(pixel_values=batch, **ids).logits


def test_every_pixel_has_its_likeliest_word(checkpoints, rng) -> None:
    model = made(checkpoints, threshold=0.4)
    assert isinstance(model, SemanticLabels)
    picture = image(rng, 64, 64)
    logits = torch.cat([own_logits(model, picture, f"a photo of a {word}") for word in WORDS])
    probability, index = logits.sigmoid().max(dim=0)
    wanted = torch.where(probability >= 0.4, index + 1, -1)
    found = model.label_map(picture)
    torch.testing.assert_close(found.confidence, probability, rtol=0, atol=1e-3)
    assert float((found.ids == wanted).float().mean()) > 0.99, "all but ties"
    assert set(found.ids.unique().tolist()) == {-1, 1, 2, 3}, "the test shows all of them"
    assert [(row.id, row.name) for row in model.classes.rows] == list(enumerate(WORDS, start=1))


def test_maps_have_the_size_of_the_photograph(checkpoints, rng) -> None:
    picture = image(rng, 37, 90)
    found = made(checkpoints, threshold=0.0).label_map(picture)
    assert (found.height, found.width) == (37, 90)
    assert int(found.ids.min()) >= 1, "at 0 every pixel has a word"
    none = made(checkpoints, threshold=1.0).label_map(picture)
    assert bool((none.ids == -1).all())
    larger = made(checkpoints, threshold=0.0, size=96).label_map(picture)
    assert not torch.equal(larger.ids, found.ids)


def test_images_together_and_what_is_asked_count(checkpoints, rng) -> None:
    model = made(checkpoints, batch=3)
    assert model.batch_size == 3
    pictures = [image(rng, 30, 40) for _ in range(3)]
    alone = [model.label_map(one).confidence for one in pictures]
    model.encode(pictures)
    assert len(model._last._kept) == 3
    for one, picture in zip(alone, pictures, strict=True):
        torch.testing.assert_close(one, model.label_map(picture).confidence, rtol=0, atol=1e-4)
    others = [
        made(checkpoints, words=("chair",)),
        made(checkpoints, threshold=0.5),
        made(checkpoints, size=96),
    ]
    assert all(other.settings != model.settings for other in others)
    assert model.settings["tokenizer"]


def test_what_is_refused(checkpoints) -> None:
    with pytest.raises(InputError, match="clipseg looks for what words name, so expected at least"):
        made(checkpoints, words=())
    with pytest.raises(RangeError, match="threshold: expected a value in .*, got 1.5"):
        ClipSegOptions(threshold=1.5)
    with pytest.raises(InputError, match="template: this option was removed; words stand in"):
        ClipSegOptions(template="a photo")
    with pytest.raises(RangeError, match="size: expected a multiple of 16, got 100"):
        made(checkpoints, size=100)
    with pytest.raises(FileFormatError, match=r"expected weights of clipseg, got those of 'clip'"):
        find_model(
            "clipseg",
            ClipSegOptions(words=WORDS),
            loading=LoadOptions(weights=str(checkpoints("clip"))),
        )
