"""How strongly neighbouring pixels differ: in colour, in the mixture of colours, in texture.

A pixel is described by soft histograms of L, a and b with fixed bins, and by the energy of its
gradients in four directions. Blurred over a neighbourhood, the histograms are distributions of
colour; the square root makes the distance of two of them the Hellinger distance. The largest
eigenvalue of the structure tensor over all channels is then the squared change across the
strongest edge through the pixel, whichever way it runs. A texture has edges inside, but not in
the distributions over neighbourhoods wider than its grain.
"""

from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]

# Bins of CIE Lab, in its own units. Colours indoors and outdoors lie near grey: +-48 holds them.
_L_BINS = np.linspace(0.0, 100.0, 13, dtype=np.float32)
_AB_BINS = np.linspace(-48.0, 48.0, 17, dtype=np.float32)
_TEXTURE_SCALE = 12.0
"""Gradient energy, in units of L, at which a texture channel is half full."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PixelFeatures:
    """What merging and watershed go by, at the working size."""

    lab: Array
    """(h, w, 3): smoothed colour."""

    bins: Array
    """(h, w, b): soft histograms of L, a and b; each of the three sums to 1."""

    texture: Array
    """(h, w, 4): gradient energy in four directions, in [0, 1)."""

    strength: Array
    """(h, w): boundary strength, 0 in flat parts, about 1 at strong edges."""


@contextmanager
def one_thread() -> Generator[None]:
    """Have cv2 work in one thread: the same sums in the same order, whatever the machine."""
    import cv2

    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


def pixel_features(image: NDArray[np.uint8]) -> PixelFeatures:
    """Describe every pixel of an RGB image at the working size."""
    import cv2

    scaled = image.astype(np.float32) / 255
    raw = np.asarray(cv2.cvtColor(scaled, cv2.COLOR_RGB2LAB), np.float32)
    lab = _blur(raw, 1.0)
    bins = np.concatenate(
        (
            _soft_bins(lab[..., 0], _L_BINS),
            _soft_bins(lab[..., 1], _AB_BINS),
            _soft_bins(lab[..., 2], _AB_BINS),
        ),
        axis=2,
    )
    texture = _texture(raw[..., 0])
    return PixelFeatures(
        lab=lab, bins=bins, texture=texture, strength=_strength(lab, bins, texture)
    )


def _strength(lab: Array, bins: Array, texture: Array) -> Array:
    """Edges of colour (sharp), of colour distributions and of texture (broad), together."""
    # 20 units of Lab across a sharp edge count as a full one.
    sharp = _gradient(lab, 1.0) / 20.0
    # The three histograms sum to 3, so the distance of disjoint ones is sqrt(2 * 3).
    root3 = np.float32(1.0 / np.sqrt(6.0))
    narrow = _gradient(np.sqrt(_blur(bins, 2.0)) * root3, 2.0)
    broad = _gradient(np.sqrt(_blur(bins, 5.0)) * root3, 5.0)
    grain = _gradient(_blur(texture, 5.0), 5.0)
    total = 0.35 * np.minimum(sharp, 1.5) + 0.35 * narrow + 0.3 * broad + 0.3 * grain
    return total.astype(np.float32)


def _gradient(channels: Array, reach: float) -> Array:
    """Change across the strongest edge at each pixel, over about twice `reach` pixels."""
    import cv2

    step = max(1, round(reach))
    kernel = np.zeros((1, 2 * step + 1), np.float32)
    kernel[0, 0], kernel[0, -1] = -1.0, 1.0
    xx = np.zeros(channels.shape[:2], np.float32)
    yy, xy = xx.copy(), xx.copy()
    for k in range(channels.shape[2]):
        plane = np.ascontiguousarray(channels[..., k])
        dx = np.asarray(cv2.filter2D(plane, -1, kernel, borderType=cv2.BORDER_REFLECT))
        dy = np.asarray(cv2.filter2D(plane, -1, kernel.T, borderType=cv2.BORDER_REFLECT))
        xx += dx * dx
        yy += dy * dy
        xy += dx * dy
    root = np.sqrt((xx - yy) ** 2 + 4 * xy * xy)
    return np.sqrt(np.maximum((xx + yy + root) / 2, 0)).astype(np.float32)


def _texture(lightness: Array) -> Array:
    """Gradient energy in four directions, averaged over a few pixels, squeezed to [0, 1)."""
    import cv2

    dx = np.asarray(cv2.Scharr(lightness, cv2.CV_32F, 1, 0)) / 16
    dy = np.asarray(cv2.Scharr(lightness, cv2.CV_32F, 0, 1)) / 16
    half = np.float32(np.sqrt(0.5))
    planes = [np.abs(dx), np.abs(dy), np.abs(dx + dy) * half, np.abs(dx - dy) * half]
    energy = _blur(np.stack(planes, axis=2).astype(np.float32), 2.0)
    return (energy / (energy + _TEXTURE_SCALE)).astype(np.float32)


def _soft_bins(values: Array, centres: Array) -> Array:
    """Linear interpolation into bins: at most two per pixel are filled, and sum to 1."""
    step = centres[1] - centres[0]
    position = np.clip((values - centres[0]) / step, 0, len(centres) - 1)
    distance = np.abs(position[..., None] - np.arange(len(centres), dtype=np.float32))
    return np.maximum(1 - distance, 0).astype(np.float32)


def _blur(channels: Array, sigma: float) -> Array:
    """Gaussian blur of every channel; cv2 takes at most four at a time."""
    import cv2

    def one(part: Any) -> Any:
        return cv2.GaussianBlur(
            np.ascontiguousarray(part), (0, 0), sigma, borderType=cv2.BORDER_REFLECT
        )

    planes = [one(channels[..., k]) for k in range(channels.shape[2])]
    return np.stack(planes, axis=2).astype(np.float32)
