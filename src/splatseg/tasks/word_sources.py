"""What of a scene answers words: which layer of features, and the words of its space."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, cast

import torch

from splatseg.core import (
    Features,
    Layer,
    VoxelFeatures,
)
from splatseg.core.models import LateTextFeatures, TextFeatures
from splatseg.core.options import Count, Share, options
from splatseg.errors import InputError, quoted
from splatseg.io.evidence import TEXT_FILE, FeatureEvidence, evidence_header
from splatseg.io.scene import scene_layer_names
from splatseg.lift.vocabulary import Vocabulary, vocabulary_of
from splatseg.methods import find_method
from splatseg.methods.voxels.words import LastLayers
from splatseg.tasks.segment import SegmentOptions, segment_work
from splatseg.tasks.work import Work

_ANSWERING = ("objects", "voxels", "features")
"""Methods whose layers answer words, the best first."""

_ROWS_AT_ONCE = 8192
"""Rows that are widened at a time."""

_DIGITS = 12
"""Of a digest in a message."""


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
        raise InputError(several_masks(work, option))
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


def several_masks(work: Work, option: str) -> str:
    """The refusal to choose one of several sets of masks."""
    names = ", ".join(work.evidence_of("masks"))
    return f"{option}: expected one of the sets of masks by name ({names}), got none."
