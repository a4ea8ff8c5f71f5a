"""Words, or points by hand, asked of a scene: found in the initial views, and voted into 3D."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg.core import JSON, Gaussians, PromptableMasks, Rle, View
from splatseg.core.boundary import boundary
from splatseg.core.models import GroundedMasks, TextFeatures
from splatseg.errors import InputError, RangeError
from splatseg.io.evidence import Evidence, FeatureEvidence
from splatseg.lift.vocabulary import Vocabulary, vocabulary_of
from splatseg.methods.prompt.masks import ModelMasks, PromptedMasks, RecordedMasks, mask_table
from splatseg.methods.prompt.options import PromptOptions
from splatseg.methods.prompt.select import (
    PromptShares,
    ViewPoints,
    confidence_of,
    sampled_points,
    vote_for,
    world_prompts,
)
from splatseg.methods.prompt.views import initial_views
from splatseg.methods.prompt.words import (
    CellMatches,
    FoundObject,
    GroundedMatches,
    MaskMatches,
    WordAnswering,
)

_AT_ONCE = 32
"""Objects whose votes are summed at a time: 8 bytes for each and Gaussian."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PromptSources:
    """What a scene has to answer by; which of it is needed is up to the options."""

    features: FeatureEvidence | None = None
    """Features in the space of words."""

    masks: Evidence | None = None
    """Masks of the views."""

    grounder: GroundedMasks | None = None
    prompter: PromptableMasks | None = None
    encoder: TextFeatures | None = None

    @property
    def evidence(self) -> tuple[Evidence, ...]:
        """What was recorded."""
        return tuple(one for one in (self.features, self.masks) if one is not None)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PromptedObject:
    """One object that was asked for."""

    word: str
    """The word that it answers to; empty with points by hand."""

    probability: float
    """That the word means it; 1 with points by hand."""

    points: Sequence[ViewPoints]
    """Points in views."""

    confidence: Float[Tensor, "n"]
    """Probability that each Gaussian belongs to it; above 0.5 it does."""

    projected: int
    """How many views its points were projected into."""

    masks: tuple[tuple[View, Rle], ...]
    """The views that had a mask of it, with the mask of the last round."""

    @property
    def masked(self) -> int:
        """How many views had a mask of it."""
        return len(self.masks)

    def record(self) -> dict[str, JSON]:
        """What a layer keeps of it."""
        points: list[JSON] = []
        for one in self.points:
            place: dict[str, JSON] = {"view": one.view.name}
            for name, wanted in (("points", True), ("negative_points", False)):
                chosen = one.pixels[one.positive == wanted].tolist()
                place[name] = [[float(x), float(y)] for x, y in chosen]
            points.append(place)
        return {
            "word": self.word,
            "probability": round(self.probability, 6),
            "prompts": points,
            "projected_views": self.projected,
            "masked_views": self.masked,
        }


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Prompted:
    """What was asked for."""

    objects: tuple[PromptedObject, ...]

    confidence: Float[Tensor, "n"]
    """Of each Gaussian to belong to one of them."""

    mask_calls: int
    """How often masks were asked for: of words in the initial views, and of points in others."""

    seconds: dict[str, float] = field(default_factory=dict[str, float])
    """Of finding words, and of everything after."""


class PromptSession:
    """Asks a scene again and again; the initial views are read once.

    Args:
        gaussians: The Gaussians of the scene.
        views: Those that may be used.
        sources: What answers.
        options: How; their words and points by hand are not looked at.
        seed: Of random choices.
        up: Where up is: only then is something on something.
        backend: Name of the rendering backend.
    """

    @boundary
    def __init__(
        self,
        gaussians: Gaussians,
        views: Sequence[View],
        sources: PromptSources,
        *,
        options: PromptOptions | None = None,
        seed: int = 0,
        up: tuple[float, float, float] | None = None,
        backend: str = "auto",
    ) -> None:
        if not views:
            raise InputError("views: expected at least one, got none.")
        gaussians.check_values()
        self._gaussians, self._sources = gaussians, sources
        self._options = options or PromptOptions()
        self._seed, self._up, self._backend = seed, up, backend
        self._views = tuple(sorted(views, key=lambda view: view.name))
        self._makers = self._mask_maker()

    @cached_property
    def initial(self) -> tuple[View, ...]:
        """The views that words are looked for in."""
        options = self._options
        known = self._views
        if self._sources.grounder is None:
            for one in self._sources.evidence:
                known = tuple(view for view in known if view.name in set(one.view_names))
        if not known:
            raise InputError(
                "views: expected a view with both features and masks to look for words in, got "
                "none."
            )
        return initial_views(
            known, how=options.initial, count=options.initial_views, seed=self._seed
        )

    @cached_property
    def vocabulary(self) -> Vocabulary:
        """Words that can be asked for, where no grounding model answers."""
        if self._sources.features is None:
            raise InputError(
                "words: expected features in the space of words, or a grounder, got neither."
            )
        return vocabulary_of(self._sources.features, self._sources.encoder)

    @cached_property
    def _answering(self) -> WordAnswering:
        options, sources = self._options, self._sources
        if sources.grounder is not None:
            return GroundedMatches(
                self._gaussians, self.initial, sources.grounder, options, backend=self._backend
            )
        vocabulary = self.vocabulary
        if sources.masks is None or sources.features is None:
            raise InputError(
                "masks: expected evidence of masks, such as masks_sam, to find words by, got none."
            )
        table = mask_table(
            self._gaussians,
            self.initial,
            sources.features,
            sources.masks,
            looks=options.region == "masks" and options.phrases == "parts",
            up=self._up,
            backend=self._backend,
        )
        if options.region == "cells":
            return CellMatches(table, sources.features, vocabulary, options)
        return MaskMatches(table, vocabulary, options)

    @boundary
    def find(self, word: str) -> list[FoundObject]:
        """Objects in the initial views that answer to a word, the surest first.

        Raises:
            InputError: If it is empty, or nothing is known of it.
        """
        if not word.strip():
            raise InputError("words: expected words or phrases, got an empty one.")
        return self._answering.find(word.strip())

    @boundary
    def ask(
        self, words: Sequence[str], *, progress: Callable[[int, int], None] | None = None
    ) -> Prompted:
        """Select what words mean.

        Raises:
            InputError: If there are none, nothing is known of one, nothing in the initial views
                answers to one, or no view has a mask of what does.
        """
        if not words:
            raise InputError("words: expected words or phrases, got none.")
        if self._sources.grounder is None:
            # A word without a vector is told before anything is read.
            self.vocabulary.vectors(words)
        began, before = time.perf_counter(), self._answering.calls
        found: list[FoundObject] = []
        for word in words:
            objects = self.find(word)
            if not objects:
                raise InputError(
                    f"words: nothing in the {len(self.initial)} initial views answers to "
                    f"{word!r}; expected at least {self._options.probability_limit:g} of a mask."
                )
            found += objects
        seconds = {"find": time.perf_counter() - began}
        made = self.select(found, progress=progress)
        return replace(
            made,
            mask_calls=made.mask_calls + self._answering.calls - before,
            seconds=seconds | made.seconds,
        )

    @boundary
    def select(
        self,
        found: Sequence[FoundObject],
        *,
        progress: Callable[[int, int], None] | None = None,
    ) -> Prompted:
        """Select what was found.

        Args:
            found: Objects that `find` gave, or others.
            progress: Called with the views done and all there are.

        Raises:
            InputError: If no view has a mask of an object.
        """
        ranks: dict[str, int] = {}
        given: list[tuple[str, Sequence[ViewPoints]]] = []
        for one in found:
            rank = ranks.get(one.word, 0)
            ranks[one.word] = rank + 1
            key = f"{one.word}/{rank}"
            given.append((key, sampled_points(one, key, self._options, seed=self._seed)))
        about = [(one.word, one.probability) for one in found]
        return self._voted(given, about, progress)

    @boundary
    def ask_points(
        self,
        points: Sequence[tuple[str, float, float]],
        *,
        views: Sequence[View] = (),
        progress: Callable[[int, int], None] | None = None,
    ) -> Prompted:
        """Select what points by hand show, all together one object, as SA-GS does.

        Args:
            points: Name of a view, x and y.
            views: Those that points may lie in, if not only those that may be used.
            progress: Called with the views done and all there are.

        Raises:
            InputError: If there are none, a view does not exist, or no view has a mask of it.
            RangeError: If a point lies outside its picture.
        """
        if not points:
            raise InputError("point: expected at least one, got none.")
        by_name = {view.name: view for view in (*self._views, *views)}
        given: dict[str, list[list[float]]] = {}
        for name, x, y in points:
            if name not in by_name:
                raise InputError(f"point: expected a view of the scene, got {name!r}.")
            camera = by_name[name].camera
            if not (0 <= x < camera.width and 0 <= y < camera.height):
                raise RangeError(
                    f"point: expected pixels of view {name}, {camera.width}x{camera.height}, "
                    f"got ({x:g}, {y:g})."
                )
            given.setdefault(name, []).append([x, y])
        shown = [
            ViewPoints(
                view=by_name[name],
                pixels=torch.tensor(pixels),
                positive=torch.ones(len(pixels), dtype=torch.bool),
            )
            for name, pixels in given.items()
        ]
        return self._voted([("points", shown)], [("", 1.0)], progress)

    def _mask_maker(self) -> PromptedMasks:
        if self._sources.prompter is not None:
            return ModelMasks(self._sources.prompter, self._gaussians, backend=self._backend)
        if self._sources.masks is None:
            raise InputError(
                "masks: expected evidence of masks, such as masks_sam, or a prompter that makes "
                "masks of points, got neither."
            )
        return RecordedMasks(self._sources.masks)

    def _voting_views(self) -> tuple[View, ...]:
        """Views that can have masks of points."""
        if self._sources.prompter is not None or self._sources.masks is None:
            return self._views
        known = set(self._sources.masks.view_names)
        return tuple(view for view in self._views if view.name in known)

    def _voted(
        self,
        given: Sequence[tuple[str, Sequence[ViewPoints]]],
        about: Sequence[tuple[str, float]],
        progress: Callable[[int, int], None] | None,
    ) -> Prompted:
        began = time.perf_counter()
        options, before = self._options, self._makers.calls
        prompts = world_prompts(self._gaussians, given, options, backend=self._backend)
        objects: list[PromptedObject] = []
        for start in range(0, len(prompts), _AT_ONCE):
            part = slice(start, start + _AT_ONCE)
            votes = vote_for(
                self._gaussians,
                self._voting_views(),
                prompts[part],
                self._makers,
                options,
                seed=self._seed,
                backend=self._backend,
                progress=progress,
            )
            objects += _objects(votes, given[part], about[part], options)
        if not any(one.masked for one in objects):
            raise InputError(
                f"masks: expected a mask at the points in at least one of "
                f"{max((one.projected for one in objects), default=0)} views, found none."
            )
        return Prompted(
            objects=tuple(objects),
            confidence=torch.stack([one.confidence for one in objects]).amax(dim=0),
            mask_calls=self._makers.calls - before,
            seconds={"select": time.perf_counter() - began},
        )


def _objects(
    votes: PromptShares,
    given: Sequence[tuple[str, Sequence[ViewPoints]]],
    about: Sequence[tuple[str, float]],
    options: PromptOptions,
) -> list[PromptedObject]:
    return [
        PromptedObject(
            word=about[at][0],
            probability=about[at][1],
            points=given[at][1],
            confidence=confidence_of(votes.shares[at], options.tau),
            projected=votes.projected[at],
            masks=votes.masks[at],
        )
        for at in range(len(given))
    ]
