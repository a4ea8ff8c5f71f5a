"""What a protocol asks of a thing, and from a layer and a prompt to masks of views."""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol, Self

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatseg.core import (
    Camera,
    Features,
    Gaussians,
    LabelMap,
    Model,
    Prompt,
    PromptableMasks,
    Scene,
    Selection,
    View,
)
from splatseg.core.models import GroundedMasks, Image
from splatseg.errors import InputError
from splatseg.lift import GaussianField, TextSpace, relevancy
from splatseg.prompting.prompts import ViewPrompt
from splatseg_bench.protocols import (
    TargetSwitches,
    relevancy_mask,
    resized_mask,
    smoothed_relevancy,
    stretched,
)
from splatseg_bench.scene import Scribble, TargetTask

_COVERED = 0.02
"""Alpha up to which a pixel shows nothing."""

CUTS = 100
"""Cuts that are tried where one is chosen."""

_SELECTED = "selected"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Answer:
    """What a method says of one thing in one view."""

    mask: Bool[Tensor, "height width"]
    relevancy: Float[Tensor, "height width"] | None = None
    """Where it comes from a map of relevancy, for its peak."""


class Answering(Protocol):
    """Who answers for a thing."""

    def answer(self, camera: Camera) -> Answer:
        """What is the thing in a view."""
        ...


class Cuttable(Answering, Protocol):
    """An answer that comes from scores, which are cut."""

    def score_map(self, camera: Camera) -> Float[Tensor, "height width"]:
        """The score of each pixel of a view."""
        ...

    def mask_at(
        self, scores: Float[Tensor, "height width"], cut: float
    ) -> Bool[Tensor, "height width"]:
        """What has more than a cut."""
        ...

    def with_cut(self, cut: float) -> Self:
        """The same, cut there."""
        ...


@dataclass(frozen=True, kw_only=True, eq=False)  # no slots: it caches
class ByIds:
    """Ids of a layer stand for the thing."""

    field: GaussianField
    gaussians: Gaussians
    layer: str
    ids: tuple[int, ...]
    switches: TargetSwitches

    def answer(self, camera: Camera) -> Answer:
        """The pixels of these ids, or the silhouette of the Gaussians that have them."""
        if self.switches.decided == "gaussians":
            return Answer(mask=silhouette(self._chosen, camera, self.switches))
        with self.field.view(camera) as view:
            return Answer(mask=ids_mask(view.label_map(self.layer), self.ids))

    @cached_property
    def _chosen(self) -> Gaussians:
        labels = self.field.labels(self.layer)
        return self.gaussians[torch.isin(labels.ids, torch.tensor(self.ids))]


@dataclass(frozen=True, kw_only=True, eq=False)  # no slots: it caches
class BySelection:
    """Gaussians that a prompt selected, each as likely as its confidence says.

    A pixel is as likely as the light of its Gaussians has it, what is behind all of them counting
    as outside; this is how `splatseg render` draws a selection.
    """

    gaussians: Gaussians
    selection: Selection
    switches: TargetSwitches
    backend: str = "auto"
    cut: float = 0.5
    """Probability above which a pixel, or a Gaussian, is taken."""

    def answer(self, camera: Camera) -> Answer:
        """Pixels that are likely, or the silhouette of the Gaussians that are."""
        found = self.score_map(camera)
        if self.switches.decided == "gaussians":
            chosen = self.gaussians[self._probabilities > self.cut]
            mask = silhouette(chosen, camera, self.switches)
        else:
            mask = self.mask_at(found, self.cut)
        return Answer(mask=mask, relevancy=found)

    def score_map(self, camera: Camera) -> Float[Tensor, "height width"]:
        """Probability of each pixel."""
        with self._field.view(camera) as view:
            return view.features(_SELECTED)[..., 0].cpu()

    def mask_at(
        self, scores: Float[Tensor, "height width"], cut: float
    ) -> Bool[Tensor, "height width"]:
        """What is likelier than a cut."""
        return scores > cut

    def with_cut(self, cut: float) -> Self:
        """The same, cut there."""
        return replace(self, cut=cut)

    @property
    def _probabilities(self) -> Float[Tensor, "n"]:
        confidence = self.selection.confidence
        return (self.selection.mask if confidence is None else confidence).float()

    @cached_property
    def _field(self) -> GaussianField:
        layer = Features(values=self._probabilities[:, None])
        return GaussianField(self.gaussians, {_SELECTED: layer}, backend=self.backend)


@dataclass(frozen=True, kw_only=True, eq=False)  # no slots: it caches
class ByFeatures:
    """What is more like the thing than like anything else."""

    field: GaussianField
    gaussians: Gaussians
    layer: str
    values: Float[Tensor, "n channels"]
    """Of Gaussians."""

    seen: Bool[Tensor, "n"]
    """Gaussians that have features."""

    space: TextSpace
    thing: Float[Tensor, "1 width"]
    others: Float[Tensor, "m width"]
    """What it is held against: canonical words, or what lies around it."""

    switches: TargetSwitches
    cut: float | None = None
    """The cut that was chosen; None is the protocol's."""

    def answer(self, camera: Camera) -> Answer:
        """What is relevant in a view."""
        found = self.score_map(camera)
        if self.switches.decided == "gaussians":
            return Answer(mask=silhouette(self._chosen, camera, self.switches), relevancy=found)
        return Answer(mask=relevancy_mask(found, self.switches, cut=self.cut), relevancy=found)

    def mask_at(
        self, scores: Float[Tensor, "height width"], cut: float
    ) -> Bool[Tensor, "height width"]:
        """What is more relevant than a cut, filtered as the protocol has it."""
        return relevancy_mask(scores, self.switches, cut=cut)

    def with_cut(self, cut: float) -> Self:
        """The same, cut there."""
        return replace(self, cut=cut)

    def score_map(self, camera: Camera) -> Float[Tensor, "height width"]:
        """Relevancy of each pixel, filtered; of those that show nothing the least."""
        with self.field.view(camera) as view:
            alpha = view.signals(colour=False).alpha
            features = view.features(self.layer)
        covered = alpha > _COVERED
        values = torch.zeros(alpha.shape)
        values[covered] = self._relevancy_of(features[covered] / alpha[covered][:, None])
        if bool(covered.any()):
            values[~covered] = float(values[covered].min())
        return smoothed_relevancy(values, self.switches)

    @cached_property
    def _chosen(self) -> Gaussians:
        values = torch.zeros(len(self.values))
        values[self.seen] = stretched(self._relevancy_of(self.values[self.seen]), self.switches)
        cut = self.switches.relevancy_cut if self.cut is None else self.cut
        return self.gaussians[values > cut]

    def _relevancy_of(self, values: Float[Tensor, "m channels"]) -> Float[Tensor, "m"]:
        words = torch.cat((self.thing, self.others))
        cosines = self.space.cosines(values, words)
        return relevancy(cosines[..., :1], cosines[..., 1:], temperature=self.switches.temperature)[
            ..., 0
        ]


def silhouette(
    chosen: Gaussians, camera: Camera, switches: TargetSwitches
) -> Bool[Tensor, "height width"]:
    """Where the chosen Gaussians alone stop enough light."""
    if not len(chosen):
        return torch.zeros(camera.height, camera.width, dtype=torch.bool)
    with GaussianField(chosen).view(camera) as view:
        return view.signals(colour=False).alpha > switches.silhouette_cut


def ids_mask(label_map: LabelMap, ids: Sequence[int]) -> Bool[Tensor, "height width"]:
    """Pixels that have one of some ids."""
    return torch.isin(label_map.ids, torch.tensor(list(ids), dtype=label_map.ids.dtype))


def segments_inside(
    label_map: LabelMap, mask: Bool[Tensor, "height width"], *, share: float
) -> tuple[int, ...]:
    """Ids of which at least a share of the pixels lies in a mask, ascending.

    Args:
        label_map: Segments of a view.
        mask: Of the same pixels.
        share: In (0, 1].
    """
    ids, index = torch.unique(label_map.ids, return_inverse=True)
    areas = torch.bincount(index.flatten(), minlength=len(ids))
    inside = torch.bincount(index[mask], minlength=len(ids))
    taken = (inside >= share * areas) & (inside > 0) & (ids >= 0)
    return tuple(int(i) for i in ids[taken])


def best_cut(
    make: Callable[[float], Sequence[Bool[Tensor, "height width"]]],
    truth: Sequence[Bool[Tensor, "height width"]],
) -> float:
    """The cut of 0.01, 0.02, ... whose masks overlap the given ones most; the lowest of equals."""
    best, chosen = -1.0, 0.5
    for step in range(1, CUTS):
        cut = step / CUTS
        overlap = 0.0
        for mask, true in zip(make(cut), truth, strict=True):
            either = int((mask | true).sum())
            overlap += int((mask & true).sum()) / either if either else 1.0
        if overlap > best + 1e-12:
            best, chosen = overlap, cut
    return chosen


def mask_overlap(one: Bool[Tensor, "height width"], other: Bool[Tensor, "height width"]) -> float:
    """Intersection over union; 1 of two empty masks."""
    either = int((one | other).sum())
    return int((one & other).sum()) / either if either else 1.0


# What a protocol gives of a thing, as a mask in one view.


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PromptedMask:
    """The mask of a thing in the view that it is asked for in."""

    view: str
    mask: Bool[Tensor, "height width"]
    """In the photograph's pixels."""


def prompted_mask(
    scene: Scene,
    task: TargetTask,
    switches: TargetSwitches,
    *,
    prompter: Model | None,
    seed: int,
) -> PromptedMask:
    """The mask that is given, or that a model makes of strokes.

    Args:
        scene: The fitted scene.
        task: What is asked for.
        switches: What is given of it.
        prompter: Who answers strokes.
        seed: Of the points that are taken on strokes.

    Raises:
        InputError: If the benchmark gives no such prompt, or the model answers none.
    """
    if switches.prompt == "mask":
        if task.reference is None:
            raise InputError(f"task {task.name}: expected a mask of one view as prompt, got none.")
        camera = scene.view(task.reference.view).camera
        mask = resized_mask(task.reference.read(), (camera.height, camera.width))
        return PromptedMask(view=task.reference.view, mask=mask)
    if task.scribble is None:
        raise InputError(f"task {task.name}: expected strokes in one view as prompt, got none.")
    if not isinstance(prompter, PromptableMasks):
        name = "none" if prompter is None else prompter.name
        raise InputError(f"prompter: expected a model that answers points, got {name}.")
    view = scene.view(task.scribble.view)
    image: Image = view.read_image()
    prompt = scribble_prompt(
        task.scribble, switches, height=view.camera.height, width=view.camera.width,
        seed=_seed_of(seed, task.name),
    )  # fmt: skip
    found = prompter.prompted_masks(prompter.embed(image), prompt)
    if not len(found):
        raise InputError(f"task {task.name}: {prompter.name} found nothing at its strokes.")
    return PromptedMask(view=view.name, mask=found.masks[0].decode())


def worded_mask(
    field: GaussianField, view: View, words: str, grounder: GroundedMasks
) -> PromptedMask | None:
    """What words mean in a view as the scene draws it, all of it together; None for nothing.

    Args:
        field: The scene.
        view: A view; its photograph is not read.
        words: What is asked for.
        grounder: Who finds it.
    """
    with field.view(view.camera) as drawn:
        colour = drawn.signals().colour
    if colour is None:
        raise InputError("field: expected one with colours, got one without.")
    image = (colour.clamp(0, 1) * 255 + 0.5).to(torch.uint8)
    found = grounder.grounded_masks(image, [words]).masks
    if not len(found):
        return None
    together = torch.zeros(view.camera.height, view.camera.width, dtype=torch.bool)
    for mask in found.masks:
        together |= mask.decode()
    return PromptedMask(view=view.name, mask=together)


def mask_prompt(scene: Scene, prompt: PromptedMask) -> ViewPrompt:
    """A mask of a view as `select` takes it."""
    return ViewPrompt(view=scene.view(prompt.view), mask=prompt.mask)


def stroke_prompt(
    scene: Scene, task: TargetTask, switches: TargetSwitches, *, seed: int
) -> ViewPrompt:
    """Strokes as `select` takes them: the pixels that are sampled on their skeletons.

    They stay strokes, of which some pixels may slip over a border, and are no points, each of
    which was meant.

    Args:
        scene: The fitted scene.
        task: What is asked for.
        switches: The shares of the skeletons that are taken.
        seed: Of the sample.

    Raises:
        InputError: If the benchmark gives no strokes, or none on the thing.
    """
    if task.scribble is None:
        raise InputError(f"task {task.name}: expected strokes in one view as prompt, got none.")
    view = scene.view(task.scribble.view)
    height, width = view.camera.height, view.camera.width
    given = scribble_prompt(
        task.scribble, switches, height=height, width=width, seed=_seed_of(seed, task.name)
    )
    drawn = torch.zeros(2, height, width, dtype=torch.bool)
    columns, rows = given.points.long().unbind(dim=1)
    drawn[(~given.signs).long(), rows.clamp_max(height - 1), columns.clamp_max(width - 1)] = True
    return ViewPrompt(
        view=view, scribble=drawn[0], negative_scribble=drawn[1] if bool(drawn[1].any()) else None
    )


def scribble_prompt(
    scribble: Scribble, switches: TargetSwitches, *, height: int, width: int, seed: int
) -> Prompt:
    """Points on the skeletons of strokes, as SAGA samples them.

    A share of the skeleton's pixels, at least one of strokes on the thing, becomes points in the
    middle of the photograph's pixels that they stand for.

    Args:
        scribble: The strokes.
        switches: The shares.
        height: Rows of the photograph.
        width: Columns of it.
        seed: Of the sample.

    Raises:
        InputError: If there is no stroke on the thing.
    """
    on, off = scribble.read()
    generator = torch.Generator().manual_seed(seed)
    scale = torch.tensor([width / on.shape[1], height / on.shape[0]])
    positive = _sampled(on, switches.positive_share, generator, at_least=1)
    negative = _sampled(off, switches.negative_share, generator, at_least=0)
    if not len(positive):
        raise InputError(f"view {scribble.view}: expected a stroke on the thing, got none.")
    points = torch.cat((positive, negative)) * scale
    signs = torch.arange(len(points)) < len(positive)
    return Prompt(points=points, positive=signs)


def _sampled(
    strokes: Bool[Tensor, "height width"],
    share: float,
    generator: torch.Generator,
    *,
    at_least: int,
) -> Float[Tensor, "n 2"]:
    """Centres of a share of the pixels of a skeleton, x and y."""
    from skimage.morphology import skeletonize

    thin = torch.from_numpy(skeletonize(strokes.numpy()))
    pixels = torch.nonzero(thin).flip(1).float() + 0.5
    # Skeletons of single pixels are empty.
    if not len(pixels):
        pixels = torch.nonzero(strokes).flip(1).float() + 0.5
    noise = torch.rand(len(pixels), generator=generator)
    count = min(len(pixels), max(at_least, int((noise > 1 - share).sum())))
    return pixels[noise.argsort(descending=True, stable=True)[:count].sort().values]


def _seed_of(seed: int, task: str) -> int:
    """A seed for each task, whatever other tasks there are."""
    return int.from_bytes(hashlib.sha256(f"{seed}:{task}".encode()).digest()[:4], "little")
