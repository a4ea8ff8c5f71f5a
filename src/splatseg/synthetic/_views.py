"""Where the photographs of a generated scene are taken, and the start points they give."""

import math
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from splatseg._check import check_range
from splatseg.core import Camera, PointCloud, View
from splatseg.core.boundary import boundary
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.synthetic._raycast import Truth
from splatseg.synthetic._scene import SyntheticScene

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
    views. The same scene gives the same views.

    Returns:
        Views named ``train_0000`` ... and ``test_0000`` ..., without photographs.

    Raises:
        InputError: If the scene is so full that a camera finds no place.
    """
    check_range("train", train, 1, 10000)
    check_range("test", test, 0, 10000)
    rng = np.random.default_rng([scene.seed, 7])
    views: list[View] = []
    for split, count, phase in (("train", train, 0.0), ("test", test, 0.5)):
        for i in range(count):
            turn = 2 * math.pi * (i + phase) / count
            eye, target = _stand(scene, rng, turn=turn, look=_LOOKS[i % len(_LOOKS)])
            camera = look_at(eye, target, width=width, height=height, field_of_view=field_of_view)
            views.append(View(name=f"{split}_{i:04d}", camera=camera, split=split))
    return tuple(views)


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
