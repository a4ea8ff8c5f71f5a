"""What a tracker of the library remembers of the frames so far, and no more than it looks at.

The library's session keeps pixels, logits and memories of every frame; here each is dropped when
no later frame can ask for it, so that a thousand frames take the memory of twenty.
"""

import importlib
from collections.abc import Mapping
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg.errors import MissingPackageError
from splatseg.models.networks._library import library

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

    @torch.inference_mode()
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
