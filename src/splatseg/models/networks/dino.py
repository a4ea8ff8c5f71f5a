"""DINO, DINOv2 (with registers) and DINOv3: features of patches at several depths.

Caron et al. 2021 (arXiv:2104.14294), Oquab et al. 2023 (arXiv:2304.07193), Darcet et al. 2023
(arXiv:2309.16588), Simeoni et al. 2025 (arXiv:2508.10104). CoSSegGaussians takes DINO of 2021.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

import torch
from torch import Tensor

from splatseg.core import FeatureMap
from splatseg.core.boundary import convert_fields
from splatseg.core.models import DeepFeatures, Image
from splatseg.errors import RangeError
from splatseg.models._encoded import LastImages
from splatseg.models._family import Checkpoint, Loading
from splatseg.models._images import Normalisation, patch_grid, patch_input
from splatseg.models.networks._library import (
    configuration,
    network,
    network_family,
    settings_of,
    side_of,
)

_CLASSES = {
    "dino": {"vit": "ViTModel"},
    "dinov2": {"dinov2": "Dinov2Model", "dinov2_with_registers": "Dinov2WithRegistersModel"},
    "dinov3": {"dinov3_vit": "DINOv3ViTModel"},
}
"""Class of the library by family and the weights' ``model_type``."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DinoOptions:
    """Which blocks of the network describe patches."""

    depths: int = 4
    """Blocks whose features are kept, spread evenly over the network; the last one always is."""

    normalise: bool = True
    """Features pass the network's last normalisation, as its own output does."""

    def __post_init__(self) -> None:
        convert_fields(self)
        if self.depths < 1:
            raise RangeError(f"depths: expected 1 or more, got {self.depths}.")


class Dino:
    """Features of patches of a vision transformer that learned without labels."""

    def __init__(self, name: str, options: DinoOptions, place: Loading) -> None:
        classes = _CLASSES[name]
        content = configuration(place, tuple(classes))
        kind = str(content["model_type"])
        extra: dict[str, Any] = {"add_pooling_layer": False} if kind == "vit" else {}
        self.name = name
        self.note = f"weights {place.name}"
        self.batch_size = place.images_together
        self._options = options
        self._place = place
        self._network = network(place, classes[kind], content, **extra)
        config = self._network.config
        self._patch = side_of(place.folder, config.patch_size)
        self._size = place.size or side_of(place.folder, config.image_size)
        self._tokens = 1 + int(getattr(config, "num_register_tokens", 0) or 0)
        self._positions = {"interpolate_pos_encoding": True} if kind == "vit" else {}
        self._normalisation = Normalisation.of(place.folder)
        self._last = LastImages[DeepFeatures](self._encode)
        count = int(config.num_hidden_layers)
        if options.depths > count:
            raise RangeError(
                f"depths: expected at most the {count} blocks of {place.name}, got "
                f"{options.depths} ({place.folder})."
            )
        # After every count / depths blocks: 3, 6, 9, 12 of 12.
        self._blocks = [round(count * (i + 1) / options.depths) for i in range(options.depths)]

    @property
    def settings(self) -> Mapping[str, Any]:
        """Options, weights, precision and size of the input."""
        return settings_of(self._options, self._place, size=self._size)

    @property
    def default_settings(self) -> Mapping[str, Any]:
        """The same with default options."""
        return settings_of(DinoOptions(), self._place, size=self._size)

    def encode(self, images: Sequence[Image]) -> None:
        """Pass images of one size through the network at once."""
        self._last.encode(images)

    def features(self, image: Image) -> DeepFeatures:
        """Features after several blocks, the deepest last, and the class token."""
        return self._last.of(image)

    @torch.inference_mode()
    def _encode(self, images: Sequence[Image]) -> list[DeepFeatures]:
        height, width = (int(side) for side in images[0].shape[:2])
        grid = patch_grid(height, width, patch=self._patch, size=self._size)
        batch = patch_input(
            images, grid, self._normalisation, device=self._place.device, dtype=self._place.dtype
        )
        states = self._states(batch)
        tokens = [states[block] for block in self._blocks]
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

    def _states(self, batch: Tensor) -> list[Tensor]:
        """Tokens after each block, those that came in first."""
        output = self._network(batch, output_hidden_states=True, **self._positions)
        states = cast("Sequence[Tensor]", output.hidden_states)
        if not self._options.normalise:
            return list(states)
        norm = getattr(self._network, "layernorm", None) or self._network.norm
        return [norm(state) for state in states]


DINO = network_family(
    "dino",
    "features of patches, of 2021: the teacher of CoSSegGaussians",
    Checkpoint(id="facebook/dino-vitb16", megabytes=343, licence="Apache-2.0"),
    Checkpoint(id="facebook/dino-vits8", megabytes=87, licence="Apache-2.0"),
    reference="arXiv:2104.14294",
    gives=("features",),
    options=DinoOptions,
    make=Dino,
)
DINOV2 = network_family(
    "dinov2",
    "features of patches, of 2023",
    Checkpoint(id="facebook/dinov2-small", megabytes=88, licence="Apache-2.0"),
    Checkpoint(id="facebook/dinov2-base", megabytes=346, licence="Apache-2.0"),
    Checkpoint(id="facebook/dinov2-with-registers-base", megabytes=346, licence="Apache-2.0"),
    reference="arXiv:2304.07193",
    gives=("features",),
    options=DinoOptions,
    make=Dino,
)
DINOV3 = network_family(
    "dinov3",
    "features of patches, of 2025",
    Checkpoint(
        id="facebook/dinov3-vitb16-pretrain-lvd1689m",
        megabytes=343,
        licence="DINOv3 License",
        note="access must be asked for",
    ),
    reference="arXiv:2508.10104",
    gives=("features",),
    options=DinoOptions,
    make=Dino,
)
