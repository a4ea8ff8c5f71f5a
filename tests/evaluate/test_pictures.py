"""Colours of ids, depth and errors; sheets of images."""

import numpy as np
import torch

from splatseg.core import ClassInfo, ClassTable
from splatseg.report.colours import colour_of
from splatseg.report.images import (
    GalleryImage,
    colour_depth,
    colour_labels,
    colour_share,
    mark_errors,
    overlay_labels,
)

CLASSES = ClassTable(
    rows=(ClassInfo(id=2, name="a", colour=(1, 2, 3)), ClassInfo(id=4, name="b", colour=None))
)


def plain(colour, height=30, width=40, **more) -> GalleryImage:
    image = torch.tensor(colour, dtype=torch.uint8).expand(height, width, 3)
    return GalleryImage(image=image, **more)


def test_ids_take_the_tables_colours():
    ids = torch.tensor([[2, -1], [4, 2]], dtype=torch.int32)
    image = colour_labels(ids, CLASSES)
    assert image.dtype == torch.uint8
    assert image[0, 0].tolist() == image[1, 1].tolist() == [1, 2, 3]
    assert tuple(image[1, 0].tolist()) == colour_of(4, CLASSES) == colour_of(4)
    assert max(image[0, 1].tolist()) < 40  # none is nearly black


def test_made_up_colours_differ_from_each_other():
    colours = np.array([colour_of(i) for i in range(40)], dtype=float)
    gaps = np.linalg.norm(colours[:, None] - colours[None], axis=-1)
    np.fill_diagonal(gaps, np.inf)
    assert gaps.min() > 20
    assert np.diagonal(gaps, offset=1).min() > 100  # neighbours clearly


def test_depth_gets_darker_with_distance():
    depth = torch.linspace(1.0, 5.0, 50).repeat(4, 1)
    image = colour_depth(depth, near=1.0, far=5.0).float()
    grey = image[0].mean(dim=-1)
    assert bool((grey[1:] < grey[:-1] + 1e-6).all())
    assert image[0, 0].tolist() == [244, 226, 150]
    assert image[0, -1].tolist() == [22, 24, 60]
    # Beyond the range the ends stay.
    ends = colour_depth(torch.tensor([[0.5, 9.0]]), near=1.0, far=5.0)
    assert ends[0].tolist() == [[244, 226, 150], [22, 24, 60]]


def test_depth_zero_is_nothing():
    image = colour_depth(torch.tensor([[0.0, 2.0, 3.0]]))
    assert image[0, 0].tolist() == [24, 24, 28]
    assert colour_depth(torch.zeros(2, 2)).float().std(dim=(0, 1)).max() == 0
    assert colour_depth(torch.full((2, 2), 3.0)).shape == (2, 2, 3)  # one depth has no range


def test_errors_are_red_missing_ones_blue_and_void_is_left_alone():
    image = torch.full((1, 4, 3), 100, dtype=torch.uint8)
    ids = torch.tensor([[1, 2, -1, 1]])
    truth = torch.tensor([[1, 1, 1, -1]])
    right, wrong, missing, void = mark_errors(image, ids, truth=truth)[0].tolist()
    assert right == void == [125, 125, 125]
    assert wrong[0] > wrong[2] + 80
    assert missing[2] > missing[0] + 80


def test_labels_tint_a_photograph() -> None:
    image = torch.full((3, 4, 3), 100, dtype=torch.uint8)
    ids = torch.tensor([[1, 1, -1, -1]] * 3)
    classes = ClassTable(rows=(ClassInfo(id=1, name="a", colour=(200, 0, 0)),))
    out = overlay_labels(image, ids, classes)
    assert out[1, 0].tolist() == [155, 45, 45]
    assert out[1, 3].tolist() == [100, 100, 100]
    # The border between the two is lighter than either.
    assert out[1, 2].tolist() == [170, 170, 170]


def test_shares_go_from_dark_to_light() -> None:
    colours = colour_share(torch.tensor([[0.0, 0.5, 1.0, -1.0]]))[0].int()
    brightness = colours[:3].sum(dim=1)
    assert brightness.tolist() == sorted(brightness.tolist())
    assert colours[0].tolist() == [22, 24, 60]
    assert colours[2].tolist() == [244, 226, 150]
    assert colours[3].tolist() == [24, 24, 28]
