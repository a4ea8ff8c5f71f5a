"""SAM 2 and SAM 3 as trackers: what is marked in some views is followed through all of them.

Ravi et al. 2024 (arXiv:2408.00714), Carion et al. 2025 (arXiv:2511.16719).
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from splatseg._check import check_shape
from splatseg.core import UNLABELLED, LabelMap
from splatseg.core.boundary import convert_fields
from splatseg.core.models import Image
from splatseg.errors import RangeError
from splatseg.models._family import Checkpoint, Loading
from splatseg.models._images import HALVES, Normalisation, frame_of, network_input
from splatseg.models.networks._library import (
    configuration,
    network,
    network_family,
    settings_of,
    side_of,
)
from splatseg.models.networks._video_memory import VideoMemory, session_of

_CUT = 0.0
"""Logit above which a pixel is in the mask, and an object in the view."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Kind:
    """What differs between the networks."""

    library_name: str
    """Of the classes of the library, without their ending."""

    types: tuple[str, ...]
    """Values of the weights' ``model_type``."""

    colours: Normalisation | None = None
    """What is done to colours where the weights do not say; None is as for ImageNet."""


_KINDS = {
    "sam2-video": _Kind(library_name="Sam2Video", types=("sam2_video",)),
    "sam3-video": _Kind(
        library_name="Sam3TrackerVideo",
        types=("sam3_tracker_video", "sam3_video"),
        colours=HALVES,
    ),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class SamVideoOptions:
    """What the network remembers."""

    seeds_remembered: int = 4
    """Seeded views by which an object is remembered: the first, and the last of the others. Each
    adds to the time and memory of every object."""

    def __post_init__(self) -> None:
        convert_fields(self)
        if self.seeds_remembered < 1:
            raise RangeError(f"seeds_remembered: expected 1 or more, got {self.seeds_remembered}.")


class SamVideo:
    """Follows objects by the network's memory of the frames before, one frame at a time."""

    def __init__(self, name: str, options: SamVideoOptions, place: Loading) -> None:
        convert_fields(options)
        kind = _KINDS[name]
        content = configuration(place, kind.types)
        self.name = name
        self.note = f"weights {place.name}"
        self._kind = kind
        self._options = options
        self._place = place
        self._network = network(place, f"{kind.library_name}Model", content)
        self._size = side_of(place.folder, self._network.image_size)
        if place.size not in (None, self._size):
            raise RangeError(f"size: {place.name} takes {self._size} alone, got {place.size}.")
        self._normalisation = Normalisation.of(place.folder, self._kind.colours)

    @property
    def settings(self) -> Mapping[str, Any]:
        """Options, weights, precision and size of the input."""
        return settings_of(self._options, self._place, size=self._size)

    @property
    def default_settings(self) -> Mapping[str, Any]:
        """The same with default options."""
        return settings_of(SamVideoOptions(), self._place, size=self._size)

    def track(
        self, frames: Iterable[tuple[str, Image]], seeds: Mapping[str, LabelMap]
    ) -> Iterator[tuple[str, LabelMap]]:
        """Follow what the seeds mark; `MaskTracker.track`.

        Where objects overlap, a pixel is of the one with the highest logit. One whose logit of
        being in the view is not above 0 is absent. Memory does not grow with the frames; time and
        memory grow with the objects.

        Args:
            frames: Names and images of views, in order. They are taken one at a time.
            seeds: Label maps by name of the view that they mark.

        Raises:
            ShapeError: If a seed has not the size of its view.
        """
        session = session_of(
            self._kind.library_name,
            inference_device=self._place.device,
            inference_state_device=self._place.device,
            video_storage_device=self._place.device,
            dtype=self._place.dtype,
        )
        remembered = self._options.seeds_remembered
        memory = VideoMemory(self._network, session, seeds_remembered=remembered)
        before: str | None = None
        for name, image in frames:
            if name != before:
                memory.next_frame()
            before = name
            seed = seeds.get(name)
            if seed is not None:
                check_shape(f"seeds[{name!r}]", seed.ids, tuple(image.shape[:2]))
            yield name, self._followed(memory, image, seed)

    def _followed(self, memory: VideoMemory, image: Image, seed: LabelMap | None) -> LabelMap:
        size = int(image.shape[0]), int(image.shape[1])
        nothing = torch.full(size, UNLABELLED, dtype=torch.int32)
        marked = nothing if seed is None else seed.ids.cpu()
        masks = self._masks(marked)
        if not masks and not memory.ids:
            return LabelMap(ids=nothing)
        pixels = network_input(
            [image], frame_of(*size, size=self._size, shape="square"), self._normalisation,
            device=self._place.device, dtype=self._place.dtype,
        )  # fmt: skip
        ids, logits, there = memory.follow(pixels, masks)
        others = [
            i for i, id in enumerate(ids) if id not in masks and float(there[i]) > _CUT
        ]  # what is seeded lies where the seed says, to the pixel
        found = highest([ids[i] for i in others], logits[others], size)
        return LabelMap(ids=torch.where(marked == UNLABELLED, found, marked))

    def _masks(self, marked: Tensor) -> dict[int, Tensor]:
        """The mask of each id that is marked, as the network takes it."""
        masks: dict[int, Tensor] = {}
        for id in torch.unique(marked).tolist():
            if id != UNLABELLED:
                mask = (marked == id)[None, None].to(self._place.device, torch.float32)
                small = F.interpolate(
                    mask, (self._size, self._size), mode="bilinear", antialias=True
                )
                masks[int(id)] = (small >= 0.5).to(self._place.dtype)
        return masks


def highest(ids: list[int], logits: Tensor, size: tuple[int, int]) -> Tensor:
    """The id of the highest logit at each pixel, -1 where none is above 0.

    Args:
        ids: Of the objects.
        logits: (n, rows, columns), coarser than the image.
        size: Rows and columns of the image.
    """
    best = torch.full(size, _CUT, device=logits.device)
    found = torch.full(size, UNLABELLED, dtype=torch.int32, device=logits.device)
    # One at a time: a hundred objects at full size would take gigabytes.
    for i in sorted(range(len(ids)), key=lambda i: ids[i]):
        full = F.interpolate(logits[i][None, None].float(), size, mode="bilinear")[0, 0]
        better = full > best
        best = torch.where(better, full, best)
        found = torch.where(better, ids[i], found)
    return found.cpu()


SAM2_VIDEO = network_family(
    "sam2-video",
    "Segment Anything 2 as a tracker: seeds (--seeds) are followed through the views",
    Checkpoint(id="facebook/sam2.1-hiera-small", megabytes=184, licence="Apache-2.0"),
    Checkpoint(id="facebook/sam2.1-hiera-base-plus", megabytes=324, licence="Apache-2.0"),
    Checkpoint(id="facebook/sam2.1-hiera-large", megabytes=898, licence="Apache-2.0"),
    reference="arXiv:2408.00714",
    gives=("tracked",),
    options=SamVideoOptions,
    make=SamVideo,
)
SAM3_VIDEO = network_family(
    "sam3-video",
    "Segment Anything 3's tracker: seeds (--seeds) are followed through the views",
    Checkpoint(
        id="facebook/sam3", megabytes=3440, licence="SAM License", note="access must be asked for"
    ),
    reference="arXiv:2511.16719",
    gives=("tracked",),
    options=SamVideoOptions,
    make=SamVideo,
)
