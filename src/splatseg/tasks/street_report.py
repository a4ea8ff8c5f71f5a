"""The page of a drive: its mesh field, and the points of laser scans that were labelled."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from splatseg.core import UNLABELLED, ClassTable, Renderable, RenderableLayer, Scene, View, map_ids
from splatseg.core.boundary import boundary
from splatseg.errors import InputError
from splatseg.evaluate import Confusion, semantic_score
from splatseg.evaluate.held_out import label_map_in
from splatseg.evaluate.metrics import psnr
from splatseg.evaluate.street_names import street_class
from splatseg.io.depths import depth_kind
from splatseg.io.images import image_camera, load_image
from splatseg.io.scene_folder import scene_path, work_on_scene
from splatseg.lift.viewed_points import points_in_view
from splatseg.report.colours import colour_labels, layer_colours
from splatseg.report.html import Notice
from splatseg.report.images import Gallery, GalleryImage, colour_depth
from splatseg.report.maps import LabelledPoints, point_map
from splatseg.report.street_report import (
    LevelFacts,
    PointCounts,
    PointScore,
    StreetReportData,
    street_record,
    street_report,
)
from splatseg.report.words import count_text, spread
from splatseg.street.depth_views import capture_views, field_views
from splatseg.street.field import VERTEX_WORDS
from splatseg.tasks.scan_labels import LabelBy, ScanLabels
from splatseg.tasks.street_drive import StreetDrive
from splatseg.tasks.street_field import StreetField
from splatseg.tasks.work import REPORTS_FOLDER, photographed, write_page

_VIEWS = 4
_LONGEST = 720
"""Of the pictures of a page, pixels."""

_BY = {
    "gaussians": "the views of the Gaussians",
    "mesh": "the views of the mesh field",
    "vertices": "the vertices of the mesh field",
}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LabelledScans:
    """Laser scans that were labelled, as a page shows them."""

    made: ScanLabels
    by: LabelBy

    points: LabelledPoints
    """Some of their points."""

    classes: ClassTable | None = None
    """What the scans' own classes are called; None where they have no names."""


@boundary
def report_street(
    scene: Scene,
    field: Renderable,
    *,
    layer: str,
    made: StreetField | StreetDrive | None = None,
    scans: LabelledScans | None = None,
    name: str = "street",
    command: str = "",
) -> Path:
    """Write SCENE/reports/NAME.html, and NAME.json beside it; gives the path of the page.

    It shows a few training views as the field has them, and what `made` and `scans` tell.

    Args:
        scene: The scene, with its folder.
        field: What views are drawn of.
        layer: Its layer of classes.
        made: How a field was made; None where it was there.
        scans: Points that were labelled.
        name: What the page is called.
        command: The words that started it; may be empty.

    Raises:
        InputError: If the scene has no folder, or the layer has no labels.
        OutputError: If it cannot be written.
    """
    root = scene.root
    if root is None:
        raise InputError("scene: expected one with a folder to write a report to, got none.")
    summary = field.layer(layer)
    if summary.kind != "labels":
        raise InputError(f"layer: expected labels, {layer!r:.80} holds {summary.kind}.")
    classes = layer_colours(summary, scene.classes)
    with work_on_scene(root, "street", writes=[REPORTS_FOLDER]):
        views, likeness = _views(scene, field, layer, classes)
        data = StreetReportData(
            scene=root.name,
            layer=layer,
            classes=classes,
            metres_per_unit=scene.metres_per_unit or 1.0,
            psnr=likeness,
            points=None if scans is None else _counts(scans, scene, field, layer, root),
            command=command,
            **_making(made, scene),
        )
        page = street_report(data, views=views, above=_above(scans, scene, classes))
        path = scene_path(root, REPORTS_FOLDER, f"{name}.html")
        return write_page(page, path, record=street_record(data))


def _making(made: StreetField | StreetDrive | None, scene: Scene) -> dict[str, Any]:
    """What is known of how a field was made."""
    if made is None:
        return {}
    facts: dict[str, Any] = {"layer": made.layer, "views learned from": made.facts["views"]}
    notices: list[Notice] = []
    if made.moving is not None:
        sentence = f"{made.moving.sentence[0].upper()}{made.moving.sentence[1:]}."
        notices.append(Notice(verdict="Moving things", sentence=sentence))
    told: dict[str, Any] = {
        "name": made.name,
        "primitives": made.facts["primitives"],
        "timings": made.timings,
        "notices": tuple(notices),
        "facts": facts,
    }
    if isinstance(made, StreetDrive):
        return told | {"blocks": made.blocks}
    metres = scene.metres_per_unit or 1.0
    facts |= {
        "points and depth": made.sources,
        "evidence": str(made.evidence.folder.name),
        "radius of points, m": round(made.field.radius * metres, 4),
        "rays": made.facts["rays"],
        "seed": made.field.info.seed,
    }
    start, mesh = made.fit.start, made.field.mesh
    levels = tuple(
        LevelFacts(
            side=round(side * metres, 6),
            started=int((start.levels == level).sum()),
            kept=int((mesh.levels == level).sum()),
        )
        for level, side in enumerate(mesh.sizes)
    )
    return told | {
        "levels": levels,
        "shaping": made.fit.geometry.records,
        "training": made.fit.radiance.records,
    }


def _views(
    scene: Scene, field: Renderable, layer: str, classes: ClassTable
) -> tuple[Gallery | None, dict[str, float]]:
    """Some training views as photographed and as the field has them, and how like they are."""
    known = photographed(scene.train_views)
    rows: list[tuple[str, tuple[GalleryImage, ...]]] = []
    likeness: dict[str, float] = {}
    for view in spread(known, _VIEWS):
        pictures, decibels = _pictures(view, field, layer, classes)
        likeness[view.name] = decibels
        rows.append((view.name, pictures))
    if not rows:
        return None, {}
    gallery = Gallery(
        title="Training views",
        columns=("photograph", "rendered", "depth", "classes"),
        rows=tuple(rows),
        note="Views that were learned from. Depth is light where it is near, and nearly black "
        "where nothing stands.",
    )
    return gallery, likeness


def _pictures(
    view: View, field: Renderable, layer: str, classes: ClassTable
) -> tuple[tuple[GalleryImage, ...], float]:
    photograph = load_image(view, longest=_LONGEST)
    camera = image_camera(view, _LONGEST)
    with field.view(camera) as looked_at:
        shown = looked_at.signals()
        ids = label_map_in(looked_at, layer, camera).ids
    if shown.colour is None:
        raise InputError("field: expected colours of a view, got none.")
    rendered = (shown.colour.clamp(0, 1) * 255 + 0.5).to(torch.uint8)
    depth = shown.depth if shown.median_depth is None else shown.median_depth
    decibels = psnr(rendered, photograph)
    pictures = (
        GalleryImage(image=photograph),
        GalleryImage(image=rendered, caption=f"{decibels:.1f} dB"),
        GalleryImage(image=colour_depth(depth)),
        GalleryImage(image=colour_labels(ids, classes), kind="chart"),
    )
    return pictures, decibels


def _counts(
    scans: LabelledScans, scene: Scene, field: Renderable, layer: str, root: Path
) -> PointCounts:
    counts, folder = scans.made.counts, scans.made.folder
    inside = folder.is_relative_to(root)
    rule = scans.made.vertex_rule
    kept = scans.points
    truth = true_ids(kept.truth, scans.classes, field.layer(layer))
    scores, sight = (), ""
    if bool((truth != UNLABELLED).any()):
        seen, sight = visibility_of_points(scene, field, layer, kept.points)
        scores = point_scores(kept.ids, truth, seen)
    return PointCounts(
        folder=str(folder.relative_to(root) if inside else folder),
        by=_BY[scans.by] + ("" if rule is None else f" ({VERTEX_WORDS[rule]})"),
        vertex_rule=rule,
        scores=scores,
        sight=sight,
        scans=counts.scans,
        points=counts.points,
        unlabelled=counts.unlabelled,
        ids=dict(counts.ids),
    )


def _above(scans: LabelledScans | None, scene: Scene, classes: ClassTable) -> Gallery | None:
    if scans is None or not len(scans.points.ids):
        return None
    up = scene.up or (0.0, 0.0, 1.0)
    image = point_map(scans.points.points, scans.points.ids, classes, up=up)
    kept = len(scans.points.ids)
    of = "" if kept == scans.made.counts.points else f" {count_text(kept)} of them, evenly."
    return Gallery(
        title="Labelled points from above",
        columns=("",),
        rows=(("", (GalleryImage(image=image, caption="points by class", kind="chart"),)),),
        note=f"Higher points lie over lower ones; those without a label are grey.{of}",
    )


@boundary
def point_scores(
    ids: Int[Tensor, "n"], truth: Int[Tensor, "n"], seen: Bool[Tensor, "n"]
) -> tuple[PointScore, ...]:
    """Scores of all points, of those that a camera saw, and of those that none saw.

    A point without a label is wrong; a point without a truth is not asked.

    Args:
        ids: Of the points, -1 undefined.
        truth: Their true ids, -1 none.
        seen: Whether a camera saw each.
    """
    rows: list[PointScore] = []
    for name, among in (("all", torch.ones_like(seen)), ("seen", seen), ("unseen", ~seen)):
        known = among & (truth != UNLABELLED)
        count = int(known.sum())
        if not count:
            rows.append(PointScore(points=name, count=0, miou=None, accuracy=None, undefined=None))
            continue
        score = semantic_score(Confusion.of(ids[known], truth[known]))
        rows.append(
            PointScore(
                points=name,
                count=count,
                miou=score.miou,
                accuracy=score.accuracy,
                undefined=int((ids[known] == UNLABELLED).sum()) / count,
            )
        )
    return tuple(rows)


def visibility_of_points(
    scene: Scene, field: Renderable, layer: str, points: Float[Tensor, "n 3"]
) -> tuple[Bool[Tensor, "n"], str]:
    """Which points the views saw that a layer was made from, and by whose depth.

    Depth is that of the capture's maps where all of these views have one, else what the field
    shows in them.
    """
    learned = field.layer(layer).info.views
    views = scene.train_views or scene.views
    if learned is not None:
        views = tuple(view for view in scene.views if view.name in set(learned)) or views
    mapped = all(v.depth is not None and depth_kind(v.depth) != "relative" for v in views)
    depths = capture_views(views) if mapped else field_views(field, [v.camera for v in views])
    pairs = ((view.camera, view.depth) for view in depths)
    seen = points_in_view(points, pairs, metres_per_unit=scene.metres_per_unit or 1.0)
    return seen, "the capture's depth maps" if mapped else "the depth that the field shows"


def true_ids(
    truth: Int[Tensor, "n"], table: ClassTable | None, layer: RenderableLayer
) -> Int[Tensor, "n"]:
    """A scan's classes in the ids of a layer, by their names; -1 for those that the layer lacks.

    Without names on one of the sides ids are taken as they are.
    """
    names = layer.info.names
    if table is None or not names:
        return truth
    own = {name: id for id, name in names.items()}
    known = [row.name for row in table.rows]
    found = {row.id: street_class(row.name, own, known) for row in table.rows}
    return map_ids(
        truth,
        {id: own[name] for id, name in found.items() if name is not None},
        default=UNLABELLED,
    )
