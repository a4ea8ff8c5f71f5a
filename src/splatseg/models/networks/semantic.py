"""Networks that give each pixel a class directly: SegFormer, and DPT with a semantic head.

Xie et al. 2021 (arXiv:2105.15203), Ranftl et al. 2021 (arXiv:2103.13413).
"""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg.core import ClassTable, LabelMap
from splatseg.core.boundary import convert_fields
from splatseg.core.models import Image
from splatseg.models._class_names import network_classes
from splatseg.models._encoded import LastImages
from splatseg.models._family import Checkpoint, Loading
from splatseg.models._images import HALVES, Normalisation, network_input
from splatseg.models._input_size import InputSize
from splatseg.models._queries import SemanticOptions, map_of_scores
from splatseg.models.networks._library import configuration, network, network_family, settings_of
from splatseg.models.networks.depth import UNUSED_OF_DPT, dpt_input_size

_CLASSES = {
    "segformer": {"segformer": "SegformerForSemanticSegmentation"},
    "dpt-semantic": {"dpt": "DPTForSemanticSegmentation"},
}
"""Class of the library by family and the weights' ``model_type``."""

_SEGFORMER_SIZE = InputSize(sides=(512, 512))
_DPT_SIZE = InputSize(sides=(480, 480))


class SemanticNetwork:
    """The class of every pixel, out of a closed set."""

    def __init__(self, name: str, options: SemanticOptions, place: Loading) -> None:
        convert_fields(options)
        config = configuration(place, tuple(_CLASSES[name]))
        self._network = network(
            place, _CLASSES[name][str(config["model_type"])], config, unused=UNUSED_OF_DPT
        )
        self._classes = network_classes(
            config, count=int(self._network.config.num_labels), things=False
        )
        self.name = name
        self.note = f"weights {place.name}; {self._classes.note}"
        self.batch_size = place.images_together
        self._options = options
        self._place = place
        if name == "segformer":
            self._normalisation = Normalisation.of(place.folder)
            self._size = InputSize.of(place.folder, otherwise=_SEGFORMER_SIZE)
        else:
            self._normalisation = Normalisation.of(place.folder, otherwise=HALVES)
            self._size = dpt_input_size(self._network.config, place.folder, otherwise=_DPT_SIZE)
        self._last = LastImages[Tensor](self._encode)

    @property
    def settings(self) -> Mapping[str, Any]:
        """Options, weights, precision and size of the input, 0 where the weights say it."""
        return settings_of(self._options, self._place, size=self._place.size or 0)

    @property
    def default_settings(self) -> Mapping[str, Any]:
        """The same with default options."""
        return settings_of(SemanticOptions(), self._place, size=self._place.size or 0)

    @property
    def classes(self) -> ClassTable:
        """The network's classes, with ids from 1."""
        return self._classes.table

    def encode(self, images: Sequence[Image]) -> None:
        """Pass images of one size through the network at once."""
        self._last.encode(images)

    def label_map(self, image: Image) -> LabelMap:
        """The class of every pixel; its probability is the confidence."""
        height, width = (int(side) for side in image.shape[:2])
        return map_of_scores(
            self._last.of(image), height, width,
            classes=self._classes, options=self._options, logits=True,
        )  # fmt: skip

    @torch.inference_mode()
    def _encode(self, images: Sequence[Image]) -> list[Float[Tensor, "classes rows columns"]]:
        height, width = (int(side) for side in images[0].shape[:2])
        frame = self._size.frame(height, width, size=self._place.size)
        batch = network_input(
            images, frame, self._normalisation, device=self._place.device, dtype=self._place.dtype
        )
        return [one.float() for one in self._network(batch).logits]


SEGFORMER = network_family(
    "segformer",
    "classes of pixels, small and fast",
    Checkpoint(
        id="nvidia/segformer-b0-finetuned-ade-512-512", megabytes=15,
        licence="NVIDIA Source Code License", note="not for commercial use",
    ),
    Checkpoint(
        id="nvidia/segformer-b5-finetuned-cityscapes-1024-1024", megabytes=339,
        licence="NVIDIA Source Code License", note="not for commercial use",
    ),
    reference="arXiv:2105.15203",
    gives=("labels",),
    options=SemanticOptions,
    make=SemanticNetwork,
)  # fmt: skip
DPT_SEMANTIC = network_family(
    "dpt-semantic",
    "classes of pixels, by a dense prediction transformer",
    Checkpoint(id="Intel/dpt-large-ade", megabytes=1380, licence="Apache-2.0"),
    reference="arXiv:2103.13413",
    gives=("labels",),
    options=SemanticOptions,
    make=SemanticNetwork,
)
