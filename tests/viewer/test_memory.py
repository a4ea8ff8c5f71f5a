"""Freed memory goes back to the system: after jobs, and now and then."""

import pathlib
import sys

import numpy as np
import pytest

from splatseg.viewer import _memory
from support.viewer import RED_PIXEL


def resident() -> int:
    """Bytes that this process holds."""
    with pathlib.Path("/proc/self/statm").open() as file:
        return int(file.read().split()[1]) * 4096


@pytest.mark.skipif(sys.platform != "linux", reason="asks /proc")
def test_freed_memory_is_given_back() -> None:
    if _memory._malloc_trim() is None:
        pytest.skip("not glibc")
    # Small pieces between pieces that stay: the heap cannot shrink by itself.
    pieces = [np.ones(30_000, np.uint8) for _ in range(4000)]
    held = resident()
    del pieces[::2]
    del pieces[: len(pieces) - 1]
    assert _memory.give_back()
    assert held - resident() > 60e6


def test_other_c_libraries_do_without(monkeypatch) -> None:
    monkeypatch.setattr(_memory, "_malloc_trim", lambda: None)
    assert not _memory.give_back()


def test_the_worker_gives_back_after_jobs_and_some_answers(page, monkeypatch) -> None:
    given: list[int] = []
    monkeypatch.setattr(_memory, "EVERY", 2)
    monkeypatch.setattr(_memory, "give_back", lambda: given.append(1))
    page.select(1, points=[RED_PIXEL])
    page.still(1)
    before = len(given)
    page.send("job", id=1, name="export", arguments={"what": "table", "name": "all"})
    page.until(lambda one: isinstance(one, dict) and one["type"] in ("finished", "error"))
    page.still(2)
    assert len(given) == before + 1
    page.select(2, points=[RED_PIXEL])
    page.select(3, points=[RED_PIXEL])
    page.still(3)
    assert len(given) == before + 2
