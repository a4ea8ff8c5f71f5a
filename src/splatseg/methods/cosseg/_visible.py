"""Points that single views show, kept in files beyond a budget."""

import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Int64
from torch import Tensor

from splatseg.errors import SplatsegError
from splatseg.io.arrays import read_npy
from splatseg.methods.cosseg._fusion import FusionInputs
from splatseg.methods.cosseg._points import PointSet


class VisiblePoints:
    """Point sets of views, each made when it is first asked for.

    Use it in a ``with`` block: what the budget does not hold lies in a temporary folder.

    Args:
        make: Makes the points of a view, by its number.
        memory: Bytes that are kept in memory.
    """

    def __init__(self, make: Callable[[int], PointSet], *, memory: int) -> None:
        self._make = make
        self._left = memory
        self._kept: dict[int, PointSet] = {}
        self._holder: tempfile.TemporaryDirectory[str] | None = None

    def __enter__(self) -> "VisiblePoints":
        return self

    def __exit__(self, *_: object) -> None:
        self._kept.clear()
        if self._holder is not None:
            self._holder.cleanup()
            self._holder = None

    def of(self, view: int) -> PointSet:
        """The points of a view.

        Raises:
            SplatsegError: If they are too much for memory and cannot be written.
        """
        found = self._kept.get(view)
        if found is None:
            found = self._make(view)
            size = sum(one.nbytes for one in _arrays(found))
            if size <= self._left:
                self._left -= size
            else:
                found = self._on_disk(view, found)
            self._kept[view] = found
        return found

    def _on_disk(self, view: int, points: PointSet) -> PointSet:
        try:
            if self._holder is None:
                self._holder = tempfile.TemporaryDirectory(prefix="splatseg-points-")
            folder = Path(self._holder.name)
            arrays = [
                _mapped(folder / f"{view:06d}-{index}.npy", one)
                for index, one in enumerate(_arrays(points))
            ]
        except OSError as error:
            raise SplatsegError(
                f"points of views beyond the memory budget cannot be written ({error})."
            ) from error
        count = len(points.inputs.levels)
        return PointSet(
            inputs=FusionInputs(levels=tuple(arrays[:count]), up=tuple(arrays[count:-1])),
            rows=arrays[-1],
        )


def _arrays(points: PointSet) -> Sequence[Tensor]:
    return (*points.inputs.levels, *points.inputs.up, points.rows)


def _mapped(path: Path, values: Tensor | Int64[Tensor, "n"]) -> Tensor:
    np.save(path, values.numpy(), allow_pickle=False)
    if not values.numel():  # an empty file cannot be mapped
        return values
    # Copy on write: torch wants arrays it may write to, and the file is to stay as it is.
    return torch.from_numpy(read_npy(path, mapped=True))
