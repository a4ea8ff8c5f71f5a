"""Warnings of splat writers, said of the path that a file will have."""

import warnings
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

from splatseg.io.splats import SplatWarning


@contextmanager
def retold(temporary: Path, final: Path) -> Generator[None]:
    """Repeat each `SplatWarning` of the block with `final` in the place of `temporary`."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", SplatWarning)
        yield
    for warning in caught:
        text = str(warning.message).replace(str(temporary), str(final))
        warnings.warn(text, warning.category, stacklevel=4)
