"""Files that scorers read."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from PIL import Image


@pytest.fixture
def maps_in(tmp_path: Path) -> Callable[[str, Sequence[np.ndarray]], Path]:
    """Write maps of ids (0 none, as in files) or images into a folder of this name."""

    def write(name: str, maps: Sequence[np.ndarray]) -> Path:
        folder = tmp_path / name
        folder.mkdir()
        for i, array in enumerate(maps):
            kept = array if array.dtype == np.uint8 else array.astype(np.uint16)
            Image.fromarray(kept).save(folder / f"view_{i}.png")
        return folder

    return write
