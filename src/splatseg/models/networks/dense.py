"""Networks that say something of every patch or pixel: features, depth, classes.

DINO, DINOv2 (with registers) and DINOv3: Caron et al. 2021 (arXiv:2104.14294), Oquab et al. 2023
(arXiv:2304.07193), Darcet et al. 2023 (arXiv:2309.16588), Simeoni et al. 2025 (arXiv:2508.10104);
CoSSegGaussians takes DINO of 2021. Depth Anything and DPT (MiDaS): Yang et al. 2024
(arXiv:2401.10891, arXiv:2406.09414), Ranftl et al. 2021 (arXiv:2103.13413). SegFormer: Xie et al.
2021 (arXiv:2105.15203).
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar, cast

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from splatseg.core import ClassTable, DepthMap, FeatureMap, LabelMap
from splatseg.core.models import DeepFeatures, Image
from splatseg.core.options import Count, Positive, options
from splatseg.core.threads import network_inference
from splatseg.errors import FileFormatError, RangeError
from splatseg.models._images import HALVES, InputSize, Normalisation, patch_grid, patch_input
from splatseg.models._weights import Loading
from splatseg.models.networks._library import BatchedNetwork, configuration, network, side_of
from splatseg.models.networks.segmenters import SemanticOptions, map_of_scores, network_classes

_CLASSES = {
    "dino": {"vit": "ViTModel"},
    "dinov2": {"dinov2": "Dinov2Model", "dinov2_with_registers": "Dinov2WithRegistersModel"},
    "dinov3": {"dinov3_vit": "DINOv3ViTModel"},
    "depth-anything": {"depth_anything": "DepthAnythingForDepthEstimation"},
    "dpt": {"dpt": "DPTForDepthEstimation"},
    "segformer": {"segformer": "SegformerForSemanticSegmentation"},
    "dpt-semantic": {"dpt": "DPTForSemanticSegmentation"},
}
"""Class of the library by family and the weights' ``model_type``."""

_COLOURS = {"dpt": HALVES, "dpt-semantic": HALVES}
"""What is done to colours where the weights do not say, if not what ImageNet's networks do."""

_DPT_SIDE = 384
_SIZES = {
    "depth-anything": InputSize(sides=(518, 518), keeps_proportions=True),
    "dpt": InputSize(sides=(_DPT_SIDE, _DPT_SIDE)),
    "segformer": InputSize(sides=(512, 512)),
    "dpt-semantic": InputSize(sides=(480, 480)),
}
"""What the input is where the weights do not tell."""

_UNUSED_OF_DPT = ("neck.fusion_stage.layers.0.residual_layer1.",)
"""The coarsest depth has nothing coarser to be added to; published weights lack it."""


@options(removed={"normalise": "features always pass the network's last normalisation"})
class DinoOptions:
    """Which blocks of the network describe patches."""

    depths: Count = 4
    """Blocks whose features are kept, spread evenly over the network; the last one always is."""


class Dino(BatchedNetwork[DeepFeatures]):
    """Features of patches of a vision transformer that learned without labels."""

    _constants: ClassVar = {"normalise": True}

    def __init__(self, name: str, options: DinoOptions, place: Loading) -> None:
        super().__init__(name, options, place)
        content = configuration(place, tuple(_CLASSES[name]))
        kind = str(content["model_type"])
        extra: dict[str, Any] = {"add_pooling_layer": False} if kind == "vit" else {}
        self._network = network(place, _CLASSES[name][kind], content, **extra)
        config = self._network.config
        self._patch = side_of(place.folder, config.patch_size)
        self._input_size = place.size or side_of(place.folder, config.image_size)
        self._tokens = 1 + int(getattr(config, "num_register_tokens", 0) or 0)
        self._positions = {"interpolate_pos_encoding": True} if kind == "vit" else {}
        self._normalisation = Normalisation.of(place.folder)
        count = int(config.num_hidden_layers)
        if options.depths > count:
            raise RangeError(
                f"depths: expected at most the {count} blocks of {place.name}, got "
                f"{options.depths} ({place.folder})."
            )
        # After every count / depths blocks: 3, 6, 9, 12 of 12.
        self._blocks = [round(count * (i + 1) / options.depths) for i in range(options.depths)]

    def features(self, image: Image) -> DeepFeatures:
        """Features after several blocks, the deepest last, and the class token."""
        return self._last.of(image)

    @override
    @network_inference()
    def _encode(self, images: Sequence[Image]) -> list[DeepFeatures]:
        height, width = (int(side) for side in images[0].shape[:2])
        grid = patch_grid(height, width, patch=self._patch, size=self._input_size)
        batch = patch_input(
            images, grid, self._normalisation, device=self._place.device, dtype=self._place.dtype
        )
        output = self._network(batch, output_hidden_states=True, **self._positions)
        states = cast("Sequence[Tensor]", output.hidden_states)  # the first came in
        wanted = self._tokens + grid.rows * grid.columns
        if states[-1].shape[1] != wanted:
            raise FileFormatError(
                f"{self._place.folder}: expected a network that gives {wanted} tokens of an image "
                f"of {grid.rows} x {grid.columns} patches, got {states[-1].shape[1]}."
            )
        norm = getattr(self._network, "layernorm", None) or self._network.norm
        tokens = [norm(states[block]) for block in self._blocks]
        return [
            DeepFeatures(
                maps=tuple(
                    FeatureMap(
                        features=one[i, self._tokens :]
                        .float()
                        .cpu()
                        .reshape(grid.rows, grid.columns, -1)
                        .contiguous(),
                        stride=grid.stride,
                        height=height,
                        width=width,
                    )
                    for one in tokens
                ),
                depths=tuple(f"block{block}" for block in self._blocks),
                class_token=tokens[-1][i, 0].float().cpu().clone(),
            )
            for i in range(len(images))
        ]


def _dpt_input_size(config: Any, folder: Path, otherwise: InputSize) -> InputSize:
    """What a network with DPT's head takes: whole patches, and squares where it has no backbone."""
    found = InputSize.of(folder, otherwise=otherwise)
    backbone = None if getattr(config, "is_hybrid", False) else config.backbone_config
    patch = side_of(folder, getattr(backbone, "patch_size", None) or config.patch_size)
    found = replace(found, multiple=math.lcm(found.multiple, patch))
    if backbone is not None:
        return found
    side = max(found.sides or (found.shortest or found.longest or _DPT_SIDE,))
    return InputSize(sides=(side, side), multiple=found.multiple, takes_squares=True)


@options
class DepthOptions:
    """Which depths count."""

    max_depth: Positive | None = None
    """Metric depth beyond this many metres counts as unknown. None keeps all; a value goes with
    weights that give metres."""


class DepthNetwork(BatchedNetwork[DepthMap]):
    """Depth of every pixel: in metres, or inverse and up to a scale and a shift."""

    def __init__(self, name: str, options: DepthOptions, place: Loading) -> None:
        super().__init__(name, options, place)
        config = configuration(place, tuple(_CLASSES[name]))
        self._network = network(
            place, _CLASSES[name][str(config["model_type"])], config, unused=_UNUSED_OF_DPT
        )
        kind = getattr(self._network.config, "depth_estimation_type", "relative")
        self._is_metric = kind == "metric"
        if options.max_depth is not None and not self._is_metric:
            raise RangeError(
                f"max_depth: expected weights that tell metres, got {place.name}, which tells "
                "inverse depth up to a scale and a shift."
            )
        tells = "metres" if self._is_metric else "inverse depth up to a scale and a shift"
        self.note = f"weights {place.name}; {tells}"
        self._max_depth = options.max_depth
        self._input_size = place.size or 0
        self._normalisation = Normalisation.of(place.folder, otherwise=_COLOURS.get(name))
        self._size = _dpt_input_size(self._network.config, place.folder, _SIZES[name])

    def depth_map(self, image: Image) -> DepthMap:
        """The depth of every pixel."""
        return self._last.of(image)

    @override
    @network_inference()
    def _encode(self, images: Sequence[Image]) -> list[DepthMap]:
        height, width = (int(side) for side in images[0].shape[:2])
        frame = self._size.frame(height, width, size=self._place.size)
        found = self._network(self._input(images, frame, mode="bicubic")).predicted_depth
        whole = F.interpolate(found[:, None].float(), (height, width), mode="bilinear")[:, 0]
        return [self._depth_map(one) for one in whole]

    def _depth_map(self, values: Tensor) -> DepthMap:
        values = values.clamp_min(0)
        if self._max_depth is not None:
            values = torch.where(values > self._max_depth, 0.0, values)
        return DepthMap(values=values.cpu(), kind="metric" if self._is_metric else "relative")


class SemanticNetwork(BatchedNetwork[Tensor]):
    """The class of every pixel, out of a closed set: SegFormer, and DPT with a semantic head."""

    def __init__(self, name: str, options: SemanticOptions, place: Loading) -> None:
        super().__init__(name, options, place)
        content = configuration(place, tuple(_CLASSES[name]))
        self._network = network(
            place, _CLASSES[name][str(content["model_type"])], content, unused=_UNUSED_OF_DPT
        )
        config = self._network.config
        self._classes = network_classes(content, count=int(config.num_labels), things=False)
        self.note = f"weights {place.name}; {self._classes.note}"
        self._input_size = place.size or 0
        self._normalisation = Normalisation.of(place.folder, otherwise=_COLOURS.get(name))
        self._size = (
            InputSize.of(place.folder, otherwise=_SIZES[name])
            if name == "segformer"
            else _dpt_input_size(config, place.folder, _SIZES[name])
        )

    @property
    def classes(self) -> ClassTable:
        """The network's classes, with ids from 1."""
        return self._classes.table

    def label_map(self, image: Image) -> LabelMap:
        """The class of every pixel; its probability is the confidence."""
        height, width = (int(side) for side in image.shape[:2])
        return map_of_scores(
            self._last.of(image), height, width,
            classes=self._classes, options=self._options, logits=True,
        )  # fmt: skip

    @override
    @network_inference()
    def _encode(self, images: Sequence[Image]) -> list[Float[Tensor, "classes rows columns"]]:
        height, width = (int(side) for side in images[0].shape[:2])
        frame = self._size.frame(height, width, size=self._place.size)
        return [one.float() for one in self._network(self._input(images, frame)).logits]
