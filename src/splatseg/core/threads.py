"""Sums that do not depend on how many threads there are."""

from collections.abc import Generator
from contextlib import contextmanager

import torch


@contextmanager
def one_torch_thread() -> Generator[None]:
    """Limit torch to one thread while the block runs.

    Torch splits sums and products of matrices among its threads, so that they round differently
    with their number; and its idle threads spin on the cores that the kernels of this library
    need, which share their own work in a fixed order.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
