"""Phrases taken apart, and what their parts say of things."""

import math

import pytest
import torch

from lift.conftest import gaussians_at
from splatseg.io.evidence import TextEmbeddings
from splatseg.lift import TextSpace
from splatseg.lift.phrases import (
    ThingLooks,
    known_name,
    match_phrases,
    parse_phrase,
    phrase_scores,
    sureness,
    thing_looks,
)
from splatseg.lift.vocabulary import Vocabulary
from splatseg.lift.words import WordMatches

SPACE = TextSpace(width=3)
LABELS = ("mug", "desk", "white board", "desk lamp", "rubber duck", "duck", "red mug on the desk")
KINDS = ("class", "class", "class", "class", "synonym", "class", "instance")
VOCABULARY = Vocabulary(
    space=SPACE,
    recorded=TextEmbeddings(
        labels=LABELS,
        vectors=torch.nn.functional.normalize(torch.ones(len(LABELS), 3), dim=1),
        kinds=KINDS,
        target_ids=tuple(range(len(LABELS))),
    ),
)
RED, GREEN, GREY = (0.78, 0.12, 0.12), (0.2, 0.59, 0.24), (0.5, 0.5, 0.5)


@pytest.fixture(autouse=True)
def ten_degrees(monkeypatch):
    monkeypatch.setattr("splatseg.lift.phrases.TEMPERATURE", 10.0)


@pytest.mark.parametrize(
    ("text", "called", "coloured", "relation", "reference"),
    [
        ("mug", "mug", False, None, None),
        ("orange", "orange", False, None, None),
        ("The red  mug", "red mug", True, None, None),
        ("wooden mug on the desk (2)", "wooden mug", False, "on", "desk"),
        ("book in a dark blue box", "book", False, "on", "dark blue box"),
        ("mug on the second shelf of the tall cupboard", "mug", False, "on", "tall cupboard"),
        ("Chair next to the round Table", "Chair", False, "near", "round Table"),
        ("chair at the desk on the carpet", "chair", False, "near", "desk"),
        ("picture on the north wall", "picture", False, None, None),
        ("plant in the corner", "plant", False, None, None),
        ("mug behind the box", "mug", False, None, None),
        ("cat in front of the red sofa", "cat", False, None, None),
        ("olive mug behind", "olive mug", True, None, None),
        ("book on the top shelf of the cupboard behind", "book", False, "on", "cupboard"),
        ("mug on", "mug", False, None, None),
    ],
)
def test_what_a_phrase_says(text, called, coloured, relation, reference) -> None:
    found = parse_phrase(text)
    assert found.text == text
    assert found.called == called
    assert (found.colour is not None) == coloured
    assert found.relation == relation
    assert (found.reference.called if found.reference else None) == reference
    assert found.is_compound == (coloured or reference is not None)


def test_colours_are_those_of_cielab() -> None:
    """sRGB (200, 30, 30) by CIE 15 for D65, worked out outside of this project."""
    red = parse_phrase("red mug").colour
    assert red == pytest.approx((43.22, 63.04, 45.22), abs=0.01)
    light, dark = parse_phrase("light red mug").colour, parse_phrase("dark red mug").colour
    assert light == pytest.approx((red[0] + 25, red[1] * 0.7, red[2] * 0.7), abs=1e-3)
    assert dark == pytest.approx((red[0] - 25, red[1] * 0.8, red[2] * 0.8), abs=1e-3)
    assert parse_phrase("deep red mug").colour == red


def boxes(*places: tuple[tuple[float, ...], tuple[float, ...]], has_up: bool = True) -> ThingLooks:
    low = torch.tensor([low for low, _ in places], dtype=torch.float32)
    high = torch.tensor([high for _, high in places], dtype=torch.float32)
    return ThingLooks(colours=torch.zeros(len(low), 3), low=low, high=high, has_up=has_up)


DESK = ((0, 0, 0.0), (2, 1, 0.8))
MUG = ((0.5, 0.5, 0.8), (0.6, 0.6, 0.9))
BESIDE = ((2.4, 0.5, 0.8), (2.5, 0.6, 0.9))
FAR = ((5, 5, 0.8), (5.1, 5.1, 0.9))
HIGH = ((0.5, 0.5, 1.8), (0.6, 0.6, 1.9))
BELOW = ((0.5, 0.5, -0.9), (0.6, 0.6, -0.8))


def test_things_stand_on_what_is_below_them() -> None:
    looks = boxes(DESK, MUG, BESIDE, FAR, HIGH, BELOW)
    on = looks.related("on", torch.arange(6))
    assert torch.nonzero(on).tolist() == [[1, 0]]
    under = boxes(DESK, ((0.9, 0.45, 0.0), (1.1, 0.55, 0.1)))
    assert not bool(under.related("on", torch.arange(2))[0, 1]), "a desk is on nothing so small"
    # Half a mug above the desk is still on it: boxes are of centres, and end before surfaces.
    lifted = boxes(DESK, ((0.5, 0.5, 0.84), (0.6, 0.6, 0.94)), ((0.5, 0.5, 0.86), (0.6, 0.6, 0.96)))
    assert lifted.related("on", torch.arange(3))[:, 0].tolist() == [False, True, False]
    # The rim is grown by a tenth of the desk.
    rim = boxes(DESK, ((2.1, 0.5, 0.8), (2.2, 0.6, 0.9)), ((2.2, 0.5, 0.8), (2.3, 0.6, 0.9)))
    assert rim.related("on", torch.arange(3))[:, 0].tolist() == [False, True, False]


def test_things_are_near_within_a_quarter_of_the_others_diagonal() -> None:
    looks = boxes(DESK, MUG, BESIDE, FAR)
    near = looks.related("near", torch.arange(4))
    assert near[:, 0].tolist() == [False, True, True, False]
    assert near[0].tolist() == [False, True, False, False], "a quarter of a mug is no distance"


def test_shares_of_what_is_meant_do_not_depend_on_the_chunk(monkeypatch) -> None:
    looks, meant = boxes(DESK, MUG, BESIDE, FAR), torch.tensor([0.7, 0.1, 0.1, 0.1])
    assert looks.share("on", meant).tolist() == pytest.approx([0, 0.7, 0, 0])
    monkeypatch.setattr("splatseg.lift.phrases._AT_ONCE", 3)
    assert looks.share("on", meant).tolist() == pytest.approx([0, 0.7, 0, 0])
    nowhere = boxes(DESK, MUG, has_up=False)
    assert nowhere.share("on", meant[:2]).tolist() == [1, 1], "nobody knows what is on what"
    unknown = boxes(DESK, ((math.nan,) * 3, (math.nan,) * 3))
    assert not bool(unknown.related("near", torch.arange(2)).any())


def test_looks_of_things() -> None:
    gaussians = gaussians_at(torch.rand(300, 3, generator=torch.Generator().manual_seed(0)))
    colours = torch.tensor([RED, GREEN, GREY])
    thing = torch.arange(300) % 3
    gaussians.sh[:, 0] = (colours[thing] - 0.5) / 0.28209479
    gaussians.means[thing == 1] += torch.tensor([0.0, 4.0, 0.0])
    kept = torch.nonzero(thing < 2).squeeze(1)
    looks = thing_looks(
        gaussians, thing[kept], kept, torch.ones(len(kept)), count=3, up=(0.0, 1.0, 0.0)
    )
    assert looks.has_up
    assert torch.isnan(looks.low[2]).all()
    assert looks.colours[0].tolist() == pytest.approx(parse_phrase("red mug").colour, abs=1.5)
    # What was y is now up.
    assert 3.9 < float(looks.low[1, 2]) < 4.1
    assert 4.9 < float(looks.high[1, 2]) < 5.1
    # Half of each kind, the red ones twice as heavy.
    rows = torch.tensor([0, 1])
    mixed = thing_looks(
        gaussians, torch.zeros(2).long(), rows, torch.tensor([2.0, 1.0]), count=1, up=None
    )
    expected = thing_looks(
        gaussians_of((2 * torch.tensor(RED) + torch.tensor(GREEN)) / 3),
        torch.zeros(1).long(), torch.zeros(1).long(), torch.ones(1), count=1, up=None,
    )  # fmt: skip
    torch.testing.assert_close(mixed.colours, expected.colours, atol=0.05, rtol=0)


def gaussians_of(colour: torch.Tensor):
    one = gaussians_at(torch.zeros(1, 3))
    one.sh[:, 0] = (colour - 0.5) / 0.28209479
    return one


def test_scores_by_hand() -> None:
    phrase = parse_phrase("red mug on the desk")
    light, a, b = phrase.colour
    looks = boxes(DESK, MUG, FAR)
    looks.colours[:] = torch.tensor([[light, a, b], [light + 8, a, b], [light, a + 6, b + 8]])
    names = {"red mug": torch.tensor([0.0, 0.5, 0.25]), "desk": torch.tensor([0.8, 0.1, 1e-9])}
    found = phrase_scores(phrase, torch.tensor([0.1, 0.2, 0.3]), looks, names.__getitem__)
    desk = 0.8 / (0.8 + 0.1 + 1e-3)
    expected = [
        1.0 + math.log(1e-3) + 2 * math.log(0.02),
        2.0 + math.log(0.5) - 3 * 4 / 20 + 2 * math.log(0.02 + desk),
        3.0 + math.log(0.25) - 3 * 10 / 20 + 2 * math.log(0.02),
    ]
    assert found.tolist() == pytest.approx(expected, abs=1e-4)
    # What has no name says nothing, and what a reference has no name of is not looked for.
    names = {"red mug": None, "desk": None}
    found = phrase_scores(phrase, torch.zeros(3), looks, names.get)
    assert found.tolist() == pytest.approx([0.0, -3 * 4 / 20, -3 * 10 / 20], abs=1e-4)


def test_others_are_as_sure_as_they_come_near() -> None:
    scores = torch.tensor([1.0, 3.0, 3.0 - math.log(2)])
    found = sureness(scores, torch.tensor([0.9, 0.2, 0.9]), torch.tensor([0.0, 0.8, 1.0]))
    assert found.tolist() == pytest.approx([0.8 * math.exp(-2), 0.8, 0.4], abs=1e-6)
    alone = sureness(scores, torch.tensor([0.9, 0.2, 0.9]), None)
    assert float(alone[1]) == pytest.approx(0.2)


def test_names_are_the_longest_end_that_is_known() -> None:
    assert known_name("pink rubber duck", VOCABULARY) == "rubber duck"
    assert known_name("old duck", VOCABULARY) == "duck"
    assert known_name("pink swan", VOCABULARY) is None
    assert known_name("red mug on the desk", VOCABULARY) == "desk"

    class Encoder:
        def encode_text(self, words):
            raise AssertionError

    anything = Vocabulary(space=SPACE, encoder=Encoder())
    assert known_name("dark pink rubber swan", anything) == "rubber swan"
    assert known_name("red", anything) is None
    assert known_name("mug", Vocabulary(space=SPACE)) is None


def test_colours_tell_things_of_one_name_apart() -> None:
    """Two mugs, of which the phrase as a whole prefers the green one; words stay as they are."""
    looks = boxes(MUG, MUG, DESK)
    looks.colours[:] = torch.tensor(
        [parse_phrase("green mug").colour, parse_phrase("red mug").colour, (50.0, 0.0, 0.0)]
    )
    whole = WordMatches(
        words=("mug", "red mug on the desk", "white board"),
        cosines=torch.tensor([[0.9, 0.8, 0.1], [0.9, 0.7, 0.1], [0.0, 0.1, 0.1]]),
        probabilities=torch.tensor([[0.9, 0.5, 0.1], [0.9, 0.4, 0.1], [0.0, 0.0, 0.1]]),
    )
    asked = []

    def ask(word: str) -> torch.Tensor:
        asked.append(word)
        return {"mug": torch.tensor([0.9, 0.9, 0.0]), "desk": torch.tensor([0.0, 0.0, 0.9])}[word]

    scores, sure = match_phrases(whole, lambda: looks, VOCABULARY, ask)
    assert torch.equal(scores[:, [0, 2]], 10 * whole.cosines[:, [0, 2]])
    assert torch.equal(sure[:, [0, 2]], whole.probabilities[:, [0, 2]])
    assert int(scores[:, 1].argmax()) == 1
    assert float(sure[1, 1]) == pytest.approx(0.9)
    assert float(sure[0, 1]) < 0.01
    assert asked == ["mug", "desk"], "each once, and not for plain words"
    assert torch.equal(whole.probabilities[:, 1], torch.tensor([0.5, 0.4, 0.0])), "nothing changed"
