"""Photographs as networks take them: resized, normalised, padded; and what came of the last."""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Generic, Literal, TypeVar, cast

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from splatseg.core.models import Image
from splatseg.errors import BackendError, FileFormatError, quoted
from splatseg.io.json_files import read_json

IMAGENET = ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225))
"""Mean and standard deviation of the channels, in [0, 1]."""

_MAX_SIDE = 1 << 14
_SMALLEST_STD = 1e-3
"""Colours are divided by it."""


_MULTIPLES = ("size_divisor", "size_divisibility", "ensure_multiple_of")
"""What the multiple of sides is called in the files of the several networks."""

_A = TypeVar("_A")


def image_digest(image: Image) -> str:
    """A digest of an image's size and pixels."""
    array = image.detach().cpu().contiguous().numpy()
    digest = hashlib.sha256(repr((array.shape, array.dtype.str)).encode())
    digest.update(array.data)
    return digest.hexdigest()


@dataclass(frozen=True, slots=True, kw_only=True)
class Normalisation:
    """What is done to colours in [0, 1]: less the mean, by the deviation."""

    mean: tuple[float, float, float] = IMAGENET[0]
    std: tuple[float, float, float] = IMAGENET[1]

    @classmethod
    def of(cls, folder: Path, otherwise: "Normalisation | None" = None) -> "Normalisation":
        """The one that the weights' own settings for images say, else ImageNet's or another."""
        known = cls() if otherwise is None else otherwise
        path, content = _image_settings(folder)
        return cls(
            mean=_three(path, content, "image_mean", known.mean),
            std=_three(path, content, "image_std", known.std, least=_SMALLEST_STD),
        )


def _image_settings(folder: Path) -> tuple[Path, dict[str, Any]]:
    """How weights want images, and the file that says so; nothing where none does.

    That is preprocessor_config.json, or a part of processor_config.json where newer programs wrote
    one file for images and words.
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
    """
    path, content = _image_settings(folder)
    size = content.get("size")
    value = cast("dict[str, Any]", size).get(name) if isinstance(size, dict) else None
    if value is None:
        return otherwise
    return _pixels(path, f"size: {name}", value)


def _pixels(path: Path, name: str, value: object) -> int:
    """A number of pixels that a file gives, from 1 to 16384."""
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
        return _unpadded(height, width, (size, size))
    scale = size / max(height, width)
    if shape == "padded":
        inner = [max(1, int(side * scale + 0.5)) for side in (height, width)]
        return Frame(
            height=height, width=width, inner_height=inner[0], inner_width=inner[1],
            outer_height=size, outer_width=size,
        )  # fmt: skip
    rows, columns = (max(1, round(s * scale / multiple)) * multiple for s in (height, width))
    return _unpadded(height, width, (rows, columns))


def _unpadded(height: int, width: int, inner: tuple[int, int]) -> Frame:
    return Frame(
        height=height, width=width, inner_height=inner[0], inner_width=inner[1],
        outer_height=inner[0], outer_width=inner[1],
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
    inner = (grid.rows * grid.patch, grid.columns * grid.patch)
    frame = _unpadded(height + below, width + right, inner)
    continued = [
        F.pad(image.permute(2, 0, 1).float()[None], (0, right, 0, below), mode="replicate")[0]
        .permute(1, 2, 0)
        .to(torch.uint8)
        for image in images
    ]
    return network_input(continued, frame, normalisation, device=device, dtype=dtype, mode=mode)


@dataclass(frozen=True, slots=True, kw_only=True)
class InputSize:
    """Sides of a network's input. Either `sides`, or `shortest` and `longest`."""

    shortest: int | None = None
    """Pixels of the shorter side, where the longer one does not become more than `longest`."""

    longest: int | None = None
    """The most pixels of the longer side."""

    sides: tuple[int, int] | None = None
    """Height and width, whatever the image's proportions are."""

    keeps_proportions: bool = False
    """With `sides`: the image is scaled so that one side fits, the one that changes it less."""

    multiple: int = 1
    """Sides are multiples of this."""

    takes_squares: bool = False
    """The network takes squares only: a size that the user says is both sides."""

    @classmethod
    def of(cls, folder: Path, *, otherwise: "InputSize") -> "InputSize":
        """The one that the weights' preprocessor_config.json says.

        Args:
            folder: The weights.
            otherwise: What holds where the file is not there or does not tell; a size of one
                number is both sides where this has `sides`, else the shorter one.

        Raises:
            FileFormatError: If a size is no number of pixels.
        """
        path, content = _image_settings(folder)
        if not content:
            return otherwise
        size = content.get("size")
        multiple = otherwise.multiple
        for name in _MULTIPLES:
            if content.get(name):
                multiple = _pixels(path, name, content[name])
        if size is None:
            return replace(otherwise, multiple=multiple, takes_squares=False)
        given = cast(dict[str, Any], size) if isinstance(size, dict) else {}
        numbers = {
            key: _pixels(path, f"size {key}", value) for key, value in given.items() if value
        }
        if not isinstance(size, dict):
            one = _pixels(path, "size", size)
            square = otherwise.sides is not None
            numbers = {"height": one, "width": one} if square else {"shortest_edge": one}
            if not square and content.get("max_size"):
                numbers["longest_edge"] = _pixels(path, "max_size", content["max_size"])
        if "height" in numbers and "width" in numbers:
            return cls(
                sides=(numbers["height"], numbers["width"]),
                keeps_proportions=content.get("keep_aspect_ratio") is True,
                multiple=multiple,
            )
        if not numbers.keys() & {"shortest_edge", "longest_edge"}:
            raise FileFormatError(
                f"{path}: size: expected height and width or the shortest and longest edge, got "
                f"{quoted(size)}."
            )
        return cls(
            shortest=numbers.get("shortest_edge"),
            longest=numbers.get("longest_edge"),
            multiple=multiple,
        )

    def frame(self, height: int, width: int, *, size: int | None = None) -> Frame:
        """How an image is laid into the input, without padding.

        Args:
            height: Rows of the image.
            width: Columns of the image.
            size: The longer side, where the user says it: the proportions are kept unless the
                network takes squares.
        """
        if size is not None and not self.takes_squares:
            return frame_of(height, width, size=size, multiple=self.multiple)
        if size is not None:
            inner = self._whole((size, size))
            return frame_of(height, width, size=inner[0], shape="square")
        if self.sides is not None and not self.keeps_proportions:
            inner = self._whole(self.sides)
        elif self.sides is not None:
            scales = (self.sides[0] / height, self.sides[1] / width)
            scale = min(scales, key=lambda one: abs(1 - one))
            inner = self._whole((height * scale, width * scale))
        else:
            scale = (self.shortest or self.longest or 1) / min(height, width)
            if self.longest is not None:
                scale = min(scale, self.longest / max(height, width))
                if self.shortest is None:
                    scale = self.longest / max(height, width)
            inner = self._whole((height * scale, width * scale))
        return _unpadded(height, width, inner)

    def _whole(self, sides: Sequence[float]) -> tuple[int, int]:
        rows, columns = (max(1, int(side / self.multiple + 0.5)) * self.multiple for side in sides)
        return rows, columns


def is_lack_of_memory(error: BaseException) -> bool:
    """Whether an error says that there is no memory for a tensor."""
    return isinstance(error, torch.OutOfMemoryError | MemoryError) or (
        isinstance(error, RuntimeError) and "allocate memory" in str(error)
    )


class LastImages(Generic[_A]):
    """Encodes images, several at a time if they are announced, and keeps the last ones.

    What is kept is found by the content of the image, so it changes no answer.
    """

    def __init__(
        self, run: Callable[[Sequence[Image]], Sequence[_A]], *, resizable: bool = True
    ) -> None:
        """Keep what a network makes of images; a resizable one takes inputs of other sizes."""
        self._run = run
        self._resizable = resizable
        self._kept: dict[str, _A] = {}

    def encode(self, images: Sequence[Image]) -> None:
        """Encode images of one size together; what was kept before is forgotten."""
        digests = [image_digest(image) for image in images]
        if all(digest in self._kept for digest in digests):
            return
        self._kept = {}  # before the run: the two together may not fit
        self._kept = dict(zip(digests, self._fitting(images), strict=True))

    def _fitting(self, images: Sequence[Image]) -> list[_A]:
        """As many together as memory holds, half as many where they do not fit."""
        try:
            return list(self._run(images))
        except (torch.OutOfMemoryError, MemoryError, RuntimeError) as error:
            if not is_lack_of_memory(error):
                raise
            height, width = (int(side) for side in images[0].shape[:2])
            if len(images) == 1:
                smaller = "--size N makes it smaller for the network, " * self._resizable
                raise BackendError(
                    f"there is not enough memory for an image of {width}x{height}; {smaller}"
                    "--dtype bfloat16 halves the network."
                ) from error
        half = len(images) // 2
        return [*self._fitting(images[:half]), *self._fitting(images[half:])]

    def of(self, image: Image) -> _A:
        """What the network makes of an image."""
        self.encode([image])
        return self._kept[image_digest(image)]
