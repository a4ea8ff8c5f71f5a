"""Frames of a walk through a room: which are fitted, which are scored, which are left out."""

import re

from splatseg.core import Capture
from splatseg.errors import InputError

_NUMBER = re.compile(r"\d+")


def walk_splits(capture: Capture, every: int) -> dict[str, str]:
    """``train``, ``test`` or ``unused`` by name of the view, as Semantic-NeRF divides its frames.

    Of `every` frames that follow each other the first is a training view, the one in the middle
    between it and the next is a test view, and the others are neither: of frames 0 to 9 with 5 the
    frames 0 and 5 are trained on and 2 and 7 are scored. Frames without a pose are not counted.

    Args:
        capture: Of a walk; its views are in the order of the numbers in their names.
        every: At least 2.

    Raises:
        InputError: If there is no test view, as there are too few frames.
    """
    names = sorted((view.name for view in capture.views), key=_frame)
    split_at = {0: "train", every // 2: "test"}
    splits = {name: split_at.get(i % every, "unused") for i, name in enumerate(names)}
    if "test" not in splits.values():
        raise InputError(
            f"{capture.path}: expected more than {every // 2} frames, got {len(names)}; "
            "train_every must be smaller for so few."
        )
    return splits


def _frame(name: str) -> tuple[int, str]:
    """The number that a name ends with, and the name."""
    numbers = _NUMBER.findall(name)
    return (int(numbers[-1]) if numbers else -1, name)
