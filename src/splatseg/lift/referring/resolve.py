r"""Which objects of a scene a referring expression means, and why.

Each part of a phrase grades all objects no, perhaps or yes (`geometry`): the name by its
probability, colours by their distance in CIELAB, relations by boxes. Parts are joined by minimum.
A relation holds where it does with any object that fits the landmark's own phrase, so that "the mug
left of the laptop" may name a landmark that only the two together tell apart (Haddock 1987). Orders
then compare what is left, with a margin.

Nothing is chosen silently: where more fit than the phrase speaks of, something fits perhaps,
or two readings differ, the answer is ambiguous and has all candidates.

References:
    Haddock, Incremental Interpretation and Combinatory Categorial Grammar (IJCAI 1987).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from splatseg.errors import InputError
from splatseg.lift.referring.geometry import (
    NO,
    PERHAPS,
    YES,
    Array,
    ObjectGeometry,
    Viewer,
)
from splatseg.lift.referring.grammar import Clause, NounPhrase, Order
from splatseg.lift.referring.orders import ranked_grades, ranking

Status = Literal["found", "ambiguous", "nothing"]

_COLOUR_YES, _COLOUR_NO = 15.0, 75.0
"""Delta E to a named colour, lightness halved: mean colours of small things are off by 30, and
of a bowl full of fruit by 67."""

_CONTRAST, _CONTRAST_MOST = 20.0, 45.0
"""Delta E by which the only thing of a colour is nearer to it than all others of its kind."""

_WEAK = 0.1
"""Probability of a name below which an object is no rival of the only one that surely has it."""

_LEAST_LEVELS = 2
"""Heights at which a shelf holds things, from which on it has an upper and a lower one."""

_LISTED = 8
"""Candidates that an explanation names."""

_VIEW_RELATIONS = ("left of", "right of", "in front of", "behind")
_VERTICAL = ("on", "in", "under", "above", "with")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NameMatch:
    """What objects answer to a name."""

    name: str
    """Of explanations."""

    grades: Array
    """(k,) no, perhaps or yes."""

    probabilities: Array
    """(k,) of the name."""

    colour: Array | None = None
    """(k,) distance in CIELAB to the colour that was said; None where none was."""

    unread: tuple[str, ...] = ()
    """Words before the name that nothing is known of."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Referent:
    """An object that a phrase means, or may mean."""

    thing: int
    probability: float
    """Of its name."""

    explanation: str
    """Which it is and why: "mug 4: left of laptop 2 from view front"."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Reference:
    """What a phrase means in a scene."""

    status: Status
    """found: `referents` are meant. ambiguous: these may be. nothing: nothing fits."""

    referents: tuple[Referent, ...]
    """The most probable first."""

    explanation: str
    """A sentence."""

    @property
    def things(self) -> tuple[int, ...]:
        """Their numbers; none where the phrase is ambiguous."""
        return tuple(one.thing for one in self.referents) if self.status == "found" else ()


@dataclass(slots=True)
class _Meant:
    """What is known of a noun phrase so far."""

    name: str
    grades: Array
    probabilities: Array
    reasons: dict[int, list[str]] = field(default_factory=dict[int, list[str]])
    doubtful: frozenset[int] = frozenset()
    """Objects that perhaps have the name."""

    failed: str = ""
    """Of what emptied it."""

    def fitting(self, least: float = PERHAPS) -> list[int]:
        return [int(at) for at in np.flatnonzero(self.grades >= least)]

    def because(self, thing: int, reason: str) -> None:
        self.reasons.setdefault(thing, []).append(reason)


class Resolver:
    """Resolves phrases in one scene.

    Args:
        geometry: Where its objects are.
        match: What objects answer to a name, colours included; "" is every object.
        colour: Distance of objects to a named colour, where the words are one.
        viewer: Who says left and right; None where the scene has no view.
    """

    def __init__(
        self,
        geometry: ObjectGeometry,
        match: Callable[[str], NameMatch],
        *,
        colour: Callable[[str], Array | None],
        viewer: Viewer | None,
    ) -> None:
        self._geometry, self._match, self._viewer = geometry, match, viewer
        self._colour = colour
        self._there = np.array([len(one) > 0 for one in geometry.points])

    def resolve(self, readings: Sequence[NounPhrase], text: str) -> Reference:
        """What a phrase means.

        Args:
            readings: Of the phrase, see `parse_referring`.
            text: The phrase, for sentences.

        Raises:
            InputError: If a relation needs to know where up is, or who looks, and nobody does, or
                nothing is known of a name.
        """
        answers = [self._answer(one, text) for one in readings]
        fitting = [one for one in answers if one.status != "nothing"]
        if not fitting:
            return answers[0]
        meant = {tuple(sorted(one.thing for one in answer.referents)) for answer in fitting}
        if len(meant) == 1 and all(one.status == "found" for one in fitting):
            return fitting[0]
        if len(fitting) == 1:
            return fitting[0]
        every: dict[int, Referent] = {}
        for answer in fitting:
            for one in answer.referents:
                every.setdefault(one.thing, one)
        return Reference(
            status="ambiguous",
            referents=tuple(every.values()),
            explanation=f"{text}: ambiguous, {len(fitting)} readings differ: "
            + _listed(list(every.values())),
        )

    def _answer(self, phrase: NounPhrase, text: str) -> Reference:
        """What one reading means."""
        meant = self._meant(phrase)
        sure, all_of_them = meant.fitting(YES), meant.fitting()
        if phrase.quantity == "one" and len(sure) == 1:
            # It speaks of one: what hardly has the name is not another.
            probable = meant.probabilities >= _WEAK
            all_of_them = [at for at in all_of_them if probable[at] or at in sure]
        referents = [self._referent(meant, at) for at in all_of_them]
        referents.sort(key=lambda one: (-round(one.probability, 2), one.thing))
        if not all_of_them:
            count = "0" if phrase.quantity == "count" else "nothing"
            return Reference(
                status="nothing", referents=(), explanation=f"{text}: {count}, {meant.failed}"
            )
        wanted = phrase.number or (1 if phrase.quantity == "one" else None)
        certain = len(sure) == len(all_of_them)
        if certain and wanted in (None, len(sure)):
            count = f"{len(sure)}: " if phrase.quantity == "count" else ""
            return Reference(
                status="found",
                referents=tuple(referents),
                explanation=f"{text}: {count}{_listed(referents)}",
            )
        if wanted is not None and len(all_of_them) < wanted:
            return Reference(
                status="nothing",
                referents=(),
                explanation=f"{text}: nothing, expected {wanted}, found {len(all_of_them)}: "
                + _listed(referents),
            )
        doubtful = "" if certain else ", some of them uncertain"
        count = f"{len(referents)} candidates"
        if len(referents) == 1:
            count, doubtful = "1 candidate", ", which is uncertain"
        return Reference(
            status="ambiguous",
            referents=tuple(referents),
            explanation=f"{text}: ambiguous, {count}{doubtful}: {_listed(referents)}",
        )

    def _referent(self, meant: _Meant, at: int) -> Referent:
        reasons = ", ".join(meant.reasons.get(at, ()))
        label = f"{'perhaps ' if at in meant.doubtful else ''}{meant.name} {at}"
        return Referent(
            thing=at,
            probability=round(float(meant.probabilities[at]), 6),
            explanation=f"{label}: {reasons}" if reasons else label,
        )

    # Noun phrases

    def _meant(self, phrase: NounPhrase, *, holds: bool = False) -> _Meant:
        """Grades of all objects, clause by clause, and then by the order.

        Args:
            phrase: The noun phrase.
            holds: Whether the target is on it or in it: its order may be a level then.
        """
        meant = self._named(phrase)
        for clause in phrase.clauses:
            self._restrict(meant, clause)
        self._contrast(phrase, meant)
        for order in phrase.orders:
            if not (holds and _level_of(phrase) and self._has_levels(meant)):
                self._ordered(meant, order, phrase.number or 1)
        return meant

    def _named(self, phrase: NounPhrase) -> _Meant:
        found = self._match(phrase.noun)
        grades = np.where(self._there, found.grades, NO)
        meant = _Meant(
            name=found.name,
            grades=grades,
            probabilities=found.probabilities,
            doubtful=frozenset(np.flatnonzero(grades == PERHAPS).tolist()),
        )
        if not meant.fitting():
            meant.failed = f"no {found.name} is in the scene"
        if found.unread and meant.fitting():
            said = " ".join(found.unread)
            for at in meant.fitting():
                meant.because(at, f"{said!r} is not known")
            meant.grades = np.minimum(meant.grades, PERHAPS)
        return meant

    def _contrast(self, phrase: NounPhrase, meant: _Meant) -> None:
        """Colours: as they are, or, of one thing, nearer to the colour than all others."""
        distances = self._match(phrase.noun).colour
        if distances is None:
            return
        one = phrase.quantity == "one"
        self._coloured(meant, distances, phrase.noun, negated=False, one=one)

    def _coloured(
        self, meant: _Meant, distances: Array, said: str, *, negated: bool, one: bool
    ) -> None:
        fitting = meant.fitting()
        if not fitting:
            return
        yes = distances <= _COLOUR_YES
        grades = np.where(yes, YES, np.where(distances > _COLOUR_NO, NO, PERHAPS))
        if one and not negated and len(fitting) > 1:
            order = sorted(fitting, key=lambda at: float(distances[at]))
            first, second = float(distances[order[0]]), float(distances[order[1]])
            if first <= _CONTRAST_MOST and second - first >= _CONTRAST:
                grades = np.full(len(distances), NO)
                grades[order[0]] = YES
        self._join(meant, 1 - grades if negated else grades, f"no {meant.name} is so coloured")

    def _join(self, meant: _Meant, grades: Array, failed: str) -> None:
        before = len(meant.fitting())
        meant.grades = np.minimum(meant.grades, grades)
        if before and not meant.fitting():
            meant.failed = f"{failed} ({before} looked at)"

    # Clauses

    def _restrict(self, meant: _Meant, clause: Clause) -> None:
        if not meant.fitting():
            return
        if clause.attribute:
            distances = self._colour(clause.attribute)
            if distances is None:
                raise InputError(
                    f"words: expected a colour after {clause.words!r}, got {clause.attribute!r}."
                )
            self._coloured(meant, distances, clause.attribute, negated=clause.negated, one=False)
            for at in meant.fitting():
                meant.because(at, f"{'not ' if clause.negated else ''}{clause.attribute}")
            return
        holds = clause.relation in ("on", "in")
        landmarks = [self._meant(one, holds=holds) for one in clause.landmarks]
        level = _level_of(clause.landmarks[0]) if holds else None
        if level is not None and not self._has_levels(landmarks[0]):
            level = None
        for landmark in landmarks:
            if landmark.fitting():
                continue
            if clause.negated and not any(one.definite for one in clause.landmarks):
                return  # "not on a desk", where none is; "the desk" should be there
            meant.grades = np.full_like(meant.grades, NO)
            meant.failed = landmark.failed or f"no {landmark.name} is in the scene"
            return
        if clause.relation is None:
            self._join(meant, 1 - landmarks[0].grades, f"every {meant.name} is excepted")
            return
        self._check(clause)
        grades = np.full(len(meant.grades), NO)
        for target in meant.fitting():
            best, witness = NO, ""
            for pair in self._witnesses(clause, landmarks, target):
                certain = min(float(one.grades[at]) for one, at in pair)
                grade = min(certain, self._related(clause, target, [at for _, at in pair], level))
                if grade > best:
                    best = grade
                    witness = " and ".join(f"{one.name} {at}" for one, at in pair)
            grades[target] = 1 - best if clause.negated else best
            if grades[target] > NO:
                meant.because(target, self._because(clause, witness, float(grades[target])))
        landmark = " and ".join(one.name for one in landmarks)
        said = f"{'not ' if clause.negated else ''}{clause.words}"
        if len(clause.landmarks) == 1:
            only = landmarks[0].fitting()
            landmark += f" {only[0]}" if len(only) == 1 else ""
        self._join(meant, grades, f"no {meant.name} is {said} {landmark}{self._from(clause)}")

    def _because(self, clause: Clause, witness: str, grade: float) -> str:
        sure = "" if grade == YES else "perhaps "
        if clause.negated:
            kinds = " and ".join(one.noun or "thing" for one in clause.landmarks)
            said = f"not {clause.words} any {kinds}"
            said = said.replace("not without any", "with a").replace("not with any", "without")
            return f"{sure}{said}{self._from(clause)}"
        return f"{sure}{clause.words} {witness}{self._from(clause)}"

    def _from(self, clause: Clause) -> str:
        if clause.relation in _VIEW_RELATIONS and self._viewer is not None:
            return f" from view {self._viewer.name}"
        return ""

    def _check(self, clause: Clause) -> None:
        if clause.relation in _VERTICAL and not self._geometry.has_up:
            raise InputError(
                f"words: {clause.words!r} needs to know where up is, and the scene does not say; "
                "set it with `splatseg import --up`."
            )
        if clause.relation in _VIEW_RELATIONS:
            self._seen_by(clause.words)

    def _seen_by(self, said: str) -> Viewer:
        if self._viewer is None:
            raise InputError(f"words: {said!r} needs a view to look from, the scene has none.")
        return self._viewer

    def _witnesses(
        self, clause: Clause, landmarks: list[_Meant], target: int
    ) -> list[tuple[tuple[_Meant, int], ...]]:
        """Landmarks that a relation may be to, the target itself left out, the nearest first."""
        first = [at for at in landmarks[0].fitting() if at != target]
        if clause.relation != "between":
            first.sort(key=lambda at: self._distance(target, at))
            return [((landmarks[0], at),) for at in first]
        second_of = landmarks[-1]
        second = [at for at in second_of.fitting() if at != target]
        if len(landmarks) == 1:
            return [((landmarks[0], a), (landmarks[0], b)) for a in first for b in second if a < b]
        return [((landmarks[0], a), (second_of, b)) for a in first for b in second if a != b]

    def _distance(self, first: int, second: int) -> float:
        centre = self._geometry.centre
        return float(np.linalg.norm(centre[first] - centre[second]))

    def _related(
        self, clause: Clause, target: int, landmarks: Sequence[int], level: Order | None
    ) -> float:
        geometry, relation, landmark = self._geometry, clause.relation, landmarks[0]
        if relation in _VIEW_RELATIONS:
            viewer = self._seen_by(clause.words)
            return geometry.beside(target, landmark, viewer, relation)
        if relation == "on" or relation == "in":
            held = geometry.on if relation == "on" else geometry.inside
            grade = held(target, landmark)
            if relation == "in" and grade == NO and geometry.on(target, landmark) > NO:
                grade = PERHAPS  # a flat bowl holds what stands on it
            return grade if level is None else min(grade, self._on_level(level, target, landmark))
        if relation == "with":
            turned = Clause(words=clause.words, relation=clause.within, landmarks=clause.landmarks)
            return self._plain(turned, landmark, target)
        if relation == "between":
            return geometry.between(target, landmarks[0], landmarks[1])
        return self._plain(clause, target, landmark)

    def _plain(self, clause: Clause, target: int, landmark: int) -> float:
        geometry = self._geometry
        held = {
            "on": geometry.on, "in": geometry.inside, "under": geometry.under,
            "above": geometry.above, "near": geometry.near,
        }[clause.relation or "near"]  # fmt: skip
        return held(target, landmark)

    def _on_level(self, level: Order, target: int, shelf: int) -> float:
        """Whether a target stands on the level that "the upper shelf" says, of a shelf."""
        levels = self._geometry.levels(shelf)
        if len(levels) < _LEAST_LEVELS:
            return NO
        on = self._geometry.on
        sure = [any(on(at, shelf) == YES for at in one) for one in levels]
        if level.key == "middle":
            chosen = levels[len(levels) // 2] if len(levels) % 2 else []
            return (YES if all(sure) else PERHAPS) if target in chosen else NO
        for at in reversed(range(len(levels))) if level.descending else range(len(levels)):
            if sure[at]:
                # Below it may be one of things that are perhaps on it.
                first = at == (len(levels) - 1 if level.descending else 0)
                return (YES if first else PERHAPS) if target in levels[at] else NO
            if target in levels[at]:
                return PERHAPS
        return NO

    def _has_levels(self, meant: _Meant) -> bool:
        """Whether upper and lower are levels of a shelf, not several shelves over each other."""
        rows = meant.fitting()
        if not rows or not self._geometry.has_up:
            return False
        low, high = self._geometry.low[rows, 2], self._geometry.high[rows, 2]
        side_by_side = len(rows) == 1 or bool(low.max() < high.min())
        return side_by_side and any(len(self._geometry.levels(at)) >= _LEAST_LEVELS for at in rows)

    # Orders

    def _ordered(self, meant: _Meant, order: Order, count: int) -> None:
        """Keep the first so many by an order; those within the margin of the last are perhaps."""
        rows = meant.fitting()
        if not rows:
            return
        if order.rank < 0:
            raise InputError(
                f"words: expected a side to count from after {order.words!r}, such as 'from the "
                "left', or a size, such as 'second largest', got none."
            )
        landmark = None
        if order.landmark is not None:
            landmark = self._meant(order.landmark)
            if not landmark.fitting():
                meant.grades = np.full_like(meant.grades, NO)
                meant.failed = landmark.failed
                return
        ranked = ranking(
            self._geometry,
            order,
            rows,
            viewer=self._seen_by,
            landmarks=() if landmark is None else landmark.fitting(),
            landmark="" if landmark is None else landmark.name,
            certain=landmark is None or bool(landmark.fitting(YES)),
        )
        grades = np.full(len(meant.grades), NO)
        grades[rows] = ranked_grades(ranked, order, count, meant.grades[rows])
        for at in np.flatnonzero(grades):
            meant.because(int(at), ranked.reason)
        self._join(meant, grades, f"no {meant.name} is {order.words}")


def _level_of_order(order: Order) -> bool:
    return order.words in ("upper", "top", "lower", "bottom", "middle") and not order.stands_out


def _level_of(phrase: NounPhrase) -> Order | None:
    """The order that may be a level of a shelf."""
    return next((one for one in phrase.orders if _level_of_order(one)), None)


def _listed(referents: Sequence[Referent]) -> str:
    shown = "; ".join(one.explanation for one in referents[:_LISTED])
    more = len(referents) - _LISTED
    return shown + (f"; and {more} more" if more > 0 else "")
