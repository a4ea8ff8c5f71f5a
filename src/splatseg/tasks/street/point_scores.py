"""Scores of labelled points of scans that brought their truth: of all, seen, and unseen points."""

from collections.abc import Iterator

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from splatseg.core import (
    UNLABELLED,
    Camera,
    ClassTable,
    Renderable,
    RenderableLayer,
    Scene,
    map_ids,
)
from splatseg.core.boundary import boundary
from splatseg.evaluate import Confusion, semantic_score, street_class
from splatseg.io.depths import depth_kind
from splatseg.lift.viewed_points import points_in_sight
from splatseg.report.street_report import PointScore
from splatseg.street.depth_views import DepthView, capture_views, field_views


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


def in_sight(
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
    seen = points_in_sight(points, _pairs(depths), metres_per_unit=scene.metres_per_unit or 1.0)
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


def _pairs(depths: Iterator[DepthView]) -> Iterator[tuple[Camera, Tensor]]:
    for view in depths:
        yield view.camera, view.depth
