"""Rows of W: contributors and kept weights, against W as a dense matrix."""

import pytest
import torch
from render_scenes import dense_weights, float32, random_camera, random_gaussians

from splatseg import render as splat
from splatseg.errors import InputError, RangeError

COUNT, WIDTH, HEIGHT = 150, 30, 23


@pytest.fixture
def camera(rng):
    return random_camera(rng, width=WIDTH, height=HEIGHT)


@pytest.fixture
def scene(rng):
    return random_gaussians(rng, COUNT, sh_degree=0)


def _pixels(rng, count: int) -> torch.Tensor:
    """(column, row), with repetitions and the corners."""
    corners = torch.tensor([[0, 0], [WIDTH - 1, 0], [0, HEIGHT - 1], [WIDTH - 1, HEIGHT - 1]])
    inside = torch.stack(
        (
            torch.from_numpy(rng.integers(0, WIDTH, count)),
            torch.from_numpy(rng.integers(0, HEIGHT, count)),
        ),
        dim=1,
    )
    return torch.cat((corners, inside, inside[:3]))


def _csr_to_dense(kept: splat.SparseWeights) -> torch.Tensor:
    dense = torch.zeros(kept.shape)
    rows = torch.repeat_interleave(torch.arange(kept.shape[0]), kept.indptr.diff())
    dense[rows, kept.ids.long()] = kept.weights.float()
    return dense


def _depths(camera, scene) -> torch.Tensor:
    return camera.project(scene.means.double())[1]


@pytest.mark.parametrize("k", [1, 3, 40])
def test_contributors_are_the_strongest_entries_of_the_row(backend, rng, camera, scene, k):
    dense = dense_weights(backend, scene, camera)
    depth = _depths(camera, scene)
    pixels = _pixels(rng, 200)
    found = backend.contributors(scene, camera, pixels, k)
    assert found.ids.dtype == found.first.dtype == found.median.dtype == torch.int32
    assert found.ids.shape == found.weights.shape == (len(pixels), k)
    for p, (column, row) in enumerate(pixels.tolist()):
        weights = dense[row * WIDTH + column]
        held = torch.nonzero(weights)[:, 0]
        number = min(k, len(held))
        ids = found.ids[p]
        assert (ids[:number] >= 0).all()
        assert (ids[number:] == -1).all()
        assert not found.weights[p, number:].any()
        assert len(set(ids[:number].tolist())) == number
        # The weights are those of W, in falling order, and no stronger one is left out.
        torch.testing.assert_close(
            found.weights[p, :number], weights[ids[:number].long()], atol=2e-6, rtol=1e-5
        )
        strongest = weights.sort(descending=True).values[:number]
        torch.testing.assert_close(found.weights[p, :number], strongest, atol=2e-6, rtol=1e-5)
        assert (found.weights[p].diff() <= 0).all()
        if len(held) == 0:
            assert found.first[p] == found.median[p] == -1
            continue
        order = held[depth[held].argsort()]
        assert int(found.first[p]) == int(order[0])
        # T behind each is 1 minus the weights so far.
        behind = 1 - weights[order].double().cumsum(0)
        half = torch.nonzero(behind <= 0.5)[:, 0]
        if len(half) == 0 or abs(float(behind[half[0]]) - 0.5) > 1e-5:
            assert int(found.median[p]) == (int(order[half[0]]) if len(half) else -1)


def test_median_contributor_has_the_median_depth(backend, camera, scene):
    drawn = backend.render(scene, camera)
    row, column = torch.meshgrid(torch.arange(HEIGHT), torch.arange(WIDTH), indexing="ij")
    pixels = torch.stack((column, row), -1).reshape(-1, 2)
    found = backend.contributors(scene, camera, pixels, 1)
    depth = torch.where(
        found.median >= 0, _depths(camera, scene)[found.median.long().clamp_min(0)], 0.0
    )
    torch.testing.assert_close(drawn.median_depth.flatten(), depth.float(), rtol=1e-6, atol=0)


@pytest.mark.parametrize("channels", [1, 5, 64])
def test_kept_weights_render_and_back_project(backend, rng, camera, scene, channels):
    """Half precision rounds each weight by at most 2^-11 of it."""
    kept = backend.weights(scene, camera)
    assert kept.shape == (WIDTH * HEIGHT, COUNT)
    assert kept.nbytes > 0
    signal = float32(rng.normal(size=(COUNT, channels)))
    image = float32(rng.normal(size=(HEIGHT, WIDTH, channels)))
    drawn = backend.render(scene, camera, signal).image.reshape(-1, channels)
    back = backend.back_project(scene, camera, image)
    bound = float(signal.abs().max()) * 2**-10
    torch.testing.assert_close(kept.product(signal), drawn, atol=bound, rtol=0)
    sums = kept.adjoint(image.reshape(-1, channels))
    error = torch.linalg.vector_norm(sums - back.sums)
    assert error < 1e-3 * torch.linalg.vector_norm(back.sums)
    seen = kept.adjoint(torch.ones(WIDTH * HEIGHT, 1))[:, 0]
    torch.testing.assert_close(seen, back.weights, atol=1e-4, rtol=1e-3)
    # Whatever the weights were rounded to, the two products are each other's transpose.
    left = (kept.product(signal).double() * image.reshape(-1, channels)).sum()
    right = (signal.double() * sums).sum()
    scale = (drawn.double() * image.reshape(-1, channels)).abs().sum()
    assert abs(left - right) < 1e-5 * scale


def test_csr_holds_the_rows_front_to_back(backend, camera, scene):
    kept = backend.weights(scene, camera)
    assert isinstance(kept, splat.SparseWeights)
    assert kept.indptr.dtype == torch.int64
    assert kept.ids.dtype == torch.int32
    assert kept.weights.dtype == torch.float16
    assert kept.indptr[0] == 0
    assert kept.indptr[-1] == len(kept.ids) == len(kept.weights)
    dense = dense_weights(backend, scene, camera)
    torch.testing.assert_close(_csr_to_dense(kept), dense, atol=1e-6, rtol=2**-10)
    depth = _depths(camera, scene)
    for start, stop in zip(kept.indptr[:-1].tolist(), kept.indptr[1:].tolist(), strict=True):
        row = depth[kept.ids[start:stop].long()]
        assert (row.diff() >= -1e-6 * row[1:]).all()


def test_csr_of_some_pixels_has_their_rows(backend, rng, camera, scene):
    pixels = _pixels(rng, 50)
    every = _csr_to_dense(backend.weights(scene, camera))
    some = backend.weights(scene, camera, pixels)
    assert some.shape == (len(pixels), COUNT)
    rows = pixels[:, 1] * WIDTH + pixels[:, 0]
    torch.testing.assert_close(_csr_to_dense(some), every[rows], atol=1e-6, rtol=2**-10)


@pytest.mark.parametrize("of_pixels", [False, True])
def test_csr_can_keep_the_strongest_only(backend, rng, camera, scene, of_pixels):
    k = 2
    pixels = _pixels(rng, 60) if of_pixels else None
    every = _csr_to_dense(backend.weights(scene, camera, pixels))
    kept = backend.weights(scene, camera, pixels, k)
    assert (kept.indptr.diff() <= k).all()
    dense = _csr_to_dense(kept)
    expected = every.sort(dim=1, descending=True).values[:, :k]
    actual = dense.sort(dim=1, descending=True).values[:, :k]
    torch.testing.assert_close(actual, expected, atol=1e-6, rtol=2**-10)
    depth = _depths(camera, scene)
    for start, stop in zip(kept.indptr[:-1].tolist(), kept.indptr[1:].tolist(), strict=True):
        row = depth[kept.ids[start:stop].long()]
        assert (row.diff() >= -1e-6 * row[1:]).all(), "still front to back"


def test_an_empty_scene_has_an_empty_matrix(backend, rng, camera):
    kept = backend.weights(random_gaussians(rng, 0), camera)
    assert kept.shape == (WIDTH * HEIGHT, 0)
    assert not kept.product(torch.zeros(0, 4)).any()
    assert kept.adjoint(torch.ones(WIDTH * HEIGHT, 4)).shape == (0, 4)


def test_kept_weights_refuse_other_shapes(backend, camera, scene):
    kept = backend.weights(scene, camera)
    with pytest.raises(InputError, match="signal"):
        kept.product(torch.zeros(COUNT + 1, 2))
    with pytest.raises(InputError, match="image"):
        kept.adjoint(torch.zeros(WIDTH * HEIGHT - 1, 2))


def test_what_cannot_be_asked_for(backend, camera, scene):
    with pytest.raises(RangeError, match="pixels"):
        backend.contributors(scene, camera, torch.tensor([[WIDTH, 0]]), 1)
    with pytest.raises(RangeError, match="pixels"):
        backend.contributors(scene, camera, torch.tensor([[0, -1]]), 1)
    with pytest.raises(RangeError, match="k: "):
        backend.contributors(scene, camera, torch.tensor([[0, 0]]), 0)
