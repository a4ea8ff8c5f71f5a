"""Segment Anything: SAM, SAM-HQ, SAM 2 and the tracker of SAM 3, for masks, prompts and embeddings.

Kirillov et al. 2023 (arXiv:2304.02643), Ke et al. 2023 (arXiv:2306.01567), Ravi et al. 2024
(arXiv:2408.00714), Carion et al. 2025 (arXiv:2511.16719).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, cast

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from splatseg.core import FeatureMap, MaskSet, Rle
from splatseg.core.models import DeepFeatures, Embedding, Image, Prompt
from splatseg.core.threads import network_inference
from splatseg.models._images import HALVES, Frame, Normalisation, frame_of
from splatseg.models._mask_generator import (
    STABILITY_OFFSET,
    Decode,
    SamOptions,
    automatic_masks,
)
from splatseg.models._weights import Loading
from splatseg.models.networks._library import (
    BatchedNetwork,
    answering,
    configuration,
    network,
    side_of,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Kind:
    """What differs between the networks."""

    class_name: str
    shape: Literal["padded", "square"]
    """How images are laid into the square input."""

    default_size: int
    colours: Normalisation | None = None
    """What is done to colours where the weights do not say; None is as for ImageNet."""


_KINDS = {
    "sam": _Kind(class_name="SamModel", shape="padded", default_size=1024),
    "sam_hq": _Kind(class_name="SamHQModel", shape="padded", default_size=1024),
    "sam2": _Kind(class_name="Sam2Model", shape="square", default_size=1024),
    "sam3_tracker": _Kind(
        class_name="Sam3TrackerModel", shape="square", default_size=1008, colours=HALVES
    ),
}
_TYPES = {
    "sam": ("sam",),
    "sam-hq": ("sam_hq",),
    "sam2": ("sam2", "sam2_video"),
    "sam3": ("sam3_tracker", "sam3_video"),
}
"""Values of the weights' ``model_type`` by family; those of videos hold the same network."""

_SAM3_PARTS = {
    r"^tracker_model\.": "",
    r"^tracker_neck\.": "vision_encoder.neck.",
    r"^detector_model\.vision_encoder\.backbone\.": "vision_encoder.backbone.",
}
"""The tracker's tensors in weights that hold the detector too. The library takes one
"tracker_model." off by itself, and puts two before the names where it writes such weights."""

_EMBEDDING = -1
"""The coarsest map, the last one: 256 channels on 64 x 64 cells at full size."""

_SURE = 10.0
"""Logit of a pixel that a rough mask holds."""

_CUT = 0.0
"""Logit above which a pixel is in the mask."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Seen:
    """What the encoder made of an image."""

    frame: Frame
    maps: tuple[Tensor, ...]
    """Embedding and whatever else the decoder needs, each (1, channels, rows, columns) or so."""


class Sam(BatchedNetwork[_Seen]):
    """Masks of things, by points, boxes and rough masks, or of a grid of points."""

    _resizable = False
    _constants: ClassVar = {"multimask": True, "stability_offset": STABILITY_OFFSET}

    def __init__(self, name: str, options: SamOptions, place: Loading) -> None:
        super().__init__(name, options, place)
        content = configuration(place, _TYPES[name])
        held = str(content["model_type"])
        kind = held.replace("sam2_video", "sam2").replace("sam3_video", "sam3_tracker")
        parts: dict[str, Any] = {"key_mapping": _SAM3_PARTS} if held == "sam3_video" else {}
        self._kind = _KINDS[kind]
        self._network = network(place, self._kind.class_name, content, **parts)
        vision = self._network.config.vision_config
        size = getattr(getattr(vision, "backbone_config", vision), "image_size", None)
        self._input_size = side_of(place.folder, size or self._kind.default_size)
        self._check_size(self._input_size)
        self._normalisation = Normalisation.of(place.folder, self._kind.colours)

    def masks(self, image: Image) -> MaskSet:
        """Masks for a grid of points: `automatic_masks`."""
        return automatic_masks(image, self._decoder_of, self._options)

    def features(self, image: Image) -> DeepFeatures:
        """The encoder's embedding, as SAGA distils it, on cells of whole pixels."""
        seen = self._last.of(image)
        frame = seen.frame
        grid = seen.maps[_EMBEDDING].float()
        cell = frame.outer_height / grid.shape[2]
        stride = max(1, round(cell * max(frame.height, frame.width) / max(
            frame.inner_height, frame.inner_width)))  # fmt: skip
        rows, columns = -(-frame.height // stride), -(-frame.width // stride)
        # Cells' centres in the frame, in [-1, 1] of the whole input.
        y = (torch.arange(rows) + 0.5) * stride / frame.height * frame.inner_height
        x = (torch.arange(columns) + 0.5) * stride / frame.width * frame.inner_width
        where = torch.stack(
            torch.meshgrid(y / frame.outer_height, x / frame.outer_width, indexing="ij"), dim=-1
        ).flip(-1)
        sampled = F.grid_sample(
            grid, (2 * where - 1)[None].to(grid), padding_mode="border", align_corners=False
        )[0]
        one = FeatureMap(
            features=sampled.permute(1, 2, 0).cpu().contiguous(),
            stride=stride,
            height=frame.height,
            width=frame.width,
        )
        return DeepFeatures(maps=(one,), depths=("encoder",))

    def embed(self, image: Image) -> Embedding:
        """The encoder's answer, as a value."""
        seen = self._last.of(image)
        arrays = {f"map{i}": one.cpu() for i, one in enumerate(seen.maps)}
        height, width = (int(side) for side in image.shape[:2])
        return Embedding(model=self.name, height=height, width=width, arrays=arrays)

    def prompted_masks(self, embedding: Embedding, prompt: Prompt) -> MaskSet:
        """Masks of what the prompt means, the one that the network is surest of first."""
        embedding.check_model(self.name)
        prompt.check_size(embedding.height, embedding.width)
        seen = _Seen(
            frame=self._frame(embedding.height, embedding.width),
            maps=tuple(
                embedding.arrays[f"map{i}"].to(self._place.device, self._place.dtype)
                for i in range(len(embedding.arrays))
            ),
        )
        # Three masks for a single point, which says least; one for a box, a mask, several hints.
        vague = len(prompt.points) == 1 and prompt.box is None and prompt.mask is None
        logits, scores = self._decode(
            seen,
            points=prompt.points[None] if len(prompt.points) else None,
            positive=prompt.signs[None],
            box=None if prompt.box is None else prompt.box[None],
            mask=None if prompt.mask is None else prompt.mask[None],
            multimask=vague,
        )
        order = torch.sort(scores[0], descending=True, stable=True).indices
        size = (embedding.height, embedding.width)
        full = F.interpolate(logits[0, order][None].float(), size, mode="bilinear")[0] > _CUT
        return MaskSet(
            height=size[0],
            width=size[1],
            masks=tuple(Rle.encode(mask) for mask in full.cpu()),
            scores=scores[0, order].float().cpu().clamp(0, 1),
            levels=torch.zeros(len(order), dtype=torch.int32),
        )

    def _decoder_of(self, image: Image) -> Decode:
        seen = self._last.of(image)

        def decode(points: Float[Tensor, "n 2"]) -> tuple[Tensor, Tensor]:
            return self._decode(
                seen,
                points=points[:, None],
                positive=torch.ones(len(points), 1, dtype=torch.bool),
                multimask=True,
            )

        return decode

    def _frame(self, height: int, width: int) -> Frame:
        return frame_of(height, width, size=self._input_size, shape=self._kind.shape)

    @override
    @network_inference()
    def _encode(self, images: Sequence[Image]) -> list[_Seen]:
        frame = self._frame(*(int(side) for side in images[0].shape[:2]))
        maps = answering(self._place.folder, self._maps)(self._input(images, frame))
        return [
            _Seen(frame=frame, maps=tuple(one[i : i + 1] for one in maps))
            for i in range(len(images))
        ]

    def _maps(self, batch: Tensor) -> list[Tensor]:
        """Embeddings of images, the one that is coarsest last.

        SAM 2 and 3 add that there is no memory of earlier frames. Their own function for it takes
        only features of one layout in memory, and only one size of the input. SAM 3's encoder makes
        a map more than its tracker takes, a coarser one: that is left out first, as its tracker of
        videos does; its function for images adds to that one what it then leaves out.
        """
        if self._kind.shape == "padded":
            return _flat(self._network.get_image_embeddings(batch))
        features = self._network.get_image_features(batch, return_dict=True).fpn_hidden_states
        # SAM 3 makes one map more, coarser, for its detector alone.
        features = features[: len(self._network.backbone_feature_sizes)]
        maps = [one.permute(1, 2, 0) for one in features]
        maps[-1] = maps[-1] + self._network.no_memory_embedding.reshape(1, -1, 1)
        sides = [round(one.shape[2] ** 0.5) for one in maps]
        return [one.reshape(*one.shape[:2], n, n) for one, n in zip(maps, sides, strict=True)]

    @network_inference()
    def _decode(
        self,
        seen: _Seen,
        *,
        points: Tensor | None = None,
        positive: Tensor | None = None,
        box: Tensor | None = None,
        mask: Tensor | None = None,
        multimask: bool,
    ) -> tuple[Tensor, Tensor]:
        """Logits (prompts, masks, rows, columns) over the image alone, and the IoU expected."""
        frame, device, dtype = seen.frame, self._place.device, self._place.dtype
        scale = torch.tensor([frame.inner_width / frame.width, frame.inner_height / frame.height])
        words: dict[str, Any] = self._embedding_words(seen.maps)
        if points is not None and positive is not None:
            words["input_points"] = (points * scale)[None].to(device, dtype)
            words["input_labels"] = positive[None].to(device, torch.int32)
        if box is not None:
            words["input_boxes"] = (box * scale.repeat(2))[None].to(device, dtype)
        if mask is not None:
            words["input_masks"] = self._mask_hint(mask, frame).to(device, dtype)
        output = self._network(**words, multimask_output=multimask)
        logits, scores = output.pred_masks[0], output.iou_scores[0]
        rows = max(1, round(logits.shape[2] * frame.inner_height / frame.outer_height))
        columns = max(1, round(logits.shape[3] * frame.inner_width / frame.outer_width))
        return logits[:, :, :rows, :columns], scores

    def _embedding_words(self, maps: tuple[Tensor, ...]) -> dict[str, Any]:
        if self._kind.class_name == "SamModel":
            return {"image_embeddings": maps[0]}
        if self._kind.class_name == "SamHQModel":
            return {"image_embeddings": maps[-1], "intermediate_embeddings": list(maps[:-1])}
        return {"image_embeddings": list(maps)}

    def _mask_hint(self, mask: Tensor, frame: Frame) -> Tensor:
        """A rough mask as logits of the decoder's input size, out of the image surely not."""
        hints = self._network.config.prompt_encoder_config
        folder = self._place.folder
        size = 4 * (side_of(folder, hints.image_size) // side_of(folder, hints.patch_size))
        inner = F.interpolate(
            mask[:, None].float(), (frame.inner_height, frame.inner_width), mode="bilinear"
        )
        below, right = (
            frame.outer_height - frame.inner_height,
            frame.outer_width - frame.inner_width,
        )
        padded = F.pad(inner, (0, right, 0, below))
        small = F.interpolate(padded, (size, size), mode="bilinear", antialias=True)
        return (small - 0.5) * 2 * _SURE


def _flat(found: Any) -> list[Tensor]:
    """Embeddings as the networks give them, the one of the whole image last."""
    if isinstance(found, Tensor):
        return [found]
    items = list(cast("Sequence[Any]", found))
    if len(items) == 2 and not isinstance(items[1], Tensor):  # SAM-HQ: embedding, then blocks
        return [*cast("Sequence[Tensor]", items[1]), items[0]]
    return cast("list[Tensor]", items)
