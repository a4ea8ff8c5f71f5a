"""What 2D models see in one view: masks, label maps, feature maps, depth maps."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from splatseg._check import check_choice, check_finite, check_shape, check_values
from splatseg.core.boundary import boundary, convert_fields
from splatseg.core.late import preview
from splatseg.core.rle import Rle
from splatseg.errors import RangeError, ShapeError

UNLABELLED = -1
"""The id of a pixel or Gaussian without a label. Files write it as 0."""

DepthKind = Literal["metric", "relative"]
"""Metric depth is z-depth in metres; relative is inverse depth up to a scale and a shift."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MaskSet:
    """Masks of one view. They may overlap and need not cover the image."""

    height: int
    width: int
    masks: tuple[Rle, ...]
    """Run-length masks, each of height x width pixels."""

    scores: Float[Tensor, "m"]
    """Confidence of the model in each mask, in [0, 1]."""

    levels: Int[Tensor, "m"]
    """Granularity, 0 the finest; all 0 where the model has no levels."""

    def __post_init__(self) -> None:
        convert_fields(self)
        check_shape("scores", self.scores, (len(self.masks),))
        check_finite("scores", self.scores)
        check_shape("levels", self.levels, (len(self.masks),))
        for i, mask in enumerate(self.masks):
            if (mask.height, mask.width) != (self.height, self.width):
                raise ShapeError(
                    f"masks[{i}]: expected {self.height} x {self.width} pixels, "
                    f"got {mask.height} x {mask.width}."
                )

    def __len__(self) -> int:
        return len(self.masks)

    def __repr__(self) -> str:
        levels = len(set(self.levels.tolist()))
        of = f", {levels} levels" if levels > 1 else ""
        return f"MaskSet({len(self)} masks of {self.width}x{self.height} pixels{of})"

    def _repr_html_(self) -> str:
        return preview(self)

    @boundary
    def dense(self, index: int) -> Bool[Tensor, "height width"]:
        """One mask as booleans."""
        return self.masks[index].decode()

    @classmethod
    @boundary
    def from_dense(
        cls,
        masks: Bool[Tensor, "m height width"],
        *,
        scores: Sequence[float] | Tensor | None = None,
        levels: Sequence[int] | Tensor | None = None,
    ) -> "MaskSet":
        """Encode boolean masks; scores default to 1 and levels to 0."""
        check_shape("masks", masks, (None, None, None))
        count, height, width = (int(s) for s in masks.shape)
        return cls(
            height=height,
            width=width,
            masks=tuple(Rle.encode(mask) for mask in masks),
            scores=torch.ones(count)
            if scores is None
            else torch.as_tensor(scores, dtype=torch.float32),
            levels=torch.zeros(count, dtype=torch.int32)
            if levels is None
            else torch.as_tensor(levels, dtype=torch.int32),
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LabelMap:
    """One id a pixel."""

    ids: Int[Tensor, "height width"]
    """int32 ids, -1 where a pixel has none."""

    confidence: Float[Tensor, "height width"] | None = None
    """Confidence of the id, in [0, 1]."""

    def __post_init__(self) -> None:
        convert_fields(self)
        check_shape("ids", self.ids, (None, None))
        if self.ids.numel() and int(self.ids.min()) < UNLABELLED:
            raise RangeError(f"ids: expected -1 or more, got {int(self.ids.min())}.")
        object.__setattr__(self, "ids", self.ids.to(torch.int32))
        if self.confidence is not None:
            check_shape("confidence", self.confidence, tuple(self.ids.shape))

    def __repr__(self) -> str:
        present = torch.unique(self.ids)
        count = int((present != UNLABELLED).sum())
        return f"LabelMap({self.width}x{self.height} pixels, {count} ids)"

    def _repr_html_(self) -> str:
        return preview(self)

    @property
    def height(self) -> int:
        """Rows."""
        return int(self.ids.shape[0])

    @property
    def width(self) -> int:
        """Pixels a row."""
        return int(self.ids.shape[1])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FeatureMap:
    """Dense features on a grid of square cells; cell (i, j) starts at pixel (i, j) * stride.

    Values are checked where maps are read and lifted, with the name of the view.
    """

    features: Float[Tensor, "rows columns channels"]

    stride: int
    """Pixels a cell, along both axes."""

    height: int
    """Rows of the image that the grid covers, at least in part."""

    width: int
    """Columns of the image that the grid covers, at least in part."""

    def __post_init__(self) -> None:
        convert_fields(self)
        check_shape("features", self.features, (None, None, None))
        if self.stride < 1:
            raise RangeError(f"stride: expected at least 1, got {self.stride}.")

    def __repr__(self) -> str:
        rows, columns, channels = self.features.shape
        return f"FeatureMap({rows}x{columns} cells of {self.stride} pixels, {channels} channels)"

    @property
    def channels(self) -> int:
        """Width of a feature."""
        return int(self.features.shape[2])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DepthMap:
    """How far the surfaces of one view are, as a network guesses it or a sensor measures it."""

    values: Float[Tensor, "height width"]
    """Not negative; 0 where nothing is known, and in relative maps for what is infinitely far."""

    kind: DepthKind
    """metric: z-depth in metres (`docs/conventions.md`). relative: inverse depth up to a scale and
    a shift, which are other ones in each view."""

    confidence: Float[Tensor, "height width"] | None = None
    """Confidence of the values, in [0, 1]."""

    def __post_init__(self) -> None:
        convert_fields(self)
        check_choice("kind", self.kind, ("metric", "relative"))
        check_shape("values", self.values, (None, None))
        check_values("values", self.values, 0.0, math.inf)
        if self.confidence is not None:
            check_shape("confidence", self.confidence, tuple(self.values.shape))
            check_values("confidence", self.confidence, 0.0, 1.0)

    def __repr__(self) -> str:
        known = float((self.values > 0).float().mean()) if self.values.numel() else 0.0
        return f"DepthMap({self.kind}, {self.width}x{self.height} pixels, {known:.0%} known)"

    @property
    def height(self) -> int:
        """Rows."""
        return int(self.values.shape[0])

    @property
    def width(self) -> int:
        """Pixels a row."""
        return int(self.values.shape[1])


@dataclass(frozen=True, slots=True, kw_only=True)
class Segment:
    """One segment of one view."""

    id: int
    category: int
    isthing: bool
    score: float
    """Confidence of the model, in [0, 1]."""

    def __post_init__(self) -> None:
        convert_fields(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class Track:
    """One object followed through the views."""

    id: int
    votes: Mapping[str, int]
    """Pixels under the track by the name of the class that a segmenter gave them."""

    def __post_init__(self) -> None:
        convert_fields(self)

    @property
    def category(self) -> str | None:
        """The class name with most votes; the first by name among equals."""
        return min(self.votes, key=lambda name: (-self.votes[name], name)) if self.votes else None


@boundary
def map_ids(
    ids: Int[Tensor, "height width"],
    values: Mapping[int, float],
    *,
    default: float | None,
    dtype: torch.dtype = torch.int64,
) -> Tensor:
    """What each pixel's id stands for.

    Args:
        ids: The ids of a map.
        values: What they stand for: other ids, or numbers.
        default: What an id stands for that has no value; None is the id itself.
        dtype: Of the result.

    Returns:
        (height, width), in `dtype`.

    Raises:
        RangeError: If a value is NaN or infinite and `dtype` holds integers.

    Example:
        >>> map_ids(torch.tensor([[7, -1]]), {7: 2}, default=None)
        tensor([[ 2, -1]])
    """
    if not dtype.is_floating_point and not all(
        math.isfinite(value) for value in (default or 0, *values.values())
    ):
        raise RangeError(f"values, default: expected finite numbers for {dtype}, got others.")
    present, index = torch.unique(ids, return_inverse=True)
    found = [values.get(id, id if default is None else default) for id in present.tolist()]
    return torch.tensor(found, dtype=dtype)[index]
