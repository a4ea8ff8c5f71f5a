"""Each edit of Gaussians, held to what it must leave alone and to what a camera sees."""

import math

import numpy as np
import pytest
import torch

from splatseg.core import (
    Edited,
    Gaussians,
    LayerInfo,
    Selection,
    Similarity,
    apply_rows,
)
from splatseg.edit import duplicate, extract, merge, recolour, remove, transform
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.render import render

from .conftest import BACKEND, camera, layers_of, random_gaussians


def turned(angle: float = 0.7, *, scale: float = 1.0, shift=(0.0, 0.0, 0.0)) -> Similarity:
    c, s = math.cos(angle), math.sin(angle)
    rotation = torch.tensor([[1, 0, 0], [0, c, -s], [0, s, c]], dtype=torch.float64) @ (
        torch.tensor([[c, s, 0], [-s, c, 0], [0, 0, 1]], dtype=torch.float64)
    )
    return Similarity(
        rotation=rotation, translation=torch.tensor(shift, dtype=torch.float64), scale=scale
    )


def same(left: Gaussians, right: Gaussians, tolerance: float = 0.0) -> None:
    for name in ("means", "rotations", "scales", "opacities", "sh"):
        a, b = getattr(left, name), getattr(right, name)
        torch.testing.assert_close(a, b, atol=tolerance, rtol=0, msg=lambda m, n=name: f"{n}: {m}")
    assert set(left.extra) == set(right.extra)
    for name in left.extra:
        assert torch.equal(left.extra[name], right.extra[name])


def test_extract_and_remove_share_the_rows_between_them(some, half) -> None:
    inside, outside = extract(some, half), remove(some, half)
    assert torch.equal(inside.gaussians.extra["number"], torch.arange(0, 24, 2))
    assert torch.equal(outside.gaussians.extra["number"], torch.arange(1, 24, 2))
    for edited in (inside, outside):
        same(edited.gaussians, some[edited.rows])
    assert torch.equal(torch.cat((inside.rows, outside.rows)).sort().values, torch.arange(24))


def test_a_copy_stands_behind_and_is_what_it_copies_moved(some, half) -> None:
    move = turned(scale=0.5, shift=(1.0, 2.0, 3.0))
    edited = duplicate(some, half, move)
    same(edited.gaussians[:24], some)
    same(edited.gaussians[24:], some[half.mask].transformed(move))
    assert edited.rows.tolist() == [*range(24), *range(0, 24, 2)]


def test_a_transform_moves_what_is_selected_and_nothing_else(some, half) -> None:
    move = turned(scale=2.0, shift=(0.0, -1.0, 0.5))
    edited = transform(some, move, selection=half)
    same(edited.gaussians[~half.mask], some[~half.mask])
    same(edited.gaussians[half.mask], some[half.mask].transformed(move))
    assert edited.rows.tolist() == list(range(24))


@pytest.mark.parametrize("coefficients", [1, 4, 9, 16])
def test_there_and_back_is_where_it_was(rng, coefficients) -> None:
    before = random_gaussians(rng, 16, coefficients=coefficients)
    there = turned(scale=1.7, shift=(0.3, -2.0, 1.0))
    back = transform(transform(before, there).gaussians, there.inverse()).gaussians
    torch.testing.assert_close(back.means, before.means, atol=2e-6, rtol=0)
    torch.testing.assert_close(back.scales, before.scales, atol=1e-6, rtol=0)
    torch.testing.assert_close(back.sh, before.sh, atol=2e-6, rtol=0)
    aligned = (back.rotations * before.rotations).sum(dim=1).abs()
    torch.testing.assert_close(aligned, torch.ones(16), atol=1e-6, rtol=0)


def test_a_moved_camera_sees_the_moved_scene_as_before(some) -> None:
    """Harmonics included: colours of degree 2 change with the direction they are seen from."""
    move = turned(scale=1.3, shift=(0.3, -0.2, 1.0))
    view = camera()
    before = render(some, view, backend=BACKEND).image
    moved = transform(some, move).gaussians
    after = render(moved, view.moved(move), backend=BACKEND).image
    assert float((after - before).abs().max()) < 2e-3
    flat = moved.replace(sh=some.sh)  # harmonics that were left behind
    assert (
        float((render(flat, view.moved(move), backend=BACKEND).image - before).abs().max()) > 0.05
    )


def test_a_colour_that_is_set_is_seen(some, half) -> None:
    edited = recolour(some, half, colour=(0.2, 0.4, 0.6), view_dependent=False)
    colours = edited.gaussians[half.mask].colours
    torch.testing.assert_close(colours, torch.tensor([[0.2, 0.4, 0.6]]).expand_as(colours))
    assert not edited.gaussians.sh[half.mask][:, 1:].any()
    same(edited.gaussians[~half.mask], some[~half.mask])
    kept = recolour(some, half, colour=(0.2, 0.4, 0.6)).gaussians
    assert torch.equal(kept.sh[:, 1:], some.sh[:, 1:])


def test_scale_and_shift_hold_for_every_direction(some) -> None:
    # Bright, so that no colour is clamped at 0.
    bright = some.replace(sh=torch.cat((some.sh[:, :1].abs() + 6, some.sh[:, 1:]), dim=1))
    edited = recolour(bright, scale=(0.5, 1.0, 2.0), shift=(0.1, 0.0, -0.2)).gaussians
    drawn = render(bright, camera(), backend=BACKEND)
    expected = drawn.image * torch.tensor([0.5, 1.0, 2.0])
    expected += drawn.alpha[..., None] * torch.tensor([0.1, 0.0, -0.2])
    torch.testing.assert_close(
        render(edited, camera(), backend=BACKEND).image, expected, atol=1e-4, rtol=1e-5
    )


def test_merged_scenes_draw_as_both_would(rng, some) -> None:
    other = random_gaussians(rng, 7, coefficients=4)
    other = other.replace(extra={"score": torch.rand(7, 2)})
    edited = merge(some, other, target_from_other=turned(shift=(0.0, 0.0, 1.0)))
    assert edited.rows.tolist() == [*range(24), *[-1] * 7]
    assert edited.gaussians.sh.shape == (31, 9, 3)
    same(edited.gaussians[:24].replace(extra={}), some.replace(extra={}))
    assert not edited.gaussians.extra["score"][:24].any()
    assert torch.equal(edited.gaussians.extra["score"][24:], other.extra["score"])
    moved = other.transformed(turned(shift=(0.0, 0.0, 1.0)))
    torch.testing.assert_close(
        render(edited.gaussians[24:], camera(), backend=BACKEND).image,
        render(moved, camera(), backend=BACKEND).image,
    )


def test_layers_follow_every_edit(rng, some, half) -> None:
    layers = layers_of(rng, 24)
    for edited in (
        extract(some, half),
        remove(some, half),
        duplicate(some, half, turned()),
        transform(some, turned(), selection=half),
        recolour(some, half, shift=(0.1, 0.1, 0.1)),
    ):
        numbers = edited.gaussians.extra["number"]
        objects = apply_rows(layers["objects"], edited)
        assert torch.equal(objects.ids, layers["objects"].ids[numbers])
        assert torch.equal(objects.confidence, layers["objects"].confidence[numbers])
        assert torch.equal(objects.candidates, layers["objects"].candidates[numbers])
        assert torch.equal(objects.shares, layers["objects"].shares[numbers])
        assert torch.equal(objects.evidence, layers["objects"].evidence[numbers])
        assert torch.equal(objects.inferred, layers["objects"].inferred[numbers])
        assert objects.background == 7
        assert objects.info == LayerInfo(names={3: "chair"})
        colours = apply_rows(layers["colours"], edited)
        assert torch.equal(colours.values, layers["colours"].values[numbers])
        assert torch.equal(colours.weights, layers["colours"].weights[numbers])
        picked = apply_rows(layers["picked"], edited)
        assert torch.equal(picked.mask, layers["picked"].mask[numbers])


def test_new_rows_know_nothing(rng, some) -> None:
    layers = layers_of(rng, 24)
    edited = merge(some, some[:3])
    objects = apply_rows(layers["objects"], edited)
    assert objects.ids[24:].tolist() == [-1] * 3
    assert objects.candidates[24:].tolist() == [[-1, -1]] * 3
    for column in (
        objects.confidence,
        objects.shares,
        objects.evidence,
        objects.effective_views,
        objects.inferred,
    ):
        assert not column[24:].any()
    assert not apply_rows(layers["colours"], edited).values[24:].any()
    assert not apply_rows(layers["picked"], edited).mask[24:].any()


def test_edits_one_after_the_other_are_one(rng, some, half) -> None:
    first = duplicate(some, half, turned())
    second = remove(first.gaussians, Selection(mask=torch.arange(36) % 3 == 0))
    third = merge(second.gaussians, some[:2])
    whole = first.then(second).then(third)
    for layer in layers_of(rng, 24).values():
        step = apply_rows(apply_rows(apply_rows(layer, first), second), third)
        once = apply_rows(layer, whole)
        for name in ("ids", "values", "mask"):
            if hasattr(step, name):
                assert torch.equal(getattr(step, name), getattr(once, name))
    assert torch.equal(whole.rows[:-2], whole.gaussians.extra["number"][:-2])
    assert whole.rows[-2:].tolist() == [-1, -1]


def nothing(count: int) -> Selection:
    return Selection(mask=torch.zeros(count, dtype=torch.bool))


@pytest.mark.parametrize(
    "edit",
    [
        lambda g, s: extract(g, s),
        lambda g, s: remove(g, s),
        lambda g, s: duplicate(g, s, turned()),
        lambda g, s: transform(g, turned(), selection=s),
        lambda g, s: recolour(g, s, colour=(1, 0, 0)),
    ],
)
def test_a_wrong_selection_is_refused(some, edit) -> None:
    with pytest.raises(InputError, match="selection: expected at least one Gaussian, got none"):
        edit(some, nothing(24))
    with pytest.raises(ShapeError, match="expected one over 24 Gaussians, got one over 5"):
        edit(some, nothing(5))


def test_hostile_values_are_refused(some) -> None:
    with pytest.raises(InputError, match="expected to leave Gaussians, got all 24"):
        remove(some, ~nothing(24))
    with pytest.raises(RangeError, match="scale: expected more than 0, got 0"):
        turned(scale=0.0)
    with pytest.raises(RangeError, match="translation: 1 of 3 values are not finite"):
        turned(shift=(0.0, math.nan, 0.0))
    with pytest.raises(RangeError, match="colour: expected values in"):
        recolour(some, colour=(0.5, 2.0, 0.5))
    with pytest.raises(RangeError, match="scale: expected values in"):
        recolour(some, scale=(1.0, -1.0, 1.0))
    with pytest.raises(RangeError, match="shift: 1 of 3 values are not finite"):
        recolour(some, shift=(0.0, 0.0, math.nan))
    with pytest.raises(ShapeError, match="colour: expected red, green and blue, got 2 numbers"):
        recolour(some, colour=(0.5, 0.5))
    with pytest.raises(InputError, match=r"expected antialiased to be False"):
        merge(some, some.replace(antialiased=True))
    wide = some.replace(extra={"number": torch.zeros(24, 2)})
    with pytest.raises(InputError, match=r"extra\['number'\]: expected the same width"):
        merge(some, wide)


def test_rows_that_lead_nowhere_are_refused(some, half, rng) -> None:
    with pytest.raises(RangeError, match="rows: expected -1 or more, got -2"):
        Edited(gaussians=some[:1], rows=torch.tensor([-2]))
    with pytest.raises(ShapeError, match="got one of row 22"):
        apply_rows(layers_of(rng, 5)["picked"], extract(some, half))
    with pytest.raises(ShapeError, match="expected an edit of 12 rows, got one of row 23"):
        extract(some, half).then(Edited.unchanged(some))


def test_an_empty_scene_can_be_joined(some) -> None:
    edited = merge(some[:0], some)
    same(edited.gaussians, some)
    assert edited.rows.tolist() == [-1] * 24
    assert np.isfinite(edited.gaussians.means.numpy()).all()


def test_old_rows_of_a_mask_are_those_with_a_new_row_in_it(some) -> None:
    edited = Edited(gaussians=some[:5], rows=torch.tensor([2, 0, 2, -1, 3]))
    mask = torch.tensor([True, False, False, True, True])
    assert edited.rows_before(mask, 4).tolist() == [False, False, True, True]
    assert edited.rows_before(~mask, 4).tolist() == [True, False, True, False]
    with pytest.raises(ShapeError, match="mask"):
        edited.rows_before(mask[:4], 4)
    with pytest.raises(ShapeError, match="an edit of 3 rows"):
        edited.rows_before(mask, 3)
    assert not edited.rows_before(torch.zeros(5, dtype=torch.bool), 4).any()
