"""The CUDA backend: glue between our interface and gsplat (1.5.3 or later)."""

import importlib
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any, ClassVar

import torch
from jaxtyping import Float, Int
from torch import Tensor

from splatseg.core import Camera, Gaussians
from splatseg.core.sh import evaluate_sh
from splatseg.errors import BackendError, InputError, MissingPackageError
from splatseg.render._backend import Backend, BackendView, needs_graph
from splatseg.render._rows import SparseWeights
from splatseg.render._values import (
    ALPHA_MIN,
    MEDIAN_TRANSMITTANCE,
    BackProjected,
    Contributors,
    Rendered,
    RenderOptions,
)
from splatseg.render.blending import Entries
from splatseg.render.reference import contributors_from_entries, rows_from_entries


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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CudaView:
    """A projected scene. All tensors are float32, on the GPU, with one row a Gaussian."""

    gsplat: ModuleType | Any
    width: int
    height: int
    visible: Tensor
    """Rows that reach the image; the others' columns below hold no meaning."""
    centres: Tensor
    conics: Tensor
    depths: Tensor
    opacities: Tensor
    tile_starts: Tensor
    tile_ids: Tensor

    @staticmethod
    def of(
        gaussians: Gaussians,
        camera: Camera,
        *,
        options: RenderOptions,
        gsplat: ModuleType | Any,
    ) -> "CudaView":
        """Project, cull and sort; gradients flow to the Gaussians and the pose."""
        device = gaussians.device
        across, down = -(-camera.width // TILE), -(-camera.height // TILE)
        if len(gaussians) == 0:
            # gsplat divides by the number of Gaussians.
            return CudaView._empty(camera, gsplat=gsplat, device=device)
        pose = camera.cam_from_world.to(device=device, dtype=torch.float32)
        # gsplat keeps z >= near where we keep z > near.
        near = float(torch.nextafter(torch.tensor(options.near), torch.tensor(math.inf)))
        radii, centres, depths, conics, compensations = gsplat.fully_fused_projection(
            gaussians.means,
            None,
            gaussians.rotations,
            gaussians.scales,
            pose[None],
            camera.K.to(device=device, dtype=torch.float32)[None],
            camera.width,
            camera.height,
            eps2d=options.low_pass,
            near_plane=near,
            far_plane=math.inf,
            calc_compensations=options.antialiased,
            opacities=gaussians.opacities,
        )
        opacities = gaussians.opacities[None]
        visible = (radii[0] > 0).all(dim=-1)
        if options.antialiased:
            opacities = opacities * torch.where(visible, compensations, 0.0)
        _, keys, tile_ids = gsplat.isect_tiles(
            centres, radii, depths, TILE, across, down, packed=False
        )
        return CudaView(
            gsplat=gsplat,
            width=camera.width,
            height=camera.height,
            visible=torch.nonzero(visible)[:, 0],
            centres=centres,
            conics=conics,
            depths=depths,
            opacities=opacities,
            tile_starts=gsplat.isect_offset_encode(keys, 1, across, down).reshape(1, down, across),
            tile_ids=tile_ids,
        )

    @staticmethod
    def _empty(camera: Camera, *, gsplat: ModuleType | Any, device: torch.device) -> "CudaView":
        """The view of no Gaussians."""
        across, down = -(-camera.width // TILE), -(-camera.height // TILE)
        none = torch.zeros(1, 0, device=device)
        return CudaView(
            gsplat=gsplat,
            width=camera.width,
            height=camera.height,
            visible=torch.zeros(0, dtype=torch.int64, device=device),
            centres=torch.zeros(1, 0, 2, device=device),
            conics=torch.zeros(1, 0, 3, device=device),
            depths=none,
            opacities=none,
            tile_starts=torch.zeros(1, down, across, dtype=torch.int32, device=device),
            tile_ids=torch.zeros(0, dtype=torch.int32, device=device),
        )

    def detached(self) -> "CudaView":
        """The same view with its geometry frozen."""
        return CudaView(
            gsplat=self.gsplat,
            width=self.width,
            height=self.height,
            visible=self.visible,
            centres=self.centres.detach(),
            conics=self.conics.detach(),
            depths=self.depths.detach(),
            opacities=self.opacities.detach(),
            tile_starts=self.tile_starts,
            tile_ids=self.tile_ids,
        )

    def product(self, signal: Tensor) -> tuple[Tensor, Tensor]:
        """``W @ signal`` (height, width, channels) and ``W @ 1`` (height, width)."""
        if len(self.visible) == 0:
            # Connected to the signal, so that gradients are 0, not missing.
            nothing = 0 * signal.sum(dim=0).expand(self.height, self.width, -1)
            return nothing, signal.new_zeros(self.height, self.width)
        images: list[Tensor] = []
        alpha = signal.new_zeros(self.height, self.width)
        for part in signal.split(CHANNELS, dim=1):
            image, total = self.gsplat.rasterize_to_pixels(
                self.centres,
                self.conics,
                part[None].contiguous(),
                self.opacities,
                self.width,
                self.height,
                TILE,
                self.tile_starts,
                self.tile_ids,
            )
            images.append(image[0])
            alpha = total[0, ..., 0]
        return torch.cat(images, dim=-1), alpha

    def adjoint(self, image: Tensor) -> Tensor:
        """``W.T @ image``: the gradient of <W f, image> with respect to f."""
        frozen = self.detached()
        columns: list[Tensor] = []
        for part in image.split(CHANNELS, dim=2):
            with torch.enable_grad():
                signal = image.new_zeros(self.centres.shape[1], part.shape[2], requires_grad=True)
                drawn, _ = frozen.product(signal)
            (column,) = torch.autograd.grad(drawn, signal, part.contiguous())
            columns.append(column)
        return torch.cat(columns, dim=1)

    def for_visible(self, of_rows: Callable[[Tensor], Tensor]) -> Tensor:
        """A column computed for the rows that are visible, 0 for the others.

        The others are left out of the formula, so that they give no NaN gradients.
        """
        values = of_rows(self.visible)
        full = values.new_zeros(self.centres.shape[1], *values.shape[1:])
        return full.index_copy(0, self.visible, values)

    @torch.no_grad()
    def entries(self) -> Entries:
        """All non-zero entries of W, pixel by pixel, front to back."""
        if len(self.visible) == 0:
            none = torch.zeros(0, dtype=torch.int64, device=self.centres.device)
            return Entries(pixels=none, ids=none, weights=none.double(), median=none.bool())
        ids, pixels, _ = self.gsplat.rasterize_to_indices_in_range(
            0,
            2**30,
            torch.ones(1, self.height, self.width, device=self.centres.device),
            self.centres,
            self.conics,
            self.opacities,
            self.width,
            self.height,
            TILE,
            self.tile_starts,
            self.tile_ids,
        )
        du = pixels % self.width + 0.5 - self.centres[0, ids, 0]
        dv = pixels // self.width + 0.5 - self.centres[0, ids, 1]
        a, b, c = self.conics[0, ids].unbind(-1)
        q = a * du**2 + 2 * b * du * dv + c * dv**2
        alpha = self.opacities[0, ids] * torch.exp(-q / 2)
        # The kernel listed them, so they are blended, whichever way exp rounds here.
        alpha = alpha.clamp(ALPHA_MIN, GSPLAT_ALPHA_MAX).double()
        # Transmittance before each entry: a running sum of logarithms, less the sum that the
        # pixels before it have gathered. Float64 keeps that difference exact enough.
        gathered = torch.cumsum(torch.log1p(-alpha), dim=0)
        start = torch.searchsorted(pixels, pixels)
        before_pixel = torch.cat((gathered.new_zeros(1), gathered))[start]
        behind = torch.exp(gathered - before_pixel)
        before = behind / (1 - alpha)
        return Entries(
            pixels=pixels,
            ids=ids,
            weights=alpha * before,
            median=(before > MEDIAN_TRANSMITTANCE) & (behind <= MEDIAN_TRANSMITTANCE),
        )


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
        super().__init__(gaussians, camera, options)
        self._gsplat: Any = gsplat
        self._device = device
        self._kept: tuple[Gaussians, CudaView] | None = None
        self._median: Tensor | None = None

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


# One view on the GPU: gsplat's projection and tile lists, and products over them.


GSPLAT_ALPHA_MAX = 0.999
"""gsplat's opacity cap, a literal in its kernels."""

TILE = 16
"""Side of gsplat's tiles, pixels."""

CHANNELS = 32
"""Channels of one kernel launch; gsplat gets slow above (its own default chunk)."""


def colours(view: CudaView, gaussians: Gaussians, camera: Camera, degree: int | None) -> Tensor:
    """Colours of the harmonics along the rays to the Gaussians that are visible."""
    centre = camera.centre.to(device=gaussians.device, dtype=torch.float32)

    def of_rows(rows: Tensor) -> Tensor:
        rays = gaussians.means[rows] - centre
        directions = rays / torch.linalg.vector_norm(rays, dim=1, keepdim=True)
        return evaluate_sh(gaussians.sh[rows], directions, degree=degree)

    return view.for_visible(of_rows)
