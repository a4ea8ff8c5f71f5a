"""Blocks are reduced by the components of all their patches, with the class token."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from splatseg.core import FeatureMap
from splatseg.core.models import DeepFeatures
from splatseg.errors import InputError, ShapeError
from splatseg.methods.cosseg.features import ReducedBlocks, distilled_features, pixel_counts
from splatseg.render import options_for, weights

from .conftest import Blocks


def deep(seed: int, *, token: bool = True, widths=(6, 3)) -> DeepFeatures:
    rng = np.random.default_rng(seed)
    maps = tuple(
        FeatureMap(
            features=torch.from_numpy(rng.normal(2.0, 1.0, (3, 4, width)).astype(np.float32)),
            stride=8, height=24, width=32,
        )
        for width in widths
    )  # fmt: skip
    given = torch.from_numpy(rng.normal(size=6).astype(np.float32)) if token else None
    return DeepFeatures(maps=maps, depths=("block3", "block6"), class_token=given)


def source(**more) -> Blocks:
    return Blocks({f"v{i}": deep(i, **more) for i in range(3)})


def test_components_are_those_of_all_patches_and_tokens() -> None:
    given = Blocks({name: replace(one, maps=one.maps[:1], depths=("block3",))
                    for name, one in source().found.items()})  # fmt: skip
    found = ReducedBlocks(given, given.view_names, components=4)
    joined = {
        name: np.concatenate(
            (one.maps[0].features.numpy(), np.broadcast_to(one.class_token.numpy(), (3, 4, 6))), -1
        )
        for name, one in given.found.items()
    }
    patches = np.concatenate([one.reshape(-1, 12) for one in joined.values()]).astype(np.float64)
    _, _, axes = np.linalg.svd(patches - patches.mean(axis=0), full_matrices=False)
    expected = (joined["v1"] - patches.mean(axis=0)) @ axes[:4].T
    expected /= np.linalg.norm(expected, axis=-1, keepdims=True)
    got = found.features("v1")
    assert (got.stride, got.height, got.width) == (8, 24, 32)
    values = got.features.numpy()
    signs = np.sign((values * expected).sum(axis=(0, 1)))
    np.testing.assert_allclose(values * signs, expected, atol=2e-5)
    assert found.steps == {"class token": True, "principal components": True}


def test_narrow_blocks_keep_their_channels_and_length_becomes_1() -> None:
    given = source(token=False)
    found = ReducedBlocks(given, given.view_names, components=4)
    assert found.columns == (slice(0, 4), slice(4, 7))
    assert found.steps == {"class token": False, "principal components": True}
    values = found.features("v2").features
    narrow = given.found["v2"].maps[1].features
    torch.testing.assert_close(values[..., 4:], torch.nn.functional.normalize(narrow, dim=-1))
    torch.testing.assert_close(values[..., :4].norm(dim=-1), torch.ones(3, 4))
    kept = ReducedBlocks(given, given.view_names, components=8)
    assert kept.steps == {"class token": False, "principal components": False}
    assert kept.columns == (slice(0, 6), slice(6, 9))


def test_a_narrow_block_beside_a_token_stands_for_itself() -> None:
    given = source()
    found = ReducedBlocks(given, given.view_names, components=4)
    assert found.columns == (slice(0, 4), slice(4, 7))
    narrow = torch.nn.functional.normalize(given.found["v0"].maps[1].features, dim=-1)
    torch.testing.assert_close(found.features("v0").features[..., 4:], narrow)
    kept = ReducedBlocks(given, given.view_names, components=6)
    assert kept.steps == {"class token": False, "principal components": False}


def test_views_that_differ_are_refused() -> None:
    given = source()
    given.found["v1"] = replace(given.found["v1"], depths=("block3", "block9"))
    with pytest.raises(InputError, match="expected the blocks block3, block6 of view v1"):
        ReducedBlocks(given, given.view_names, components=4)
    given = source()
    given.found["v1"] = deep(1, token=False)
    with pytest.raises(InputError, match="expected a class token of view v1"):
        ReducedBlocks(given, given.view_names, components=4)
    given = source()
    given.found["v2"] = deep(2, widths=(5, 3))
    with pytest.raises(ShapeError, match="expected 6 channels of block3 of view v2"):
        ReducedBlocks(given, given.view_names, components=4)
    given = source()
    first, second = given.found["v2"].maps
    other = replace(second, features=second.features[:2], height=16)
    given.found["v2"] = replace(given.found["v2"], maps=(first, other))
    with pytest.raises(ShapeError, match="blocks of view v2 on one grid"):
        ReducedBlocks(given, given.view_names, components=4)


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


def lifted(halves, pixels=None):
    return distilled_features(
        halves.gaussians, halves.views, halves.blocks, pixels=pixels, backend=DRAWN_BY
    )


@pytest.mark.parametrize("division", ["mean", "pixels"])
def test_against_the_matrix(halves, division) -> None:
    from splatseg.lift.voting.features import read_grid

    rows = dense(halves)
    count = np.sum([(one > 0).sum(axis=0) for one in rows], axis=0)
    found = lifted(halves, torch.from_numpy(count) if division == "pixels" else None)
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
            total = total / np.sqrt((total**2).sum(axis=1).mean())
        np.testing.assert_allclose(scale.float().numpy(), total, rtol=5e-3, atol=2e-3)


def test_pixels_are_counted(halves) -> None:
    expected = np.sum([(one > 0).sum(axis=0) for one in dense(halves)], axis=0)
    found = pixel_counts(halves.gaussians, halves.views, backend=DRAWN_BY)
    np.testing.assert_array_equal(found.numpy(), expected)
    given = lifted(halves, found * 2)
    twice = lifted(halves, found)
    torch.testing.assert_close(given.scales[0], twice.scales[0], rtol=1e-2, atol=1e-3)


def test_smaller_views_are_a_little_blurred(halves, monkeypatch) -> None:
    whole = lifted(halves)
    monkeypatch.setattr("splatseg.methods.cosseg.features.LIFTED_SIDE", 16)
    small = lifted(halves)
    difference = (small.scales[0].float() - whole.scales[0].float()).abs()
    assert 0 < float(difference.mean()) < 0.1


def test_features_missing_for_some_views(halves) -> None:
    some = Blocks({name: one for name, one in halves.blocks.found.items() if name != "v2"})
    with pytest.raises(InputError, match="1 of 4 have none, the first is v2"):
        distilled_features(halves.gaussians, halves.views, some, backend=DRAWN_BY)
