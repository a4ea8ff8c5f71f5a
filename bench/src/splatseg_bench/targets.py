"""One thing at a time: a prompt, the method's answer in each view, its agreement with the truth."""

from collections.abc import Iterator, Sequence
from functools import cached_property
from pathlib import Path
from typing import TypeVar, cast

import torch
from torch import Tensor

from splatseg.core import (
    TREE_LEVELS,
    ClassInfo,
    ClassTable,
    Features,
    InstanceTree,
    LabelMap,
    Layer,
    Selection,
    plain_features,
)
from splatseg.errors import InputError
from splatseg.io.atomic import path_inside
from splatseg.io.evidence import create_evidence, save_label_map
from splatseg.io.images import save_png
from splatseg.lift import GaussianField, TextSpace
from splatseg.lift.label_maps import has_classifier
from splatseg.methods.prompt.views import points_inside
from splatseg.prompting.prompts import ViewPrompt
from splatseg_bench.answers import (
    Answer,
    Answering,
    ByFeatures,
    ByIds,
    BySelection,
    Cuttable,
    PromptedMask,
    best_cut,
    ids_mask,
    mask_overlap,
    mask_prompt,
    prompted_mask,
    segments_inside,
    stroke_prompt,
    worded_mask,
)
from splatseg_bench.evidence import Seen
from splatseg_bench.job import Job, LayerSelector, SpokenLayer, asks_for_all, is_affinity
from splatseg_bench.protocols import (
    MaskRow,
    TargetSwitches,
    peak_in_boxes,
    resized_mask,
    score_mask,
)
from splatseg_bench.scene import TargetTask, TrueMask

_LAYER = "layer"
_POINTS = 8
"""Points of a mask that a promptable model is given."""

_THING, _REST = 1, 2
"""Ids of a prompt's mask as evidence."""

_Cut = TypeVar("_Cut", bound=Cuttable)


class TargetRun:
    """A method asked for one thing after another in one scene.

    A method that takes label maps is given the prompt's mask as the label map of one view. A layer
    of instances, a tree or affinity features are made of machine masks first, and `select` answers
    the prompt from them; where the protocol says so, the segments that lie in the prompt's mask
    are taken instead. Other features are asked what is more like the inside of the mask than the
    outside, or more relevant to words than canonical ones.

    Args:
        job: The method and the scene.
    """

    def __init__(self, job: Job) -> None:
        self._job = job
        self._switches = cast(TargetSwitches, job.protocol.switches)
        self._selector = LayerSelector(job)
        self.notes: list[str] = []
        """What should be known of the answers, a sentence each."""

    def rows(self, predictions: Path) -> Iterator[MaskRow]:
        """Each task and scored view in turn; masks are written as PNG of 0 and 255."""
        with self._selector:
            for task in self._job.bench.tasks:
                answers = self._answers(task)
                for true in self.scored(task):
                    yield self._row(task, true, answers, predictions)

    def scored(self, task: TargetTask) -> tuple[TrueMask, ...]:
        """The true masks that count."""
        prompted = {
            one.view
            for one in (task.reference, task.scribble)
            if one is not None and not self._switches.reference_scored
        }
        if self._switches.prompt == "words":
            prompted = set()
        found = tuple(true for true in task.truth if true.view not in prompted)
        if not found:
            raise InputError(f"task {task.name}: expected a view to score besides the prompt's.")
        return found

    def _row(
        self,
        task: TargetTask,
        true: TrueMask,
        answers: Answering | None,
        predictions: Path,
    ) -> MaskRow:
        truth = true.read()
        answer: Answer | None = None
        localised = None
        if answers is not None:
            answer = answers.answer(self._job.scene.view(true.view).camera)
            mask = resized_mask(answer.mask, truth.shape)
            path = path_inside(predictions, task.name, f"{true.view}.png")
            save_png(mask.to(torch.uint8) * 255, path)
        if self._switches.localisation and len(true.boxes):
            relevancy = None if answer is None else answer.relevancy
            localised = relevancy is not None and peak_in_boxes(
                relevancy, true.boxes, (int(truth.shape[0]), int(truth.shape[1]))
            )
        return score_mask(
            None if answer is None else answer.mask,
            truth,
            scene=self._job.bench.name,
            task=task.name,
            view=true.view,
            switches=self._switches,
            localised=localised,
        )

    def _answers(self, task: TargetTask) -> Answering | None:
        """Who answers a task; nobody where it cannot be asked."""
        if self._job.method.returns == "selection":
            return self._by_method(task)
        if self._switches.prompt == "words" and self._job.grounder is None:
            return self._by_words(task)
        if self._selects:
            return self._by_selection(task)
        prompt = self._prompt(task)
        if prompt is None:
            self.notes.append(f"{task.name}: its words were not found in the first view.")
            return None
        if "labels" in self._job.method.evidence:
            return self._by_prompted_labels(task, prompt)
        if isinstance(self._layer, Features) and not has_classifier(self._layer):
            return self._by_prototype(task, prompt, self._layer)
        return self._by_segments(task, prompt)

    def _by_method(self, task: TargetTask) -> BySelection | None:
        """What a method selects that is asked for one thing at a time.

        It is asked by words where these are given, or a grounder was named to find them; else by
        points of the mask, or of the mask that the prompter makes of strokes.
        """
        grounder = self._job.options.grounder
        words = task.words or task.name
        given: PromptedMask | None = None
        asked: dict[str, object] = {"words": (words,)}
        if grounder is not None:
            asked["grounder"] = grounder
        if asks_for_all(words) and "objects" in self._job.method.option_names():
            asked["objects"] = "all"
        if self._switches.prompt != "words" and grounder is None:
            given = self._prompt(task)
            if given is None:
                return None
            inside = points_inside(given.mask, _POINTS).tolist()
            asked = {"point": tuple(f"{given.view}:{x:g},{y:g}" for x, y in inside)}
        try:
            layer = self._job.layer(self._method_seen.name, asked=asked)
        except InputError as error:
            self.notes.append(f"{task.name}: nothing was selected ({error})")
            return None
        if not isinstance(layer, Selection):
            raise InputError(f"method {self._job.method.name}: expected it to give a selection.")
        found = BySelection(
            gaussians=self._job.scene.gaussians,
            selection=layer,
            switches=self._switches,
            backend=self._job.backend,
        )
        return self._with_cut(task, found, given)

    @property
    def _selects(self) -> bool:
        """Whether `select` answers: it does for all layers that it can select by."""
        if self._switches.answered == "segments" or "labels" in self._job.method.evidence:
            return False
        layer = self._layer
        return not isinstance(layer, Features) or has_classifier(layer) or is_affinity(layer)

    def _by_selection(self, task: TargetTask) -> BySelection | None:
        """What `select` answers to strokes as they are, or to a mask."""
        asked: ViewPrompt | None
        if self._switches.prompt == "scribble":
            asked = stroke_prompt(
                self._job.scene, task, self._switches, seed=self._job.options.seed
            )
            mask = None
        else:
            mask = self._prompt(task)
            asked = None if mask is None else mask_prompt(self._job.scene, mask)
        if asked is None:
            self.notes.append(f"{task.name}: its words were not found in the first view.")
            return None
        try:
            selection = self._selector.select(self._layer, asked)
        except InputError as error:
            self.notes.append(f"{task.name}: nothing was selected ({error})")
            return None
        found = BySelection(
            gaussians=self._job.scene.gaussians,
            selection=selection,
            switches=self._switches,
            backend=self._job.backend,
        )
        return self._with_cut(task, found, mask)

    def _prompt(self, task: TargetTask) -> PromptedMask | None:
        if self._job.grounder is not None:
            first = min(true.view for true in self.scored(task))
            return worded_mask(
                GaussianField(self._job.scene.gaussians, backend=self._job.backend),
                self._job.scene.view(first),
                task.words or task.name,
                self._job.grounder,
            )
        return prompted_mask(
            self._job.scene,
            task,
            self._switches,
            prompter=self._job.prompter,
            seed=self._job.options.seed,
        )

    @cached_property
    def _layer(self) -> Layer:
        """The method's layer of machine evidence, made once for all tasks."""
        return self._job.layer(self._job.seen().name)

    @cached_property
    def _field(self) -> GaussianField:
        return self._field_of(self._layer)

    def _field_of(self, layer: Layer) -> GaussianField:
        return GaussianField(self._job.scene.gaussians, {_LAYER: layer}, backend=self._job.backend)

    def _by_prompted_labels(self, task: TargetTask, prompt: PromptedMask) -> ByIds:
        """The prompt's mask lifted from its one view."""
        folder = path_inside(self._job.root, "prompts", self._job.protocol.name)
        source = folder / self._job.bench.name
        source.mkdir(parents=True, exist_ok=True)
        name = f"prompt-{self._job.bench.tasks.index(task)}"
        evidence = create_evidence(source / name, kind="labels", classes=_PROMPT_TABLE)
        ids = torch.where(prompt.mask, _THING, _REST)
        save_label_map(LabelMap(ids=ids), evidence, prompt.view)
        layer = self._job.layer(name, views=(prompt.view,), source=source)
        return self._by_ids(self._field_of(layer), _LAYER, (_THING,))

    def _by_segments(self, task: TargetTask, prompt: PromptedMask) -> ByIds:
        """Segments in the prompt's mask, of the level of a tree that covers it best."""
        tree = isinstance(self._layer, InstanceTree)
        addresses = [f"{_LAYER}@{level}" for level in TREE_LEVELS] if tree else [_LAYER]
        camera = self._job.scene.view(prompt.view).camera
        best, chosen = -1.0, ByIds(
            field=self._field, gaussians=self._job.scene.gaussians, layer=_LAYER, ids=(),
            switches=self._switches,
        )  # fmt: skip
        for address in addresses:
            with self._field.view(camera) as view:
                found = view.label_map(address)
            ids = segments_inside(found, prompt.mask, share=self._switches.segment_share)
            overlap = mask_overlap(ids_mask(found, ids), prompt.mask)
            if overlap > best:
                best, chosen = overlap, self._by_ids(self._field, address, ids)
        return chosen

    def _by_ids(self, field: GaussianField, layer: str, ids: Sequence[int]) -> ByIds:
        return ByIds(
            field=field,
            gaussians=self._job.scene.gaussians,
            layer=layer,
            ids=tuple(ids),
            switches=self._switches,
        )

    def _by_prototype(
        self, task: TargetTask, prompt: PromptedMask, layer: Features
    ) -> ByFeatures | None:
        """What is more like the mean of the prompt's mask than the mean of what is around it."""
        camera = self._job.scene.view(prompt.view).camera
        with self._field.view(camera) as view:
            features = torch.nn.functional.normalize(view.features(_LAYER), dim=-1)
        inside, outside = features[prompt.mask], features[~prompt.mask]
        if not len(inside) or not len(outside):
            return None
        space = TextSpace(width=int(features.shape[-1]))
        return self._with_cut(
            task,
            self._by_features(layer, space, inside.mean(0)[None], outside.mean(0)[None]),
            prompt,
        )

    def _by_words(self, task: TargetTask) -> ByFeatures | BySelection | None:
        """What answers to the words more than to canonical ones, or as the method asks words."""
        words = task.words or task.name
        vocabulary = self._spoken.vocabulary
        if not vocabulary.known(words):
            self.notes.append(f"{task.name}: no vector of its words was recorded.")
            return None
        if self._job.words == "span":
            return self._by_span(task, words)
        layer = plain_features(self._spoken.layer)
        unknown = [word for word in self._switches.negatives if not vocabulary.known(word)]
        if unknown:
            raise InputError(
                f"words: expected vectors of the canonical words, {', '.join(unknown)} have none."
            )
        found = self._by_features(
            layer,
            vocabulary.space,
            vocabulary.vectors([words]),
            vocabulary.vectors(self._switches.negatives),
        )
        return self._with_cut(task, found, None)

    def _by_span(self, task: TargetTask, words: str) -> BySelection:
        """What likelier is the thing than anything else, as `query` answers."""
        found = BySelection(
            gaussians=self._job.scene.gaussians,
            selection=self._spoken.selection(words),
            switches=self._switches,
            backend=self._job.backend,
        )
        return self._with_cut(task, found, None)

    @cached_property
    def _spoken(self) -> SpokenLayer:
        return SpokenLayer(self._job)

    @cached_property
    def _method_seen(self) -> Seen:
        """Evidence of a method that selects: features of words where these find what is asked."""
        words = self._switches.prompt == "words" and self._job.grounder is None
        return self._job.seen(words=words)

    def _by_features(
        self, layer: Features, space: TextSpace, thing: Tensor, others: Tensor
    ) -> ByFeatures:
        seen = torch.ones(len(layer), dtype=torch.bool)
        return ByFeatures(
            field=self._field_of(layer),
            gaussians=self._job.scene.gaussians,
            layer=_LAYER,
            values=layer.values,
            seen=seen if layer.weights is None else layer.weights > 0,
            space=space,
            thing=thing,
            others=others,
            switches=self._switches,
        )

    def _with_cut(self, task: TargetTask, found: _Cut, prompt: PromptedMask | None) -> _Cut:
        """With the cut that the protocol chooses, on the prompt's view or by the truth."""
        if self._switches.threshold == "fixed":
            return found
        if self._switches.threshold == "reference":
            if prompt is None:
                raise InputError(
                    "threshold: expected fixed or oracle with words and strokes, got reference."
                )
            given = [(prompt.view, prompt.mask)]
        else:
            given = [(true.view, true.read()) for true in self.scored(task)]
        views = [self._job.scene.view(name).camera for name, _ in given]
        masks = [
            resized_mask(mask, (camera.height, camera.width))
            for (_, mask), camera in zip(given, views, strict=True)
        ]
        maps = [found.score_map(camera) for camera in views]
        cut = best_cut(lambda cut: [found.mask_at(one, cut) for one in maps], masks)
        return found.with_cut(cut)


_PROMPT_TABLE = ClassTable(
    rows=(
        ClassInfo(id=_THING, name="thing"),
        ClassInfo(id=_REST, name="rest", isthing=False),
    )
)
