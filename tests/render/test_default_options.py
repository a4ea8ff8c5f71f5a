"""Who says nothing draws with the backend's own opacity cap; who asks gets it or is refused."""

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
    render,
    weights,
)
from splatseg.render import _backend as registry
from splatseg.render.cuda import GSPLAT_ALPHA_MAX


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
