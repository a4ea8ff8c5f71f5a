"""Label maps with the errors that a closed-set segmenter makes.

Errors of a network are not noise: one object looks like another class from most places, small
things are overlooked, borders wander, shadows and patterns become segments of their own. Noise
would average out over views and make lifting look better than it is.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from splatseg._check import check_range
from splatseg.core.boundary import boundary
from splatseg.core.evidence import UNLABELLED
from splatseg.synthetic._raycast import Truth
from splatseg.synthetic._scene import SyntheticScene

_MISSED_BELOW = 0.0012
_RAGGED = 0.006
_BLOBS = 2.5


@dataclass(frozen=True, slots=True, kw_only=True)
class _Tendency:
    """What one object is taken for, and how often."""

    others: tuple[int, ...]
    """The class it is taken for, then those that parts of it are taken for."""

    rate: float
    fragment_rate: float


@boundary
def machine_labels(
    scene: SyntheticScene,
    truths: Mapping[str, Truth],
    *,
    seed: int = 0,
    severity: float = 1.0,
) -> dict[str, Int[Tensor, "height width"]]:
    """Class maps as a network would give them, by view name.

    Per object a class it is taken for and a rate are drawn once, so that its errors agree over
    views. Then per view: whole segments take the other class at that rate; parts of a segment
    do; segments of less than a thousandth of the image vanish in their surroundings half of
    the time; borders are bent by up to 0.6 % of the image's width; a few blobs take a class at
    random.

    Args:
        scene: Gives the classes and which are related.
        truths: What each view really shows, by name.
        seed: Of everything that is drawn.
        severity: 0 gives the truth back; 1 is a middling network (about nine pixels of ten are
            right); up to 2.

    Returns:
        int32 maps, -1 where the truth has no class.
    """
    check_range("severity", severity, 0.0, 2.0)
    check_range("seed", seed, 0, 2**63 - 1)
    tendencies = _tendencies(scene, np.random.default_rng([seed, 3]), severity)
    return {
        name: _one_view(scene, truth, tendencies, np.random.default_rng([seed, 5, i]), severity)
        for i, (name, truth) in enumerate(sorted(truths.items()))
    }


def _tendencies(
    scene: SyntheticScene, rng: np.random.Generator, severity: float
) -> dict[int, _Tendency]:
    names = {row.id: row.name for row in scene.classes.rows}
    ids = {row.name: row.id for row in scene.classes.rows}
    stuff = {row.id for row in scene.classes.rows if not row.isthing}
    out: dict[int, _Tendency] = {}
    for item in scene.objects:
        own = names[item.class_id]
        alike = [n for group in scene.related_classes if own in group for n in group if n != own]
        pool = alike or [n for n in ids if n != own] or [own]
        # One thing in twelve is mostly taken for something else, the others now and then.
        hard = rng.random() < 0.08
        rate = float(rng.uniform(0.45, 0.7) if hard else rng.beta(1.2, 9.0))
        out[item.id] = _Tendency(
            others=tuple(ids[str(other)] for other in rng.permutation(pool)),
            rate=0.0 if item.class_id in stuff else min(1.0, severity * rate),
            fragment_rate=min(1.0, severity * (0.35 if item.class_id in stuff else 0.12)),
        )
    return out


def _one_view(
    scene: SyntheticScene,
    truth: Truth,
    tendencies: Mapping[int, _Tendency],
    rng: np.random.Generator,
    severity: float,
) -> Int[Tensor, "height width"]:
    height, width = truth.semantic.shape
    labels = truth.semantic.clone()
    if severity == 0:
        return labels
    for instance in torch.unique(truth.instance).tolist():
        if instance == UNLABELLED:
            continue
        segment = truth.instance == instance
        tendency = tendencies[instance]
        # Drawn always, so that one object's luck does not change another's.
        draw = rng.random(2)
        part = segment & (_smooth_noise(rng, height, width, cells=6) > 0.84)
        fragment = tendency.others[int(rng.integers(len(tendency.others)))]
        small = int(segment.sum()) < _MISSED_BELOW * height * width
        if small and draw[0] < min(1.0, 0.5 * severity):
            labels[segment] = _surroundings(truth.semantic, segment)
        elif draw[0] < tendency.rate:
            labels[segment] = tendency.others[0]
        elif draw[1] < tendency.fragment_rate:
            labels[part] = fragment
    for _ in range(int(rng.poisson(_BLOBS * severity))):
        labels[_blob(rng, height, width)] = int(rng.choice([r.id for r in scene.classes.rows]))
    bent = _bent(labels, rng, reach=_RAGGED * severity * width)
    return bent.masked_fill(truth.semantic == UNLABELLED, UNLABELLED)


def _smooth_noise(
    rng: np.random.Generator, height: int, width: int, *, cells: int
) -> Float[Tensor, "height width"]:
    """Noise in about [0, 1] with `cells` features along the longer side."""
    small = torch.from_numpy(rng.random((1, 1, cells + 1, cells + 1), dtype=np.float32))
    side = max(height, width)
    large = functional.interpolate(small, size=(side, side), mode="bicubic", align_corners=True)
    return large[0, 0, :height, :width]


def _surroundings(semantic: Tensor, segment: Tensor) -> int:
    """The class that most pixels around a segment have."""
    near = functional.max_pool2d(segment[None, None].float(), 7, stride=1, padding=3)[0, 0] > 0
    ring = semantic[near & ~segment & (semantic != UNLABELLED)]
    return int(ring.mode().values) if len(ring) else int(semantic[segment][0])


def _blob(rng: np.random.Generator, height: int, width: int) -> Tensor:
    row, column = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    y, x, turn = rng.uniform(0, height), rng.uniform(0, width), rng.uniform(0, math.pi)
    long, short = rng.uniform(0.02, 0.07) * width, rng.uniform(0.01, 0.04) * width
    u = (column - x) * math.cos(turn) + (row - y) * math.sin(turn)
    v = (row - y) * math.cos(turn) - (column - x) * math.sin(turn)
    return (u / long) ** 2 + (v / short) ** 2 < 1


def _bent(labels: Tensor, rng: np.random.Generator, *, reach: float) -> Tensor:
    """The map read at places that wander by up to about `reach` pixels."""
    height, width = labels.shape
    row, column = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    moved: list[Tensor] = []
    for grid, size in ((row, height), (column, width)):
        shift = sum(
            (_smooth_noise(rng, height, width, cells=cells) - 0.5) * share
            for cells, share in ((12, 2.0), (40, 1.5))
        )
        moved.append((grid + shift * reach).round().long().clamp(0, size - 1))
    return labels[moved[0], moved[1]]
