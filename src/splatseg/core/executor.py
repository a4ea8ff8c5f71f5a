"""Work on independent items, such as views: where it is done, and in which order it comes back.

Whatever goes through `Executor.map` is the same function of the same items wherever it runs, and
its results come in the order of the items. So the caller that sums them up sums in one order, and
gets the same bits from one process and from many.
"""

from collections.abc import Callable, Generator, Iterable
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from typing import Protocol, TypeVar, runtime_checkable

from splatseg.core.threads import in_threads

S = TypeVar("S")
T = TypeVar("T")
R = TypeVar("R")


@runtime_checkable
class Executor(Protocol):
    """Calls a function of independent items somewhere, and gives what it yields in their order."""

    def map(
        self, function: Callable[[S, T], Iterable[R]], items: Iterable[T], *, shared: S
    ) -> Generator[R]:
        """What the function yields of each item, in the order of the items.

        Nothing is begun before the first result is asked for, and only so many items are begun
        ahead of the results that are asked for that memory stays bounded. A generator that is
        closed begins no further item. An exception of the function comes out as it is, after the
        results of all earlier items.

        Args:
            function: A function of a module, as it may be called in another process. It may be
                called twice of one item, so it leaves `shared` as it is and writes nothing, or
                the same again.
            items: What differs from call to call. Small: such as a view.
            shared: What all calls have in common, such as Gaussians and the evidence that they
                read. Goes to each process once.
        """
        ...


class LocalExecutor:
    """One item after the other, in the thread that asks for the results."""

    def map(
        self, function: Callable[[S, T], Iterable[R]], items: Iterable[T], *, shared: S
    ) -> Generator[R]:
        """See `Executor.map`; an item is begun when its first result is asked for."""
        for item in items:
            yield from function(shared, item)


LOCAL = LocalExecutor()


@dataclass(frozen=True, slots=True)
class ThreadExecutor:
    """Several items at once in threads of this process, torch with one thread in each."""

    threads: int

    def map(
        self, function: Callable[[S, T], Iterable[R]], items: Iterable[T], *, shared: S
    ) -> Generator[R]:
        """See `Executor.map`; all items are begun as threads become free."""
        with closing(in_threads(partial(_listed, function, shared), items, self.threads)) as found:
            for results in found:
                yield from results


def _listed(function: Callable[[S, T], Iterable[R]], shared: S, item: T) -> list[R]:
    return list(function(shared, item))
