"""SAM 2 and SAM 3 as trackers: what is marked in some views is followed through all of them.

Ravi et al. 2024 (arXiv:2408.00714), Carion et al. 2025 (arXiv:2511.16719). The library's session
keeps pixels, logits and memories of every frame; here each is dropped when no later frame can ask
for it, so that a thousand frames take the memory of twenty.
"""

import importlib
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from splatseg._check import check_shape
from splatseg.core import UNLABELLED, LabelMap
from splatseg.core.models import Image
from splatseg.core.options import Count, options
from splatseg.core.threads import network_inference
from splatseg.errors import MissingPackageError
from splatseg.models._images import HALVES, Normalisation, frame_of
from splatseg.models._weights import Loading
from splatseg.models.networks._library import (
    NetworkModel,
    configuration,
    library,
    network,
    side_of,
)

_ONLY_NOW = ("high_res_masks",)
"""Of a frame's outputs, what nothing reads after the network has run."""

_WHILE_CURRENT = ("pred_masks",)
"""What is read again only if the same frame is asked about again."""

_OF_RECENT = ("maskmem_features", "maskmem_pos_enc")
"""What the network attends to of the last frames; of earlier ones only a vector an object."""


def session_of(kind: str, **options: Any) -> Any:
    """A session of the library for a kind of tracker, such as ``Sam2Video``.

    Raises:
        MissingPackageError: If the installed library has none of this name.
    """
    name = f"{kind}InferenceSession"
    found = getattr(library(), name, None)
    if found is None:  # earlier releases have it beside the network alone
        model = getattr(library(), f"{kind}Model", None)
        module = None if model is None else importlib.import_module(model.__module__)
        found = getattr(module, name, None)
    if found is None:
        version = getattr(library(), "__version__", "of an unknown version")
        raise MissingPackageError(
            f"this model needs {name} of the package transformers, which the one installed "
            f"({version}) has not. Try: pip install -U 'splatseg[models]'."
        )
    return found(**options)


class VideoMemory:
    """The network's memory of one run through frames.

    Args:
        network: A ``Sam2VideoModel`` or ``Sam3TrackerVideoModel``.
        session: A session of the library that holds nothing yet.
        seeds_remembered: Seeded frames that an object is remembered by: its first, and the last
            of the others.
    """

    def __init__(self, network: Any, session: Any, *, seeds_remembered: int) -> None:
        self._network = network
        self._session = session
        self._seeds = seeds_remembered
        self._frame = -1

    @property
    def ids(self) -> tuple[int, ...]:
        """Ids of the objects so far, in the order in which they came."""
        return tuple(self._session.obj_ids)

    def next_frame(self) -> None:
        """Another frame comes; what only the frames before it needed goes."""
        self._frame += 1
        pointers = self._network.config.max_object_pointers_in_encoder
        memories = self._network.num_maskmem
        for outputs in self._session.output_dict_per_obj.values():
            tracked, seeded = outputs["non_cond_frame_outputs"], outputs["cond_frame_outputs"]
            for frame in list(tracked):
                if frame <= self._frame - max(pointers, memories):
                    del tracked[frame]
                elif frame <= self._frame - memories:
                    _drop(tracked[frame], _OF_RECENT)
            # Objects that are seeded often would otherwise be compared with every seed.
            for frame in sorted(seeded)[1 : max(1, len(seeded) - self._seeds + 1)]:
                del seeded[frame]
            for output in (*tracked.values(), *seeded.values()):
                _drop(output, _WHILE_CURRENT)
        for frames in self._session.frames_tracked_per_obj.values():
            frames.clear()

    @network_inference()
    def follow(
        self, pixels: Float[Tensor, "1 3 side side"], seeds: Mapping[int, Tensor]
    ) -> tuple[tuple[int, ...], Float[Tensor, "n rows columns"], Float[Tensor, "n"]]:
        """Look for all objects in the current frame.

        Args:
            pixels: The frame as the network takes it.
            seeds: Masks (1, 1, side, side) of 0 and 1 by the id of the object that they show here.

        Returns:
            Ids; logits of their pixels, coarser than the input; logits of their being there at
            all. Nothing where there is no object yet.
        """
        session = self._session
        for id in self.ids:
            self._forget_answer(id)
        for id, mask in seeds.items():
            session.add_mask_inputs(session.obj_id_to_idx(id), self._frame, mask)
        if not self.ids:
            return (), pixels.new_zeros(0, 1, 1), pixels.new_zeros(0)
        session.obj_with_new_inputs = list(seeds)
        output = self._network(inference_session=session, frame=pixels, frame_idx=self._frame)
        session.processed_frames = None
        for id in self.ids:
            self._keep_little(session.obj_id_to_idx(id))
        return tuple(output.object_ids), output.pred_masks[:, 0], output.object_score_logits[:, 0]

    def _forget_answer(self, id: int) -> None:
        """Undo what was made of the current frame, where it comes again with other seeds."""
        index = self._session.obj_id_to_idx(id)
        tracked = self._session.output_dict_per_obj[index]["non_cond_frame_outputs"]
        tracked.pop(self._frame, None)
        self._session.frames_tracked_per_obj[index].pop(self._frame, None)

    def _keep_little(self, index: int) -> None:
        self._session.mask_inputs_per_obj[index].clear()
        for outputs in self._session.output_dict_per_obj[index].values():
            output = outputs.get(self._frame)
            if output is not None:
                _drop(output, _ONLY_NOW)
                for name in _OF_RECENT:  # slices of one tensor for all objects
                    output[name] = output[name].clone()


def _drop(output: dict[str, Any], names: tuple[str, ...]) -> None:
    for name in names:
        output.pop(name, None)


_CUT = 0.0
"""Logit above which a pixel is in the mask, and an object in the view."""


_TYPES = {
    "sam2-video": ("Sam2Video", ("sam2_video",)),
    "sam3-video": ("Sam3TrackerVideo", ("sam3_tracker_video", "sam3_video")),
}
"""By family the classes of the library, without their ending, and values of ``model_type``."""


@options
class SamVideoOptions:
    """What the network remembers."""

    seeds_remembered: Count = 4
    """Seeded views by which an object is remembered: the first, and the last of the others. Each
    adds to the time and memory of every object."""


class SamVideo(NetworkModel):
    """Follows objects by the network's memory of the frames before, one frame at a time."""

    def __init__(self, name: str, options: SamVideoOptions, place: Loading) -> None:
        super().__init__(name, options, place)
        self._library_name, types = _TYPES[name]
        content = configuration(place, types)
        self._network = network(place, f"{self._library_name}Model", content)
        self._input_size = side_of(place.folder, self._network.image_size)
        self._check_size(self._input_size)
        colours = HALVES if name == "sam3-video" else None
        self._normalisation = Normalisation.of(place.folder, colours)

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
            self._library_name,
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
        frame = frame_of(*size, size=self._input_size, shape="square")
        pixels = self._input([image], frame)
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
                    mask, (self._input_size, self._input_size), mode="bilinear", antialias=True
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
