r"""Resampling between the photograph's distorted pixels and a pinhole image.

Backends draw pinhole images only, because a Gaussian stays an ellipse under no other lens. A
photograph with distortion is drawn in two linear steps: W into a pinhole image that covers
every pixel of the photograph, then a sparse matrix R that looks up each pixel of the photograph
in it:

.. math:: \text{photograph} = R \, W \, \text{signal}, \qquad
          \text{sums} = W^\top R^\top \, \text{photograph}

`Warp` holds R as sparse rows in both orders, so that `apply` is R, `adjoint` is exactly its
transpose, both are sums in a fixed order, and both are differentiable.
"""

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Literal, get_args

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from splatseg._check import check_choice, check_shape
from splatseg.core import Camera
from splatseg.errors import InputError
from splatseg.render._products import Csr, LinearMap, starts_of

WarpMode = Literal["bilinear", "nearest"]

# A point of the pinhole image that comes back elsewhere lies beyond the fold of the lens
# polynomial; honest round trips are off by less than a millionth of a pixel.
_FOLD_TOLERANCE = 1e-2


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Warp:
    """A sparse matrix from the pixels of one image (source) to those of another (target).

    Rows of pixels without a counterpart are empty: `apply` gives 0 there.

    Example:
        >>> camera = Camera(width=4, height=3, fx=4.0, fy=4.0, cx=2.0, cy=1.5,
        ...                 cam_from_world=torch.eye(4), model="opencv", distortion=(0.1,))
        >>> warp = Warp.between(camera, camera.undistorted())
        >>> bool(warp.valid.all())
        True
    """

    target_shape: tuple[int, int]
    """Rows and columns of the image that `apply` gives."""

    source_shape: tuple[int, int]
    """Rows and columns of the image that `apply` takes."""

    valid: Bool[Tensor, "target_rows target_columns"]
    """True where a target pixel has a counterpart in the source image."""

    _rows: Csr
    _columns: Csr

    @classmethod
    def between(cls, target: Camera, source: Camera, mode: WarpMode = "bilinear") -> "Warp":
        """The matrix that shows what `source` saw in the pixels of `target`.

        Every pixel centre of `target` is a ray; the source image is read where that ray meets
        it, from the four pixels around (bilinear, weights that add up to 1, the outermost
        pixels continued over the last half pixel) or from the pixel it falls into (nearest).

        Args:
            target: The camera whose pixels are wanted, usually the photograph's.
            source: The camera whose image is read, usually ``target.undistorted()``.
            mode: ``nearest`` for ids, ``bilinear`` for everything else.

        Raises:
            InputError: If the cameras are not at the same place and turned alike, or `mode` is
                unknown.
        """
        check_choice("mode", mode, get_args(WarpMode))
        if not torch.allclose(
            target.cam_from_world.detach().double(),
            source.cam_from_world.detach().double(),
        ):
            raise InputError(
                "target, source: expected two cameras with the same pose, got different ones."
            )
        at, valid = _meeting_points(target, source)
        columns, values = (part[valid] for part in _taps(at, source, mode))
        rows = Csr(
            indptr=starts_of(valid.flatten() * columns.shape[1]),
            ids=columns.flatten().int(),
            weights=values.flatten(),
            columns=source.height * source.width,
        )
        return cls(
            target_shape=(target.height, target.width),
            source_shape=(source.height, source.width),
            valid=valid,
            _rows=rows,
            _columns=rows.transposed(),
        )

    @property
    def _map(self) -> LinearMap:
        return LinearMap(
            forward=lambda values: self._rows.to(values.device).product(values),
            adjoint=lambda values: self._columns.to(values.device).product(values),
        )

    def apply(
        self, image: Float[Tensor, "source_rows source_columns channels"]
    ) -> Float[Tensor, "target_rows target_columns channels"]:
        """Source image to target image: ``R @ image``. Differentiable.

        Raises:
            ShapeError: If the image is not of `source_shape`.
        """
        check_shape("image", image, (*self.source_shape, None))
        flat = self._map(image.flatten(0, 1))
        return flat.unflatten(0, self.target_shape)

    def adjoint(
        self, image: Float[Tensor, "target_rows target_columns channels"]
    ) -> Float[Tensor, "source_rows source_columns channels"]:
        """Target image to source image: ``R.T @ image``. Differentiable.

        Raises:
            ShapeError: If the image is not of `target_shape`.
        """
        check_shape("image", image, (*self.target_shape, None))
        flat = self._map.transposed()(image.flatten(0, 1))
        return flat.unflatten(0, self.source_shape)

    def nearest_sources(
        self, pixels: Int64[Tensor, "p 2"]
    ) -> tuple[Int64[Tensor, "p 2"], Bool[Tensor, "p"]]:
        """The source pixel (column, row) with the largest weight of each target pixel.

        Pixels without a counterpart give (0, 0) and False.
        """
        _, columns = self.target_shape
        on_cpu = pixels.cpu().long()
        rows = on_cpu[:, 1] * columns + on_cpu[:, 0]
        found = self.valid.reshape(-1)[rows]
        if not bool(found.any()):
            return torch.zeros_like(pixels, dtype=torch.int64), found.to(pixels.device)
        # Every valid row has the same number of entries.
        taps = int(self._rows.indptr.diff().max())
        entries = self._rows.indptr[rows].unsqueeze(1) + torch.arange(taps)
        entries = entries.clamp_max(len(self._rows.ids) - 1)
        best = self._rows.weights[entries].argmax(dim=1, keepdim=True)
        source = self._rows.ids[entries].long().gather(1, best).squeeze(1)
        source = torch.where(found, source, 0)
        width = self.source_shape[1]
        at = torch.stack((source % width, source // width), dim=-1)
        return at.to(pixels.device), found.to(pixels.device)


def undistorted_camera(camera: Camera) -> Camera:
    """The pinhole camera to draw for `camera`: it covers every pixel of the photograph."""
    if camera.is_pinhole:
        return replace(camera, model="pinhole", distortion=())
    return replace(_cached_pinhole(camera.lens), cam_from_world=camera.cam_from_world)


def warp_into_photograph(camera: Camera, mode: WarpMode = "bilinear") -> Warp:
    """The warp from ``camera.undistorted()`` into the photograph's pixels, kept for reuse.

    The last few are kept; they depend on the lens and the size, not on the pose.
    """
    return _cached_warp(camera.lens, mode, into_photograph=True)


def photograph_to_pinhole(
    image: Float[Tensor, "height width channels"], camera: Camera
) -> tuple[
    Float[Tensor, "pinhole_height pinhole_width channels"],
    Bool[Tensor, "pinhole_height pinhole_width"],
]:
    """Straighten a photograph: its pixels in ``camera.undistorted()``, and which are real.

    Args:
        image: The photograph, in floating point.
        camera: Its camera. Without distortion the photograph comes back as it is.

    Returns:
        The pinhole image, 0 where the photograph shows nothing, and the mask of pixels whose
        centre lies inside the photograph.
    """
    check_shape("image", image, (camera.height, camera.width, None))
    if camera.is_pinhole:
        return image, torch.ones(image.shape[:2], dtype=torch.bool, device=image.device)
    warp = _cached_warp(camera.lens, "bilinear", into_photograph=False)
    return warp.apply(image), warp.valid.to(image.device)


@lru_cache(maxsize=1024)
def _cached_pinhole(lens: tuple[Any, ...]) -> Camera:
    return Camera.of_lens(lens).undistorted()


@lru_cache(maxsize=8)
def _cached_warp(lens: tuple[Any, ...], mode: WarpMode, *, into_photograph: bool) -> Warp:
    camera = Camera.of_lens(lens)
    pinhole = _cached_pinhole(lens)
    if into_photograph:
        return Warp.between(camera, pinhole, mode)
    return Warp.between(pinhole, camera, mode)


def _meeting_points(target: Camera, source: Camera) -> tuple[Tensor, Tensor]:
    """Where the target's rays meet the source image, and whether they do."""
    plane = target.plane_of_pixels()
    straight = plane * plane.new_tensor([source.fx, source.fy])
    straight = straight + plane.new_tensor([source.cx, source.cy])
    at = source.distort_pixels(straight)
    size = at.new_tensor([source.width, source.height])
    valid = ((at >= 0) & (at <= size)).all(dim=-1)
    if not source.is_pinhole:
        back = source.undistort_pixels(at[valid])
        off = torch.linalg.vector_norm(back - straight[valid], dim=-1)
        valid[valid.clone()] = off < _FOLD_TOLERANCE
    return at, valid


def _taps(at: Tensor, source: Camera, mode: WarpMode) -> tuple[Tensor, Tensor]:
    """Flat source pixels and weights of each point, (..., taps) both."""
    size = torch.tensor([source.width, source.height])
    # Points that meet nothing may be anywhere; their rows are left out afterwards.
    at = torch.nan_to_num(at).clamp(at.new_zeros(2), size.to(at))
    if mode == "nearest":
        cell = torch.minimum(at.floor().long(), size - 1)
        return (cell[..., 1] * source.width + cell[..., 0]).unsqueeze(-1), torch.ones_like(
            at[..., :1], dtype=torch.float32
        )
    corner = torch.floor(at - 0.5)
    fraction = at - 0.5 - corner
    columns: list[Tensor] = []
    weights: list[Tensor] = []
    for dy in (0, 1):
        for dx in (0, 1):
            cell = corner.long() + torch.tensor([dx, dy])
            cell = torch.minimum(cell.clamp_min(0), size - 1)
            columns.append(cell[..., 1] * source.width + cell[..., 0])
            across = fraction[..., 0] if dx else 1 - fraction[..., 0]
            down = fraction[..., 1] if dy else 1 - fraction[..., 1]
            weights.append(across * down)
    return torch.stack(columns, dim=-1), torch.stack(weights, dim=-1).float()
