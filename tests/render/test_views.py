"""Views through a lens: forward, adjoint, picking and W of a distorted photograph."""

import pytest
import torch

from splatseg.core import Camera, Gaussians
from splatseg.errors import InputError
from splatseg.render import (
    RenderOptions,
    back_project,
    contributors,
    default_options,
    get_backend,
    options_for,
    prepare,
    render,
    weights,
)
from splatseg.render import _backend as registry
from splatseg.render.cuda import GSPLAT_ALPHA_MAX
from splatseg.render.warp import Warp, undistorted_camera, warp_into_photograph

BACKEND = "reference"
LENSES = [("opencv", (-0.2, 0.05, 1e-3, -2e-3)), ("fisheye", (0.02, -0.01))]


def camera_of(lens=LENSES[0], width: int = 15, height: int = 11) -> Camera:
    return Camera(
        width=width,
        height=height,
        fx=13.0,
        fy=12.0,
        cx=7.0,
        cy=6.0,
        cam_from_world=torch.eye(4, dtype=torch.float64),
        model=lens[0],
        distortion=lens[1],
    )


@pytest.fixture
def gaussians(rng) -> Gaussians:
    n = 12
    rotations = torch.from_numpy(rng.normal(size=(n, 4)))
    return Gaussians(
        means=torch.from_numpy(rng.uniform((-1, -0.8, 1.5), (1, 0.8, 3), (n, 3))),
        rotations=rotations / rotations.norm(dim=1, keepdim=True),
        scales=torch.from_numpy(rng.uniform(0.1, 0.4, (n, 3))),
        opacities=torch.from_numpy(rng.uniform(0.3, 0.9, n)),
        sh=torch.from_numpy(rng.normal(size=(n, 1, 3))) * 0.3,
    )


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("mode", ["bilinear", "nearest"])
def test_back_project_is_the_adjoint_of_render(rng, gaussians, lens, mode) -> None:
    camera = camera_of(lens)
    signal = torch.from_numpy(rng.normal(size=(12, 5)))
    image = torch.from_numpy(rng.normal(size=(11, 15, 5)))
    options = {"backend": BACKEND, "warp": mode}
    drawn = render(gaussians, camera, signal, **options)
    back = back_project(gaussians, camera, image, **options)
    left, right = float((drawn.image * image).sum()), float((signal * back.sums).sum())
    assert left == pytest.approx(right, rel=1e-6)
    # The weights are the photograph's: together as much light as alpha says.
    assert float(back.weights.sum()) == pytest.approx(float(drawn.alpha.sum()), rel=1e-6)
    ones = back_project(gaussians, camera, torch.ones(11, 15, 1).double(), **options)
    torch.testing.assert_close(ones.sums[:, 0], back.weights)


@pytest.mark.parametrize("lens", LENSES)
def test_a_view_is_the_straight_view_seen_through_the_lens(gaussians, lens) -> None:
    camera = camera_of(lens)
    straight = render(gaussians, undistorted_camera(camera), backend=BACKEND)
    for mode in ("bilinear", "nearest"):
        warp = Warp.between(camera, undistorted_camera(camera), mode)
        drawn = render(gaussians, camera, backend=BACKEND, warp=mode)
        torch.testing.assert_close(drawn.image, warp.apply(straight.image))
        torch.testing.assert_close(drawn.alpha, warp.apply(straight.alpha[..., None])[..., 0])
        light = warp.apply((straight.alpha * straight.depth)[..., None])[..., 0]
        covered = drawn.alpha > 0
        assert int(covered.sum()) > 0
        torch.testing.assert_close(drawn.depth[covered], (light / drawn.alpha)[covered])
        assert bool((drawn.depth[~covered] == 0).all())
        median = warp_into_photograph(camera, "nearest").apply(straight.median_depth[..., None])
        assert torch.equal(drawn.median_depth, median[..., 0])


def test_depth_of_a_plane_stays_its_depth_at_the_silhouette() -> None:
    """Depths are averaged by weight: beside an empty pixel they do not sink towards 0."""
    one = Gaussians(
        means=torch.tensor([[0.0, 0.0, 2.0]]),
        rotations=torch.tensor([[1.0, 0, 0, 0]]),
        scales=torch.full((1, 3), 0.2),
        opacities=torch.tensor([0.9]),
        sh=torch.zeros(1, 1, 3),
    )
    drawn = render(one, camera_of(), backend=BACKEND)
    covered = drawn.alpha > 0
    assert bool(covered.any())
    assert not bool(covered.all())
    torch.testing.assert_close(
        drawn.depth[covered], torch.full_like(drawn.depth[covered], 2.0), rtol=1e-5, atol=0
    )


def test_gradients_pass_the_lens(rng, gaussians) -> None:
    camera = camera_of()
    signal = torch.from_numpy(rng.normal(size=(12, 2))).requires_grad_()
    image = torch.from_numpy(rng.normal(size=(11, 15, 2)))
    (render(gaussians, camera, signal, backend=BACKEND).image * image).sum().backward()
    expected = back_project(gaussians, camera, image, backend=BACKEND).sums
    torch.testing.assert_close(signal.grad, expected.to(signal.grad), rtol=1e-5, atol=1e-7)


def test_contributors_and_w_read_the_nearest_straight_pixel(gaussians) -> None:
    camera = camera_of()
    pixels = torch.tensor([[0, 0], [14, 10], [7, 5], [3, 8]])
    at, found = warp_into_photograph(camera, "nearest").nearest_sources(pixels)
    assert bool(found.all())
    assert not torch.equal(at, pixels)
    seen = contributors(gaussians, camera, pixels, 3, backend=BACKEND)
    straight = contributors(gaussians, undistorted_camera(camera), at, 3, backend=BACKEND)
    assert torch.equal(seen.ids, straight.ids)
    assert torch.equal(seen.weights, straight.weights)

    ones = torch.ones(12, 1, dtype=torch.float32)
    alpha = render(gaussians, camera, backend=BACKEND, warp="nearest").alpha.float()
    whole = weights(gaussians, camera, backend=BACKEND)
    assert whole.shape == (15 * 11, 12)
    torch.testing.assert_close(whole.product(ones)[:, 0], alpha.reshape(-1), rtol=0, atol=2e-3)
    some = weights(gaussians, camera, pixels, backend=BACKEND)
    torch.testing.assert_close(
        some.product(ones)[:, 0], alpha[pixels[:, 1], pixels[:, 0]], rtol=0, atol=2e-3
    )
    with pytest.raises(InputError, match="camera: expected one without distortion"):
        prepare(gaussians, camera, backend=BACKEND).part_sums([])


@pytest.mark.parametrize("lens", LENSES)
def test_rows_of_w_sum_to_the_alpha_of_the_nearest_warp(lens) -> None:
    """A small opaque thing in a corner, where the lens moves pixels by most of one."""
    thing = Gaussians(
        means=torch.tensor([[0.75, -0.55, 2.0]]),
        rotations=torch.tensor([[1.0, 0, 0, 0]]),
        scales=torch.full((1, 3), 0.06),
        opacities=torch.tensor([0.99]),
        sh=torch.zeros(1, 1, 3),
    )
    camera = camera_of(lens)
    rows = weights(thing, camera, backend="cpu").product(torch.ones(1, 1))[:, 0].reshape(11, 15)
    alpha = {
        mode: render(thing, camera, backend="cpu", warp=mode).alpha
        for mode in ("nearest", "bilinear")
    }
    torch.testing.assert_close(rows, alpha["nearest"], rtol=0, atol=2e-3)
    assert float((rows - alpha["bilinear"]).abs().max()) > 0.02
    # By hand: what bilinear reads is the mean of four rows, by how near they are.
    straight = render(thing, undistorted_camera(camera), backend="cpu").alpha
    at = (
        undistorted_camera(camera)
        .project(
            camera.unproject(camera.pixel_centres(), torch.ones(11, 15).double()).reshape(-1, 3)
        )[0]
        .reshape(11, 15, 2)
    )
    v, u = divmod(int(alpha["nearest"].argmax()), 15)
    x, y = (at[v, u] - 0.5).tolist()
    i, j = int(x), int(y)
    across, down = x - i, y - j
    taps = straight[j : j + 2, i : i + 2]
    expected = (1 - down) * ((1 - across) * taps[0, 0] + across * taps[0, 1])
    expected += down * ((1 - across) * taps[1, 0] + across * taps[1, 1])
    assert float(alpha["bilinear"][v, u]) == pytest.approx(float(expected), abs=1e-4)
    nearest = straight[int(at[v, u, 1]), int(at[v, u, 0])]
    assert float(rows[v, u]) == pytest.approx(float(nearest), abs=2e-3)


# Who says nothing draws with the backend's own opacity cap; who asks gets it or is refused.


def test_the_cpu_draws_with_the_cap_of_3dgs() -> None:
    assert default_options("cpu") == RenderOptions()
    assert default_options("reference", sh_degree=1) == RenderOptions(sh_degree=1)


def test_cuda_draws_with_the_cap_that_gsplat_has(monkeypatch: pytest.MonkeyPatch) -> None:
    class Cuda:
        name = "cuda"

    monkeypatch.setattr(registry, "_backend", lambda _: Cuda())
    assert default_options("cuda") == RenderOptions(alpha_max=GSPLAT_ALPHA_MAX)
    assert pytest.approx(0.999) == GSPLAT_ALPHA_MAX


def test_auto_follows_the_data() -> None:
    assert get_backend("auto", like=torch.zeros(1)).name == "cpu"
    with pytest.raises(InputError, match="expected one of auto, cpu, cuda, reference, got 'gpu'"):
        get_backend("gpu")


def test_gaussians_are_drawn_as_they_are_meant() -> None:
    """A small far Gaussian, 0.1 px wide: the low-pass alone would make it brighter.

    Antialiased, its opacity shrinks by sqrt(det S / det (S + 0.3 I)) = 0.01 / (0.01 + 0.3).
    """
    camera = Camera(
        width=3, height=3, fx=10.0, fy=10.0, cx=1.5, cy=1.5, cam_from_world=torch.eye(4)
    )
    gaussians = Gaussians(
        means=torch.tensor([[0.0, 0.0, 10.0]]),
        rotations=torch.eye(4)[:1],
        scales=torch.full((1, 3), 0.1),
        opacities=torch.tensor([0.9]),
        sh=torch.zeros(1, 1, 3),
    )
    meant = gaussians.replace(antialiased=True)
    assert options_for(gaussians) == RenderOptions()
    assert options_for(meant) == RenderOptions(antialiased=True)
    assert options_for(meant.replace(low_pass=0.1)) == RenderOptions(antialiased=True, low_pass=0.1)
    expected = 0.9 * 0.01 / 0.31
    pixel = torch.tensor([[1, 1]])
    assert float(render(gaussians, camera).alpha[1, 1]) == pytest.approx(0.9, rel=1e-5)
    assert float(render(meant, camera).alpha[1, 1]) == pytest.approx(expected, rel=1e-4)
    assert float(contributors(meant, camera, pixel, 1).weights) == pytest.approx(expected, rel=1e-4)
    rows = weights(meant, camera, pixel)
    assert float(rows.product(torch.ones(1, 1))) == pytest.approx(expected, rel=1e-3)
    image = torch.zeros(3, 3, 1)
    image[1, 1] = 1
    assert float(back_project(meant, camera, image).sums) == pytest.approx(expected, rel=1e-4)
    # Whoever gives options means them.
    plain = render(meant, camera, options=RenderOptions())
    assert float(plain.alpha[1, 1]) == pytest.approx(0.9, rel=1e-5)
