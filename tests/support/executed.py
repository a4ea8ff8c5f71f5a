"""What workers of an executor call in tests; they import it by this name."""

import os
import signal
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from splatseg.errors import MissingFileError
from splatseg.render.cpu import threads


def twice(shared: int, item: int) -> Iterator[int]:
    """Two results an item; those of the first items take longest."""
    time.sleep(max(0.0, 0.2 - 0.05 * item))
    yield shared + item
    yield shared * item


def noted(folder: Path, item: int) -> Iterator[int]:
    """Notes that the item was begun."""
    (folder / str(item)).touch()
    yield item


def failing(shared: int, item: int) -> Iterator[int]:
    """The third item fails."""
    if item == 2:
        raise MissingFileError(f"scan_{item}.bin: there is no such file.")
    yield item


def together(shared: tuple[Path, int], item: int) -> Iterator[int]:
    """How many items are worked on at a time: waits a while for so many."""
    folder, expected = shared
    own = folder / str(item)
    own.touch()
    until = time.monotonic() + (60 if expected > 1 else 0.3)
    found = 0
    while found < max(2, expected) and time.monotonic() < until:
        found = max(found, len(list(folder.iterdir())))
        time.sleep(0.01)
    time.sleep(0.1)
    own.unlink()
    yield found


def looked_at(shared: Any, item: int) -> Iterator[tuple[int, int, int, int]]:
    """The process, its threads of kernels and of torch, and where the shared value lies."""
    yield os.getpid(), threads(), torch.get_num_threads(), shared.data_ptr()


def late(shared: tuple[Path, int], item: int) -> Iterator[int]:
    """Takes half a minute, but for the first item, and notes that it got to its end.

    So many interrupts are lost on it.
    """
    folder, lost = shared
    for _ in range(600 if item else 0):
        try:
            time.sleep(0.05)
        except KeyboardInterrupt:
            lost -= 1
            if lost < 0:
                raise
    (folder / str(item)).touch()
    yield item


def sums(shared: Any, item: int) -> Iterator[Any]:
    """A row of a tensor, and as an array."""
    yield shared[item] + 1
    yield (shared[item] + 1).numpy()


@dataclass(frozen=True)
class Dying:
    """Evidence whose reader's process is killed when it reads a view for the first time."""

    evidence: Any
    view: str
    folder: Path
    times: int = 1

    @property
    def view_names(self) -> Any:
        return self.evidence.view_names

    def label_map(self, name: str) -> Any:
        there = len(list(self.folder.iterdir()))
        if name == self.view and there < self.times:
            (self.folder / str(there)).touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return self.evidence.label_map(name)
