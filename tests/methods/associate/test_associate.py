"""Segments of unordered views become instances."""

import importlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
import torch

from splatseg.core import (
    ClassInfo,
    ClassTable,
    InstanceFacts,
    LabelMap,
    MaskSet,
    Rle,
    View,
)
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.io.evidence import create_evidence, open_evidence, save_masks
from splatseg.lift import ConfusionOptions
from splatseg.methods import MethodInputs
from splatseg.methods.associate import (
    DEFAULT_CONFUSION,
    AssociateMethodOptions,
    AssociateOptions,
    associate,
)
from splatseg.methods.associate._clustering import _Candidates, join_pairs, shared_masses
from splatseg.methods.associate._table import SegmentTable, segment_table
from splatseg.methods.associate._votes import majority
from support.lifting import camera_at, gaussians_at

BACKEND = "reference"

# Three squares of four Gaussians each, side by side, and one Gaussian that no view shows.
LEFT, MIDDLE, RIGHT = -0.6, 0.0, 0.6
SPREAD = ((-0.1, -0.1), (0.1, -0.1), (-0.1, 0.1), (0.1, 0.1))
CENTRES = [(x + dx, dy, 2.0) for x in (LEFT, MIDDLE, RIGHT) for dx, dy in SPREAD]
GAUSSIANS = gaussians_at([*CENTRES, (0.0, 0.0, -5.0)], scale=0.06, opacity=0.95)
TRUTH = [1] * 4 + [2] * 4 + [3] * 4
VIEWS = [
    View(name=f"v{i}", camera=camera_at(x, width=64, height=32))
    for i, x in enumerate((-0.1, 0.0, 0.1, 0.05))
]


@dataclass(frozen=True)
class Segments:
    """Segments in memory."""

    of: Mapping[str, LabelMap | MaskSet]
    categories: Mapping[str, Mapping[int, int]] = field(default_factory=dict)
    overlapping: bool = False
    persistent: bool = False

    @property
    def view_names(self) -> tuple[str, ...]:
        return tuple(self.of)

    def segments_of(self, name: str) -> LabelMap | MaskSet:
        return self.of[name]

    def categories_of(self, name: str) -> Mapping[int, int]:
        return self.categories.get(name, {})


def columns(view: View, *borders: float) -> torch.Tensor:
    """Which strip between borders (world x at depth 2) each pixel is in, from 0; -1 outside."""
    camera = view.camera
    x = torch.arange(camera.width) + 0.5
    world = (x - camera.cx) / camera.fx * 2.0 - float(camera.cam_from_world[0, 3])
    strip = torch.bucketize(world.float(), torch.tensor(borders)) - 1
    strip[strip == len(borders) - 1] = -1
    return strip.expand(camera.height, camera.width)


def mapped(strips: torch.Tensor, names: list[int]) -> LabelMap:
    table = torch.tensor([*names, -1], dtype=torch.int32)
    return LabelMap(ids=table[strips])


BORDERS = (-1.2, -0.3, 0.3, 1.2)


def clean(names: Mapping[str, list[int]]) -> Segments:
    return Segments({v.name: mapped(columns(v, *BORDERS), names[v.name]) for v in VIEWS})


NAMES = {"v0": [7, 8, 9], "v1": [9, 7, 8], "v2": [1, 2, 3], "v3": [70000, 5, 1]}
SAME = {name: [1, 2, 3] for name in NAMES}


def run(source: Segments, views=VIEWS, confusion=DEFAULT_CONFUSION, **options):
    chosen = AssociateOptions(**options)
    return associate(GAUSSIANS, views, source, options=chosen, confusion=confusion, backend=BACKEND)


def groups(ids: torch.Tensor) -> list[frozenset[int]]:
    """The Gaussians of each instance."""
    return sorted(
        (frozenset((ids == i).nonzero().squeeze(1).tolist()) for i in ids.unique() if i > 0),
        key=min,
    )


THINGS = [frozenset(range(4)), frozenset(range(4, 8)), frozenset(range(8, 12))]


def test_ids_of_each_views_own_become_instances() -> None:
    labels = run(clean(NAMES))
    assert groups(labels.ids) == THINGS
    assert int(labels.ids[12]) == -1
    assert labels.evidence is not None
    assert float(labels.evidence[12]) == 0
    assert bool((labels.confidence[:12] > 0.95).all())
    # Outer things are as large as each other, and larger than the middle one in no way; each has
    # a segment in all four views.
    facts = InstanceFacts(segments=4, views=4)
    assert labels.info.instances == {1: facts, 2: facts, 3: facts}
    assert labels.info.details["associate"] == {
        "segments": 12,
        "instances": 3,
        "left_out": 0,
        "joined_within_views": 0,
    }
    assert labels.info.views == ("v0", "v1", "v2", "v3")


def test_neither_order_nor_names_matter() -> None:
    one = run(clean(NAMES))
    other = run(
        clean({"v0": [3, 1, 2], "v1": [1, 2, 3], "v2": [5, 900, 4], "v3": [2, 3, 1]}), VIEWS[::-1]
    )
    assert torch.equal(one.ids, other.ids)
    assert torch.equal(one.confidence, other.confidence)
    assert one.info.details["associate"] == other.info.details["associate"]


def test_a_split_in_one_view_is_outvoted() -> None:
    source = clean(NAMES)
    # In v2 the left thing falls apart into one fifth and four fifths.
    halves = mapped(columns(VIEWS[2], -1.2, -0.62, -0.3, 0.3, 1.2), [10, 11, 12, 13])
    labels = run(Segments({**source.of, "v2": halves}))
    assert groups(labels.ids) == THINGS
    assert labels.info.details["associate"]["segments"] == 13


def test_a_merger_in_one_view_is_outvoted() -> None:
    source = clean(NAMES)
    merged = mapped(columns(VIEWS[1], *BORDERS), [4, 4, 6])
    labels = run(Segments({**source.of, "v1": merged}))
    assert groups(labels.ids) == THINGS


def test_a_switch_of_tracks_is_repaired() -> None:
    """Ids that mean the same in all views but for two that change places: geometry decides."""
    switched = clean({**SAME, "v3": [2, 1, 3]})
    told = run(replace(switched, persistent=True)).info.details["associate"]
    left, middle = (int(i) for i in run(switched).ids[[0, 4]])
    assert told["merged"] == [{"id": i, "from": [1, 2]} for i in sorted((left, middle))]
    assert told["split"] == [{"from": i, "ids": sorted((left, middle))} for i in (1, 2)]

    labels = run(clean({**SAME, "v3": [2, 1, 3]}))
    assert groups(labels.ids) == THINGS


def test_things_that_are_out_of_a_picture_are_not_missed_there() -> None:
    """One view shows the right thing alone, another the left one: they are compared with others."""
    source = clean(NAMES)
    of = dict(source.of)
    for name, kept in (("v0", 2), ("v2", 0)):
        view = next(view for view in VIEWS if view.name == name)
        ids = torch.where(columns(view, *BORDERS) == kept, 1, -1).int()
        of[name] = LabelMap(ids=ids)
    labels = run(Segments(of))
    assert groups(labels.ids) == THINGS
    assert sorted(facts.segments for facts in labels.info.instances.values()) == [2, 3, 3]


@pytest.mark.parametrize("overlapping", [False, True])
def test_large_segments_are_read_on_a_coarser_grid(overlapping) -> None:
    """Four times the pixels: the same instances; the low-pass filter adds some evidence."""
    large = [
        replace(view, camera=view.camera.resized(4 * view.camera.width, 4 * view.camera.height))
        for view in VIEWS
    ]
    of = {}
    for view in large:
        strips = columns(view, *BORDERS)
        found = mapped(strips, NAMES[view.name])
        if overlapping:
            masks = tuple(Rle.encode(strips == i) for i in range(3))
            height, width = strips.shape
            found = MaskSet(
                height=height,
                width=width,
                masks=masks,
                scores=torch.ones(3),
                levels=torch.zeros(3, dtype=torch.int64),
            )
        of[view.name] = found
    source = Segments(of, overlapping=overlapping)
    level = {"level": "object"} if overlapping else {}
    full = run(source, large, longest_side=10_000, **level)
    coarse = run(source, large, longest_side=64, **level)
    assert groups(full.ids) == groups(coarse.ids) == THINGS
    assert full.evidence is not None
    assert coarse.evidence is not None
    torch.testing.assert_close(coarse.evidence, full.evidence, rtol=0.12, atol=0.5)


def table_of(source: Segments, views=VIEWS) -> SegmentTable:
    return segment_table(GAUSSIANS, views, source, longest_side=640, backend=BACKEND)


def test_pairs_that_share_next_to_nothing_are_left_out() -> None:
    """Columns of 1, 400 and 401 Gaussians: the first is a 400th of the others."""
    import scipy.sparse

    dense = np.zeros((402, 4))
    dense[0, 0] = dense[:400, 1] = dense[:401, 2] = dense[401, 3] = 1
    found = shared_masses(scipy.sparse.csr_matrix(dense.T, dtype=np.float32)).toarray()
    whole = dense.T @ dense
    assert whole[0, 1] == 1
    assert whole[0, 2] == 1
    whole[0, 1:3] = whole[1:3, 0] = 0  # cosines of 0.05 and below
    assert np.array_equal(found, whole)


def test_a_sample_of_gaussians_keeps_the_sums(monkeypatch) -> None:
    """Few pairs: all count 1. Many: fewer Gaussians, which count for the others."""
    table = table_of(clean(NAMES))
    module = importlib.import_module("splatseg.methods.associate._table")
    entries = np.bincount(table.gaussian, minlength=table.gaussians)
    assert table._sample(entries).tolist() == [1.0] * table.gaussians
    rng = np.random.default_rng(0)
    n = 5000
    size = rng.gamma(0.7, size=n).astype(np.float32)
    many = replace(
        table,
        gaussians=n,
        gaussian=np.arange(n, dtype=np.int32),
        segment=np.zeros(n, np.int32),
        mass=size,
        seen=size,
    )
    monkeypatch.setattr(module, "_PAIRS", 1e4)
    worth = many._sample(np.full(n, 5))
    taken = worth > 0
    assert 380 < taken.sum() < 402, "25 pairs a Gaussian"
    assert float((worth * size).sum()) == pytest.approx(float(size.sum()), rel=0.01)
    assert worth[taken].min() >= 1 - 1e-9
    # Those that are seen most are taken most.
    assert size[taken].mean() > 1.5 * size.mean()
    sampled = replace(table)
    monkeypatch.setattr(module, "_PAIRS", 100)
    assert 0 < (sampled._sample(entries) > 0).sum() < table.gaussians
    assert groups(run(clean(NAMES)).ids) == THINGS


@pytest.mark.parametrize("size", [1, 4, 1 << 20])
def test_what_views_of_one_group_see_of_another(rng, monkeypatch, size) -> None:
    """In pieces of any size, for pairs in any order."""
    import scipy.sparse

    module = importlib.import_module("splatseg.methods.associate._clustering")
    seen = scipy.sparse.random(30, 9, 0.4, random_state=1, format="csr")
    members = scipy.sparse.csr_matrix(rng.integers(0, 3, (30, 9)).astype(float))
    one, other = rng.integers(0, 30, 50), rng.integers(0, 30, 50)
    monkeypatch.setattr(module, "_CELLS", size)
    monkeypatch.setattr(module, "_PAIRS", size)
    found = module.visible_in(seen, members, one, other)
    expected = (seen.toarray()[one] * members.toarray()[other]).sum(axis=1)
    np.testing.assert_allclose(found, expected)


def test_pairs_of_joined_groups_add_up() -> None:
    """0 and 3 join, and 1 and 2: what they shared with each other is gone."""
    row, column = np.array([0, 0, 1, 1, 2, 0]), np.array([1, 2, 2, 3, 3, 4])
    value = np.array([1.0, 2, 4, 8, 16, 32])
    found = join_pairs(row, column, value, np.array([0, 1, 1, 0, 4]))
    assert [part.tolist() for part in found] == [[0, 0], [1, 4], [27, 32]]


def test_groups_join_their_best_and_of_equals_the_first() -> None:
    """0 is as near to 1 as to 2; 3 is nearer to 5 than to 4; 4 and 5 are below the threshold."""
    import scipy.sparse

    one = scipy.sparse.identity(6, format="csr")
    row, column = np.array([0, 0, 3, 3, 4]), np.array([1, 2, 4, 5, 5])
    candidates = _Candidates((row, column, np.ones(5)), one, one, 0.5)
    assert candidates.mutual_best() is None
    candidates.ratio = np.array([0.9, 0.9, 0.6, 0.7, 0.2])
    assert candidates.mutual_best().tolist() == [0, 0, 2, 3, 4, 3]


def test_votes_become_a_soft_layer() -> None:
    """Strongest first, the smaller id among equals; shares are of all votes."""
    import scipy.sparse

    votes = scipy.sparse.csr_matrix(np.array([[1.0, 3, 0, 0], [2, 0, 2, 0], [0, 0, 0, 0]]))
    labels = majority(votes)
    assert labels.ids.tolist() == [2, 1, -1]
    assert labels.candidates is not None
    assert labels.candidates[:, :3].tolist() == [[2, 1, -1], [1, 3, -1], [-1, -1, -1]]
    assert labels.shares is not None
    assert labels.shares[:, :2].tolist() == [[0.75, 0.25], [0.5, 0.5], [0, 0]]
    assert labels.confidence.tolist() == [0.75, 0.5, 0]
    assert labels.evidence is not None
    assert labels.evidence.tolist() == [4, 4, 0]
    many = majority(scipy.sparse.csr_matrix(np.arange(1.0, 11)[None]))
    assert many.candidates is not None
    assert many.candidates.tolist() == [[10, 9, 8, 7, 6, 5, 4, 3]]


def test_confusion_is_corrected_unless_told_otherwise(monkeypatch) -> None:
    """The soft votes go to `correct_confusion` with the options given, and its word is the last."""
    module = importlib.import_module("splatseg.methods.associate")
    asked = []

    def turned(labels, *, options):
        asked.append((labels, options))
        return replace(
            labels,
            ids=labels.ids.flip(0),
            info=labels.info.with_edit("correct_confusion", {"a": 1}),
        )

    monkeypatch.setattr(module, "correct_confusion", turned)
    three = ConfusionOptions(effective_views=3)
    told = run(clean(NAMES), confusion=three)
    plain = run(clean(NAMES), confusion=None)
    assert len(asked) == 1
    assert asked[0][1] is three
    assert torch.equal(asked[0][0].ids, plain.ids)
    assert asked[0][0].candidates is not None
    assert torch.equal(told.ids, plain.ids.flip(0))
    assert told.info.edit("correct_confusion") == {"a": 1}
    assert plain.info.edits == ()
    assert (told.candidates, plain.candidates) == (None, None)


def test_the_method_corrects_confusion_unless_told_otherwise(monkeypatch, tmp_path) -> None:
    module = importlib.import_module("splatseg.methods.associate")
    labels, given = run(clean(NAMES)), []

    def associated(*_, confusion, **__):
        given.append(confusion)
        return labels

    monkeypatch.setattr(module, "associate", associated)
    three = ConfusionOptions(effective_views=3)
    create_evidence(tmp_path, kind="masks")
    save_masks(MaskSet.from_dense(torch.ones(1, 32, 64) > 0), tmp_path, "v0")
    inputs = MethodInputs(gaussians=GAUSSIANS, views=VIEWS, evidence=open_evidence(tmp_path))
    for wanted in (True, False):
        options = AssociateMethodOptions(correct_confusion=wanted, confusion=three)
        assert module.run(inputs, options) is labels
    assert given == [three, None]


def test_relabelling_counts_no_more_views_than_saw_a_gaussian(monkeypatch) -> None:
    """The number of views that see each Gaussian goes along with its votes."""
    module = importlib.import_module("splatseg.methods.associate")
    asked = []
    monkeypatch.setattr(
        module, "correct_confusion", lambda labels, options: asked.append(labels) or labels
    )
    # In v3 nothing is said of the right square, so that three views tell something of it.
    labels = run(clean({**NAMES, "v3": [70000, 5, -1]}))
    for found in (asked[0].effective_views, labels.effective_views):
        assert found is not None
        assert found.tolist() == [4.0] * 8 + [3.0] * 4 + [0.0]


def test_accidents_are_left_out() -> None:
    source = clean(NAMES)
    # Only v1 sees a fourth thing in the upper half of the middle one.
    ids = source.of["v1"].ids.clone()
    ids[:16][ids[:16] == 7] = 4
    source = Segments({**source.of, "v1": LabelMap(ids=ids)})
    assert run(source, min_views=2).info.details["associate"]["instances"] == 3
    assert run(source, min_views=5).info.details["associate"]["instances"] == 3, "4 views are all"
    alone = run(source, VIEWS[1:2], min_views=2)
    assert alone.info.details["associate"]["instances"] == 4, "one view is all there is"


def test_names_come_from_categories() -> None:
    source = replace(
        clean(SAME),
        categories={"v0": {1: 5, 2: 6}, "v1": {1: 6, 2: 6}, "v2": {1: 5}, "v3": {}},
    )
    classes = ClassTable(
        rows=(ClassInfo(id=5, name="cup", isthing=True), ClassInfo(id=6, name="book", isthing=True))
    )
    labels = associate(GAUSSIANS, VIEWS, source, classes=classes, backend=BACKEND)
    by_thing = {int(labels.ids[4 * i]): i for i in range(3)}
    id_of = {thing: id for id, thing in by_thing.items()}
    info = labels.info
    assert info.class_of == {id_of[0]: 5, id_of[1]: 6}
    assert info.names[id_of[0]] == f"cup {id_of[0]}"
    assert info.names[id_of[1]] == f"book {id_of[1]}"
    assert info.names[id_of[2]] == f"object {id_of[2]}"


def test_memory_is_bounded_by_the_views_that_see_most(monkeypatch) -> None:
    module = importlib.import_module("splatseg.methods.associate._table")
    whole = table_of(clean(NAMES))
    monkeypatch.setattr(module, "MAX_VIEWS", 2)
    table = table_of(clean(NAMES))
    pairs = np.unique(np.stack((table.gaussian, table.view[table.segment])), axis=1)
    assert np.bincount(pairs[0]).max() == 2
    for i in range(12):
        best = np.sort(np.unique(whole.seen[whole.gaussian == i]))[-2:]
        assert set(table.seen[table.gaussian == i]) <= set(best)
    monkeypatch.setattr(module, "MAX_VIEWS", 3)
    assert groups(run(clean(NAMES)).ids) == THINGS


def test_masses_are_those_of_the_masks() -> None:
    table = table_of(clean(NAMES))
    assert table.views == ("v0", "v1", "v2", "v3")
    assert len(table.view) == 12
    assert table.view.tolist() == [0, 0, 0, 1, 1, 1, 2, 2, 2, 3, 3, 3]
    assert table.name.tolist() == [7, 8, 9, 9, 7, 8, 1, 2, 3, 70000, 5, 1]
    # A strip holds its own thing and nothing else; what a view sees of it is what the strip holds.
    for row in range(12):
        entries = table.segment == row
        held = table.gaussian[entries][table.mass[entries] > 0.05]
        assert set(held.tolist()) == THINGS[row % 3]
        np.testing.assert_allclose(
            table.mass[entries][table.mass[entries] > 0.05],
            table.seen[entries][table.mass[entries] > 0.05],
            rtol=0.01,
        )
    np.testing.assert_allclose(
        table.size, np.bincount(table.segment, table.mass, minlength=12), rtol=1e-6
    )


def test_hostile_input() -> None:
    source = clean(NAMES)
    with pytest.raises(InputError, match="no segments of view 'v9'"):
        run(source, [View(name="v9", camera=camera_at())])
    void = LabelMap(ids=torch.full((32, 64), -1, dtype=torch.int32))
    with pytest.raises(InputError, match="expected a segment in 4 views, found none"):
        run(Segments(dict.fromkeys(NAMES, void)))
    with pytest.raises(ShapeError, match="v0"):
        run(Segments({**source.of, "v0": LabelMap(ids=torch.ones(5, 64, dtype=torch.int32))}))
    with pytest.raises(RangeError, match="agreement"):
        AssociateOptions(agreement=1.5)
    with pytest.raises(InputError, match="small_things: this option was removed; `correct_conf"):
        AssociateOptions(small_things=0.25)
    with pytest.raises(RangeError, match="min_views"):
        AssociateOptions(min_views=0)
    # Segments where no Gaussian is: no instance, no error.
    corner = torch.full((32, 64), -1, dtype=torch.int32)
    corner[0, 0] = 1
    empty = run(Segments(dict.fromkeys(NAMES, LabelMap(ids=corner))))
    assert empty.ids.unique().tolist() == [-1]
    assert empty.info.details["associate"]["instances"] == 0
