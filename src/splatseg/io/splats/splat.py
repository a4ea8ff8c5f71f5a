"""The ``.splat`` layout of the first web viewers: 32 bytes a Gaussian and no header.

Three float32 of position, three float32 of scale (linear), four bytes red, green, blue and
opacity (value / 255), four bytes of the quaternion (w, x, y, z) as (byte - 128) / 128.
There are no harmonics beyond the mean colour.
"""

from pathlib import Path

import numpy as np

from splatseg.core import Gaussians
from splatseg.core.sh import SH_C0
from splatseg.errors import FileFormatError, InputError
from splatseg.io.splats._common import (
    Losses,
    Rows,
    blocks,
    check_file,
    finish,
    to_rows,
    unsigned,
)

_ROW = np.dtype(
    [
        ("mean", "<f4", 3),
        ("scale", "<f4", 3),
        ("colour", "u1", 4),
        ("rotation", "u1", 4),
    ]
)


def read_splat(path: Path, *, strict: bool = False) -> Gaussians:
    """Read a ``.splat`` file.

    Raises:
        FileFormatError: If its length is no multiple of 32 bytes or a row cannot be rendered.
        MissingFileError: If there is no such file.
    """
    size = check_file(path)
    count, left = divmod(size, _ROW.itemsize)
    if left:
        raise FileFormatError(
            f"{path}: expected a multiple of {_ROW.itemsize} bytes, one row a Gaussian, "
            f"got {size} bytes: the file is truncated or no .splat file."
        )
    rows = Rows.empty(count, 1)
    with path.open("rb") as file:
        for part in blocks(count):
            block = np.fromfile(file, _ROW, part.stop - part.start)
            rows.means[part] = block["mean"]
            rows.scales[part] = block["scale"]
            rows.sh[part, 0] = (block["colour"][:, :3] / 255 - 0.5) / SH_C0
            rows.opacities[part] = block["colour"][:, 3] / 255
            rows.rotations[part] = (block["rotation"].astype(np.float32) - 128) / 128
    return finish(path, rows, strict=strict)


def write_splat(gaussians: Gaussians, path: Path, *, losses: Losses) -> None:
    """Write a ``.splat`` file, rows in the order they have.

    Raises:
        InputError: If there are no Gaussians: such a file would be empty.
        RangeError: If a row cannot be rendered.
    """
    if len(gaussians) == 0:
        raise InputError("gaussians: a .splat file cannot hold a scene without Gaussians.")
    rows = to_rows(gaussians)
    if gaussians.sh_degree:
        losses.drop("harmonics above degree 0")
    losses.drop_extra(gaussians)
    losses.drop_antialiased(gaussians)
    losses.drop_low_pass(gaussians)
    with path.open("wb") as file:
        for part in blocks(len(gaussians)):
            block = np.empty(part.stop - part.start, _ROW)
            block["mean"] = rows.means[part]
            block["scale"] = rows.scales[part]
            colours, outside = unsigned((rows.sh[part, 0] * SH_C0 + 0.5) * 255, 255)
            losses.clamp("colours", outside)
            block["colour"][:, :3] = colours
            block["colour"][:, 3] = unsigned(rows.opacities[part] * 255, 255)[0]
            block["rotation"] = unsigned(rows.rotations[part] * 128 + 128, 255)[0]
            file.write(block.tobytes())
