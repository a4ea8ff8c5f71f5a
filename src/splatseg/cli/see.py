"""``splatseg see``: a 2D model, or evidence recorded elsewhere -> evidence of a scene."""

from collections.abc import Sequence
from dataclasses import dataclass, field, make_dataclass
from typing import Annotated, Any

import tyro

from splatseg.cli._shared import OnViews, print_result
from splatseg.cli._words import option_value
from splatseg.models import (
    DescribedEvidence,
    LoadOptions,
    ModelFamily,
    TrackingOptions,
    find_family,
    model_names,
    model_summary,
)
from splatseg.tasks import SeeOptions, see

CONFIG = (tyro.conf.HelptextFromCommentsOff,)
"""Options of the model and of its weights are flags without a prefix."""


@dataclass(frozen=True, kw_only=True)
class Command(OnViews):
    """Run a 2D model on a scene's photographs, and record its predictions.

    The evidence is written to SCENE/evidence/NAME, one file per view. Work that was stopped
    continues when the same command is run again; --overwrite begins again.

    For example:

    splatseg see room --model regions --evidence masks

    splatseg see room --model dinov2 --weights facebook/dinov2-base --download --evidence dino

    splatseg see room --model sam2-video --seeds masks --evidence tracks

    splatseg see city --model sam2 --evidence masks --executor ray://10.0.0.1:6379 --task-gpus 1

    splatseg see room --model sam-masks --evidence masks_sam --views all --allow-missing

    splatseg see room --model label-maps --evidence labels --zero-is-class --void 255

    splatseg see room --model predictions --evidence ade --suffix _pred --classes ade20k-train

    splatseg see room --model instances_default.json --evidence drawn --what labels
    """

    model: Annotated[str, tyro.conf.arg(metavar="NAME_OR_PATH")]
    """Model to run: one of those above, or a file or folder of predictions recorded elsewhere:
    masks, label maps, features or depth, one file per view, or annotations as COCO, CVAT, labelme,
    Label Studio and Detectron2 write them (docs/models.md). `splatseg see --model NAME --help`
    shows the options of one."""

    evidence: Annotated[str, tyro.conf.arg(metavar="NAME")]
    """Name of the evidence to write."""

    seeing: tyro.conf.OmitArgPrefixes[SeeOptions] = field(default_factory=SeeOptions)
    """What to predict, of which views, and how recorded predictions are read."""

    loading: tyro.conf.OmitArgPrefixes[LoadOptions] = field(default_factory=LoadOptions)
    """Weights, and device of the network."""

    options: Any = None
    """Options of the model."""


_HIDDEN_LOADING = (
    "loading",
    Annotated[LoadOptions, tyro.conf.OmitArgPrefixes, tyro.conf.Suppress],
    field(default_factory=LoadOptions),
)
"""For a model that has no weights: their flags are unknown to it, and so refused."""

_TRACKING: tuple[Any, ...] = (
    ("seeds", Annotated[str | None, tyro.conf.Suppress], None),
    (
        "tracking",
        Annotated[TrackingOptions, tyro.conf.Suppress],
        field(default_factory=TrackingOptions),
    ),
)
_DEPTH: tuple[Any, ...] = (("depth_from_scene", Annotated[bool, tyro.conf.Suppress], True),)


def _seeing(*, tracks: bool, takes_depth: bool) -> Any:
    """The options of what is seen, without those that the model has no use for."""
    hidden = [*(() if tracks else _TRACKING), *(() if takes_depth else _DEPTH)]
    made: Any = make_dataclass("Seeing", hidden, bases=(SeeOptions,), frozen=True, kw_only=True)
    return ("seeing", tyro.conf.OmitArgPrefixes[made], field(default_factory=made))


_NO_OPTIONS = ("options", Annotated[Any, tyro.conf.Suppress], field(default=None))


def command_for(words: Sequence[str]) -> type[Any]:
    """The command with the flags of the model that the words name.

    Flags of other models are unknown to it, and so refused.
    """
    name = option_value(words, "--model")
    if name is None:
        return _with_summaries()
    if name not in model_names():
        seeing = _seeing(tracks=False, takes_depth=False)
        return _made([_NO_OPTIONS, _HIDDEN_LOADING, seeing], Command.__doc__)
    family = find_family(name)
    if family is None:
        return _made([_NO_OPTIONS, _HIDDEN_LOADING], Command.__doc__)
    options = Annotated[
        family.options,
        tyro.conf.OmitArgPrefixes,
        tyro.conf.arg(help=f"Options of model {name}: {family.summary} ({family.reference})."),
    ]
    fields: list[Any] = [
        ("options", options, field(default_factory=family.options)),
        _seeing(tracks="tracked" in family.gives, takes_depth=family.takes_depth),
    ]
    if not family.needs_weights:
        fields.append(_HIDDEN_LOADING)
    return _made(fields, f"{Command.__doc__}{_weights(family)}")


def _made(fields: list[Any], text: str | None) -> type[Any]:
    made = make_dataclass("Command", fields, bases=(Command,), frozen=True, kw_only=True)
    made.__doc__ = text
    return made


def _weights(family: ModelFamily) -> str:
    """Published weights of a family, a line each."""
    if not family.checkpoints:
        return ""
    rows = "\n".join(
        f"- {one.id} ({one.megabytes} MB, {one.licence}{f'; {one.note}' if one.note else ''})"
        for one in family.checkpoints
    )
    if family.checkpoints[0].installed:
        return f"\n\nWeights of an installed package (`{family.checkpoints[0].pip}`):\n\n{rows}"
    if not family.checkpoints[0].on_hub:
        return f"\n\nPublished weights, of which --weights takes a copy:\n\n{rows}"
    return f"\n\nWeights on the Hugging Face hub, the default first:\n\n{rows}"


def _with_summaries() -> type[Any]:
    """The command without a model, whose help lists the models."""
    text = "\n".join(
        f"- {name}: {model_summary(name) or 'of another package'}" for name in model_names()
    )
    return _made(
        [_NO_OPTIONS, _HIDDEN_LOADING, _seeing(tracks=False, takes_depth=False)],
        f"{Command.__doc__}\n\nModels:\n\n{text}",
    )


def run(command: Command) -> None:
    """See a scene."""
    with command.open_executor() as executor:
        seen = see(
            command.open_streamed(None),
            command.model,
            command.evidence,
            options=command.seeing,
            model_options=command.options,
            loading=None if command.loading == LoadOptions() else command.loading,
            backend=command.backend,
            executor=executor,
            observer=command.observer,
        )
    facts = {
        "evidence": seen.folder,
        "kind": seen.kind,
        "model": seen.model,
        "views": seen.views,
        "views_kept": seen.kept,
        "masks": seen.masks,
        "seconds": round(seen.seconds, 3),
        "bytes": seen.bytes,
        "notes": list(seen.notes),
    }
    lines = [summary(seen), str(seen.folder)]
    for one in seen.further:
        lines += [summary(one), str(one.folder)]
    facts["further"] = [str(one.folder) for one in seen.further]
    print_result(facts, lines, json=command.json)


def summary(seen: DescribedEvidence) -> str:
    """One line on what was written."""
    new = seen.views - seen.kept
    parts = [f"{seen.kind} of {seen.views} views by {seen.model}"]
    if seen.kept:
        parts.append(f"{seen.kept} of them were there")
    if new and seen.masks is not None:
        parts.append(f"{seen.masks / new:.1f} masks a view")
    if new:
        parts.append(f"{seen.seconds / new:.2f} s an image")
    parts.append(f"{seen.bytes / 1e6:.1f} MB")
    return ", ".join(parts)
