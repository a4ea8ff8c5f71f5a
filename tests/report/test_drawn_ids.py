"""Ids stand inside what they name, and nowhere else."""

import numpy as np
import torch

from splatseg.report.colours import draw_ids


def test_each_wide_area_has_its_id_in_its_middle() -> None:
    ids = torch.full((120, 200), -1, dtype=torch.int32)
    ids[20:80, 10:70] = 7
    ids[30:110, 120:190] = 12
    ids[0:4, 100:104] = 3  # too small to be written in
    image = torch.full((120, 200, 3), 100, dtype=torch.uint8)
    written = (draw_ids(image, ids) != image).any(dim=-1)
    rows, columns = torch.nonzero(written, as_tuple=True)
    assert bool((ids[written] >= 0).all()), "nothing is written outside"
    for id, middle in ((7, (50, 40)), (12, (70, 155))):
        inside = ids[rows, columns] == id
        assert int(inside.sum()) > 20
        centre = (rows[inside].float().mean(), columns[inside].float().mean())
        assert np.allclose(centre, middle, atol=8)
    assert not bool(written[:8, 96:108].any())


def test_a_bent_area_has_its_id_within_it() -> None:
    """The middle of an L lies outside it; its widest place does not."""
    ids = torch.full((160, 160), -1, dtype=torch.int32)
    ids[10:150, 10:50] = 4
    ids[120:150, 10:150] = 4
    image = torch.zeros(160, 160, 3, dtype=torch.uint8)
    written = (draw_ids(image, ids) != image).any(dim=-1)
    assert bool(written.any())
    assert bool((ids[written] == 4).all())


def test_a_map_of_nothing_is_left_alone() -> None:
    image = torch.full((30, 40, 3), 9, dtype=torch.uint8)
    assert torch.equal(draw_ids(image, torch.full((30, 40), -1)), image)
