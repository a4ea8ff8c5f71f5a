"""Classes of points of the surface, from labels of Gaussians or from words."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, TypeGuard, cast

import torch
from jaxtyping import Int
from torch import Tensor

from splatseg.core import (
    UNLABELLED,
    ClassTable,
    Features,
    InstanceTree,
    Labels,
    Layer,
    Selection,
    VoxelFeatures,
    map_ids,
    plain_features,
)
from splatseg.errors import InputError
from splatseg.evaluate import Confusion, semantic_score
from splatseg.io.arrays import save_arrays
from splatseg.io.atomic import atomic_file, path_inside
from splatseg.io.evidence import open_evidence
from splatseg.lift import GaussianField
from splatseg.lift.label_maps import ClassifierHead, has_classifier
from splatseg_bench.evidence import Seen, evidence_wanted
from splatseg_bench.job import Job, word_index, words_of
from splatseg_bench.protocols import PointSwitches
from splatseg_bench.scene import TruePoints

_LAYER = "layer"
_MOVED = 1e-4
"""How far a Gaussian may be from its point, as a share of the extent of the points."""


def point_scores(job: Job) -> tuple[dict[str, float], list[dict[str, Any]], list[str]]:
    """Figures of the classes of points: scores, a row a class, and notes.

    Raises:
        InputError: If the scene has no labelled points, or the method gives no classes.
    """
    truth = job.bench.points
    switches = cast(PointSwitches, job.protocol.switches)
    if truth is None:
        raise InputError(f"scene {job.bench.name}: expected labelled points, got none.")
    wanted = torch.tensor(switches.class_ids or truth.labels.present.tolist())
    found, counted, notes = _labels_of_points(job, truth, switches, wanted)
    true = torch.where(torch.isin(truth.labels.ids, wanted), truth.labels.ids, UNLABELLED)
    true = torch.where(counted, true, UNLABELLED)
    path = path_inside(
        job.root, "predictions", job.protocol.name, job.method.name, f"{job.bench.name}.npz"
    )
    arrays = {"semantic": found.clamp_min(0).numpy(), "truth": true.clamp_min(0).numpy()}
    with atomic_file(path) as temporary:
        save_arrays({}, arrays, temporary, name=path)
    score = semantic_score(Confusion.of(found, true))
    rows: list[dict[str, Any]] = [
        {
            "class": id,
            "name": "" if truth.table is None else truth.table.name_of(id),
            "points": int((true == id).sum()),
            "iou": iou,
        }
        for id, iou in score.per_class.items()
    ]
    left_out = int((~counted).sum())
    if left_out:
        notes.append(f"{left_out} points of faint Gaussians are left out.")
    scores = {
        "miou": score.miou,
        "mean_accuracy": score.mean_accuracy,
        "accuracy": score.accuracy,
        "fwiou": score.fwiou,
    }
    return scores, rows, notes


def _labels_of_points(
    job: Job, truth: TruePoints, switches: PointSwitches, wanted: Int[Tensor, "k"]
) -> tuple[Tensor, Tensor, list[str]]:
    """Ids of the truth for each point, which points count, and notes."""
    layer, seen = _layer(job)
    notes: list[str] = []
    if read_in_words(layer):
        layer = read_by_words(job, seen, layer, truth.table, wanted.tolist())
    else:
        layer, note = _in_true_ids(job, seen, layer, truth.table)
        notes += note
    field = GaussianField(job.scene.gaussians, {_LAYER: layer}, backend=job.backend)
    if not switches.fixed_points:
        ids = field.labels_at(truth.points, _LAYER).ids
        return ids, torch.ones(len(ids), dtype=torch.bool), notes
    _check_places(job, truth)
    return field.labels(_LAYER).ids, job.scene.gaussians.opacities >= switches.min_opacity, notes


def _layer(job: Job) -> tuple[Layer, Seen]:
    seen = job.seen(words=evidence_wanted(job.protocol, job.method, job.options) == "words")
    return job.whole_layer(seen.name), seen


def _check_places(job: Job, truth: TruePoints) -> None:
    means = job.scene.gaussians.means
    if len(means) != len(truth.points):
        raise InputError(
            f"{job.scene.root}: expected a Gaussian at each of the {len(truth.points)} points, got "
            f"{len(means)}; fit with strategy fixed, or set fixed_points=no."
        )
    extent = float((truth.points.amax(0) - truth.points.amin(0)).norm())
    moved = float((means.cpu() - truth.points.float()).norm(dim=1).max())
    if moved > _MOVED * extent:
        raise InputError(
            f"{job.scene.root}: expected Gaussians at the points, got one {moved:g} away from its "
            "own."
        )


def read_in_words(layer: Layer) -> TypeGuard[Features | VoxelFeatures]:
    """Whether classes of a layer are told by words: it has features, and no classifier."""
    if isinstance(layer, VoxelFeatures):
        return True
    return isinstance(layer, Features) and not has_classifier(layer)


def read_by_words(
    job: Job,
    seen: Seen,
    layer: Features | VoxelFeatures,
    table: ClassTable | None,
    wanted: Sequence[int],
) -> Features:
    """Features with a classifier: the class whose name is nearest, as the method asks words.

    Args:
        job: The method and the scene.
        seen: The evidence that the features were made of.
        layer: The features.
        table: Names of classes.
        wanted: Ids of the classes to choose from; those whose names have no vector are left out.
    """
    if table is None:
        raise InputError(f"scene {job.bench.name}: expected names of its classes, got none.")
    vocabulary = words_of(job.scene, seen)
    ids = [id for id in wanted if vocabulary.known(table.name_of(id))]
    if not ids:
        raise InputError("words: expected vectors of names of classes, none has one.")
    vectors = vocabulary.vectors([table.name_of(id) for id in ids])
    if job.words == "span" and (span := word_index(layer, vocabulary).span) is not None:
        vectors = span.inside(vectors)
    layer = plain_features(layer)
    weight, bias = vocabulary.space.linear(vectors)
    head = ClassifierHead(ids=torch.tensor(ids), weight=weight, bias=bias, blend="probabilities")
    return replace(layer, info=replace(layer.info, head=head.to_json()))


def _in_true_ids(
    job: Job, seen: Seen, layer: Layer, table: ClassTable | None
) -> tuple[Labels, list[str]]:
    """Labels in the ids of the truth: by name where both have names, else as they are."""
    if isinstance(layer, InstanceTree | Selection):
        raise InputError(f"method {job.method.name}: expected classes, got {job.method.returns}.")
    field = GaussianField(job.scene.gaussians, {_LAYER: layer}, backend=job.backend)
    labels = field.labels(_LAYER)
    mapping, notes = true_ids_of(job, seen, table)
    if mapping is None:
        return replace(labels, candidates=None, shares=None), notes
    ids = map_ids(labels.ids, mapping, default=UNLABELLED)
    background = mapping.get(labels.background, UNLABELLED)
    return replace(labels, ids=ids, background=background, candidates=None, shares=None), notes


def true_ids_of(
    job: Job, seen: Seen, table: ClassTable | None
) -> tuple[dict[int, int] | None, list[str]]:
    """The truth's id by id of the evidence, by name; None where ids are taken as they are."""
    if job.scene.root is None:
        raise InputError("scene: expected one that was read from its folder, got one without.")
    classes = open_evidence(job.scene.root / "evidence" / seen.name).classes
    if classes is None or table is None:
        return None, ["ids of classes are taken as they are: one of the two has no names."]
    known = {row.name.lower(): row.id for row in table.rows}
    found = {row.id: known[row.name.lower()] for row in classes.rows if row.name.lower() in known}
    lacking = len(classes.rows) - len(found)
    note = f"{lacking} of {len(classes.rows)} classes of {seen.model} are none of the truth's."
    return found, [note] if lacking else []
