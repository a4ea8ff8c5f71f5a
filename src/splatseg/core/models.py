"""What a 2D model can be asked. An adapter has the methods of one or several of these protocols.

An image is uint8 (H, W, 3), upright sRGB; what comes back is in the pixels of that image. A model
is a value: it keeps nothing of one image that changes the answer to the next. `splatseg see` asks
which protocols a model has by its methods, so an adapter inherits from nothing.
"""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from splatseg._check import check_finite, check_shape, check_values
from splatseg.core.boundary import boundary, convert_fields
from splatseg.core.evidence import DepthMap, FeatureMap, LabelMap, MaskSet, Segment
from splatseg.core.scene import ClassTable
from splatseg.errors import InputError, RangeError


def signs_of_points(points: Tensor, positive: Tensor | None) -> Tensor:
    """Whether each of the points (p, 2) is on the thing; all are where nothing is said.

    Raises:
        ShapeError: If points are not p x 2, or signs are not of p points.
        RangeError: If a coordinate is not finite.
    """
    check_finite("points", points)
    if positive is None:
        return torch.ones(len(points), dtype=torch.bool)
    return positive.to(torch.bool)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Prompt:
    """What a person points at in an image: points, a box, a rough mask, or several of them."""

    points: Float[Tensor, "p 2"] = field(default_factory=lambda: torch.zeros(0, 2))
    """x to the right and y down, in pixels; the centre of the top-left pixel is (0.5, 0.5)."""

    positive: Bool[Tensor, "p"] | None = None
    """Whether each point is on the thing (True) or not; None means that all are."""

    box: Float[Tensor, "4"] | None = None
    """x0, y0, x1, y1 in pixels: the thing lies inside."""

    mask: Bool[Tensor, "height width"] | None = None
    """A rough mask of the thing, of the image's size."""

    def __post_init__(self) -> None:
        convert_fields(self)
        object.__setattr__(self, "positive", signs_of_points(self.points, self.positive))
        if self.box is not None:
            check_finite("box", self.box)
            x0, y0, x1, y1 = self.box.tolist()
            if not (x0 < x1 and y0 < y1):
                raise RangeError(
                    f"box: expected x0 < x1 and y0 < y1, got ({x0:g}, {y0:g}, {x1:g}, {y1:g})."
                )
        if self.box is None and self.mask is None and not bool(self.signs.any()):
            raise InputError("prompt: expected a positive point, a box or a mask, got none.")

    @property
    def signs(self) -> Bool[Tensor, "p"]:
        """`positive`, never None."""
        all_of_them = torch.ones(len(self.points), dtype=torch.bool)
        return all_of_them if self.positive is None else self.positive

    @boundary
    def check_size(self, height: int, width: int) -> None:
        """Raise `InputError` unless the prompt lies in an image of this size.

        Raises:
            RangeError: If a point lies outside, or the box does not meet the image.
            ShapeError: If the mask has another size.
        """
        limits = torch.tensor([width, height])
        outside = ((self.points < 0) | (self.points > limits)).any(1)
        if bool(outside.any()):
            x, y = self.points[outside][0].tolist()
            raise RangeError(
                f"points: expected pixels of an image of {width}x{height}, got ({x:g}, {y:g})."
            )
        if self.box is not None:
            x0, y0, x1, y1 = self.box.tolist()
            if x0 >= width or y0 >= height or x1 <= 0 or y1 <= 0:
                raise RangeError(
                    f"box: expected one that meets the image of {width}x{height}, "
                    f"got ({x0:g}, {y0:g}, {x1:g}, {y1:g})."
                )
        if self.mask is not None:
            check_shape("mask", self.mask, (height, width))


Image = UInt8[Tensor, "height width 3"]

CANONICAL_PHRASES = ("object", "things", "stuff", "texture")
"""What a word is compared with to say how relevant it is (LERF, Kerr et al. 2023, section 3.3)."""


@runtime_checkable
class Model(Protocol):
    """Name and settings of a model."""

    @property
    def name(self) -> str:
        """How it is asked for, such as ``classical``; recorded with what it gives."""
        ...

    @property
    def settings(self) -> Mapping[str, Any]:
        """All that changes its answers besides the image, in values that JSON holds.

        Weights belong here too, by a revision or a digest. Cached answers are found by it.
        """
        ...

    @property
    def note(self) -> str:
        """What people who use it should know, such as that it is a stand-in; may be empty."""
        ...


@runtime_checkable
class ModelWithDefaults(Model, Protocol):
    """A model that knows the defaults of its settings."""

    @property
    def default_settings(self) -> Mapping[str, Any]:
        """Like `settings`. Work that was begun before a setting existed counts as having these."""
        ...


@runtime_checkable
class BatchedModel(Model, Protocol):
    """A model whose network takes several images at once."""

    @property
    def batch_size(self) -> int:
        """How many images to announce together."""
        ...

    def encode(self, images: Sequence[Image]) -> None:
        """Pass images of one size through the network together.

        Questions about them that come next are answered from that; others as ever.
        """
        ...


@runtime_checkable
class AutomaticMasks(Model, Protocol):
    """Finds the things in an image by itself."""

    def masks(self, image: Image) -> MaskSet:
        """Masks of the image; they may overlap."""
        ...


@runtime_checkable
class ConcurrentMasks(AutomaticMasks, Protocol):
    """Finds the masks of an image in one thread, so those of several images at once."""

    @property
    def concurrent(self) -> bool:
        """Whether several threads may ask at once."""
        ...


@runtime_checkable
class DepthAwareMasks(AutomaticMasks, Protocol):
    """Finds the things in an image better where the depth of what it shows is known."""

    def masks_with_depth(
        self, image: Image, depth: Float[Tensor, "height width"], focal: float
    ) -> MaskSet:
        """Masks of the image; they may overlap.

        Args:
            image: The image.
            depth: z-depth of its pixels in any unit, 0 where there is nothing.
            focal: Focal length in its pixels.
        """
        ...


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Embedding:
    """What a promptable model keeps of an image. A value: it can be cached and sent elsewhere."""

    model: str
    """Name of the model that made it; no other can use it."""

    height: int
    """Rows of the image."""

    width: int
    """Columns of the image."""

    arrays: Mapping[str, Tensor]
    """What the model needs to answer prompts."""

    view: str | None = None
    """Name of the view, for models that go by it."""

    def check_model(self, name: str) -> None:
        """Raise `InputError` unless the model of this name made it."""
        if self.model != name:
            raise InputError(f"embedding: expected one of model {name!r}, got {self.model!r}.")


@runtime_checkable
class PromptableMasks(Model, Protocol):
    """Answers a prompt with masks: the image is encoded once, prompts are cheap."""

    def embed(self, image: Image) -> Embedding:
        """Encode an image."""
        ...

    def prompted_masks(self, embedding: Embedding, prompt: Prompt) -> MaskSet:
        """Masks of what the prompt means, the best first; none where nothing fits."""
        ...


@runtime_checkable
class SemanticLabels(Model, Protocol):
    """Names the class of every pixel, out of a closed set."""

    @property
    def classes(self) -> ClassTable | None:
        """Names of the ids."""
        ...

    def label_map(self, image: Image) -> LabelMap:
        """The class of every pixel, -1 where there is none."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Panoptic:
    """The segments of one image; ids mean something in this image only."""

    ids: LabelMap
    segments: tuple[Segment, ...]
    """One for each id: its class, whether it is a thing, how sure it is."""


@runtime_checkable
class PanopticSegments(Model, Protocol):
    """Divides an image into segments, each with a class out of a closed set."""

    @property
    def categories(self) -> ClassTable | None:
        """Names of the segments' classes."""
        ...

    def panoptic(self, image: Image) -> Panoptic:
        """The segments of an image."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DeepFeatures:
    """Features of one image at several depths of a network."""

    maps: tuple[FeatureMap, ...]
    """From the shallowest to the deepest; at least one."""

    depths: tuple[str, ...]
    """Names of the depths, such as ``block9``."""

    class_token: Float[Tensor, "width"] | None = None
    """One vector of the whole image, where the network has one."""

    def __post_init__(self) -> None:
        convert_fields(self)
        if not self.maps or len(self.maps) != len(self.depths):
            raise InputError(
                f"depths: expected one name a map, at least one, got {len(self.depths)} names of "
                f"{len(self.maps)} maps."
            )


@runtime_checkable
class DenseFeatures(Model, Protocol):
    """Describes every patch of an image by a vector; similar patches have similar vectors."""

    def features(self, image: Image) -> DeepFeatures:
        """Features of an image."""
        ...


@runtime_checkable
class DenseDepth(Model, Protocol):
    """Tells how far the surface at every pixel is."""

    def depth_map(self, image: Image) -> DepthMap:
        """The depth of every pixel: metric, or relative."""
        ...


@runtime_checkable
class Inpainting(Model, Protocol):
    """Paints what is missing in an image from what is around it."""

    def inpaint(self, image: Image, mask: Bool[Tensor, "height width"]) -> Image:
        """The image, painted where the mask is True; what it shows there is not to be used."""
        ...


@runtime_checkable
class TextFeatures(Model, Protocol):
    """Embeds image patches and words in one space; compare by cosine."""

    def text_features(self, image: Image) -> FeatureMap:
        """Unit vectors of the patches of an image."""
        ...

    def encode_text(self, words: Sequence[str]) -> Float[Tensor, "n width"]:
        """Unit vectors of words or phrases."""
        ...


@runtime_checkable
class TextFeaturesWithWords(TextFeatures, Protocol):
    """Text features by a model that was told which words people will ask for."""

    @property
    def words(self) -> tuple[str, ...]:
        """Words whose vectors are written beside the features; may be empty."""
        ...


@runtime_checkable
class LateTextFeatures(TextFeatures, DenseFeatures, Protocol):
    """Text features whose last layers may come after lifting: at each Gaussian, or each voxel."""

    def in_word_space(self, decoded: Float[Tensor, "*n decoder"]) -> Float[Tensor, "*n width"]:
        """Unit vectors in the space of words of what `features` gives, or of means of it."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Boxes:
    """Boxes found for words."""

    boxes: Float[Tensor, "n 4"]
    """x0, y0, x1, y1 in pixels, the surest first."""

    scores: Float[Tensor, "n"]
    """How sure each is, in [0, 1]."""

    words: tuple[int, ...]
    """Index of the word that each box was found for."""

    def __post_init__(self) -> None:
        convert_fields(self)
        check_shape("boxes", self.boxes, (len(self.words), 4))
        check_finite("boxes", self.boxes)
        check_finite("scores", self.scores)


@runtime_checkable
class GroundedBoxes(Model, Protocol):
    """Finds what words mean."""

    def boxes(self, image: Image, words: Sequence[str]) -> Boxes:
        """Boxes of what the words mean, none where they mean nothing here."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TextMasks:
    """Masks found for words. Masks of one word, and of several, may overlap."""

    masks: MaskSet
    """The surest first; `scores` say how sure it is that the word is meant."""

    words: tuple[int, ...]
    """Index of the word that each mask was found for."""

    def __post_init__(self) -> None:
        convert_fields(self)
        if len(self.words) != len(self.masks):
            raise InputError(
                f"words: expected one for each of the {len(self.masks)} masks, got "
                f"{len(self.words)}."
            )


@runtime_checkable
class GroundedMasks(Model, Protocol):
    """Finds what words mean, to the pixel."""

    def grounded_masks(self, image: Image, words: Sequence[str]) -> TextMasks:
        """Masks of what the words mean, none where they mean nothing here."""
        ...


@runtime_checkable
class MaskTracker(Model, Protocol):
    """Follows objects through views that come in the order of a path."""

    def track(
        self, frames: Iterable[tuple[str, Image]], seeds: Mapping[str, LabelMap]
    ) -> Iterator[tuple[str, LabelMap]]:
        """Follow what the seeds mark; one label map a frame, as frames are taken in.

        At a seeded view the result has the seed's ids where it marks pixels, and what was marked
        before in the others. Before the first seed there is nothing to follow: all is -1.

        Args:
            frames: Names and images of views, in order. The next one is taken when the label map
                of the one before was taken. A frame that comes again at once, under the same
                name, is answered anew, as if it came for the first time.
            seeds: Label maps by name of the view that they mark; -1 marks nothing. Ids are those
                of the result: a later seed may bring new ones, and say again where known ones
                are. One is looked up when its frame is taken, so that the mapping may grow.
        """
        ...


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Pointmap:
    """Where the surface lies that each pixel of an image shows."""

    points: Float[Tensor, "rows columns 3"]
    """In the frame of the pair's first camera: x to the right, y down, z forwards. The unit is the
    network's own, and one for both maps of a pair."""

    confidence: Float[Tensor, "rows columns"]
    """How sure each is, from 1 on, where it is not at all. Numbers of one network compare with each
    other."""

    def __post_init__(self) -> None:
        convert_fields(self)
        check_finite("points", self.points)
        check_values("confidence", self.confidence, 1.0, math.inf)


@runtime_checkable
class PointmapModel(Model, Protocol):
    """Sees the geometry of two images at once, as DUSt3R does (arXiv:2312.14132)."""

    def pointmaps(self, first: Image, second: Image) -> tuple[Pointmap, Pointmap]:
        """Points of both images, **both in the frame of the first one's camera**.

        A map may have any number of rows and columns: they divide its image evenly, so that the
        middle of row i lies at (i + 0.5) / rows of the image's height.
        """
        ...
