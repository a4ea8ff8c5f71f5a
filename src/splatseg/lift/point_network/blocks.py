"""Work on the points of a level, in blocks on the threads that the library's kernels use.

The arrays of a block fit the processor's caches. A block is worked on by one thread of torch's: its
own threads would share out each of some twenty small operations and wait for each other after
each. So results do not depend on the number of threads either.
"""

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import torch
from jaxtyping import Float, Int32
from torch import Tensor

from splatseg import _native
from splatseg.errors import InputError

Make = Callable[[Int32[Tensor, "k m"], slice], Float[Tensor, "m channels"]]
"""Makes something of some points: it gets their neighbours, and their rows."""

VALUES = 1 << 18
"""Numbers of the largest array of a block."""
DEVICE_VALUES = 1 << 26
"""The same on a device, which takes no less time for less work."""
MIN_POINTS = 16
"""Points of a block at least: shorter products of matrices cost more than they save."""


def in_blocks(
    make: Make, neighbours: Int32[Tensor, "n k"], *, width: int, is_recorded: bool
) -> Float[Tensor, "n channels"]:
    """Make something of each point, block by block.

    Neighbours are handed out as (k, m), so that a sum over them is a sum of whole arrays.

    Args:
        make: Of some points. It is called by several threads at once.
        neighbours: Of all points.
        width: Numbers of a pair of a point and a neighbour, by which blocks are cut.
        is_recorded: Whether gradients are recorded or batch norms count: all points are one block
            then.
    """
    if is_recorded:
        return make(neighbours.T.contiguous(), slice(0, len(neighbours)))
    on_cpu = neighbours.device.type == "cpu"
    values = VALUES if on_cpu else DEVICE_VALUES
    size = max(MIN_POINTS, values // (width * neighbours.shape[1]))
    rows = [slice(start, start + size) for start in range(0, len(neighbours), size)]
    threads = min(_native.threads() if on_cpu else 1, len(rows))
    call = partial(_made, make, neighbours)
    if threads == 1:
        return _filled(len(neighbours), rows, map(call, rows))
    with ThreadPoolExecutor(threads, initializer=torch.set_num_threads, initargs=(1,)) as pool:
        return _filled(len(neighbours), rows, pool.map(call, rows))


def _filled(count: int, rows: Sequence[slice], parts: Iterable[Tensor]) -> Tensor:
    """Parts as one array: no two copies of all at once."""
    found: Tensor | None = None
    for chosen, part in zip(rows, parts, strict=True):
        found = part.new_empty(count, part.shape[1]) if found is None else found
        found[chosen] = part
    if found is None:
        raise InputError("neighbours: expected at least one point, got none.")
    return found


def _made(make: Make, neighbours: Tensor, rows: slice) -> Tensor:
    with torch.no_grad():  # each thread has its own switch
        return make(neighbours[rows].T.contiguous(), rows)
