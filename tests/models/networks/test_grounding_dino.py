"""Grounding DINO: own post-processing solved by hand, the networks held to direct calls."""

import json
import shutil
from pathlib import Path

import pytest
import torch

from splatseg.core.models import GroundedBoxes
from splatseg.errors import FileFormatError, InputError, RangeError
from splatseg.models import LoadOptions, find_model, record_evidence
from splatseg.models.networks import grounding_dino
from splatseg.models.networks.grounding_dino import (
    GroundingDinoOptions,
    found_boxes,
    phrases,
    word_tokens,
)
from support.checkpoints_text import COLOURS

WORDS = ("chair", "red mug", "table")
KINDS = ["grounding_dino", "mm_grounding_dino"]
ALL = {"box_threshold": 0.0, "text_threshold": 0.0}


@pytest.fixture(autouse=True)
def every_box(monkeypatch) -> None:
    """Boxes that overlap are kept."""
    monkeypatch.setattr(grounding_dino, "MAX_OVERLAP", 1.0)


def made(checkpoints, kind: str = "grounding_dino", *, size=None, **options):
    place = LoadOptions(weights=str(checkpoints(kind)), size=size, device="cpu")
    return find_model("grounding-dino", GroundingDinoOptions(**ALL | options), loading=place)


def image(rng, height: int, width: int) -> torch.Tensor:
    return torch.from_numpy(rng.integers(0, 256, (height, width, 3)).astype("uint8"))


@pytest.mark.parametrize("kind", KINDS)
def test_boxes_are_those_of_the_network(checkpoints, rng, kind: str) -> None:
    model = made(checkpoints, kind)
    assert isinstance(model, GroundedBoxes)
    picture = image(rng, 64, 80)  # the shorter side is as the checkpoint wants it
    found = model.boxes(picture, WORDS)
    mean, std = (torch.tensor(COLOURS[name]).view(3, 1, 1) for name in ("image_mean", "image_std"))
    batch = ((picture.permute(2, 0, 1) / 255 - mean) / std)[None]
    from transformers import AutoTokenizer

    asked = AutoTokenizer.from_pretrained(checkpoints(kind))(
        "chair. red mug. table.", return_tensors="pt"
    )
    with torch.inference_mode():
        output = model._network(pixel_values=batch, **asked)
    # [CLS] chair . red mug . table . [SEP]
    assert asked.input_ids.shape[1] == 9
    tokens = output.logits[0].sigmoid()
    by_word = torch.stack([tokens[:, 1], tokens[:, 3:5].mean(dim=1), tokens[:, 6]], dim=1)
    best = torch.stack([tokens[:, 1], tokens[:, 3:5].amax(dim=1), tokens[:, 6]], dim=1)
    word = by_word.argmax(dim=1)
    score, order = best.gather(1, word[:, None])[:, 0].sort(descending=True)
    torch.testing.assert_close(found.scores, score, rtol=0, atol=1e-4)
    assert found.words == tuple(word[order].tolist())
    assert len(set(found.words)) > 1
    x, y, wide, high = output.pred_boxes[0, order].T
    corners = torch.stack((x - wide / 2, y - high / 2, x + wide / 2, y + high / 2), dim=1)
    wanted = corners.clamp(0, 1) * torch.tensor([80, 64, 80, 64])
    torch.testing.assert_close(found.boxes, wanted, rtol=0, atol=1e-2)


def test_phrases_and_their_tokens() -> None:
    text, places = phrases([" Chair ", "red mug", "x"])
    assert text == "chair. red mug. x."
    assert [text[start:end] for start, end in places] == ["chair", "red mug", "x"]
    # [CLS] chair . red mu ##g . x . [SEP]
    spans = [(0, 0), (0, 5), (5, 6), (7, 10), (11, 13), (13, 14), (14, 15), (16, 17), (17, 18),
             (0, 0)]  # fmt: skip
    assert word_tokens(spans, places) == [[1], [3, 4, 5], [7]]


def test_a_box_is_of_the_word_of_which_it_fits_most(monkeypatch) -> None:
    """Four tokens: chair; red, mug; a token of no word. By hand."""
    probabilities = torch.tensor(
        [
            [0.40, 0.70, 0.10, 0.9],  # chair 0.40, red mug (0.7 + 0) / 2 = 0.35: chair
            [0.30, 0.60, 0.50, 0.0],  # chair 0.30, red mug 0.55: red mug, 0.6
            [0.20, 0.10, 0.10, 0.9],  # nothing speaks for a word
            [0.26, 0.00, 0.00, 0.0],  # speaks for chair, but not surely enough
        ]
    )
    boxes = torch.tensor([[0.5, 0.5, 0.2, 0.4]] * 4)
    options = GroundingDinoOptions(box_threshold=0.35, text_threshold=0.25)
    found = found_boxes(probabilities, boxes, [[0], [1, 2]], options, size=(100, 200))
    assert found.words == (1, 0)
    torch.testing.assert_close(found.scores, torch.tensor([0.6, 0.4]))
    torch.testing.assert_close(found.boxes[0], torch.tensor([80.0, 30, 120, 70]))
    loose = GroundingDinoOptions(box_threshold=0.2, text_threshold=0.25)
    monkeypatch.setattr(grounding_dino, "MAX_OVERLAP", 0.8)
    assert len(found_boxes(probabilities, boxes, [[0], [1, 2]], loose, size=(9, 9)).words) == 2, (
        "two boxes of chair lie on each other"
    )
    monkeypatch.setattr(grounding_dino, "MAX_OVERLAP", 1.0)
    assert found_boxes(probabilities, boxes, [[0], [1, 2]], loose, size=(9, 9)).words == (1, 0, 0)
    strict = GroundingDinoOptions(box_threshold=0.35, text_threshold=0.65)
    of = found_boxes(probabilities, boxes, [[0], [1, 2]], strict, size=(9, 9))
    assert of.words == (1,), "with 0.65 only red of the first box speaks, for red mug"


def test_boxes_end_at_the_border_and_have_an_area() -> None:
    boxes = torch.tensor([[0.0, 0.5, 0.5, 0.5], [1.3, 0.5, 0.2, 0.2], [0.5, 0.5, 0.0, 0.3]])
    options = GroundingDinoOptions(box_threshold=0.0, text_threshold=0.0)
    found = found_boxes(torch.full((3, 1), 0.5), boxes, [[0]], options, size=(40, 80))
    torch.testing.assert_close(found.boxes, torch.tensor([[0.0, 10, 20, 30]]))


def test_the_input_has_the_sides_that_the_weights_want(checkpoints, tmp_path) -> None:
    model = made(checkpoints)

    def sides(model, height, width):
        frame = model._frame(height, width)
        return frame.outer_height, frame.outer_width

    assert sides(model, 100, 120) == (64, 77), "the shorter side is 64"
    assert sides(model, 100, 300) == (32, 96), "the longer one at most 96"
    assert sides(made(checkpoints, size=200), 100, 300) == (67, 200)
    assert made(checkpoints, size=200).settings != model.settings
    folder = Path(shutil.copytree(checkpoints("grounding_dino"), tmp_path / "copy"))
    path = folder / "preprocessor_config.json"
    content = json.loads(path.read_text())
    # The same in the file that newer programs write.
    path.unlink()
    (folder / "processor_config.json").write_text(json.dumps({"image_processor": content}))
    again = find_model("grounding-dino", loading=LoadOptions(weights=str(folder)))
    assert sides(again, 100, 300) == (32, 96)
    assert again._normalisation == model._normalisation
    (folder / "processor_config.json").unlink()
    bare = find_model("grounding-dino", loading=LoadOptions(weights=str(folder)))
    assert sides(bare, 100, 100) == (800, 800)
    assert sides(bare, 100, 200) == (666, 1333)
    path.write_text(json.dumps(content | {"size": {"shortest_edge": "wide"}}))
    with pytest.raises(
        FileFormatError, match=r"shortest_edge: expected a number of pixels up to 16384, got"
    ):
        find_model("grounding-dino", loading=LoadOptions(weights=str(folder)))


def test_settings_and_refusals(checkpoints, rng, views, tmp_path) -> None:
    model = made(checkpoints)
    for name, value in (("box_threshold", 0.5), ("text_threshold", 0.5)):
        assert made(checkpoints, **{name: value}).settings != model.settings
        with pytest.raises(RangeError, match=rf"{name}: expected a value in \[0, 1\], got 2"):
            GroundingDinoOptions(**{name: 2})
    picture = image(rng, 40, 50)
    assert model.boxes(picture, []).words == ()
    with pytest.raises(InputError, match="expected words without full stops"):
        model.boxes(picture, ["a. b"])
    with pytest.raises(InputError, match="distinct words"):
        model.boxes(picture, ["a", "a"])
    with pytest.raises(RangeError, match=r"words: expected at most 48 tokens, got 63"):
        model.boxes(picture, ["z" * 58, "chair"])
    with pytest.raises(FileFormatError, match="expected weights of grounding-dino or mm-grounding"):
        made(checkpoints, "clip")
    with pytest.raises(InputError, match="'grounding-dino': expected one that gives evidence"):
        record_evidence(model, views, tmp_path / "boxes")
