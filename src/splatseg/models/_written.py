"""Evidence view by view: from a model that is run, or copied from what others recorded."""

import shutil
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from splatseg import _native
from splatseg._check import check_choice
from splatseg.core import UNLABELLED, ClassTable, DepthMap, LabelMap, MaskSet, View, camera_of_map
from splatseg.core.models import (
    AutomaticMasks,
    BatchedModel,
    ConcurrentMasks,
    DeepFeatures,
    DenseDepth,
    DenseFeatures,
    Image,
    MaskTracker,
    Model,
    Panoptic,
    PanopticSegments,
    SemanticLabels,
    TextFeatures,
    TextFeaturesWithWords,
)
from splatseg.errors import InputError, ShapeError
from splatseg.io.annotations import AREA_KINDS, AnnotationEvidence
from splatseg.io.atomic import atomic_file, path_inside
from splatseg.io.evidence import (
    SEGMENTS_FILE,
    TEXT_FILE,
    EvidenceKind,
    FeatureEvidence,
    LabelEvidence,
    PanopticEvidence,
    TrackedEvidence,
    check_map_sizes,
    read_id_map,
    save_depth_map,
    save_features,
    save_label_map,
    save_masks,
    save_render,
    save_segments,
    save_text_embeddings,
    save_tracks,
    view_files,
)
from splatseg.io.images import load_image
from splatseg.io.json_files import read_json, write_json
from splatseg.models.networks._words import word_vectors
from splatseg.models.recorded import RecordedModel, check_grid, check_size

_QUESTIONS: dict[str, tuple[type[Any], EvidenceKind, str]] = {
    "masks": (AutomaticMasks, "masks", "masks"),
    "panoptic": (PanopticSegments, "panoptic", "panoptic"),
    "labels": (SemanticLabels, "labels", "label_map"),
    "text": (TextFeatures, "features", "text_features"),
    "features": (DenseFeatures, "features", "features"),
    "depth": (DenseDepth, "depth", "depth_map"),
    "tracked": (MaskTracker, "tracked", "track"),
}
"""The protocol of a question and the kind of evidence that it makes, the most telling first."""

_SEGMENT_PARTS = ".segments"
"""Folder of the segments of single views while panoptic evidence is being written."""

_KINDS_OF_RECORDED = {"labels": ("labels", "tracked"), "text": ("features",)}
"""Kinds of recorded evidence that answer a question, where it is not the kind of its name."""

_SHARED_OF_FEATURES = ("quant.npz", "basis.npz")
_WITH_SEGMENTS = (PanopticEvidence, AnnotationEvidence)


class EvidenceWriter(ABC):
    """Writes evidence of one kind, view by view."""

    resumable: ClassVar[bool] = True
    """Whether work that was stopped can go on at the next view, or begins again."""

    keep_partial: ClassVar[bool] = False
    """Whether views that are written are worth keeping if a later one fails."""

    kind: EvidenceKind
    what: str
    """The question; of recorded evidence its kind."""

    views: Sequence[View]
    """Views that there can be evidence of, in the order in which they are written."""

    classes: ClassTable | None = None
    """Names of the ids."""

    details: Mapping[str, Any]
    """Further metadata."""

    settings: Mapping[str, Any] = MappingProxyType({})
    """What changes the evidence besides the model's settings and the images."""

    reads: Path | None = None
    """Folder of evidence that is read, which is not to be written to."""

    @abstractmethod
    def write(self, folder: Path, view: View, answers: Iterator["Answer"]) -> int:
        """Write one view; gives the number of masks, 0 for other kinds.

        Args:
            folder: Where.
            view: The view.
            answers: What a model says, of which that of this view comes next; other evidence
                leaves them.
        """

    def start(self, folder: Path, views: Sequence[View]) -> None:
        """Write what all views share."""
        return

    def finish(self, folder: Path) -> None:
        """Write what can only be written at the end."""
        return

    def source_ids(self) -> Mapping[int, int] | None:
        """The model's own id by id written, where they differ."""
        return None

    def notes(self) -> tuple[str, ...]:
        """Sentences for the user."""
        return ()


def without_empty(masks: MaskSet) -> MaskSet:
    """The masks that have a pixel."""
    keep = [i for i, mask in enumerate(masks.masks) if mask.area]
    return masks if len(keep) == len(masks) else masks.subset(keep)


def some(names: Sequence[str]) -> str:
    """The first three names, for a sentence."""
    return ", ".join(names[:3]) + (", ..." if len(names) > 3 else "")


def ability(model: Model, what: str | None) -> str:
    """What a model is asked for; None takes the most telling that it can be.

    Raises:
        InputError: If the model cannot give this, or nothing at all.
    """
    can = [one for one, (protocol, *_) in _QUESTIONS.items() if isinstance(model, protocol)]
    if not can:
        raise InputError(f"model {model.name!r}: expected one that gives evidence of views.")
    if what is None:
        return can[0]
    check_choice("what", what, _QUESTIONS)
    if what not in can:
        raise InputError(
            f"model {model.name!r}: expected one of what it gives ({', '.join(can)}), got {what!r}."
        )
    return what


def batch_of(model: Model) -> int:
    """How many views are looked at together."""
    return max(1, model.batch_size) if isinstance(model, BatchedModel) else 1


def threads_for(model: Model, what: Sequence[str], views: int) -> int:
    """How many views are looked at at once in this process, each in a thread."""
    concurrent = isinstance(model, ConcurrentMasks) and model.concurrent
    return min(_native.threads(), views) if concurrent and tuple(what) == ("masks",) else 1


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Look:
    """A model, and what it is asked and shown."""

    model: Any
    what: tuple[str, ...]
    image_of: Callable[[View], Image] | None = None
    """Gives the picture of a view; None takes photographs."""

    depth_of: Callable[[View], Float[Tensor, "height width"]] | None = None
    """Gives the depth of a view to a model whose masks go by it."""

    def picture(self, view: View) -> Image:
        """What the model is shown of a view."""
        with _ONE_VIEW:
            return load_image(view) if self.image_of is None else self.image_of(view)

    def answer(self, view: View, what: str, image: Image) -> Any:
        """What the model says of a view."""
        if what == "masks" and self.depth_of is not None:
            with _ONE_VIEW:
                depth = self.depth_of(view)
            return self.model.masks_with_depth(image, depth, view.camera.fx)
        return getattr(self.model, _QUESTIONS[what][2])(image)


_ONE_VIEW = threading.Lock()
"""Pictures and depths are read and drawn by one thread of a process at a time."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Answer:
    """What a model says of a view to one question."""

    found: Any
    drawn: Image | None
    """The picture that it was shown, where the view has no photograph."""


def answers_of(look: Look, together: Sequence[tuple[View, Sequence[int]]]) -> Iterator[Answer]:
    """Answers to the questions of views that a model looks at together, in their order.

    A model that takes several images at once sees those of one size together.

    Args:
        look: The model.
        together: Views, and the places in `Look.what` of what is asked of each.
    """
    images: dict[str, Image] = {}
    if isinstance(look.model, BatchedModel) and len(together) > 1:
        images = {view.name: look.picture(view) for view, _ in together}
        if len({tuple(image.shape) for image in images.values()}) == 1:
            look.model.encode(list(images.values()))
    for view, questions in together:
        image = images[view.name] if view.name in images else look.picture(view)
        drawn = image if view.image is None else None
        for question in questions:
            yield Answer(found=look.answer(view, look.what[question], image), drawn=drawn)


class ComputedEvidence(EvidenceWriter):
    """Evidence of a model that is run on pictures of views."""

    keep_partial = True

    def __init__(
        self,
        model: Any,
        views: Sequence[View],
        what: str | None,
        *,
        with_depth: bool = False,
    ) -> None:
        self.views = views
        self.details = {}
        self.what = ability(model, what)
        self.kind = _QUESTIONS[self.what][1]
        if self.what in ("labels", "panoptic"):
            self.classes = model.classes if self.what == "labels" else model.categories
        self._model = model
        if with_depth and self.what == "masks":
            self.settings = {"depth_from_scene": True}
        self._counts: dict[str, int] = {}
        """Masks by view, for the notes."""

    @override
    def start(self, folder: Path, views: Sequence[View]) -> None:
        # Words change no feature, so other words may be asked for in a later call.
        knows_words = self.what == "text" and isinstance(self._model, TextFeaturesWithWords)
        if knows_words and self._model.words:
            save_text_embeddings(word_vectors(self._model), folder)

    @override
    def write(self, folder: Path, view: View, answers: Iterator[Answer]) -> int:
        answer = next(answers)
        found = answer.found
        if answer.drawn is not None:
            save_render(answer.drawn, folder, view.name)
        maps: Sequence[Any] = (found,)
        if isinstance(found, DeepFeatures | Panoptic):
            maps = found.maps if isinstance(found, DeepFeatures) else (found.ids,)
        for one in maps:
            check_output(self._model, view, one)
        if isinstance(found, MaskSet):
            masks = without_empty(found)
            save_masks(masks, folder, view.name)
            self._counts[view.name] = len(masks)
            return len(masks)
        if isinstance(found, LabelMap):
            save_label_map(found, folder, view.name)
        elif isinstance(found, Panoptic):
            part = path_inside(folder, _SEGMENT_PARTS, view.name)
            part.mkdir(exist_ok=True)
            # Before the label map, which is what tells that the view is done.
            save_segments({view.name: found.segments}, part)
            save_label_map(LabelMap(ids=found.ids.ids), folder, view.name)
        elif isinstance(found, DepthMap):
            save_depth_map(found, folder, view.name)
        else:
            save_features(found, folder, view.name)
        return 0

    @override
    def finish(self, folder: Path) -> None:
        if self.what != "panoptic":
            return
        parts, path = folder / _SEGMENT_PARTS, folder / SEGMENTS_FILE
        table = read_json(path) if path.is_file() else {}
        for part in sorted(parts.rglob(SEGMENTS_FILE)):
            table |= read_json(part)
        write_json(table, path_inside(folder, SEGMENTS_FILE))
        shutil.rmtree(parts, ignore_errors=True)

    @override
    def notes(self) -> tuple[str, ...]:
        none = [name for name, count in self._counts.items() if not count]
        if not none:
            return ()
        return (f"{len(none)} of {len(self._counts)} views have no mask at all ({some(none)}).",)


def check_output(model: Model, view: View, found: Any) -> None:
    """Refuse what has not the photograph's size."""
    camera = view.camera
    if (found.height, found.width) != (camera.height, camera.width):
        raise ShapeError(
            f"model {model.name!r}: view {view.name!r}: expected {camera.width}x{camera.height} "
            f"pixels as the photograph has, got {found.width}x{found.height}."
        )


class CopiedEvidence(EvidenceWriter):
    """Evidence that others recorded, checked against the views and copied into our own layout."""

    def __init__(
        self, model: RecordedModel, views: Sequence[View], what: str | None, *, allow_missing: bool
    ) -> None:
        evidence = model.evidence
        if isinstance(evidence, AnnotationEvidence):
            evidence = evidence.as_kind(AREA_KINDS.get(what or "", evidence.annotations.kind))
        kinds = _KINDS_OF_RECORDED.get(what or "", (what,))
        if what is not None and evidence.kind not in kinds:
            raise InputError(
                f"{evidence.folder}: expected evidence of {what}, got {evidence.kind}."
            )
        there = frozenset(evidence.view_names)
        lacking = [view.name for view in views if view.name not in there]
        if len(lacking) == len(views):
            raise InputError(
                f"{evidence.folder}: expected evidence of the views asked for ({some(lacking)}), "
                f"got none of them but {len(there)} others ({some(sorted(there))})"
                f"{_ending_hint(lacking, sorted(there))}."
            )
        if lacking and not allow_missing:
            raise InputError(
                f"{evidence.folder}: {len(lacking)} of the {len(views)} views asked for are "
                f"missing ({some(lacking)}); name those that are there, or allow missing ones."
            )
        self.kind = self.what = evidence.kind
        self.views = [view for view in views if view.name in there]
        # Of tracks the classes are those of their categories; tracks name themselves.
        tracks = isinstance(evidence, TrackedEvidence)
        self.classes = evidence.maps.table if tracks else evidence.classes
        self.details = {"views_missing": lacking}
        self.reads = evidence.folder
        self._evidence = evidence
        self._lacking = lacking
        self._empty: list[str] = []
        """Views with empty masks, one entry a mask."""

        self._bare: list[str] = []
        """Views without any mask or id."""

        self._highest = 256
        """The highest id of the maps so far; those of 8 bits end at 255, plus 1."""

        self._enlarged: list[str] = []
        """Sizes of label maps that were smaller than the photograph, one entry a view."""

        self._unnamed: set[int] = set()
        """Ids that the class table does not name."""

    @override
    def source_ids(self) -> Mapping[int, int] | None:
        known = self._evidence.source_ids
        if known is None:
            return None
        return {id: source for id, source in known.items() if id <= self._highest}

    @override
    def start(self, folder: Path, views: Sequence[View]) -> None:
        evidence = self._evidence
        check_map_sizes(evidence, views)
        if evidence.source_ids is not None:
            there = view_files(folder, ".png").values()
            found = (int(read_id_map(path).max(initial=0)) for path in there)
            self._highest = max((self._highest, *found))
        if evidence.kind == "panoptic" and isinstance(evidence, _WITH_SEGMENTS):
            save_segments({view.name: evidence.segments(view.name) for view in views}, folder)
        elif isinstance(evidence, TrackedEvidence):
            save_tracks(evidence.tracks, folder, order=evidence.order)
        elif isinstance(evidence, FeatureEvidence):
            for name in _SHARED_OF_FEATURES:
                _copy(evidence.folder / name, path_inside(folder, name))
            words = evidence.folder / TEXT_FILE
            beside = evidence.folder.absolute().parent / TEXT_FILE
            if evidence.basis is not None or words.is_file():
                _copy(words if words.is_file() else beside, path_inside(folder, TEXT_FILE))

    @override
    def write(self, folder: Path, view: View, answers: Iterator[Answer]) -> int:
        name, size = view.name, (view.camera.height, view.camera.width)
        evidence = self._evidence
        if evidence.kind == "masks":
            masks = evidence.masks(name)
            check_size(evidence, name, (masks.height, masks.width), size)
            whole = without_empty(masks)
            self._empty.extend([name] * (len(masks) - len(whole)))
            if not len(whole):
                self._bare.append(name)
            save_masks(whole, folder, name)
            return len(whole)
        if isinstance(evidence, FeatureEvidence):
            self._write_features(evidence, folder, view)
            return 0
        if evidence.kind == "depth":
            self._write_depth(folder, view)
            return 0
        maps = (
            evidence.maps if isinstance(evidence, (PanopticEvidence, TrackedEvidence)) else evidence
        )
        ids = self._fitted(maps.label_map(name), view)
        check_size(evidence, name, (ids.height, ids.width), size)
        self._note_ids(ids)
        self._highest = max(self._highest, int(ids.ids.max()))
        if not bool((ids.ids != UNLABELLED).any()):
            self._bare.append(name)
        save_label_map(ids, folder, name)
        return 0

    @override
    def notes(self) -> tuple[str, ...]:
        notes = list(self._evidence.notes)
        if self._lacking:
            notes.append(f"{len(self._lacking)} views have no evidence ({some(self._lacking)}).")
        if self._empty:
            views = sorted(set(self._empty))
            notes.append(
                f"{len(self._empty)} masks without a pixel were left out (in {some(views)})."
            )
        if self._bare:
            what = {"masks": "mask", "depth": "depth"}.get(self._evidence.kind, "label")
            notes.append(f"{len(self._bare)} views have no {what} at all ({some(self._bare)}).")
        if self._enlarged:
            sizes = some(sorted(set(self._enlarged)))
            notes.append(
                f"{len(self._enlarged)} label maps were smaller than their photographs ({sizes}) "
                "and enlarged to them, each pixel taking the nearest id."
            )
        if self._unnamed:
            ids = some([str(id) for id in sorted(self._unnamed)])
            notes.append(
                f"Ids that the class table does not name are used ({ids}); --void makes one none."
            )
        return tuple(notes)

    def _fitted(self, ids: LabelMap, view: View) -> LabelMap:
        """A smaller map in the photograph's proportions at its size, each pixel the nearest."""
        height, width = view.camera.height, view.camera.width
        if (ids.height, ids.width) == (height, width):
            return ids
        try:
            camera_of_map(view, ids.height, ids.width)
        except ShapeError:
            return ids  # `check_size` says what is wrong
        self._enlarged.append(f"{ids.width}x{ids.height}")
        rows = ((torch.arange(height) + 0.5) * ids.height / height).long()
        columns = ((torch.arange(width) + 0.5) * ids.width / width).long()
        confidence = None if ids.confidence is None else ids.confidence[rows][:, columns]
        return LabelMap(ids=ids.ids[rows][:, columns], confidence=confidence)

    def _write_depth(self, folder: Path, view: View) -> None:
        """A depth map at its own size: between an object and its background there is no depth."""
        depth = self._evidence.depth_map(view.name)
        try:
            camera_of_map(view, depth.height, depth.width)
        except ShapeError:
            size = (view.camera.height, view.camera.width)
            check_size(self._evidence, view.name, (depth.height, depth.width), size)
        if not bool((depth.values > 0).any()):
            self._bare.append(view.name)
        save_depth_map(depth, folder, view.name)

    def _note_ids(self, ids: LabelMap) -> None:
        table = self._evidence.classes if isinstance(self._evidence, LabelEvidence) else None
        if table is not None:
            named = {row.id for row in table.rows}
            present = {int(id) for id in torch.unique(ids.ids).tolist()}
            self._unnamed.update(present - named - {UNLABELLED})

    def _write_features(self, evidence: FeatureEvidence, folder: Path, view: View) -> None:
        size = view.camera.height, view.camera.width
        if evidence.scale is None:
            deep = evidence.deep_features(view.name)
            for one in deep.maps:
                check_grid(evidence, view.name, one, size)
            save_features(deep, folder, view.name)
            return
        check_grid(evidence, view.name, evidence.features(view.name), size)
        # Quantised features stay as they are: all depths, at their size.
        _copy(evidence.files[view.name], path_inside(folder, f"{view.name}.npz"))


def _ending_hint(names: Sequence[str], others: Sequence[str]) -> str:
    """The option that reads files which are named as views are, with an ending of their own."""
    if all("/" in other for other in others) and names[0] in {o.split("/")[0] for o in others}:
        return "; --what masks reads a folder of pictures a view"
    endings = (other.removeprefix(names[0]) for other in others if other.startswith(names[0]))
    ending = min(endings, key=len, default="")
    if ending and all(other.endswith(ending) for other in others):
        return f"; --suffix {ending} reads them without it"
    return ""


def _copy(source: Path, target: Path) -> None:
    if source.is_file():
        with atomic_file(target) as temporary:
            shutil.copyfile(source, temporary)
