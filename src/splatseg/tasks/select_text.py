"""Clicks and boxes that a promptable model turns into masks: SAM-based prompts."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, cast

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg.core import JSON, Layer, LayerInfo, PromptableMasks, Scene, Selection
from splatseg.core.boundary import boundary
from splatseg.core.models import GroundedMasks, TextFeatures
from splatseg.core.options import options
from splatseg.errors import InputError
from splatseg.io.evidence import Evidence, FeatureEvidence
from splatseg.lift.referring import referring_readings
from splatseg.lift.vocabulary import vocabulary_of
from splatseg.methods.prompt import PromptOptions, PromptSession, PromptSources, selection_of
from splatseg.prompting.pipeline import SceneIndex, SelectionContext, postprocess
from splatseg.prompting.prompts import Solid, ViewPrompt, prompt_record
from splatseg.prompting.seen import ViewCache
from splatseg.render import BackendName
from splatseg.tasks.query import QueryResult, QuerySession, reference_record
from splatseg.tasks.select import Selected, check_base, combined, within
from splatseg.tasks.sources import STEPS, SelectOptions
from splatseg.tasks.word_sources import QueryOptions, feature_evidence, mask_name
from splatseg.tasks.work import SILENT, Observer, Work, layer_versions

# Prompts as the record of a layer holds them.


# Words become a selection.


_KINDS = ("masks", "panoptic", "tracked")

_MEMBER = 0.501
"""Least confidence of a Gaussian of an object that is meant."""


@options
class TextOptions:
    """What answers words."""

    features: str | None = None
    """Evidence of features in the space of words, such as features_text. None takes the only one
    that there are words for."""

    evidence: str | None = None
    """Evidence of masks. None takes the only one."""

    view: str | None = None
    """View from which left, right, in front and behind are said. None takes the first of
    training."""

    prompt: PromptOptions = field(default_factory=PromptOptions)
    """How words become masks, points and votes; its words and its names of evidence and models are
    ignored."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TextModels:
    """Models that answer instead of what was recorded."""

    grounder: GroundedMasks | None = None
    """Finds what words mean in the initial views, such as LangSAM."""

    prompter: PromptableMasks | None = None
    """Makes masks of points, such as SAM."""

    encoder: TextFeatures | None = None
    """Encodes words that were not recorded with the features."""


@boundary
def select_text(
    scene: Scene,
    words: Sequence[str],
    *,
    options: TextOptions | None = None,
    select_options: SelectOptions | None = None,
    models: TextModels | None = None,
    places: Sequence[Solid] = (),
    base: Selection | None = None,
    backend: BackendName = "auto",
    observer: Observer = SILENT,
) -> Selected:
    """The Gaussians that words mean, as Prompt SA-GS finds them.

    Words are looked for in a few train views, points of the masks found there become points of
    the world, these give a mask in every view, and the masks vote (`methods.prompt`). Phrases that
    refer by relations, orders, counts or negation are resolved among the objects of the scene, as
    `query` does (`lift.referring`); a grounder reads them itself.

    What the command ``splatseg select --text`` does.

    Args:
        scene: The scene; it stays as it is.
        words: Words or phrases, all of which are selected together.
        options: What answers, and how.
        select_options: The mode, the seed, and the post-processing.
        models: Models that answer instead of what was recorded.
        places: Bound the answer: of several, all hold.
        base: A selection that the mode adds to, subtracts from or intersects with.
        backend: Rendering backend.
        observer: Is told of the progress.

    Raises:
        InputError: If the scene has nothing that answers to words, nothing is known of one,
            nothing in it answers, or a phrase is ambiguous and not all objects are wanted: the
            message has the candidates.
    """
    options, models = options or TextOptions(), models or TextModels()
    chosen = select_options or SelectOptions()
    check_base(scene, base, chosen)
    began = time.perf_counter()
    if not scene.train_views:
        raise InputError("views: expected train views to look for words in, the scene has none.")
    work = Work(scene=scene, backend=backend, observer=observer)
    features, masks = _evidence(work, options, models)
    phrases = _referring(words, features, options, models)
    plain = tuple(word for word in words if word.strip() not in phrases)
    parts: list[Selection] = []
    seconds: dict[str, float] = {}
    made_layers: Mapping[str, Layer] = {}
    if plain or not phrases:
        asked = replace(options.prompt, words=plain, point=())
        session = PromptSession(
            scene.gaussians,
            scene.train_views,
            PromptSources(
                features=features,
                masks=masks,
                grounder=models.grounder,
                prompter=models.prompter,
                encoder=models.encoder,
            ),
            options=asked,
            seed=chosen.seed,
            up=scene.up,
            backend=backend,
        )
        seconds["open"] = time.perf_counter() - began
        with observer.stage("select") as step:
            made = session.ask(plain, progress=step)
        seconds |= made.seconds
        parts.append(selection_of(made, session, asked))
    if phrases:
        began = time.perf_counter()
        answers = QuerySession(
            scene,
            options=QueryOptions(
                features=options.features, masks=options.evidence, view=options.view
            ),
            encoder=models.encoder,
            backend=backend,
            observer=observer,
        ).ask(phrases)
        made_layers = answers.made_layers
        parts.append(_referred(answers, several=options.prompt.objects == "all"))
        seconds["refer"] = time.perf_counter() - began
    found = _joined(parts)
    confidence, steps = _cleaned(work, _confidence(found), chosen)
    confidence = within(confidence, [place.contains(scene.gaussians) for place in places])
    selection = combined(Selection.of_confidence(confidence), base, chosen.mode)
    evidence = None if features is None else features.folder.name
    return Selected(
        selection=replace(selection, info=_info(found, places, base, chosen, evidence)),
        seconds={**seconds, **steps},
        source="text",
        warnings=() if selection.count else ("Nothing is selected.",),
        made_layers=made_layers,
    )


def _referring(
    words: Sequence[str],
    features: FeatureEvidence | None,
    options: TextOptions,
    models: TextModels,
) -> tuple[str, ...]:
    """The words that are phrases to resolve among objects."""
    if features is None or options.prompt.phrases == "whole":
        return ()
    vocabulary = vocabulary_of(features, models.encoder)
    return tuple(word.strip() for word in words if referring_readings(word, vocabulary) is not None)


def _referred(answers: QueryResult, *, several: bool) -> Selection:
    """The objects that phrases mean; of ambiguous ones all candidates, or an error."""
    rows = answers.vectors.probabilities.new_zeros(len(answers.index))
    records: list[JSON] = []
    for word, reference in answers.references.items():
        if reference.status == "nothing" or (reference.status == "ambiguous" and not several):
            hint = "" if reference.status == "nothing" else " (all of them with --objects all)"
            raise InputError(f"words: {reference.explanation}{hint}.")
        for one in reference.referents:
            rows[one.thing] = max(one.probability, _MEMBER)
        records.append({"word": word, **reference_record(reference)})
    confidence = answers.index.of_gaussians(rows[:, None])[:, 0].float().clamp(0, 1)
    info = LayerInfo(
        method="query",
        options={**asdict(answers.options), "from_layer": answers.layer},
        details={"prompts": records},
    )
    return Selection.of_confidence(confidence, info=info)


def _joined(parts: Sequence[Selection]) -> Selection:
    """One selection of what words and phrases gave, with all records."""
    first, *others = parts
    if not others:
        return first
    confidence = torch.stack([_confidence(one) for one in parts]).amax(dim=0)
    details = dict(first.info.details)
    details["prompts"] = [
        prompt for one in parts for prompt in cast("list[JSON]", one.info.details["prompts"])
    ]
    return Selection.of_confidence(confidence, info=replace(first.info, details=details))


def _confidence(selection: Selection) -> Float[Tensor, "n"]:
    return selection.mask.float() if selection.confidence is None else selection.confidence


def _evidence(
    work: Work, options: TextOptions, models: TextModels
) -> tuple[FeatureEvidence | None, Evidence | None]:
    """What was recorded and is needed.

    Features are where no grounder finds words, and masks where no prompter makes them, or where
    words are found by them.
    """
    features = None
    if models.grounder is None:
        features = feature_evidence(work, options.features, models.encoder)
    if models.grounder is not None and models.prompter is not None and options.evidence is None:
        return features, None
    name = mask_name(work, options.evidence, option="evidence")
    if name is None:
        return features, None
    masks = work.evidence(name)
    if masks.kind not in _KINDS:
        raise InputError(f"evidence: expected masks or segments, {name!r} has {masks.kind}.")
    return features, masks


def _cleaned(
    work: Work, confidence: Tensor, options: SelectOptions
) -> tuple[Float[Tensor, "n"], Mapping[str, float]]:
    """Without specks and holes, as the selections of clicks are."""
    with ViewCache(work.gaussians, backend=work.backend) as views:
        context = SelectionContext(
            gaussians=work.gaussians,
            prompts=(),
            views=views,
            neighbours=SceneIndex(work.gaussians),
            source="text",
        )
        return postprocess(
            confidence,
            context,
            enabled=STEPS["none" if options.post_processing == "none" else "full"],
        )


def _info(
    found: Selection,
    places: Sequence[Solid],
    base: Selection | None,
    options: SelectOptions,
    evidence: str | None,
) -> LayerInfo:
    """The record of a selection: that of the method, the places, and what it changed."""
    details: dict[str, JSON] = dict(found.info.details)
    asked = cast("list[JSON]", details["prompts"])
    details["prompts"] = [*asked, *(prompt_record(place) for place in places)]
    if base is not None:
        details["mode"] = options.mode
        details["base"] = base.info.details.get("prompts", [])
    return replace(
        found.info,
        evidence=evidence,
        seed=options.seed,
        versions=layer_versions(),
        details=details,
    )


@boundary
def text_prompts(selection: Selection, scene: Scene) -> tuple[ViewPrompt, ...]:
    """The points that stood for words in the initial views, as prompts of these views.

    Args:
        selection: What `select_text` made.
        scene: Its scene.
    """
    found: dict[str, list[tuple[float, float, bool]]] = {}
    for one in cast("list[dict[str, Any]]", selection.info.details.get("prompts", [])):
        for place in one.get("prompts", ()):
            points = found.setdefault(place["view"], [])
            points += [(x, y, True) for x, y in place["points"]]
            points += [(x, y, False) for x, y in place["negative_points"]]
    return tuple(
        ViewPrompt(
            view=scene.view(name),
            points=torch.tensor([[x, y] for x, y, _ in points]),
            positive=torch.tensor([positive for _, _, positive in points]),
        )
        for name, points in sorted(found.items())
        if points
    )


# What is written of a selection beside its layer: splats of it alone, and pictures.
