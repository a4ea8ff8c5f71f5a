"""The training photographs of a fit: undistorted, cached in memory, and downsampled."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatseg.core import Camera, View
from splatseg.core.boundary import boundary
from splatseg.fit._options import FitOptions, fixed_colour
from splatseg.io.images import image_camera, load_alpha, load_image, load_mask, reduced_size
from splatseg.render.warp import photograph_to_pinhole, undistorted_camera

_MEMORY = 6 * 2**30
"""Bytes of photographs that are cached; those that do not fit are read again each time."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Example:
    """One training view."""

    index: int
    """Index of the training view."""

    camera: Camera
    """Pinhole."""

    photograph: Float[Tensor, "height width 3"]
    """[0, 1]; 0 where the mask is False. With an alpha channel: colour times alpha."""

    mask: Bool[Tensor, "height width"] | None
    """Valid pixels; None is all."""

    alpha: Float[Tensor, "height width"] | None = None
    """Opacity of each pixel, [0, 1]; None is opaque everywhere."""


class TrainingPhotographs:
    """Training views by index. Pixels are read at first use.

    Photographs with distortion are resampled into ``camera.undistorted()``; pixels outside the
    photograph have no loss. Pixels that are 0 in the view's own mask have no loss either, or are
    transparent (`FitOptions.masks`). With `keep_alpha` an alpha channel of a photograph is kept,
    to be blended over a colour other than white.

    Example:
        photographs = TrainingPhotographs(capture.train_views, longest=1600)
        example = photographs.example(0, reduction=2)
    """

    def __init__(
        self,
        views: Sequence[View],
        *,
        longest: int,
        masks: Literal["ignore", "alpha", "off"] = "ignore",
        keep_alpha: bool = False,
    ) -> None:
        self._views = tuple(views)
        self._longest = longest
        self._masks = masks
        self._keep_alpha = keep_alpha
        self._cache: dict[int, _Pixels] = {}
        self._bytes = 0
        self._cameras = [undistorted_camera(image_camera(view, longest)) for view in self._views]

    @classmethod
    def of(cls, views: Sequence[View], *, options: FitOptions) -> "TrainingPhotographs":
        """The photographs of views with the options of a fit."""
        return cls(
            views,
            longest=options.longest,
            masks=options.masks,
            keep_alpha=fixed_colour(options.background) is not None,
        )

    def __len__(self) -> int:
        return len(self._views)

    @property
    def views(self) -> tuple[View, ...]:
        """The views."""
        return self._views

    def camera(self, index: int) -> Camera:
        """The pinhole camera of a view at full size."""
        return self._cameras[index]

    def example(self, index: int, *, reduction: int = 1) -> Example:
        """A view with its sides divided by `reduction`: means of square blocks of pixels.

        Rows and columns that do not fill a block are dropped. A block is valid if all its pixels
        are.
        """
        pixels, mask, opaque = self._pixels(index)
        photograph = pixels.float() / 255
        alpha = None if opaque is None else opaque.float() / 255
        camera = self._cameras[index]
        if reduction == 1:
            return Example(
                index=index, camera=camera, photograph=photograph, mask=mask, alpha=alpha
            )
        photograph = torch.nn.functional.avg_pool2d(photograph.movedim(-1, 0), reduction)
        if mask is not None:
            covered = torch.nn.functional.avg_pool2d(mask[None].float(), reduction)[0]
            mask = covered == 1
        if alpha is not None:
            alpha = torch.nn.functional.avg_pool2d(alpha[None], reduction)[0]
        return Example(
            index=index,
            camera=reduced_camera(camera, reduction),
            photograph=photograph.movedim(0, -1).contiguous(),
            mask=mask,
            alpha=alpha,
        )

    def _pixels(self, index: int) -> "_Pixels":
        kept = self._cache.get(index)
        if kept is None:
            kept = self._read(index)
            size = sum(tensor.nbytes for tensor in kept if tensor is not None)
            if self._bytes + size <= _MEMORY:
                self._cache[index] = kept
                self._bytes += size
        return kept

    def _read(self, index: int) -> "_Pixels":
        view = self._views[index]
        camera = image_camera(view, self._longest)
        pixels = load_image(view, longest=self._longest)
        if self._masks == "alpha" or (self._keep_alpha and view.mask is None):
            alpha = load_alpha(view, longest=self._longest)
            if alpha is not None:
                return _premultiplied(pixels, alpha, view, camera)
        own_mask = load_mask(view, longest=self._longest) if self._masks == "ignore" else None
        if camera.is_pinhole:
            if own_mask is None:
                return pixels, None, None
            mask = own_mask.bool()
            return pixels * mask[..., None], mask, None
        pinhole, mask = photograph_to_pinhole(pixels.float(), camera)
        if own_mask is not None:
            used, _ = photograph_to_pinhole(own_mask.float()[..., None], camera)
            mask = mask & (used[..., 0] > 1 - 1e-3)
        pinhole = (pinhole + 0.5).clamp(0, 255).to(torch.uint8)
        return pinhole * mask[..., None], mask, None


_Pixels = tuple[Tensor, Tensor | None, Tensor | None]
"""Photograph (uint8), mask and alpha (uint8)."""


def _premultiplied(pixels: Tensor, alpha: Tensor, view: View, camera: Camera) -> _Pixels:
    """A photograph times its alpha, undistorted, with the mask of valid pixels."""
    opaque = alpha.float()[..., None]
    if view.mask is None:
        # Its own alpha: it was blended over white, whose contribution is subtracted.
        colour = (pixels.float() - (255 - opaque)).clamp_min(0)
    else:
        colour = pixels.float() * opaque / 255
    mask = None
    both = torch.cat((colour, opaque), dim=2)
    if not camera.is_pinhole:
        both, mask = photograph_to_pinhole(both, camera)
        both = both * mask[..., None]
    both = (both + 0.5).clamp(0, 255).to(torch.uint8)
    return both[..., :3].contiguous(), mask, both[..., 3].contiguous()


def reduced_camera(camera: Camera, reduction: int) -> Camera:
    """The camera of an image whose pixels are blocks of `reduction` x `reduction`."""
    return replace(
        camera,
        width=camera.width // reduction,
        height=camera.height // reduction,
        fx=camera.fx / reduction,
        fy=camera.fy / reduction,
        cx=camera.cx / reduction,
        cy=camera.cy / reduction,
    )


@boundary
def reduction_note(views: Sequence[View], *, longest: int) -> str | None:
    """One sentence on photographs that are downsampled for the fit; None if none is."""
    sizes = [(view.camera.width, view.camera.height) for view in views]
    larger = [size for size in sizes if max(size) > longest]
    if not larger:
        return None
    width, height = max(larger)
    new_width, new_height = reduced_size(width, height, longest)
    return (
        f"{len(larger)} of {len(sizes)} photographs are reduced to a longest side of {longest} "
        f"pixels (the largest from {width}x{height} to {new_width}x{new_height})."
    )
