"""How many threads torch has: the one place that decides.

The kernels of this library share the cores, and sum in a fixed order. Torch splits sums and
products of matrices among its threads, so that they round differently with their number; and its
idle threads spin on the cores that the kernels need. So torch has one thread while a public
function of this library runs (`core.boundary`), and its caller's again afterwards. Networks of
others, which are torch alone, run in `network_inference`.
"""

import threading
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

import torch

T = TypeVar("T")
R = TypeVar("R")


class _Limit(threading.local):
    outside: int | None = None
    """Torch's threads before the limit; None where there is none."""


_limit = _Limit()


def is_limited() -> bool:
    """Whether torch has one thread here, since a public function runs."""
    return _limit.outside is not None


def caller_threads() -> int:
    """The threads that torch has outside of the library: what a pool of threads may have here."""
    return torch.get_num_threads() if _limit.outside is None else _limit.outside


@contextmanager
def one_torch_thread() -> Generator[None]:
    """Limit torch to one thread while the block runs; within another such block, do nothing."""
    if _limit.outside is not None:
        yield
        return
    _limit.outside = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(_limit.outside)
        _limit.outside = None


@contextmanager
def all_torch_threads() -> Generator[None]:
    """Give torch its caller's threads while the block runs."""
    before = _limit.outside
    if before is None:
        yield
        return
    _limit.outside = None
    torch.set_num_threads(before)
    try:
        yield
    finally:
        torch.set_num_threads(1)
        _limit.outside = before


@contextmanager
def network_inference() -> Generator[None]:
    """Run a network of others: without gradients, on all threads of torch; also a decorator."""
    with all_torch_threads(), torch.inference_mode():
        yield


def in_threads(function: Callable[[T], R], items: Iterable[T], threads: int) -> Generator[R]:
    """Call a function for each item, several at once, torch with one thread in each.

    Whatever is stopped or raised, no call is begun after it.

    Yields:
        The results, in the order of the items.
    """
    if threads == 1:
        yield from map(function, items)
        return
    pool = ThreadPoolExecutor(threads, initializer=torch.set_num_threads, initargs=(1,))
    try:
        yield from pool.map(function, items)
    finally:
        pool.shutdown(cancel_futures=True)
