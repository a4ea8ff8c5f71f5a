"""Photographs as networks take them: resized, normalised, padded; and their way back."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, cast

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from splatseg.core.models import Image
from splatseg.errors import FileFormatError, quoted
from splatseg.io.json_files import read_json

IMAGENET = ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225))
"""Mean and standard deviation of the channels, in [0, 1]."""

_MAX_SIDE = 1 << 14
_SMALLEST_STD = 1e-3
"""Colours are divided by it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Normalisation:
    """What is done to colours in [0, 1]: less the mean, by the deviation."""

    mean: tuple[float, float, float] = IMAGENET[0]
    std: tuple[float, float, float] = IMAGENET[1]

    @classmethod
    def of(cls, folder: Path, otherwise: "Normalisation | None" = None) -> "Normalisation":
        """The one that the weights' own settings for images say (`image_settings`).

        Args:
            folder: The weights.
            otherwise: The one where it says none; None takes ImageNet's.

        Raises:
            FileFormatError: If it does not hold three numbers in range each.
        """
        known = cls() if otherwise is None else otherwise
        path, content = image_settings(folder)
        return cls(
            mean=_three(path, content, "image_mean", known.mean),
            std=_three(path, content, "image_std", known.std, least=_SMALLEST_STD),
        )


def image_settings(folder: Path) -> tuple[Path, dict[str, Any]]:
    """How weights want images, and the file that says so; nothing where none does.

    That is preprocessor_config.json, or a part of processor_config.json where newer programs wrote
    one file for images and words.

    Raises:
        FileFormatError: If the file is no JSON object.
    """
    path = folder / "preprocessor_config.json"
    if path.is_file():
        return path, read_json(path)
    both = folder / "processor_config.json"
    part = read_json(both).get("image_processor") if both.is_file() else None
    return both, cast("dict[str, Any]", part) if isinstance(part, dict) else {}


def input_side(folder: Path, name: str, otherwise: int) -> int:
    """A side of the network's input, pixels, that the weights' settings for images give.

    Args:
        folder: The weights.
        name: Which: ``height``, ``shortest_edge`` or ``longest_edge``.
        otherwise: The side where they say none.

    Raises:
        FileFormatError: If it is no whole number from 1 to 16384.
    """
    path, content = image_settings(folder)
    size = content.get("size")
    value = cast("dict[str, Any]", size).get(name) if isinstance(size, dict) else None
    if value is None:
        return otherwise
    return pixels(path, f"size: {name}", value)


def pixels(path: Path, name: str, value: object) -> int:
    """A number of pixels that a file gives.

    Raises:
        FileFormatError: If it is no whole number from 1 to 16384.
    """
    if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= _MAX_SIDE:
        raise FileFormatError(
            f"{path}: {name}: expected a number of pixels up to {_MAX_SIDE}, got {quoted(value)}."
        )
    return value


def _three(
    path: Path,
    content: dict[str, Any],
    name: str,
    otherwise: tuple[float, float, float],
    *,
    least: float = 0.0,
) -> tuple[float, float, float]:
    found = content.get(name)
    if found is None:
        return otherwise
    if not isinstance(found, list) or len(found) != 3 or not all(  # pyright: ignore[reportUnknownArgumentType]
        isinstance(x, int | float) and least <= x <= 1 for x in found  # pyright: ignore[reportUnknownVariableType]
    ):  # fmt: skip
        raise FileFormatError(f"{path}: {name}: expected three numbers in [{least:g}, 1].")
    red, green, blue = (float(x) for x in found)  # pyright: ignore[reportUnknownVariableType, reportUnknownArgumentType]
    return red, green, blue


HALVES = Normalisation(mean=(0.5, 0.5, 0.5), std=(0.5, 0.5, 0.5))
"""Colours from -1 to 1, as SAM 3 and others take them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Frame:
    """Where an image lies in the square or rectangle that a network sees."""

    height: int
    """Rows of the image."""

    width: int
    inner_height: int
    """Rows that the image takes; below it is padding."""

    inner_width: int
    outer_height: int
    """Rows of the network's input."""

    outer_width: int


def frame_of(
    height: int,
    width: int,
    *,
    size: int,
    multiple: int = 1,
    shape: Literal["longer", "square", "padded"] = "longer",
) -> Frame:
    """How an image is laid into a network's input.

    Args:
        height: Rows of the image.
        width: Columns of the image.
        size: The longer side of the input, pixels, or both sides.
        multiple: Sides of the input are multiples of this, at least one.
        shape: ``longer`` keeps the proportions to a multiple; ``square`` stretches both sides to
            `size`; ``padded`` keeps them, below and to the right of the image is padding.
    """
    if shape == "square":
        return Frame(
            height=height, width=width, inner_height=size, inner_width=size,
            outer_height=size, outer_width=size,
        )  # fmt: skip
    scale = size / max(height, width)
    if shape == "padded":
        inner = [max(1, int(side * scale + 0.5)) for side in (height, width)]
        return Frame(
            height=height, width=width, inner_height=inner[0], inner_width=inner[1],
            outer_height=size, outer_width=size,
        )  # fmt: skip
    sides = [max(1, round(side * scale / multiple)) * multiple for side in (height, width)]
    return Frame(
        height=height, width=width, inner_height=sides[0], inner_width=sides[1],
        outer_height=sides[0], outer_width=sides[1],
    )  # fmt: skip


def network_input(
    images: Sequence[Image],
    frame: Frame,
    normalisation: Normalisation,
    *,
    device: torch.device,
    dtype: torch.dtype,
    mode: Literal["bilinear", "bicubic"] = "bilinear",
    padding: Literal["mean", "black"] = "mean",
) -> Float[Tensor, "images 3 height width"]:
    """Images of one size as a batch: resized with antialiasing, normalised, padded.

    Padding is of the mean colour, which is 0 after normalisation, or black before it.
    """
    batch = torch.stack([image.permute(2, 0, 1) for image in images]).to(device).float()
    inner = (frame.inner_height, frame.inner_width)
    if batch.shape[-2:] != inner:
        batch = F.interpolate(batch, inner, mode=mode, antialias=True).clamp_(0, 255).round_()
    mean = batch.new_tensor(normalisation.mean).view(3, 1, 1) * 255
    std = batch.new_tensor(normalisation.std).view(3, 1, 1) * 255
    batch = (batch - mean) / std
    below, right = frame.outer_height - inner[0], frame.outer_width - inner[1]
    if below or right:
        lacking = F.pad(torch.zeros_like(batch[:1, :1]), (0, right, 0, below), value=1)
        batch = F.pad(batch, (0, right, 0, below))
        if padding == "black":
            batch = torch.where(lacking > 0, -mean / std, batch)
    return batch.to(dtype)


@dataclass(frozen=True, slots=True, kw_only=True)
class PatchGrid:
    """Patches of a network on an image, each on a square of whole pixels."""

    rows: int
    columns: int
    stride: int
    """Pixels of the image that a patch lies on, along both axes."""

    patch: int
    """Pixels of the network's input that a patch has, along both axes."""


def patch_grid(height: int, width: int, *, patch: int, size: int) -> PatchGrid:
    """The grid whose longer side is as near to `size` pixels of input as whole pixels allow.

    Cells of a feature map start at whole pixels, so the input is not the image at some size but
    the image's cells at the size of a patch; at the lower and right border they reach over it.

    Example:
        >>> patch_grid(384, 512, patch=14, size=518)
        PatchGrid(rows=28, columns=37, stride=14, patch=14)
    """
    stride = max(1, round(patch * max(height, width) / size))
    return PatchGrid(
        rows=-(-height // stride), columns=-(-width // stride), stride=stride, patch=patch
    )


def patch_input(
    images: Sequence[Image],
    grid: PatchGrid,
    normalisation: Normalisation,
    *,
    device: torch.device,
    dtype: torch.dtype,
    mode: Literal["bilinear", "bicubic"] = "bicubic",
) -> Float[Tensor, "images 3 height width"]:
    """Images of one size as a batch of whole patches; beyond the border the image is continued."""
    height, width = (int(side) for side in images[0].shape[:2])
    below, right = grid.rows * grid.stride - height, grid.columns * grid.stride - width
    frame = Frame(
        height=height + below, width=width + right,
        inner_height=grid.rows * grid.patch, inner_width=grid.columns * grid.patch,
        outer_height=grid.rows * grid.patch, outer_width=grid.columns * grid.patch,
    )  # fmt: skip
    continued = [
        F.pad(image.permute(2, 0, 1).float()[None], (0, right, 0, below), mode="replicate")[0]
        .permute(1, 2, 0)
        .to(torch.uint8)
        for image in images
    ]
    return network_input(continued, frame, normalisation, device=device, dtype=dtype, mode=mode)
