"""Features on Gaussians against the dense matrix W."""

import numpy as np
import pytest
import torch

from splatseg.errors import InputError
from splatseg.methods.cosseg._distilled import distilled_features, pixel_counts
from splatseg.render import options_for, weights

from .conftest import Blocks

DRAWN_BY = "auto"  # what renders is tested in lift


def dense(halves) -> list[np.ndarray]:
    """W of each view, (pixels, n)."""
    options = options_for(halves.gaussians, DRAWN_BY)
    return [
        weights(halves.gaussians, view.camera, options=options, backend=DRAWN_BY)
        .to_scipy()
        .toarray()
        for view in halves.views
    ]


def lifted(halves, division, **more):
    return distilled_features(
        halves.gaussians, halves.views, halves.blocks, components=8, division=division,
        backend=DRAWN_BY, **more,
    )  # fmt: skip


@pytest.mark.parametrize("division", ["mean", "sum", "pixels"])
def test_against_the_matrix(halves, division) -> None:
    from splatseg.lift.voting.features import read_grid

    rows = dense(halves)
    count = np.sum([(one > 0).sum(axis=0) for one in rows], axis=0)
    found = lifted(halves, division)
    assert (found.names, len(found.scales)) == (("block3", "block12"), 2)
    torch.testing.assert_close(
        found.weights, torch.from_numpy(np.sum([one.sum(axis=0) for one in rows], 0)).float(),
        rtol=1e-3, atol=1e-3,
    )  # fmt: skip
    for index, scale in enumerate(found.scales):
        total = 0.0
        for view, one in zip(halves.views, rows, strict=True):
            grid = halves.blocks.deep_features(view.name).maps[index].features
            unit = torch.nn.functional.normalize(grid, dim=-1)
            image = read_grid(unit, cells=(6, 8), size=(24, 32))
            total = total + one.T @ image.reshape(-1, image.shape[-1]).numpy()
        if division == "mean":
            total = total / np.maximum(found.weights.numpy(), 1e-9)[:, None]
        if division == "pixels":
            total = total / np.maximum(count, 1)[:, None]
        if division != "mean":
            total = total / np.sqrt((total**2).sum(axis=1).mean())
        np.testing.assert_allclose(scale.float().numpy(), total, rtol=5e-3, atol=2e-3)


def test_pixels_are_counted(halves) -> None:
    expected = np.sum([(one > 0).sum(axis=0) for one in dense(halves)], axis=0)
    found = pixel_counts(halves.gaussians, halves.views, backend=DRAWN_BY)
    np.testing.assert_array_equal(found.numpy(), expected)
    given = lifted(halves, "pixels", pixels=found * 2)
    twice = lifted(halves, "pixels", pixels=found)
    torch.testing.assert_close(given.scales[0], twice.scales[0], rtol=1e-2, atol=1e-3)


def test_smaller_views_are_a_little_blurred(halves) -> None:
    small, whole = lifted(halves, "mean", longest_side=16), lifted(halves, "mean")
    difference = (small.scales[0].float() - whole.scales[0].float()).abs()
    assert 0 < float(difference.mean()) < 0.1


def test_features_missing_for_some_views(halves) -> None:
    some = Blocks({name: one for name, one in halves.blocks.found.items() if name != "v2"})
    with pytest.raises(InputError, match="1 of 4 have none, the first is v2"):
        distilled_features(
            halves.gaussians, halves.views, some, components=8, division="mean", backend=DRAWN_BY
        )
