"""What pixels are trained towards: targets of any number a pixel, and the groups pixels come in."""

import hashlib
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Int64
from torch import Tensor

from splatseg.core import UNLABELLED, LabelMap, LabelSource, MaskSet
from splatseg.core.boundary import boundary, convert_fields
from splatseg.errors import InputError, ShapeError, SplatsegError
from splatseg.io.arrays import read_npy
from splatseg.render import SparseWeights


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Ragged:
    """Rows of any length, one after the other: row p is ``values[starts[p]:starts[p + 1]]``."""

    starts: Int64[Tensor, "rows_plus_1"]
    """Where each row begins; 0 first, the number of values last."""

    values: Tensor
    """The rows' values, rows along the first axis."""

    def __post_init__(self) -> None:
        convert_fields(self)
        if self.starts.ndim != 1 or not self.values.ndim:
            raise ShapeError("starts, values: expected starts of one axis and rows of values.")
        if not len(self.starts) or int(self.starts[0]) or int(self.starts[-1]) != len(self.values):
            raise ShapeError(
                f"starts: expected to begin with 0 and end with {len(self.values)}, the number "
                f"of values, got {self.starts[:1].tolist()} and {self.starts[-1:].tolist()}."
            )

    def __len__(self) -> int:
        return len(self.starts) - 1

    def row(self, index: int) -> Tensor:
        """One row's values."""
        return self.values[int(self.starts[index]) : int(self.starts[index + 1])]

    def slice(self, begin: int, end: int) -> "Ragged":
        """Consecutive rows."""
        first, last = int(self.starts[begin]), int(self.starts[end])
        return Ragged(starts=self.starts[begin : end + 1] - first, values=self.values[first:last])

    @classmethod
    def of(cls, rows: Sequence[Tensor]) -> "Ragged":
        """Rows of integers given one by one."""
        none = torch.zeros(0, dtype=torch.int64)
        sizes = torch.tensor([len(row) for row in rows], dtype=torch.int64)
        return cls(starts=_starts(sizes), values=torch.cat([none, *rows]))

    @classmethod
    def concatenate(cls, parts: Sequence["Ragged"]) -> "Ragged":
        """All rows, one part after the other."""
        sizes = torch.cat([torch.diff(part.starts) for part in parts])
        return cls(starts=_starts(sizes), values=torch.cat([part.values for part in parts]))


Target = Tensor | Ragged
Targets = Mapping[str, Target]
"""By name: one value or vector a pixel (a tensor), or any number of them a pixel (`Ragged`)."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PixelChoice:
    """The pixels of one view that may be drawn. They are numbered row by row."""

    height: int
    width: int
    pixels: Int64[Tensor, "m"]
    """Pixels that may be drawn, distinct."""

    grid: bool = False
    """Whether these are cells of a grid over the whole photograph, whatever its proportions. A
    cell's row of W is that of a picture with as many pixels: it holds all Gaussians of the cell.
    Otherwise height and width are the photograph's, or fewer in proportion."""


@runtime_checkable
class TargetSource(Protocol):
    """What there is to learn from each view."""

    @property
    def view_names(self) -> Sequence[str]:
        """Views of which there is something."""
        ...

    @property
    def fingerprint(self) -> str:
        """A digest of all there is, by which a resumed training knows its data again."""
        ...

    def choice(self, name: str) -> PixelChoice:
        """What may be drawn of a view."""
        ...

    def groups(self, name: str) -> Ragged:
        """The groups that its pixels come in, none empty and the pixels of each distinct.

        Groups may overlap, and need not hold every pixel.
        """
        ...

    def targets(self, name: str, pixels: Int64[Tensor, "p"]) -> Targets:
        """Targets of some pixels of a view."""
        ...


@runtime_checkable
class MaskSets(Protocol):
    """A source of masks, such as `splatseg.io.evidence.Evidence`."""

    @property
    def view_names(self) -> Sequence[str]:
        """Views that have masks."""
        ...

    def masks(self, name: str) -> MaskSet:
        """The masks of a view."""
        ...


class LabelTargets:
    """Label maps as targets; groups are the ids.

    Targets: ``label``, the index of the pixel's id among `ids` (int64), and ``confidence``, 1
    where the map has none.

    Args:
        evidence: The label maps; ids mean the same in all of them.
        names: The views to learn from.

    Raises:
        InputError: If no pixel of these views has a label.
    """

    @boundary
    def __init__(self, evidence: LabelSource, names: Sequence[str]) -> None:
        self._evidence = evidence
        self.view_names: Sequence[str] = tuple(sorted(names))
        """The views to learn from."""
        digest = hashlib.sha256()
        found: set[int] = set()
        for name in self.view_names:
            label_map = evidence.label_map(name)
            digest.update(repr((name, label_map.height, label_map.width)).encode())
            digest.update(label_map.ids.cpu().numpy().tobytes())
            if label_map.confidence is not None:
                digest.update(label_map.confidence.cpu().numpy().tobytes())
            found.update(torch.unique(label_map.ids).tolist())
        found.discard(UNLABELLED)
        if not found:
            raise InputError(
                f"evidence: expected a labelled pixel in {len(self.view_names)} views, found none."
            )
        self.ids = torch.tensor(sorted(found))
        """All ids, ascending."""
        self._last: tuple[str, LabelMap] | None = None
        self.fingerprint: str = digest.hexdigest()
        """A digest of all maps."""

    def choice(self, name: str) -> PixelChoice:
        """Labelled pixels."""
        label_map = self._label_map(name)
        pixels = torch.nonzero(label_map.ids.cpu().reshape(-1) != UNLABELLED).squeeze(1)
        return PixelChoice(height=label_map.height, width=label_map.width, pixels=pixels)

    def groups(self, name: str) -> Ragged:
        """Labelled pixels, by id."""
        flat = self._label_map(name).ids.cpu().long().reshape(-1)
        pixels = torch.nonzero(flat != UNLABELLED).squeeze(1)
        order = torch.argsort(flat[pixels], stable=True)
        sizes = torch.unique_consecutive(flat[pixels][order], return_counts=True)[1]
        return Ragged(starts=_starts(sizes), values=pixels[order])

    def targets(self, name: str, pixels: Int64[Tensor, "p"]) -> Targets:
        """``label`` and ``confidence`` of labelled pixels."""
        label_map = self._label_map(name)
        flat = label_map.ids.cpu().long().reshape(-1)
        confidence = torch.ones(len(pixels))
        if label_map.confidence is not None:
            confidence = label_map.confidence.cpu().float().reshape(-1)[pixels]
        return {"label": torch.searchsorted(self.ids, flat[pixels]), "confidence": confidence}

    def _label_map(self, name: str) -> LabelMap:
        """The map of a view; that of the last one asked for is still there."""
        if self._last is None or self._last[0] != name:
            self._last = (name, self._evidence.label_map(name))
        return self._last[1]


class MaskTargets:
    """Overlapping masks as targets; groups are the masks.

    Targets: ``masks``, the indices in the view's mask set of all masks that contain the pixel
    (`Ragged`, ascending; none for a pixel outside all masks).

    Args:
        evidence: The masks.
        names: The views to learn from.

    Raises:
        InputError: If these views have no mask with a pixel.
    """

    @boundary
    def __init__(self, evidence: MaskSets, names: Sequence[str]) -> None:
        self._evidence = evidence
        self.view_names: Sequence[str] = tuple(sorted(names))
        """The views to learn from."""
        digest, some = hashlib.sha256(), False
        for name in self.view_names:
            masks = evidence.masks(name)
            digest.update(repr((name, masks.height, masks.width)).encode())
            for mask in masks.masks:
                digest.update(np.asarray(mask.counts, dtype=np.int64).tobytes())
                some = some or mask.area > 0
        if not some:
            raise InputError(
                f"evidence: expected a mask in {len(self.view_names)} views, found none."
            )
        self.fingerprint: str = digest.hexdigest()
        """A digest of all masks."""

    def choice(self, name: str) -> PixelChoice:
        """All pixels."""
        masks = self._evidence.masks(name)
        everything = torch.arange(masks.height * masks.width)
        return PixelChoice(height=masks.height, width=masks.width, pixels=everything)

    def groups(self, name: str) -> Ragged:
        """Pixels, by mask."""
        masks = self._evidence.masks(name)
        inside = [torch.nonzero(masks.dense(i).reshape(-1)).squeeze(1) for i in range(len(masks))]
        return Ragged.of([pixels for pixels in inside if len(pixels)])

    def targets(self, name: str, pixels: Int64[Tensor, "p"]) -> Targets:
        """``masks`` of some pixels."""
        masks = self._evidence.masks(name)
        rows, columns = [pixels[:0]], [pixels[:0]]
        for index in range(len(masks)):
            row = torch.nonzero(masks.dense(index).reshape(-1)[pixels]).squeeze(1)
            rows.append(row)
            columns.append(torch.full_like(row, index))
        row, column = torch.cat(rows), torch.cat(columns)
        order = torch.argsort(row, stable=True)
        sizes = torch.bincount(row, minlength=len(pixels))
        return {"masks": Ragged(starts=_starts(sizes), values=column[order])}


def _starts(sizes: Tensor) -> Int64[Tensor, "rows_plus_1"]:
    return torch.cat((sizes.new_zeros(1), torch.cumsum(sizes, dim=0))).long()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DrawnView:
    """The pixels drawn of one view. Where they are spilled, its tensors are mapped files."""

    rows: SparseWeights
    pixels: Tensor
    """int64 (p,), numbered row by row."""

    stands_for: Tensor
    """float32 (p,), how many pixels of the view each one stands for."""

    targets: Targets

    def __len__(self) -> int:
        return len(self.pixels)

    def slice(self, begin: int, end: int) -> "DrawnView":
        """Consecutive pixels."""
        return DrawnView(
            rows=_consecutive(self.rows, begin, end),
            pixels=self.pixels[begin:end],
            stands_for=self.stands_for[begin:end],
            targets={name: _slice(target, begin, end) for name, target in self.targets.items()},
        )

    def tensors(self) -> list[Tensor]:
        """All tensors, in the order that `with_tensors` takes them."""
        found = [self.rows.indptr, self.rows.ids, self.rows.weights, self.pixels, self.stands_for]
        for target in self.targets.values():
            found += (target.starts, target.values) if isinstance(target, Ragged) else (target,)
        return found

    def with_tensors(self, tensors: Sequence[Tensor]) -> "DrawnView":
        """The same with tensors of the same values in other memory."""
        left = iter(tensors)
        return DrawnView(
            rows=replace(self.rows, indptr=next(left), ids=next(left), weights=next(left)),
            pixels=next(left),
            stands_for=next(left),
            targets={
                name: Ragged(starts=next(left), values=next(left))
                if isinstance(target, Ragged)
                else next(left)
                for name, target in self.targets.items()
            },
        )


def _consecutive(rows: SparseWeights, begin: int, end: int) -> SparseWeights:
    first, last = int(rows.indptr[begin]), int(rows.indptr[end])
    return replace(
        rows,
        indptr=rows.indptr[begin : end + 1] - first,
        ids=rows.ids[first:last],
        weights=rows.weights[first:last],
    )


def _slice(target: Target, begin: int, end: int) -> Target:
    return target.slice(begin, end) if isinstance(target, Ragged) else target[begin:end]


class TensorBudget:
    """Keeps tensors in memory up to a budget, and others as mapped files of a temporary folder.

    Args:
        memory: Bytes that are kept in memory.
    """

    def __init__(self, memory: int) -> None:
        self._left = memory
        self._holder: tempfile.TemporaryDirectory[str] | None = None
        self._files = 0

    def kept(self, tensors: Sequence[Tensor]) -> Sequence[Tensor]:
        """The tensors, all in memory or all mapped.

        Raises:
            SplatsegError: If they are too much for memory and cannot be written.
        """
        size = sum(tensor.nbytes for tensor in tensors)
        if size <= self._left:
            self._left -= size
            return tensors
        try:
            if self._holder is None:
                self._holder = tempfile.TemporaryDirectory(prefix="splatseg-training-")
            return [self._mapped(Path(self._holder.name), tensor) for tensor in tensors]
        except OSError as error:
            raise SplatsegError(
                f"{tempfile.gettempdir()}: what is beyond the memory budget cannot be written "
                f"({error})."
            ) from error

    def close(self) -> None:
        """Remove the files."""
        if self._holder is not None:
            self._holder.cleanup()
            self._holder = None

    def _mapped(self, folder: Path, tensor: Tensor) -> Tensor:
        if not tensor.numel():  # an empty file cannot be mapped
            return tensor
        path = folder / f"{self._files:07d}.npy"
        self._files += 1
        np.save(path, tensor.numpy(), allow_pickle=False)
        # Copy on write: torch wants arrays it may write to, and the file is to stay as it is.
        return torch.from_numpy(read_npy(path, mapped=True))
