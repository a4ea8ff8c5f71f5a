"""Tints of the modes: for each Gaussian a colour and how much of it, in eight bits.

A tint has four columns: red, green, blue, and the share of the Gaussian's own colour that they
replace, each from 0 to 255.
"""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

Tint = NDArray[np.uint8]
Confidence = NDArray[np.uint8]
Colour = tuple[int, int, int]

MEMBER = 128
"""Confidence from which on a Gaussian belongs to something."""

SELECTED: Colour = (255, 115, 0)
_SELECTED_SHARE = 0.6
NO_OBJECT: Colour = (64, 64, 64)
_HALF = 128
_RAMP_SHARE = 180
_ROWS = 50_000
"""Gaussians that principal components are found from; more of them change nothing to see."""


def _ramp() -> NDArray[np.uint8]:
    steps = np.arange(256, dtype=np.uint8)
    colours = cv2.applyColorMap(steps, cv2.COLORMAP_VIRIDIS).reshape(256, 3)
    return colours[:, ::-1].astype(np.uint8)


RAMP: NDArray[np.uint8] = _ramp()
"""256 colours from dark blue to yellow, of evenly rising lightness (viridis)."""

RAMP_STOPS = tuple("#" + bytes(RAMP[level]).hex() for level in range(0, 256, 15))
"""Evenly spaced colours of it, as a page writes them, the first and the last among them."""

_SELECTED_LEVELS = np.where(
    np.arange(256) >= MEMBER, np.round(np.arange(256) * _SELECTED_SHARE), 0
).astype(np.uint8)


def selected_share(selection: Confidence) -> NDArray[np.uint8]:
    """How much of each Gaussian's colour the selection's takes: the surer, the more."""
    return _SELECTED_LEVELS[selection]


def selected_tint(selection: Confidence, below: Tint | None) -> Tint:
    """The selection's colour, over another tint."""
    share = selected_share(selection)
    if below is None:
        tint = np.empty((len(share), 4), np.uint8)
        tint[:, :3], tint[:, 3] = SELECTED, share
        return tint
    return over(below, SELECTED, share)


def over(below: Tint, colour: Colour, share: NDArray[np.uint8]) -> Tint:
    """A tint that does what two do, one after the other.

    Args:
        below: The first.
        colour: The colour of the second.
        share: How much of it, for each Gaussian.
    """
    rows = np.nonzero(share)[0]
    tint = below.copy()
    first = below[rows].astype(np.float32) / 255
    second = (share[rows].astype(np.float32) / 255)[:, None]
    left = first[:, 3:] * (1 - second)
    both = left + second
    mixed = (first[:, :3] * left + np.asarray(colour, np.float32) / 255 * second) / both
    tint[rows] = np.round(255 * np.concatenate((mixed, both), axis=1))
    return tint


def ramp_tint(values: NDArray[np.uint8], *, covers: bool) -> Tint:
    """Levels from 0 to 255 as colours of the ramp, in place of the colours or over them."""
    tint = np.empty((len(values), 4), np.uint8)
    tint[:, :3] = RAMP[values]
    tint[:, 3] = 255 if covers else _RAMP_SHARE
    return tint


def range_of(values: NDArray[np.float32]) -> tuple[float, float]:
    """The first percentile of values and the largest; 0 and 1 without any."""
    if len(values) == 0:
        return 0.0, 1.0
    return float(np.percentile(values, 1)), float(values.max())


def stretched(values: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Levels from 0 to 255 for the ends of `range_of`."""
    low, high = range_of(values)
    span = max(high - low, 1e-9)
    return np.round(255 * np.clip((values - low) / span, 0, 1)).astype(np.uint8)


def owners_of(
    objects: Sequence[tuple[NDArray[np.uint8] | NDArray[np.bool_], Colour]], count: int
) -> tuple[NDArray[np.int32], NDArray[np.uint8]]:
    """The object of each Gaussian, -1 for none, and the confidence that it has it with.

    Where several have a Gaussian, the one that has it with the highest confidence; of equals the
    later.
    """
    owner = np.full(count, -1, np.int32)
    best = np.zeros(count, np.uint8)
    for position, (mask, _) in enumerate(objects):
        sure = mask.astype(np.uint8) * 255 if mask.dtype == np.bool_ else mask
        wins = (sure >= MEMBER) & (sure >= best)
        owner[wins] = position
        best[wins] = sure[wins]
    return owner, best


def owner_tint(owner: NDArray[np.int32], colours: Sequence[Colour]) -> Tint:
    """Half of the colour of each Gaussian's object, and nothing where there is none."""
    table = np.zeros((len(colours) + 1, 4), np.uint8)
    for position, colour in enumerate(colours):
        table[position] = (*colour, _HALF)
    return table[owner]


def component_tint(features: NDArray[np.float32], known: NDArray[np.bool_] | None = None) -> Tint:
    """Three principal components of features as red, green and blue.

    Args:
        features: One row a Gaussian, (n, channels).
        known: False where a row says nothing: those are grey. None is all true.
    """
    count, channels = features.shape
    known = np.ones(count, np.bool_) if known is None else known
    tint = np.full((count, 4), 128, np.uint8)
    tint[:, 3] = 255
    rows = np.nonzero(known)[0]
    if len(rows) < 2:
        return tint
    sample = features[rows[:: max(1, len(rows) // _ROWS)]].astype(np.float64)
    mean = sample.mean(axis=0)
    _, vectors = np.linalg.eigh(np.cov(sample - mean, rowvar=False).reshape(channels, channels))
    for component in range(min(3, channels)):
        vector = vectors[:, -1 - component]
        # An eigenvector has no sign of its own: its largest entry is positive.
        vector = vector * np.sign(vector[np.abs(vector).argmax()])
        along = features[rows] @ vector.astype(np.float32) - np.float32(mean @ vector)
        low, high = np.percentile(along, (1, 99))
        if high > low:
            tint[rows, component] = np.round(255 * np.clip((along - low) / (high - low), 0, 1))
    return tint
