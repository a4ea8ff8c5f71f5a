"""Stand-ins for 2D models that need no weights: colour, gradients and nothing else.

They run with nothing downloaded and know nothing of what things are. `Classical` has masks,
prompts and features behind the protocols; the functions are there by themselves too.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import torch

from splatseg.core import MaskSet
from splatseg.core.models import DeepFeatures, Embedding, Image, Prompt
from splatseg.models._family import ModelFamily
from splatseg.models.classical._descriptor import DescriptorOptions as DescriptorOptions
from splatseg.models.classical._descriptor import (
    colour_gradient_features as colour_gradient_features,
)
from splatseg.models.classical._grabcut import GrabCutOptions as GrabCutOptions
from splatseg.models.classical._grabcut import grab_cut as grab_cut
from splatseg.models.classical._regions import RegionOptions as RegionOptions
from splatseg.models.classical._regions import partition as partition
from splatseg.models.classical._regions import reduced
from splatseg.models.classical._regions import region_masks as region_masks

ALGORITHM = 1
"""Grows when the same settings give other answers, so that cached ones are not taken for new."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Classical:
    """Automatic masks by merging superpixels, prompted ones by GrabCut, features of colour."""

    regions: RegionOptions = field(default_factory=RegionOptions)
    cut: GrabCutOptions = field(default_factory=GrabCutOptions)
    descriptor: DescriptorOptions = field(default_factory=DescriptorOptions)

    @property
    def name(self) -> str:
        """``classical``."""
        return "classical"

    @property
    def settings(self) -> Mapping[str, Any]:
        """The options, and the version of the algorithm."""
        return {
            "algorithm": ALGORITHM,
            "regions": asdict(self.regions) | {"cuts": list(self.regions.cuts)},
            "cut": asdict(self.cut),
            "descriptor": asdict(self.descriptor) | {"reaches": list(self.descriptor.reaches)},
        }

    @property
    def default_settings(self) -> Mapping[str, Any]:
        """The settings of a model that was made without options."""
        return Classical().settings

    @property
    def note(self) -> str:
        """That it is a stand-in."""
        return "a stand-in without weights: it goes by colour and edges, not by what things are"

    def masks(self, image: Image) -> MaskSet:
        """Nested masks of several granularities: `region_masks`."""
        return region_masks(image, self.regions)

    def embed(self, image: Image) -> Embedding:
        """The image at the working size."""
        return Embedding(
            model=self.name,
            height=int(image.shape[0]),
            width=int(image.shape[1]),
            arrays={"image": torch.from_numpy(reduced(image, self.regions.working_size).copy())},
        )

    def prompted_masks(self, embedding: Embedding, prompt: Prompt) -> MaskSet:
        """The mask of what the prompt means: `grab_cut`."""
        embedding.check_model(self.name)
        return grab_cut(
            embedding.arrays["image"].numpy(),
            prompt,
            size=(embedding.height, embedding.width),
            options=self.cut,
        )

    def features(self, image: Image) -> DeepFeatures:
        """Colour and gradients per cell: `colour_gradient_features`."""
        return colour_gradient_features(image, self.descriptor)


CLASSICAL = ModelFamily(
    name="classical",
    summary="masks and features by colour and edges: a stand-in that needs no weights",
    reference="docs/models.md",
    gives=("masks", "features"),
    options=RegionOptions,
    load=lambda options, place: Classical(regions=options),
)
