"""Segment Anything: SAM, SAM-HQ, SAM 2 and the tracker of SAM 3, for masks, prompts and embeddings.

Kirillov et al. 2023 (arXiv:2304.02643), Ke et al. 2023 (arXiv:2306.01567), Ravi et al. 2024
(arXiv:2408.00714), Carion et al. 2025 (arXiv:2511.16719).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, cast

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from splatseg.core import FeatureMap, MaskSet, Rle
from splatseg.core.boundary import convert_fields
from splatseg.core.models import DeepFeatures, Embedding, Image, Prompt
from splatseg.errors import RangeError
from splatseg.models._encoded import LastImages
from splatseg.models._family import Checkpoint, Loading
from splatseg.models._images import HALVES, Frame, Normalisation, frame_of, network_input
from splatseg.models._mask_generator import Decode, MaskGeneratorOptions, automatic_masks
from splatseg.models.networks._library import (
    answering,
    configuration,
    network,
    network_family,
    settings_of,
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

_CUT = 0.0
"""Logit above which a pixel is in the mask."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SamOptions(MaskGeneratorOptions):
    """Which masks are kept when nobody prompts; the defaults are the published ones."""

    multimask: bool = field(default=True)
    """Three masks a point, for part, object and group, instead of one."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Seen:
    """What the encoder made of an image."""

    frame: Frame
    maps: tuple[Tensor, ...]
    """Embedding and whatever else the decoder needs, each (1, channels, rows, columns) or so."""


class Sam:
    """Masks of things, by points, boxes and rough masks, or of a grid of points."""

    def __init__(self, name: str, options: SamOptions, place: Loading) -> None:
        convert_fields(options)
        content = configuration(place, _TYPES[name])
        held = str(content["model_type"])
        kind = held.replace("sam2_video", "sam2").replace("sam3_video", "sam3_tracker")
        parts: dict[str, Any] = {"key_mapping": _SAM3_PARTS} if held == "sam3_video" else {}
        self.name = name
        self.note = f"weights {place.name}"
        self.batch_size = place.images_together
        self._kind = _KINDS[kind]
        self._options = options
        self._place = place
        self._network = network(place, self._kind.class_name, content, **parts)
        self._size = self._trained_size()
        if place.size not in (None, self._size):
            raise RangeError(f"size: {place.name} takes {self._size} alone, got {place.size}.")
        self._normalisation = Normalisation.of(place.folder, self._kind.colours)
        self._last = LastImages[_Seen](self._encode, resizable=False)

    @property
    def settings(self) -> Mapping[str, Any]:
        """Options, weights, precision and size of the input."""
        return self._settings(self._options)

    @property
    def default_settings(self) -> Mapping[str, Any]:
        """The same with default options."""
        return self._settings(SamOptions())

    def _settings(self, options: SamOptions) -> Mapping[str, Any]:
        return settings_of(options, self._place, size=self._size, unrecorded=("prompts_per_batch",))

    def encode(self, images: Sequence[Image]) -> None:
        """Pass images of one size through the encoder at once."""
        self._last.encode(images)

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
            multimask=self._options.multimask and vague,
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
                multimask=self._options.multimask,
            )

        return decode

    def _trained_size(self) -> int:
        """Side of the input that the weights were made for, pixels."""
        vision = self._network.config.vision_config
        size = getattr(getattr(vision, "backbone_config", vision), "image_size", None)
        return side_of(self._place.folder, size or self._kind.default_size)

    def _frame(self, height: int, width: int) -> Frame:
        return frame_of(height, width, size=self._size, shape=self._kind.shape)

    @torch.inference_mode()
    def _encode(self, images: Sequence[Image]) -> list[_Seen]:
        frame = self._frame(*(int(side) for side in images[0].shape[:2]))
        batch = network_input(
            images, frame, self._normalisation, device=self._place.device, dtype=self._place.dtype
        )
        maps = answering(self._place.folder, self._maps)(batch)
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

    @torch.inference_mode()
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


_EMBEDDING = -1
"""The coarsest map, the last one: 256 channels on 64 x 64 cells at full size."""

_SURE = 10.0
"""Logit of a pixel that a rough mask holds."""


def _flat(found: Any) -> list[Tensor]:
    """Embeddings as the networks give them, the one of the whole image last."""
    if isinstance(found, Tensor):
        return [found]
    items = list(cast("Sequence[Any]", found))
    if len(items) == 2 and not isinstance(items[1], Tensor):  # SAM-HQ: embedding, then blocks
        return [*cast("Sequence[Tensor]", items[1]), items[0]]
    return cast("list[Tensor]", items)


SAM = network_family(
    "sam",
    "Segment Anything of 2023: masks of parts, objects and groups, and its embedding",
    Checkpoint(id="facebook/sam-vit-base", megabytes=375, licence="Apache-2.0"),
    Checkpoint(id="facebook/sam-vit-large", megabytes=1250, licence="Apache-2.0"),
    Checkpoint(id="facebook/sam-vit-huge", megabytes=2565, licence="Apache-2.0"),
    reference="arXiv:2304.02643",
    gives=("masks", "features"),
    options=SamOptions,
    make=Sam,
)
SAM_HQ = network_family(
    "sam-hq",
    "Segment Anything with finer borders",
    Checkpoint(id="syscv-community/sam-hq-vit-base", megabytes=379, licence="Apache-2.0"),
    reference="arXiv:2306.01567",
    gives=("masks", "features"),
    options=SamOptions,
    make=Sam,
)
SAM2 = network_family(
    "sam2",
    "Segment Anything 2: masks, faster than the first",
    Checkpoint(id="facebook/sam2.1-hiera-small", megabytes=184, licence="Apache-2.0"),
    Checkpoint(id="facebook/sam2.1-hiera-base-plus", megabytes=324, licence="Apache-2.0"),
    Checkpoint(id="facebook/sam2.1-hiera-large", megabytes=898, licence="Apache-2.0"),
    reference="arXiv:2408.00714",
    gives=("masks", "features"),
    options=SamOptions,
    make=Sam,
)
SAM3 = network_family(
    "sam3",
    "Segment Anything 3: its tracker's masks for points and boxes",
    Checkpoint(
        id="facebook/sam3", megabytes=3440, licence="SAM License", note="access must be asked for"
    ),
    reference="arXiv:2511.16719",
    gives=("masks", "features"),
    options=SamOptions,
    make=Sam,
)
