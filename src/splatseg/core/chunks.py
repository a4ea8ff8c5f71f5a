r"""Gaussians that stay on the disk: runs of rows near each other, of which a view reads few.

A view needs the Gaussians that reach its image. Gaussian i with centre (x, y, z) before the camera,
largest standard deviation s and its projected radius of at most

.. math:: r = 3.34 \, (s F / z + \sqrt{\text{low pass}}), \qquad
          F = \max(f_x \sqrt{1 + a^2}, f_y \sqrt{1 + b^2})

pixels (EWA's Jacobian at a direction that is clamped to a, b: the view and a margin) reaches the
right edge of an image of width w where :math:`f_x x / z + c_x - r \le w`, which for :math:`z > 0`
is linear in the centre,

.. math:: f_x x - (w - c_x + 3.34 \sqrt{\text{low pass}}) \, z \le 3.34 \, s F .

So a chunk is not seen if no corner of the box around its centres fulfils that with the chunk's
largest s, for one of the four edges, or if all corners are behind the near plane. What is read
without need is culled by the backend, as in a scene in memory: the image is the same to the bit.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from numpy.typing import NDArray
from torch import Tensor

from splatseg.core.boundary import boundary
from splatseg.core.camera import Camera
from splatseg.errors import InputError

if TYPE_CHECKING:
    from splatseg.core.gaussians import Gaussians

REACH = 3.34
"""Standard deviations that alpha >= 1/255 reaches at most: sqrt(2 ln 255) = 3.33."""

MARGIN = 0.3
"""Share of the field of view by which directions may lie beside it before they are clamped."""

_ROUNDING = 1.0
"""Pixels that float32 projections are allowed to be off."""

_VIEW_BYTES = 170
"""Of each Gaussian of a view in the kernels: projected twice, keys of the sort, its row."""


class ReadRows(Protocol):
    """Reads runs of rows, from one to before another, one behind the other."""

    def __call__(self, runs: Sequence[tuple[int, int]], *, colours: bool = True) -> "Gaussians":
        """Float32, without extra columns; without `colours` all harmonics are 0, of degree 0.

        Raises:
            FileFormatError: If files are damaged, or hold what cannot be rendered.
        """
        ...


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Chunks:
    """Runs of rows of Gaussians on the disk, and where they lie."""

    starts: Int64[Tensor, "chunks_plus_1"]
    """The first row of each, and the number of rows."""

    low: Float[Tensor, "chunks 3"]
    """Smallest coordinates of centres, world."""

    high: Float[Tensor, "chunks 3"]
    """Largest coordinates of centres, world."""

    largest: Float[Tensor, "chunks"]
    """Largest standard deviation of any of its Gaussians, scene units."""

    memory: int
    """Bytes that Gaussians of a view and what the kernels make of them may take."""

    read: "ReadRows"
    """Reads runs of rows."""

    def __len__(self) -> int:
        return len(self.low)

    def blocks(self, size: int) -> Iterator[tuple[int, int]]:
        """All rows as runs of at most this many."""
        count = int(self.starts[-1])
        for first in range(0, count, size):
            yield first, min(first + size, count)

    def rows(self, chosen: Bool[Tensor, "chunks"]) -> Int64[Tensor, "m"]:
        """The rows of some chunks, ascending."""
        return rows_of(self.runs(chosen))

    def runs(self, chosen: Bool[Tensor, "chunks"]) -> list[tuple[int, int]]:
        """The rows of some chunks as runs, each as long as it can be."""
        found: list[tuple[int, int]] = []
        for index in torch.nonzero(chosen).flatten().tolist():
            first, end = int(self.starts[index]), int(self.starts[index + 1])
            if found and found[-1][1] == first:
                found[-1] = found[-1][0], end
            else:
                found.append((first, end))
        return found

    def seen(self, camera: Camera, *, near: float, low_pass: float) -> Bool[Tensor, "chunks"]:
        """Which chunks may reach the image of a pinhole camera.

        Args:
            camera: The camera.
            near: Depth from which on Gaussians are drawn, scene units.
            low_pass: Variance of the filter that they are drawn with, square pixels.
        """
        corners = torch.stack((self.low, self.high)).double()
        of = torch.cartesian_prod(*[torch.arange(2)] * 3)
        boxes = torch.stack([corners[of[:, axis], :, axis] for axis in range(3)], dim=2)
        pose = camera.cam_from_world.detach().cpu().double()
        x, y, z = (boxes @ pose[:3, :3].T + pose[:3, 3]).unbind(dim=2)
        pad = REACH * (low_pass**0.5 + 0.01) + _ROUNDING
        right, below = camera.width - camera.cx, camera.height - camera.cy
        a = max(camera.cx, right) / camera.fx + MARGIN * camera.width / (2 * camera.fx)
        b = max(camera.cy, below) / camera.fy + MARGIN * camera.height / (2 * camera.fy)
        focal = max(camera.fx * (1 + a * a) ** 0.5, camera.fy * (1 + b * b) ** 0.5)
        reach = REACH * focal * self.largest.double() * (1 + 1e-5)
        edges = (
            camera.fx * x - (right + pad) * z,
            -camera.fx * x - (camera.cx + pad) * z,
            camera.fy * y - (below + pad) * z,
            -camera.fy * y - (camera.cy + pad) * z,
        )
        found = z.amax(dim=0) > near * (1 - 1e-5)
        for edge in edges:
            found &= edge.amin(dim=0) <= reach
        return found

    def view_of(
        self, camera: Camera, *, near: float, low_pass: float, coefficients: int
    ) -> list[tuple[int, int]]:
        """The runs of rows that a pinhole camera may see.

        Args:
            camera: The camera.
            near: As for `seen`.
            low_pass: As for `seen`.
            coefficients: Harmonics of a channel.

        Raises:
            InputError: If they take more memory than is allowed.
        """
        runs = self.runs(self.seen(camera, near=near, low_pass=low_pass))
        count = sum(end - first for first, end in runs)
        needed = count * (4 * (11 + 3 * coefficients) + _VIEW_BYTES)
        if needed > self.memory:
            raise InputError(
                f"memory: a view has {count} Gaussians before it, which take about "
                f"{needed / 1e9:.2f} GB, more than the {self.memory / 1e9:.2f} GB that were "
                "allowed; allow more."
            )
        return runs

    def around(self, low: Float[Tensor, "3"], high: Float[Tensor, "3"]) -> Bool[Tensor, "chunks"]:
        """Which chunks have centres in a box, or may have."""
        return ((self.low <= high) & (self.high >= low)).all(dim=1)


def rows_of(runs: Sequence[tuple[int, int]]) -> Int64[Tensor, "m"]:
    """The rows of some runs, one run behind the other."""
    return torch.cat([torch.arange(0), *(torch.arange(*run) for run in runs)])


_LARGE = 1 / 64
"""Share of the Gaussians that stand apart because they are the largest: a chunk is seen from as far
as its largest Gaussian."""

_BITS = 21
"""Of each coordinate on the Morton curve: three fit into 64."""

_BLOCK = 1 << 18
"""Rows whose places on the curve are found at once."""


@boundary
def morton_order(
    means: Float[Tensor, "n 3"], largest: Float[Tensor, "n"]
) -> tuple[Int64[Tensor, "n"], int]:
    """The rows in the order in which chunks have them, and how many of the first stand apart.

    Coordinates have 21 bits each in the box around all centres. Equal ones keep their order.

    Args:
        means: Centres.
        largest: Largest standard deviation of each.

    Returns:
        The rows, those of the largest Gaussians first, and how many those are.

    Example:
        >>> corners = torch.tensor([[0.0, 0, 0], [1, 1, 1], [0, 0, 1], [0.1, 0, 0]])
        >>> morton_order(corners, torch.ones(4))
        (tensor([0, 3, 2, 1]), 0)
    """
    count = len(means)
    codes = np.zeros(count, np.uint64)
    if count:
        low, high = (corner.double().numpy() for corner in torch.aminmax(means, dim=0))
        scale = (2**_BITS - 1) / np.maximum(high - low, 1e-300)
        for start in range(0, count, _BLOCK):
            part = slice(start, start + _BLOCK)
            cells = (means[part].double().numpy() - low) * scale
            for axis in range(3):
                codes[part] |= _spread(cells[:, axis].astype(np.uint64)) << np.uint64(axis)
    apart = int(count * _LARGE)
    if apart:
        limit = float(largest.kthvalue(count - apart).values)
        small = (largest > limit).logical_not().numpy()
        apart = count - int(small.sum())
        codes |= small.astype(np.uint64) << np.uint64(63)
    return torch.from_numpy(np.argsort(codes, kind="stable")), apart


def _spread(values: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """The 21 bits of numbers with two zeros between each two of them."""
    for shift, mask in (
        (32, 0x1F00000000FFFF), (16, 0x1F0000FF0000FF), (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3), (2, 0x1249249249249249),
    ):  # fmt: skip
        values = (values | values << np.uint64(shift)) & np.uint64(mask)
    return values
