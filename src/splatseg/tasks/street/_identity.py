"""What blocks of a drive depend on, as digests: blocks of the same are gone on with, no others."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import torch
from torch import Tensor

from splatseg.core import Scan, ScanSource, Scene
from splatseg.io.digests import camera_numbers, digest, file_mark
from splatseg.io.evidence import DepthEvidence, LabelEvidence, find_evidence, open_evidence
from splatseg.io.tables import class_rows
from splatseg.street.build import DnmpOptions
from splatseg.tasks.street._build import versions
from splatseg.tasks.street._inputs import DriveInputs
from splatseg.tasks.street._sources import DEPTHS
from splatseg.tasks.street.options import StreetOptions

_NAMES_AND_PATHS = ("field", "scans", "moving")
"""Options that are no part of a field: data may move."""


class DigestedScans:
    """Scans of which digests are taken as they are read first; a `core.ScanSource`.

    Args:
        scans: The scans.
    """

    def __init__(self, scans: ScanSource) -> None:
        self._scans = scans
        self._digests: dict[str, str] = {}

    @property
    def scan_names(self) -> Sequence[str]:
        """All scans."""
        return self._scans.scan_names

    def scan(self, name: str) -> Scan:
        """One of them.

        Raises:
            InputError: If there is none of that name, or its file is broken.
        """
        scan = self._scans.scan(name)
        if name not in self._digests:
            origin = torch.zeros(0) if scan.origin is None else scan.origin
            self._digests[name] = digest([_bytes(scan.points), _bytes(origin)])
        return scan

    @property
    def digest(self) -> str:
        """Of all scans that were read."""
        return digest(sorted(self._digests.items()))


def drive_identity(
    scene: Scene,
    inputs: DriveInputs,
    *,
    options: StreetOptions,
    field_options: DnmpOptions,
    layer: str,
    scans: DigestedScans | None,
    points: Tensor | None,
) -> dict[str, Any]:
    """All that the fields of a drive's blocks depend on, in values that JSON holds.

    Args:
        scene: The scene.
        inputs: What is learned from.
        options: What the fields are made from.
        field_options: How.
        layer: Name of their layer.
        scans: All of them read already.
        points: Of the capture.
    """
    views = inputs.views
    classes = inputs.evidence.classes or scene.classes
    gaussians = scene.gaussians
    boxes = () if inputs.moving is None else inputs.moving.things.boxes
    asked = {k: v for k, v in asdict(options).items() if k not in _NAMES_AND_PATHS}
    return {
        "options": asked | {"layer": layer, "evidence": inputs.name},
        "field_options": asdict(field_options),
        "versions": versions(),
        "inputs": {
            "metres_per_unit": inputs.metres,
            "views": digest(view.name for view in views),
            "cameras": digest(camera_numbers(view.camera) for view in views),
            "photographs": digest(file_mark(view.image) for view in views),
            "masks": digest(file_mark(view.mask) for view in views),
            "depth maps": digest((file_mark(view.depth), view.depth_unit) for view in views),
            "label maps": _label_maps(inputs),
            "depth evidence": _depth_evidence(scene, options.depth),
            "classes": digest([None if classes is None else class_rows(classes)]),
            "points": digest([None if points is None else _bytes(points)]),
            "scans": "none" if scans is None else scans.digest,
            "boxes": digest(
                (b.centre.tolist(), b.size, b.rotation.tolist(), b.start, b.end) for b in boxes
            ),
            "gaussians": digest(
                _bytes(t) for t in (gaussians.means, gaussians.scales, gaussians.opacities)
            ),
        },
    }


def differences(recorded: Mapping[str, Any], wanted: Mapping[str, Any]) -> list[str]:
    """Names of what is not the same in two identities, in order.

    Args:
        recorded: As JSON gives it back.
        wanted: Likewise.
    """
    found: list[str] = []
    for group in ("options", "field_options", "inputs", "versions"):
        one, other = _object(recorded.get(group)), _object(wanted.get(group))
        found += [name for name in sorted({*one, *other}) if one.get(name) != other.get(name)]
    return found


def _object(value: object) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}  # pyright: ignore[reportUnknownVariableType]


def _label_maps(inputs: DriveInputs) -> str:
    evidence = inputs.evidence
    files = evidence.files if isinstance(evidence, LabelEvidence) else {}
    return digest(file_mark(files.get(view.name)) for view in inputs.views)


def _depth_evidence(scene: Scene, depth: str) -> str:
    if depth in DEPTHS:
        return "none"
    found = open_evidence(find_evidence(scene.evidence_folders, depth, option="depth"))
    files = found.files if isinstance(found, DepthEvidence) else {}
    return digest((name, file_mark(path)) for name, path in sorted(files.items()))


def _bytes(tensor: Tensor) -> str:
    return hashlib.sha256(tensor.detach().cpu().contiguous().numpy().tobytes()).hexdigest()
