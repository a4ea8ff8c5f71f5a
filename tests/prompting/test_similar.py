"""More like this: objects and Gaussians like what is selected."""

import pytest
import torch

from splatseg.core import Features, Labels, Selection
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.prompting.similar import (
    SimilarOptions,
    describe_objects,
    similar_gaussians,
    similar_objects,
)
from support.ball_rows import balls_at, graph_of, grid

BLOCK = grid(3, 3, 3)
"""An object of 27 balls."""


def blocks(*kinds: str):
    """Blocks 10 apart: a red cube, A; a red flat one, F; a blue cube, B. Labels are 0, 1, ..."""
    parts, colours = [], []
    for i, kind in enumerate(kinds):
        flat = torch.tensor([1.0, 1.0, 0.1 if kind == "F" else 1.0])
        parts.append(BLOCK * flat + torch.tensor([10.0 * i, 0, 0]))
        colour = [0.1, 0.1, 0.9] if kind == "B" else [0.9, 0.1, 0.1]
        colours.append(torch.tensor(colour).expand(27, 3))
    gaussians = balls_at(torch.cat(parts), colours=torch.cat(colours))
    ids = torch.arange(len(kinds)).repeat_interleave(27)
    return gaussians, Labels(ids=ids, confidence=torch.ones(len(ids)))


def object_of(labels: Labels, id: int) -> Selection:
    return Selection(mask=labels.ids == id)


def features_of(*vectors) -> Features:
    return Features(values=torch.tensor(vectors).float().repeat_interleave(27, dim=0))


def test_without_features_colours_and_shapes_are_compared() -> None:
    gaussians, labels = blocks("A", "B", "A", "F", "B", "A")
    found = similar_objects(gaussians, labels, object_of(labels, 0))
    assert found.ids.tolist() == [2, 5]
    assert found.similarity.tolist() == pytest.approx([1, 1], abs=1e-4)
    assert torch.equal(found.rows[0], torch.arange(54, 81))
    assert found.selection(len(gaussians)).ids.tolist() == [*range(54, 81), *range(135, 162)]


def test_shapes_are_the_same_whichever_way_they_lie() -> None:
    gaussians, labels = blocks("F", "A")
    turned = gaussians.replace(means=gaussians.means[:, [2, 0, 1]])
    rows, of = torch.arange(54), labels.ids.long()
    torch.testing.assert_close(
        describe_objects(gaussians, rows, of, 2), describe_objects(turned, rows, of, 2)
    )


def test_with_features_they_are_compared_by_direction() -> None:
    gaussians, labels = blocks("A", "A", "A", "A")
    features = features_of([2, 0], [3, 0.3], [0.0, 1], [1, 1])
    chosen = object_of(labels, 0)

    def ids(**options) -> list[int]:
        return similar_objects(
            gaussians, labels, chosen, features=features, options=SimilarOptions(**options)
        ).ids.tolist()

    assert ids() == [1]
    assert ids(min_similarity=0.7) == [1, 3]
    assert ids(min_similarity=-1) == [1, 3, 2]
    assert ids(min_similarity=-1, max_objects=2) == [1, 3]
    assert ids(min_size=28) == []


def test_visibility_weighs_features() -> None:
    gaussians, labels = blocks("A", "A")
    values = features_of([1, 0], [1, 0]).values.clone()
    values[27:40] = torch.tensor([0.0, 1.0])
    hidden = torch.ones(54)
    hidden[27:40] = 0
    chosen = object_of(labels, 0)
    with_weights = Features(values=values, weights=hidden)
    found = similar_objects(gaussians, labels, chosen, features=with_weights)
    assert found.similarity.tolist() == pytest.approx([1.0])
    without = similar_objects(gaussians, labels, chosen, features=Features(values=values))
    assert without.similarity.numel() == 0


def test_what_is_mostly_selected_is_not_found_again_nor_is_what_has_no_id() -> None:
    gaussians, labels = blocks("A", "A", "A")
    ids = labels.ids.clone()
    ids[54:] = -1
    labels = Labels(ids=ids, confidence=labels.confidence)
    features = features_of([1, 0], [1, 0], [1, 0])
    chosen = Selection(mask=torch.arange(81) < 27 + 14)
    assert not len(similar_objects(gaussians, labels, chosen, features=features).ids)
    fewer = Selection(mask=torch.arange(81) < 27 + 13)
    assert similar_objects(gaussians, labels, fewer, features=features).ids.tolist() == [1]


def test_without_objects_connected_pieces_are_found() -> None:
    gaussians, labels = blocks("A", "A", "A", "A", "A", "A")
    features = features_of([1, 0], [0, 1], [1, 0.1], [0, 1], [0, 1], [0, 0])
    graph = graph_of(gaussians, 6)
    found = similar_gaussians(graph, features, object_of(labels, 0))
    assert [rows.tolist() for rows in found.rows] == [list(range(54, 81))]
    assert found.similarity.tolist() == pytest.approx([1 / 1.01**0.5], abs=1e-5)
    part = Selection(mask=torch.arange(len(gaussians)) < 3)
    rest = similar_gaussians(graph, features, part)
    assert [rows[0].item() for rows in rest.rows] == [3, 54], "the rest of it is most like it"
    large = SimilarOptions(min_size=25)
    assert [
        rows[0].item() for rows in similar_gaussians(graph, features, part, options=large).rows
    ] == [54]
    none = SimilarOptions(deviations=5)
    assert not similar_gaussians(graph, features, part, options=none).rows
    one = SimilarOptions(max_objects=1)
    assert len(similar_gaussians(graph, features, part, options=one).rows) == 1


def test_what_is_refused() -> None:
    gaussians, labels = blocks("A", "B")
    graph = graph_of(gaussians, 6)
    features, chosen = features_of([1, 0], [0, 0]), object_of(labels, 0)
    nothing, unknown = object_of(labels, 9), object_of(labels, 1)
    short = Selection(mask=torch.ones(3, dtype=torch.bool))
    with pytest.raises(ShapeError, match="selection: expected 54 rows"):
        similar_objects(gaussians, labels, short)
    with pytest.raises(ShapeError, match="features: expected 54 rows"):
        similar_objects(gaussians, labels, chosen, features=features[:3])
    with pytest.raises(ShapeError, match="selection: expected 54 rows"):
        similar_gaussians(graph, features, short)
    for selection, sentence in (
        (nothing, "selection: expected at least one Gaussian, got none"),
        (unknown, "selection: expected a Gaussian with a feature, got none"),
    ):
        with pytest.raises(InputError, match=sentence):
            similar_objects(gaussians, labels, selection, features=features)
        with pytest.raises(InputError, match=sentence):
            similar_gaussians(graph, features, selection)
    for wrong in (
        {"min_similarity": 2},
        {"max_objects": 0},
        {"min_size": 0},
        {"deviations": float("nan")},
    ):
        with pytest.raises(RangeError, match=next(iter(wrong))):
            SimilarOptions(**wrong)
