"""Evidence from a model that is run, directly or through a cache."""

import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from typing_extensions import override

from splatseg._check import check_choice
from splatseg.core import ClassTable, LabelMap, View
from splatseg.core.models import (
    AutomaticMasks,
    BatchedModel,
    DenseDepth,
    DenseFeatures,
    Image,
    MaskTracker,
    Model,
    PanopticSegments,
    SemanticLabels,
    TextFeatures,
    TextFeaturesWithWords,
)
from splatseg.errors import InputError, ShapeError
from splatseg.io.atomic import path_inside
from splatseg.io.evidence import (
    SEGMENTS_FILE,
    EvidenceKind,
    save_depth_map,
    save_features,
    save_label_map,
    save_masks,
    save_segments,
    save_text_embeddings,
)
from splatseg.io.images import load_image
from splatseg.io.json_files import read_json, write_json
from splatseg.models._cache import ModelCache
from splatseg.models._sources import SEGMENT_PARTS, Source, What, some, without_empty
from splatseg.models._words import word_vectors

_PROTOCOLS: dict[What, type[Any]] = {
    "masks": AutomaticMasks,
    "panoptic": PanopticSegments,
    "labels": SemanticLabels,
    "text": TextFeatures,
    "features": DenseFeatures,
    "depth": DenseDepth,
    "tracked": MaskTracker,
}
_KINDS: dict[What, EvidenceKind] = {
    "masks": "masks",
    "panoptic": "panoptic",
    "labels": "labels",
    "text": "features",
    "features": "features",
    "depth": "depth",
    "tracked": "tracked",
}


def abilities(model: Model) -> tuple[What, ...]:
    """What a model can be asked for, the most telling first."""
    return tuple(what for what, protocol in _PROTOCOLS.items() if isinstance(model, protocol))


class Pictures:
    """Pictures of the views that are being looked at, so that several kinds read each once.

    Args:
        image_of: Gives the picture of a view, and may keep it in the folder that evidence is
            written to; None takes photographs.
    """

    def __init__(self, image_of: Callable[[View, Path], Image] | None) -> None:
        self._image_of = image_of
        self._kept: dict[tuple[str, Path | None], Image] = {}

    def of(self, view: View, folder: Path) -> Image:
        """The picture of a view, for evidence that is written to a folder."""
        # What is drawn is kept beside each kind; a photograph is the same for all.
        key = (view.name, folder if view.image is None else None)
        if key not in self._kept:
            self._kept[key] = (
                load_image(view) if self._image_of is None else self._image_of(view, folder)
            )
        return self._kept[key]

    def forget(self) -> None:
        """Let go of the pictures: other views come."""
        self._kept.clear()


def ability(model: Model, what: What | None) -> What:
    """What a model is asked for; None takes the most telling that it can be.

    Raises:
        InputError: If the model cannot give this, or nothing at all.
    """
    can = abilities(model)
    if not can:
        raise InputError(f"model {model.name!r}: expected one that gives evidence of views.")
    if what is None:
        what = can[0]
    check_choice("what", what, _PROTOCOLS)
    if what not in can:
        raise InputError(
            f"model {model.name!r}: expected one of what it gives ({', '.join(can)}), got {what!r}."
        )
    return what


def computed(
    model: Model, *, what: What | None, cache: ModelCache | None, pictures: Pictures
) -> Source:
    """Evidence from running a model on pictures of views, each by itself.

    Raises:
        InputError: If the model cannot give this, or nothing at all.
    """
    what = ability(model, what)
    return _Computed(model=model, asked=what, cache=cache, pictures=pictures)


def batch_of(model: Model) -> int:
    """How many views are looked at together."""
    return max(1, model.batch_size) if isinstance(model, BatchedModel) else 1


def announce(model: Model, targets: Iterable[tuple[Source, Path]], views: Sequence[View]) -> None:
    """Let a model that takes several images at once see those of the next views.

    Images of one size go together.

    Args:
        model: The model.
        targets: What is asked of it, and the folder that each is written to.
        views: The next views.
    """
    if not isinstance(model, BatchedModel) or len(views) < 2:
        return
    images: list[Image] = []
    for source, folder in targets:
        if isinstance(source, _Computed):
            images = max(images, source.announced(views, folder), key=len)
    if len({tuple(image.shape) for image in images}) == 1:
        model.encode(images)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Computed(Source):
    model: Any
    asked: What
    cache: ModelCache | None
    pictures: Pictures
    counts: dict[str, int] = field(default_factory=dict[str, int])
    """Masks by view, for the notes."""

    @property
    @override
    def kind(self) -> EvidenceKind:
        return _KINDS[self.asked]

    @property
    @override
    def what(self) -> str:
        return self.asked

    @property
    @override
    def is_costly(self) -> bool:
        return True

    @property
    @override
    def goes_on(self) -> bool:
        return True

    @override
    def sequence(self, views: Sequence[View]) -> Sequence[View]:
        return views

    @override
    def available(self, views: Sequence[View]) -> frozenset[str]:
        return frozenset(view.name for view in views)

    @override
    def classes(self) -> ClassTable | None:
        if self.asked == "labels":
            return self.model.classes
        return self.model.categories if self.asked == "panoptic" else None

    @override
    def source_ids(self) -> Mapping[int, int] | None:
        return None

    @override
    def details(self) -> Mapping[str, Any]:
        return {}

    @override
    def check_target(self, folder: Path) -> None:
        return None

    @override
    def start(self, folder: Path, views: Sequence[View]) -> None:
        # Words change no feature, so other words may be asked for in a later call.
        knows_words = self.asked == "text" and isinstance(self.model, TextFeaturesWithWords)
        if knows_words and self.model.words:
            save_text_embeddings(word_vectors(self.model), folder)

    @override
    def write(self, folder: Path, view: View) -> int:
        image = self.pictures.of(view, folder)
        if self.asked == "masks":
            masks = without_empty(self._ask(ModelCache.masks, self.model.masks, image))
            self._check_size(view, masks.height, masks.width)
            save_masks(masks, folder, view.name)
            self.counts[view.name] = len(masks)
            return len(masks)
        if self.asked == "labels":
            ids = self._ask(ModelCache.label_map, self.model.label_map, image)
            self._check_size(view, ids.height, ids.width)
            save_label_map(ids, folder, view.name)
        elif self.asked == "panoptic":
            self._write_panoptic(folder, view, image)
        elif self.asked == "depth":
            depth = self._ask(ModelCache.depth_map, self.model.depth_map, image)
            self._check_size(view, depth.height, depth.width)
            save_depth_map(depth, folder, view.name)
        elif self.asked == "features":
            deep = self._ask(ModelCache.features, self.model.features, image)
            for one in deep.maps:
                self._check_size(view, one.height, one.width)
            save_features(deep, folder, view.name)
        else:
            features = self._ask(ModelCache.text_features, self.model.text_features, image)
            self._check_size(view, features.height, features.width)
            save_features(features, folder, view.name)
        return 0

    @override
    def finish(self, folder: Path) -> None:
        if self.asked != "panoptic":
            return
        parts, path = folder / SEGMENT_PARTS, folder / SEGMENTS_FILE
        table = read_json(path) if path.is_file() else {}
        for part in sorted(parts.rglob(SEGMENTS_FILE)):
            table |= read_json(part)
        write_json(table, path_inside(folder, SEGMENTS_FILE))
        shutil.rmtree(parts, ignore_errors=True)

    @override
    def notes(self) -> tuple[str, ...]:
        none = [name for name, count in self.counts.items() if not count]
        if not none:
            return ()
        return (f"{len(none)} of {len(self.counts)} views have no mask at all ({some(none)}).",)

    def announced(self, views: Sequence[View], folder: Path) -> list[Image]:
        """Pictures of views that are asked about next, and that no cache answers for."""
        images = [self.pictures.of(view, folder) for view in views]
        if self.cache is None:
            return images
        return [i for i in images if not self.cache.entry(self.asked, self.model, i).is_file()]

    def _ask(self, cached: Callable[..., Any], direct: Callable[[Image], Any], image: Image) -> Any:
        return direct(image) if self.cache is None else cached(self.cache, self.model, image)

    def _check_size(self, view: View, height: int, width: int) -> None:
        camera = view.camera
        if (height, width) != (camera.height, camera.width):
            raise ShapeError(
                f"model {self.model.name!r}: view {view.name!r}: expected {camera.width}x"
                f"{camera.height} pixels as the photograph has, got {width}x{height}."
            )

    def _write_panoptic(self, folder: Path, view: View, image: Image) -> None:
        found = self._ask(ModelCache.panoptic, self.model.panoptic, image)
        self._check_size(view, found.ids.height, found.ids.width)
        part = path_inside(folder, SEGMENT_PARTS, view.name)
        part.mkdir(exist_ok=True)
        # Before the label map, which is what tells that the view is done.
        save_segments({view.name: found.segments}, part)
        save_label_map(LabelMap(ids=found.ids.ids), folder, view.name)
