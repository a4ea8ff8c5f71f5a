r"""The field of eq. 4: :math:`(\sigma_j, c_j, k_j) = F_\theta(x_j, f_j, d_j)`.

As in Semantic-NeRF, opacity and classes depend on the place alone, colour also on the view; a
softmax makes probabilities of the classes before anything is composited.

References:
    Zhi et al., In-Place Scene Labelling (Semantic-NeRF, ICCV 2021).
    Lu et al., Urban Radiance Field Representation with Deformable Neural Mesh Primitives (ICCV
    2023).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from splatseg._check import check_finite, check_shape
from splatseg.core.boundary import boundary
from splatseg.core.threads import one_torch_thread
from splatseg.errors import InputError
from splatseg.street.mesh import PrimitiveMesh
from splatseg.street.radiance.encoding import Layers, Trunk, encode, encoded_size
from splatseg.street.radiance.options import RadianceOptions

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
        self.register_buffer("scale", torch.tensor(options.position_scale * mesh.sizes[0]))

    def _make_layers(self, options: RadianceOptions, classes: int) -> None:
        size = encoded_size(3, options.position_frequencies)
        size += encoded_size(options.feature_size, options.feature_frequencies)
        width, view = options.width, encoded_size(3, options.view_frequencies)
        self.trunk = Trunk(size, width=width, depth=options.depth, skip=options.skip)
        self.opacity = nn.Linear(width, 1)
        hidden = (options.semantic_width,) if options.semantic_width else ()
        self.semantic = Layers((width, *hidden, classes))
        seen = 0 if options.view_encoding == "none" else view
        self.colour = Layers((width + seen, *options.colour_widths, 3))
        self.background = None
        if options.background != "none":
            widths = (view, *options.background_widths) if options.background == "network" else (1,)
            self.background = Layers((*widths, 3 + classes))

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
        options = self._options
        if options.view_encoding == "none":
            return self.colour(hidden).sigmoid()
        seen = directions if options.view_encoding == "view" else directions * normals
        view = encode(seen, options.view_frequencies)
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
        """Colour and probabilities of what is seen along unit directions behind all primitives.

        Without a background both are 0.
        """
        if self.background is None:
            return directions.new_zeros(len(directions), 3), directions.new_zeros(
                len(directions), len(self._ids)
            )
        if self._options.background == "constant":
            found = self.background(directions.new_ones(1, 1)).expand(len(directions), -1)
        else:
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
        with torch.no_grad(), one_torch_thread():
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
