"""Words become a selection."""

import importlib.metadata
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, cast

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg.core import JSON, LayerInfo, PromptableMasks, Scene, Selection
from splatseg.core.boundary import boundary, convert_fields
from splatseg.core.models import GroundedMasks, TextFeatures
from splatseg.errors import InputError
from splatseg.io.evidence import Evidence, FeatureEvidence, find_evidence, open_evidence
from splatseg.methods.prompt import (
    PromptOptions,
    PromptSession,
    PromptSources,
    selection_of,
)
from splatseg.prompting.pipeline import SceneIndex, SelectionContext, postprocess
from splatseg.prompting.prompts import Solid, ViewPrompt
from splatseg.prompting.seen import ViewCache
from splatseg.render import BackendName
from splatseg.tasks._observer import SILENT, Observer
from splatseg.tasks._query_sources import feature_evidence, mask_name
from splatseg.tasks._select_record import prompt_record
from splatseg.tasks.select_options import SelectOptions
from splatseg.tasks.select_session import Selected, check_base, combined, within

_KINDS = ("masks", "panoptic", "tracked")


@dataclass(frozen=True, slots=True, kw_only=True)
class TextOptions:
    """What words are answered by."""

    features: str | None = None
    """Evidence of features in the space of words, such as features_text. None takes the only one
    that there are words for."""

    evidence: str | None = None
    """Evidence of masks. None takes the only one."""

    prompt: PromptOptions = field(default_factory=PromptOptions)
    """How words become masks, points and votes; its words, and its names of evidence and models,
    are not looked at."""

    def __post_init__(self) -> None:
        convert_fields(self)


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
    the world, these give a mask in every view, and the masks vote (`methods.prompt`).

    What the command ``splatseg select --text`` does.

    Args:
        scene: The scene; it stays as it is.
        words: Words or phrases, all of which are selected together.
        options: What answers, and how.
        select_options: The mode, the seed, and the steps that follow.
        models: Models that answer instead of what was recorded.
        places: Bound the answer: of several, all hold.
        base: A selection that the mode adds to, subtracts from or intersects with.
        backend: Who renders.
        observer: Is told of the progress.

    Raises:
        InputError: If the scene has nothing that answers to words, nothing is known of one, or
            nothing in it answers.
    """
    options, models = options or TextOptions(), models or TextModels()
    chosen = select_options or SelectOptions()
    check_base(scene, base, chosen)
    began = time.perf_counter()
    asked = replace(options.prompt, words=tuple(words), point=())
    if not scene.train_views:
        raise InputError("views: expected train views to look for words in, the scene has none.")
    features, masks = _evidence(scene, options, models)
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
    seconds = {"open": time.perf_counter() - began}
    with observer.stage("select") as step:
        made = session.ask(words, progress=step)
    seconds |= made.seconds
    found = selection_of(made, session, asked)
    confidence, steps = _cleaned(scene, made.confidence, chosen, backend)
    confidence = within(confidence, places, scene.gaussians)
    selection = combined(Selection.of_confidence(confidence), base, chosen.mode)
    evidence = None if features is None else features.folder.name
    return Selected(
        selection=replace(selection, info=_info(found, places, base, chosen, evidence)),
        seconds={**seconds, **steps},
        source="text",
        warnings=() if selection.count else ("Nothing is selected.",),
    )


def _evidence(
    scene: Scene, options: TextOptions, models: TextModels
) -> tuple[FeatureEvidence | None, Evidence | None]:
    """What was recorded and is needed.

    Features are where no grounder finds words, and masks where no prompter makes them, or where
    words are found by them.
    """
    features = None
    if models.grounder is None:
        features = feature_evidence(scene, options.features, models.encoder)
    if models.grounder is not None and models.prompter is not None and options.evidence is None:
        return features, None
    name = mask_name(scene, options.evidence, option="evidence")
    if name is None:
        return features, None
    masks = open_evidence(find_evidence(scene.evidence_folders, name))
    if masks.kind not in _KINDS:
        raise InputError(f"evidence: expected masks or segments, {name!r} has {masks.kind}.")
    return features, masks


def _cleaned(
    scene: Scene, confidence: Tensor, options: SelectOptions, backend: BackendName
) -> tuple[Float[Tensor, "n"], Mapping[str, float]]:
    """Without specks and holes, as the selections of clicks are."""
    with ViewCache(scene.gaussians, backend=backend) as views:
        context = SelectionContext(
            gaussians=scene.gaussians,
            prompts=(),
            views=views,
            neighbours=SceneIndex(scene.gaussians),
            source="text",
        )
        return postprocess(confidence, context, enabled=options.steps)


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
        versions={
            "splatseg": importlib.metadata.version("splatseg"),
            "torch": str(torch.__version__),
        },
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
