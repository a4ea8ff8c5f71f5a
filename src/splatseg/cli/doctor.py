"""``splatseg doctor``: what is wrong with a capture's cameras and points, and a corrected copy."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from splatseg.cli._types import Format, Json
from splatseg.cli._work import print_result
from splatseg.errors import InputError
from splatseg.pose.doctor import Diagnosis, DoctorOptions
from splatseg.tasks import examine_capture


@dataclass(frozen=True, slots=True, kw_only=True)
class Command:
    """Find the usual faults of a capture with poses, and write a corrected one.

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
    """Folder to write the corrected capture to, as a transforms.json that refers to the same
    photographs. Nothing of DATA is changed; without faults nothing is written."""

    json: Json = False

    max_views: int = 30
    """Most photographs to look at; more take longer and decide more finely."""

    format: Format = "auto"


def run(command: Command) -> None:
    """Examine a capture."""
    found = examine_capture(
        command.data,
        fix=command.fix,
        options=DoctorOptions(max_views=command.max_views),
        format=command.format,
    )
    diagnosis = found.diagnosis
    content = facts(diagnosis) | {"written": found.written}
    lines = report(diagnosis, str(command.data))
    if found.written is not None:
        lines.append(f"{found.written}: the corrected capture")
    print_result(content, lines, json=command.json)
    if not diagnosis.healthy and found.written is None:
        raise InputError(_sentence(diagnosis, command))


def facts(diagnosis: Diagnosis) -> dict[str, Any]:
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


def report(diagnosis: Diagnosis, name: str) -> list[str]:
    """A diagnosis for people, a line for each thing."""
    lines = [f"{name}: {_verdict(diagnosis)}"]
    for fault in diagnosis.faults:
        lines.append(f"  fault: {fault.sentence}")
        if fault.remedy:
            lines.append(f"    remedy: {fault.remedy}")
    lines += [f"  doubt: {doubt}" for doubt in diagnosis.doubts]
    lines += [f"  not checked: {sentence}" for sentence in diagnosis.unchecked]
    lines.append(f"  {_evidence(diagnosis.figures)}")
    return lines


def _verdict(diagnosis: Diagnosis) -> str:
    if diagnosis.healthy:
        return "no fault found"
    count = len(diagnosis.faults)
    return f"{count} fault{'s' if count > 1 else ''} found"


def _evidence(figures: dict[str, Any] | Any) -> str:
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


def _sentence(diagnosis: Diagnosis, command: Command) -> str:
    names = ", ".join(fault.name for fault in diagnosis.faults)
    if diagnosis.corrected is None:
        return f"{command.data}: {names}; no correction that was tried helps."
    return f"{command.data}: {names}; --fix OUT writes a corrected capture."
