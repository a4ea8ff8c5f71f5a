"""What of a scene answers: which layer, features or masks clicks and words are looked up in."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

from splatseg.core import (
    FeatureMap,
    Features,
    InstanceTree,
    Labels,
    Layer,
    View,
    VoxelFeatures,
    tree_level,
)
from splatseg.core.instance_tree import layer_kind
from splatseg.core.models import PromptableMasks
from splatseg.core.options import options
from splatseg.errors import InputError
from splatseg.methods import find_method
from splatseg.methods.saga import trained_as_published
from splatseg.prompting.feature_source import (
    FeatureMembership,
    FeatureMembershipOptions,
    ThresholdRule,
)
from splatseg.prompting.layer_source import LayerSource
from splatseg.prompting.pipeline import MembershipSource, SceneIndex, StepName
from splatseg.prompting.propagation import PropagatedMasks
from splatseg.prompting.seen import ViewCache
from splatseg.tasks.see import shown_image
from splatseg.tasks.segment import SegmentOptions, segment_work
from splatseg.tasks.word_sources import several_masks
from splatseg.tasks.work import Work, check_streams

SelectMode = Literal["new", "add", "subtract", "intersect"]
SelectThreshold = Literal["auto", "fixed", "adaptive"]
SelectPostProcessing = Literal["auto", "full", "published", "none"]

STEPS: Mapping[str, tuple[StepName, ...]] = {
    "full": ("filter", "grow", "refine", "fill_holes", "hidden"),
    "published": ("filter", "grow"),  # SAGA, section 3.5
    "none": (),
}
"""Steps that follow a source, by `SelectOptions.post_processing`."""

_LEVELS = {"group": 0.0, "object": 0.5, "part": 1.0}

_STEP_REMOVED = "use `post_processing` none, or published"


@options(
    removed={
        **dict.fromkeys(("filter", "grow", "refine", "fill_holes", "hidden"), _STEP_REMOVED),
        "max_pixels": "1024 pixels are looked at",
    }
)
class SelectOptions:
    """What a selection is made from, and its post-processing."""

    source: str = "auto"
    """What decides which Gaussians belong together: features, masks, layer, or propagate (masks
    that the prompter makes in up to eight views, one after another). auto takes the first that
    there is: a tree, affinity features, masks, labels, a prompter."""

    from_layer: str | None = None
    """Layer of features, labels or a tree that the source reads. None takes the one of its kind
    that fits best: a tree before labels of instances before other labels."""

    evidence: str | None = None
    """Name of the masks that the source reads, where there are several; auto then takes them."""

    granularity: str | float = "auto"
    """Size of what a click selects: group, object, part, or a number from 0 (groups) by 0.5
    (objects) to 1 (the finest parts). auto: chosen by the source."""

    threshold: SelectThreshold = "auto"
    """Similarity that features must have. fixed: a cosine of 0.85. adaptive: more than the mean of
    all scores; after masks, mean and deviation of products with 2D features (SAGA, section 3.4).
    auto: adaptive for features trained as published, else fixed."""

    post_processing: SelectPostProcessing = "auto"
    """Steps after the source. full: remove outliers, grow, refine the border, close holes, add what
    no view shows. published: those of SAGA's section 3.5 (features only). none: no steps. auto:
    published for features trained as published, else full."""

    mode: SelectMode = "new"
    """Combination with an existing selection: replace it, add to it, subtract from it, or intersect
    with it."""

    seed: int = 0
    """Seed of all random choices."""

    @property
    def level(self) -> float | None:
        """The granularity as a number, None for the source's choice.

        Raises:
            InputError: If it is neither a level nor a number from 0 to 1.
        """
        if self.granularity == "auto":
            return None
        try:
            level = tree_level(str(self.granularity))
        except InputError:
            raise InputError(
                "granularity: expected auto, group, object, part or a number from 0 to 1, "
                f"got {self.granularity!r}."
            ) from None
        return _LEVELS[level] if isinstance(level, str) else level


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OpenedSource:
    """A source, and what it is to be called."""

    source: MembershipSource
    name: str
    """Its kind: features, masks, layer, or the type of one that was given."""

    layer: str | None = None
    """The layer that it reads."""

    evidence: str | None = None
    """The evidence that it reads."""

    rule: ThresholdRule | None = None
    """The threshold of features."""

    published: bool = False
    """Whether these are features that were trained as published."""

    made_layers: Mapping[str, Layer] = field(default_factory=dict[str, Layer])
    """Layers that were made to open it, by the names to keep them under."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SourceRequest:
    """What an opener may take."""

    work: Work
    options: SelectOptions
    views: ViewCache
    neighbours: SceneIndex
    prompter: PromptableMasks | None = None


Opener = Callable[[SourceRequest], OpenedSource | None]
"""Opens a source; None where the scene has nothing of its kind. What is named and is not there,
or does not fit, is an `InputError`."""


def open_source(request: SourceRequest) -> OpenedSource:
    """The source that the options ask for.

    Raises:
        InputError: If there is no such source, or the scene has nothing to select by.
    """
    options = request.options
    openers: Sequence[Opener] = AUTO
    if options.source != "auto":
        if options.source not in OPENERS:
            known = ", ".join(("auto", *OPENERS))
            raise InputError(f"source: expected one of {known}, got {options.source!r}.")
        openers = (OPENERS[options.source],)
    elif options.evidence is not None:
        openers = (_open_masks,)
    for opener in openers:
        opened = opener(request)
        if opened is not None:
            return opened
    wanted = "masks, features or a layer" if options.source == "auto" else options.source
    raise InputError(
        f"source: expected something that says which Gaussians belong together ({wanted}), and "
        "the scene has none; make masks with `splatseg see` and a layer with `splatseg segment`."
    )


def _open_layer(request: SourceRequest) -> OpenedSource | None:
    """The layer that is named, or the one that says most of instances."""
    work, options = request.work, request.options
    name = options.from_layer or _best_layer(work)
    if name is None:
        return None
    if options.from_layer is None:
        work.observer.note(f"selecting by layer {name} (see from_layer)")
    layer = work.layer(name, option="from_layer")
    if not isinstance(layer, Labels | InstanceTree):
        if options.source == "auto":
            return None
        kind = layer_kind(layer)
        raise InputError(f"from_layer: expected labels or a tree, {name!r} is of {kind}.")
    source = LayerSource(layer, work.gaussians, name=name, views=request.views)
    return OpenedSource(source=source, name="layer", layer=name)


def _open_tree(request: SourceRequest) -> OpenedSource | None:
    """A tree of the scene, where no layer is named."""
    if request.options.from_layer is not None:
        return None
    name = _best_layer(request.work)
    is_tree = name is not None and request.work.facts(name).rank == 0
    return _open_layer(request) if is_tree else None


def _best_layer(work: Work) -> str | None:
    """A tree before labels of instances before other labels; of equals the first by name."""
    ranked = ((work.facts(name).rank, name) for name in work.layer_names)
    return min(((rank, name) for rank, name in ranked if rank is not None), default=(0, None))[1]


def _open_features(request: SourceRequest) -> OpenedSource | None:
    """The layer of features that is named, or the first with affinity features."""
    work, options = request.work, request.options
    affinity = (name for name in work.layer_names if work.facts(name).is_affinity)
    name = options.from_layer or next(affinity, None)
    if name is None:
        return None
    layer = work.layer(name, option="from_layer")
    if isinstance(layer, Features | VoxelFeatures):
        check_streams(work.scene, "source features")
    if isinstance(layer, VoxelFeatures):
        layer = layer.features()
    if not isinstance(layer, Features):
        if options.source == "auto":
            return None
        kind = layer_kind(layer)
        raise InputError(f"from_layer: expected features, {name!r} is of {kind}.")
    published = trained_as_published(layer.info)
    rule = options.threshold
    if rule == "auto":
        rule = "adaptive" if published else "fixed"
    source = FeatureMembership(
        layer,
        work.gaussians,
        options=FeatureMembershipOptions(rule=rule, seed=options.seed),
        guidance=_guidance(work, layer),
    )
    work.observer.note(f"selecting by features {name}, threshold {rule}")
    return OpenedSource(source=source, name="features", layer=name, rule=rule, published=published)


def _guidance(work: Work, layer: Features) -> Callable[[View], FeatureMap | None] | None:
    """Feature maps that features were trained with, where they are still at hand."""
    name = layer.info.options.get("guidance")
    if not isinstance(name, str):
        return None
    try:
        evidence = work.evidence(name)
    except InputError:
        return None
    known = set(evidence.view_names)
    return lambda view: evidence.features(view.name) if view.name in known else None


def _open_masks(request: SourceRequest) -> OpenedSource | None:
    """The tree that masks associate to: one of the scene that was made of them, or made now."""
    work, options = request.work, request.options
    if options.from_layer is not None and options.source == "auto":
        return None
    evidence = _masks(request)
    if evidence is None:
        return None
    for name in work.layer_names:
        facts = work.facts(name)
        if facts.rank == 0 and facts.info.evidence == evidence:
            layer = work.layer(name)
            source = LayerSource(layer, work.gaussians, name=name, views=request.views)
            work.observer.note(f"selecting by masks {evidence}, associated in layer {name}")
            return OpenedSource(source=source, name="masks", layer=name, evidence=evidence)
    work.observer.note(f"masks {evidence} are associated first; the next selection is immediate")
    made = segment_work(work, find_method("associate"), SegmentOptions(evidence=evidence)).layer
    name = evidence if evidence not in work.layer_names else f"{evidence}_tree"
    return OpenedSource(
        source=LayerSource(made, work.gaussians, name=name, views=request.views),
        name="masks",
        layer=name,
        evidence=evidence,
        made_layers={name: made},
    )


def _masks(request: SourceRequest) -> str | None:
    """Name of the masks of the scene or its capture: those asked for, or the only ones."""
    work, wanted = request.work, request.options.evidence
    if wanted is not None:
        found = work.evidence(wanted)
        if found.kind != "masks":
            raise InputError(f"evidence: expected masks, {wanted!r} has {found.kind}.")
        return wanted
    names = work.evidence_of("masks")
    first, second = next(names, None), next(names, None)
    if second is None:
        return first
    # Labels may still answer where nothing was asked for by name.
    if request.options.source == "masks" or _best_layer(work) is None:
        raise InputError(several_masks(work, "evidence"))
    return None


def _open_propagate(request: SourceRequest) -> OpenedSource | None:
    """Masks that the prompter makes in a few views; None without one."""
    work, views = request.work, request.views
    if request.prompter is None:
        if request.options.source == "auto":
            return None
        raise InputError(
            "prompter: expected a model for source propagate, such as classical or recorded masks, "
            "got none."
        )
    check_streams(work.scene, "source propagate")
    source = PropagatedMasks(
        work.scene.train_views,
        request.prompter,
        cache=views,
        neighbours=request.neighbours,
        image_of=lambda view: shown_image(view, views.prepared(view)),
        report=work.observer.note,
    )
    return OpenedSource(source=source, name="propagate")


OPENERS: dict[str, Opener] = {
    "features": _open_features,
    "layer": _open_layer,
    "masks": _open_masks,
    "propagate": _open_propagate,
}
"""Sources by name."""

AUTO: Sequence[Opener] = (
    _open_tree, _open_features, _open_masks, _open_layer, _open_propagate,
)  # fmt: skip
"""What ``auto`` tries: what answers best comes first, and what has to be made after what is there;
labels of classes know no things, and come last (docs/decisions/association.md)."""
