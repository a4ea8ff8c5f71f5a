"""Photographs of a generated scene: where they are taken, start points, wrong label maps."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from splatseg._check import check_range
from splatseg.core import Camera, PointCloud, View
from splatseg.core.boundary import boundary
from splatseg.core.evidence import UNLABELLED
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.synthetic.raycast import Truth
from splatseg.synthetic.solids import SyntheticScene, Vector

_CLEARANCE = 0.28
_LOOKS = ("across", "across", "near", "across", "across", "up")
# Height of what is looked at, as a share of the room's.
_RISE = {"across": (0.18, 0.45), "near": (0.25, 0.70), "up": (0.80, 1.05)}
_POINT_SPREAD = 0.012
_SAME_SURFACE = 0.03


@boundary
def look_at(
    eye: Sequence[float],
    target: Sequence[float],
    *,
    width: int,
    height: int,
    field_of_view: float = 75.0,
) -> Camera:
    """A pinhole camera at `eye` that looks at `target` with z up.

    Args:
        eye: Centre of projection, world.
        target: Point that falls on the middle of the image, world; not straight above or below.
        width: Pixels a row.
        height: Rows.
        field_of_view: Horizontal, degrees.
    """
    check_range("field_of_view", field_of_view, 1.0, 170.0)
    for name, point in (("eye", eye), ("target", target)):
        if len(point) != 3:
            raise ShapeError(f"{name}: expected 3 coordinates, got {len(point)}.")
    centre = torch.tensor([float(v) for v in eye], dtype=torch.float64)
    forward = torch.tensor([float(v) for v in target], dtype=torch.float64) - centre
    right = torch.linalg.cross(forward, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    if float(torch.linalg.vector_norm(right)) < 1e-9:
        raise RangeError(
            f"target: expected a point not straight above or below {eye}, got {target}."
        )
    forward = forward / torch.linalg.vector_norm(forward)
    right = right / torch.linalg.vector_norm(right)
    rotation = torch.stack((right, torch.linalg.cross(forward, right), forward))
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = rotation
    pose[:3, 3] = -rotation @ centre
    focal = width / 2 / math.tan(math.radians(field_of_view) / 2)
    return Camera(
        width=width,
        height=height,
        fx=focal,
        fy=focal,
        cx=width / 2,
        cy=height / 2,
        cam_from_world=pose,
    )


@boundary
def cameras(
    scene: SyntheticScene,
    *,
    train: int = 48,
    test: int = 12,
    width: int = 320,
    height: int = 240,
    field_of_view: float = 75.0,
) -> tuple[View, ...]:
    """Views from inside the scene's bounds, train views first.

    They stand on a ring half-way to the walls at changing heights. Most look across the
    room, one of six at what is near and one up to the ceiling. Test views stand between train
    views. Of a scene of several rooms each has its share of the views, one room after the
    other. The same scene gives the same views.

    Returns:
        Views named ``train_0000`` ... and ``test_0000`` ..., without photographs.

    Raises:
        InputError: If the scene is so full that a camera finds no place.
    """
    check_range("train", train, 1, 10000)
    check_range("test", test, 0, 10000)
    rng = np.random.default_rng([scene.seed, 7])
    views: list[View] = []
    rooms = [_room_of(scene, *box) for box in scene.rooms] or [scene]
    for split, total, phase in (("train", train, 0.0), ("test", test, 0.5)):
        ends = [total * i // len(rooms) for i in range(len(rooms) + 1)]
        for own, (first, last) in zip(rooms, pairwise(ends), strict=True):
            for i in range(last - first):
                turn = 2 * math.pi * (i + phase) / (last - first)
                eye, target = _stand(own, rng, turn=turn, look=_LOOKS[i % len(_LOOKS)])
                camera = look_at(
                    eye, target, width=width, height=height, field_of_view=field_of_view
                )
                views.append(View(name=f"{split}_{first + i:04d}", camera=camera, split=split))
    return tuple(views)


def _room_of(scene: SyntheticScene, low: Vector, high: Vector) -> SyntheticScene:
    """One room of a scene, with the solids that stand in it."""
    inside = tuple(
        solid
        for solid in scene.primitives
        if all(low[k] - solid.radius < solid.centre[k] < high[k] + solid.radius for k in range(3))
    )
    return replace(scene, primitives=inside, bounds=(low, high), rooms=())


def _stand(
    scene: SyntheticScene, rng: np.random.Generator, *, turn: float, look: str
) -> tuple[list[float], list[float]]:
    """A free place on the ring and what it looks at."""
    low, high = np.array(scene.bounds[0]), np.array(scene.bounds[1])
    centre, half = (low + high) / 2, (high - low) / 2
    for _ in range(200):
        angle = turn + rng.uniform(-0.05, 0.05)
        round_ = np.array([math.cos(angle), math.sin(angle)])
        eye = np.empty(3)
        eye[:2] = centre[:2] + rng.uniform(0.35, 0.68) * half[:2] * round_
        eye[2] = low[2] + rng.uniform(0.42, 0.72) * 2 * half[2]
        if look == "near":
            aside = angle + rng.choice([-1, 1]) * rng.uniform(0.9, 1.5)
            toward = np.array([math.cos(aside), math.sin(aside)])
            target = np.array([*(eye[:2] + half[:2] * toward), 0.0])
        else:
            aside = angle + math.pi + rng.uniform(-0.5, 0.5)
            target = np.array(
                [
                    *(centre[:2] + 0.5 * half[:2] * [math.cos(aside), math.sin(aside)]),
                    0.0,
                ]
            )
        rise = rng.uniform(*_RISE[look])
        target[2] = low[2] + rise * 2 * half[2]
        position = torch.tensor(eye).unsqueeze(0)
        if not any(bool(p.contains(position, _CLEARANCE)) for p in scene.primitives):
            return eye.tolist(), target.tolist()
    raise InputError(f"scene: no free place for a camera near the angle {turn:.2f} rad was found.")


@boundary
def start_points(
    views: Sequence[View],
    truths: Mapping[str, Truth],
    *,
    count: int = 15000,
    min_views: int = 3,
    seed: int = 0,
) -> PointCloud:
    """Points like those of structure from motion: on surfaces, seen often, a little off.

    Pixels of the train views are drawn at random and lifted by their true depth. A point is
    kept if at least `min_views` train views see it, and moved by Gaussian noise of 1.2 cm. Its
    colour is the mean over those views.

    Args:
        views: Views of the scene; those of other splits than ``train`` are not looked at.
        truths: What each view sees, by name.
        count: How many points are wanted; fewer are given where few places are seen often.
        min_views: Views that must see a point.
        seed: Of the drawing and the noise.
    """
    train = [view for view in views if view.split == "train"]
    if not train:
        raise InputError("views: expected at least one train view, got none.")
    check_range("seed", seed, 0, 2**63 - 1)
    rng = np.random.default_rng([seed, 11])
    # Some are lost again because too few views see them.
    each = math.ceil(1.6 * count / len(train))
    found = torch.cat([_lifted(view.camera, truths[view.name], each, rng) for view in train])
    seen = torch.zeros(len(found))
    colour = torch.zeros(len(found), 3)
    for view in train:
        truth = truths[view.name]
        pixels, depth = view.camera.project(found)
        column, row = pixels[:, 0].floor().long(), pixels[:, 1].floor().long()
        inside = (column >= 0) & (column < view.camera.width) & (row >= 0)
        inside = (inside & (row < view.camera.height) & (depth > 0)).nonzero()[:, 0]
        at = row[inside], column[inside]
        sees = inside[(truth.depth[at] - depth[inside]).abs() < _SAME_SURFACE]
        seen[sees] += 1
        colour[sees] += truth.image[row[sees], column[sees]].float()
    good = (seen >= min_views).nonzero()[:, 0].numpy()
    chosen = torch.from_numpy(rng.permutation(good)[:count].copy())
    noise = torch.from_numpy(rng.normal(scale=_POINT_SPREAD, size=(len(chosen), 3)))
    return PointCloud(
        points=(found[chosen] + noise).float(),
        colours=(colour[chosen] / seen[chosen].unsqueeze(-1)).round().to(torch.uint8),
    )


def _lifted(
    camera: Camera, truth: Truth, count: int, rng: np.random.Generator
) -> Float[Tensor, "n 3"]:
    hit = (truth.depth > 0).nonzero()
    if not len(hit):
        return torch.zeros(0, 3, dtype=torch.float64)
    drawn = hit[torch.from_numpy(rng.integers(len(hit), size=count))]
    pixels = drawn.flip(-1).double() + 0.5
    return camera.unproject(pixels, truth.depth[drawn[:, 0], drawn[:, 1]].double())


# Label maps with the errors that a closed-set segmenter makes.
#
# Errors of a network are not noise: one object looks like another class from most places, small
# things are overlooked, borders wander, shadows and patterns become segments of their own. Noise
# would average out over views and make lifting look better than it is.


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
