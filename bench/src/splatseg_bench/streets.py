"""Drives along streets: classes of the points of lasers by every rule, and of held-out views."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, cast

import torch
from jaxtyping import Float, Int
from torch import Tensor

from splatseg.core import (
    UNLABELLED,
    ClassTable,
    InstanceTree,
    Labels,
    Layer,
    PointLabels,
    Renderable,
    Selection,
    map_ids,
)
from splatseg.errors import InputError
from splatseg.evaluate import Confusion, evaluate_photographs, semantic_score, street_class
from splatseg.evaluate.held_out import drawn_and_true
from splatseg.io.arrays import save_arrays
from splatseg.io.atomic import atomic_file, path_inside
from splatseg.io.evidence import open_evidence
from splatseg.lift import GaussianField
from splatseg.methods import Method
from splatseg.street.build import METHOD_NAME
from splatseg.street.field import MeshField
from splatseg.tasks.scan_labels import viewed_points
from splatseg.tasks.street_field import save_street_field, street_field
from splatseg.tasks.street_inputs import StreetOptions
from splatseg_bench.evidence import Seen, evidence_wanted
from splatseg_bench.job import Job
from splatseg_bench.maps import Scores, TrueMapSource, class_scores, keep_map
from splatseg_bench.points import read_by_words, read_in_words
from splatseg_bench.protocols import SKY, TABLE_1, Protocol, StreetSwitches, merged_name
from splatseg_bench.region_voting import region_labels
from splatseg_bench.scene import BenchmarkScene, TruePoints
from splatseg_bench.scenes import held_out_views, scans_of

_LAYER = "layer"
_OF_GAUSSIANS = ("views", "density", "region", "fair")
_OF_MESHES = ("field", "views")
_COLUMNS = {name: column for column, name in enumerate((*TABLE_1, SKY), start=1)}
"""Ids of the classes that all others are merged to."""


def point_rules(protocol: Protocol, method: Method, bench: BenchmarkScene) -> tuple[str, ...]:
    """By which of the protocol's rules a method is run; where no point has a class, by one.

    Raises:
        InputError: If it has none of them.
    """
    wanted = cast(StreetSwitches, protocol.switches).points
    known = _rules_of(method)
    rules = tuple(rule for rule in wanted if rule in known)
    if not rules:
        raise InputError(
            f"points: expected one of {', '.join(known)} for method {method.name}, got "
            f"{', '.join(wanted)}."
        )
    return rules if bench.points is not None else rules[:1]


def _rules_of(method: Method) -> tuple[str, ...]:
    return _OF_MESHES if method.name == METHOD_NAME else _OF_GAUSSIANS


class Drive:
    """A method in a drive: its labels, and the scores of views that all rules of points share.

    Args:
        job: The method and the fitted scene.
    """

    def __init__(self, job: Job) -> None:
        self._job = job
        self._switches = cast(StreetSwitches, job.protocol.switches)

    def scores(self, job: Job) -> Scores:
        """Figures of the method by the rule of a job.

        Returns:
            ``miou`` of points, of each of Table 1's classes its IoU, ``accuracy``, ``undefined``,
            the share of points without a label; where points say whether a photograph shows them
            ``visible_miou`` and ``hidden_miou`` of those that are shown and are not; of views
            ``view_miou``, ``psnr`` and ``ssim``. A row a class of points, and a row a view.

        Raises:
            InputError: If there is no truth, or the method gives no classes.
        """
        truth = self._job.bench.points
        if truth is None and self._job.bench.semantic is None:
            raise InputError(
                f"scene {self._job.bench.name}: expected labelled points or views, got neither."
            )
        scores: dict[str, float] = {}
        rows: list[dict[str, Any]] = []
        notes = list(self._notes)
        if truth is not None:
            scores, rows, more = self._points(job, truth)
            notes += more
        views, view_rows, more = self._views
        return scores | views, rows + view_rows, [*notes, *more]

    @cached_property
    def _seen(self) -> Seen:
        job = self._job
        return job.seen(words=evidence_wanted(job.protocol, job.method, job.options) == "words")

    @cached_property
    def _made(self) -> tuple[Layer, bool]:
        """The layer of Gaussians, and whether its ids are the truth's."""
        job, seen = self._job, self._seen
        layer = job.whole_layer(seen.name)
        if read_in_words(layer):
            table = self._true_table
            ids = [] if table is None else [row.id for row in table.rows]
            return read_by_words(job, seen, layer, table, ids), True
        if isinstance(layer, InstanceTree | Selection):
            raise InputError(
                f"method {job.method.name}: expected classes, got {job.method.returns}."
            )
        return layer, False

    @property
    def _true_table(self) -> ClassTable | None:
        bench = self._job.bench
        maps, points = bench.semantic, bench.points
        tables = (None if points is None else points.table, None if maps is None else maps.table)
        return next((table for table in tables if table is not None), None)

    @cached_property
    def _gaussians(self) -> GaussianField:
        job = self._job
        return GaussianField(job.scene.gaussians, {_LAYER: self._made[0]}, backend=job.backend)

    @cached_property
    def _shown(self) -> Renderable:
        """What views are drawn of: Gaussians, or the method's own field."""
        return self._mesh() if self._job.method.name == METHOD_NAME else self._gaussians

    def _mesh(self) -> MeshField:
        """The mesh field of the drive, which is kept in the scene."""
        job, scene = self._job, self._job.scene
        made = street_field(
            scene,
            options=StreetOptions(
                field=METHOD_NAME,
                evidence=self._seen.name,
                layer=_LAYER,
                scans=scans_of(job.bench, job.protocol),
                published=job.options.published,
                seed=job.options.seed,
            ),
            field_options=job.options.options_of(job.method),
            backend=job.backend,
            observer=job.observer,
        )
        if scene.root is not None:
            save_street_field(made, scene.root)
        return made.field

    @cached_property
    def _found_table(self) -> ClassTable | None:
        """Names of the layer's ids."""
        if self._job.method.name != METHOD_NAME and self._made[1]:
            return self._true_table
        root = self._job.scene.root
        if root is None:
            raise InputError("scene: expected one that was read from its folder, got one without.")
        return open_evidence(root / "evidence" / self._seen.name).classes

    @property
    def _notes(self) -> list[str]:
        notes: list[str] = []
        if self._found_table is None:
            notes.append("ids of classes are taken as they are: the evidence has no names.")
        if self._switches.scans and scans_of(self._job.bench, self._job.protocol) is None:
            notes.append("there are no scans beside the photographs, so that none were used.")
        return notes

    def _points(self, job: Job, truth: TruePoints) -> Scores:
        """Scores of the points of lasers by one rule."""
        columns = self._columns(truth.table, sky=True)
        true = map_ids(truth.labels.ids, columns.true, default=UNLABELLED)
        labels = self._labels_at(job.rule or "views", truth.points.double())
        undefined = (labels.ids == UNLABELLED) & (true != UNLABELLED)
        if self._switches.undefined == "skipped":
            true = torch.where(undefined, UNLABELLED, true)
        found = map_ids(labels.ids, columns.found, default=UNLABELLED)
        apart = self._apart(found, true, truth)
        if self._switches.visible:
            if truth.visible is None:
                raise InputError(
                    f"visible: expected points that say whether a photograph shows them, those of "
                    f"{job.bench.name} do not."
                )
            true = torch.where(truth.visible, true, UNLABELLED)
            undefined &= truth.visible
        _keep(job, found, true)
        score = semantic_score(Confusion.of(found, true, self._weights(truth)))
        rows: list[dict[str, Any]] = [
            {
                "class": id,
                "name": columns.names.get(id, ""),
                "points": int((true == id).sum()),
                "iou": iou,
            }
            for id, iou in score.per_class.items()
        ]
        known = int((truth.labels.ids != UNLABELLED).sum())
        scores = {"miou": score.miou}
        if self._switches.classes == "table-1":
            scores |= {row["name"]: row["iou"] for row in rows}
        scores |= apart
        scores |= {"accuracy": score.accuracy, "undefined": int(undefined.sum()) / max(known, 1)}
        return scores, rows, [f"points: {columns.note}."] if columns.note else []

    def _apart(
        self, found: Int[Tensor, "p"], true: Int[Tensor, "p"], truth: TruePoints
    ) -> dict[str, float]:
        """Scores of the points that photographs show and of those that none shows."""
        scores: dict[str, float] = {}
        if truth.visible is None:
            return scores
        for name, among in (("visible", truth.visible), ("hidden", ~truth.visible)):
            of_these = torch.where(among, true, UNLABELLED)
            if bool((of_these != UNLABELLED).any()):
                score = semantic_score(Confusion.of(found, of_these, self._weights(truth)))
                scores[f"{name}_miou"] = score.miou
        return scores

    def _weights(self, truth: TruePoints) -> Float[Tensor, "p"] | None:
        """What points count; None is all alike."""
        return truth.labels.confidence if self._switches.confidence else None

    def _labels_at(self, rule: str, points: Float[Tensor, "p 3"]) -> PointLabels:
        """Labels of all points, in ids of the layer."""
        scene = self._job.scene
        unit = scene.metres_per_unit or 1.0
        if rule == "field":
            return self._shown.labels_at(points, _LAYER)
        if rule == "density":
            return self._gaussians.labels_at(points, _LAYER)
        if rule == "views":
            return viewed_points(scene, self._shown).labels_at(points, _LAYER)
        labels = self._gaussians.labels(_LAYER)
        return region_labels(
            scene.gaussians,
            labels.ids,
            points,
            weights=_seen_weights(labels) if rule == "fair" else None,
            radius=self._switches.radius / unit,
        )

    @cached_property
    def _views(self) -> Scores:
        """Scores of held-out views: pictures, and classes of those that have a truth."""
        job = self._job
        out = held_out_views(job.bench, job.protocol)
        views = sorted(
            (view for view in job.scene.views if view.name in out), key=lambda view: view.name
        )
        photographed = [view for view in views if view.image is not None]
        scores: dict[str, float] = {}
        if photographed:
            with job.observer.stage("score pictures") as step:
                report = evaluate_photographs(self._shown, photographed, progress=step)
            scores = {"psnr": report.psnr, "ssim": report.ssim}
        maps = job.bench.semantic
        known = [view for view in views if maps is not None and view.name in maps.read]
        if maps is None or not known:
            return scores, [], ["no held-out view has true classes."]
        columns = self._columns(maps.table, sky=self._switches.sky)
        confusions: list[Confusion] = []
        with job.observer.stage("score views") as step:
            pairs = drawn_and_true(
                self._shown, known, _LAYER, TrueMapSource(maps=maps), progress=step
            )
            for view, (drawn, true) in zip(known, pairs, strict=True):
                ids = map_ids(drawn.ids, columns.found, default=UNLABELLED)
                keep_map(job, "classes", view, ids)
                confusions.append(
                    Confusion.of(ids, map_ids(true.ids, columns.true, default=UNLABELLED))
                )
        of_classes, rows = class_scores(known, confusions)
        lacking = len(views) - len(known)
        notes = [f"{lacking} of {len(views)} held-out views have no truth."] if lacking else []
        notes += [f"views: {columns.note}."] if columns.note else []
        return {"view_miou": of_classes["miou"], **scores}, rows, notes

    def _columns(self, table: ClassTable | None, *, sky: bool) -> "_Columns":
        """What ids of a truth and of the layer count as."""
        found = self._found_table
        merged = self._switches.classes == "table-1"
        if table is None:
            raise InputError(
                f"scene {self._job.bench.name}: expected names of its classes, got none."
            )
        if merged:
            names = {column: name for name, column in _COLUMNS.items()}
            true = _merged(table)
        else:
            true = {row.id: row.id for row in table.rows}
            names = {row.id: row.name for row in table.rows}
        mapping, note = (true, "") if found is None else _matched(found, table, true, merged=merged)
        if not sky:
            true = {id: column for id, column in true.items() if names[column].lower() != SKY}
        return _Columns(true=true, found=mapping, names=names, note=note)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Columns:
    """Classes that are scored."""

    true: Mapping[int, int]
    """By id of the truth."""

    found: Mapping[int, int]
    """By id of the layer."""

    names: Mapping[int, str]

    note: str
    """Which classes of the layer the truth calls otherwise, or lacks; empty where none."""


def _matched(
    found: ClassTable, table: ClassTable, true: Mapping[int, int], *, merged: bool
) -> tuple[dict[int, int], str]:
    """Column by id of the layer: that of the truth's class, by its name or another of its names.

    What the truth has no class for is of Table 1's column of its own name, or of none.
    """
    ids = {row.name: row.id for row in table.rows}
    own = [row.name for row in found.rows]
    columns: dict[int, int] = {}
    otherwise: list[str] = []
    lacking: list[str] = []
    for row in found.rows:
        name = street_class(row.name, ids, own)
        if name is None:
            lacking.append(row.name)
            column = merged_name(row.name) if merged else None
            if column is not None:
                columns[row.id] = _COLUMNS[column]
            continue
        if name.lower() != row.name.lower():
            otherwise.append(f"{row.name} is {name}")
        if ids[name] in true:
            columns[row.id] = true[ids[name]]
    told = (("by other names", otherwise), ("the truth has no class for", lacking))
    return columns, "; ".join(f"{words}: {', '.join(names)}" for words, names in told if names)


def _merged(table: ClassTable) -> dict[int, int]:
    """Column by id, for the ids that have one."""
    named = ((row.id, merged_name(row.name)) for row in table.rows)
    return {id: _COLUMNS[name] for id, name in named if name is not None}


def _seen_weights(labels: Labels) -> Float[Tensor, "n"]:
    """How much all views saw each Gaussian."""
    if labels.evidence is None:
        raise InputError("points: expected labels that say how much views saw, fair needs them.")
    return labels.evidence


def _keep(job: Job, found: Int[Tensor, "p"], true: Int[Tensor, "p"]) -> None:
    """Write the classes of points, in the order of the truth; 0 for none."""
    path = path_inside(job.root, "predictions", job.protocol.name, job.row, f"{job.bench.name}.npz")
    arrays = {"semantic": found.clamp_min(0).numpy(), "truth": true.clamp_min(0).numpy()}
    with atomic_file(path) as temporary:
        save_arrays({}, arrays, temporary, name=path)
