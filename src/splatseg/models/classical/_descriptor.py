"""A dense descriptor of colour and gradients, without weights."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from splatseg.core import FeatureMap
from splatseg.core.boundary import boundary, convert_fields
from splatseg.core.models import DeepFeatures, Image
from splatseg.errors import InputError
from splatseg.models.classical._boundary import one_thread

_LIGHTNESS_WEIGHT = 0.5
"""L against a and b: shading changes L from view to view, the object's colour does not."""

_DIRECTIONS = 8


@dataclass(frozen=True, slots=True, kw_only=True)
class DescriptorOptions:
    """What the descriptor is made of."""

    cell_size: int = 8
    """Pixels of the photograph a cell of features."""

    reaches: tuple[float, ...] = (1.0, 3.0)
    """Widths of the neighbourhoods, in cells, that are described: one depth each, the deepest
    last."""

    def __post_init__(self) -> None:
        convert_fields(self)
        if self.cell_size < 1:
            raise InputError(f"cell_size: expected at least 1, got {self.cell_size}.")
        if not self.reaches or min(self.reaches) <= 0:
            raise InputError(f"reaches: expected positive widths, got {self.reaches}.")


@boundary
def colour_gradient_features(
    image: Image, options: DescriptorOptions | None = None
) -> DeepFeatures:
    """Mean and spread of Lab and a histogram of gradient directions, per neighbourhood.

    A stand-in for the features of a network: like surfaces get like vectors, but it knows
    nothing of what things are. Channels: mean L (halved), a, b; spread of L, a, b; then the
    gradient energy of eight directions, all scaled to about [-1, 1].

    Returns:
        One map a reach, float32 with 14 channels, and as class token the mean of the deepest.
    """
    import cv2

    options = DescriptorOptions() if options is None else options
    height, width = (int(s) for s in image.shape[:2])
    cell = options.cell_size
    rows, columns = -(-height // cell), -(-width // cell)
    array = np.ascontiguousarray(image.cpu().numpy())
    # Cells at the lower and right border may reach over the image; it is continued there.
    padded = np.pad(
        array, ((0, rows * cell - height), (0, columns * cell - width), (0, 0)), mode="edge"
    )
    with one_thread():
        scaled = padded.astype(np.float32) / 255
        lab = np.asarray(cv2.cvtColor(scaled, cv2.COLOR_RGB2LAB), np.float32)
        planes = _planes(lab)
        cells = [_by_cell(plane, rows, columns) for plane in planes]
        maps = [_described(cells, reach) for reach in options.reaches]
    return DeepFeatures(
        maps=tuple(
            FeatureMap(features=torch.from_numpy(values), stride=cell, height=height, width=width)
            for values in maps
        ),
        depths=tuple(f"reach{reach:g}" for reach in options.reaches),
        class_token=torch.from_numpy(maps[-1].mean((0, 1), dtype=np.float64).astype(np.float32)),
    )


def _planes(lab: NDArray[np.float32]) -> list[NDArray[np.float32]]:
    """Lab, its squares, and the gradient energy of each direction."""
    import cv2

    scaled = lab / np.array([100.0, 50.0, 50.0], np.float32)
    dx = np.asarray(cv2.Scharr(lab[..., 0], cv2.CV_32F, 1, 0)) / 16
    dy = np.asarray(cv2.Scharr(lab[..., 0], cv2.CV_32F, 0, 1)) / 16
    planes = [scaled[..., k] for k in range(3)]
    planes += [scaled[..., k] ** 2 for k in range(3)]
    for k in range(_DIRECTIONS):
        angle = np.pi * k / _DIRECTIONS
        planes.append(np.abs(dx * np.float32(np.cos(angle)) + dy * np.float32(np.sin(angle))))
    return planes


def _by_cell(plane: NDArray[np.float32], rows: int, columns: int) -> NDArray[np.float32]:
    height, width = plane.shape
    blocks = plane.reshape(rows, height // rows, columns, width // columns)
    return blocks.mean((1, 3), dtype=np.float64).astype(np.float32)


def _described(cells: list[NDArray[np.float32]], reach: float) -> NDArray[np.float32]:
    import cv2

    def blurred(plane: NDArray[np.float32]) -> Any:
        return cv2.GaussianBlur(plane, (0, 0), reach / 2, borderType=cv2.BORDER_REFLECT)

    means = np.stack([np.asarray(blurred(plane)) for plane in cells], axis=2)
    colour, squares, energy = means[..., :3], means[..., 3:6], means[..., 6:]
    spread = np.sqrt(np.maximum(squares - colour**2, 0))
    weighted = colour * np.array([_LIGHTNESS_WEIGHT, 1.0, 1.0], np.float32)
    values = np.concatenate((weighted, spread, energy / (energy + 4.0)), axis=2)
    return np.ascontiguousarray(values, dtype=np.float32)
