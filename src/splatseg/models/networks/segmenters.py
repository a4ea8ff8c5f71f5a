"""Mask classification networks: MaskFormer, Mask2Former, OneFormer and EoMT.

Cheng et al. 2021 (arXiv:2107.06278) and 2022 (arXiv:2112.01527), Jain et al. 2022
(arXiv:2211.06220), Kerssies et al. 2025 (arXiv:2503.19108). They name the class of every pixel out
of a closed set, and divide the image into segments.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, cast

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from splatseg.core import ClassTable, LabelMap
from splatseg.core.boundary import convert_fields
from splatseg.core.models import Image, Panoptic
from splatseg.errors import InputError
from splatseg.io.json_files import read_json
from splatseg.models._class_names import network_classes
from splatseg.models._encoded import LastImages
from splatseg.models._family import Checkpoint, Loading
from splatseg.models._images import Frame, Normalisation, frame_of, network_input
from splatseg.models._input_size import InputSize
from splatseg.models._queries import (
    Queries,
    QueryOptions,
    class_scores,
    map_of_scores,
    panoptic_segments,
    semantic_map,
)
from splatseg.models.networks._library import (
    configuration,
    network,
    network_family,
    settings_of,
    side_of,
)
from splatseg.models.networks._tokens import Tokens

Task = Literal["semantic", "panoptic"]

_CLASSES = {
    "maskformer": {"maskformer": "MaskFormerForInstanceSegmentation"},
    "mask2former": {"mask2former": "Mask2FormerForUniversalSegmentation"},
    "oneformer": {"oneformer": "OneFormerForUniversalSegmentation"},
    "eomt": {
        "eomt": "EomtForUniversalSegmentation",
        "eomt_dinov3": "EomtDinov3ForUniversalSegmentation",
    },
}
"""Class of the library by family and the weights' ``model_type``."""

_PUBLISHED_SIZE = InputSize(shortest=800, longest=1333, multiple=32)


@dataclass(frozen=True, slots=True, kw_only=True)
class SegmenterOptions(QueryOptions):
    """Which queries become segments, and which pixels keep their class."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Windows:
    """Scores of classes of an image that was looked at window by window."""

    scores: Float[Tensor, "classes rows columns"]


class Segmenter:
    """Classes of pixels and segments, by a network of queries."""

    def __init__(self, name: str, options: SegmenterOptions, place: Loading) -> None:
        convert_fields(options)
        config = configuration(place, tuple(_CLASSES[name]))
        kind = str(config["model_type"])
        # Text of the things in an image is read while OneFormer learns, and not afterwards.
        extra: dict[str, Any] = {"is_training": False} if kind == "oneformer" else {}
        self._network = network(place, _CLASSES[name][kind], config, **extra)
        self._classes = network_classes(
            config, count=int(self._network.config.num_labels), things=True
        )
        self.name = name
        self.note = f"weights {place.name}; {self._classes.note}"
        self.batch_size = place.images_together
        self._options = options
        self._place = place
        self._normalisation = Normalisation.of(place.folder)
        self._side = (
            side_of(place.folder, self._network.config.image_size) if name == "eomt" else None
        )
        if self._side is not None and place.size not in (None, self._side):
            raise InputError(
                f"size: expected {self._side}, the only one that {place.name} takes, got "
                f"{place.size}."
            )
        self._size = InputSize.of(place.folder, otherwise=_PUBLISHED_SIZE)
        self._tokens = {task: self._task_tokens(task) for task in _TASKS} if extra else {}
        self._last = self._runs(name)
        self._announced: dict[int, Sequence[Image]] = {}

    @property
    def settings(self) -> Mapping[str, Any]:
        """Options, weights, precision and size of the input, 0 where the weights say it."""
        return self._settings(self._options)

    @property
    def default_settings(self) -> Mapping[str, Any]:
        """The same with default options."""
        return self._settings(SegmenterOptions())

    @property
    def classes(self) -> ClassTable:
        """The network's classes, with ids from 1."""
        return self._classes.table

    @property
    def categories(self) -> ClassTable:
        """The same."""
        return self._classes.table

    def encode(self, images: Sequence[Image]) -> None:
        """Remember images of one size; they pass together when the first one is asked about.

        Some of the networks give label maps and segments in passes of their own.
        """
        self._announced = {id(last): images for last in self._last.values()}

    def label_map(self, image: Image) -> LabelMap:
        """The class of every pixel; see `semantic_map`."""
        height, width = (int(side) for side in image.shape[:2])
        found = self._of("semantic", image)
        if isinstance(found, _Windows):
            return map_of_scores(
                found.scores, height, width,
                classes=self._classes, options=self._options, logits=False,
            )  # fmt: skip
        return semantic_map(found, height, width, classes=self._classes, options=self._options)

    def panoptic(self, image: Image) -> Panoptic:
        """The segments of an image; see `panoptic_segments`."""
        height, width = (int(side) for side in image.shape[:2])
        found = cast(Queries, self._of("panoptic", image))
        return panoptic_segments(found, height, width, classes=self._classes, options=self._options)

    def _settings(self, options: SegmenterOptions) -> Mapping[str, Any]:
        return settings_of(options, self._place, size=self._place.size or 0)

    def _runs(self, name: str) -> dict[Task, LastImages[Queries | _Windows]]:
        """What passes images through the network for each task; one for both where it can be."""
        one = LastImages[Queries | _Windows](
            partial(self._encode, "panoptic"), resizable=self._side is None
        )
        if name == "oneformer":
            semantic = LastImages[Queries | _Windows](partial(self._encode, "semantic"))
            return {"panoptic": one, "semantic": semantic}
        if self._side is not None and _in_windows(self._place):
            windows = LastImages[Queries | _Windows](self._encode_windows, resizable=False)
            return {"panoptic": one, "semantic": windows}
        return {"panoptic": one, "semantic": one}

    def _of(self, task: Task, image: Image) -> Queries | _Windows:
        last = self._last[task]
        images = self._announced.pop(id(last), None)
        if images is not None:
            last.encode(images)
        return last.of(image)

    def _frame(self, height: int, width: int) -> Frame:
        if self._side is not None:
            return frame_of(height, width, size=self._side, shape="padded")
        return self._size.frame(height, width, size=self._place.size)

    @torch.inference_mode()
    def _encode(self, task: Task, images: Sequence[Image]) -> list[Queries | _Windows]:
        frame = self._frame(*(int(side) for side in images[0].shape[:2]))
        batch = self._input(images, frame)
        output = self._network(batch, **self._words(task, len(images)))
        covered = (
            frame.inner_height / frame.outer_height,
            frame.inner_width / frame.outer_width,
        )
        return [
            Queries(classes=classes.float(), masks=masks.float(), covered=covered)
            for classes, masks in zip(
                output.class_queries_logits, output.masks_queries_logits, strict=True
            )
        ]

    @torch.inference_mode()
    def _encode_windows(self, images: Sequence[Image]) -> list[Queries | _Windows]:
        """Scores in windows of the network's size along the longer side, averaged over overlaps."""
        side = cast(int, self._side)
        height, width = (int(side) for side in images[0].shape[:2])
        frame = InputSize(shortest=side).frame(height, width)
        batch = self._input(images, frame)
        axis = 2 if height > width else 3
        starts = window_starts(batch.shape[axis], side)
        found: list[Queries | _Windows] = []
        for image in batch:
            windows = [image.narrow(axis - 1, start, side) for start in starts]
            output = self._network(torch.stack(windows))
            total = image.new_zeros(self._classes.count, *image.shape[1:], dtype=torch.float32)
            times = torch.zeros_like(total[:1])
            for i, start in enumerate(starts):
                masks = torch.nn.functional.interpolate(
                    output.masks_queries_logits[i][None].float(), (side, side), mode="bilinear"
                )[0]
                queries = Queries(classes=output.class_queries_logits[i].float(), masks=masks)
                total.narrow(axis - 1, start, side).add_(class_scores(queries, masks))
                times.narrow(axis - 1, start, side).add_(1)
            found.append(_Windows(scores=total / times))
        return found

    def _input(self, images: Sequence[Image], frame: Frame) -> Float[Tensor, "images 3 h w"]:
        return network_input(
            images, frame, self._normalisation, device=self._place.device,
            dtype=self._place.dtype, padding="black",
        )  # fmt: skip

    def _words(self, task: Task, count: int) -> dict[str, Tensor]:
        if not self._tokens:
            return {}
        return {"task_inputs": self._tokens[task].expand(count, -1).to(self._place.device)}

    def _task_tokens(self, task: Task) -> Int64[Tensor, "1 length"]:
        """The sentence that tells OneFormer its task, as numbers; 0 after its end."""
        longest = int(self._network.config.task_seq_len)
        tokens = Tokens(self._place, self._network.config, longest=longest)
        found = tokens.of([f"the task is {task}"], padded_to=longest)
        return found["input_ids"] * found["attention_mask"]


_TASKS: tuple[Task, ...] = ("semantic", "panoptic")


def window_starts(length: int, side: int) -> list[int]:
    """Where windows start that cover an axis, as few as do, spread evenly.

    Example:
        >>> window_starts(1000, 512)
        [0, 488]
    """
    count = -(-length // side)
    return [i * (length - side) // (count - 1) for i in range(count)] if count > 1 else [0]


def _in_windows(place: Loading) -> bool:
    """Whether the weights' label maps are made in windows rather than of the whole image."""
    path = place.folder / "preprocessor_config.json"
    return path.is_file() and read_json(path).get("do_split_image") is True


MASKFORMER = network_family(
    "maskformer",
    "classes of pixels and segments, of 2021",
    Checkpoint(id="facebook/maskformer-swin-base-ade", megabytes=411, licence="other"),
    Checkpoint(id="facebook/maskformer-swin-base-coco", megabytes=411, licence="other"),
    reference="arXiv:2107.06278",
    gives=("panoptic", "labels"),
    options=SegmenterOptions,
    make=Segmenter,
)
MASK2FORMER = network_family(
    "mask2former",
    "classes of pixels and segments, of 2022",
    Checkpoint(id="facebook/mask2former-swin-base-coco-panoptic", megabytes=432, licence="other"),
    Checkpoint(id="facebook/mask2former-swin-large-ade-semantic", megabytes=866, licence="other"),
    Checkpoint(
        id="facebook/mask2former-swin-large-cityscapes-panoptic", megabytes=866, licence="other"
    ),
    reference="arXiv:2112.01527",
    gives=("panoptic", "labels"),
    options=SegmenterOptions,
    make=Segmenter,
)
ONEFORMER = network_family(
    "oneformer",
    "classes of pixels and segments, by a network that is told its task",
    Checkpoint(id="shi-labs/oneformer_ade20k_swin_tiny", megabytes=203, licence="MIT"),
    Checkpoint(id="shi-labs/oneformer_coco_swin_large", megabytes=950, licence="MIT"),
    reference="arXiv:2211.06220",
    gives=("panoptic", "labels"),
    options=SegmenterOptions,
    make=Segmenter,
)
EOMT = network_family(
    "eomt",
    "classes of pixels and segments, by a plain vision transformer",
    Checkpoint(id="tue-mps/coco_panoptic_eomt_large_640", megabytes=1270, licence="MIT"),
    Checkpoint(
        id="tue-mps/ade20k_semantic_eomt_large_512",
        megabytes=1270,
        licence="MIT",
        note="label maps in windows",
    ),
    reference="arXiv:2503.19108",
    gives=("panoptic", "labels"),
    options=SegmenterOptions,
    make=Segmenter,
)
