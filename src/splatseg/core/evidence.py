"""What 2D models see in one view (masks, label, feature and depth maps), and where it is from."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from torch import Tensor

from splatseg._check import check_finite, check_shape, check_values
from splatseg.core.boundary import boundary, convert_fields
from splatseg.core.options import Count
from splatseg.core.upward import Previewed
from splatseg.errors import InputError, RangeError, ShapeError

_MAX_BITS = 35
"""Of a number in compressed counts: 7 characters, which hold any run and any difference of two."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rle:
    """One binary mask as run lengths in column-major order, the first run being zeros."""

    height: int
    width: int
    counts: NDArray[np.uint32]

    def __post_init__(self) -> None:
        convert_fields(self)
        total = int(self.counts.sum(dtype=np.uint64))
        if total != self.height * self.width:
            raise RangeError(
                f"counts: expected runs that add up to {self.height} x {self.width} = "
                f"{self.height * self.width} pixels, got {total}."
            )

    @property
    def area(self) -> int:
        """Number of pixels set."""
        return int(self.counts[1::2].sum(dtype=np.uint64))

    @property
    def bbox(self) -> tuple[int, int, int, int]:
        """x, y, width, height of the tight box; zeros where the mask is empty."""
        ends = np.cumsum(self.counts, dtype=np.int64)
        begins, ends = ends[0::2][: len(self.counts[1::2])], ends[1::2]
        keep = ends > begins
        begins, last = begins[keep], ends[keep] - 1
        if not len(begins):
            return (0, 0, 0, 0)
        x0, x1 = int(begins[0] // self.height), int(last[-1] // self.height)
        # A run that crosses into the next column touches both the bottom and the top row.
        crosses = bool((begins // self.height != last // self.height).any())
        y0 = 0 if crosses else int((begins % self.height).min())
        y1 = self.height - 1 if crosses else int((last % self.height).max())
        return (x0, y0, x1 - x0 + 1, y1 - y0 + 1)

    @classmethod
    @boundary
    def encode(cls, mask: Bool[Tensor, "height width"]) -> "Rle":
        """Run lengths of a boolean mask."""
        height, width = (int(s) for s in mask.shape)
        flat = mask.to(torch.bool).cpu().numpy().T.reshape(-1)
        changes = np.flatnonzero(flat[1:] != flat[:-1]) + 1
        edges = np.concatenate(([0], changes, [flat.size]))
        counts = np.diff(edges).astype(np.uint32)
        if flat.size and flat[0]:
            counts = np.concatenate((np.zeros(1, np.uint32), counts))
        return cls(height=height, width=width, counts=counts)

    def decode(self) -> Bool[Tensor, "height width"]:
        """The mask as booleans."""
        values = np.arange(len(self.counts)) % 2 == 1
        flat = np.repeat(values, self.counts)
        return torch.from_numpy(np.ascontiguousarray(flat.reshape(self.width, self.height).T))

    @classmethod
    @boundary
    def from_coco(cls, text: str | bytes, *, height: int, width: int) -> "Rle":
        """Read COCO's compressed counts: 5 bits a character, least significant first.

        From the third run on, a number is stored as the difference to the run before last.

        Raises:
            InputError: If a character is outside the alphabet or a number does not end.
        """
        # Bytes of what is not ASCII are above 127, which is refused below.
        data = text.encode() if isinstance(text, str) else text
        codes = np.frombuffer(data, np.uint8).astype(np.int64) - 48
        if codes.size and (codes.min() < 0 or codes.max() > 63):
            raise InputError("counts: expected a compressed COCO mask, got other characters.")
        if codes.size and codes[-1] & 32:
            raise InputError("counts: the compressed mask breaks off inside a number.")
        counts: list[int] = []
        value = shift = 0
        for code in codes.tolist():
            value |= (code & 31) << shift
            shift += 5
            if code & 32:
                if shift >= _MAX_BITS:
                    raise InputError("counts: expected runs of 32 bits, got a longer number.")
                continue
            if code & 16:
                value -= 1 << shift
            counts.append(value + (counts[-2] if len(counts) > 2 else 0))
            value = shift = 0
        if any(count < 0 for count in counts):
            raise InputError("counts: the compressed mask holds a negative run.")
        total = sum(counts)
        if total != height * width:  # before they are forced into 32 bits
            raise InputError(
                f"counts: expected runs that add up to {height} x {width} = {height * width} "
                f"pixels, got {total}."
            )
        return cls(height=height, width=width, counts=np.array(counts, np.uint32))

    def to_coco(self) -> str:
        """COCO's compressed counts. Inverse of `from_coco`."""
        out: list[str] = []
        runs = self.counts.tolist()
        for i, run in enumerate(runs):
            value = run - runs[i - 2] if i > 2 else run
            more = True
            while more:
                code = value & 31
                value >>= 5
                more = value != (-1 if code & 16 else 0)
                out.append(chr((code | 32 if more else code) + 48))
        return "".join(out)


UNLABELLED = -1
"""The id of a pixel or Gaussian without a label. Files write it as 0."""

DepthKind = Literal["metric", "relative"]
"""Metric depth is z-depth in metres; relative is inverse depth up to a scale and a shift."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MaskSet(Previewed):
    """Masks of one view. They may overlap and need not cover the image."""

    height: int
    width: int
    masks: tuple[Rle, ...]
    """Run-length masks, each of height x width pixels."""

    scores: Float[Tensor, "m"]
    """Confidence of the model in each mask, in [0, 1]."""

    levels: Int[Tensor, "m"]
    """Granularity, 0 the finest; all 0 where the model has no levels."""

    objectness: Float[Tensor, "m"] | None = None
    """How far a mask is expected to be a whole object, neither a part of one nor several: twice
    what its IoU with an object is above a half, in [0, 1]. None where the model does not tell."""

    def __post_init__(self) -> None:
        convert_fields(self)
        for name, values in (("scores", self.scores), ("objectness", self.objectness)):
            if values is not None:
                check_shape(name, values, (len(self.masks),))
                check_finite(name, values)
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

    @boundary
    def dense(self, index: int) -> Bool[Tensor, "height width"]:
        """One mask as booleans."""
        return self.masks[index].decode()

    def subset(self, rows: Sequence[int]) -> "MaskSet":
        """Some of the masks, in the order given."""
        index = torch.tensor(rows, dtype=torch.int64)
        return replace(
            self,
            masks=tuple(self.masks[i] for i in rows),
            scores=self.scores[index],
            levels=self.levels[index],
            objectness=None if self.objectness is None else self.objectness[index],
        )

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
class LabelMap(Previewed):
    """One id a pixel."""

    ids: Int[Tensor, "height width"]
    """int32 ids, -1 where a pixel has none."""

    confidence: Float[Tensor, "height width"] | None = None
    """Confidence of the id, in [0, 1]."""

    def __post_init__(self) -> None:
        convert_fields(self)
        if self.ids.numel() and int(self.ids.min()) < UNLABELLED:
            raise RangeError(f"ids: expected -1 or more, got {int(self.ids.min())}.")
        object.__setattr__(self, "ids", self.ids.to(torch.int32))

    def __repr__(self) -> str:
        present = torch.unique(self.ids)
        count = int((present != UNLABELLED).sum())
        return f"LabelMap({self.width}x{self.height} pixels, {count} ids)"

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

    stride: Count
    """Pixels a cell, along both axes."""

    height: int
    """Rows of the image that the grid covers, at least in part."""

    width: int
    """Columns of the image that the grid covers, at least in part."""

    def __post_init__(self) -> None:
        convert_fields(self)

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
        check_values("values", self.values, 0.0, math.inf)
        if self.confidence is not None:
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
    ids: Int[Tensor, "..."],
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


@runtime_checkable
class ViewNames(Protocol):
    """Something recorded of views."""

    @property
    def view_names(self) -> Sequence[str]:
        """Views of which there is something."""
        ...


@runtime_checkable
class LabelSource(Protocol):
    """Label maps by view name, read when asked for: recorded evidence, or a dictionary's."""

    @property
    def view_names(self) -> Sequence[str]:
        """Views that have a label map."""
        ...

    def label_map(self, name: str) -> LabelMap:
        """The label map of one view."""
        ...


@runtime_checkable
class SegmentSource(Protocol):
    """Segments of views, each view with ids of its own."""

    @property
    def view_names(self) -> Sequence[str]:
        """Views that have segments."""
        ...

    @property
    def overlapping(self) -> bool:
        """Whether segments of one view may overlap."""
        ...

    @property
    def persistent(self) -> bool:
        """Whether ids are meant to go through all views, as those of a tracker."""
        ...

    def segments_of(self, name: str) -> LabelMap | MaskSet:
        """The segments of one view: a label map, or masks that may overlap."""
        ...

    def categories_of(self, name: str) -> Mapping[int, int]:
        """Category by segment, where it is known."""
        ...


@runtime_checkable
class FeatureSource(Protocol):
    """Feature maps by view name, read when asked for."""

    @property
    def view_names(self) -> Sequence[str]:
        """Views that have a feature map."""
        ...

    def features(self, name: str) -> FeatureMap:
        """The feature map of one view."""
        ...
