"""Outlines of ids, all at once and one by one."""

import torch

from splatseg.prompting.tree_choice import _outlines, box_iou, outline


def test_outlines_of_all_ids_are_those_of_each() -> None:
    generator = torch.Generator().manual_seed(0)
    index = torch.randint(0, 40, (17, 23), generator=generator)
    index = torch.unique(index, return_inverse=True)[1]
    count = int(index.max()) + 1
    each = torch.stack([outline(index == i) for i in range(count)])
    assert torch.equal(_outlines(index, count), each)
    assert outline(torch.zeros(3, 4, dtype=torch.bool)).tolist() == [0, 0, 0, 0]


def test_boxes_against_one() -> None:
    boxes = torch.tensor([[0, 0, 2, 2], [1, 1, 3, 3], [5, 5, 6, 6]])
    assert box_iou(boxes, boxes[0]).tolist() == [1, 1 / 7, 0]
