"""Arrays of files, read as NumPy reads them."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray


def arrays_of(path: Path) -> dict[str, NDArray]:
    """All arrays of an npz file, which is closed again: left open, a later test is told of it."""
    with np.load(path) as found:
        return {name: found[name] for name in found}
