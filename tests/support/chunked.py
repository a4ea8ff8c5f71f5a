"""Gaussians in chunks, and the same in memory."""

from pathlib import Path

import pytest
import torch

from splatseg.core import Gaussians
from splatseg.io import chunks as files


def in_chunks(
    gaussians: Gaussians,
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    *,
    rows: int = 16,
    memory: int = 10**9,
    half: bool = False,
) -> Gaussians:
    """Gaussians written in small chunks, and opened."""
    monkeypatch.setattr(files, "CHUNK_ROWS", rows)
    folder.mkdir(parents=True)
    files.write_chunks(
        lambda first, end: gaussians[first:end], len(gaussians), folder, memory=memory, half=half
    )
    return files.open_chunks(folder, memory=memory)


def in_memory(gaussians: Gaussians) -> Gaussians:
    """The same rows in the same order, as if they had been read as a whole."""
    taken = gaussians[torch.arange(len(gaussians))]
    assert taken.chunks is None
    return taken
