"""What a report shows of a tree of instances: its nodes, and pictures of its cuts."""

from collections.abc import Mapping, Sequence

from torch import Tensor

from splatseg.core import (
    TREE_LEVELS,
    UNLABELLED,
    ClassTable,
    Gaussians,
    InstanceTree,
    Renderable,
    View,
)
from splatseg.evaluate.held_out import label_map_in
from splatseg.io.export import node_rows
from splatseg.io.images import image_camera, load_image
from splatseg.report._segment_panels import rendered_image
from splatseg.report.drawn_ids import draw_ids
from splatseg.report.html import Block, Table
from splatseg.report.images import Gallery, GalleryImage, overlay_labels
from splatseg.report.layer_colours import layer_colours

_LONGEST = 448
_MAX_ROWS = 400


def tree_section(
    field: Renderable,
    layer: str,
    tree: InstanceTree,
    views: Sequence[View],
    *,
    gaussians: Gaussians,
) -> tuple[Block, ...]:
    """The pictures of three cuts in some views, and a table of all nodes, children indented.

    Args:
        field: What is rendered.
        layer: Name of the layer of the field.
        tree: The layer.
        views: Those that are rendered.
        gaussians: Who carries the labels; colours follow from them.
    """
    pictures = (_cuts(field, layer, tree, views, gaussians),) if views else ()
    return (*pictures, _nodes(tree))


def _cuts(
    field: Renderable, layer: str, tree: InstanceTree, views: Sequence[View], gaussians: Gaussians
) -> Gallery:
    tables = {
        level: layer_colours(
            field.layer(f"{layer}@{level}"), None, gaussians=gaussians, labels=tree.cut(level)
        )
        for level in TREE_LEVELS
    }
    rows: list[tuple[str, tuple[GalleryImage, ...]]] = []
    for view in views:
        camera = image_camera(view, _LONGEST)
        size = (camera.height, camera.width)
        with field.view(camera) as looked_at:
            drawn = [
                label_map_in(looked_at, f"{layer}@{level}", camera).ids for level in TREE_LEVELS
            ]
            if view.image is None:
                photograph = rendered_image(looked_at, size)
            else:
                photograph = load_image(view, longest=_LONGEST)
        rows.append(
            (
                view.name,
                tuple(
                    _picture(photograph, ids, tables[level])
                    for level, ids in zip(TREE_LEVELS, drawn, strict=True)
                ),
            )
        )
    return Gallery(
        title="The tree at three levels",
        columns=tuple(f"{level}s" for level in TREE_LEVELS),
        rows=tuple(rows),
        note="Groups hold objects, objects hold parts. What has no level above it, or none below, "
        "is shown at the next.",
    )


def _picture(photograph: Tensor, ids: Tensor, colours: ClassTable) -> GalleryImage:
    return GalleryImage(image=draw_ids(overlay_labels(photograph, ids, colours), ids))


def _nodes(tree: InstanceTree) -> Table:
    rows = {row["id"]: row for row in node_rows(tree)}
    order = _depth_first(tree, {id: row["gaussians"] for id, row in rows.items()})
    cells = tuple(
        (
            "\u2003" * (len(tree.path(id)) - 1) + str(rows[id]["name"]),
            id,
            rows[id]["level"],
            rows[id]["gaussians"],
            f"{rows[id]['support']:.2f}",
            rows[id]["segments"],
            rows[id]["views"],
        )
        for id in order[:_MAX_ROWS]
    )
    more = f" The first {_MAX_ROWS} of {len(order)} are shown." if len(order) > _MAX_ROWS else ""
    return Table(
        title="The tree",
        columns=("node", "id", "level", "Gaussians", "support", "masks", "views"),
        rows=cells,
        note="Support is the share of the views that could have seen a node which have a mask of "
        f"it.{more}",
    )


def _depth_first(tree: InstanceTree, size: Mapping[int, int]) -> list[int]:
    """Ids of all nodes, each followed by those below it, the largest first."""
    below: dict[int, list[int]] = {}
    for node in tree.nodes:
        below.setdefault(node.parent, []).append(node.id)
    stack = sorted(below.get(UNLABELLED, []), key=lambda id: (size[id], -id))
    found: list[int] = []
    while stack:
        id = stack.pop()
        found.append(id)
        stack += sorted(below.get(id, []), key=lambda id: (size[id], -id))
    return found
