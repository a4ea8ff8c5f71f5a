"""Which of the masks that answer to a word are meant: a thing, not its part and not its group."""

import pytest
import torch

from splatseg.core import MaskSet, View
from splatseg.lift.phrases import ThingLooks
from splatseg.lift.words import WordAnswers
from splatseg.methods.prompt.masks import MaskTable
from splatseg.methods.prompt.words import answering, mask_groups
from support.red_square import SIZE, camera

PART, THING, GROUP, OTHER = range(4)
SIDES = (4, 10, 24, 6)
HELD = torch.tensor(
    [[1, 0.9, 1, 0], [0.1, 1, 1, 0], [0.05, 0.3, 1, 0], [0, 0, 0, 1]], dtype=torch.float32
)
"""Share of the row's mask that the column's has."""


@pytest.fixture
def table() -> MaskTable:
    """Two views of a part in a thing in a group, and something else."""
    masks = torch.zeros(4, SIZE, SIZE, dtype=torch.bool)
    for row, side in enumerate(SIDES[:OTHER]):
        masks[row, :side, :side] = True
    masks[OTHER, -SIDES[OTHER] :, -SIDES[OTHER] :] = True
    same = torch.eye(4).tile(2, 2)
    return MaskTable(
        views=tuple(View(name=name, camera=camera(0)) for name in ("a", "b")),
        masks=(MaskSet.from_dense(masks),) * 2,
        view=torch.tensor([0] * 4 + [1] * 4),
        index=torch.arange(4).tile(2),
        values=torch.eye(4).tile(2, 1),
        cells=torch.tensor([float(side**2) for side in SIDES]).tile(2),
        iou=same,
        contained=HELD.tile(2, 2),
        looks=ThingLooks(
            colours=torch.zeros(8, 3), low=torch.zeros(8, 3), high=torch.ones(8, 3), has_up=False
        ),
    )


def meant(table: MaskTable, cosines: list[float], probabilities: list[float]) -> int | None:
    answers = WordAnswers(
        words=("mug",),
        cosines=torch.tensor(cosines * 2)[:, None],
        probabilities=torch.tensor(probabilities * 2)[:, None],
    )
    found = answering(table, mask_groups(table), answers, several=False, least=0.05)
    if not found:
        return None
    (one,) = found
    assert [view.name for view, _ in one.masks] == ["a", "b"]
    return [side**2 for side in SIDES].index(one.masks[0][1].area)


def test_a_thing_is_meant_and_not_its_part(table) -> None:
    sure = [0.9] * 4
    assert meant(table, [0.98, 0.97, 0.3, 0.1], sure) == THING
    assert meant(table, [0.97, 0.98, 0.3, 0.1], sure) == THING


def test_a_part_is_meant_where_the_whole_answers_less(table) -> None:
    assert meant(table, [0.98, 0.90, 0.3, 0.1], [0.9] * 4) == PART
    assert meant(table, [0.98, 0.97, 0.3, 0.1], [0.9, 0.01, 0.01, 0.0]) == PART


def test_what_does_not_hold_it_is_no_whole_of_it(table) -> None:
    assert meant(table, [0.95, 0.2, 0.3, 0.96], [0.9] * 4) == OTHER
    assert meant(table, [0.96, 0.2, 0.3, 0.95], [0.9] * 4) == PART


def test_the_whole_may_be_a_group(table) -> None:
    assert meant(table, [0.97, 0.97, 0.96, 0.1], [0.9] * 4) == GROUP


def test_nothing_answers(table) -> None:
    assert meant(table, [0.98, 0.97, 0.3, 0.1], [0.01] * 4) is None
