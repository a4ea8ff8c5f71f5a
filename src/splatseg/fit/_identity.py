"""Identity of a fit: its data, options and renderer. A checkpoint resumes only the same fit."""

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from splatseg.core import Capture, View
from splatseg.core.checkpoints import DIFFERENCES, differing_names, option_differences
from splatseg.errors import InputError, brief
from splatseg.fit._options import FitOptions
from splatseg.io.digests import camera_numbers, digest, file_mark
from splatseg.io.json_files import parse_object

# The length may differ: a fit can be resumed with another one. The number of Gaussians depends on
# the length, and may differ with it.
_LENGTH = {"minutes", "steps"}
_WITH_LENGTH = "max_gaussians"


def fit_identity(
    capture: Capture, views: Iterable[View], *, options: FitOptions, backend: str
) -> dict[str, Any]:
    """Digests of a fit's data, its options, and its backend.

    Paths are not part of it: data may move. A photograph that is missing counts as empty; reading
    it raises the error.

    Args:
        capture: The capture, for its start points.
        views: The training views.
        options: The options of the fit.
        backend: Name of the renderer in use.
    """
    views = tuple(views)
    names = [view.name for view in views]
    data = {
        "training views": digest(names),
        "cameras": digest(camera_numbers(view.camera) for view in views),
        "photographs": digest(file_mark(view.image) for view in views),
        "masks": digest(file_mark(view.mask) for view in views),
        "depth maps": digest([*map(_depth, views)]),
        "start points": _points(capture),
    }
    return {
        "data": data,
        "options": _as_recorded(options),
        "defaults": _as_recorded(FitOptions()),
        "backend": backend,
    }


def check_identity(path: Path, saved: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """Raise unless a checkpoint belongs to the fit that is to be resumed.

    Options that the checkpoint does not have count as their defaults (`option_differences`).

    Args:
        path: The checkpoint, for messages.
        saved: Its identity.
        now: The identity of the fit to resume.

    Raises:
        InputError: Naming everything that differs.
    """
    other = differing_names(_of(saved, "data"), _of(now, "data"))
    differing = [f"other {name}" for name in other]
    differing += _other_options(saved, now)
    if saved.get("backend") != now.get("backend"):
        differing.append(f"backend {saved.get('backend')!r} instead of {now.get('backend')!r}")
    if differing:
        raise InputError(
            f"{path}: expected a checkpoint with the data and options of this fit, got one with "
            f"{brief(', '.join(differing), DIFFERENCES)}."
        )


def _other_options(saved: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """In words, the options that differ and may not."""
    differences = option_differences(
        _of(saved, "options"),
        _of(now, "options"),
        defaults=_of(now, "defaults"),
        recorded_defaults=_of(saved, "defaults"),
    )
    names = {difference.name for difference in differences}
    free = {*_LENGTH, _WITH_LENGTH} if not _LENGTH.isdisjoint(names) else set[str]()
    return [difference.text for difference in differences if difference.name not in free]


def _as_recorded(options: FitOptions) -> dict[str, Any]:
    """Options as JSON returns them: tuples become lists."""
    return parse_object(json.dumps(asdict(options)), where="options")


def _of(identity: Mapping[str, Any], group: str) -> Mapping[str, Any]:
    found = identity.get(group)
    return found if isinstance(found, dict) else {}  # pyright: ignore[reportUnknownVariableType]


def _depth(view: View) -> object:
    return (file_mark(view.depth), view.depth_unit)


def _points(capture: Capture) -> str:
    cloud = capture.points
    if cloud is None:
        return "none"
    found = hashlib.sha256(cloud.points.contiguous().numpy().tobytes())
    if cloud.colours is not None:
        found.update(cloud.colours.contiguous().numpy().tobytes())
    return found.hexdigest()[:16]
