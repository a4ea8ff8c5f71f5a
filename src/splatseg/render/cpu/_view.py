"""One view on the CPU kernels: prepared once, then rendered, back-projected, differentiated.

This is the layer under the backend that fitting uses directly: it knows nothing of autograd and
allocates its scratch memory once.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np
import torch
from jaxtyping import Float, Int32
from torch import Tensor

from splatseg import _native
from splatseg.core import Camera
from splatseg.render._options import RenderOptions

MAX_COLOUR_CHANNELS = 3
"""Signals of up to this many channels use the colour kernel."""

_LANES = 16
_free_views: list[_native.View] = []
_FREE_VIEWS = 4


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SceneGradients:
    """Gradients of one backward pass; rows of Gaussians that the view does not show are 0."""

    means: Float[Tensor, "n 3"] | None
    rotations: Float[Tensor, "n 4"] | None
    scales: Float[Tensor, "n 3"] | None
    opacities: Float[Tensor, "n"] | None
    sh: Float[Tensor, "n coefficients 3"] | None
    signal: Float[Tensor, "n channels"] | None
    screen_offsets: Float[Tensor, "n 2"] | None
    """With respect to the projected centres, per pixel, for densification."""

    cam_from_world: Float[Tensor, "4 4"] | None


def padded_channels(channels: int) -> int:
    """Channels rounded up to whole vectors."""
    return (channels + _LANES - 1) // _LANES * _LANES


def _padded(signal: Tensor) -> Tensor:
    channels = signal.shape[1]
    if channels % _LANES == 0:
        return signal
    wide = signal.new_zeros(len(signal), padded_channels(channels))
    wide[:, :channels] = signal
    return wide


def _zeros(*shape: int) -> Tensor:
    """Zeros whose pages are only touched when somebody writes: most rows never are."""
    return torch.from_numpy(np.zeros(shape, np.float32))


def _plain(tensor: Tensor) -> Tensor:
    """What the kernels read: float32, contiguous, without a gradient; no copy where it is so."""
    return tensor.detach().to(torch.float32).contiguous()


class CpuView:
    """W of one pinhole view, never stored: each product blends the view again.

    Args:
        means, rotations, scales, opacities: Columns of `core.Gaussians`, on the CPU.
        camera: A pinhole camera.
        options: Switches of the blending model.
        sh: Spherical harmonics, rendered where no signal is given.
        signal: A signal (n, up to 3) that takes their place.

    Values are not checked; rows that are not finite are left out rather than drawn.
    """

    def __init__(
        self,
        means: Float[Tensor, "n 3"],
        rotations: Float[Tensor, "n 4"],
        scales: Float[Tensor, "n 3"],
        opacities: Float[Tensor, "n"],
        *,
        camera: Camera,
        options: RenderOptions,
        sh: Float[Tensor, "n coefficients 3"] | None = None,
        signal: Float[Tensor, "n channels"] | None = None,
    ) -> None:
        self._count = len(means)
        self._height, self._width = camera.height, camera.width
        self._degree_limit = options.sh_degree
        self._geometry = (_plain(means), _plain(rotations), _plain(scales), _plain(opacities))
        degree = self._colour_with(sh, signal)
        # Views keep tens of megabytes of scratch; a fresh one would be paid for in page faults.
        self._view: _native.View = _free_views.pop() if _free_views else _native.View()
        self._pose = camera.cam_from_world.detach()
        self._view.prepare(
            self._cloud,
            camera.width,
            camera.height,
            camera.fx,
            camera.fy,
            camera.cx,
            camera.cy,
            self._pose[:3].to(torch.float32).contiguous(),
            options.near,
            options.alpha_max,
            options.low_pass,
            options.antialiased,
            degree,
        )
        self._forward: tuple[Tensor, Tensor, Tensor] | None = None
        self._wide: Tensor | None = None

    def _colour_with(self, sh: Tensor | None, signal: Tensor | None) -> int:
        """Set the source of the colours; returns the degree of the spherical harmonics in use."""
        self._narrow = 3 if signal is None else signal.shape[1]
        self._sh = None if sh is None else _plain(sh)
        self._cloud = _native.Cloud(
            *self._geometry, self._sh, None if signal is None else _plain(signal)
        )
        if self._sh is None:
            return 0
        held = {1: 0, 4: 1, 9: 2, 16: 3}[self._sh.shape[1]]
        return held if self._degree_limit is None else min(held, self._degree_limit)

    def recolour(
        self,
        *,
        sh: Float[Tensor, "n coefficients 3"] | None = None,
        signal: Float[Tensor, "n channels"] | None = None,
    ) -> None:
        """Take other spherical harmonics or another narrow signal; the projection stays as it is.

        Only for renders without a record: the backward pass knows the colours of the start.
        """
        degree = self._colour_with(sh, signal)
        self._forward = None
        self._view.recolour(self._cloud, degree)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Give the scratch memory back. The view cannot be used afterwards."""
        view, self._view = self._view, _CLOSED
        if view is not _CLOSED and len(_free_views) < _FREE_VIEWS:
            _free_views.append(view)

    def __del__(self) -> None:
        if hasattr(self, "_view"):
            self.close()

    @property
    def visible_ids(self) -> Int32[Tensor, "visible"]:
        """Rows of the Gaussians in view, front to back."""
        ids = torch.empty(self._view.visible, dtype=torch.int32)
        self._view.visible_ids(ids)
        return ids

    @property
    def statistics(self) -> dict[str, int]:
        """Gaussians in view, Gaussian-tile pairs, Gaussian-pixel pairs evaluated last."""
        return {
            "visible": self._view.visible,
            "tile_pairs": self._view.tile_pairs,
            "pixel_pairs": self._view.evaluated,
        }

    def render(
        self, signal: Float[Tensor, "n channels"] | None = None, *, record: bool = False
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Image (h, w, c), alpha, depth sum and median depth, each (h, w).

        Args:
            signal: A wide signal; None draws what the view was made with.
            record: Keep what `backward` needs.
        """
        shape = (self._height, self._width)
        alpha, depth_sum, median = (torch.empty(shape) for _ in range(3))
        if signal is None:
            image = torch.empty(*shape, self._narrow)
            self._wide = None
            self._view.forward_colour(self._narrow, image, alpha, depth_sum, median, record)
        else:
            wide = _padded(_plain(signal))
            image = torch.empty(*shape, signal.shape[1])
            self._view.forward_features(
                wide, signal.shape[1], image, alpha, depth_sum, median, record
            )
            self._wide = wide if record else None
        # Detached: autograd hangs its graph, and with it this view, on the tensors it is given,
        # and a view that held those would be a cycle that keeps tens of megabytes.
        kept = (image.detach(), alpha.detach(), depth_sum.detach())
        self._forward = kept if record else None
        return image, alpha, depth_sum, median

    def back_project(self, image: Float[Tensor, "height width channels"]) -> tuple[Tensor, Tensor]:
        """``W.T @ image`` (n, c) and ``W.T @ 1`` (n,)."""
        channels = image.shape[2]
        sums, weights = _zeros(self._count, channels), _zeros(self._count)
        self._view.adjoint(_plain(image), channels, sums, weights)
        return sums, weights

    def back_project_sparse(
        self, indptr: Tensor, channels: Tensor, values: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """The sums that are not 0 of a `SparseImage`, by Gaussian, and ``W.T @ 1`` (n,)."""
        weights = _zeros(self._count)
        found = self._view.sparse_adjoint(
            indptr.contiguous(), channels.contiguous(), values.contiguous(), weights
        )
        gaussians, names, sums = (torch.from_numpy(array) for array in found)
        return gaussians, names, sums, weights

    def argmax(
        self, channels: Tensor, values: Tensor | None, *, count: int, background: int
    ) -> tuple[Tensor, Tensor]:
        """Of each pixel the largest channel of a `SparseSignal`, and its value, each (h, w)."""
        winner = torch.empty(self._height, self._width, dtype=torch.int32)
        score = torch.empty(self._height, self._width)
        self._view.argmax(
            channels.contiguous(),
            None if values is None else values.contiguous(),
            count,
            background,
            winner,
            score,
        )
        return winner, score

    def backward(
        self,
        v_image: Float[Tensor, "height width channels"],
        *,
        v_alpha: Float[Tensor, "height width"] | None = None,
        v_depth_sum: Float[Tensor, "height width"] | None = None,
        wanted: frozenset[str] = frozenset(
            ("means", "rotations", "scales", "opacities", "sh", "screen_offsets")
        ),
    ) -> SceneGradients:
        """Gradients of ``<v_image, image> + <v_alpha, alpha> + <v_depth_sum, depth_sum>``.

        Needs a `render` with ``record=True`` before it, of which it is the derivative.
        """
        if self._forward is None:
            raise RuntimeError("backward: render(record=True) comes first.")
        image, alpha, depth_sum = self._forward

        def maybe(t: Tensor | None) -> Tensor | None:
            return None if t is None else _plain(t)

        n, channels = self._count, image.shape[2]
        v_signal = _zeros(n, channels) if "signal" in wanted else None
        planes = (image, alpha, depth_sum, _plain(v_image), maybe(v_alpha), maybe(v_depth_sum))
        if self._wide is None:
            self._view.backward_colour(channels, *planes)
            if v_signal is not None:
                self._view.narrow_signal_gradient(channels, v_signal)
        else:
            self._view.backward_features(self._wide, channels, *planes, v_signal)

        def zeros(name: str, *shape: int) -> Tensor | None:
            return _zeros(n, *shape) if name in wanted else None

        use_sh = "sh" in wanted and self._sh is not None and self._wide is None
        means, rotations, scales = zeros("means", 3), zeros("rotations", 4), zeros("scales", 3)
        opacities, screen_offsets = zeros("opacities"), zeros("screen_offsets", 2)
        sh = _zeros(*self._sh.shape) if use_sh and self._sh is not None else None
        pose = torch.zeros(15, dtype=torch.float64) if "pose" in wanted else None
        if any(
            x is not None for x in (means, rotations, scales, opacities, sh, screen_offsets, pose)
        ):
            self._view.chain(
                self._cloud, means, rotations, scales, opacities, sh, screen_offsets, pose
            )
        return SceneGradients(
            means=means,
            rotations=rotations,
            scales=scales,
            opacities=opacities,
            sh=sh,
            signal=v_signal,
            screen_offsets=screen_offsets,
            cam_from_world=None if pose is None else self._pose_gradient(pose),
        )

    def _pose_gradient(self, sums: Tensor) -> Tensor:
        """From the rows of [R | t] and the camera centre c = -R^T t, where SH directions begin."""
        gradient = torch.zeros(4, 4, dtype=torch.float64)
        gradient[:3] = sums[:12].reshape(3, 4)
        v_centre = sums[12:]
        rotation, translation = self._pose[:3, :3].double(), self._pose[:3, 3].double()
        gradient[:3, :3] -= torch.outer(translation, v_centre)
        gradient[:3, 3] -= rotation @ v_centre
        return gradient

    def pixel_rows(self, pixels: Tensor, k: int) -> tuple[Tensor, ...]:
        """Rows of W of pixels (column, row): indptr, ids, weights, first and median ids.

        ``k = 0`` keeps all entries, else each pixel's k strongest, front to back.
        """
        rows = self._view.pixel_rows(pixels.to(torch.int64).contiguous(), k)
        return tuple(torch.from_numpy(array) for array in rows)

    def block_matrix(self) -> _native.BlockMatrix:
        """W in 4 x 4 blocks."""
        matrix = _native.BlockMatrix()
        matrix.build(self._view)
        return matrix


_CLOSED = _native.View()
