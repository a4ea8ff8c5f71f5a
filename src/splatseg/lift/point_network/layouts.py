"""What public implementations of RandLA-Net call an encoder's tensors, and in which order.

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

from splatseg.lift.point_network.config import RandlaVariant
from splatseg.lift.point_network.inputs import PointInputs

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
