"""Generated worlds as cameras on a car, labelled meshes and labelled points record them."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from splatseg._check import check_range
from splatseg.core import LabelledMesh, View
from splatseg.core.boundary import boundary, convert_fields
from splatseg.core.evidence import UNLABELLED
from splatseg.errors import InputError
from splatseg.synthetic.photographs import look_at
from splatseg.synthetic.raycast import cast, classes_of, film, shade
from splatseg.synthetic.solids import Primitive, SyntheticScene

_EYE_HEIGHT = 1.55
_AHEAD = 14.0


@boundary
def drive_cameras(
    scene: SyntheticScene,
    count: int = 40,
    *,
    test_every: int = 8,
    width: int = 352,
    height: int = 192,
    field_of_view: float = 90.0,
    reach: float = 0.7,
) -> tuple[View, ...]:
    """Forward-looking pinhole cameras along the drive of a street, in the order of the drive.

    They stand 1.55 m above the road, evenly spaced, and look along the line that is driven,
    with a little sway. The same scene gives the same views.

    Args:
        scene: A scene with a `drive`.
        count: Number of views.
        test_every: Of how many views one has the split ``test``; 0 for none.
        width: Pixels a row.
        height: Rows.
        field_of_view: Horizontal, degrees.
        reach: Share of the drive that is driven, in (0, 1]; the rest is what the last sees ahead.

    Returns:
        Views named ``drive_0000`` ..., without photographs.

    Raises:
        InputError: If the scene has no drive, as rooms have none.
    """
    check_range("count", count, 1, 100000)
    check_range("test_every", test_every, 0, 100000)
    check_range("reach", reach, 0.01, 1.0)
    if len(scene.drive) < 2:
        raise InputError(
            f"scene: expected one with a drive, such as a street, {scene.name!r:.60} has none."
        )
    line = np.array(scene.drive)
    steps = np.linalg.norm(np.diff(line, axis=0), axis=1)
    along = np.concatenate(([0.0], np.cumsum(steps)))
    rng = np.random.default_rng([scene.seed, 31])

    def place(s: float) -> np.ndarray:
        """On the line; before its ends and beyond them straight on."""
        inside = min(max(s, 0.0), float(along[-1]))
        point = np.array([np.interp(inside, along, line[:, k]) for k in range(3)])
        end = line[-1] - line[-2] if s > inside else line[1] - line[0]
        return point + (s - inside) * end / np.linalg.norm(end)

    views: list[View] = []
    for i, s in enumerate(np.linspace(0.0, reach * float(along[-1]), count)):
        eye, ahead = place(float(s)), place(float(s) + _AHEAD)
        eye[2] += _EYE_HEIGHT + rng.uniform(-0.02, 0.02)
        eye[:2] += rng.uniform(-0.06, 0.06, size=2)
        sway = math.tan(math.radians(0.8)) * _AHEAD
        ahead[:2] += rng.uniform(-sway, sway, size=2)
        ahead[2] += _EYE_HEIGHT - 0.35 + rng.uniform(-0.1, 0.1)
        camera = look_at(
            eye.tolist(), ahead.tolist(), width=width, height=height, field_of_view=field_of_view
        )
        split = "test" if test_every and i % test_every == test_every // 2 else "train"
        views.append(View(name=f"drive_{i:04d}", camera=camera, split=split))
    return tuple(views)


# A generated scene as a labelled mesh.


_Triangles = tuple[Float[Tensor, "v 3"], Int[Tensor, "m 3"]]
_BOX = (
    (0, 1, 3), (0, 3, 2), (4, 7, 5), (4, 6, 7), (0, 5, 1), (0, 4, 5),
    (2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3),
)  # fmt: skip


@boundary
def scene_mesh(scene: SyntheticScene, *, segments: int = 96) -> LabelledMesh:
    """The solids of a scene as triangles, their faces labelled ``semantic`` and ``instance``.

    Boxes and planes are exact. Spheres and cylinders are polyhedra with corners on the solid,
    off it by up to 1 - cos(pi / segments) of the radius.

    Args:
        scene: The solids.
        segments: Corners around a sphere or cylinder.
    """
    check_range("segments", segments, 3, 10000)
    vertices: list[Tensor] = []
    faces: list[Tensor] = []
    classes: list[Tensor] = []
    instances: list[Tensor] = []
    count = 0
    for item in scene.primitives:
        unit, triangles = _unit(item, segments)
        half = torch.tensor(item.half_size, dtype=torch.float64)
        centre = torch.tensor(item.centre, dtype=torch.float64)
        vertices.append((unit * half) @ item.rotation.T + centre)
        faces.append(triangles + count)
        count += len(unit)
        rows = torch.ones(len(triangles), dtype=torch.int32)
        classes.append(rows * scene.class_of(item.instance))
        instances.append(rows * item.instance)
    return LabelledMesh(
        vertices=torch.cat(vertices),
        faces=torch.cat(faces),
        face_labels={"semantic": torch.cat(classes), "instance": torch.cat(instances)},
    )


def _unit(item: Primitive, segments: int) -> _Triangles:
    """The unit solid."""
    if item.shape == "plane":
        corners = torch.tensor([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
        return corners.double(), torch.tensor([[0, 1, 2], [0, 2, 3]])
    if item.shape == "box":
        # Vertex 4 i + 2 j + k has the signs of (i, j, k).
        sign = torch.tensor([-1.0, 1.0], dtype=torch.float64)
        return torch.cartesian_prod(sign, sign, sign), torch.tensor(_BOX)
    if item.shape == "sphere":
        up = torch.linspace(0, math.pi, segments // 2 + 1, dtype=torch.float64)
        return _turned(up.sin(), -up.cos(), segments)
    radii = torch.tensor([0.0, 1.0, item.taper, 0.0], dtype=torch.float64)
    return _turned(radii, torch.tensor([-1.0, -1, 1, 1], dtype=torch.float64), segments)


def _turned(radii: Tensor, heights: Tensor, segments: int) -> _Triangles:
    """The surface of a line turned about the z axis."""
    turn = torch.arange(segments, dtype=torch.float64) * (2 * math.pi / segments)
    ring = torch.stack((turn.cos(), turn.sin()), dim=-1)
    flat = radii[:, None, None] * ring
    vertices = torch.cat((flat, heights[:, None, None].expand(-1, segments, 1)), dim=-1)
    low = torch.arange(len(radii) - 1)[:, None] * segments
    here = torch.arange(segments)
    after = (here + 1) % segments
    a, b, c, d = low + here, low + after, low + segments + after, low + segments + here
    faces = torch.stack((torch.stack((a, b, c), -1), torch.stack((a, c, d), -1)), dim=2)
    return vertices.reshape(-1, 3), faces.reshape(-1, 3)


# Labelled points of what photographs of a scene would see, clean or as Gaussians lie.


_WIDTH, _HEIGHT = 96, 64
_POINTS_A_VIEW = 2000
_MIN_VIEWS = 8
_REACH = 40.0
_NEAR = 3.0
_CLEARANCE = 0.15
_MAX_ROUNDS = 4


@dataclass(frozen=True, slots=True, kw_only=True)
class SurfaceOptions:
    """How far points are from what they stand for. The defaults are exact points."""

    views: int | None = None
    """From how many places the scene is seen; None takes one for each 2000 points, and at
    least eight. 1 is a partial view: what a single camera sees."""

    detail: float = 0.0
    """In [0, 1]: 0 takes the pixels of a view alike, 1 those at edges and texture eight times as
    often as those of plain surfaces, as a fit spends its Gaussians."""

    noise: float = 0.0
    """Standard deviation of positions in metres for what is up to 3 m away, growing with the
    distance from the camera beyond; 0.01 to 0.02 is like centres of fitted Gaussians."""

    floaters: float = 0.0
    """Share of points, in [0, 1), that lie anywhere between a camera and what it sees."""

    colour_noise: float = 0.0
    """Standard deviation of colours, in [0, 1]."""

    def __post_init__(self) -> None:
        convert_fields(self)
        if self.views is not None:
            check_range("views", self.views, 1, 100000)
        check_range("detail", self.detail, 0.0, 1.0)
        check_range("noise", self.noise, 0.0, 10.0)
        check_range("floaters", self.floaters, 0.0, 0.99)
        check_range("colour_noise", self.colour_noise, 0.0, 1.0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SurfaceCloud:
    """Points with colour, class, object and normal; one row a point."""

    positions: Float[Tensor, "n 3"]
    """float32, world, metres."""

    colours: Float[Tensor, "n 3"]
    """float32 sRGB in [0, 1], lit as in photographs."""

    semantic: Int[Tensor, "n"]
    """int32 class of the scene's table; -1 for floaters."""

    instance: Int[Tensor, "n"]
    """int32 object of the scene; -1 for floaters."""

    normals: Float[Tensor, "n 3"]
    """float32 unit normals towards the camera that saw the point; zero for floaters."""

    def __len__(self) -> int:
        return len(self.positions)

    def take(self, rows: Int[Tensor, "m"]) -> "SurfaceCloud":
        """The points of some rows, in their order."""
        return SurfaceCloud(
            positions=self.positions[rows],
            colours=self.colours[rows],
            semantic=self.semantic[rows],
            instance=self.instance[rows],
            normals=self.normals[rows],
        )


@boundary
def surface_points(
    scene: SyntheticScene,
    count: int = 20000,
    *,
    seed: int = 0,
    options: SurfaceOptions | None = None,
) -> SurfaceCloud:
    """Points on the surfaces that cameras inside a scene see, with exact labels.

    Cameras stand at random in free places: anywhere in a room, about the drive of a street, where
    they see 40 m far. Pixels of their views, drawn at random, become points, so that what is
    near and seen often has more of them, as the Gaussians of a fit have.

    Args:
        scene: Gives surfaces, colours and labels.
        count: Number of points.
        seed: Of everything that is drawn; the same arguments give the same points.
        options: Density, noise and floaters; None for exact points.

    Raises:
        InputError: If no camera finds a free place, or cameras see next to nothing.
    """
    check_range("count", count, 1, 10_000_000)
    check_range("seed", seed, 0, 2**63 - 1)
    chosen = SurfaceOptions() if options is None else options
    rng = np.random.default_rng([seed, scene.seed, 37])
    views = chosen.views or max(_MIN_VIEWS, math.ceil(count / _POINTS_A_VIEW))
    pieces: list[SurfaceCloud] = []
    # A view may see the sky: what is missing then comes from further views.
    for _ in range(_MAX_ROUNDS * views if chosen.views is None else views):
        missing = count - sum(len(piece) for piece in pieces)
        if missing <= 0:
            break
        share = math.ceil(count / views)
        pieces.append(_seen(scene, min(share, missing), rng, chosen))
    found = sum(len(piece) for piece in pieces)
    if found == 0 or (found < count and chosen.views is None):
        raise InputError(
            f"scene: expected surfaces around its cameras, {count} points were not met."
        )
    cloud = _joined(pieces)
    return cloud.take(torch.from_numpy(rng.permutation(len(cloud))))


def _seen(
    scene: SyntheticScene, count: int, rng: np.random.Generator, options: SurfaceOptions
) -> SurfaceCloud:
    """Up to `count` points of one view; fewer where it sees little but sky."""
    eye, target = _viewpoint(scene, rng)
    side = max(1, math.ceil(math.sqrt(3 * count / (_WIDTH * _HEIGHT))))
    camera = look_at(
        eye, target, width=_WIDTH * side, height=_HEIGHT * side, field_of_view=rng.uniform(60, 95)
    )
    origin, rays = camera.rays(camera.pixel_centres() + _wobble(camera.height, camera.width, rng))
    order = _blocks(camera.height, camera.width)
    directions = rays.reshape(-1, 3)[order].float()
    distance, which = cast(scene, origin, directions)
    light, normals = shade(scene, origin.float(), directions, distance, which)
    colours = film(light)
    size = (camera.height, camera.width)
    usable = (which >= 0) & (distance < _REACH)
    weight = usable.float() * (1 + 7 * options.detail * _edges(colours, distance, order, size))
    candidates = int(usable.sum())
    if not candidates:
        return _joined([])
    number = min(count, candidates)
    shares = weight.double().numpy()
    drawn = rng.choice(len(shares), size=number, replace=False, p=shares / shares.sum())
    rows = torch.from_numpy(np.sort(drawn))
    semantic, instance = classes_of(scene)
    points = origin.float() + distance[rows].unsqueeze(-1) * directions[rows]
    exact = SurfaceCloud(
        positions=points,
        colours=colours[rows],
        semantic=semantic[which[rows]],
        instance=instance[which[rows]],
        normals=normals[rows],
    )
    return _jittered(exact, origin.float(), rng, options)


def _wobble(height: int, width: int, rng: np.random.Generator) -> Float[Tensor, "h w 2"]:
    """Offsets within pixels, so that points lie in no pattern."""
    return torch.from_numpy(rng.uniform(-0.5, 0.5, size=(height, width, 2)))


def _blocks(height: int, width: int) -> Int[Tensor, "n"]:
    """Pixels by blocks of 16 x 16, which `cast` takes as bundles."""
    row, column = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    block = (row // 16) * (width // 16) + column // 16
    return torch.argsort(block.reshape(-1), stable=True)


def _edges(
    colours: Float[Tensor, "n 3"],
    distance: Float[Tensor, "n"],
    order: Int[Tensor, "n"],
    size: tuple[int, int],
) -> Float[Tensor, "n"]:
    """How much colour and log distance change from a pixel to the next ones, in [0, 1]."""
    depth = distance.clamp(0.01, 2 * _REACH).log().unsqueeze(-1)
    image = torch.empty(len(order), 4)
    image[order] = torch.cat((colours, 2 * depth), dim=-1)
    image = image.reshape(*size, 4)
    change = torch.zeros(size)
    change[1:] += (image[1:] - image[:-1]).abs().sum(-1)
    change[:, 1:] += (image[:, 1:] - image[:, :-1]).abs().sum(-1)
    return (4 * change).clamp(max=1.0).reshape(-1)[order]


def _viewpoint(scene: SyntheticScene, rng: np.random.Generator) -> tuple[list[float], list[float]]:
    """A free place for a camera, and what it looks at."""
    low, high = np.array(scene.bounds[0]), np.array(scene.bounds[1])
    centres = np.array([p.centre for p in scene.primitives])
    reach = np.array([p.radius for p in scene.primitives]) + 2 * _CLEARANCE
    for _ in range(500):
        if scene.drive:
            at = np.array(scene.drive[rng.integers(len(scene.drive))])
            aside = rng.uniform(-1, 1, size=2) * [5.0, 5.0]
            eye = np.array([at[0] + aside[0], at[1] + aside[1], rng.uniform(1.2, 2.6)])
        else:
            share = rng.uniform([0.06, 0.06, 0.25], [0.94, 0.94, 0.85])
            eye = low + share * (high - low)
        spot = torch.from_numpy(eye).unsqueeze(0)
        near = np.flatnonzero(((centres - eye) ** 2).sum(axis=1) < reach**2)
        if not any(bool(scene.primitives[i].contains(spot, _CLEARANCE)) for i in near):
            turn, rise = rng.uniform(0, 2 * math.pi), rng.normal(-0.25, 0.35)
            if scene.drive:
                rise = rng.normal(-0.03, 0.15)
            rise = min(max(rise, -1.2), 1.0)
            way = [math.cos(turn), math.sin(turn), math.tan(rise)]
            return eye.tolist(), (eye + way).tolist()
    raise InputError("scene: no free place for a camera was found in 500 tries.")


def _jittered(
    cloud: SurfaceCloud, origin: Tensor, rng: np.random.Generator, options: SurfaceOptions
) -> SurfaceCloud:
    """The points with the noise that the options ask for; some become floaters."""
    count = len(cloud)
    way = cloud.positions - origin
    spread = options.noise * (
        torch.linalg.vector_norm(way, dim=-1, keepdim=True) / _NEAR
    ).clamp_min(1)
    positions = cloud.positions + spread * _normal(rng, count)
    colours = (cloud.colours + options.colour_noise * _normal(rng, count)).clamp(0, 1)
    strays = torch.from_numpy(rng.random(count) < options.floaters)
    share = torch.from_numpy(rng.uniform(0.2, 0.97, size=(count, 1))).float()
    stray = strays.unsqueeze(-1)
    return SurfaceCloud(
        positions=torch.where(stray, origin + share * way, positions),
        colours=colours,
        semantic=cloud.semantic.masked_fill(strays, UNLABELLED),
        instance=cloud.instance.masked_fill(strays, UNLABELLED),
        normals=cloud.normals.masked_fill(stray, 0.0),
    )


def _normal(rng: np.random.Generator, count: int) -> Float[Tensor, "n 3"]:
    return torch.from_numpy(rng.normal(size=(count, 3))).float()


def _joined(pieces: list[SurfaceCloud]) -> SurfaceCloud:
    """Several clouds as one; none give an empty one."""
    whole = torch.zeros(0, dtype=torch.int32)
    empty = SurfaceCloud(
        positions=torch.zeros(0, 3),
        colours=torch.zeros(0, 3),
        semantic=whole,
        instance=whole,
        normals=torch.zeros(0, 3),
    )
    every = [empty, *pieces]
    return SurfaceCloud(
        positions=torch.cat([piece.positions for piece in every]),
        colours=torch.cat([piece.colours for piece in every]),
        semantic=torch.cat([piece.semantic for piece in every]),
        instance=torch.cat([piece.instance for piece in every]),
        normals=torch.cat([piece.normals for piece in every]),
    )
