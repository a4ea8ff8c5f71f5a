"""Drawn rows of W with their targets: in memory, or in files beyond a budget."""

import os
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from splatseg.errors import SplatsegError
from splatseg.io.arrays import read_npy
from splatseg.lift.training._targets import Ragged, Target, Targets
from splatseg.render import SparseWeights


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

    def arrays(self) -> dict[str, Tensor]:
        """All tensors by the names they are filed under."""
        found = {
            "rows.indptr": self.rows.indptr,
            "rows.ids": self.rows.ids,
            "rows.weights": self.rows.weights,
            "pixels": self.pixels,
            "stands_for": self.stands_for,
        }
        for name, target in self.targets.items():
            if isinstance(target, Ragged):
                found[f"targets.{name}.starts"] = target.starts
                found[f"targets.{name}.values"] = target.values
            else:
                found[f"targets.{name}"] = target
        return found

    def with_arrays(self, arrays: dict[str, Tensor]) -> "DrawnView":
        """The same with tensors of the same values in other memory. Inverse of `arrays`."""

        def target(name: str, value: Target) -> Target:
            if isinstance(value, Ragged):
                starts, values = (arrays[f"targets.{name}.{part}"] for part in ("starts", "values"))
                return Ragged(starts=starts, values=values)
            return arrays[f"targets.{name}"]

        return DrawnView(
            rows=replace(
                self.rows,
                indptr=arrays["rows.indptr"],
                ids=arrays["rows.ids"],
                weights=arrays["rows.weights"],
            ),
            pixels=arrays["pixels"],
            stands_for=arrays["stands_for"],
            targets={name: target(name, value) for name, value in self.targets.items()},
        )

    @property
    def nbytes(self) -> int:
        """Bytes it holds, in memory or in files."""
        return sum(tensor.nbytes for tensor in self.arrays().values())


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


class RowStore:
    """Keeps drawn views; those that would exceed the budget are memory-mapped NumPy files.

    The files lie in a temporary folder that goes with the store.

    Args:
        memory: Bytes that are kept in memory.
        folder: Where the temporary folder is made; None is the system's place for such.
    """

    def __init__(self, *, memory: int, folder: Path | None = None) -> None:
        self._left = memory
        self._parent = folder
        self._holder: tempfile.TemporaryDirectory[str] | None = None
        self._views: list[DrawnView] = []
        self._spilled = 0

    def __len__(self) -> int:
        return len(self._views)

    def __getitem__(self, index: int) -> DrawnView:
        return self._views[index]

    @property
    def spilled(self) -> int:
        """Bytes in files."""
        return self._spilled

    def append(self, view: DrawnView) -> None:
        """Keep a view.

        Raises:
            SplatsegError: If it is too much for memory and cannot be written.
        """
        size = view.nbytes
        if size <= self._left:
            self._left -= size
            self._views.append(view)
            return
        self._spilled += size
        self._views.append(self._on_disk(view))

    def close(self) -> None:
        """Forget all views and remove the files."""
        self._views.clear()
        if self._holder is not None:
            self._holder.cleanup()
            self._holder = None

    def _on_disk(self, view: DrawnView) -> DrawnView:
        try:
            if self._holder is None:
                self._holder = tempfile.TemporaryDirectory(
                    prefix="splatseg-rows-", dir=self._parent
                )
            folder = Path(self._holder.name) / f"{len(self._views):06d}"
            folder.mkdir()
            return view.with_arrays(
                {name: _mapped(folder / f"{name}.npy", t) for name, t in view.arrays().items()}
            )
        except OSError as error:
            where = self._parent or os.fspath(tempfile.gettempdir())
            raise SplatsegError(
                f"{where}: rows beyond the memory budget cannot be written ({error})."
            ) from error


def _mapped(path: Path, tensor: Tensor) -> Tensor:
    np.save(path, tensor.numpy(), allow_pickle=False)
    if not tensor.numel():  # an empty file cannot be mapped
        return tensor
    # Copy on write: torch wants arrays it may write to, and the file is to stay as it is.
    return torch.from_numpy(read_npy(path, mapped=True))
