"""Which backend computes W. Asking for one by name never gives another."""

from functools import cache
from typing import Literal, cast

from torch import Tensor

from splatseg._check import check_choice
from splatseg.core import Gaussians
from splatseg.core.boundary import boundary
from splatseg.core.gaussians import LOW_PASS
from splatseg.render._backend import Backend
from splatseg.render._options import RenderOptions

BackendName = Literal["auto", "cpu", "cuda", "reference"]
BACKENDS: tuple[BackendName, ...] = ("auto", "cpu", "cuda", "reference")


@boundary
def get_backend(name: str = "auto", *, like: Tensor | None = None) -> Backend:
    """The backend of this name.

    ``auto`` is ``cuda`` for tensors on a CUDA device and ``cpu`` for all others: it follows the
    data and never falls back.

    Args:
        name: ``auto``, ``cpu``, ``cuda`` or ``reference``.
        like: A tensor of the scene; ``auto`` asks where it is.

    Raises:
        InputError: If there is no backend of this name.
        MissingPackageError: If ``cuda`` is asked for without gsplat or without a GPU.
    """
    check_choice("backend", name, BACKENDS)
    if name == "auto":
        name = "cuda" if like is not None and like.device.type == "cuda" else "cpu"
    return _backend(cast(BackendName, name))


@boundary
def options_for(gaussians: Gaussians, backend: str = "auto") -> RenderOptions:
    """The default options for Gaussians.

    The `default_options` of the backend, with the low-pass filter that they were fitted with.
    """
    return default_options(
        backend,
        like=gaussians.means,
        antialiased=gaussians.antialiased,
        low_pass=gaussians.low_pass,
    )


@boundary
def default_options(
    name: str = "auto",
    *,
    like: Tensor | None = None,
    sh_degree: int | None = None,
    antialiased: bool = False,
    low_pass: float = LOW_PASS,
) -> RenderOptions:
    """The default options of a backend.

    The defaults of `RenderOptions`, but for the opacity cap of ``cuda``, which gsplat has built
    in (``docs/decisions/0006-cuda-opacity-cap.md``).

    Args:
        name: As for `get_backend`.
        like: As for `get_backend`.
        sh_degree: Maximum degree of the spherical harmonics in use; None is all.
        antialiased: What the Gaussians are meant for, `Gaussians.antialiased`.
        low_pass: Likewise, `Gaussians.low_pass`.
    """
    if get_backend(name, like=like).name == "cuda":
        from splatseg.render.cuda import GSPLAT_ALPHA_MAX

        return RenderOptions(
            alpha_max=GSPLAT_ALPHA_MAX,
            sh_degree=sh_degree,
            antialiased=antialiased,
            low_pass=low_pass,
        )
    return RenderOptions(sh_degree=sh_degree, antialiased=antialiased, low_pass=low_pass)


@cache
def _backend(name: BackendName) -> Backend:
    if name == "cuda":
        from splatseg.render.cuda import CudaBackend

        return CudaBackend()
    if name == "reference":
        from splatseg.render.reference import ReferenceBackend

        return ReferenceBackend()
    from splatseg.render.cpu import CpuBackend

    return CpuBackend()
