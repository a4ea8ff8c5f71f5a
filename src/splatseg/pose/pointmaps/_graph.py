"""Which photographs are paired."""

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from splatseg.errors import InputError, quoted
from splatseg.pose._pairs import chosen_pairs, connected_groups, likeness
from splatseg.pose._photographs import Photograph, read_reduced
from splatseg.pose.pointmaps._options import PairGraph, PointmapOptions

_LONGEST = 640
_FEATURES = 1000


def wanted_pairs(
    photographs: Sequence[Photograph],
    options: PointmapOptions,
    *,
    there: Sequence[tuple[int, int]] | None,
) -> list[tuple[int, int]]:
    """Pairs of photographs to align, sorted; the first is the one in whose frame points are.

    Args:
        photographs: Sorted by name.
        options: How pairs are chosen.
        there: Pairs that a folder of pointmaps holds; None where any can be asked for.

    Raises:
        InputError: If a photograph is in no pair, or the pairs do not hang together.
    """
    kind: PairGraph = options.pairs
    if kind == "auto" and there is None:
        kind = "complete" if len(photographs) <= options.complete_up_to else "retrieval"
    if kind == "auto":
        pairs = sorted(there or ())
    else:
        pairs = _graph(photographs, kind, options)
        if options.symmetric:
            pairs = sorted({*pairs, *((j, i) for i, j in pairs)})
        if there is not None:
            held = set(there)
            pairs = [pair for pair in pairs if pair in held]
    check_connected([one.path.name for one in photographs], pairs)
    return pairs


def check_connected(names: Sequence[str], pairs: Sequence[tuple[int, int]]) -> None:
    """Refuse pairs that leave a photograph out, or fall into parts.

    Raises:
        InputError: If they do; the message names one.
    """
    paired = {i for pair in pairs for i in pair}
    alone = [name for i, name in enumerate(names) if i not in paired]
    if alone:
        more = f" and {len(alone) - 1} more" if len(alone) > 1 else ""
        raise InputError(
            f"pointmaps: expected each of {len(names)} photographs in a pair, got none with "
            f"{quoted(alone[0])}{more}."
        )
    groups = connected_groups(len(names), pairs)
    apart = [i for i in range(len(names)) if groups[i] != groups[0]]
    if apart:
        raise InputError(
            f"pointmaps: expected pairs that connect all {len(names)} photographs, got "
            f"{len(set(groups))} parts without a pair between them, such as {quoted(names[0])} "
            f"and {quoted(names[apart[0]])}."
        )


def _graph(
    photographs: Sequence[Photograph], kind: PairGraph, options: PointmapOptions
) -> list[tuple[int, int]]:
    count = len(photographs)
    if kind == "complete":
        return [(i, j) for i in range(count) for j in range(i + 1, count)]
    if kind == "window":
        return [
            (i, j) for i in range(count) for j in range(i + 1, min(i + 1 + options.window, count))
        ]
    if kind == "reference":
        return [(0, j) for j in range(1, count)]
    alike = likeness([_descriptors(one) for one in photographs], seed=options.seed)
    return chosen_pairs(alike, overlap=1, neighbours=options.neighbours)


def _descriptors(photograph: Photograph) -> NDArray[np.uint8]:
    """SIFT descriptors of a photograph at a modest size, (n, 128)."""
    pixels = read_reduced(photograph, longest=_LONGEST).numpy()
    sift: Any = cv2.SIFT_create(nfeatures=_FEATURES)  # pyright: ignore[reportAttributeAccessIssue]
    found = sift.detectAndCompute(cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY), None)[1]
    return np.zeros((0, 128), np.uint8) if found is None else found.astype(np.uint8)
