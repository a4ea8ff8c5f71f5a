"""Shapes of primitives: an icosphere deformed by a code, and its auto-encoder (eq. 1)."""

import functools
import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional

from splatseg._check import check_choice, check_range, check_shape
from splatseg.core.boundary import boundary, convert_fields
from splatseg.errors import InputError, RangeError, ShapeError

VERTICES, FACES = 42, 80

_SHORT, _LONG = 1.0, (1 + math.sqrt(5)) / 2
_ICOSAHEDRON = (
    (-_SHORT, _LONG, 0.0), (_SHORT, _LONG, 0.0), (-_SHORT, -_LONG, 0.0), (_SHORT, -_LONG, 0.0),
    (0.0, -_SHORT, _LONG), (0.0, _SHORT, _LONG), (0.0, -_SHORT, -_LONG), (0.0, _SHORT, -_LONG),
    (_LONG, 0.0, -_SHORT), (_LONG, 0.0, _SHORT), (-_LONG, 0.0, -_SHORT), (-_LONG, 0.0, _SHORT),
)  # fmt: skip
"""The order of published checkpoints, whose numbers mean nothing in another one."""
_TOUCHING = 1e-3


def primitive_scale(voxel_size: float) -> float:
    """Length of the unit of a primitive in a voxel: from its middle to a corner.

    Example:
        >>> round(primitive_scale(1.0), 3)
        0.866
    """
    return voxel_size * 0.5 * math.sqrt(3)


def template() -> tuple[Float[Tensor, "42 3"], Int[Tensor, "80 3"]]:
    """The icosphere of level 1: an icosahedron whose edges are halved, on the unit sphere.

    Vertices are the 12 of the icosahedron, then the middles of its 30 edges in the order of the
    edges' vertices, which is how published checkpoints have them.

    Returns:
        float32 vertices (42, 3) of length 1, and int64 faces (80, 3), counter-clockwise seen
        from outside; they are the caller's own.

    Example:
        >>> vertices, faces = template()
        >>> len(vertices) - len(faces) * 3 // 2 + len(faces)
        2
    """
    # Networks are made on `meta`, without memory, before their tensors are read.
    with torch.device("cpu"):
        vertices, faces = _icosphere()
    return vertices.float(), faces.clone()


@functools.cache
def _icosphere() -> tuple[Float[Tensor, "42 3"], Int[Tensor, "80 3"]]:
    """The same in float64."""
    corners = torch.tensor(_ICOSAHEDRON, dtype=torch.float64)
    near = torch.cdist(corners, corners) < 2 * _SHORT + _TOUCHING
    count = len(corners)
    edges = [(a, b) for a, b in itertools.combinations(range(count), 2) if near[a, b]]
    middle = {edge: count + i for i, edge in enumerate(edges)}
    faces: list[tuple[int, int, int]] = []
    for a, b, c in itertools.combinations(range(count), 3):
        if near[a, b] and near[b, c] and near[a, c]:
            ab, bc, ac = middle[a, b], middle[b, c], middle[a, c]
            faces += [(a, ab, ac), (b, bc, ab), (c, ac, bc), (ab, bc, ac)]
    halves = torch.tensor(edges)
    vertices = torch.cat((corners, corners[halves].mean(dim=1)))
    vertices = vertices / vertices.norm(dim=1, keepdim=True)
    rows = torch.tensor(faces)
    inward = torch.linalg.det(vertices[rows]) < 0
    rows[inward] = rows[inward].flip(1)
    return vertices, rows


# How large an auto-encoder of shapes is.


MAX_WIDTH = 4096
"""Channels that a layer may have; a file that asks for more is not believed."""
MAX_LAYERS = 12
"""Hidden layers that encoder or decoder may have."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ShapeConfig:
    """Widths of the layers. The defaults are the published ones (DNMP, Lu et al. 2023).

    Example:
        >>> ShapeConfig().decoder_widths
        (512, 512, 512, 512)
    """

    code_size: int = 8
    """mu, numbers of a code, at least 2: codes are points of a sphere."""

    encoder_widths: tuple[int, ...] = (512, 512, 512, 512)
    """Channels of a point after each layer, before the maximum over points."""

    decoder_widths: tuple[int, ...] = (512, 512, 512, 512)
    """Channels after each layer of the decoder, before the offsets."""

    def __post_init__(self) -> None:
        convert_fields(self)
        check_range("code_size", self.code_size, 2, MAX_WIDTH)
        for name in ("encoder_widths", "decoder_widths"):
            widths: tuple[int, ...] = getattr(self, name)
            if not 1 <= len(widths) <= MAX_LAYERS:
                raise RangeError(f"{name}: expected 1 to {MAX_LAYERS} layers, got {len(widths)}.")
            if any(not 1 <= width <= MAX_WIDTH for width in widths):
                raise RangeError(f"{name}: expected widths of 1 to {MAX_WIDTH}, got {widths}.")


PUBLISHED = ShapeConfig()
"""The published auto-encoder: 1.65 million weights."""


# Points to codes to deformed icospheres (eq. 1).


class Perceptron(nn.Module):
    """Linear layers with ReLUs between them, none after the last.

    Args:
        widths: Channels before the first layer, and after each.
    """

    def __init__(self, widths: Sequence[int]) -> None:
        super().__init__()
        self.layers = nn.ModuleList(nn.Linear(*pair) for pair in itertools.pairwise(widths))

    def hidden(self, x: Float[Tensor, "*n a"]) -> Float[Tensor, "*n b"]:
        """What the last layer is given."""
        for layer in self.layers[:-1]:
            x = functional.relu(layer(x))
        return x

    def last(self, x: Float[Tensor, "*n b"]) -> Float[Tensor, "*n c"]:
        """The last layer."""
        return self.layers[-1](x)


class ShapeAutoEncoder(nn.Module):
    r"""A PointNet that codes points, and a decoder of codes into meshes (Lu et al. 2023).

    .. math:: G(z) = X_{template} + \mathrm{MLP}(z / \|z\|), \quad z \in \mathbb{R}^\mu

    Lengths are in the unit of the primitive: the template has radius 1. A primitive in a voxel
    of size s has the published scale s * 0.5 * sqrt(3), so that the template goes through the
    corners of its voxel.

    Args:
        config: Widths of the layers; None is as published.
        has_encoder: Whether points can be coded; files of others may hold a decoder alone.
    """

    vertices: Float[Tensor, "42 3"]
    faces: Int[Tensor, "80 3"]

    def __init__(self, config: ShapeConfig | None = None, *, has_encoder: bool = True) -> None:
        super().__init__()
        self._config = PUBLISHED if config is None else config
        size = self._config.code_size
        encoder = Perceptron((3, *self._config.encoder_widths, size)) if has_encoder else None
        self.encoder = encoder
        self.decoder = Perceptron((size, *self._config.decoder_widths, 3 * VERTICES))
        vertices, faces = template()
        self.register_buffer("vertices", vertices, persistent=False)
        self.register_buffer("faces", faces, persistent=False)

    @property
    def config(self) -> ShapeConfig:
        """Widths of its layers."""
        return self._config

    @property
    def code_size(self) -> int:
        """mu, the numbers of a code."""
        return self._config.code_size

    def encode(self, points: Float[Tensor, "n p 3"]) -> Float[Tensor, "n mu"]:
        """Codes of sets of points, whatever the order of the points.

        Args:
            points: Each row is one set, in the unit and the frame of its primitive.

        Returns:
            Codes of length 1.

        Raises:
            ShapeError: If they are not (n, p, 3) with at least one point a set.
            InputError: If this has a decoder only.
        """
        check_shape("points", points, (None, None, 3))
        if points.shape[1] == 0:
            raise ShapeError(f"points: expected a point in each set, got {tuple(points.shape)}.")
        if self.encoder is None:
            raise InputError("points: expected shapes with an encoder, got a decoder alone.")
        found = self.encoder.last(self.encoder.hidden(points).amax(dim=1))
        return functional.normalize(found, dim=1)

    def decode(self, codes: Float[Tensor, "n mu"]) -> Float[Tensor, "n 42 3"]:
        """Vertices of deformed icospheres; their faces are those of `template`.

        Args:
            codes: Of any length but 0: they are brought to length 1.

        Returns:
            Vertices in the unit of the primitive, in the order of `template`.

        Raises:
            ShapeError: If codes are not (n, mu).
        """
        check_shape("codes", codes, (None, self.code_size))
        unit = functional.normalize(codes, dim=1)
        offsets = self.decoder.last(self.decoder.hidden(unit))
        return self.vertices + offsets.unflatten(1, (VERTICES, 3))


def with_tensors(shapes: ShapeAutoEncoder, state: Mapping[str, Tensor]) -> ShapeAutoEncoder:
    """An auto-encoder that was made without memory (on ``meta``), with its tensors."""
    shapes.load_state_dict(dict(state), strict=True, assign=True)
    return shapes


# Distances between sets of points, and points on meshes to measure them with.


Distance = Literal["squared", "euclidean"]


@boundary
def chamfer(
    a: Float[Tensor, "n p 3"], b: Float[Tensor, "n q 3"], *, distance: Distance = "squared"
) -> Float[Tensor, "n"]:
    r"""Chamfer distance between sets of points, set by set, differentiable in both.

    .. math:: \frac{1}{p} \sum_{x \in a} \min_{y \in b} d(x, y)
        + \frac{1}{q} \sum_{y \in b} \min_{x \in a} d(x, y)

    Args:
        a: One set a row, at least one point each.
        b: As many sets.
        distance: d is the squared distance, as published, or the distance itself.

    Raises:
        ShapeError: If the sets are not as many, or empty.
    """
    check_choice("distance", distance, ("squared", "euclidean"))
    check_shape("a", a, (None, None, 3))
    check_shape("b", b, (len(a), None, 3))
    if not a.shape[1] or not b.shape[1]:
        raise ShapeError(
            f"a, b: expected points in each set, got {tuple(a.shape)} and {tuple(b.shape)}."
        )
    with torch.no_grad():
        # |x - y|^2 without |x|^2 chooses y; the distances themselves are of differences, exact.
        products = a @ b.transpose(1, 2)
        nearest_b = (products - 0.5 * b.square().sum(dim=-1)[:, None]).argmax(dim=2)
        nearest_a = (products - 0.5 * a.square().sum(dim=-1)[:, :, None]).argmax(dim=1)
    return _mean_to(a, b, nearest_b, distance) + _mean_to(b, a, nearest_a, distance)


def _mean_to(a: Tensor, b: Tensor, nearest: Tensor, distance: Distance) -> Float[Tensor, "n"]:
    found = torch.gather(b, 1, nearest.unsqueeze(-1).expand(-1, -1, 3))
    if distance == "euclidean":
        return torch.linalg.vector_norm(a - found, dim=-1).mean(dim=1)
    return (a - found).square().sum(dim=-1).mean(dim=1)


# Codes that are wanted: that of the sphere, and those between two others.


_SEED = 7
_DRAWN, _KEPT, _STEPS, _RATE = 512, 4, 150, 0.03


def sphere_code(shapes: ShapeAutoEncoder) -> Float[Tensor, "mu"]:
    """The code of length 1 whose shape is nearest to the sphere; the same for the same weights.

    Nearest is the least Chamfer distance between vertices and middles of faces of the shape, and
    those of the template. Descent starts from the best of fixed codes, drawn evenly over their
    sphere, and from what the encoder makes of the template.
    """
    device = shapes.vertices.device
    wanted = _points(shapes.vertices[None], shapes)

    def far(codes: Tensor) -> Float[Tensor, "n"]:
        return chamfer(_points(shapes.decode(codes), shapes), wanted.expand(len(codes), -1, -1))

    generator = torch.Generator().manual_seed(_SEED)
    codes = torch.randn(_DRAWN, shapes.code_size, generator=generator).to(device)
    with torch.no_grad():
        if shapes.encoder is not None:
            codes = torch.cat((shapes.encode(wanted), codes))
        codes = functional.normalize(codes[far(codes).argsort(stable=True)[:_KEPT]], dim=1)
    with torch.enable_grad():
        codes.requires_grad_()
        optimiser = torch.optim.Adam([codes], lr=_RATE)
        for step in range(_STEPS):
            for group in optimiser.param_groups:
                group["lr"] = _RATE * (1 - step / _STEPS)
            optimiser.zero_grad()
            far(codes).sum().backward(inputs=[codes])
            optimiser.step()
    with torch.no_grad():
        found = functional.normalize(codes.detach(), dim=1)
        return found[far(found).argmin()].clone()


def _points(vertices: Float[Tensor, "n 42 3"], shapes: ShapeAutoEncoder) -> Tensor:
    """Vertices and middles of faces."""
    return torch.cat((vertices, vertices[:, shapes.faces].mean(dim=2)), dim=1)
