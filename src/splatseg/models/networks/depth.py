"""Depth of one photograph: Depth Anything and DPT (MiDaS).

Yang et al. 2024 (arXiv:2401.10891, arXiv:2406.09414), Ranftl et al. 2021 (arXiv:2103.13413).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from splatseg.core import DepthMap
from splatseg.core.boundary import convert_fields
from splatseg.core.models import Image
from splatseg.errors import RangeError
from splatseg.models._encoded import LastImages
from splatseg.models._family import Checkpoint, Loading
from splatseg.models._images import HALVES, Normalisation, network_input
from splatseg.models._input_size import InputSize
from splatseg.models.networks._library import (
    configuration,
    network,
    network_family,
    settings_of,
    side_of,
)

_CLASSES = {
    "depth-anything": {"depth_anything": "DepthAnythingForDepthEstimation"},
    "dpt": {"dpt": "DPTForDepthEstimation"},
}
"""Class of the library by family and the weights' ``model_type``."""

_DPT_SIDE = 384


UNUSED_OF_DPT = ("neck.fusion_stage.layers.0.residual_layer1.",)
"""The coarsest depth has nothing coarser to be added to; published weights lack it."""

_NORMALISATIONS = {"depth-anything": Normalisation(), "dpt": HALVES}
_SIZES = {
    "depth-anything": InputSize(sides=(518, 518), keeps_proportions=True),
    "dpt": InputSize(sides=(_DPT_SIDE, _DPT_SIDE)),
}
"""What the input is where the weights do not tell."""


def dpt_input_size(config: Any, folder: Path, *, otherwise: InputSize) -> InputSize:
    """What a network with DPT's head takes: whole patches, and squares where it has no backbone.

    Args:
        config: The network's configuration.
        folder: The weights.
        otherwise: What holds where they do not tell.
    """
    found = InputSize.of(folder, otherwise=otherwise)
    backbone = None if getattr(config, "is_hybrid", False) else config.backbone_config
    patch = side_of(folder, getattr(backbone, "patch_size", None) or config.patch_size)
    found = replace(found, multiple=math.lcm(found.multiple, patch))
    if backbone is not None:
        return found
    side = max(found.sides or (found.shortest or found.longest or _DPT_SIDE,))
    return InputSize(sides=(side, side), multiple=found.multiple, takes_squares=True)


@dataclass(frozen=True, slots=True, kw_only=True)
class DepthOptions:
    """Which depths are told."""

    max_depth: float | None = None
    """Metric depth beyond this many metres counts as unknown. None keeps all that the network
    tells; it goes with weights that tell metres."""

    def __post_init__(self) -> None:
        convert_fields(self)
        if self.max_depth is not None and not self.max_depth > 0:
            raise RangeError(f"max_depth: expected more than 0, got {self.max_depth:g}.")


class DepthNetwork:
    """Depth of every pixel: in metres, or inverse and up to a scale and a shift."""

    def __init__(self, name: str, options: DepthOptions, place: Loading) -> None:
        convert_fields(options)
        config = configuration(place, tuple(_CLASSES[name]))
        self._network = network(
            place, _CLASSES[name][str(config["model_type"])], config, unused=UNUSED_OF_DPT
        )
        kind = getattr(self._network.config, "depth_estimation_type", "relative")
        self._is_metric = kind == "metric"
        if options.max_depth is not None and not self._is_metric:
            raise RangeError(
                f"max_depth: expected weights that tell metres, got {place.name}, which tells "
                "inverse depth up to a scale and a shift."
            )
        tells = "metres" if self._is_metric else "inverse depth up to a scale and a shift"
        self.name = name
        self.note = f"weights {place.name}; {tells}"
        self.batch_size = place.images_together
        self._options = options
        self._place = place
        self._normalisation = Normalisation.of(place.folder, otherwise=_NORMALISATIONS[name])
        self._size = dpt_input_size(self._network.config, place.folder, otherwise=_SIZES[name])
        self._last = LastImages[DepthMap](self._encode)

    @property
    def settings(self) -> Mapping[str, Any]:
        """Options, weights, precision and size of the input, 0 where the weights say it."""
        return settings_of(self._options, self._place, size=self._place.size or 0)

    @property
    def default_settings(self) -> Mapping[str, Any]:
        """The same with default options."""
        return settings_of(DepthOptions(), self._place, size=self._place.size or 0)

    def encode(self, images: Sequence[Image]) -> None:
        """Pass images of one size through the network at once."""
        self._last.encode(images)

    def depth_map(self, image: Image) -> DepthMap:
        """The depth of every pixel."""
        return self._last.of(image)

    @torch.inference_mode()
    def _encode(self, images: Sequence[Image]) -> list[DepthMap]:
        height, width = (int(side) for side in images[0].shape[:2])
        frame = self._size.frame(height, width, size=self._place.size)
        batch = network_input(
            images, frame, self._normalisation, device=self._place.device,
            dtype=self._place.dtype, mode="bicubic",
        )  # fmt: skip
        found = self._network(batch).predicted_depth
        whole = F.interpolate(found[:, None].float(), (height, width), mode="bilinear")[:, 0]
        return [self._depth_map(one) for one in whole]

    def _depth_map(self, values: Tensor) -> DepthMap:
        values = values.clamp_min(0)
        if self._options.max_depth is not None:
            values = torch.where(values > self._options.max_depth, 0.0, values)
        return DepthMap(values=values.cpu(), kind="metric" if self._is_metric else "relative")


DEPTH_ANYTHING = network_family(
    "depth-anything",
    "depth of a photograph, inverse or in metres as the weights are",
    Checkpoint(
        id="depth-anything/Depth-Anything-V2-Small-hf", megabytes=99, licence="Apache-2.0"
    ),
    Checkpoint(
        id="depth-anything/Depth-Anything-V2-Base-hf", megabytes=390, licence="CC-BY-NC-4.0",
        note="not for commercial use",
    ),
    Checkpoint(
        id="depth-anything/Depth-Anything-V2-Large-hf", megabytes=1341, licence="CC-BY-NC-4.0",
        note="not for commercial use",
    ),
    Checkpoint(
        id="depth-anything/Depth-Anything-V2-Metric-Indoor-Small-hf", megabytes=99,
        licence="Apache-2.0", note="metres",
    ),
    reference="arXiv:2406.09414",
    gives=("depth",),
    options=DepthOptions,
    make=DepthNetwork,
)  # fmt: skip
DPT = network_family(
    "dpt",
    "inverse depth of a photograph, by a dense prediction transformer (MiDaS)",
    Checkpoint(id="Intel/dpt-large", megabytes=1370, licence="Apache-2.0"),
    reference="arXiv:2103.13413",
    gives=("depth",),
    options=DepthOptions,
    make=DepthNetwork,
)
