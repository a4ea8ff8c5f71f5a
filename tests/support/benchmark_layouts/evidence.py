"""Recorded evidence of a scene under the names that its photographs have in a layout.

Photographs are told by their pixels, so a layout may call them what it likes, and store them as
PNG. Those that it does not have, such as held-out ones, lose their evidence. Where they were taken
again through a fisheye lens they are told by their order, and evidence is taken through it too.
"""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from splatseg.core import Capture
from support.benchmark_layouts.fisheye import fisheye_names, through_fisheye
from support.benchmark_layouts.source import Source, link

SHARED_FILES = ("quant.npz", "basis.npz", "text_embeddings.npz")
_BESIDE = "text_embeddings.npz"


def write_evidence(source: Source, capture: Capture, name: str, folder: Path) -> Path:
    """Write one folder of evidence of a scene for the views of a capture.

    Args:
        source: The scene that was converted.
        capture: What was read from the layout.
        name: Name of the evidence, a folder of the scene.
        folder: Where the folder of this name is written.

    Raises:
        FileNotFoundError: If the scene has no such evidence, or none of these photographs.
    """
    there = source.folder / name
    bent = any(view.camera.model == "fisheye" for view in capture.views)
    names = fisheye_names(source) if bent else renamed_views(source, capture)
    lens = capture.views[0].camera if bent else None
    files = {path.stem: path for path in sorted(there.iterdir()) if path.stem in names}
    if not files:
        raise FileNotFoundError(f"{there}: expected evidence of the photographs of {capture.path}")
    target = folder / name
    target.mkdir(parents=True)
    for view, path in files.items():
        if lens is None:
            link(path, target / f"{names[view]}{path.suffix}")
        else:
            through_fisheye(path, target / f"{names[view]}{path.suffix}", source, lens)
    for shared in SHARED_FILES:
        if (there / shared).is_file():
            link(there / shared, target / shared)
    if name.startswith("features_text") and (source.folder / _BESIDE).is_file():
        link(source.folder / _BESIDE, target / _BESIDE)
    _write_table(there / "segments.json", target, names)
    _write_tracks(there / "tracks.json", target, names)
    # Ids get their names from the capture's metadata.json, beside the folder.
    if not (folder / "metadata.json").exists():
        link(source.folder / "metadata.json", folder / "metadata.json")
    return target


def renamed_views(source: Source, capture: Capture) -> dict[str, str]:
    """Names of views in the capture by those of the scene."""
    # A layout may repeat photographs: those to learn from have the evidence.
    views = sorted(capture.views, key=lambda view: view.split == "train")
    found = {_pixels(view.image): view.name for view in views}
    own = {view.name: found.get(_pixels(view.image)) for view in source.views}
    return {name: other for name, other in own.items() if other is not None}


def _pixels(path: Path | None) -> str:
    if path is None:
        return ""
    with Image.open(path) as image:
        return hashlib.sha256(np.asarray(image.convert("RGB")).tobytes()).hexdigest()


def _write_table(path: Path, target: Path, names: Mapping[str, str]) -> None:
    """Segments by view, renamed."""
    if not path.is_file():
        return
    content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    renamed = {names[view]: rows for view, rows in content.items() if view in names}
    (target / path.name).write_text(json.dumps(renamed), encoding="utf-8")


def _write_tracks(path: Path, target: Path, names: Mapping[str, str]) -> None:
    """Tracks with the order of views, renamed."""
    if not path.is_file():
        return
    content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    order = content.get("order", [])
    content["order"] = [names[view] for view in order if view in names]
    (target / path.name).write_text(json.dumps(content), encoding="utf-8")
