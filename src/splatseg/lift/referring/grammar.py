r"""The grammar of referring expressions: "the red mug left of the laptop on the desk".

A referring expression names a target by what it is called and by where it is with respect to
landmarks. The phrase becomes a tree of noun phrases:

    phrase     := [how many | all | both | ...] noun phrase
    noun phrase:= determiner? (number | order | position | negated colour)* words clause*
    clause     := (that is | which are | and | ,)? not? relation noun phrase
                | (that is | which are) not? colour
                | nearest | farthest from | on the left | ... (orders that follow the noun)
                | except | but not noun phrase
    relation   := left of | right of | in front of | behind | on | in | under | above | near
                | between (noun phrase and noun phrase) | with

Words that are none of these stay in the name, for whatever answers names. A clause may belong to
any noun before it: "the mug near the book on the desk" has two readings, and `parse_referring`
gives all of them, those where clauses belong to the nearest noun first.

References:
    Achlioptas et al., ReferIt3D (2020), section 3.1, for the relations: horizontal proximity,
    vertical proximity, between, support, and those that depend on the view.
    Chen et al., ScanRefer (2020).
"""

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

from splatseg.errors import InputError

Relation = Literal[
    "left of", "right of", "in front of", "behind", "on", "in", "under", "above", "near",
    "between", "with",
]  # fmt: skip
OrderKey = Literal["size", "height", "elevation", "lateral", "depth", "middle", "distance"]
Quantity = Literal["one", "all", "count"]

_RELATIONS: dict[str, Relation] = {
    "left of": "left of", "to the left of": "left of", "on the left of": "left of",
    "on the left side of": "left of", "to the left side of": "left of",
    "right of": "right of", "to the right of": "right of", "on the right of": "right of",
    "on the right side of": "right of", "to the right side of": "right of",
    "in front of": "in front of", "before": "in front of", "behind": "behind",
    "in back of": "behind", "on": "on", "on top of": "on", "upon": "on", "atop": "on",
    "in": "in", "inside": "in", "inside of": "in", "within": "in", "under": "under",
    "underneath": "under", "below": "under", "beneath": "under", "above": "above", "over": "above",
    "near": "near", "near to": "near", "close to": "near", "next to": "near", "beside": "near",
    "adjacent to": "near", "by": "near", "at": "near", "between": "between",
    "in between": "between", "with": "with",
}  # fmt: skip
"""The phrases of each relation."""

_ORDERS: dict[str, tuple[OrderKey, bool]] = {
    "largest": ("size", True), "biggest": ("size", True), "smallest": ("size", False),
    "tallest": ("height", True), "shortest": ("height", False),
    "highest": ("elevation", True), "topmost": ("elevation", True), "lowest": ("elevation", False),
    "leftmost": ("lateral", False), "rightmost": ("lateral", True),
    "nearest": ("depth", False), "closest": ("depth", False), "farthest": ("depth", True),
    "furthest": ("depth", True),
}  # fmt: skip
"""Superlatives: what is compared, and whether the largest comes first. Without a landmark nearest
is nearest to the viewer."""

_POSITIONS: dict[str, tuple[OrderKey, bool]] = {
    "upper": ("elevation", True), "top": ("elevation", True), "lower": ("elevation", False),
    "bottom": ("elevation", False), "left": ("lateral", False), "right": ("lateral", True),
    "front": ("depth", False), "back": ("depth", True), "rear": ("depth", True),
    "middle": ("middle", False), "central": ("middle", False),
}  # fmt: skip
"""Positions before a noun, "the left mug", and after "from the", "on the", "at the", "in the"."""

_SIZES: dict[str, tuple[OrderKey, bool]] = {
    "large": ("size", True), "big": ("size", True), "small": ("size", False),
    "little": ("size", False), "tall": ("height", True), "short": ("height", False),
}  # fmt: skip
"""Sizes before a noun: the one that stands out, with a wider margin (`Order.stands_out`)."""

_ORDINALS = {word: at for at, word in enumerate(
    ("first", "second", "third", "fourth", "fifth", "sixth", "seventh", "eighth", "ninth",
     "tenth"), start=1)} | {"1st": 1, "2nd": 2, "3rd": 3}  # fmt: skip
_NUMBERS = {word: at for at, word in enumerate(
    ("one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten", "eleven",
     "twelve"), start=1)}  # fmt: skip
_ARTICLES = ("the", "a", "an", "some", "my", "your", "this", "that", "these", "those")
_ALL = ("all the", "all of the", "all", "every", "each")
_COUNTS = ("how many", "the number of", "number of", "count the", "count")
_ANYTHING = ("thing", "object", "item", "something", "anything", "everything", "one")
"""Nouns that every object answers to."""

_COPULAS = ("is", "are", "stands", "stand", "lies", "lie", "sits", "sit", "hangs", "hang")
_PARTICIPLES = ("standing", "lying", "sitting", "hanging", "placed", "located")
_EXCEPT = ("except for", "except", "other than", "apart from", "but not")
_PLURALS = {
    "shelves": "shelf", "bookshelves": "bookshelf", "knives": "knife", "mice": "mouse",
    "dice": "die", "people": "person", "men": "man", "women": "woman", "children": "child",
    "feet": "foot", "leaves": "leaf", "loaves": "loaf", "cacti": "cactus", "cactuses": "cactus",
    "buses": "bus", "ones": "one",
}  # fmt: skip
_NO_PLURALS = (
    "glasses", "scissors", "headphones", "blinds", "stairs", "pants", "trousers", "jeans",
    "binoculars", "pliers", "tongs",
)  # fmt: skip
"""End in s, and are one thing."""

_KEYWORDS = frozenset(
    word
    for phrase in (*_RELATIONS, *_EXCEPT, "nearest", "closest", "farthest", "furthest", "from",
                   "and", "but", "or", "nor", "that", "which", "who", "not", "without", "of", "to",
                   "than", "the", *_COPULAS, *_PARTICIPLES)
    for word in phrase.split()[:1]
)  # fmt: skip
"""Words that end a name."""

_TWO = 2
"""Things that something is between."""

_MAX_RELATIONS = 5
"""More give so many readings that nobody means one of them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Order:
    """What is picked out of several by an order: "largest", "second from the left"."""

    words: str
    """As it was said."""

    key: OrderKey
    """What is compared; `distance` is that from a landmark."""

    descending: bool = False
    """Whether the largest value comes first."""

    rank: int = 1
    """From the first, 1, on; below 0 where no side to count from was said."""

    landmark: "NounPhrase | None" = None
    """Of `distance`."""

    stands_out: bool = False
    """Said as "large", not as "largest": it must stand out."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Clause:
    """What the target must fulfil: a relation with landmarks, a colour, or not to be another."""

    words: str
    """As it was said, without its landmarks: "left of"."""

    relation: Relation | None = None
    """None for attributes and exceptions."""

    landmarks: "tuple[NounPhrase, ...]" = ()
    """One; of `between` two, or one of two things."""

    attribute: str = ""
    """Words of a colour: "dark red"."""

    negated: bool = False
    within: Relation = "on"
    """How the landmark of `with` is related to the target: "desk with a mug on it"."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NounPhrase:
    """A target, or a landmark."""

    noun: str
    """What it is called, in the singular, colours included: "light brown mug". Empty: anything."""

    plural: bool = False
    quantity: Quantity = "one"
    """How many are meant: one, all of them, or all of them with their number."""

    number: int | None = None
    """Exactly so many."""

    orders: tuple[Order, ...] = ()
    """At most one, of what fulfils the clauses; with a number the first so many."""

    clauses: tuple[Clause, ...] = ()
    definite: bool = False
    """Whether it was said with "the"."""

    @property
    def is_plain(self) -> bool:
        """Whether it is a name, and nothing is to be found out by relations, orders or numbers."""
        return (
            not self.clauses
            and not self.orders
            and self.number is None
            and self.quantity != "count"
        )


def singular(word: str) -> tuple[str, bool]:
    """The singular of a noun, and whether it was a plural.

    Example:
        >>> singular("mugs"), singular("glass"), singular("shelves"), singular("boxes")
        (('mug', True), ('glass', False), ('shelf', True), ('box', True))
    """
    if word in _PLURALS:
        return _PLURALS[word], True
    if word in _NO_PLURALS or len(word) < 4 or not word.endswith("s"):
        return word, False
    if word.endswith(("ss", "us", "is")):
        return word, False
    if word.endswith(("ches", "shes", "xes", "sses")):
        return word[:-2], True
    if word.endswith("ies"):
        return word[:-3] + "y", True
    return word[:-1], True


def parse_referring(
    text: str, *, is_name: Callable[[str], bool] | None = None
) -> tuple[NounPhrase, ...]:
    """The readings of a phrase, those whose clauses belong to the nearest noun first.

    Args:
        text: The phrase; articles, capitals and marks at its end do not count.
        is_name: Whether words are a name as they stand, such as "top hat" or "books".

    Raises:
        InputError: If it does not follow the grammar, or has more than five relations.

    Example:
        >>> (one,) = parse_referring("the mugs not on the desk")
        >>> one.noun, one.plural, one.clauses[0].relation, one.clauses[0].negated
        ('mug', True, 'on', True)
    """
    words = _tokens(text)
    parser = _Parser(words, is_name or (lambda words: False))
    if sum(word in ("and", "with") or word in _RELATIONS for word in words) > 2 * _MAX_RELATIONS:
        raise InputError(f"words: expected at most {_MAX_RELATIONS} relations, got {text!r}.")
    found: list[NounPhrase] = []
    for phrase, at in parser.phrase():
        if at == len(words) and phrase not in found:
            found.append(phrase)
    if not found:
        rest = " ".join(words[parser.furthest :]) or "its end"
        raise InputError(
            f"words: expected a name with relations, orders and counts (docs/selecting.md), got "
            f"{text!r}, which is not understood at {rest!r}."
        )
    return tuple(found)


def _tokens(text: str) -> tuple[str, ...]:
    said = re.sub(r"\s*\(\d+\)", "", text.lower().strip().rstrip(".?!"))
    said = re.sub(r"\bnon-", "non ", said.replace(",", " , ").replace("n't ", " not "))
    return tuple(said.split())


class _Parser:
    """Recursive descent with backtracking: each rule yields what it can be, and where it ends."""

    def __init__(self, words: Sequence[str], is_name: Callable[[str], bool]) -> None:
        self._words, self._is_name = words, is_name
        self.furthest = 0

    def phrase(self) -> Iterator[tuple[NounPhrase, int]]:
        """A whole phrase."""
        quantities: tuple[tuple[Sequence[str], Quantity], ...] = ((_COUNTS, "count"), (_ALL, "all"))
        for phrases, quantity in quantities:
            end = self._one_of(0, phrases)
            if end is not None:
                for found, stop in self._noun_phrase(end):
                    # "how many mugs are there"
                    stop = self._after(stop, "are", "there") or stop
                    yield replace(found, quantity=quantity, plural=True), stop
                return
        yield from self._noun_phrase(0)

    def _word(self, at: int) -> str:
        self.furthest = max(self.furthest, min(at, len(self._words)))
        return self._words[at] if at < len(self._words) else ""

    def _after(self, at: int, *words: str) -> int | None:
        """Where words end that stand here."""
        end = at + len(words)
        return end if tuple(self._words[at:end]) == words else None

    def _one_of(self, at: int, phrases: Sequence[str]) -> int | None:
        """Where the longest of some phrases ends that stands here."""
        ends = (self._after(at, *phrase.split()) for phrase in phrases)
        return max((end for end in ends if end is not None), default=None)

    def _relation(self, at: int) -> tuple[Relation, str, int] | None:
        if (end := self._one_of(at, tuple(_RELATIONS))) is None:
            return None
        said = " ".join(self._words[at:end])
        return _RELATIONS[said], said, end

    def _noun_phrase(self, at: int) -> Iterator[tuple[NounPhrase, int]]:
        if (core := self._core(at)) is not None:
            yield from self._with_clauses(*core)

    def _core(self, at: int) -> tuple[NounPhrase, int] | None:
        """What stands up to the noun, and the noun."""
        definite, number, rank = False, None, None
        orders: list[Order] = []
        clauses: list[Clause] = []
        if self._word(at) in _ARTICLES:
            definite, at = self._word(at) == "the", at + 1
        if (both := self._after(at, "both")) is not None:
            number, at = _TWO, self._after(both, "the") or both
        while not self._is_name(" ".join(self._name(at))):  # "top hat"
            word = self._word(at)
            if word in ("not", "non") and self._word(at + 1):
                size = 2 if self._word(at + 1) in ("light", "dark", "pale") else 1
                colour = " ".join(self._words[at + 1 : at + 1 + size])
                clauses.append(Clause(words="not", attribute=colour, negated=True))
                at += 1 + size
                continue
            if word in _ORDINALS and rank is None:
                rank = _ORDINALS[word]
            elif (word in _NUMBERS or word.isdecimal()) and number is None and self._name(at + 1):
                number = _NUMBERS.get(word) or int(word)
            elif word in _ORDERS and (self._name(at + 1) or self._after(at + 1, "of")):
                key, descending = _ORDERS[word]
                said = word if rank is None else f"{_ordinal(rank)} {word}"
                orders.append(Order(words=said, key=key, descending=descending, rank=rank or 1))
                rank = None
            elif word in (_POSITIONS | _SIZES) and rank is None and self._name(at + 1):
                key, descending = (_POSITIONS | _SIZES)[word]
                orders.append(
                    Order(words=word, key=key, descending=descending, stands_out=word in _SIZES)
                )
            else:
                break
            at += 1
        among = bool(orders) and self._word(at) == "of"
        if among:  # "the largest of the mugs" is one
            at = at + 1 + (self._word(at + 1) in _ARTICLES)
        noun = self._name(at)
        said = " ".join(noun)
        if not noun or (said in (*_POSITIONS, "it", "them") and not self._is_name(said)):
            return None
        at += len(noun)
        if rank is not None:
            orders.append(Order(words=_ordinal(rank), key="lateral", rank=-rank))
        if len(orders) > 1:
            return None
        called, plural = self._called(noun)
        plural = (plural and not among) or (number or 1) > 1
        made = NounPhrase(
            noun=called,
            plural=plural,
            quantity="all" if plural else "one",
            number=number,
            orders=tuple(orders),
            clauses=tuple(clauses),
            definite=definite,
        )
        return made, at

    def _name(self, at: int) -> tuple[str, ...]:
        """Words up to the next that ends a name; the first may be one itself: "the stand"."""
        end = at + self._is_name(self._word(at))
        while end < len(self._words) and self._words[end] not in (*_KEYWORDS, ","):
            end += 1
        self._word(end)
        return tuple(self._words[at:end])

    def _called(self, noun: tuple[str, ...]) -> tuple[str, bool]:
        """The name in the singular, and whether it is a plural."""
        said = " ".join(noun)
        last, plural = singular(noun[-1])
        if plural:
            # Of "cactuses" and "vases" only the names know which end is the plural's.
            ends = (last, noun[-1][:-1], noun[-1][:-2])
            known = (end for end in ends if self._is_known_end((*noun[:-1], end)))
            last = next(known, last)
        one = " ".join((*noun[:-1], last))
        if self._is_name(said) and not (plural and self._is_name(one)):
            return said, False
        if last in _ANYTHING:
            return " ".join(noun[:-1]), plural or last == "everything"
        return one, plural

    def _is_known_end(self, noun: tuple[str, ...]) -> bool:
        """Whether a noun ends in a name."""
        return any(self._is_name(" ".join(noun[at:])) for at in range(len(noun)))

    def _with_clauses(self, phrase: NounPhrase, at: int) -> Iterator[tuple[NounPhrase, int]]:
        """The phrase with as many of the clauses that follow as it takes, the most first."""
        for clause, end in self._clause(at, bool(phrase.clauses)):
            if isinstance(clause, Clause):
                grown = replace(phrase, clauses=(*phrase.clauses, clause))
            else:
                grown = _ordered(phrase, clause)
                if grown is None:
                    continue
            yield from self._with_clauses(grown, end)
        yield phrase, at

    def _clause(self, at: int, has_clause: bool) -> Iterator[tuple[Clause | Order, int]]:
        if (excepted := self._one_of(at, _EXCEPT)) is not None:
            said = " ".join(self._words[at:excepted])
            for landmark, end in self._noun_phrase(excepted):
                yield Clause(words=said, landmarks=(landmark,), negated=True), end
        if self._word(at) in ("and", "but", ",") and has_clause:
            at = self._after(at, ",", "and") or at + 1
        linked = at
        if self._word(at) in ("that", "which", "who"):
            at += 1
        copula = self._word(at) in _COPULAS
        at += copula
        at += copula and self._word(at) == "there"
        negated = self._word(at) == "not"
        at += negated
        if self._word(at) == "without":
            yield from self._related("with", "without", at + 1, negated=not negated)
            return
        if self._word(at) in _PARTICIPLES:
            at += 1
        yield from self._order_after(at, negated)
        found = self._relation(at)
        if found is not None:
            relation, said, end = found
            yield from self._related(relation, said, end, negated=negated)
        elif (copula or negated) and at > linked:
            colour = " ".join(self._name(at))
            if colour:
                said = "not" if negated else "is"
                clause = Clause(words=said, attribute=colour, negated=negated)
                yield clause, at + len(colour.split())

    def _related(
        self, relation: Relation, said: str, at: int, *, negated: bool
    ) -> Iterator[tuple[Clause, int]]:
        for landmark, end in self._noun_phrase(at):
            clause = Clause(words=said, relation=relation, landmarks=(landmark,), negated=negated)
            if relation == "with":
                place = self._relation(end)
                if place is not None and self._word(place[2]) in ("it", "them"):
                    yield replace(clause, within=place[0]), place[2] + 1
                    continue
                yield clause, end
            elif relation == "between":
                if landmark.number == _TWO or (landmark.plural and landmark.number is None):
                    yield clause, end
                if self._word(end) == "and":
                    for second, stop in self._noun_phrase(end + 1):
                        yield replace(clause, landmarks=(landmark, second)), stop
            elif (landmark.number or 1) == 1:  # "near two chairs" says more than near a chair
                yield clause, end

    def _order_after(self, at: int, negated: bool) -> Iterator[tuple[Order, int]]:
        """Orders that follow the noun: "nearest the window", "from the left", "on the left"."""
        if negated:
            return
        word = self._word(at)
        if word in ("nearest", "closest", "farthest", "furthest"):
            end = self._after(at + 1, "away", "from")
            end = end or at + 1 + (self._word(at + 1) in ("to", "from"))
            descending = word in ("farthest", "furthest")
            for landmark, stop in self._noun_phrase(end):
                order = Order(words=word, key="distance", descending=descending, landmark=landmark)
                yield order, stop
        if word in ("to", "from"):
            # "the nearest chair to the window": completed by what stood before the noun.
            for landmark, stop in self._noun_phrase(at + 1):
                yield Order(words="", key="distance", landmark=landmark), stop
        if word in ("from", "on", "at", "in", "to") and self._word(at + 1) == "the":
            side = self._word(at + 2)
            ends_here = self._word(at + 3) not in ("of", "side") and not self._name(at + 3)
            if side in _POSITIONS and ends_here:
                key, descending = _POSITIONS[side]
                yield Order(words=f"{word} the {side}", key=key, descending=descending), at + 3


def _ordinal(rank: int) -> str:
    return next(word for word, at in _ORDINALS.items() if at == rank)


def _ordered(phrase: NounPhrase, order: Order) -> NounPhrase | None:
    """A phrase with an order that follows its noun; None where it does not go with it."""
    before = phrase.orders[-1] if phrase.orders else None
    waiting = before is not None and before.rank < 0
    if order.words == "":
        # "to" and "from" complete "nearest" and "farthest" only.
        if before is None or before.key != "depth" or before.words.split()[-1] not in _ORDERS:
            return None
        return replace(phrase, orders=(replace(before, key="distance", landmark=order.landmark),))
    counts = order.words.startswith("from")
    if before is None:
        # "second from the left" counts; "from the left" alone says nothing.
        return None if counts else replace(phrase, orders=(order,))
    if not waiting or order.key == "middle" or not (counts or order.key == "distance"):
        return None
    joined = replace(order, words=f"{before.words} {order.words}", rank=-before.rank)
    return replace(phrase, orders=(joined,))
