"""``splatseg info``: what a capture, a scene, a splat file or a folder of evidence holds."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from splatseg.cli._types import Format, Json, Linear, Strict
from splatseg.cli._work import print_result
from splatseg.tasks import describe


@dataclass(frozen=True, slots=True, kw_only=True)
class Command:
    """Say in one line what is there: a capture, a scene, a splat file or evidence.

    For example:

    splatseg info room

    splatseg info capture --format colmap --verbose

    splatseg info room.ply --json
    """

    path: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DATA")]
    """Folder of a capture, of a scene, of evidence or of bare photographs, or a splat file."""

    format: Format = "auto"
    strict: Strict = False
    linear: Linear = ()
    json: Json = False

    verbose: bool = False
    """Print all details, one a line, under the line."""


def run(command: Command) -> None:
    """Tell what is there."""
    facts = describe(
        command.path, format=command.format, strict=command.strict, linear=command.linear
    )
    lines = [summary(facts)]
    if command.verbose:
        lines += [f"  {key}: {_shown(value)}" for key, value in facts.items()]
    print_result(facts, lines, json=command.json)


def summary(facts: dict[str, Any]) -> str:
    """The facts in one line."""
    notes = "".join(f"; note: {note}" for note in facts.get("notes", []))
    return f"{facts['path']}: {_SENTENCES[facts['kind']](facts)}{notes}"


def _capture_sentence(facts: dict[str, Any]) -> str:
    parts = [f"{facts['format']} capture, {_views(facts)}"]
    parts.append(f"{facts['points']} start points" if facts["points"] is not None else "no points")
    parts += [f"{facts[key]} {word}" for key, word in _COUNTED.items() if facts[key]]
    if facts["splats"]:
        parts.append("with a splat file")
    parts += _world(facts)
    if facts["evidence"]:
        parts.append(f"evidence {', '.join(facts['evidence'])}")
    if facts["other_formats"]:
        parts.append(f"also as {', '.join(facts['other_formats'])}")
    return "; ".join(parts)


_COUNTED = {"masks": "masks", "depth_maps": "depth maps", "classes": "classes"}


def _scene_sentence(facts: dict[str, Any]) -> str:
    layers = ", ".join(f"{name} ({kind})" for name, kind in facts["layers"].items())
    parts = [
        f"scene, {_gaussians(facts)}",
        _views(facts) if facts["views"] else "no views",
        *_world(facts),
        f"layers {layers}" if layers else "no layers",
        *([f"fields {', '.join(facts['fields'])}"] if facts["fields"] else []),
    ]
    if facts["evidence"]:
        parts.append(f"evidence {', '.join(facts['evidence'])}")
    return "; ".join(parts)


def _evidence_sentence(facts: dict[str, Any]) -> str:
    classes = f"; {facts['classes']} classes" if facts["classes"] else ""
    return (
        f"evidence of the kind {facts['evidence_kind']} of {facts['views']} views; "
        f"{facts['first_view']} has {facts['in_first_view']}{classes}"
    )


def _photographs_sentence(facts: dict[str, Any]) -> str:
    return f"{facts['photographs']} photographs, {', '.join(facts['sizes'])}; no poses"


_NO_CHECKPOINT = "fit that was stopped before its first checkpoint"


def _unfinished_sentence(facts: dict[str, Any]) -> str:
    running = facts["running"]
    how = f"running, process {running['process']}; " if running else ""
    if not facts["steps"]:
        return f"fit, {how}no checkpoint yet" if running else _NO_CHECKPOINT
    return (
        f"unfinished fit, {how}{100 * facts['progress']:.0f} % done"
        f"{' at its last checkpoint' if running else ''}: {facts['gaussians']} Gaussians "
        f"after {facts['steps']} steps and {facts['seconds'] / 60:.1f} minutes"
        f"{'' if running else '; fit --resume continues it'}"
    )


def _splat_sentence(facts: dict[str, Any]) -> str:
    return f"{facts['format']} splats, {_gaussians(facts)}"


def _splat_folder_sentence(facts: dict[str, Any]) -> str:
    files = ", ".join(f"{count} {format}" for format, count in facts["files"].items())
    return f"splat files ({files}); name one of them"


def _layer_sentence(facts: dict[str, Any]) -> str:
    return f"layer of {facts['holds']}, {facts['rows']} rows"


def _folder_sentence(facts: dict[str, Any]) -> str:
    return f"folder of captures or scenes ({', '.join(facts['holds'])}); name one of them"


_SENTENCES = {
    "capture": _capture_sentence,
    "scene": _scene_sentence,
    "unfinished fit": _unfinished_sentence,
    "evidence": _evidence_sentence,
    "photographs": _photographs_sentence,
    "splats": _splat_sentence,
    "splat folder": _splat_folder_sentence,
    "layer": _layer_sentence,
    "folder": _folder_sentence,
}


def _views(facts: dict[str, Any]) -> str:
    split = ", ".join(f"{count} {name}" for name, count in facts["split"].items())
    sizes = facts["sizes"]
    shown = ", ".join(sizes[:2]) + (f" and {len(sizes) - 2} sizes more" if len(sizes) > 2 else "")
    return f"{facts['views']} views {shown} ({split}), {' and '.join(facts['lenses'])}"


def _gaussians(facts: dict[str, Any]) -> str:
    extra = facts["extra_columns"]
    columns = f", further columns {', '.join(extra)}" if extra else ""
    return f"{facts['gaussians']} Gaussians, harmonics of degree {facts['sh_degree']}{columns}"


def _world(facts: dict[str, Any]) -> list[str]:
    parts: list[str] = []
    if facts["up"] is not None:
        parts.append(f"up is ({', '.join(f'{v:g}' for v in facts['up'])})")
    if facts["metres_per_unit"] is not None:
        parts.append(f"1 unit is {facts['metres_per_unit']:g} m")
    return parts


def _shown(value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{k} {v}" for k, v in value.items()) or "none"  # pyright: ignore[reportUnknownVariableType]
    if isinstance(value, list):
        return ", ".join(str(v) for v in value) or "none"  # pyright: ignore[reportUnknownVariableType, reportUnknownArgumentType]
    return "none" if value is None else str(value)
