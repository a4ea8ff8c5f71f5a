"""Neighbours look unlike each other, and a layer has the same colours everywhere."""

import itertools

import numpy as np
import pytest
import torch

from splatseg.core import ClassInfo, ClassTable, Gaussians, Labels, LayerInfo, RenderableLayer
from splatseg.report.colours import _oklab, colour_of, layer_colours, legend_of


def gaussians_at(means: torch.Tensor) -> Gaussians:
    n = len(means)
    return Gaussians(
        means=means,
        rotations=torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
        scales=torch.full((n, 3), 0.1),
        opacities=torch.full((n,), 0.9),
        sh=torch.zeros(n, 1, 3),
    )


def board(side: int = 12) -> tuple[Gaussians, Labels]:
    """A chessboard of side x side things, each of a patch of Gaussians."""
    fine = 4 * side
    x, y = torch.meshgrid(torch.arange(fine), torch.arange(fine), indexing="ij")
    ids = (x // 4) * side + y // 4
    means = torch.stack((x, y, torch.zeros_like(x)), -1).reshape(-1, 3).float()
    ids = ids.reshape(-1).int()
    return gaussians_at(means), Labels(ids=ids, confidence=torch.ones(len(ids)))


def apart(one: tuple[int, int, int], other: tuple[int, int, int]) -> float:
    lab = _oklab(np.array([one, other]) / 255)
    return float(np.linalg.norm(lab[0] - lab[1]))


def test_neighbours_are_told_apart() -> None:
    side = 12
    gaussians, labels = board(side)
    table = layer_colours(RenderableLayer.of(labels), None, gaussians=gaussians, labels=labels)
    colours = {row.id: row.colour for row in table.rows}
    pairs = [
        (i * side + j, (i + di) * side + j + dj)
        for i, j in itertools.product(range(side), repeat=2)
        for di, dj in ((1, 0), (0, 1))
        if i + di < side and j + dj < side
    ]
    least = min(apart(colours[a], colours[b]) for a, b in pairs)
    assert least > 0.2
    assert min(apart(colour_of(a), colour_of(b)) for a, b in pairs) < 0.15, "what ids alone give"
    assert len(set(colours.values())) > 40, "the whole palette is used"


def test_the_same_layer_has_the_same_colours() -> None:
    gaussians, labels = board()
    layer = RenderableLayer.of(labels)
    first = layer_colours(layer, None, gaussians=gaussians, labels=labels)
    assert layer_colours(layer, None, gaussians=gaussians, labels=labels) == first
    legend = legend_of(layer, None, colours=first)["ids"]
    assert {int(id): tuple(row["colour"]) for id, row in legend.items()} == {
        row.id: row.colour for row in first.rows
    }
    assert legend["7"]["name"] == "", "no name is made up for programs"


def test_colours_of_a_class_table_stay_and_others_keep_away() -> None:
    gaussians, labels = board(3)
    red = (210, 20, 20)
    named = Labels(
        ids=labels.ids,
        confidence=labels.confidence,
        info=LayerInfo(names={4: "chair", 1: "table"}),
    )
    classes = ClassTable(
        rows=(ClassInfo(id=4, name="chair", colour=red), ClassInfo(id=1, name="sky", colour=red))
    )
    layer = RenderableLayer.of(named)
    table = layer_colours(layer, classes, gaussians=gaussians, labels=named)
    colours = {row.id: row.colour for row in table.rows}
    assert colours[4] == red
    assert colours[1] != red, "id 1 is a sky there and a table here"
    for beside in (1, 3, 5, 7):
        assert apart(colours[beside], red) > 0.15


@pytest.mark.parametrize("count", [0, 1])
def test_hardly_anything_to_colour(count: int) -> None:
    gaussians = gaussians_at(torch.zeros(count, 3))
    labels = Labels(
        ids=torch.full((count,), 5, dtype=torch.int32),
        confidence=torch.ones(count),
        background=2,
    )
    table = layer_colours(RenderableLayer.of(labels), None, gaussians=gaussians, labels=labels)
    assert [row.id for row in table.rows] == [2, 5][: count + 1]
    plain = layer_colours(RenderableLayer.of(labels), None)
    assert [row.colour for row in plain.rows] == [colour_of(row.id) for row in plain.rows]
