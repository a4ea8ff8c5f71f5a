r"""Phrases that tell one thing from others like it: "red mug on the wooden desk".

One cosine holds a whole phrase against a whole feature. But a phrase says several things, and most
can be seen: what it is called, which colour it has, what it stands on. So each counts by itself,

.. math:: s_k = \tau \cos_V(f_k, t) + \alpha \log p_k(\text{name})
          - \beta \, \frac{\Delta E(c_k, c)}{20}
          + \gamma \log \Bigl( \epsilon + \sum_j q_j \, [k \text{ on } j] \Bigr)

with the cosine of the phrase, the probability of its name (`lift.words`), the distance of
the thing's colour in CIELAB, lightness halved because shadows change it, and q the things that the
rest of the phrase may mean, by their own names and colours. The largest s is what is meant, and
others are as sure as they come near it:

.. math:: p_k = \max(p_b(\text{phrase}), p_b(\text{name})) \, e^{s_k - s_b}, \qquad b = \arg\max s

Parts that a phrase does not have, or that nothing is known of, do not count: "mug" is what it was.
Left, right, before and behind depend on who looks; `lift.referring` reads them.

References:
    CIE 15:2004, the colour space CIELAB and its distance of 1976.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from splatseg.core import Gaussians
from splatseg.core.rigid import upright
from splatseg.core.sh import base_colours
from splatseg.lift.vocabulary import Vocabulary
from splatseg.lift.words import TEMPERATURE, WordMatches

Relation = Literal["on", "near"]

_NAME, _COLOUR, _RELATION = 1.0, 3.0, 2.0
"""Alpha, beta and gamma: docs/decisions/words.md."""

_DISTANCE = 20.0
"""Delta E that is clearly another colour."""

_LIGHTNESS = 0.5
_LEAST_NAME = 1e-3
_EPSILON = 0.02
_GROWN = 0.1
"""Share of a thing's sides by which its box is grown before others are on it."""

_NEAR = 0.25
"""Share of a thing's diagonal within which others are near it."""

_XYZ = torch.tensor(
    [
        [0.412453, 0.357580, 0.180423],
        [0.212671, 0.715160, 0.072169],
        [0.019334, 0.119193, 0.950227],
    ],
    dtype=torch.float64,
)
"""Linear sRGB to CIE XYZ; white, (1, 1, 1), is that of D65."""

_COLOURS: dict[str, tuple[int, int, int]] = {
    "black": (20, 20, 20), "white": (240, 240, 240), "grey": (128, 128, 128),
    "gray": (128, 128, 128), "silver": (190, 190, 195), "red": (200, 30, 30),
    "maroon": (110, 20, 40), "orange": (240, 130, 30), "brown": (110, 70, 40),
    "tan": (200, 170, 120), "beige": (225, 210, 180), "cream": (245, 235, 205),
    "gold": (210, 170, 60), "yellow": (240, 215, 50), "olive": (120, 120, 40),
    "lime": (150, 220, 50), "green": (50, 150, 60), "mint": (170, 230, 190),
    "teal": (20, 128, 128), "turquoise": (60, 210, 200), "cyan": (60, 220, 230),
    "blue": (50, 80, 200), "navy": (25, 35, 90), "purple": (130, 50, 160),
    "violet": (140, 60, 200), "lavender": (190, 170, 225), "pink": (245, 160, 190),
    "magenta": (220, 40, 180),
}  # fmt: skip
"""sRGB of what everyday words of colours mean."""

_SHADES: dict[str, tuple[float, float]] = {
    "light": (25.0, 0.7), "pale": (25.0, 0.6), "dark": (-25.0, 0.8),
}  # fmt: skip
"""What is added to the lightness, and what chroma is multiplied by."""

_RELATIONS: dict[str, Relation] = {
    "on": "on", "in": "on", "inside": "on", "at": "near", "by": "near", "near": "near",
    "beside": "near", "next to": "near",
}  # fmt: skip
_OTHERS = ("in front of", "behind", "under", "above", "below", "left of", "right of", "over")
"""Words that end the name, too, and say what is not read."""

_SPLIT = re.compile(
    r"\s+(" + "|".join(sorted((*_RELATIONS, *_OTHERS), key=len, reverse=True)) + r")(?:\s+|$)"
)
_ARTICLE = re.compile(r"^(?:the|a|an|some|my|your)\s+", re.IGNORECASE)
_NUMBER = re.compile(r"\s*\(\d+\)")
_AT_ONCE = 512
"""Things whose relations to all others are held at a time."""

_PLACES = {"wall", "walls", "ceiling", "floor", "ground", "room", "middle", "centre", "center",
           "corner", "left", "right", "front", "back"}  # fmt: skip
"""What ends a reference that is no thing to stand on, or is on all sides."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Phrase:
    """What a phrase says."""

    text: str

    called: str
    """Before what relates it to others: "light brown mug"."""

    colour: tuple[float, float, float] | None = None
    """CIELAB."""

    relation: Relation | None = None

    reference: "Phrase | None" = None
    """What it is related to."""

    @property
    def is_compound(self) -> bool:
        """Whether it says more than a name."""
        return self.colour is not None or self.reference is not None


def parse_phrase(text: str) -> Phrase:
    """Take a phrase apart; words that are not understood stay in its name."""
    said = _ARTICLE.sub("", _NUMBER.sub("", " ".join(text.split())))
    found = _SPLIT.search(said.lower())
    called = said[: found.start()] if found else said
    relation = _RELATIONS.get(found.group(1)) if found else None
    reference = None
    if found and relation is not None:
        # "the second shelf of the cupboard" is in the cupboard.
        rest = re.split(r"\s+of\s+", said[found.end() :], flags=re.IGNORECASE)[-1]
        reference = parse_phrase(rest)
        if reference.called.lower().rpartition(" ")[2] in {"", *_PLACES}:
            reference = None
    return Phrase(
        text=text,
        called=called,
        colour=colour_of(called),
        relation=None if reference is None else relation,
        reference=reference,
    )


def colour_of(called: str) -> tuple[float, float, float] | None:
    """CIELAB of the first colour before a name; a colour alone is a name."""
    words = called.lower().split()
    for at, word in enumerate(words[:-1]):
        if word in _COLOURS:
            light, a, b = _lab(torch.tensor([_COLOURS[word]]) / 255)[0].tolist()
            if at and words[at - 1] in _SHADES:
                step, chroma = _SHADES[words[at - 1]]
                light, a, b = light + step, a * chroma, b * chroma
            return light, a, b
    return None


def _lab(colours: Float[Tensor, "k 3"]) -> Float[Tensor, "k 3"]:
    """CIELAB of sRGB in [0, 1], under the white of D65 (IEC 61966-2-1, CIE 15)."""
    srgb = colours.double()
    linear = torch.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    x, y, z = (linear @ _XYZ.T / _XYZ.sum(dim=1)).unbind(1)
    fx, fy, fz = (
        torch.where(t > (6 / 29) ** 3, t.clamp_min(0) ** (1 / 3), t * (29 / 6) ** 2 / 3 + 4 / 29)
        for t in (x, y, z)
    )
    return torch.stack((116 * fy - 16, 500 * (fx - fy), 200 * (fy - fz)), dim=1).float()


def colour_distances(
    colours: Float[Tensor, "k 3"], colour: tuple[float, float, float]
) -> Float[Tensor, "k"]:
    """Delta E of colours in CIELAB to one, lightness halved because shadows change it."""
    away = colours - torch.tensor(colour)
    away[:, 0] *= _LIGHTNESS
    return away.norm(dim=1)


def colour_words(words: Sequence[str]) -> tuple[bool, ...]:
    """Which words name colours, or shades of them."""
    return tuple(word.lower() in _COLOURS or word.lower() in _SHADES for word in words)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ThingLooks:
    """How things look and where they are; those without a Gaussian are nowhere."""

    colours: Float[Tensor, "k 3"]
    """CIELAB of the mean colour."""

    low: Float[Tensor, "k 3"]
    """Lower corners of boxes, scene units, with z up."""

    high: Float[Tensor, "k 3"]

    has_up: bool
    """Whether it is known where up is; without it nothing is on anything."""

    def related(self, relation: Relation, rows: Int64[Tensor, "r"]) -> Bool[Tensor, "r k"]:
        """Whether the thing of a row is on, or near, that of a column; nothing is to itself."""
        side = self.high - self.low
        low, high = self.low[rows, None], self.high[rows, None]
        if relation == "near":
            gap = torch.maximum(self.low[None] - high, low - self.high[None])
            found = gap.clamp_min(0).norm(dim=2) <= _NEAR * side.norm(dim=1)[None]
        else:
            centre = (high + low) / 2
            grown = _GROWN * side[None]
            inside = (centre >= self.low[None] - grown) & (centre <= self.high[None] + grown)
            above = centre[..., 2] >= self.low[None, :, 2]
            touching = low[..., 2] <= self.high[None, :, 2] + side[rows, None, 2] / 2
            volume = side.prod(dim=1)
            smaller = volume[rows, None] < volume[None]
            found = inside[..., 0] & inside[..., 1] & above & touching & smaller
        return found & (rows[:, None] != torch.arange(len(side))[None])

    def share(self, relation: Relation, meant: Float[Tensor, "k"]) -> Float[Tensor, "k"]:
        """How much of what is meant each thing is on, or near.

        Args:
            relation: Which of them.
            meant: Shares of things, that add up to 1.
        """
        if relation == "on" and not self.has_up:
            return torch.ones_like(meant)
        rows = torch.arange(len(meant)).split(_AT_ONCE)
        parts = [self.related(relation, part).to(meant.dtype) @ meant for part in rows]
        return torch.cat(parts) if parts else meant


def thing_looks(
    gaussians: Gaussians,
    things: Int64[Tensor, "e"],
    rows: Int64[Tensor, "e"],
    weights: Float[Tensor, "e"],
    *,
    count: int,
    up: tuple[float, float, float] | None,
) -> ThingLooks:
    """Mean colours and boxes of things.

    Args:
        gaussians: The Gaussians of the scene.
        things: Thing of each entry.
        rows: Gaussian of each entry.
        weights: How much of the Gaussian the thing has, above 0.
        count: How many things there are.
        up: Where up is; None where nobody knows.
    """
    colours = torch.zeros(count, 3, dtype=torch.float64)
    total = torch.zeros(count, dtype=torch.float64)
    heavy = weights.double() * gaussians.opacities.detach().cpu().double()[rows]
    colours.index_add_(0, things, base_colours(gaussians.sh).double()[rows] * heavy[:, None])
    total.index_add_(0, things, heavy)
    means = upright(gaussians.means.detach().cpu(), up).float()
    low = torch.full((count, 3), torch.nan)
    high = torch.full((count, 3), torch.nan)
    order = torch.argsort(things, stable=True)
    ids, counts = torch.unique_consecutive(things[order], return_counts=True)
    ends = torch.tensor([0.02, 0.98])
    for thing, part in zip(ids.tolist(), order.split(counts.tolist()), strict=True):
        low[thing], high[thing] = means[rows[part]].quantile(ends, dim=0)
    return ThingLooks(
        colours=_lab((colours / total[:, None].clamp_min(1e-12)).float()),
        low=low,
        high=high,
        has_up=up is not None,
    )


def phrase_scores(
    phrase: Phrase,
    cosines: Float[Tensor, "k"],
    looks: ThingLooks,
    name: Callable[[str], Float[Tensor, "k"] | None],
) -> Float[Tensor, "k"]:
    """S of each thing.

    Args:
        phrase: What is asked for.
        cosines: Of the whole phrase, in the span.
        looks: How things look.
        name: Probabilities of the name of what is called something; None where there is none.
    """
    found = TEMPERATURE * cosines + _called(phrase, looks, name)
    reference, relation = phrase.reference, phrase.relation
    if reference is None or relation is None or name(reference.called) is None:
        return found
    meant = _called(reference, looks, name).softmax(dim=0)
    return found + _RELATION * (_EPSILON + looks.share(relation, meant)).log()


def _called(
    phrase: Phrase, looks: ThingLooks, name: Callable[[str], Tensor | None]
) -> Float[Tensor, "k"]:
    """What name and colour say."""
    found = torch.zeros(len(looks.colours))
    probabilities = name(phrase.called)
    if probabilities is not None:
        found = found + _NAME * probabilities.clamp_min(_LEAST_NAME).log()
    if phrase.colour is not None:
        away = colour_distances(looks.colours, phrase.colour)
        found = found - _COLOUR * away / _DISTANCE
    return found


def vocabulary_names(vocabulary: Vocabulary) -> frozenset[str]:
    """Recorded words that are called so: classes and their synonyms."""
    recorded = vocabulary.recorded
    if recorded is None:
        return frozenset()
    pairs = zip(recorded.labels, recorded.kinds, strict=True)
    return frozenset(label for label, kind in pairs if kind in ("class", "synonym"))


def known_name(called: str, vocabulary: Vocabulary) -> str | None:
    """The longest end of what something is called that is a word.

    Of "pink rubber duck" it is "rubber duck", where that was recorded, or "duck"; with a model that
    encodes any words all but the colours.
    """
    words = called.split()
    if vocabulary.encoder is not None:
        plain = [word for word in words if word.lower() not in (*_COLOURS, *_SHADES)]
        return " ".join(plain) or None
    names = vocabulary_names(vocabulary)
    return next((end for at in range(len(words)) if (end := " ".join(words[at:])) in names), None)


def sureness(
    scores: Float[Tensor, "k"], phrase: Float[Tensor, "k"], name: Float[Tensor, "k"] | None
) -> Float[Tensor, "k"]:
    """P of each thing, in [0, 1].

    Args:
        scores: S.
        phrase: Probabilities of the whole phrase.
        name: Those of its name.
    """
    best = int(scores.argmax())
    sure = phrase[best] if name is None else torch.maximum(phrase[best], name[best])
    return (sure * (scores - scores[best]).exp()).clamp(0, 1)


def match_phrases(
    answers: WordMatches,
    looks: Callable[[], ThingLooks],
    vocabulary: Vocabulary,
    ask: Callable[[str], Float[Tensor, "k"]],
) -> tuple[Float[Tensor, "k words"], Float[Tensor, "k words"]]:
    """Scores and probabilities of phrases that say more than a name, and of words as they were.

    Args:
        answers: Of the phrases, each taken whole.
        looks: How things look; asked for if a phrase needs it.
        vocabulary: The words that are known.
        ask: Probabilities of a word.

    Returns:
        S, tau times the cosine for plain words, and p.
    """
    scores, sure = TEMPERATURE * answers.cosines, answers.probabilities.clone()
    asked: dict[str, Tensor | None] = {}
    names = vocabulary_names(vocabulary)  # "white board" is one, and is not taken apart

    def name(called: str) -> Tensor | None:
        if called not in asked:
            word = known_name(called, vocabulary)
            asked[called] = None if word is None else ask(word)
        return asked[called]

    for column, text in enumerate(answers.words):
        phrase = parse_phrase(text)
        if text in names or not phrase.is_compound:
            continue
        found = phrase_scores(phrase, answers.cosines[:, column], looks(), name)
        scores[:, column] = found
        sure[:, column] = sureness(found, sure[:, column], name(phrase.called))
    return scores, sure
