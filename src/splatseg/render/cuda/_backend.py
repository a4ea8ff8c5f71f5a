"""The CUDA backend: glue between our interface and gsplat (1.5.3 or later)."""

import importlib
from dataclasses import replace
from types import ModuleType
from typing import Any, ClassVar

import torch
from jaxtyping import Float, Int
from torch import Tensor

from splatseg.core import Camera, Gaussians
from splatseg.errors import BackendError, InputError, MissingPackageError
from splatseg.render._backend import Backend, BackendView, needs_graph
from splatseg.render._options import RenderOptions
from splatseg.render._rows import SparseWeights
from splatseg.render._values import BackProjected, Contributors, Rendered
from splatseg.render._view_weights import ImageWeights
from splatseg.render.cuda._view import GSPLAT_ALPHA_MAX, CudaView, colours
from splatseg.render.reference._backend import contributors_from_entries, rows_from_entries
from splatseg.render.reference._composite import Entries
from splatseg.render.reference._weights import blocks_from_csr


class CudaBackend(Backend):
    """gsplat's kernels, float32. Inputs may be anywhere; results are where the Gaussians are.

    gsplat caps alpha at 0.999 and cannot be told otherwise, so `RenderOptions.alpha_max` must
    say 0.999; any other value is refused, never replaced. Sums over pixels are in the order the
    GPU happens to take: `back_project` and gradients differ in the last digits between runs.
    """

    name: ClassVar[str] = "cuda"

    def __init__(self, *, library: ModuleType | None = None, device: str = "cuda") -> None:
        """Load gsplat.

        Args:
            library: What to use in place of gsplat (tests).
            device: Where to compute.

        Raises:
            MissingPackageError: If gsplat, or a GPU that torch can use, is missing.
            BackendError: If gsplat's kernels do not load.
        """
        self._device = torch.device(device)
        self._gsplat: Any = load_gsplat() if library is None else library

    def prepare(
        self, gaussians: Gaussians, camera: Camera, *, options: RenderOptions
    ) -> "CudaBackendView":
        """A prepared view, for any number of products.

        Raises:
            BackendError: If the options ask for what gsplat cannot do.
        """
        if options.alpha_max != GSPLAT_ALPHA_MAX:
            raise BackendError(
                f"alpha_max: the cuda backend (gsplat) has its opacity cap built in at "
                f"{GSPLAT_ALPHA_MAX}, got {options.alpha_max}; pass RenderOptions(alpha_max="
                f"{GSPLAT_ALPHA_MAX}), or use the cpu backend."
            )
        return CudaBackendView(gaussians, camera, options, gsplat=self._gsplat, device=self._device)


class CudaBackendView(BackendView):
    """One view on the GPU. Its projection is kept there, frozen, until it is closed."""

    def __init__(
        self,
        gaussians: Gaussians,
        camera: Camera,
        options: RenderOptions,
        *,
        gsplat: ModuleType | Any,
        device: torch.device,
    ) -> None:
        self._gaussians, self._camera, self._options = gaussians, camera, options
        self._gsplat: Any = gsplat
        self._device = device
        self._kept: tuple[Gaussians, CudaView] | None = None
        self._median: Tensor | None = None
        self._closed = False

    @property
    def size(self) -> tuple[int, int]:
        """Height and width."""
        return self._camera.height, self._camera.width

    def close(self) -> None:
        """Free the GPU's memory."""
        self._kept, self._median, self._closed = None, None, True

    def render(
        self,
        signal: Float[Tensor, "n channels"] | None = None,
        *,
        screen_offsets: Float[Tensor, "n 2"] | None = None,
    ) -> Rendered:
        """``W @ signal``; None is the colour of the SH. Differentiable in torch."""
        home, dtype = self._gaussians.device, self._gaussians.dtype
        graph = needs_graph(self._gaussians, self._camera, screen_offsets)
        gaussians, view = self._on_device(graph=graph)
        if screen_offsets is not None and len(gaussians):
            offsets = screen_offsets.to(device=self._device, dtype=torch.float32)
            view = replace(view, centres=view.centres + offsets)
        if signal is None:
            signal = colours(view, gaussians, self._camera, self._options.sh_degree)
        else:
            signal = signal.to(device=self._device, dtype=torch.float32)
        depths = view.for_visible(lambda rows: view.depths[0, rows, None])
        drawn, alpha = view.product(torch.cat((signal, depths), dim=1))
        covered = alpha > 0
        depth = torch.where(covered, drawn[..., -1] / torch.where(covered, alpha, 1.0), 0.0)
        median = self._median_depth(view, frozen=not graph)
        return Rendered(
            image=drawn[..., :-1].to(device=home, dtype=dtype),
            alpha=alpha.to(device=home, dtype=dtype),
            depth=depth.to(device=home, dtype=dtype),
            median_depth=median.to(device=home, dtype=dtype),
        )

    @torch.no_grad()
    def back_project(self, image: Float[Tensor, "height width channels"]) -> BackProjected:
        """``W.T @ image`` and ``W.T @ 1``: the gradient of a render towards its signal."""
        home, dtype = self._gaussians.device, self._gaussians.dtype
        _, view = self._on_device()
        image = image.to(device=self._device, dtype=torch.float32)
        sums = view.adjoint(torch.cat((image, torch.ones_like(image[..., :1])), dim=-1))
        sums = sums.to(device=home, dtype=dtype)
        return BackProjected(sums=sums[:, :-1], weights=sums[:, -1])

    @torch.no_grad()
    def contributors(self, pixels: Int[Tensor, "p 2"], k: int) -> Contributors:
        """The k strongest Gaussians of pixels (column, row), ties front to back."""
        found = self._entries(pixels)
        return contributors_from_entries(found, len(pixels), k, dtype=self._gaussians.dtype)

    @torch.no_grad()
    def rows(self, pixels: Int[Tensor, "p 2"] | None, k: int | None) -> SparseWeights:
        """Rows of W: all pixels or some, all entries or each pixel's k strongest."""
        count = self._camera.width * self._camera.height if pixels is None else len(pixels)
        found = self._entries(pixels)
        return rows_from_entries(found, k, shape=(count, len(self._gaussians)))

    def blocks(self) -> ImageWeights:
        """W in blocks of 4 x 4 pixels."""
        return blocks_from_csr(self.rows(None, None), self._camera.width, self._camera.height)

    def _on_device(self, *, graph: bool = False) -> tuple[Gaussians, CudaView]:
        """The Gaussians and their projection; new ones for a graph."""
        if self._closed:
            raise InputError("view: expected one that is open, this one was closed.")
        if graph:
            return self._project()
        if self._kept is None:
            with torch.no_grad():
                self._kept = self._project()
        return self._kept

    def _project(self) -> tuple[Gaussians, CudaView]:
        gaussians = self._gaussians.to(device=self._device, dtype=torch.float32)
        view = CudaView.of(gaussians, self._camera, options=self._options, gsplat=self._gsplat)
        return gaussians, view

    def _median_depth(self, view: CudaView, *, frozen: bool) -> Tensor:
        """Median depth (height, width); listing all entries for it is done once a view."""
        if frozen and self._median is not None:
            return self._median
        found = view.entries()
        median = torch.zeros(view.height * view.width, device=self._device)
        median[found.pixels[found.median]] = view.depths.detach()[0, found.ids[found.median]]
        median = median.reshape(view.height, view.width)
        if frozen:
            self._median = median
        return median

    def _entries(self, pixels: Tensor | None) -> Entries:
        """Entries of the rows asked for, renumbered, where the Gaussians are."""
        home = self._gaussians.device
        _, view = self._on_device()
        found = view.entries()
        if pixels is not None:
            pixels = pixels.to(device=self._device, dtype=torch.int64)
            found = _take_rows(found, pixels[:, 1] * self._camera.width + pixels[:, 0])
        return Entries(
            pixels=found.pixels.to(home),
            ids=found.ids.to(home),
            weights=found.weights.to(home),
            median=found.median.to(home),
        )


def _take_rows(found: Entries, rows: Tensor) -> Entries:
    """Entries of some pixels, in the order asked for; a pixel may be asked for twice."""
    start = torch.searchsorted(found.pixels, rows)
    count = torch.searchsorted(found.pixels, rows, right=True) - start
    asked = torch.repeat_interleave(torch.arange(len(rows), device=rows.device), count)
    before = torch.cumsum(count, dim=0) - count
    source = torch.arange(len(asked), device=rows.device) - before[asked] + start[asked]
    return Entries(
        pixels=asked,
        ids=found.ids[source],
        weights=found.weights[source],
        median=found.median[source],
    )


def load_gsplat(device: str = "cuda") -> ModuleType:
    """Import gsplat and see that its kernels run.

    Args:
        device: Where they are tried.

    Raises:
        MissingPackageError: If gsplat, or a GPU that torch can use, is missing.
        BackendError: If gsplat's kernels do not load.
    """
    if not torch.cuda.is_available():
        raise MissingPackageError(
            "backend 'cuda' needs an NVIDIA GPU and a torch that can use it, and torch sees "
            "none; install a CUDA build of torch (pytorch.org/get-started) or use the cpu "
            "backend."
        )
    try:
        gsplat = importlib.import_module("gsplat")
    except ImportError as error:
        raise MissingPackageError(
            f"backend 'cuda' needs a package that is not installed (gsplat). Try: pip install "
            f"'splatseg[cuda]'. {_compiles()}"
        ) from error
    try:
        gsplat.quat_scale_to_covar_preci(
            torch.ones(1, 4, device=device), torch.ones(1, 3, device=device)
        )
    except (AttributeError, ImportError, OSError, RuntimeError) as error:
        raise BackendError(
            f"backend 'cuda': gsplat is installed but its kernels do not load ({error}). "
            f"{_compiles()}"
        ) from error
    return gsplat


def _compiles() -> str:
    """What gsplat needs beside itself: its wheels end at torch 2.4 and Python 3.10."""
    toolkit = f" {torch.version.cuda}" if torch.version.cuda else ""
    return (
        f"gsplat 1.5.3 compiles its kernels at first use, in minutes: that needs nvcc of the CUDA "
        f"toolkit{toolkit}, the version torch was built with, and a C++ compiler (docs/install.md)."
    )
