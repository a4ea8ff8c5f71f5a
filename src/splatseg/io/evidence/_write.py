"""Writes evidence: a folder with evidence.json and one file a view, each whole or not there."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from jaxtyping import UInt8
from numpy.typing import NDArray
from torch import Tensor

from splatseg._check import check_choice, check_finite, check_shape, check_values
from splatseg.core import (
    UNLABELLED,
    ClassTable,
    DepthMap,
    FeatureMap,
    LabelMap,
    MaskSet,
    Segment,
    Track,
)
from splatseg.core.boundary import boundary
from splatseg.core.models import DeepFeatures
from splatseg.core.view_names import check_view_name
from splatseg.errors import InputError, MissingFileError, RangeError, ShapeError
from splatseg.io.atomic import atomic_file
from splatseg.io.class_tables import class_rows
from splatseg.io.depths import DEPTH_NAME
from splatseg.io.evidence._base import (
    CONFIDENCE_FOLDER,
    HEADER_FILE,
    MAX_FILE_ID,
    RENDERS_FOLDER,
    EvidenceKind,
)
from splatseg.io.evidence._features import TEXT_FILE, TextEmbeddings, features_content
from splatseg.io.evidence._labels import CONFIDENCE_STEPS
from splatseg.io.evidence._masks import masks_content
from splatseg.io.evidence._open import FORMAT, written_version
from splatseg.io.evidence._segments import SEGMENTS_FILE, TRACKS_FILE
from splatseg.io.images import save_png, write_png
from splatseg.io.json_files import json_text, write_json
from splatseg.io.paths import path_inside
from splatseg.io.write_errors import named_write_failures

_WRITTEN = ("labels", "panoptic", "tracked", "masks", "features", "depth")


@boundary
def create_evidence(
    folder: Path | str,
    *,
    kind: EvidenceKind,
    classes: ClassTable | None = None,
    source_ids: Mapping[int, int] | None = None,
    metadata: Mapping[str, Any] | None = None,
) -> Path:
    """Make a folder of evidence and write its evidence.json; views are saved one by one.

    Files of views that are there stay, so that interrupted work can go on.

    Args:
        folder: The folder, usually SCENE/evidence/NAME. Its parent must exist.
        kind: labels, panoptic, tracked, masks, features or depth. The label maps of panoptic
            and tracked evidence need the table of `save_segments` or `save_tracks` beside them.
        classes: Names of the ids, where they have some.
        source_ids: The model's own id by id written, where they differ.
        metadata: How it was made, in values that JSON holds.

    Raises:
        InputError: If the kind is another, or a value has no place in JSON.
        MissingFileError: If the parent of `folder` does not exist.
    """
    check_choice("kind", kind, _WRITTEN)
    folder = Path(folder)
    header = {
        "format": FORMAT,
        "version": written_version(kind),
        "kind": kind,
        "classes": None if classes is None else class_rows(classes),
        "source_ids": None if source_ids is None else {str(k): v for k, v in source_ids.items()},
        "metadata": dict(metadata or {}),
    }
    json_text("metadata", header)
    if not folder.parent.is_dir():
        raise MissingFileError(f"{folder}: expected an existing folder to write in.")
    with named_write_failures(folder):
        folder.mkdir(exist_ok=True)
    write_json(header, path_inside(folder, HEADER_FILE))
    return folder


@boundary
def save_label_map(label_map: LabelMap, folder: Path | str, name: str) -> None:
    """Write a view's label map: 8 bit where all ids fit, else 16; -1 becomes 0.

    Its confidence, if any, goes into a 16 bit PNG of its own.

    Raises:
        InputError: If an id is 0, which is void in files, or above 65535.
    """
    ids = label_map.ids.cpu().numpy()
    path = _view_path(Path(folder), name, ".png")
    if ids.size == 0:
        raise InputError(f"{name}: expected a label map of at least one pixel, got none.")
    if (ids == 0).any():
        raise InputError(f"{name}: expected ids from 1 on (0 is void in files), got 0.")
    highest = int(ids.max())
    if highest > MAX_FILE_ID:
        raise RangeError(f"{name}: expected ids up to {MAX_FILE_ID}, got {highest}.")
    values = np.where(ids == UNLABELLED, 0, ids)
    confidence: NDArray[np.uint16] | None = None
    if label_map.confidence is not None:
        check_values(f"{name}: confidence", label_map.confidence, 0.0, 1.0)
        steps = label_map.confidence.double().cpu().numpy() * CONFIDENCE_STEPS
        confidence = np.floor(steps + 0.5).astype(np.uint16)
    beside = path_inside(Path(folder), CONFIDENCE_FOLDER, f"{name}.png", make=False)
    if confidence is not None:
        beside.parent.mkdir(parents=True, exist_ok=True)
        write_png(confidence, beside)
    elif beside.is_file():
        # It belongs to the label map that is about to be replaced.
        beside.unlink()
    write_png(values.astype(np.uint8) if highest <= 255 else values.astype(np.uint16), path)


@boundary
def save_masks(masks: MaskSet, folder: Path | str, name: str) -> None:
    """Write a view's masks as compressed COCO run lengths.

    Raises:
        RangeError: If a score lies outside [0, 1].
    """
    check_values(f"{name}: scores", masks.scores, 0.0, 1.0)
    text = json_text(name, masks_content(masks))
    path = _view_path(Path(folder), name, ".json")
    with atomic_file(path) as temporary:
        temporary.write_text(text + "\n", encoding="utf-8", newline="\n")


@boundary
def save_render(image: UInt8[Tensor, "height width 3"], folder: Path | str, name: str) -> Path:
    """Keep the picture that a model saw of a view without a photograph, beside the evidence.

    Returns:
        The file, FOLDER/_renders/VIEW.png.
    """
    path = _view_path(Path(folder) / RENDERS_FOLDER, name, ".png")
    save_png(image, path)
    return path


@boundary
def save_segments(segments: Mapping[str, Sequence[Segment]], folder: Path | str) -> None:
    """Write the table of panoptic evidence: the segments of each view by its name.

    Raises:
        InputError: If an id or category is 0 or less (a category of -1 is none), or two
            segments of a view share an id.
    """
    content: dict[str, Any] = {}
    for name, rows in segments.items():
        ids = [segment.id for segment in rows]
        if any(id < 1 for id in ids) or len(set(ids)) != len(ids):
            raise InputError(f"{name}: expected segments with ids of their own from 1 on.")
        content[name] = {
            "segments_info": [
                {
                    "id": segment.id,
                    "category_id": max(segment.category, 0),
                    "isthing": segment.isthing,
                    "score": segment.score,
                }
                for segment in rows
            ]
        }
    write_json(content, path_inside(Path(folder), SEGMENTS_FILE))


@boundary
def save_tracks(tracks: Sequence[Track], folder: Path | str, *, order: Sequence[str]) -> None:
    """Write the table of tracked evidence: the tracks, and the views as they were gone through."""
    content = {
        "order": list(order),
        "tracks": {str(track.id): {"category_votes": dict(track.votes)} for track in tracks},
    }
    write_json(content, path_inside(Path(folder), TRACKS_FILE))


@boundary
def save_features(features: FeatureMap | DeepFeatures, folder: Path | str, name: str) -> None:
    """Write a view's features as float16: one map, or those of several depths and a class token.

    Raises:
        RangeError: If a value is NaN or infinite, or beyond the range of float16 (65504).
        InputError: If maps are of images of several sizes, or two depths have one name.
    """
    content = features_content(name, features)
    _save_arrays(_view_path(Path(folder), name, ".npz"), content)


@boundary
def save_depth_map(depth: DepthMap, folder: Path | str, name: str) -> None:
    """Write a view's depth map as float16, with its kind and confidence.

    Raises:
        RangeError: If a value is beyond the range of float16 (65504).
    """
    half = depth.values.detach().cpu().to(torch.float16)
    check_finite(f"{name}: depth as float16", half)
    arrays: dict[str, NDArray[Any]] = {DEPTH_NAME: half.numpy(), "kind": np.array(depth.kind)}
    if depth.confidence is not None:
        arrays["confidence"] = depth.confidence.detach().cpu().to(torch.float16).numpy()
    _save_arrays(_view_path(Path(folder), name, ".npz"), arrays)


@boundary
def save_text_embeddings(embeddings: TextEmbeddings, folder: Path | str) -> None:
    """Write text_embeddings.npz, in the folder of the features or in the one above it.

    Args:
        embeddings: Unit vectors of words, in the space of the features.
        folder: The folder.

    Raises:
        RangeError: If a value is NaN or infinite.
        InputError: If a word stands there twice.
        ShapeError: If there is not one vector, kind and id a word.
    """
    count = len(embeddings.labels)
    check_shape("vectors", embeddings.vectors, (count, None))
    check_finite("vectors", embeddings.vectors)
    for name in ("kinds", "target_ids"):
        if len(getattr(embeddings, name)) != count:
            raise ShapeError(
                f"{name}: expected one for each of {count} words, got "
                f"{len(getattr(embeddings, name))}."
            )
    if len(set(embeddings.labels)) != count:
        raise InputError("labels: expected distinct words, got one more than once.")
    arrays: dict[str, NDArray[Any]] = {
        "labels": np.array(embeddings.labels, np.str_),
        "vectors": embeddings.vectors.detach().cpu().numpy().astype(np.float32),
        "kind": np.array(embeddings.kinds, np.str_),
        "target_id": np.array(embeddings.target_ids, np.int64),
    }
    _save_arrays(path_inside(Path(folder), TEXT_FILE), arrays)


def _save_arrays(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    with atomic_file(path) as temporary, temporary.open("wb") as file:
        np.savez(file, **cast("dict[str, Any]", arrays))


def _view_path(folder: Path, name: str, suffix: str) -> Path:
    check_view_name(name)
    with named_write_failures(folder / f"{name}{suffix}"):
        return path_inside(folder, f"{name}{suffix}")
