"""What a capture, a scene, a splat file or a folder of evidence holds."""

import warnings
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from splatseg.core import (
    TREE_LEVELS,
    Capture,
    Features,
    Gaussians,
    InstanceTree,
    Labels,
    Layer,
    Scene,
    View,
    VoxelFeatures,
)
from splatseg.core.boundary import boundary
from splatseg.errors import FileFormatError, InputError, MissingFileError
from splatseg.fit import CheckpointSummary, checkpoint_summary
from splatseg.io.captures import FORMATS, bare_photographs, find_formats, read_capture
from splatseg.io.evidence import Evidence, evidence_names, open_evidence
from splatseg.io.images import DEFAULT_LONGEST, image_size
from splatseg.io.layers import load_layer
from splatseg.io.limits import memory_to_use
from splatseg.io.scene import load_scene, load_scene_layer, scene_layer_names
from splatseg.io.scene_fields import DRIVE_FILE, scene_field_names, scene_field_path
from splatseg.io.scene_folder import (
    CHECKPOINT_FILE,
    is_scene,
    is_unfinished,
    lock_owner,
    training_files,
)
from splatseg.io.splats import SplatWarning, Values, read_splats, splat_format, trained_splats
from splatseg.tasks.checkpoints import (
    block_files,
    blocks_progress,
    where_fit_stopped,
    where_training_stopped,
)

_LAYOUTS = ("auto", *FORMATS)
_CAPTURE_FILES = (
    "transforms.json",
    "transforms_train.json",
    "poses_bounds.npy",
    "cameras_sphere.npz",
    "cameras.npz",
    "traj_w_c.txt",
)
_CAPTURE_SUFFIXES = (".parquet", ".tfrecord")
_SPLAT_SUFFIXES = (".ply", ".splat", ".ksplat", ".spz", ".sog", ".gltf", ".glb")


@boundary
def describe(
    path: Path, *, format: str = "auto", strict: bool = False, linear: tuple[Values, ...] = ()
) -> dict[str, Any]:
    """What is at a path, in values that JSON holds.

    Args:
        path: A folder of a capture, a scene, evidence or bare photographs, or a file.
        format: Which description of a capture to read, where it has several.
        strict: Refuse what `read_splats` and `read_capture` would leave out.
        linear: What a PLY file has as it is; see `read_splats`.

    Returns:
        The kind of thing and its figures; notes are sentences.

    Raises:
        MissingFileError: If there is nothing.
        InputError: If it is nothing that splatseg reads, or broken.
    """
    if format not in _LAYOUTS:
        raise InputError(f"format: expected one of {', '.join(_LAYOUTS)}, got {format!r}.")
    if not path.exists():
        raise MissingFileError(f"{path}: there is no such file or folder.")
    if path.is_dir():
        return _describe_folder(path, format, strict=strict)
    if path.name in _CAPTURE_FILES or path.suffix in _CAPTURE_SUFFIXES:
        return _capture_facts(read_capture(path, format=format, strict=strict))
    if path.suffix == ".npz":
        layer = load_layer(path)
        return {"path": str(path), "kind": "layer", "holds": _layer_kind(layer), "rows": len(layer)}
    return _splat_facts(path, strict=strict, linear=linear)


def _describe_folder(path: Path, format: str, *, strict: bool) -> dict[str, Any]:
    if format == "auto" and is_scene(path):
        # Nothing that is told of Gaussians needs them in memory.
        return _scene_facts(load_scene(path, memory=memory_to_use(None)))
    if format == "auto" and is_unfinished(path):
        return _unfinished_facts(path)
    if format != "auto" or find_formats(path):
        return _capture_facts(read_capture(path, format=format, strict=strict))
    if (path / "meta.json").is_file() or trained_splats(path) is not None:
        return _splat_facts(path, strict=strict, linear=())
    if inside := _captures_inside(path):
        return {"path": str(path), "kind": "folder", "holds": inside}
    files = [p for p in sorted(path.iterdir()) if p.suffix.lower() in _SPLAT_SUFFIXES]
    if (path / "evidence.json").is_file():
        return _evidence_facts(open_evidence(path, unfinished="allow"))
    if not files and not bare_photographs(path):
        return _evidence_or_nothing(path)
    if files:
        formats = Counter(splat_format(file) for file in files)
        return {"path": str(path), "kind": "splat folder", "files": dict(sorted(formats.items()))}
    if evidence := _as_label_maps(path):
        return evidence
    photographs = bare_photographs(path)
    sizes = Counter(image_size(photograph) for photograph in photographs)
    return {
        "path": str(path),
        "kind": "photographs",
        "photographs": len(photographs),
        "sizes": [f"{w}x{h}" for w, h in sizes],
        "notes": [
            f"larger than {DEFAULT_LONGEST} pixels; worked on at {DEFAULT_LONGEST}"
            for size in list(sizes)[:1]
            if max(size) > DEFAULT_LONGEST
        ],
    }


def _unfinished_facts(path: Path) -> dict[str, Any]:
    """Facts of a folder that a fit was to make a scene of."""
    checkpoint = path / CHECKPOINT_FILE
    facts: dict[str, Any] = {"path": str(path), "kind": "unfinished fit", "running": _running(path)}
    summary = CheckpointSummary(steps=0, progress=0.0, seconds=0.0, gaussians=0)
    if files := block_files(path):
        count, progress = blocks_progress(path)
        parts = [checkpoint_summary(file) for file in files]
        summary = CheckpointSummary(
            steps=sum(part.steps for part in parts),
            progress=progress / count,
            seconds=sum(part.seconds for part in parts),
            gaussians=sum(part.gaussians for part in parts),
        )
        facts["blocks"] = count
    elif checkpoint.is_file():
        summary = checkpoint_summary(checkpoint)
    return facts | asdict(summary)


def _running(root: Path) -> dict[str, Any] | None:
    """Which process works on a scene folder now."""
    owner = lock_owner(root)
    return None if owner is None else asdict(owner)


def _captures_inside(path: Path) -> list[str]:
    """Names of the captures and scenes directly inside a folder."""
    folders = [p for p in sorted(path.iterdir()) if p.is_dir() and not p.name.startswith(".")]
    return [p.name for p in folders if is_scene(p) or find_formats(p)]


def _evidence_or_nothing(path: Path) -> dict[str, Any]:
    try:
        evidence = open_evidence(path, unfinished="allow")
    except InputError as error:
        if isinstance(error, FileFormatError):
            raise
        raise InputError(
            f"{path}: expected a capture, photographs, a scene, evidence or splats, got none."
        ) from error
    return _evidence_facts(evidence)


def _as_label_maps(path: Path) -> dict[str, Any] | None:
    """Facts of a folder of single-channel PNGs, None if they are photographs."""
    if {p.suffix.lower() for p in bare_photographs(path)} != {".png"}:
        return None
    try:
        return _evidence_facts(open_evidence(path, unfinished="allow"))
    except FileFormatError:
        # Three channels: photographs that were saved as PNG.
        return None


def _capture_facts(capture: Capture) -> dict[str, Any]:
    folder = capture.path
    others = [format for format in find_formats(folder) if format != capture.format]
    facts: dict[str, Any] = {"path": str(folder), "kind": "capture", "format": capture.format}
    facts |= _view_facts(capture.views)
    facts |= {
        "points": None if capture.points is None else len(capture.points),
        "classes": None if capture.classes is None else len(capture.classes.rows),
        "up": None if capture.up is None else list(capture.up),
        "metres_per_unit": capture.metres_per_unit,
        "masks": sum(view.mask is not None for view in capture.views),
        "depth_maps": sum(view.depth is not None for view in capture.views),
        "splats": None if capture.splats is None else str(capture.splats),
        "evidence": list(evidence_names([folder])),
        "other_formats": others,
        "notes": list(capture.notes),
    }
    return facts


def _scene_facts(scene: Scene) -> dict[str, Any]:
    root = scene.root if scene.root is not None else Path()
    folders = [folder for folder in (root, scene.source) if folder is not None]
    lost = [v for v in scene.views if v.image is not None and not v.image.is_file()]
    facts: dict[str, Any] = {"path": str(root), "kind": "scene"}
    facts |= _gaussian_facts(scene.gaussians) | _view_facts(scene.views)
    notes = [f"{len(lost)} photographs are not where they were (see --data)"] if lost else []
    owner = lock_owner(root)
    notes += [f"a process works on it ({owner})"] if owner is not None else _stopped_notes(root)
    facts |= {
        "running": _running(root),
        "classes": None if scene.classes is None else len(scene.classes.rows),
        "up": None if scene.up is None else list(scene.up),
        "metres_per_unit": scene.metres_per_unit,
        "source": None if scene.source is None else str(scene.source),
        "layers": {
            name: _layer_kind(load_scene_layer(root, name)) for name in scene_layer_names(root)
        },
        "fields": list(scene_field_names(root)),
        "evidence": list(evidence_names(folders)),
        "notes": notes,
    }
    return facts


def _stopped_notes(root: Path) -> list[str]:
    """What was stopped in a scene folder and can go on."""
    notes: list[str] = []
    stopped = where_fit_stopped(root)
    if stopped is not None:
        notes.append(f"its fit {stopped}; fit --resume continues it")
    notes += [
        f"the training of layer {file.stem} {where_training_stopped(file)}; segment --resume "
        "continues it"
        for file in training_files(root)
    ]
    return [*notes, *_field_notes(root)]


def _field_notes(root: Path) -> list[str]:
    """What lacks of fields of drives in blocks."""
    from splatseg.street.files import load_drive, missing_blocks

    notes: list[str] = []
    for name in scene_field_names(root):
        folder = scene_field_path(root, name)
        if not folder.is_dir():
            continue
        try:
            lacking, blocks = missing_blocks(folder), len(load_drive(folder / DRIVE_FILE))
        except FileFormatError as error:
            notes.append(str(error).removesuffix("."))
            continue
        if lacking:
            notes.append(
                f"{len(lacking)} of {blocks} blocks of field {name} lack; the street command that "
                "began it continues it"
            )
    return notes


def _layer_kind(layer: Layer) -> str:
    if isinstance(layer, Labels):
        return f"labels of {len(layer.present)} ids"
    if isinstance(layer, Features):
        return f"features of {layer.values.shape[1]} channels"
    if isinstance(layer, VoxelFeatures):
        table = layer.table
        return f"{len(table)} voxels of {table.channels} channels in {table.precision}"
    if isinstance(layer, InstanceTree):
        levels = Counter(node.level for node in layer.nodes)
        counts = ", ".join(f"{levels[level]} {level}s" for level in TREE_LEVELS)
        return f"tree of {len(layer.nodes)} nodes ({counts})"
    mean = layer.mean_confidence
    return f"selection of {layer.count}" + ("" if mean is None else f", confidence {mean:.2f}")


def _evidence_facts(evidence: Evidence) -> dict[str, Any]:
    names = evidence.view_names
    if not names:
        raise InputError(f"{evidence.folder}: expected evidence of at least one view, got none.")
    return {
        "path": str(evidence.folder),
        "kind": "evidence",
        "evidence_kind": evidence.kind,
        "views": len(names),
        "first_view": names[0],
        "in_first_view": _first_view(evidence, names[0]),
        "classes": None if evidence.classes is None else len(evidence.classes.rows),
    }


def _first_view(evidence: Evidence, name: str) -> str:
    if evidence.kind == "features":
        features = evidence.features(name)
        rows, columns, channels = features.features.shape
        return f"{rows} x {columns} cells of {features.stride} pixels, {channels} channels"
    if evidence.kind == "depth":
        depth = evidence.depth_map(name)
        return f"{depth.kind} depth on {depth.width}x{depth.height} pixels"
    masks = evidence.masks(name)
    what = "masks" if evidence.kind == "masks" else "ids"
    return f"{len(masks)} {what} on {masks.width}x{masks.height} pixels"


def _splat_facts(path: Path, *, strict: bool, linear: tuple[Values, ...]) -> dict[str, Any]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", SplatWarning)
        gaussians = read_splats(path, strict=strict, linear=linear)
    facts: dict[str, Any] = {"path": str(path), "kind": "splats", "format": splat_format(path)}
    notes = [str(warning.message) for warning in caught]
    return facts | _gaussian_facts(gaussians) | {"notes": notes}


def _gaussian_facts(gaussians: Gaussians) -> dict[str, Any]:
    bounds = None
    if len(gaussians):
        low, high = gaussians.means.amin(dim=0), gaussians.means.amax(dim=0)
        bounds = [low.tolist(), high.tolist()]
    return {
        "gaussians": len(gaussians),
        "sh_degree": gaussians.sh_degree,
        "bounds": bounds,
        "extra_columns": sorted(gaussians.extra),
        "chunks": None if gaussians.chunks is None else len(gaussians.chunks),
    }


def _view_facts(views: Sequence[View]) -> dict[str, Any]:
    sizes = Counter(f"{view.camera.width}x{view.camera.height}" for view in views)
    return {
        "photographs": sum(view.image is not None for view in views),
        "views": len(views),
        "view_names": [view.name for view in views],
        "split": dict(sorted(Counter(view.split for view in views).items(), key=_split_order)),
        "sizes": list(sizes),
        "lenses": sorted({view.camera.model for view in views}),
    }


def _split_order(item: tuple[str, int]) -> tuple[int, str]:
    order = ("train", "val", "test")
    return (order.index(item[0]) if item[0] in order else len(order), item[0])
