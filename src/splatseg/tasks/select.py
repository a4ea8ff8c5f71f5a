"""Prompts become a selection: once, or again and again in a session."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Self

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatseg.core import (
    JSON,
    Layer,
    LayerInfo,
    PromptableMasks,
    Scene,
    Selection,
)
from splatseg.core.boundary import boundary
from splatseg.errors import InputError, ShapeError
from splatseg.prompting.meanings import segmented_prompts
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
    Lasso,
    SelectionPrompt,
    Similar,
    Solid,
    ViewPrompt,
    prompt_record,
)
from splatseg.prompting.propagation import PropagatedMasks
from splatseg.prompting.seen import ViewCache, VisiblePrompt, see_prompts
from splatseg.render import BackendName
from splatseg.tasks.sources import (
    STEPS,
    OpenedSource,
    SelectMode,
    SelectOptions,
    SourceRequest,
    open_source,
)
from splatseg.tasks.work import SILENT, Observer, Work, check_streams, layer_versions


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
        neighbours: Neighbours of the scene's Gaussians, to share; None finds them when needed.
        views: Prepared views of the scene's Gaussians, to share; None prepares them.
        backend: Rendering backend.
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
        neighbours: SceneIndex | None = None,
        views: ViewCache | None = None,
        backend: BackendName = "auto",
        observer: Observer = SILENT,
    ) -> None:
        self._work = Work(scene=scene, layers=layers, backend=backend, observer=observer)
        self._options = options or SelectOptions()
        self._options.level  # noqa: B018  (an error before anything is opened)
        self._prompter = prompter
        self._views = ViewCache(scene.gaussians, backend=backend) if views is None else views
        self._neighbours = neighbours or SceneIndex(scene.gaussians)
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
        if self._opened is None:
            self._opened = open_source(
                SourceRequest(
                    work=self._work,
                    options=self._options,
                    views=self._views,
                    neighbours=self._neighbours,
                    prompter=self._prompter,
                )
            )
        return self._opened.source

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
        advise: bool = False,
        draft: Callable[[Float[Tensor, "n"]], None] | None = None,
    ) -> Selected:
        """See `splatseg.tasks.select`.

        Args:
            prompts: What to select by.
            base: A selection that this one adds to, is subtracted from or intersected with.
            options: Instead of the session's; they may not ask for another source.
            advise: Whether to look for where the next click would help most.
            draft: Is called with what the source says, before it is cleaned and combined with the
                base: confidences in [0, 1], above 0.5 for what is selected.

        Raises:
            InputError: If the options ask for another source than the session has.
        """
        options = options or self._options
        self._check_source(options)
        given = requested = _as_prompts(prompts)
        check_base(self._work.scene, base, options)
        if advise:
            check_streams(self._work.scene, "next_click")
        seconds: dict[str, float] = {}
        if self._prompter is not None and not self._propagates(given):
            began = time.perf_counter()
            given = segmented_prompts(given, self._prompter, granularity=options.level)
            seconds["prompter"] = time.perf_counter() - began
        shown = [prompt for prompt in given if isinstance(prompt, ViewPrompt)]
        similar = [prompt for prompt in given if isinstance(prompt, Similar)]
        solids = [prompt for prompt in given if isinstance(prompt, Solid)]
        places = [self._views.inside(solid) for solid in solids]
        if shown or similar:
            began = time.perf_counter()
            self.source  # noqa: B018  (opens it)
            seconds["open"] = time.perf_counter() - began
        context = self._seen(shown, options, seconds)
        confidence = self._membership(context, similar, seconds)
        if self._opened is not None:
            # What a source saw may depend on what it was asked.
            context = replace(context, unseen=getattr(self._opened.source, "unseen", None))
        if draft is not None:
            draft(within(confidence, places))
        if shown or similar:
            confidence, steps = postprocess(confidence, context, enabled=self._steps(options))
            seconds |= steps
        confidence = within(confidence, places)
        selection = self._described(confidence, requested, base, options)
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

    def _propagates(self, given: Sequence[SelectionPrompt]) -> bool:
        """Whether the source asks the prompter itself."""
        shown = any(isinstance(prompt, ViewPrompt) for prompt in given)
        return shown and isinstance(self.source, PropagatedMasks)

    def _check_source(self, options: SelectOptions) -> None:
        for name in ("source", "from_layer", "evidence", "threshold"):
            ours, theirs = getattr(self._options, name), getattr(options, name)
            if ours != theirs:
                raise InputError(
                    f"{name}: expected {ours!r} as the session was opened with, got {theirs!r}; "
                    "open another session."
                )

    def _post_processing(self, options: SelectOptions) -> str:
        """The key of `STEPS`."""
        opened, wanted = self._opened, options.post_processing
        if wanted == "auto":
            return "published" if opened is not None and opened.published else "full"
        if wanted == "published" and opened is None:
            return "full"
        if wanted == "published" and opened is not None and opened.name != "features":
            raise InputError(
                f"post_processing: expected a source of features for published, got {opened.name}."
            )
        return wanted

    def _steps(self, options: SelectOptions) -> tuple[StepName, ...]:
        return STEPS[self._post_processing(options)]

    def _seen(
        self, shown: Sequence[ViewPrompt], options: SelectOptions, seconds: dict[str, float]
    ) -> SelectionContext:
        """What prompts in views show."""
        gaussians = self._work.gaussians
        seen: tuple[VisiblePrompt, ...] = ()
        if shown:
            began = time.perf_counter()
            seen = see_prompts(gaussians, shown, seed=options.seed, views=self._views)
            seconds["see"] = time.perf_counter() - began
        published = self._post_processing(options) == "published"
        return SelectionContext(
            gaussians=gaussians,
            prompts=seen,
            views=self._views,
            neighbours=self._neighbours,
            scene_views=self._work.scene.train_views,
            source="" if self._opened is None else self._opened.name,
            published=published,
            granularity=options.level,
        )

    def _membership(
        self, context: SelectionContext, similar: Sequence[Similar], seconds: dict[str, float]
    ) -> Float[Tensor, "n"]:
        """What the source says; everything where only places are given."""
        gaussians = context.gaussians
        if not (context.prompts or similar):
            return torch.ones(len(gaussians), device=gaussians.device)
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
        opened = self._opened
        details: dict[str, JSON] = {"prompts": [prompt_record(prompt) for prompt in prompts]}
        if base is not None:
            details["mode"] = options.mode
            details["base"] = base.info.details.get("prompts", [])
        if opened is not None and isinstance(opened.source, PropagatedMasks):
            details["views_asked"] = [
                {"view": one.view, "agreement": round(one.agreement, 3), "counts": one.accepted}
                for one in opened.source.looked_at
            ]
        views = dict.fromkeys(p.view.name for p in prompts if isinstance(p, ViewPrompt | Lasso))
        record: dict[str, JSON] = {
            "source": "" if opened is None else opened.name,
            "layer": None if opened is None else opened.layer,
            "granularity": options.level,
            "prompter": None if self._prompter is None else self._prompter.name,
            "steps": list(self._steps(options)),
        }
        if opened is not None and opened.rule is not None:
            record["threshold"] = opened.rule
        if self._post_processing(options) == "published":
            record["post_processing"] = "published"
        info = LayerInfo(
            method="select",
            options=record,
            evidence=None if opened is None else opened.evidence,
            views=tuple(views),
            seed=options.seed,
            versions=layer_versions(),
            details=details,
        )
        return replace(selection, info=info)


@boundary
def open_selector(
    scene: Scene,
    *,
    options: SelectOptions | None = None,
    source: MembershipSource | None = None,
    prompter: PromptableMasks | None = None,
    layers: Mapping[str, Layer] | None = None,
    neighbours: SceneIndex | None = None,
    views: ViewCache | None = None,
    backend: BackendName = "auto",
    observer: Observer = SILENT,
) -> SelectionSession:
    """A session whose source is open: each selection takes milliseconds.

    Arguments are those of `SelectionSession`.

    Raises:
        InputError: If the scene has nothing to select by, or not what the options ask for.
    """
    session = SelectionSession(
        scene,
        options=options,
        source=source,
        prompter=prompter,
        layers=layers,
        neighbours=neighbours,
        views=views,
        backend=backend,
        observer=observer,
    )
    session.source  # noqa: B018  (whatever takes long is done before the first click)
    return session


@boundary
def select(
    scene: Scene,
    prompts: SelectionPrompt | Sequence[SelectionPrompt],
    *,
    options: SelectOptions | None = None,
    source: MembershipSource | None = None,
    prompter: PromptableMasks | None = None,
    base: Selection | None = None,
    advise: bool = False,
    layers: Mapping[str, Layer] | None = None,
    backend: BackendName = "auto",
    observer: Observer = SILENT,
) -> Selected:
    """The Gaussians that prompts mean.

    Prompts in views, and `Similar` ones, are answered by a source: masks, features, or a layer of
    the scene. `AxisBox`, `Ball`, `Balls` and `Lasso` bound the answer: of several, all hold.
    Alone, they select all that is inside.

    What the command ``splatseg select`` does. `open_selector` is for more than one selection.

    Args:
        scene: The scene; it stays as it is.
        prompts: One prompt, or several that mean one thing together.
        options: The source, the granularity, and the post-processing.
        source: Says which Gaussians belong together; None opens what `options` ask for.
        prompter: Turns points and boxes into masks of their views, such as SAM; None leaves them.
        base: A selection that `SelectOptions.mode` adds to, subtracts from or intersects with.
        advise: Whether to look for where the next click would help most. Followed on measured
            scenes, the advice does not raise the IoU (docs/selecting.md).
        layers: Layers at hand; others are read from the scene's folder.
        backend: Rendering backend.
        observer: Is told of what is opened.

    Returns:
        The selection with its confidence.

    Raises:
        InputError: If there is nothing to select by, a prompt shows nothing, or prompts
            contradict each other.
        ShapeError: If the base or a layer is of another scene.
    """
    with SelectionSession(
        scene,
        options=options,
        source=source,
        prompter=prompter,
        layers=layers,
        backend=backend,
        observer=observer,
    ) as session:
        return session.select(prompts, base=base, advise=advise)


def _as_prompts(
    prompts: SelectionPrompt | Sequence[SelectionPrompt],
) -> tuple[SelectionPrompt, ...]:
    one = isinstance(prompts, SelectionPrompt)
    given = (prompts,) if one else tuple(prompts)
    if not given:
        raise InputError("prompts: expected at least one, got none.")
    return given


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


def within(
    confidence: Float[Tensor, "n"], places: Sequence[Bool[Tensor, "n"]]
) -> Float[Tensor, "n"]:
    """Confidences inside all places, 0 outside."""
    for inside in places:
        confidence = torch.where(inside.to(confidence.device), confidence, 0.0)
    return confidence
