"""``splatseg info`` and ``splatseg doctor``: what is there, and what is wrong with a capture."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from splatseg.cli._shared import Format, Json, Linear, Strict, print_result
from splatseg.errors import InputError
from splatseg.tasks import describe

if TYPE_CHECKING:
    from splatseg.pose.doctor import Diagnosis


@dataclass(frozen=True, slots=True, kw_only=True)
class Command:
    """Print in one line what is at a path: a capture, a scene, a splat file or evidence.

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
    """Also print all details, one per line."""


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
    chunks = f" in {facts['chunks']} chunks" if facts["chunks"] else ""
    return (
        f"{facts['gaussians']} Gaussians{chunks}, harmonics of degree {facts['sh_degree']}{columns}"
    )


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


@dataclass(frozen=True, slots=True, kw_only=True)
class DoctorCommand:
    """Find common faults of a capture with poses, and write a corrected copy.

    Exit status: 0 when nothing is wrong, or when what is wrong was corrected with --fix;
    2 when faults are left.

    For example:

    splatseg doctor capture

    splatseg doctor capture --fix corrected

    splatseg doctor capture --format colmap --max-views 60 --json
    """

    data: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DATA")]
    """The capture: a folder in one of the layouts of --format."""

    fix: Annotated[Path | None, tyro.conf.arg(metavar="OUT")] = None
    """Folder for the corrected capture, a transforms.json that refers to the same photographs. DATA
    is not changed; without faults nothing is written."""

    json: Json = False

    max_views: int = 30
    """Largest number of photographs to examine; more take longer and find smaller faults."""

    format: Format = "auto"


def run_doctor(command: DoctorCommand) -> None:
    """Examine a capture."""
    # Here, as `info` needs none of it.
    from splatseg.pose.doctor import DoctorOptions
    from splatseg.tasks import examine_capture

    found = examine_capture(
        command.data,
        fix=command.fix,
        options=DoctorOptions(max_views=command.max_views),
        format=command.format,
    )
    diagnosis = found.diagnosis
    content = diagnosis_facts(diagnosis) | {"written": found.written}
    lines = diagnosis_lines(diagnosis, str(command.data))
    if found.written is not None:
        lines.append(f"{found.written}: the corrected capture")
    print_result(content, lines, json=command.json)
    if not diagnosis.healthy and found.written is None:
        raise InputError(_sentence(diagnosis, command))


def diagnosis_facts(diagnosis: "Diagnosis") -> dict[str, Any]:
    """A diagnosis in values that JSON holds."""
    return {
        "path": str(diagnosis.capture.path),
        "format": diagnosis.capture.format,
        "healthy": diagnosis.healthy,
        "faults": [asdict(fault) for fault in diagnosis.faults],
        "doubts": list(diagnosis.doubts),
        "unchecked": list(diagnosis.unchecked),
        "correctable": diagnosis.corrected is not None,
        "figures": dict(diagnosis.figures),
    }


def diagnosis_lines(diagnosis: "Diagnosis", name: str) -> list[str]:
    """A diagnosis for people, a line for each thing."""
    lines = [f"{name}: {_verdict(diagnosis)}"]
    for fault in diagnosis.faults:
        lines.append(f"  fault: {fault.sentence}")
        if fault.remedy:
            lines.append(f"    remedy: {fault.remedy}")
    lines += [f"  doubt: {doubt}" for doubt in diagnosis.doubts]
    lines += [f"  not checked: {sentence}" for sentence in diagnosis.unchecked]
    lines.append(f"  {_measured(diagnosis.figures)}")
    return lines


def _verdict(diagnosis: "Diagnosis") -> str:
    if diagnosis.healthy:
        return "no fault found"
    count = len(diagnosis.faults)
    return f"{count} fault{'s' if count > 1 else ''} found"


def _measured(figures: dict[str, Any] | Any) -> str:
    parts = [f"{figures['matches']} matches in {figures['pairs']} pairs of photographs"]
    if "agreement" in figures:
        parts.append(f"{100 * figures['agreement']:.1f} % agree with the cameras as given")
        after = figures.get("agreement_corrected", figures["agreement"])
        if after != figures["agreement"]:
            parts.append(f"{100 * after:.1f} % with the corrected ones")
    for key, word in (("points", "start points fit"), ("points_corrected", "corrected")):
        if key in figures:
            parts.append(f"{word} {100 * figures[key]['value']:.0f} %")
    return "evidence: " + ", ".join(parts)


def _sentence(diagnosis: "Diagnosis", command: DoctorCommand) -> str:
    names = ", ".join(fault.name for fault in diagnosis.faults)
    if diagnosis.corrected is None:
        return f"{command.data}: {names}; no correction that was tried helps."
    return f"{command.data}: {names}; --fix OUT writes a corrected capture."
