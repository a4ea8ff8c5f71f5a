r"""Prompt SA-GS: words become masks in a few views, points, masks of all views, and votes.

Words are looked for in a few views that differ most (k-means). Points of the masks found there
become points of the world, these are projected into all views, a mask is made of them in each, and
the masks vote for Gaussians.

References:
    Prompt SA-GS: Enhanced 3D Segmentation in Optimized Gaussian Splatting (2024), eq. 6 to 8.
    Hu et al., Semantic Anything in 3D Gaussians (SA-GS / SAGD, 2024): points by hand in one view.
"""

from dataclasses import asdict
from typing import cast

from splatseg.core import JSON, PromptableMasks, Selection
from splatseg.core.layer_info import LayerInfo
from splatseg.core.models import GroundedMasks, TextFeatures
from splatseg.errors import InputError
from splatseg.io.evidence import FeatureEvidence
from splatseg.methods._method import Method, MethodInputs
from splatseg.methods.prompt.options import PUBLISHED as PUBLISHED
from splatseg.methods.prompt.options import PromptOptions as PromptOptions
from splatseg.methods.prompt.session import Prompted as Prompted
from splatseg.methods.prompt.session import PromptedObject as PromptedObject
from splatseg.methods.prompt.session import PromptSession as PromptSession
from splatseg.methods.prompt.session import PromptSources as PromptSources
from splatseg.methods.prompt.views import initial_views as initial_views
from splatseg.methods.prompt.words import FoundObject as FoundObject


def parsed_points(texts: tuple[str, ...]) -> list[tuple[str, float, float]]:
    """Points VIEW:X,Y as name, x and y.

    Raises:
        InputError: If one is something else.
    """
    found: list[tuple[str, float, float]] = []
    for text in texts:
        name, _, place = text.rpartition(":")
        try:
            x, y = (float(number) for number in place.split(","))
        except ValueError:
            name = ""
        else:
            found.append((name, x, y))
        if not name:
            raise InputError(f"point: expected VIEW:X,Y, such as front:200,150, got {text!r}.")
    return found


def selection_of(prompted: Prompted, session: PromptSession, options: PromptOptions) -> Selection:
    """The selection, with a record of how it was made."""
    details: dict[str, JSON] = {
        "prompts": [one.record() for one in prompted.objects],
        "mask_calls": prompted.mask_calls,
    }
    if options.words:
        details["initial_views"] = [view.name for view in session.initial]
    info = LayerInfo(method="prompt", options=asdict(options), details=details)
    return Selection.of_confidence(prompted.confidence, info=info)


def run(inputs: MethodInputs, options: PromptOptions) -> Selection:
    """Select what words, or points by hand, mean, see `PromptSession`."""
    if not (options.words or options.point):
        raise InputError("words: expected words or phrases, or points by hand, got neither.")
    evidence = inputs.evidence
    is_features = isinstance(evidence, FeatureEvidence)
    masks = inputs.companions.get("masks")
    sources = PromptSources(
        features=evidence if is_features else None,
        masks=masks if is_features or masks is not None else evidence,
        grounder=cast("GroundedMasks | None", inputs.models.get("grounder")),
        prompter=cast("PromptableMasks | None", inputs.models.get("prompter")),
        encoder=cast("TextFeatures | None", inputs.models.get("encoder")),
    )
    session = PromptSession(
        inputs.gaussians,
        inputs.views,
        sources,
        options=options,
        seed=inputs.seed,
        up=inputs.up,
        backend=inputs.backend,
    )
    points = parsed_points(options.point)
    prompted = (
        session.ask_points(
            points, views=inputs.prompt_views or inputs.views, progress=inputs.progress
        )
        if points
        else session.ask(options.words, progress=inputs.progress)
    )
    return selection_of(prompted, session, options)


METHOD = Method(
    name="prompt",
    summary="words become masks in a few views, points, masks of all views, and votes",
    reference="Prompt SA-GS (2024), eq. 6 to 8",
    evidence=("features", "masks", "panoptic", "tracked"),
    options=PromptOptions,
    run=run,
    returns="selection",
    seeded=True,
    published=PUBLISHED,
    published_differs=(
        "It differs: words are found by cells of the language features at hand and masks are those "
        "at hand, unless --grounder and --prompter name networks (LangSAM and SAM in the paper)."
    ),
    companions={"masks": ("masks", "panoptic", "tracked")},
    models={"grounder": GroundedMasks, "prompter": PromptableMasks, "encoder": TextFeatures},
    complete=False,
)
