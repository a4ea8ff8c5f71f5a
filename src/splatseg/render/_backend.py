"""What a backend does: the matrix W of a view and its adjoint.

With the geometry frozen a view is a sparse linear map (docs/architecture.md):

    w[p, i] = alpha_i(p) * prod_{j before i} (1 - alpha_j(p))      W: pixels x Gaussians

`render` is ``W @ signal``, `back_project` is ``W.T @ image``, `contributors` reads rows of W
and `weights` keeps W.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from functools import cache
from typing import Any, ClassVar, Literal, Self, cast, get_args
from weakref import WeakKeyDictionary

import numpy as np
import torch
from jaxtyping import Float, Int, Int32, Int64, UInt8
from torch import Tensor

from splatseg._check import check_choice, check_finite, check_shape
from splatseg.core import Camera, Gaussians
from splatseg.core.boundary import boundary
from splatseg.core.gaussians import LOW_PASS
from splatseg.errors import InputError, RangeError
from splatseg.render._picture import eight_bits, mixed_colours
from splatseg.render._rows import SparseWeights
from splatseg.render._values import (
    BackProjected,
    Contributors,
    Rendered,
    RenderOptions,
    SparseBackProjected,
    SparseImage,
    SparseSignal,
    StrongestChannels,
)

_CHANNELS = 64
"""Channels of a sparse image or signal made dense at a time, where there is no sparse kernel."""


class BackendView(ABC):
    """One pinhole view on a backend: projected and sorted at first use, then used again.

    Inputs were checked by the caller. What needs gradients towards the geometry is projected
    anew each time, because it becomes part of a graph.
    """

    def __init__(self, gaussians: Gaussians, camera: Camera, options: RenderOptions) -> None:
        self._gaussians, self._camera, self._options = gaussians, camera, options
        self._closed = False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @abstractmethod
    def close(self) -> None:
        """Release its memory. The view cannot be used afterwards."""

    @abstractmethod
    def render(
        self,
        signal: Float[Tensor, "n channels"] | None = None,
        *,
        screen_offsets: Float[Tensor, "n 2"] | None = None,
    ) -> Rendered:
        """``W @ signal``; None is the colour of the SH. Differentiable in torch.

        Args:
            signal: One row a Gaussian.
            screen_offsets: Zeros, added to the projected centres, pixels: a leaf whose gradient
                is that of the projected centres (gsplat's ``means2d``), which densification
                needs.
        """

    @abstractmethod
    def back_project(self, image: Float[Tensor, "height width channels"]) -> BackProjected:
        """``W.T @ image`` and ``W.T @ 1``. No gradient."""

    @abstractmethod
    def contributors(self, pixels: Int[Tensor, "p 2"], k: int) -> Contributors:
        """The k strongest Gaussians of pixels (column, row), ties front to back."""

    @abstractmethod
    def rows(self, pixels: Int[Tensor, "p 2"] | None, k: int | None) -> SparseWeights:
        """Rows of W: all pixels or some, all entries or each pixel's k strongest."""

    @property
    def size(self) -> tuple[int, int]:
        """Height and width."""
        return self._camera.height, self._camera.width

    @torch.no_grad()
    def picture(
        self,
        *,
        tint: UInt8[Tensor, "n 4"] | None = None,
        signal: Float[Tensor, "n channels"] | None = None,
    ) -> UInt8[Tensor, "height width 3"]:
        """`render` in eight bits, a tint mixed into the colours. On the CPU, without a gradient.

        Args:
            tint: Red, green, blue and how much of them; None is none.
            signal: Grey (one channel) or colour; None is the colour of the SH.
        """
        colours = mixed_colours(
            self._gaussians,
            self._camera,
            tint=tint,
            signal=signal,
            degree=self._options.sh_degree,
        )
        return eight_bits(self.render(colours).image)

    def part_sums(self, parts: Sequence[Int32[Tensor, "pixels"]]) -> list[Any]:
        """Rows of W summed over the parts of each partition: sparse (parts, Gaussians)."""
        from scipy import sparse

        rows = self.rows(None, None).to_scipy().astype(np.float64)
        found: list[Any] = []
        for part in parts:
            inside = np.flatnonzero(part.numpy() >= 0)
            places = (part.numpy()[inside], inside)
            shape = (max(0, int(part.max()) + 1), len(part))
            members = sparse.csr_matrix((np.ones(len(inside)), places), shape=shape)
            sums: Any = members @ rows
            sums.sort_indices()
            found.append(sums)
        return found

    def back_project_sparse(self, image: SparseImage) -> SparseBackProjected:
        """``W.T @ image`` and ``W.T @ 1`` of an image of many channels. On the CPU."""
        gaussians: list[Tensor] = []
        channels: list[Tensor] = []
        sums: list[Tensor] = []
        weights: Tensor | None = None
        for start in range(0, max(image.count, 1), _CHANNELS):
            # One channel of nothing where there are none: the view still shows Gaussians.
            stop = max(min(start + _CHANNELS, image.count), start + 1)
            found = self.back_project(image.dense(start, stop).reshape(*self.size, -1))
            weights = found.weights.float().cpu()
            part = found.sums.float().cpu()
            row, column = torch.nonzero(part, as_tuple=True)
            gaussians.append(row)
            channels.append(column + start)
            sums.append(part[row, column])
        order = torch.argsort(torch.cat(gaussians), stable=True)
        return SparseBackProjected(
            gaussians=torch.cat(gaussians)[order],
            channels=torch.cat(channels)[order],
            sums=torch.cat(sums)[order],
            weights=torch.zeros(0) if weights is None else weights,
        )

    def argmax(self, signal: SparseSignal, background: int) -> StrongestChannels:
        """The largest channel of ``W @ signal`` plus the transmittance in `background`. On the CPU.

        Args:
            signal: The signal, with a row a Gaussian.
            background: The channel of the light that no Gaussian stops.
        """
        names = self._channels_in_view(signal, background)
        best = torch.full(self.size, -1.0)
        winner = torch.full(self.size, -1, dtype=torch.int32)
        for part in names.split(_CHANNELS):
            with torch.no_grad():
                drawn = self.render(signal.dense(part))
            values = drawn.image.float().cpu()
            own = torch.nonzero(part == background).flatten().tolist()
            values[..., own] += (1 - drawn.alpha.float().cpu()).clamp_min(0).unsqueeze(-1)
            value, column = values.max(dim=-1)
            better = value > best
            best = torch.where(better, value, best)
            winner = torch.where(better, part.to(torch.int32)[column], winner)
        return StrongestChannels(channels=winner, values=best)

    def _channels_in_view(self, signal: SparseSignal, background: int) -> Int64[Tensor, "m"]:
        """The channels that can be the largest of a pixel, ascending. On the CPU."""
        channels = signal.channels
        if signal.count > _CHANNELS:
            nothing = torch.zeros(*self.size, 1, device=channels.device)
            channels = channels[self.back_project(nothing).weights > 0]
        found = torch.unique(channels).cpu().long()
        return torch.unique(torch.cat((found[found >= 0], torch.tensor([background]))))


class Backend(ABC):
    """One way to compute W. Cameras are pinhole; inputs were checked by the caller."""

    name: ClassVar[str]

    @abstractmethod
    def prepare(
        self, gaussians: Gaussians, camera: Camera, *, options: RenderOptions
    ) -> BackendView:
        """A prepared view, for any number of products."""

    def render(
        self,
        gaussians: Gaussians,
        camera: Camera,
        signal: Float[Tensor, "n channels"] | None,
        *,
        options: RenderOptions,
        screen_offsets: Float[Tensor, "n 2"] | None = None,
    ) -> Rendered:
        """`BackendView.render` of a view that is used once."""
        with self.prepare(gaussians, camera, options=options) as view:
            return view.render(signal, screen_offsets=screen_offsets)


def needs_graph(gaussians: Gaussians, camera: Camera, *others: Tensor | None) -> bool:
    """Whether a render must be part of a graph of autograd."""
    leaves = (
        gaussians.means,
        gaussians.rotations,
        gaussians.scales,
        gaussians.opacities,
        gaussians.sh,
        camera.cam_from_world,
        *others,
    )
    return torch.is_grad_enabled() and any(t is not None and t.requires_grad for t in leaves)


BackendName = Literal["auto", "cpu", "cuda", "reference"]


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
    check_choice("backend", name, get_args(BackendName))
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
    in (``docs/decisions/kernels.md``).

    Args:
        name: As for `get_backend`.
        like: As for `get_backend`.
        sh_degree: Maximum degree of the spherical harmonics in use; None is all.
        antialiased: What the Gaussians are meant for, `Gaussians.antialiased`.
        low_pass: Likewise, `Gaussians.low_pass`.
    """
    changes: dict[str, float] = {}
    if get_backend(name, like=like).name == "cuda":
        from splatseg.render.cuda import GSPLAT_ALPHA_MAX

        changes = {"alpha_max": GSPLAT_ALPHA_MAX}
    return RenderOptions(sh_degree=sh_degree, antialiased=antialiased, low_pass=low_pass, **changes)


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


MAX_CHANNELS = 1024
_checked: "WeakKeyDictionary[Gaussians, tuple[int, ...]]" = WeakKeyDictionary()


_NARROW = 256
"""Contributors that may always be asked for, however few Gaussians there are."""

_ENTRIES = 1 << 28
"""Pixels x contributors at most, of 24 bytes each while they are sorted."""


def check_scene(gaussians: Gaussians) -> None:
    """Scan the values once; again only after somebody wrote into the tensors."""
    columns = (
        gaussians.means,
        gaussians.rotations,
        gaussians.scales,
        gaussians.opacities,
        gaussians.sh,
    )
    versions = tuple(-1 if t.is_inference() else t._version for t in columns)  # pyright: ignore[reportPrivateUsage]
    if -1 in versions or _checked.get(gaussians) != versions:
        gaussians.check_values()
        _checked[gaussians] = versions


def check_columns(name: str, tensor: Tensor, shape: tuple[int | None, ...]) -> None:
    """A signal or an image: shape, number of channels, type and values."""
    check_shape(name, tensor, shape)
    if not 1 <= tensor.shape[-1] <= MAX_CHANNELS:
        raise RangeError(f"{name}: expected 1 to {MAX_CHANNELS} channels, got {tensor.shape[-1]}.")
    if not tensor.is_floating_point():
        raise InputError(f"{name}: expected floating-point values, got {tensor.dtype}.")
    check_finite(name, tensor)


def check_picture(
    count: int,
    *,
    tint: Tensor | None,
    signal: Tensor | None,
    shown: Tensor | None,
) -> None:
    """What a picture is asked of: rows, channels and types.

    Raises:
        ShapeError: If there is not one row a Gaussian, or another number of columns.
        InputError: If the tint is not in eight bits, or `shown` not boolean.
    """
    if signal is not None:
        check_columns("signal", signal, (count, 1 if signal.shape[-1] == 1 else 3))
    if tint is not None:
        check_shape("tint", tint, (count, 4))
        if tint.dtype != torch.uint8:
            raise InputError(f"tint: expected eight bits (uint8), got {tint.dtype}.")
    if shown is not None:
        check_shape("shown", shown, (count,))
        if shown.dtype != torch.bool:
            raise InputError(f"shown: expected true and false, got {shown.dtype}.")


def check_pixels(pixels: Tensor, camera: Camera) -> None:
    """Pixels as integers (column, row) inside the image."""
    check_shape("pixels", pixels, (None, 2))
    if pixels.is_floating_point() or pixels.dtype == torch.bool:
        raise InputError(f"pixels: expected integers (column, row), got {pixels.dtype}.")
    size = torch.tensor([camera.width, camera.height], device=pixels.device)
    outside = ((pixels < 0) | (pixels >= size)).any(dim=1)
    if bool(outside.any()):
        first = pixels[outside][0].tolist()
        raise RangeError(
            f"pixels: expected columns in [0, {camera.width}) and rows in "
            f"[0, {camera.height}), got {first}."
        )


def check_k(k: int) -> None:
    """At least one contributor a pixel."""
    if k < 1:
        raise RangeError(f"k: expected at least 1, got {k}.")


def check_table(k: int, *, pixels: int, gaussians: int) -> None:
    """Contributors are a table of k columns: no wider than there is use for, and of bounded size.

    Args:
        k: Contributors of a pixel, those that are missing included.
        pixels: How many pixels.
        gaussians: How many Gaussians the scene has.
    """
    check_k(k)
    most = max(gaussians, _NARROW)
    if k > most:
        raise RangeError(
            f"k: expected at most {most}, the larger of the scene's {gaussians} Gaussians and "
            f"{_NARROW}, got {k}."
        )
    if pixels * k > _ENTRIES:
        raise RangeError(
            f"k: expected at most {_ENTRIES} pixels x k, which take about 6 GB, got "
            f"{pixels} x {k}; ask for fewer pixels at a time."
        )
