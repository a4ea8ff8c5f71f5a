"""RandLA-Net with its decoder, batches of points and files of encoders: what trains the encoder.

`scripts/train_point_network` has the recipe; `splatseg.methods.cosseg` has the encoder.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from splatseg.core.boundary import boundary
from splatseg.core.json_values import plain_object
from splatseg.errors import InputError
from splatseg.io.json_files import json_text
from splatseg.io.tensor_table import COUNTER
from splatseg.io.tensors import write_tensors
from splatseg.methods.cosseg.checkpoint import FORMAT, VERSION
from splatseg.methods.cosseg.network import RandlaEncoder, SharedMlp
from splatseg.methods.cosseg.pyramid import PointInputs, PointPyramid, RandlaConfig

_HEAD = (64, 32)
"""Channels of the head's two layers."""
_DROPPED = 0.5
"""Share of channels that the head drops while training."""


class RandlaNet(nn.Module):
    """RandLA-Net (Hu et al. 2020, figure 7): logits of points.

    The decoder goes from the last level to level 0. At each step features go from the nearest
    point of the coarser level to the points of the finer one, stand behind what the encoder
    found there (a skip), and pass one layer. The head's two layers, drop-out and a linear layer
    follow.

    Args:
        config: Its shape.

    Example:
        >>> from splatseg.methods.cosseg.pyramid import PyramidOptions, point_pyramid
        >>> config = RandlaConfig(inputs=3, widths=(4, 8), neighbours=4, ratios=(2, 2), classes=5)
        >>> points = torch.rand(64, 3)
        >>> options = PyramidOptions(neighbours=4, ratios=(2, 2))
        >>> pyramid = point_pyramid(points, options=options, seed=0)
        >>> RandlaNet(config).eval()(pyramid, points).shape
        torch.Size([64, 5])
    """

    @boundary
    def __init__(self, config: RandlaConfig) -> None:
        super().__init__()
        self.config = config
        self.encoder = RandlaEncoder(config)
        widths = config.level_widths
        self.middle = SharedMlp(widths[-1], widths[-1])
        # A step ends with as many channels as its skip has.
        befores = (widths[-1], *widths[-2:0:-1])
        self.steps = nn.ModuleList(
            SharedMlp(skip + before, skip)
            for skip, before in zip(widths[-2::-1], befores, strict=True)
        )
        self.head = nn.Sequential(
            SharedMlp(widths[0], _HEAD[0]),
            SharedMlp(*_HEAD),
            nn.Dropout(_DROPPED),
            nn.Linear(_HEAD[1], config.classes),
        )

    @boundary
    def forward(
        self, pyramid: PointPyramid, inputs: Float[Tensor, "n channels"]
    ) -> Float[Tensor, "n classes"]:
        """Logits of the classes of each point.

        Args:
            pyramid: The points, see `RandlaEncoder.forward`.
            inputs: Channels of each point.

        Raises:
            ShapeError: If `inputs` has not a row a point or the wrong channels.
            RangeError: If a value is not finite.
            InputError: If the pyramid has another number of levels.
        """
        levels = self.encoder(pyramid, inputs)
        features = self.middle(levels[-1])
        for step, skip, up in zip(
            self.steps, reversed(levels[:-1]), reversed(pyramid.up), strict=True
        ):
            features = step(torch.cat((skip, features[up]), dim=1))
        return self.head(features)


@boundary
def join_pyramids(pyramids: Sequence[PointPyramid]) -> PointPyramid:
    """Several pyramids as one, for a batch: no point sees a point of another one.

    Args:
        pyramids: At least one, of the same options. Rows of level 0 follow each other.

    Raises:
        InputError: If there is none, or their levels or neighbours differ in number.
    """
    if not pyramids:
        raise InputError("pyramids: expected at least one, got none.")
    shapes = sorted({tuple(near.shape[1] for near in one.neighbours) for one in pyramids})
    if len(shapes) > 1:
        raise InputError(
            "pyramids: expected the same levels with as many neighbours, got neighbours "
            f"{' and '.join(str(list(shape)) for shape in shapes)}."
        )
    starts = np.cumsum([[0] * (len(shapes[0]) + 1), *(p.sizes for p in pyramids)], axis=0)[:-1]

    def joined(name: str, ahead: int, level: int) -> Tensor:
        """A field at a level, of which the values are rows of the level so many ahead."""
        parts = (getattr(one, name)[level] for one in pyramids)
        shifts = (int(start[level + ahead]) for start in starts)
        return torch.cat([part + shift for part, shift in zip(parts, shifts, strict=True)])

    levels = range(len(shapes[0]))
    return PointPyramid(
        positions=torch.cat([one.positions for one in pyramids]),
        kept=tuple(joined("kept", -level, level) for level in range(len(shapes[0]) + 1)),
        neighbours=tuple(joined("neighbours", 0, level) for level in levels),
        pool=tuple(joined("pool", 0, level) for level in levels),
        up=tuple(joined("up", 1, level) for level in levels),
    )


@boundary
def save_point_encoder(
    encoder: RandlaEncoder, path: Path, *, inputs: PointInputs, facts: Mapping[str, Any]
) -> None:
    """Write an encoder: matrices as float16, the rest as float32, and the facts in the header.

    One of the published shape takes 5.9 MB. `load_point_encoder` is the inverse, but for the
    rounding of matrices.

    Args:
        encoder: As it is trained.
        path: The file, ``.safetensors``.
        inputs: How it was fed.
        facts: How it was trained: values that JSON holds.

    Raises:
        InputError: If a weight is not finite or too large for float16, or the facts hold
            something that JSON has no word for.
        OutputError: If it cannot be written.
    """
    state = {
        name: _halved(name, tensor) if tensor.ndim == 2 else tensor.float()
        for name, tensor in encoder.state_dict().items()
        if not name.endswith(COUNTER)
    }
    content = {
        "part": "encoder",
        "config": asdict(encoder.config),
        "inputs": asdict(inputs),
        "recipe": plain_object("facts", facts),
    }
    metadata = {"format": FORMAT, "version": VERSION, "about": json_text("facts", content)}
    write_tensors(state, path, metadata=metadata)


def _halved(name: str, tensor: Tensor) -> Tensor:
    half = tensor.half()
    if not bool(torch.isfinite(half).all()):
        raise InputError(
            f"encoder: {name}: expected weights that float16 holds, "
            f"got {float(tensor.abs().max()):g}."
        )
    return half
