"""Who says nothing draws with the backend's own opacity cap; who asks gets it or is refused."""

import pytest
import torch

from splatseg.errors import InputError
from splatseg.render import RenderOptions, default_options, get_backend
from splatseg.render import _registry as registry
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
