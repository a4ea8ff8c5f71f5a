"""W of a view that has only some of a scene's Gaussians: its columns at their rows of the scene.

With S the matrix that takes the rows that are there, everything is a product with :math:`W S`:
signals are taken by rows, and what comes back is put at them, with nothing at the others.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Protocol

import torch
from jaxtyping import Float, Int, Int32, Int64, UInt8
from torch import Tensor

from splatseg.core import Camera
from splatseg.errors import InputError
from splatseg.render._backend import BackendView
from splatseg.render._rows import SparseWeights
from splatseg.render._values import (
    BackProjected,
    Contributors,
    Rendered,
    SparseBackProjected,
    SparseImage,
    SparseSignal,
    StrongestChannels,
)


class _Part(Protocol):
    """`ViewPart`, which knows prepared views and is above this."""

    rows: Int64[Tensor, "m"]

    def view(self, *, colours: bool = False) -> Any: ...

    def close(self) -> None: ...


class RowsView(BackendView):
    """A view of some rows of a scene, asked as one of the scene.

    Args:
        part: The view of the Gaussians that are there (`ViewPart`); it is closed with this.
        count: Gaussians of the scene.
        camera: The pinhole camera.
    """

    def __init__(self, part: _Part, *, count: int, camera: Camera) -> None:
        self._part, self._rows, self._count, self._camera = part, part.rows, count, camera

    def _inner(self, *, colours: bool = False) -> BackendView:
        return self._part.view(colours=colours).own

    def close(self) -> None:
        """Release the memory of the view within."""
        self._part.close()

    def render(
        self,
        signal: Float[Tensor, "n channels"] | None = None,
        *,
        screen_offsets: Float[Tensor, "n 2"] | None = None,
    ) -> Rendered:
        """``W S signal``."""
        if screen_offsets is not None:
            raise InputError("screen_offsets: expected Gaussians in memory, got some on the disk.")
        inner = self._inner(colours=signal is None)
        return inner.render(None if signal is None else signal[self._rows])

    def picture(
        self,
        *,
        tint: UInt8[Tensor, "n 4"] | None = None,
        signal: Float[Tensor, "n channels"] | None = None,
    ) -> UInt8[Tensor, "height width 3"]:
        """`render` in eight bits."""
        return self._inner(colours=signal is None).picture(
            tint=None if tint is None else tint[self._rows],
            signal=None if signal is None else signal[self._rows],
        )

    def back_project(self, image: Float[Tensor, "height width channels"]) -> BackProjected:
        """``S.T W.T image``."""
        found = self._inner().back_project(image)
        return BackProjected(sums=self._placed(found.sums), weights=self._placed(found.weights))

    def back_project_sparse(self, image: SparseImage) -> SparseBackProjected:
        """``S.T W.T image`` of many channels."""
        found = self._inner().back_project_sparse(image)
        weights, gaussians = self._placed(found.weights), self._rows[found.gaussians]
        return replace(found, gaussians=gaussians, weights=weights)

    def argmax(self, signal: SparseSignal, background: int) -> StrongestChannels:
        """The largest channel of ``W S signal``."""
        values = None if signal.values is None else signal.values[self._rows]
        own = SparseSignal(channels=signal.channels[self._rows], values=values, count=signal.count)
        return self._inner().argmax(own, background)

    def contributors(self, pixels: Int[Tensor, "p 2"], k: int) -> Contributors:
        """The k strongest Gaussians of pixels, by their rows of the scene."""
        found = self._inner().contributors(pixels, k)
        return replace(
            found,
            **{name: self._named(getattr(found, name)) for name in ("ids", "first", "median")},
        )

    def rows(self, pixels: Int[Tensor, "p 2"] | None, k: int | None) -> SparseWeights:
        """Rows of ``W S``."""
        found = self._inner().rows(pixels, k)
        return replace(found, ids=self._named(found.ids), gaussians=self._count)

    def part_sums(self, parts: Sequence[Int32[Tensor, "pixels"]]) -> list[Any]:
        """Rows of ``W S`` summed over parts of the image."""
        from scipy.sparse import csr_matrix

        rows = self._rows.int().numpy()
        return [
            csr_matrix(
                (sums.data, rows[sums.indices], sums.indptr), shape=(sums.shape[0], self._count)
            )
            for sums in self._inner().part_sums(parts)
        ]

    def _named(self, ids: Tensor) -> Int32[Tensor, "*shape"]:
        """Rows of the scene; -1 stays."""
        if not len(self._rows):
            return ids
        return torch.where(ids < 0, ids, self._rows.int()[ids.clamp_min(0).long()])

    def _placed(self, values: Float[Tensor, "m ..."]) -> Float[Tensor, "n ..."]:
        """Values at the rows that they are of, 0 elsewhere."""
        placed = values.new_zeros((self._count, *values.shape[1:]))
        placed[self._rows] = values
        return placed
