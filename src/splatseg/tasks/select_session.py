"""A session of selecting: what is kept from one selection to the next, and how one is made."""

import importlib.metadata
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Self

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg.core import JSON, Gaussians, Layer, LayerInfo, PromptableMasks, Scene, Selection
from splatseg.core.boundary import boundary
from splatseg.errors import InputError, ShapeError
from splatseg.prompting.next_click import NextClick
from splatseg.prompting.pipeline import (
    MembershipSource,
    SceneIndex,
    SelectionContext,
    SimilaritySource,
    StepName,
    checked_membership,
    next_click,
    postprocess,
)
from splatseg.prompting.prompts import (
    AxisBox,
    Ball,
    Lasso,
    SelectionPrompt,
    Similar,
    Solid,
    ViewPrompt,
)
from splatseg.prompting.seen import SeenPrompt, ViewCache, see_prompts
from splatseg.render import BackendName
from splatseg.tasks._observer import SILENT, Observer
from splatseg.tasks._select_prompter import segmented_prompts
from splatseg.tasks._select_record import prompt_record
from splatseg.tasks._select_sources import Offer, OpenedSource, open_source
from splatseg.tasks.select_options import PUBLISHED_STEPS, SelectMode, SelectOptions


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Selected:
    """A selection, and how it came to be."""

    selection: Selection
    """With the confidence of each Gaussian, and a record of the prompts."""

    seconds: Mapping[str, float]
    """By stage: prompter (masks at points), open (the source), see (the prompts), the source's
    name, and each step."""

    source: str
    """What said which Gaussians belong together; empty where places alone did."""

    next_click: NextClick | None = None
    """Where one more click would help most; None where nobody asked, or nothing is uncertain."""

    warnings: tuple[str, ...] = ()
    """What should be known of it, in sentences."""

    made_layers: Mapping[str, Layer] = field(default_factory=dict[str, Layer])
    """Layers that opening the source made, by the names to keep them under: with them the next
    selection opens at once."""


class SelectionSession:
    """Selects again and again in one scene; a context that releases what it holds.

    It holds the source and the views that were clicked in, and nothing of one selection is left
    for the next: each is made of its prompts alone. `open_selector` makes it.

    Args:
        scene: The scene; it must stay as it is.
        options: What holds for selections that say nothing else.
        source: Says which Gaussians belong together; None opens what `options` ask for, when the
            first prompt needs it.
        prompter: Turns points and boxes into masks of their views, such as SAM; None leaves them.
        layers: Layers at hand; others are read from the scene's folder.
        backend: Who renders.
        observer: Is told of what is opened.
    """

    @boundary
    def __init__(
        self,
        scene: Scene,
        *,
        options: SelectOptions | None = None,
        source: MembershipSource | None = None,
        prompter: PromptableMasks | None = None,
        layers: Mapping[str, Layer] | None = None,
        backend: BackendName = "auto",
        observer: Observer = SILENT,
    ) -> None:
        self._scene = scene
        self._options = options or SelectOptions()
        self._options.level  # noqa: B018  (an error before anything is opened)
        self._prompter = prompter
        self._layers = layers
        self._backend: BackendName = backend
        self._observer = observer
        self._views = ViewCache(scene.gaussians, backend=backend)
        self._neighbours = SceneIndex(scene.gaussians)
        self._opened = (
            None if source is None else OpenedSource(source=source, name=type(source).__name__)
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Release the views that it holds."""
        self._views.close()

    @property
    def source(self) -> MembershipSource:
        """What says which Gaussians belong together.

        Raises:
            InputError: If the scene has nothing to select by.
        """
        return self._open().source

    @property
    def made_layers(self) -> Mapping[str, Layer]:
        """Layers that opening the source made, by the names to keep them under; see `Selected`."""
        return {} if self._opened is None else self._opened.made_layers

    @boundary
    def select(
        self,
        prompts: SelectionPrompt | Sequence[SelectionPrompt],
        *,
        base: Selection | None = None,
        options: SelectOptions | None = None,
        advise: bool = True,
    ) -> Selected:
        """See `splatseg.tasks.select`.

        Args:
            prompts: What to select by.
            base: A selection that this one adds to, is subtracted from or intersected with.
            options: Instead of the session's; they may not ask for another source.
            advise: Whether to look for where the next click would help most.

        Raises:
            InputError: If the options ask for another source than the session has.
        """
        options = options or self._options
        self._check_source(options)
        asked = given = _as_prompts(prompts)
        check_base(self._scene, base, options)
        seconds: dict[str, float] = {}
        if self._prompter is not None:
            began = time.perf_counter()
            given = segmented_prompts(given, self._prompter, granularity=options.level)
            seconds["prompter"] = time.perf_counter() - began
        shown = [prompt for prompt in given if isinstance(prompt, ViewPrompt)]
        similar = [prompt for prompt in given if isinstance(prompt, Similar)]
        solids = [prompt for prompt in given if isinstance(prompt, AxisBox | Ball | Lasso)]
        if shown or similar:
            began = time.perf_counter()
            self._open()
            seconds["open"] = time.perf_counter() - began
        context = self._seen(shown, options, seconds)
        confidence = self._membership(context, similar, seconds)
        if shown or similar:
            enabled = _steps(options, published=self._published(options))
            confidence, steps = postprocess(confidence, context, enabled=enabled)
            seconds |= steps
        confidence = within(confidence, solids, self._scene.gaussians)
        selection = self._described(confidence, asked, base, options)
        hint = None
        if advise and shown and selection.confidence is not None:
            began = time.perf_counter()
            hint = next_click(selection.confidence, context)
            seconds["next_click"] = time.perf_counter() - began
        return Selected(
            selection=selection,
            seconds=seconds,
            source=context.source,
            next_click=hint,
            warnings=() if selection.count else ("Nothing is selected.",),
            made_layers=self.made_layers,
        )

    def _open(self) -> OpenedSource:
        if self._opened is None:
            self._opened = open_source(
                Offer(
                    scene=self._scene,
                    options=self._options,
                    views=self._views,
                    layers=self._layers,
                    observer=self._observer,
                    backend=self._backend,
                )
            )
        return self._opened

    def _check_source(self, options: SelectOptions) -> None:
        for name in ("source", "from_layer", "evidence", "threshold"):
            ours, theirs = getattr(self._options, name), getattr(options, name)
            if ours != theirs:
                raise InputError(
                    f"{name}: expected {ours!r} as the session was opened with, got {theirs!r}; "
                    "open another session."
                )

    def _published(self, options: SelectOptions) -> bool:
        """Whether section 3.5 follows to the letter."""
        opened = self._opened
        if options.post_processing == "auto":
            return opened is not None and opened.published
        if options.post_processing == "own" or opened is None:
            return False
        if opened.name != "features":
            raise InputError(
                f"post_processing: expected a source of features for published, got {opened.name}."
            )
        return True

    def _seen(
        self, shown: Sequence[ViewPrompt], options: SelectOptions, seconds: dict[str, float]
    ) -> SelectionContext:
        """What prompts in views show."""
        seen: tuple[SeenPrompt, ...] = ()
        if shown:
            began = time.perf_counter()
            seen = see_prompts(
                self._scene.gaussians,
                shown,
                max_pixels=options.max_pixels,
                seed=options.seed,
                views=self._views,
            )
            seconds["see"] = time.perf_counter() - began
        return SelectionContext(
            gaussians=self._scene.gaussians,
            prompts=seen,
            views=self._views,
            neighbours=self._neighbours,
            unseen=None if self._opened is None else getattr(self._opened.source, "unseen", None),
            scene_views=self._scene.train_views,
            source="" if self._opened is None else self._opened.name,
            published=self._published(options),
            granularity=options.level,
        )

    def _membership(
        self, context: SelectionContext, similar: Sequence[Similar], seconds: dict[str, float]
    ) -> Float[Tensor, "n"]:
        """What the source says; everything where only places are given."""
        gaussians = context.gaussians
        confidence = torch.ones(len(gaussians), device=gaussians.device)
        if not (context.prompts or similar):
            return confidence
        began = time.perf_counter()
        source, name = self.source, context.source
        found: list[Tensor] = []
        if context.prompts:
            found.append(source.membership(context.prompts, granularity=context.granularity))
        if similar and not isinstance(source, SimilaritySource):
            raise InputError(
                f"similar: expected a source that knows which things are alike, {name} does not; "
                "a layer with classes does."
            )
        if isinstance(source, SimilaritySource):
            found += [source.similar(prompt.selection) for prompt in similar]
        checked = [checked_membership(one, gaussians, source=name) for one in found]
        # What is shown and what is like another are one set together.
        confidence = torch.stack(checked).amax(dim=0)
        seconds[name] = time.perf_counter() - began
        return confidence

    def _described(
        self,
        confidence: Tensor,
        prompts: Sequence[SelectionPrompt],
        base: Selection | None,
        options: SelectOptions,
    ) -> Selection:
        """The selection with what it adds to, and the record of both."""
        selection = combined(Selection.of_confidence(confidence), base, options.mode)
        opened, published = self._opened, self._published(options)
        details: dict[str, JSON] = {"prompts": [prompt_record(prompt) for prompt in prompts]}
        if base is not None:
            details["mode"] = options.mode
            details["base"] = base.info.details.get("prompts", [])
        views = dict.fromkeys(p.view.name for p in prompts if isinstance(p, ViewPrompt | Lasso))
        info = LayerInfo(
            method="select",
            options={
                "source": "" if opened is None else opened.name,
                "layer": None if opened is None else opened.layer,
                "granularity": options.level,
                "prompter": None if self._prompter is None else self._prompter.name,
                "steps": list(_steps(options, published=published)),
                **({} if opened is None or opened.rule is None else {"threshold": opened.rule}),
                **({"post_processing": "published"} if published else {}),
            },
            evidence=None if opened is None else opened.evidence,
            views=tuple(views),
            seed=options.seed,
            versions={
                "splatseg": importlib.metadata.version("splatseg"),
                "torch": str(torch.__version__),
            },
            details=details,
        )
        return replace(selection, info=info)


def _as_prompts(
    prompts: SelectionPrompt | Sequence[SelectionPrompt],
) -> tuple[SelectionPrompt, ...]:
    given = (
        (prompts,)
        if isinstance(prompts, ViewPrompt | AxisBox | Ball | Lasso | Similar)
        else tuple(prompts)
    )
    if not given:
        raise InputError("prompts: expected at least one, got none.")
    return given


def _steps(options: SelectOptions, *, published: bool) -> tuple[StepName, ...]:
    """The steps that are on; of the published ones where section 3.5 is followed."""
    return tuple(name for name in options.steps if not published or name in PUBLISHED_STEPS)


def combined(selection: Selection, base: Selection | None, mode: SelectMode) -> Selection:
    """A selection added to, subtracted from or intersected with an earlier one.

    Args:
        selection: The new one.
        base: The earlier one; None where there is none.
        mode: How.
    """
    if base is None:
        return selection
    match mode:
        case "add":
            return base | selection
        case "subtract":
            return base - selection
        case "intersect":
            return base & selection
        case "new":
            return selection


def check_base(scene: Scene, base: Selection | None, options: SelectOptions) -> None:
    """Raise `InputError` unless there is a base where the mode wants one, of the same scene."""
    if (base is None) != (options.mode == "new"):
        raise InputError(
            "base: expected a selection with mode add, subtract or intersect and none with new, "
            f"got {'none' if base is None else 'one'} with {options.mode}."
        )
    if base is not None and len(base) != len(scene.gaussians):
        raise ShapeError(
            f"base: expected a selection of {len(scene.gaussians)} Gaussians, those of the scene, "
            f"got one of {len(base)}; it is of another scene."
        )


def within(confidence: Tensor, solids: Sequence[Solid], gaussians: Gaussians) -> Float[Tensor, "n"]:
    """Confidences inside all places, 0 outside."""
    for solid in solids:
        inside = solid.contains(gaussians).to(confidence.device)
        confidence = torch.where(inside, confidence, 0.0)
    return confidence
