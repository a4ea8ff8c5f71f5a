"""A layer to export, opened: its columns, its objects and what their ids mean."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from splatseg.core import UNLABELLED, Labels, Layer, LayerInfo, RenderableLayer, Scene, Selection
from splatseg.errors import InputError
from splatseg.io.export import (
    ObjectRow,
    label_columns,
    objects_of,
)
from splatseg.render import BackendName
from splatseg.report.colours import names_of
from splatseg.tasks._observer import Observer
from splatseg.tasks.export_options import ExportOptions, What
from splatseg.tasks.label_columns import label_tables
from splatseg.tasks.scene_parts import layer_of

_SELECTED = 1


@dataclass(frozen=True, slots=True, kw_only=True)
class ExportJob:
    """What there is to export."""

    what: What
    output: Path
    options: ExportOptions
    backend: BackendName
    observer: Observer
    scene: Scene
    classes: Labels | None
    """Of `ExportOptions.layer`."""

    selection: Selection | None
    """Of `ExportOptions.layer`, where that is one."""

    instances: Labels | None
    files: Mapping[int, str]
    """Where each object's splats are, by id, as far as that is known."""

    @property
    def objects(self) -> Labels:
        """The layer whose ids are objects; a selection as the id 1."""
        if self.instances is not None:
            return self.instances
        if self.classes is not None:
            return self.classes
        if self.selection is not None:
            return _labels_of_selection(self.selection, str(self.options.layer))
        raise InputError(
            f"layer, instances: expected the labels to export as {self.what}, got neither."
        )

    @property
    def about(self) -> dict[str, Any]:
        """What tables say of where they came from."""
        layers = {"layer": self.options.layer, "instances": self.options.instances}
        return {
            "scene": str(self.scene.root),
            **layers,
            "gaussians": len(self.scene.gaussians),
            "up": None if self.scene.up is None else list(self.scene.up),
            "metres_per_unit": self.scene.metres_per_unit,
        }


def open_job(
    scene: Scene,
    output: Path,
    what: What,
    options: ExportOptions,
    layers: Mapping[str, Layer] | None,
    *,
    files: Mapping[int, str],
    backend: BackendName,
    observer: Observer,
) -> ExportJob:
    """Read the layers that the options name.

    Raises:
        InputError: If there is no such layer, or one cannot be exported.
    """
    classes: Labels | None = None
    selection: Selection | None = None
    instances: Labels | None = None
    if options.layer is not None:
        layer = layer_of(scene, options.layer, layers)
        if isinstance(layer, Selection):
            selection = _sure_selection(layer, options.min_confidence)
        elif isinstance(layer, Labels):
            classes = _sure(layer, options.min_confidence)
        else:
            raise InputError(f"layer: {options.layer} holds features, which have no ids to write.")
    if options.instances is not None:
        layer = layer_of(scene, options.instances, layers)
        if not isinstance(layer, Labels):
            raise InputError(f"instances: expected a layer of labels, got {options.instances}.")
        instances = _sure(layer, options.min_confidence)
    return ExportJob(
        what=what,
        output=output,
        options=options,
        backend=backend,
        observer=observer,
        scene=scene,
        classes=classes,
        selection=selection,
        instances=instances,
        files=files,
    )


def _sure(labels: Labels, min_confidence: float) -> Labels:
    """The layer with ids that are less sure than that taken away."""
    if not min_confidence > 0:
        return labels
    unsure = labels.confidence < min_confidence
    return replace(labels, ids=torch.where(unsure, UNLABELLED, labels.ids))


def _sure_selection(selection: Selection, min_confidence: float) -> Selection:
    """The selection without what is less sure than that to belong to it."""
    if not min_confidence > 0 or selection.confidence is None:
        return selection
    mask = selection.mask & (selection.confidence >= min_confidence)
    confidence = torch.where(mask, selection.confidence, selection.confidence.clamp_max(0.5))
    return replace(selection, mask=mask, confidence=confidence)


def _labels_of_selection(selection: Selection, name: str) -> Labels:
    return Labels(
        ids=torch.where(selection.mask, _SELECTED, UNLABELLED),
        confidence=selection.mask.float()
        if selection.confidence is None
        else selection.confidence.float(),
        info=LayerInfo(names={_SELECTED: name}),
    )


def with_only(job: ExportJob) -> ExportJob:
    """The job with the objects of `ExportOptions.only` alone."""
    if not job.options.only:
        return job
    objects = job.objects
    names = names_of(RenderableLayer.of(objects), job.scene.classes)
    present = {id for id in torch.unique(objects.ids).tolist() if id != UNLABELLED}
    wanted: set[int] = set()
    for word in job.options.only:
        found = {id for id in present if names.get(id) == word or str(id) == word}
        if not found:
            known = ", ".join(f"{id} {names.get(id, '')}".strip() for id in sorted(present)[:20])
            raise InputError(f"only: expected ids or names of objects ({known}), got {word!r}.")
        wanted |= found
    keep = torch.isin(objects.ids, torch.tensor(sorted(wanted), dtype=objects.ids.dtype))
    if job.what in ("splat", "points"):
        return replace(
            job,
            scene=replace(job.scene, gaussians=job.scene.gaussians[keep]),
            classes=None if job.classes is None else job.classes[keep],
            selection=None if job.selection is None else job.selection[keep],
            instances=None if job.instances is None else job.instances[keep],
        )
    kept = replace(objects, ids=torch.where(keep, objects.ids, UNLABELLED), background=UNLABELLED)
    if job.instances is not None:
        return replace(job, instances=kept, classes=_within(job.classes, keep))
    return replace(job, classes=kept, selection=None)


def _within(labels: Labels | None, keep: Tensor) -> Labels | None:
    if labels is None:
        return None
    ids = torch.where(keep, labels.ids, UNLABELLED)
    return replace(labels, ids=ids, background=UNLABELLED)


def columns_of(job: ExportJob) -> dict[str, Tensor]:
    """The layers as columns of a file, by name."""
    columns: dict[str, Tensor] = {}
    if job.classes is not None:
        columns |= label_columns(job.classes, "class")
    if job.selection is not None:
        columns |= label_columns(job.selection)
    if job.instances is not None:
        columns |= label_columns(job.instances, "instance")
    return columns


def meaning_of(job: ExportJob) -> dict[str, Any]:
    """What the columns mean, for the table beside a file."""
    table: dict[str, Any] = {}
    classes = job.selection if job.classes is None else job.classes
    if classes is not None and job.options.layer is not None:
        table |= label_tables(
            classes,
            "class",
            job.options.layer,
            job.scene.classes,
            gaussians=job.scene.gaussians,
        )
    if job.instances is not None and job.options.instances is not None:
        table |= label_tables(
            job.instances,
            "instance",
            job.options.instances,
            job.scene.classes,
            gaussians=job.scene.gaussians,
        )
    return table


def rows_of(job: ExportJob) -> tuple[ObjectRow, ...]:
    """The objects, one row each.

    Raises:
        InputError: If there is none.
    """
    objects = job.objects
    rows = objects_of(
        job.scene.gaussians,
        objects,
        names=names_of(RenderableLayer.of(objects), job.scene.classes),
        classes=None if job.instances is None else job.classes,
        class_names=class_names(job.scene, job.classes),
        class_of=objects.info.class_of,
        up=job.scene.up,
        box=job.options.box,
    )
    if not rows:
        raise InputError(f"{job.what}: expected a layer with objects, but no Gaussian has an id.")
    return rows


def class_names(scene: Scene, classes: Labels | None) -> dict[int, str]:
    """Names of class ids: the layer's own before the scene's."""
    rows = () if scene.classes is None else scene.classes.rows
    names = {row.id: row.name for row in rows}
    return names | ({} if classes is None else names_of(RenderableLayer.of(classes), scene.classes))
