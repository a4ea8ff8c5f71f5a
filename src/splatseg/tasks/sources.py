"""What of a scene answers: which layer, features or masks clicks and words are looked up in."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, cast

import torch

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
from splatseg.core.models import LateTextFeatures, PromptableMasks, TextFeatures
from splatseg.core.options import Count, Share, options
from splatseg.errors import InputError, quoted
from splatseg.io.evidence import TEXT_FILE, FeatureEvidence, evidence_header
from splatseg.io.scene import scene_layer_names
from splatseg.lift.vocabulary import Vocabulary, vocabulary_of
from splatseg.methods import find_method
from splatseg.methods.saga import trained_as_published
from splatseg.methods.voxels.words import LastLayers
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
from splatseg.tasks.work import Work

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

_ANSWERING = ("objects", "voxels", "features")
"""Methods whose layers answer words, the best first."""

_ROWS_AT_ONCE = 8192
"""Rows that are widened at a time."""

_DIGITS = 12
"""Of a digest in a message."""

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


@options
class QueryOptions:
    """What answers words, and from which probability."""

    from_layer: str | None = None
    """Layer of features in the space of words that answers. None takes one that `segment --method
    objects` made, or makes it from the evidence; else one of voxels or of features of Gaussians."""

    features: str | None = None
    """Evidence of features in the space of words, such as features_text. None takes the only one
    that has vectors of words."""

    masks: str | None = None
    """Evidence of masks that objects are made from. None takes the only one."""

    min_probability: Share = 0.5
    """Smallest probability, in [0, 1], with which an object answers a word; a word without an
    answer is unknown."""

    every: bool = False
    """Give each Gaussian the likeliest of several words, however unlikely: a closed set of
    classes."""

    components: Count = 32
    """Largest number of directions of the scene's features in which words are compared."""

    phrases: Literal["parts", "whole"] = "parts"
    """How a phrase such as "red mug on the desk" is compared with objects. parts: its name, colour,
    and what it stands on or near count beside its cosine; phrases without a vector of their own
    that relate, order, count or negate are resolved among the objects. whole: the cosine alone."""

    view: str | None = None
    """View from which left, right, in front and behind are said. None takes the first of
    training."""


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
        raise InputError(_which(work, "evidence"))
    return None


def _which(work: Work, option: str) -> str:
    """The refusal to choose one of several sets of masks."""
    names = ", ".join(work.evidence_of("masks"))
    return f"{option}: expected one of the sets of masks by name ({names}), got none."


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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WordSource:
    """Features that answer words, and the words for them."""

    features: Features | VoxelFeatures
    layer: str
    vocabulary: Vocabulary
    last_layers: LastLayers | None = None
    """What leads from features of voxels to the space of words; None where they lie in it."""
    made_layers: Mapping[str, Layer] = field(default_factory=dict[str, Layer])
    """Layers that were made, by the names to keep them under."""


def word_source(
    work: Work, options: QueryOptions, *, encoder: TextFeatures | None, words: Sequence[str]
) -> WordSource:
    """The layer that answers: the one asked for, one of objects, one made now, or another.

    Raises:
        InputError: If there is nothing that answers, or not what is asked for.
    """
    name = options.from_layer or _answering_layer(work, options, ("objects",))
    made: dict[str, Layer] = {}
    if name is None and (masks := mask_name(work, options.masks)) is not None:
        evidence = feature_evidence(work, options.features, encoder)
        last_layers(evidence, encoder)
        if words:
            vocabulary_of(evidence, encoder).vectors(words)
        features = evidence.folder.name
        work.observer.note(f"finding objects by {masks} and their features by {features}")
        there = () if work.scene.root is None else scene_layer_names(work.scene.root)
        name = "objects" if "objects" not in there else f"objects_{masks}"
        method = find_method("objects")
        made[name] = segment_work(
            work,
            method,
            SegmentOptions(evidence=features, layer=name),
            method_options=replace(method.options(), masks=masks),
        ).layer
    name = name or _answering_layer(work, options, _ANSWERING)
    if name is None:
        raise InputError(
            "query: expected masks to find objects by, or a layer of features; make masks with "
            "`splatseg see`, or a layer with `splatseg segment --method features`."
        )
    layer = made.get(name) or work.layer(name, option="from_layer")
    if not isinstance(layer, Features | VoxelFeatures):
        raise InputError(f"from_layer: expected features, {name!r} has none.")
    evidence = feature_evidence(work, options.features or layer.info.evidence, encoder)
    later = last_layers(evidence, encoder)
    if later is not None and isinstance(layer, Features):
        layer = in_word_space(layer, later)
    return WordSource(
        features=layer,
        layer=name,
        vocabulary=vocabulary_of(evidence, encoder),
        last_layers=later,
        made_layers=made,
    )


def _answering_layer(work: Work, options: QueryOptions, methods: tuple[str, ...]) -> str | None:
    """The first layer by the first of some methods, of the features and masks asked for."""
    found: dict[str, str] = {}
    for name in work.layer_names:
        facts = work.facts(name)
        if not issubclass(facts.kind, Features | VoxelFeatures):
            continue
        info = facts.info
        fits = options.features in (None, info.evidence)
        if fits and options.masks in (None, info.options.get("masks")):
            found.setdefault(info.method or "", name)
    return next((found[method] for method in methods if method in found), None)


def mask_name(work: Work, requested: str | None, *, option: str = "masks") -> str | None:
    """Masks to find objects by: the requested ones, or the only ones; `option` names them."""
    if requested is not None:
        work.known_evidence(requested, option=option)
        return requested
    names = list(work.evidence_of("masks"))
    if len(names) > 1:
        raise InputError(_which(work, option))
    return names[0] if names else None


def feature_evidence(work: Work, name: str | None, encoder: TextFeatures | None) -> FeatureEvidence:
    """The evidence of features in the space of words: of this name, or the only one."""
    if name is not None:
        evidence = work.evidence(name)
        if not isinstance(evidence, FeatureEvidence):
            raise InputError(f"features: expected features, {name!r} has {evidence.kind}.")
        return evidence
    evidences = (work.evidence(each) for each in work.evidence_of("features"))
    found = [
        evidence
        for evidence in evidences
        if isinstance(evidence, FeatureEvidence) and _has_words(evidence, encoder)
    ]
    if len(found) == 1:
        return found[0]
    names = ", ".join(each.folder.name for each in found)
    raise InputError(
        f"features: expected one of the sets of features by name ({names}), got none."
        if found
        else "features: expected evidence of features in the space of words, got none; `splatseg "
        "see --model clip --what text` makes some."
    )


def _has_words(evidence: FeatureEvidence, encoder: TextFeatures | None) -> bool:
    """Whether words can be compared: features of a basis into their space, or beside a file."""
    inside = (evidence.folder / TEXT_FILE).is_file()
    beside = (evidence.folder.parent / TEXT_FILE).is_file() and evidence.basis is not None
    return inside or beside or (encoder is not None and evidence.basis is None)


def last_layers(evidence: FeatureEvidence, encoder: TextFeatures | None) -> LastLayers | None:
    """What leads from features to the space of words; None where they lie in it.

    Features that ``see --what features`` wrote lie before the last layers of their model; the
    open-vocabulary voxel paper keeps embeddings so (section 3.3) and applies the last layers of
    the image encoder to each voxel at query time (section 3.5.1).

    Raises:
        InputError: If there is no model, another one, or one whose last layers cannot come later.
    """
    header = evidence_header(evidence.folder) or {}
    made = header.get("metadata")
    record = cast("Mapping[str, Any]", made) if isinstance(made, Mapping) else {}
    if record.get("what") != "features":
        return None
    name = record.get("model")
    features = f"features {evidence.folder.name!r} of {name} lie before its last layers"
    if encoder is None:
        if (evidence.folder / TEXT_FILE).is_file():
            return None
        raise InputError(
            f"model: {features}; expected that model, which leads from them to words (--model "
            f"{name}=WEIGHTS), got none."
        )
    if encoder.name != name:
        raise InputError(
            f"model: {features}; expected that model, which leads from them to words, got "
            f"{encoder.name}."
        )
    if not isinstance(encoder, LateTextFeatures):
        raise InputError(
            f"model: {features}, which {name} cannot apply later; ask with features in the space "
            "of words (`splatseg see --what text`)."
        )
    there = _weights(cast("Mapping[str, Any]", record.get("settings") or {}))
    now = _weights(encoder.settings)
    if there != now:
        raise InputError(
            f"model: {features}; expected its weights {there}, which made them, got {now}."
        )
    return encoder.in_word_space


def in_word_space(features: Features, layers: LastLayers) -> Features:
    """Features of Gaussians after the last layers; rows of zeros, which know nothing, stay so."""
    parts = [
        torch.where((rows.abs().amax(dim=1) > 0)[:, None], layers(rows).float(), 0.0)
        for rows in features.values.detach().cpu().float().split(_ROWS_AT_ONCE)
    ]
    return replace(features, values=torch.cat(parts)) if parts else features


def _weights(settings: Mapping[str, Any]) -> str:
    return quoted(str(settings.get("weights", "unknown"))[:_DIGITS])
