"""What the public functions of rendering ask of their arguments."""

from weakref import WeakKeyDictionary

import torch
from torch import Tensor

from splatseg._check import check_finite, check_shape
from splatseg.core import Camera, Gaussians
from splatseg.errors import InputError, RangeError

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
