"""Referring expressions asked of a scene, with truth from its exact surface points.

    python benchmarks/referring.py SCENE ../shared/data/office

SCENE has the layers `things` (`splatseg segment SCENE --method uplift --evidence instance --layer
things`: true instances) and `objects` (`splatseg query SCENE wall --masks masks_sam`). Phrases are
drawn from templates, and kept where the truth of every object of the named kinds is clear by a
margin, by rules on surface points of `surface_points.npz` and parents of `metadata.json` that
share no code with the resolver. Some speak of several things as of one, or of none. Rows:

- `true`: the resolver on true instances and true names of classes: grammar and geometry alone.
- `query`: what `splatseg query` answers, by recorded features and masks; an object counts as the
  instance that most of its pixels show.

Shares of the phrases: right (found all that is meant and no more, or said that several or none
are); wrong silently (found something else); ambiguous said, and nothing said, where one is meant.
"""

import json
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scored import run_rows
from word_scene import WordScene

from splatseg.core import Labels
from splatseg.lift.phrases import thing_looks
from splatseg.lift.referring import (
    ObjectNames,
    Reference,
    Resolver,
    object_geometry,
    parse_referring,
    viewer_of,
)

Truth = Literal["no", "unclear", "yes"]
Points = NDArray[np.float64]

SEED = 20_261_127
PER_KIND = 40
"""Phrases of a kind; kinds have fewer where the scene has fewer."""

_SHARE_OTHERS = 0.3
"""Of them at most that speak of one where several are, or of something where nothing is."""

_LEAST_PIXELS, _LEAST_POINTS = 500, 20
"""Of an instance in the train views, and of surface points: others nobody could tell."""

_COLOURS = (
    "black", "white", "grey", "red", "maroon", "orange", "brown", "tan", "yellow", "olive", "lime",
    "green", "teal", "turquoise", "blue", "navy", "purple", "lavender", "pink",
)  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class Asked:
    """A phrase and what it means."""

    kind: str
    text: str
    meant: frozenset[int]
    """Instances; several for one ("the mug") is ambiguous."""

    one: bool
    """Whether it speaks of one."""

    @property
    def expected(self) -> str:
        """What is right to say."""
        if not self.meant:
            return "nothing"
        return "ambiguous" if self.one and len(self.meant) > 1 else "found"


class TrueRoom:
    """True things, and relations between them that are clear by a margin."""

    def __init__(self, bench: WordScene) -> None:
        meta = json.loads((bench.data / "metadata.json").read_text())
        held = np.load(bench.data / "surface_points.npz")
        xyz, instance = held["xyz"].astype(np.float64), held["instance"]
        self.classes: list[dict[str, Any]] = meta["classes"]
        self.names: dict[int, str] = {}
        self.kind: dict[int, str] = {}
        self.parent: dict[int, int | None] = {}
        self.points: dict[int, Points] = {}
        self.kind_of_all = {one["id"]: one["class_name"] for one in meta["instances"]}
        for one in meta["instances"]:
            points = xyz[instance == one["id"]]
            if one["train_pixels"] < _LEAST_PIXELS or len(points) < _LEAST_POINTS:
                continue
            if one["isthing"]:
                self.names[one["id"]], self.kind[one["id"]] = one["name"], one["class_name"]
                self.parent[one["id"]] = one["parent"]
                self.points[one["id"]] = points[:: max(len(points) // 1500, 1)]
        # A kind one of which hardly anybody sees is not spoken of.
        hidden = {
            one["class_name"]
            for one in meta["instances"]
            if one["isthing"] and one["id"] not in self.kind
        }
        self.kinds = sorted({kind for kind in self.kind.values() if kind not in hidden})
        self.mean = {at: points.mean(axis=0) for at, points in self.points.items()}
        self.low = {at: points.min(axis=0) for at, points in self.points.items()}
        self.high = {at: points.max(axis=0) for at, points in self.points.items()}
        self.long = {at: float(np.linalg.norm(self.high[at] - self.low[at])) for at in self.points}
        camera = bench.scene.train_views[0].camera
        self.eye = camera.centre.double().numpy()
        self._trees = {at: KDTree(points) for at, points in self.points.items()}
        self._apart: dict[tuple[int, int], float] = {}

    def of(self, kind: str) -> list[int]:
        """All things of a kind."""
        return [at for at, one in self.kind.items() if one == kind]

    def apart(self, a: int, b: int) -> float:
        """Metres between surfaces."""
        key = (min(a, b), max(a, b))
        if key not in self._apart:
            self._apart[key] = float(self._trees[key[0]].query(self.points[key[1]])[0].min())
        return self._apart[key]

    def _carries(self, a: int, b: int) -> bool:
        return self.parent[a] == b or self.parent[b] == a

    def on(self, a: int, b: int) -> Truth:
        if self.parent[a] == b:
            return "yes"
        return "no" if self.apart(a, b) > 0.3 else "unclear"

    def near(self, a: int, b: int) -> Truth:
        apart, shorter = self.apart(a, b), min(self.long[a], self.long[b])
        if self._carries(a, b):
            return "unclear"
        if apart <= 0.25 * max(shorter, 0.2):
            return "yes"
        return "no" if apart > 1.5 * max(self.long[a], self.long[b]) else "unclear"

    def _over(self, a: int, b: int, grown: float = 0.0) -> bool:
        """Whether the middle of a footprint lies over that of the other, grown by metres."""
        inside = (self.mean[a] >= self.low[b] - grown) & (self.mean[a] <= self.high[b] + grown)
        return bool(inside[:2].all())

    def _apart_level(self, a: int, b: int) -> bool:
        gap = np.maximum(self.low[a] - self.high[b], self.low[b] - self.high[a])[:2]
        return bool((gap > 0.05).any())

    def above(self, a: int, b: int) -> Truth:
        if self._apart_level(a, b) or self.high[a][2] < self.low[b][2]:
            return "no"
        if self._carries(a, b):
            return "unclear"
        clear = self.low[a][2] >= self.high[b][2]
        return "yes" if clear and (self._over(a, b) or self._over(b, a)) else "unclear"

    def under(self, a: int, b: int) -> Truth:
        if self._apart_level(a, b) or self.low[a][2] > self.high[b][2]:
            return "no"
        return self.above(b, a) if not self._carries(a, b) else "unclear"

    def between(self, a: int, b: int, c: int) -> Truth:
        first, second = self.mean[b] - self.mean[a], self.mean[c] - self.mean[a]
        cosine = first @ second / np.linalg.norm(first) / np.linalg.norm(second)
        angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
        return "yes" if angle > 155 else "no" if angle < 95 else "unclear"

    def side(self, a: int, b: int, which: str) -> Truth:
        """By the angle on the ground, as seen by someone at the camera who looks at b."""
        look, step = (self.mean[b] - self.eye)[:2], (self.mean[a] - self.mean[b])[:2]
        angle = np.degrees(
            np.arctan2(look[0] * step[1] - look[1] * step[0], look @ step)
        )  # counter-clockwise from away: left is 90
        centre = {"left of": 90, "right of": -90, "in front of": 180, "behind": 0}[which]
        off = abs((angle - centre + 180) % 360 - 180)
        if off > 100:
            return "no"
        far = np.linalg.norm(step) > 0.6 * (self.long[a] + self.long[b])
        level = abs(self.mean[a][2] - self.mean[b][2]) < np.linalg.norm(step)
        return "yes" if off < 33 and far and level else "unclear"

    def colour(self, at: int) -> str | None:
        """The colour that its name says; None where that has a shade or none."""
        words = self.names[at].split(" on ")[0].split(" at ")[0].split()
        found = [word for word in words if word in _COLOURS]
        shaded = bool({"light", "dark"} & set(words))
        return found[0] if len(found) == 1 and not shaded else None

    def ordered(self, rows: Sequence[int]) -> list[int] | None:
        """From left to right, where no two are nearer than 5 degrees and none is far round."""
        middle = np.mean([self.mean[at] for at in rows], axis=0) - self.eye
        away = np.arctan2(middle[1], middle[0])
        bearing = {
            at: (away - np.arctan2(*(self.mean[at] - self.eye)[1::-1]) + np.pi) % (2 * np.pi)
            - np.pi
            for at in rows
        }
        if max(abs(one) for one in bearing.values()) > np.radians(65):
            return None
        found = sorted(rows, key=lambda at: bearing[at])
        steps = np.diff([bearing[at] for at in found])
        return found if len(steps) and steps.min() > np.radians(5) else None

    def first(self, rows: Sequence[int], *measures: Callable[[int], float]) -> int | None:
        """The one of the least value, by a fourth or more, in all measures."""
        winners: set[int] = set()
        for measure in measures:
            values = sorted((measure(at), at) for at in rows)
            if len(values) < 2 or values[1][0] < 1.25 * values[0][0]:
                return None
            winners.add(values[0][1])
        return winners.pop() if len(winners) == 1 else None


def _fitting(truths: dict[int, Truth]) -> frozenset[int] | None:
    """What fits; None where something is unclear."""
    if "unclear" in truths.values():
        return None
    return frozenset(at for at, one in truths.items() if one == "yes")


def _any(truths: Sequence[Truth]) -> Truth:
    return "yes" if "yes" in truths else "unclear" if "unclear" in truths else "no"


def _not(truth: Truth) -> Truth:
    return "no" if truth == "yes" else "yes" if truth == "no" else "unclear"


def _plural(name: str) -> str:
    if name.endswith(("x", "s", "ch", "sh")):
        return name + "es"
    return name[:-1] + "ves" if name.endswith("lf") else name + "s"


class Phrases:
    """Draws phrases of a room."""

    def __init__(self, room: TrueRoom) -> None:
        self.room = room

    def all(self) -> list[Asked]:
        """Some of each kind, in a fixed order."""
        found: list[Asked] = []
        made: dict[str, list[Asked]] = {}
        rules = (self.relations, self.negations, self.counts, self.betweens, self.nested,
                 self.conjunctions, self.nearest, self.superlatives, self.sides, self.levels,
                 self.colours, self.absent)  # fmt: skip
        for rule in rules:
            for one in rule():
                made.setdefault(one.kind, []).append(one)
        for kind in sorted(made):
            rng = np.random.default_rng([SEED, *kind.encode()])
            rows = sorted({one.text: one for one in made[kind]}.values(), key=lambda one: one.text)
            order = [rows[at] for at in rng.permutation(len(rows))]
            proper = [one for one in order if one.expected == "found"]
            others = [one for one in order if one.expected != "found"]
            most = round(_SHARE_OTHERS * PER_KIND) if proper else PER_KIND // 2
            by_kind = [one for pair in zip(
                [one for one in others if one.expected == "ambiguous"][:most],
                [one for one in others if one.expected == "nothing"][:most], strict=False,
            ) for one in pair]  # fmt: skip
            chosen = (by_kind or others)[:most]
            found += proper[: PER_KIND - len(chosen)] + chosen
        return found

    def _held(
        self, kind: str, landmark: str, relation: Callable[[int, int], Truth]
    ) -> dict[int, Truth]:
        """Of each thing of a kind, whether it is so related to any of another kind."""
        marks = self.room.of(landmark)
        return {
            at: _any([relation(at, mark) for mark in marks if mark != at])
            for at in self.room.of(kind)
        }

    def _relations(self) -> dict[str, Callable[[int, int], Truth]]:
        room = self.room
        named: dict[str, Callable[[int, int], Truth]] = {
            "on": room.on, "next to": room.near, "near": room.near, "above": room.above,
            "under": room.under,
        }  # fmt: skip
        for side in ("left of", "right of", "in front of", "behind"):
            named[side] = lambda a, b, side=side: room.side(a, b, side)
        return named

    def _pairs(self) -> Iterator[tuple[str, str]]:
        for kind, landmark in product(self.room.kinds, self.room.kinds):
            if kind != landmark:
                yield kind, landmark

    def relations(self) -> Iterator[Asked]:
        for (kind, landmark), (said, relation) in product(self._pairs(), self._relations().items()):
            meant = _fitting(self._held(kind, landmark, relation))
            if meant is None:
                continue
            row = {"next to": "near"}.get(said, said)
            yield Asked(kind=row, text=f"the {kind} {said} the {landmark}", meant=meant, one=True)
            if meant and len(meant) > 1:
                text = f"{_plural(kind)} {said} the {landmark}"
                yield Asked(kind=row, text=text, meant=meant, one=False)

    def negations(self) -> Iterator[Asked]:
        for kind, landmark in self._pairs():
            for said in ("on", "near", "left of"):
                held = self._held(kind, landmark, self._relations()[said])
                meant = _fitting({at: _not(one) for at, one in held.items()})
                if meant is None or len(held) < 2 or "yes" not in held.values():
                    continue
                name = kind if len(meant) == 1 else _plural(kind)
                link = "that is not" if len(meant) == 1 else "not"
                text = f"the {name} {link} {said} the {landmark}"
                yield Asked(kind="negation", text=text, meant=meant, one=len(meant) == 1)

    def counts(self) -> Iterator[Asked]:
        words = ("", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten")
        for kind in self.room.kinds:
            rows = frozenset(self.room.of(kind))
            text = f"how many {_plural(kind)}"
            yield Asked(kind="count", text=text, meant=rows, one=False)
            if 1 < len(rows) < len(words):
                text = f"the {words[len(rows)]} {_plural(kind)}"
                yield Asked(kind="count", text=text, meant=rows, one=False)
        for kind, landmark in self._pairs():
            for said in ("on", "near", "left of", "above"):
                meant = _fitting(self._held(kind, landmark, self._relations()[said]))
                if meant and 1 < len(meant) < len(words):
                    text = f"{words[len(meant)]} {_plural(kind)} {said} the {landmark}"
                    yield Asked(kind="count", text=text, meant=meant, one=False)
                    text = f"how many {_plural(kind)} are {said} the {landmark}"
                    yield Asked(kind="count", text=text, meant=meant, one=False)

    def betweens(self) -> Iterator[Asked]:
        single = [kind for kind in self.room.kinds if len(self.room.of(kind)) == 1]
        for kind in self.room.kinds:
            for a, b in product(single, single):
                if not (a < b) or kind in (a, b):
                    continue
                first, second = self.room.of(a)[0], self.room.of(b)[0]
                held = {at: self.room.between(at, first, second) for at in self.room.of(kind)}
                meant = _fitting(held)
                if meant is not None:
                    text = f"the {kind} between the {a} and the {b}"
                    yield Asked(kind="between", text=text, meant=meant, one=True)

    def nested(self) -> Iterator[Asked]:
        """A landmark told by what it is on; kept where the other reading means the same or none."""
        named = self._relations()
        for (kind, landmark), surface in product(self._pairs(), self.room.kinds):
            if surface in (kind, landmark) or len(self.room.of(landmark)) < 2:
                continue
            standing = self._held(landmark, surface, self.room.on)
            if "yes" not in standing.values() or "unclear" in standing.values():
                continue
            marks = [at for at, one in standing.items() if one == "yes"]
            for said in ("near", "left of", "right of"):
                held = {
                    at: _any([named[said](at, mark) for mark in marks if mark != at])
                    for at in self.room.of(kind)
                }
                low = _fitting(held)
                outer, stood = (
                    self._held(kind, landmark, named[said]),
                    self._held(kind, surface, self.room.on),
                )
                if low is None or "unclear" in (*outer.values(), *stood.values()):
                    continue
                high = {at for at in outer if outer[at] == stood[at] == "yes"}
                if len(low) == 1 and (not high or high == low):
                    text = f"the {kind} {said} the {landmark} on the {surface}"
                    yield Asked(kind="nested", text=text, meant=low, one=True)

    def conjunctions(self) -> Iterator[Asked]:
        named = self._relations()
        for (kind, first), second in product(self._pairs(), self.room.kinds):
            if second in (kind, first) or len(self.room.of(kind)) < 2:
                continue
            on = self._held(kind, first, self.room.on)
            if "yes" not in on.values():
                continue
            for said in ("near", "left of", "behind"):
                held = self._held(kind, second, named[said])
                joined: dict[int, Truth] = {}
                for at in on:
                    pair = (on[at], held[at])
                    joined[at] = "no" if "no" in pair else "unclear" if "unclear" in pair else "yes"
                meant = _fitting(joined)
                if meant is not None and len(meant) == 1:
                    text = f"the {kind} on the {first} and {said} the {second}"
                    yield Asked(kind="conjunction", text=text, meant=meant, one=True)

    def nearest(self) -> Iterator[Asked]:
        room = self.room
        for kind, landmark in self._pairs():
            rows, marks = room.of(kind), room.of(landmark)
            if len(rows) < 2 or len(marks) != 1:
                continue
            mark = marks[0]
            measures: tuple[Callable[[int], float], ...] = (
                lambda at, mark=mark: room.apart(at, mark) + 0.02,
                lambda at, mark=mark: float(np.linalg.norm(room.mean[at] - room.mean[mark])),
            )
            best = room.first(rows, *measures)
            if best is not None:
                text = f"the {kind} nearest the {landmark}"
                yield Asked(kind="nearest", text=text, meant=frozenset({best}), one=True)
            far = room.first(rows, *((lambda at, m=m: 1 / m(at)) for m in measures))
            if far is not None:
                text = f"the {kind} farthest from the {landmark}"
                yield Asked(kind="nearest", text=text, meant=frozenset({far}), one=True)

    def superlatives(self) -> Iterator[Asked]:
        room = self.room

        def height(at: int) -> float:
            return float(room.high[at][2] - room.low[at][2])

        def size(at: int) -> float:
            return float(np.sqrt(((room.points[at] - room.mean[at]) ** 2).sum(axis=1).mean()))

        for kind in room.kinds:
            rows = room.of(kind)
            if len(rows) < 2:
                continue
            for said, measures in {
                "largest": (lambda at: 1 / room.long[at], lambda at: 1 / size(at)),
                "smallest": (lambda at: room.long[at], size),
                "tallest": (lambda at: 1 / height(at),),
            }.items():
                best = room.first(rows, *measures)
                if best is not None:
                    text = f"the {said} {kind}"
                    yield Asked(kind="superlative", text=text, meant=frozenset({best}), one=True)
            for said, sign in (("highest", -1), ("lowest", 1)):
                ranked = sorted(rows, key=lambda at, sign=sign: sign * room.mean[at][2])
                if abs(room.mean[ranked[0]][2] - room.mean[ranked[1]][2]) > 0.6 * max(
                    height(at) for at in ranked[:2]
                ):
                    text = f"the {said} {kind}"
                    meant = frozenset({ranked[0]})
                    yield Asked(kind="superlative", text=text, meant=meant, one=True)

    def sides(self) -> Iterator[Asked]:
        groups = {kind: self.room.of(kind) for kind in self.room.kinds}
        for kind, landmark in self._pairs():
            meant = _fitting(self._held(kind, landmark, self.room.on))
            if meant and len(meant) > 1:
                groups[f"{kind} on the {landmark}"] = sorted(meant)
        for name, rows in groups.items():
            found = self.room.ordered(rows) if len(rows) > 1 else None
            if found is None:
                continue
            kind, _, rest = name.partition(" on the ")
            rest = f" on the {rest}" if rest else ""
            for said, at in ((f"the leftmost {kind}", 0), (f"the {kind} on the right", -1)):
                if said.endswith("right") and rest:
                    continue
                yield Asked(kind="order", text=said + rest, meant=frozenset({found[at]}), one=True)
            for word, rank in (("second", 1), ("third", 2)):
                if len(found) > rank:
                    text = f"the {word} {kind} from the left{rest}"
                    yield Asked(kind="order", text=text, meant=frozenset({found[rank]}), one=True)
                    text = f"the {word} {kind} from the right{rest}"
                    meant = frozenset({found[-1 - rank]})
                    yield Asked(kind="order", text=text, meant=meant, one=True)

    def levels(self) -> Iterator[Asked]:
        """Things on the upper and lower boards of shelves, by what their names say."""
        room = self.room
        boards = ("bottom", "second", "third", "fourth", "fifth")
        level: dict[int, tuple[int, int]] = {}
        for at, name in room.names.items():
            parent = room.parent[at]
            for rank, board in enumerate(boards):
                if parent is not None and f"on the {board} shelf of" in name:
                    level[at] = (parent, rank)
        if "shelf" not in room.kinds:
            return
        for kind in sorted({room.kind[at] for at in level}):
            if kind not in room.kinds:
                continue
            for said, pick in (("upper", max), ("top", max), ("lower", min), ("bottom", min)):
                ends = {
                    shelf: pick(rank for owner, rank in level.values() if owner == shelf)
                    for shelf, _ in level.values()
                }
                meant = frozenset(
                    at for at in room.of(kind) if at in level and level[at][1] == ends[level[at][0]]
                )
                several = len(meant) > 1
                text = f"{_plural(kind) if several else f'the {kind}'} on the {said} shelf"
                yield Asked(kind="level", text=text, meant=meant, one=not several)

    def colours(self) -> Iterator[Asked]:
        room = self.room
        for kind in room.kinds:
            rows = room.of(kind)
            said = {at: room.colour(at) for at in rows}
            if len(rows) < 2 or None in said.values():
                continue
            for colour in sorted({one for one in said.values() if one}):
                meant = frozenset(at for at in rows if said[at] == colour)
                yield Asked(kind="colour", text=f"the one {colour} {kind}", meant=meant, one=True)
                others = frozenset(rows) - meant
                if others:
                    text = f"{_plural(kind)} that are not {colour}"
                    yield Asked(kind="colour", text=text, meant=others, one=False)

    def absent(self) -> Iterator[Asked]:
        """Kinds that are not there."""
        missing = [one["name"] for one in self.room.classes if not one["present"]]
        for kind, landmark in product(missing, self.room.kinds):
            text = f"the {kind} near the {landmark}"
            yield Asked(kind="absent", text=text, meant=frozenset(), one=True)
            text = f"the {landmark} left of the {kind}"
            yield Asked(kind="absent", text=text, meant=frozenset(), one=True)


def _outcome(asked: Asked, said: Reference, instance: Callable[[int], int]) -> str:
    if said.status == asked.expected == "found":
        things = frozenset(instance(one) for one in said.things)
        return "right" if things == asked.meant else "wrong silently"
    if said.status == asked.expected:
        return "right"
    if said.status == "found":
        return "wrong silently"
    return {"ambiguous": "ambiguous said", "nothing": "nothing said"}[said.status]


class ReferringScene(WordScene):
    """A scene with its phrases."""

    verbose = False

    @cached_property
    def phrases(self) -> list[Asked]:
        return Phrases(TrueRoom(self)).all()

    def report(
        self, row: str, ask: Callable[[str], Reference], instance: Callable[[int], int]
    ) -> None:
        """Print shares of all phrases, and by kind."""
        by_kind: dict[str, Counter[str]] = {}
        for one in self.phrases:
            said = ask(one.text)
            outcome = _outcome(one, said, instance)
            by_kind.setdefault(one.kind, Counter())[outcome] += 1
            by_kind.setdefault(f"({one.expected})", Counter())[outcome] += 1
            if self.work.name == "listed" and outcome != "right":
                print(outcome, one.kind, one.expected, sorted(one.meant), said.explanation)
        outcomes = ("right", "wrong silently", "ambiguous said", "nothing said")
        total = Counter[str]()
        for kind, counts in by_kind.items():
            total.update(counts if not kind.startswith("(") else {})
        for kind, counts in {"all": total, **dict(sorted(by_kind.items()))}.items():
            shares = {one: round(counts[one] / counts.total(), 3) for one in outcomes}
            print(row, kind, {"phrases": counts.total(), **shares}, flush=True)


def true(bench: ReferringScene) -> None:
    scene, layer = bench.scene, bench.layer("things")
    if not isinstance(layer, Labels):
        raise TypeError("things: expected labels.")
    rows = layer.ids.long()
    there = torch.nonzero(rows >= 0).squeeze(1)
    count = int(rows.max()) + 1
    room = TrueRoom(bench)
    kinds = [room.kind_of_all.get(at, "") for at in range(count)]
    synonyms = {word: one["name"] for one in bench.classes for word in one["synonyms"]}
    names = {one["name"] for one in bench.classes} | set(synonyms)
    looks = thing_looks(
        scene.gaussians, rows[there], there, torch.ones(len(there)), count=count, up=scene.up
    )
    known = ObjectNames(
        names,
        lambda name: torch.tensor([float(one == synonyms.get(name, name)) for one in kinds]),
        lambda: looks.colours,
        min_probability=0.5,
    )
    view = scene.train_views[0]
    resolver = Resolver(
        object_geometry(scene.gaussians, rows, up=scene.up),
        known.match,
        colour=known.colour,
        viewer=viewer_of(view.name, view.camera.cam_from_world, up=scene.up),
    )
    bench.report(
        "true",
        lambda text: resolver.resolve(parse_referring(text, is_name=known.is_name), text),
        lambda thing: thing,
    )


def query(bench: ReferringScene) -> None:
    session = bench.session(bench.features("objects"))
    own = bench.instances(session.index)
    session = bench.asking(bench.features("objects"))
    bench.report(
        "query",
        lambda text: session.ask([text]).references[text],
        lambda thing: own[thing],
    )


if __name__ == "__main__":
    run_rows(__doc__, ReferringScene, {"true": true, "query": query})
