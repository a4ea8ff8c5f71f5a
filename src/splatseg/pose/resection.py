r"""Poses of new photographs of a known scene, one at a time: camera resectioning.

Features (SIFT) of a new photograph are matched with those of the photographs of the scene that
look most like it. A matched feature of these has a depth, so that it is a point
:math:`X_i` of the world which the new photograph shows at :math:`x_i`; the pose minimises

.. math:: \sum_i \rho\bigl(\lVert \pi(R X_i + t) - x_i \rVert\bigr)

over the matches that one pose explains (RANSAC; :math:`\rho` is the soft L1 norm). Nothing that
is known moves, and each photograph costs the same however many are known already, but for the
comparison of what they look like.

References:
    Hartley and Zisserman, Multiple View Geometry in Computer Vision, 2nd ed. (2004), chapter 7.
    Terzakis and Lourakis, A Consistently Fast and Globally Optimal Solution to the
    Perspective-n-Point Problem, ECCV 2020 (SQPnP).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from splatseg.core import Camera, View
from splatseg.core.boundary import boundary
from splatseg.errors import InputError
from splatseg.pose._doctor_matches import SiftFeatures, mutual_matches, sift_features
from splatseg.pose._pairs import likeness
from splatseg.pose._photographs import LeftOut, Photograph, read_headers, working_focal

_LONGEST = 1000
"""Longest side at which features are found, pixels, as where poses are recovered."""

_REFERENCES = 8
"""Photographs of the scene, those most alike, that a new one is matched with."""

_MIN_MATCHES = 24
"""Matches that one pose must explain: as many as the pairs of `pose.doctor` need."""

_MAX_ERROR = 3.0
"""Distance from its pixel at which a point still belongs to a pose, pixels at the size at which
features are found."""

_ROUNDS = 3
"""Times that the pose and the matches which it explains are found from each other."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ResectedView:
    """A photograph with its pose, and how well it is known."""

    view: View
    """In the world of the scene; a training view named after the photograph."""

    matches: int
    """Points of the scene that the pose explains."""

    error: float
    """Median distance between these and their pixels, pixels of the photograph."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Resection:
    """Poses of new photographs, and those that found none."""

    found: tuple[ResectedView, ...]
    left_out: tuple[LeftOut, ...]


@boundary
def resect(
    photographs: Sequence[Path],
    references: Sequence[View],
    depth_of: Callable[[View], Float[Tensor, "height width"]],
    *,
    progress: Callable[[int, int], None] | None = None,
) -> Resection:
    """Find the poses of photographs of a scene whose other photographs have theirs.

    A photograph as large as one of the scene has that one's lens; of several lenses that of the
    photograph which looks most like it. Otherwise its focal length begins at what its EXIF data
    say, or at a guess, and is found with the pose.

    Args:
        photographs: The new ones.
        references: Views of the scene with photographs and poses.
        depth_of: Depth of a reference at the pixels of its photograph, scene units; 0 where there
            is none.
        progress: Called with the photographs done and all there are.

    Raises:
        InputError: If there are no photographs, or no references with photographs.
        MissingFileError: If the photograph of a reference is not where it was.
    """
    known = [view for view in references if view.image is not None]
    if not photographs or not known:
        raise InputError(
            "photographs, references: expected at least one of each, got "
            f"{len(photographs)} and {len(known)}."
        )
    good, left_out = read_headers(photographs)
    scene = _Scene(known, depth_of)
    new = [sift_features(_unposed(photograph), _LONGEST) for photograph in good]
    alike = likeness([_bytes(one) for one in (*scene.features, *new)], seed=0)
    alike = alike[len(known) :, : len(known)]
    found: list[ResectedView] = []
    for done, (photograph, features, row) in enumerate(zip(good, new, alike, strict=True)):
        resected = _resected(photograph, features, row, scene)
        if isinstance(resected, LeftOut):
            left_out.append(resected)
        else:
            found.append(resected)
        if progress is not None:
            progress(done + 1, len(good))
    return Resection(found=tuple(found), left_out=tuple(left_out))


class _Scene:
    """What is known: the features of its photographs, and where they are in the world."""

    def __init__(
        self, views: Sequence[View], depth_of: Callable[[View], Float[Tensor, "height width"]]
    ) -> None:
        self.views = views
        self.features = [sift_features(view, _LONGEST) for view in views]
        self._depth_of = depth_of
        self._points: dict[int, NDArray[np.float64]] = {}

    def points(self, index: int) -> NDArray[np.float64]:
        """(n, 3) the world's point of each feature of a view, NaN where it has no depth."""
        if index not in self._points:
            view, pixels = self.views[index], torch.from_numpy(self.features[index].pixels)
            depth = self._depth_of(view).double()
            column = pixels[:, 0].long().clamp(0, depth.shape[1] - 1)
            row = pixels[:, 1].long().clamp(0, depth.shape[0] - 1)
            at = depth[row, column]
            points = view.camera.unproject(pixels, torch.where(at > 0, at, 1.0))
            self._points[index] = torch.where((at > 0)[:, None], points, torch.nan).numpy()
        return self._points[index]


def _unposed(photograph: Photograph) -> View:
    focal, _ = working_focal(photograph, max(photograph.width, photograph.height))
    camera = Camera(
        width=photograph.width,
        height=photograph.height,
        fx=focal,
        fy=focal,
        cx=photograph.width / 2,
        cy=photograph.height / 2,
        cam_from_world=torch.eye(4, dtype=torch.float64),
    )
    return View(name=photograph.path.stem, camera=camera, image=photograph.path)


def _bytes(features: SiftFeatures) -> NDArray[np.uint8]:
    """Descriptors as `likeness` wants them."""
    return (features.descriptors * 512).clip(0, 255).astype(np.uint8)


def _resected(
    photograph: Photograph, features: SiftFeatures, alike: NDArray[np.float32], scene: _Scene
) -> ResectedView | LeftOut:
    """The pose of a photograph, or why it has none."""
    import cv2

    name = photograph.path.name
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    order = np.argsort(-alike, kind="stable")[:_REFERENCES].tolist()
    pixels, points = [np.zeros((0, 2))], [np.zeros((0, 3))]
    for index in order:
        other = scene.features[index]
        if min(len(features.pixels), len(other.pixels)) < 2:
            continue
        pair = mutual_matches(features, other, matcher)
        at = scene.points(index)[pair[:, 1]]
        there = np.isfinite(at).all(axis=1)
        pixels.append(features.pixels[pair[there, 0]])
        points.append(at[there])
    seen, world = np.concatenate(pixels), np.concatenate(points)
    if len(seen) < _MIN_MATCHES:
        return LeftOut(name=name, why=f"{len(seen)} of its features were found in the scene")
    same = [
        scene.views[i].camera
        for i in order
        if (scene.views[i].camera.width, scene.views[i].camera.height)
        == (photograph.width, photograph.height)
    ]
    view = _unposed(photograph)
    lens = view.camera
    if same:
        lens = replace(same[0], cam_from_world=lens.cam_from_world)
    limit = _MAX_ERROR * features.scale
    camera, error = _posed(lens, seen, world, limit, free=not same)
    inside = error < limit
    if int(inside.sum()) < _MIN_MATCHES:
        return LeftOut(
            name=name, why=f"one pose explains {int(inside.sum())} of {len(seen)} matches"
        )
    return ResectedView(
        view=replace(view, camera=camera, split="train"),
        matches=int(inside.sum()),
        error=float(np.median(error[inside])),
    )


def _posed(
    camera: Camera,
    pixels: NDArray[np.float64],
    points: NDArray[np.float64],
    limit: float,
    *,
    free: bool,
) -> tuple[Camera, NDArray[np.float64]]:
    """The camera at the pose that explains most matches, and the error of each, pixels.

    Args:
        camera: Its lens.
        pixels: (n, 2) of the photograph.
        points: (n, 3) of the world.
        limit: Largest error of a match that is explained, pixels.
        free: Whether the focal length is found too.
    """
    import cv2

    plane = (camera.undistort_pixels(torch.from_numpy(pixels)).numpy() - [camera.cx, camera.cy]) / [
        camera.fx,
        camera.fy,
    ]
    nowhere = camera, np.full(len(pixels), np.inf)
    try:
        known, turn, shift, _ = cv2.solvePnPRansac(
            points, plane, np.eye(3), np.zeros(0), iterationsCount=2000,
            reprojectionError=limit / camera.fx, confidence=0.9999, flags=cv2.SOLVEPNP_SQPNP,
        )  # fmt: skip
    except cv2.error:
        # Points in one place or on one line: no pose follows from them.
        return nowhere
    if not known:
        return nowhere
    rotation, _ = cv2.Rodrigues(turn)
    camera = _at(camera, np.asarray(rotation), np.asarray(shift).reshape(3))
    error = _errors(camera, pixels, points)
    for _ in range(_ROUNDS):
        inside = error < limit
        if int(inside.sum()) < _MIN_MATCHES:
            return camera, error
        camera = _refined(camera, pixels[inside], points[inside], free=free)
        error = _errors(camera, pixels, points)
    return camera, error


def _at(camera: Camera, rotation: NDArray[Any], shift: NDArray[Any]) -> Camera:
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3], pose[:3, 3] = torch.from_numpy(rotation), torch.from_numpy(shift)
    return replace(camera, cam_from_world=pose)


def _errors(
    camera: Camera, pixels: NDArray[np.float64], points: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Distances between points and their pixels; infinite behind the camera."""
    at, depth = camera.project(torch.from_numpy(points))
    error = (at - torch.from_numpy(pixels)).norm(dim=1)
    return torch.where(depth > 0, error, torch.inf).nan_to_num(torch.inf).numpy()


def _refined(
    camera: Camera, pixels: NDArray[np.float64], points: NDArray[np.float64], *, free: bool
) -> Camera:
    """The camera that fits matches best, from where it is."""
    import cv2
    from scipy.optimize import least_squares

    pose = camera.cam_from_world.numpy()
    turn, _ = cv2.Rodrigues(pose[:3, :3])
    start = np.concatenate((np.asarray(turn).reshape(3), pose[:3, 3], [0.0] * free))

    def moved(values: NDArray[np.float64]) -> Camera:
        rotation, _ = cv2.Rodrigues(values[:3])
        factor = float(np.exp(values[6])) if free else 1.0
        lens = replace(camera, fx=factor * camera.fx, fy=factor * camera.fy)
        return _at(lens, np.asarray(rotation), values[3:6])

    def residuals(values: NDArray[np.float64]) -> NDArray[np.float64]:
        at, _ = moved(values).project(torch.from_numpy(points))
        return (at.numpy() - pixels).ravel()

    return moved(least_squares(residuals, start, loss="soft_l1").x)
