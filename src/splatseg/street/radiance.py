"""How a field on primitives is made and trained."""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import torch
from jaxtyping import Float
from msgspec import Meta
from torch import Tensor, nn
from torch.nn import functional

from splatseg._check import check_finite, check_shape
from splatseg.core.boundary import boundary
from splatseg.core.options import Count, Natural, NonNegative, Positive, options
from splatseg.errors import InputError, RangeError
from splatseg.street.hits import MAX_HITS, Sides
from splatseg.street.primitives import PrimitiveMesh

Order = Literal["distance", "levels"]

MAX_WIDTH = 4096
"""Channels that a layer may have; a file that asks for more is not believed."""
MAX_DEPTH = 32
MAX_FREQUENCIES = 16

Width = Annotated[int, Meta(ge=1, le=MAX_WIDTH)]
Frequencies = Annotated[int, Meta(ge=0, le=MAX_FREQUENCIES)]

_POSITION_SCALE = 20.0
"""Length that is 1 in the encoding of positions, in voxels of the finest level."""


@options(
    removed={
        "position_scale": "the encoding's unit is 20 voxels of the finest level",
        "view_encoding": "colour knows the product of normal and direction",
        "background": "what is behind all triangles is a network of the direction",
        "final_rate": "a tenth of the rates is left at the last step",
        "longest": "photographs are reduced as in a fit",
        "view_pixels": "all pixels of a view are learnt from",
        "cache_memory": "hits of more than 1 GiB lie in temporary files",
    }
)
class RadianceOptions:
    """Sizes of the networks, what a ray is made of, and how training goes.

    The defaults are sized for two cores, about 65 ms of CPU a step (docs/decisions/streets.md);
    `PUBLISHED_RADIANCE` are those of the papers.
    """

    feature_size: Width = 16
    """lambda, learnable numbers of a vertex."""

    feature_frequencies: Frequencies = 0
    """Octaves of sine and cosine of interpolated features; 0 gives the features alone."""

    position_frequencies: Frequencies = 6
    """Octaves of sine and cosine of positions; 0 gives the positions alone."""

    view_frequencies: Frequencies = 4
    """Octaves of sine and cosine of the product of normal and direction, which is what colour
    knows of the view, and of the background's directions."""

    width: Width = 64
    """Channels of the hidden layers that opacity, classes and colour share."""

    depth: Annotated[int, Meta(ge=1, le=MAX_DEPTH)] = 3
    """How many of them there are."""

    skip: Natural = 0
    """The layer (from 1) that is given the encoded input once more; 0 is none."""

    semantic_width: Annotated[int, Meta(ge=0, le=MAX_WIDTH)] = 32
    """Channels of the hidden layer before the classes; 0 is none."""

    colour_widths: tuple[Width, ...] = (32,)
    """Channels of the hidden layers before the colour."""

    background_widths: tuple[Width, ...] = (32, 32)
    """Channels of the hidden layers of the background's network."""

    order: Order = "distance"
    """How the triangles of a ray stand behind each other: nearest first, or all of a finer level
    before those of a coarser one, as the public code of DNMP has it."""

    max_hits: Annotated[int, Meta(ge=1, le=MAX_HITS)] = 4
    """L, triangles of a ray that are kept."""

    fine_hits: Annotated[int, Meta(ge=0, le=MAX_HITS)] | None = 3
    """Triangles of the finest level that are kept; None is `max_hits`."""

    coarse_hits: Annotated[int, Meta(ge=0, le=MAX_HITS)] | None = 1
    """Triangles of each other level that are kept; None is `max_hits`."""

    sides: Sides = "front"
    """Whether a ray has triangles that it meets from inside their primitive, as published: what is
    behind a wall is then reached by half as many of its hits."""

    rays: Count = 4096
    """Rays of a step."""

    iterations: Count = 10_000
    """Steps."""

    rate: Positive = 2e-3
    """Adam's rate of the networks at the start."""

    feature_rate: Positive = 2e-2
    """Adam's rate of the features at the start; each vertex has a clock of its own."""

    semantic_weight: NonNegative = 0.3
    """w, weight of the cross-entropy beside the squared colour error (eq. 8); published 0.1, with
    which labels of small things come late."""

    def __post_init__(self) -> None:
        for name in ("colour_widths", "background_widths"):
            if len(getattr(self, name)) > MAX_DEPTH:
                raise RangeError(f"{name}: expected at most {MAX_DEPTH} layers.")
        if self.skip > self.depth:
            raise RangeError(f"skip: expected at most {self.depth}, the depth, got {self.skip}.")
        if self.fine_hits == 0 and self.coarse_hits == 0:
            raise RangeError("fine_hits, coarse_hits: expected a triangle of some level, got 0.")


PUBLISHED_RADIANCE = RadianceOptions(
    feature_size=3,
    feature_frequencies=3,
    width=256,
    depth=8,
    skip=5,
    semantic_width=128,
    colour_widths=(256, 256),
    background_widths=(256, 256),
    order="levels",
    max_hits=6,
    fine_hits=4,
    coarse_hits=2,
    sides="both",
    semantic_weight=0.1,
    iterations=50_000,
    rate=5e-4,
    feature_rate=5e-4,
)
"""Batches and steps of the paper (4096 rays, 50 000), and the networks of DNMP's public code: 8
layers of 256, the input again after the fourth, 21 numbers of encoded features a vertex. The public
code's rates of features and of the networks are one."""


# Positional encoding, and the perceptrons that are given it.


def encoded_size(size: int, frequencies: int) -> int:
    """Numbers of what `encode` returns.

    Example:
        >>> encoded_size(3, 6)
        39
    """
    return size * (1 + 2 * frequencies)


def encode(values: Float[Tensor, "n d"], frequencies: int) -> Float[Tensor, "n e"]:
    r"""Values with their sines and cosines at octaves.

    .. math:: (x, \sin x, \sin 2 x, \ldots, \sin 2^{L - 1} x, \cos x, \ldots, \cos 2^{L - 1} x)

    References:
        Mildenhall et al., NeRF (ECCV 2020), section 5.1, with the values themselves as in its code.
    """
    if not frequencies:
        return values
    octaves = 2.0 ** torch.arange(frequencies, dtype=values.dtype, device=values.device)
    angles = (values[:, None, :] * octaves[:, None]).flatten(1)
    return torch.cat((values, angles.sin(), angles.cos()), dim=1)


class Layers(nn.Module):
    """Linear layers with ReLUs between them, none after the last.

    Args:
        widths: Channels before the first layer, and after each.
    """

    def __init__(self, widths: Sequence[int]) -> None:
        super().__init__()
        self.layers = nn.ModuleList(nn.Linear(*pair) for pair in itertools.pairwise(widths))

    def forward(self, x: Float[Tensor, "n a"]) -> Float[Tensor, "n b"]:
        """The last layer's channels."""
        for layer in self.layers[:-1]:
            x = functional.relu(layer(x), inplace=True)
        return self.layers[-1](x)


class Trunk(nn.Module):
    """Linear layers with a ReLU after each, one of which is given the input once more.

    Args:
        size: Numbers of the input.
        width: Channels after each layer.
        depth: How many layers there are.
        skip: The layer (from 1) that is given the input beside the channels; 0 is none.
    """

    def __init__(self, size: int, *, width: int, depth: int, skip: int) -> None:
        super().__init__()
        self._skip = skip
        widths = [size] + [width] * (depth - 1)
        if skip > 1:
            widths[skip - 1] += size
        self.layers = nn.ModuleList(nn.Linear(before, width) for before in widths)

    def forward(self, x: Float[Tensor, "n a"]) -> Float[Tensor, "n b"]:
        """The last layer's channels."""
        hidden = x
        for number, layer in enumerate(self.layers, start=1):
            if number == self._skip > 1:
                hidden = torch.cat((hidden, x), dim=1)
            hidden = functional.relu(layer(hidden), inplace=True)
        return hidden


# The field of eq. 4: :math:`(\sigma_j, c_j, k_j) = F_\theta(x_j, f_j, d_j)`.
#
# As in Semantic-NeRF, opacity and classes depend on the place alone, colour also on the view; a
# softmax makes probabilities of the classes before anything is composited.
#
# References:
#     Zhi et al., In-Place Scene Labelling (Semantic-NeRF, ICCV 2021).
#     Lu et al., Urban Radiance Field Representation with Deformable Neural Mesh Primitives (ICCV
#     2023).


_VERTICES = 1 << 15
"""Vertices that are looked at together."""

_SMALL = 0.1
"""Standard deviation of features before training."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FieldOutputs:
    """What the field says of points on primitives."""

    opacity: Float[Tensor, "n"]
    """sigma, the probability that a ray ends there, in [0, 1]."""

    colour: Float[Tensor, "n 3"]
    """Red, green, blue, in [0, 1]."""

    probabilities: Float[Tensor, "n k"]
    """Of the classes; rows add up to 1."""


class RadianceModel(nn.Module):
    """Features of vertices, the networks that read them, and what is behind all primitives.

    Args:
        mesh: The primitives whose vertices carry features. It is not kept.
        ids: Ids of the classes, distinct; column j of probabilities is of ``ids[j]``.
        options: Sizes and encodings.
        seed: Of the weights and features at the start.

    Raises:
        InputError: If there is no class, an id is negative, or one comes twice.
    """

    features: Tensor
    centre: Tensor
    scale: Tensor

    def __init__(
        self,
        mesh: PrimitiveMesh,
        ids: tuple[int, ...],
        options: RadianceOptions,
        *,
        seed: int = 0,
    ) -> None:
        super().__init__()
        self._ids = checked_ids(ids)
        self._options = options
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self._make_layers(options, len(self._ids))
            features = _SMALL * torch.randn(len(mesh.vertices), options.feature_size)
        self.features = nn.Parameter(features)
        middle = mesh.vertices.double().mean(dim=0).float() if len(mesh) else torch.zeros(3)
        self.register_buffer("centre", middle)
        self.register_buffer("scale", torch.tensor(_POSITION_SCALE * mesh.sizes[0]))

    def _make_layers(self, options: RadianceOptions, classes: int) -> None:
        size = encoded_size(3, options.position_frequencies)
        size += encoded_size(options.feature_size, options.feature_frequencies)
        width, view = options.width, encoded_size(3, options.view_frequencies)
        self.trunk = Trunk(size, width=width, depth=options.depth, skip=options.skip)
        self.opacity = nn.Linear(width, 1)
        hidden = (options.semantic_width,) if options.semantic_width else ()
        self.semantic = Layers((width, *hidden, classes))
        self.colour = Layers((width + view, *options.colour_widths, 3))
        self.background = Layers((view, *options.background_widths, 3 + classes))

    @property
    def ids(self) -> tuple[int, ...]:
        """Id of each column of probabilities."""
        return self._ids

    @property
    def options(self) -> RadianceOptions:
        """Sizes, encodings, and how it was trained."""
        return self._options

    def hidden(
        self, positions: Float[Tensor, "n 3"], features: Float[Tensor, "n f"]
    ) -> Float[Tensor, "n width"]:
        """What opacity, classes and colour are read from."""
        options = self._options
        places = (positions - self.centre) / self.scale
        parts = (
            encode(features, options.feature_frequencies),
            encode(places, options.position_frequencies),
        )
        return self.trunk(torch.cat(parts, dim=1))

    def opacity_of(self, hidden: Float[Tensor, "n width"]) -> Float[Tensor, "n"]:
        """Opacity, sigma."""
        return self.opacity(hidden)[:, 0].sigmoid()

    def probabilities_of(self, hidden: Float[Tensor, "n width"]) -> Float[Tensor, "n k"]:
        """Probabilities of classes, k."""
        # Several times quicker along columns than along short rows.
        return self.semantic(hidden).T.contiguous().softmax(dim=0).T

    def colour_of(
        self,
        hidden: Float[Tensor, "n width"],
        directions: Float[Tensor, "n 3"],
        normals: Float[Tensor, "n 3"],
    ) -> Float[Tensor, "n 3"]:
        """Colour, c, seen along unit directions."""
        view = encode(directions * normals, self._options.view_frequencies)
        return self.colour(torch.cat((hidden, view), dim=1)).sigmoid()

    def outputs(
        self,
        positions: Float[Tensor, "n 3"],
        features: Float[Tensor, "n f"],
        directions: Float[Tensor, "n 3"],
        normals: Float[Tensor, "n 3"],
    ) -> FieldOutputs:
        """Eq. 4 at points on primitives.

        Args:
            positions: World, scene units.
            features: Interpolated at these points (eq. 3).
            directions: Of the rays that meet them, of length 1.
            normals: Of the triangles, of length 1.
        """
        hidden = self.hidden(positions, features)
        return FieldOutputs(
            opacity=self.opacity_of(hidden),
            colour=self.colour_of(hidden, directions, normals),
            probabilities=self.probabilities_of(hidden),
        )

    def background_of(
        self, directions: Float[Tensor, "n 3"]
    ) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n k"]]:
        """Colour and probabilities of what is seen along unit directions behind all primitives."""
        found = self.background(encode(directions, self._options.view_frequencies))
        return found[:, :3].sigmoid(), found[:, 3:].softmax(dim=1)

    @boundary
    def vertex_outputs(
        self, mesh: PrimitiveMesh
    ) -> tuple[Float[Tensor, "v"], Float[Tensor, "v k"]]:
        """Opacity and probabilities at all vertices, which eq. 9 asks for.

        Args:
            mesh: The primitives that the field was trained on.

        Raises:
            ShapeError: If it has another number of vertices.
        """
        check_shape("mesh.vertices", mesh.vertices, (len(self.features), 3))
        opacity = torch.empty(len(mesh.vertices))
        probabilities = torch.empty(len(mesh.vertices), len(self._ids))
        with torch.no_grad():
            for begin in range(0, len(mesh.vertices), _VERTICES):
                part = slice(begin, begin + _VERTICES)
                places = mesh.vertices[part].to(self.features)
                hidden = self.hidden(places, self.features[part])
                opacity[part] = self.opacity_of(hidden).cpu()
                probabilities[part] = self.probabilities_of(hidden).cpu()
        return opacity, probabilities

    @property
    def state(self) -> dict[str, Tensor]:
        """All tensors by name, without gradients; `with_state` is the inverse."""
        return {name: tensor.detach() for name, tensor in self.state_dict().items()}

    @classmethod
    def with_state(
        cls,
        mesh: PrimitiveMesh,
        ids: tuple[int, ...],
        options: RadianceOptions,
        state: Mapping[str, Tensor],
    ) -> "RadianceModel":
        """A field with the tensors of another one's `state`.

        Raises:
            InputError: If a tensor is missing, is not known, or has another shape.
            RangeError: If a value is not finite.
        """
        model = cls(mesh, ids, options)
        wanted: Mapping[str, Any] = model.state_dict()
        if set(state) != set(wanted):
            other = sorted(set(state) ^ set(wanted))
            raise InputError(f"state: expected the tensors of the options, got others: {other}.")
        for name, tensor in state.items():
            check_shape(f"state: {name}", tensor, tuple(wanted[name].shape))
            check_finite(f"state: {name}", tensor)
        model.load_state_dict({name: tensor.float() for name, tensor in state.items()})
        return model


def checked_ids(ids: tuple[int, ...]) -> tuple[int, ...]:
    """Ids of classes, as they are.

    Raises:
        InputError: If there is none, one is negative, or one comes twice.
    """
    if not ids or min(ids) < 0 or len(set(ids)) != len(ids):
        raise InputError(f"ids: expected distinct ids of 0 or more, at least one, got {ids}.")
    return tuple(int(id) for id in ids)


# Samples of rays composited front to back: eq. 5, with what is behind them all.
#
# .. math:: \hat c_r = \sum_{j=1}^L T_j \sigma_j c_j + T_{L+1} c_{bg}, \qquad
#           T_j = \prod_{i<j} (1 - \sigma_i)
#
# `splatseg.street.radiance` is the readable twin, ray by ray.


def ray_weights(
    opacity: Float[Tensor, "n hits"],
) -> tuple[Float[Tensor, "n hits"], Float[Tensor, "n"]]:
    r"""The weights :math:`T_j \sigma_j` of the samples of rays, and what passes them all.

    Args:
        opacity: In [0, 1], front to back; 0 where a ray has no sample.
    """
    passed = torch.ones_like(opacity[:, 0])
    weights: list[Tensor] = []
    for one in opacity.unbind(dim=1):
        weights.append(passed * one)
        passed = passed * (1 - one)
    return torch.stack(weights, dim=1), passed
