"""The independent scorer, and the files it reads."""

import json
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from PIL import Image


@pytest.fixture
def score(shared_data: Path) -> Callable[..., dict]:
    """Run score.py, which knows nothing of this project, with the given words."""
    script = shared_data.parent / "score" / "score.py"

    def run(*words: object) -> dict:
        done = subprocess.run(
            [sys.executable, str(script), *map(str, words)], capture_output=True, text=True
        )
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout)

    return run


@pytest.fixture
def maps_in(tmp_path: Path) -> Callable[[str, Sequence[np.ndarray]], Path]:
    """Write maps of ids (0 none, as in files) into a folder of this name."""

    def write(name: str, maps: Sequence[np.ndarray]) -> Path:
        folder = tmp_path / name
        folder.mkdir()
        for i, array in enumerate(maps):
            Image.fromarray(array.astype(np.uint16)).save(folder / f"view_{i}.png")
        return folder

    return write
