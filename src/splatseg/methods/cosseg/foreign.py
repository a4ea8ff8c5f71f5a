"""Encoders out of the tensors of other implementations of RandLA-Net: their names and orders.

Names and orders are those of their sources; no file of theirs was at hand:

    open3d          isl-org/Open3D-ML, ml3d/torch, since January 2022
    open3d-2020     the same before
    ari0u           aRI0U/RandLA-Net-pytorch
    tsunghan-wu     tsunghan-wu/RandLA-Net-pytorch and its origin, qiqihaer/RandLA-Net-pytorch

In what their networks differ is a `RandlaVariant`; orders are undone by
`foreign_encoder`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor, nn

from splatseg.errors import FileFormatError
from splatseg.io.foreign import made_from
from splatseg.io.tensor_table import COUNTER, TensorTable, with_state
from splatseg.methods.cosseg.network import RandlaEncoder, SharedMlp
from splatseg.methods.cosseg.pyramid import MAX_LEVELS, PointInputs, RandlaConfig, RandlaVariant

_CONCATENATED = (9, 6, 7, 8, 0, 1, 2, 3, 4, 5)
"""Where distance, offset, point and neighbour are in the paper's order: point, neighbour, offset,
distance."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Layout:
    """Tensors of one implementation."""

    name: str
    """What it is called here and in messages."""

    signature: tuple[str, str]
    """Tensors that only its files have both of."""

    start: str
    """The first linear layer."""

    start_norms: tuple[str, ...]
    """Its batch norm, as different versions call it."""

    block: str
    """What tensors of a block begin with; ``{}`` is its number."""

    layers: Mapping[str, str]
    """Layers of a block, by what `ResidualBlock` calls them."""

    scores: Mapping[str, str]
    """The same of the linear maps of attention."""

    linear: str = ".conv"
    """Between a layer and ``.weight`` and ``.bias`` of its linear map."""

    norm: str
    """Between a layer and ``.weight``, ``.bias``, ``.running_mean`` and ``.running_var``."""

    plain: tuple[str, ...] = ()
    """Layers without a batch norm, by our name."""

    bias_optional: bool = False
    """Whether linear maps before a batch norm may have no bias."""

    copies: tuple[str, ...] = ()
    """Ends of names of second copies."""

    rest: tuple[str, ...]
    """What tensors of the decoder and the head begin with."""

    encoding_order: tuple[int, ...] = tuple(range(10))
    """Where distance, offset, point and neighbour are among the ten channels."""

    features_first: bool = True
    """Whether features stand before encodings where they are concatenated."""

    variant: RandlaVariant = field(default_factory=RandlaVariant)
    """In what the network differs."""

    colour_inputs: PointInputs
    """How a network with colours is fed, as it is trained for S3DIS."""

    plain_inputs: PointInputs
    """How one without is fed, as it is trained for SemanticKITTI."""


_MODULES = {
    "entry": "mlp1",
    "encode1": "lse1.mlp",
    "pool1.mlp": "pool1.mlp",
    "encode2": "lse2.mlp",
    "pool2.mlp": "pool2.mlp",
    "exit": "mlp2",
    "shortcut": "shortcut",
}
_SCORES = {"pool1.score": "pool1.score_fn.0", "pool2.score": "pool2.score_fn.0"}
_RAW_COLOURS = PointInputs(grid_size=0.04, origin="floor", colour_range=255.0)
_UNIT_COLOURS = PointInputs(grid_size=0.04)
_STREET = PointInputs(grid_size=0.06)

LAYOUTS = (
    Layout(
        name="open3d",
        signature=("fc0.weight", "encoder.0.lse1.mlp.conv.weight"),
        start="fc0",
        start_norms=("bn0",),
        block="encoder.{}.",
        layers=_MODULES,
        scores=_SCORES,
        norm=".batch_norm",
        rest=("mlp.", "decoder.", "fc1."),
        # Its last LeakyReLU is torch's default, the others have the authors' slope.
        variant=RandlaVariant(sum_slope=0.01),
        colour_inputs=_RAW_COLOURS,
        plain_inputs=_STREET,
    ),
    Layout(
        name="open3d-2020",
        signature=("fc0.weight", "Encoder_layer_0LFAmlp1.conv.weight"),
        start="fc0",
        start_norms=("batch_normalization",),
        block="Encoder_layer_{}",
        layers={
            "entry": "mlp1",
            "encode1": "LFAmlp1",
            "pool1.mlp": "LFAatt_pooling_1mlp",
            "encode2": "LFAmlp2",
            "pool2.mlp": "LFAatt_pooling_2mlp",
            "exit": "mlp2",
            "shortcut": "shortcut",
        },
        scores={"pool1.score": "LFAatt_pooling_1fc", "pool2.score": "LFAatt_pooling_2fc"},
        norm=".batch_normalization",
        copies=(".weights", ".biases"),
        rest=("decoder_0.", "Decoder_layer_", "fc1.", "fc2.", "fc."),
        colour_inputs=_RAW_COLOURS,
        plain_inputs=_STREET,
    ),
    Layout(
        name="ari0u",
        signature=("fc_start.weight", "encoder.0.lse1.mlp.conv.weight"),
        start="fc_start",
        start_norms=("bn_start.0", "bn_start"),
        block="encoder.{}.",
        layers=_MODULES,
        scores=_SCORES,
        norm=".batch_norm",
        plain=("entry", "exit"),
        rest=("mlp.", "decoder.", "fc_end."),
        encoding_order=_CONCATENATED,
        features_first=False,
        # Its search returns squared distances, and features are not those of neighbours.
        variant=RandlaVariant(
            distance="squared",
            second_encoding="direct",
            paired_features="own",
            sampling="own",
            slope=0.0,
            sum_slope=0.01,
        ),
        colour_inputs=_UNIT_COLOURS,
        plain_inputs=_UNIT_COLOURS,
    ),
    Layout(
        name="tsunghan-wu",
        signature=("fc0.conv.weight", "dilated_res_blocks.0.lfa.mlp1.conv.weight"),
        start="fc0.conv",
        start_norms=("fc0.bn.bn",),
        block="dilated_res_blocks.{}.",
        layers={
            "entry": "mlp1",
            "encode1": "lfa.mlp1",
            "pool1.mlp": "lfa.att_pooling_1.mlp",
            "encode2": "lfa.mlp2",
            "pool2.mlp": "lfa.att_pooling_2.mlp",
            "exit": "mlp2",
            "shortcut": "shortcut",
        },
        scores={"pool1.score": "lfa.att_pooling_1.fc", "pool2.score": "lfa.att_pooling_2.fc"},
        norm=".bn.bn",
        bias_optional=True,
        rest=("decoder_0.", "decoder_blocks.", "fc1.", "fc2.", "fc3."),
        colour_inputs=_UNIT_COLOURS,
        plain_inputs=_STREET,
    ),
)
"""Layouts that are read besides our own."""


_RATIOS = {5: (4, 4, 4, 4, 2)}
"""Ratios of networks of so many levels in the public configurations; otherwise they are 4."""


def layout_of(tensors: Mapping[str, Tensor], path: Path) -> Layout:
    """Whose tensors these are, by their names.

    Raises:
        FileFormatError: If nobody's that is known.
    """
    found = [one for one in LAYOUTS if all(name in tensors for name in one.signature)]
    if len(found) == 1:
        return found[0]
    known = "; ".join(f"{one.name}: {', '.join(one.signature)}" for one in LAYOUTS)
    raise FileFormatError(
        f"{path}: expected a RandLA-Net of splatseg, or tensors of a known layout ({known}), "
        "got other ones."
    )


def foreign_encoder(tensors: Mapping[str, Tensor], path: Path, layout: Layout) -> RandlaEncoder:
    """The encoder of a file in a layout. Tensors of decoder and head are not looked at.

    Neighbours and ratios, which such a file does not hold, are those of the public
    configurations: 16, and 4, 4, 4, 4, 2 of five levels or 4 at every level of others.

    Raises:
        FileFormatError: If a tensor is missing, has another shape or is none of the layout's.
    """
    table = TensorTable(tensors, path)
    config = _config(table, layout, path)
    with torch.device("meta"):
        encoder = RandlaEncoder(config)
    state: dict[str, Tensor] = {}
    for name, module in encoder.named_modules():
        if isinstance(module, SharedMlp):
            found = _layer(table, layout, name, module)
            state |= {f"{name}.{key}": value for key, value in found.items()}
        elif isinstance(module, nn.Linear) and name.endswith(".score"):
            state[f"{name}.weight"] = _score(table, layout, name, module)
    table.check_none_left(layout.rest)
    return with_state(encoder, state)


def _config(table: TensorTable, layout: Layout, path: Path) -> RandlaConfig:
    entry = layout.layers["entry"]
    widths: list[int] = []
    for level in range(MAX_LEVELS + 1):
        block = layout.block.format(level)
        if not any(name.startswith(block) for name in table.names()):
            break
        half, _ = table.matrix_shape(f"{block}{entry}{layout.linear}.weight")
        widths.append(2 * half)
    first, inputs = table.matrix_shape(f"{layout.start}.weight")
    with made_from(path):
        return RandlaConfig(
            inputs=cast("Any", inputs),
            first_width=first,
            widths=tuple(widths),
            ratios=_RATIOS.get(len(widths), (4,) * len(widths)),
            variant=layout.variant,
        )


def _layer(table: TensorTable, layout: Layout, name: str, module: SharedMlp) -> dict[str, Tensor]:
    """The tensors of one of our layers."""
    linear, norm = _names(table, layout, name)
    outputs, inputs = module.linear.weight.shape
    weight = table.take(f"{linear}.weight", (outputs, inputs))
    bias = torch.zeros(outputs)
    if f"{linear}.bias" in table or not layout.bias_optional:
        bias = table.take(f"{linear}.bias", (outputs,))
    if norm is None:
        scale, shift, mean = torch.ones(outputs), torch.zeros(outputs), torch.zeros(outputs)
        variance = torch.full((outputs,), 1 - module.norm.eps)
    else:
        scale, shift, mean = (
            table.take(f"{norm}.{key}", (outputs,)) for key in ("weight", "bias", "running_mean")
        )
        variance = table.take_variances(f"{norm}.running_var", outputs)
        table.leave(f"{norm}.{COUNTER}")
    return {
        "linear.weight": _reordered(weight, layout, name.split(".", 2)[-1]),
        "linear.bias": bias,
        "norm.weight": scale,
        "norm.bias": shift,
        "norm.running_mean": mean,
        "norm.running_var": variance,
        f"norm.{COUNTER}": torch.zeros((), dtype=torch.int64),
    }


def _names(table: TensorTable, layout: Layout, name: str) -> tuple[str, str | None]:
    """What the linear map and the batch norm of one of our layers are called."""
    if name == "start":
        known = (one for one in layout.start_norms if f"{one}.weight" in table)
        return layout.start, next(known, layout.start_norms[0])
    _, level, ours = name.split(".", 2)
    layer = layout.block.format(level) + layout.layers[ours]
    for end in layout.copies:
        table.leave(f"{layer}{end}")
    return f"{layer}{layout.linear}", None if ours in layout.plain else f"{layer}{layout.norm}"


def _reordered(weight: Tensor, layout: Layout, ours: str) -> Tensor:
    """A layer with its columns in our order."""
    of_ten = ours == "encode1" or layout.variant.second_encoding == "direct"
    if ours in ("encode1", "encode2") and of_ten:
        return weight[:, list(layout.encoding_order)]
    if ours in ("pool1.mlp", "pool2.mlp") and not layout.features_first:
        return _halves_swapped(weight, 1)
    return weight


def _score(table: TensorTable, layout: Layout, name: str, module: nn.Linear) -> Tensor:
    """A linear map of attention. Its bias, the same for all neighbours, has no effect."""
    _, level, ours = name.split(".", 2)
    theirs = layout.block.format(level) + layout.scores[ours]
    width = module.in_features
    if f"{theirs}.bias" in table:
        table.take(f"{theirs}.bias", (width,))
    weight = table.take(f"{theirs}.weight", (width, width))
    if layout.features_first:
        return weight
    return _halves_swapped(_halves_swapped(weight, 0), 1)


def _halves_swapped(weight: Tensor, axis: int) -> Tensor:
    return weight.roll(weight.shape[axis] // 2, axis)
