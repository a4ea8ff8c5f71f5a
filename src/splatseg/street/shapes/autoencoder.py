"""Points to codes to deformed icospheres (eq. 1)."""

import itertools
from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional

from splatseg._check import check_shape
from splatseg.core.boundary import boundary
from splatseg.errors import InputError, ShapeError
from splatseg.street.shapes.config import PUBLISHED, ShapeConfig
from splatseg.street.shapes.template import VERTICES, template


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


@boundary
def new_shapes(config: ShapeConfig, *, seed: int) -> ShapeAutoEncoder:
    """An untrained auto-encoder; the same seed gives the same weights.

    PyTorch's own initial values, but for the last layer of the decoder, which begins so small that
    every code is a near sphere.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        shapes = ShapeAutoEncoder(config)
    with torch.no_grad():
        for parameter in shapes.decoder.layers[-1].parameters():
            parameter *= 0.1
    return shapes


def with_tensors(shapes: ShapeAutoEncoder, state: Mapping[str, Tensor]) -> ShapeAutoEncoder:
    """An auto-encoder that was made without memory (on ``meta``), with its tensors."""
    shapes.load_state_dict(dict(state), strict=True, assign=True)
    return shapes
