"""What a report of a segmentation shows of single views, and of a tree of instances."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from splatseg.core import (
    TREE_LEVELS,
    UNLABELLED,
    ClassTable,
    Gaussians,
    InstanceTree,
    LabelMap,
    LabelSource,
    Renderable,
    RenderableView,
    View,
    camera_of_map,
    map_ids,
)
from splatseg.evaluate.agreement import Agreement, agreement
from splatseg.evaluate.held_out import label_map_in
from splatseg.evaluate.metrics import psnr
from splatseg.evaluate.overlaps import Overlaps, instance_score
from splatseg.io.evidence import Evidence
from splatseg.io.export import node_rows
from splatseg.io.images import image_camera, load_image, reduced_size
from splatseg.report.colours import colour_labels, draw_ids, layer_colours
from splatseg.report.html import Block, Table
from splatseg.report.images import Gallery, GalleryImage, colour_share, mark_errors, overlay_labels

_LONGEST = 1024
"""Pixels at which views without a truth are drawn."""

# What the truth calls by an id that no id of the layer was matched to.
_UNMATCHED = 1 << 30


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ViewPanel:
    """One view, looked at; all maps have one size."""

    name: str
    held_out: bool
    image: UInt8[Tensor, "height width 3"]
    """The photograph; where there is none the render, the model's own if it was kept."""

    photographed: bool
    """Whether the picture is a photograph."""

    rendered: UInt8[Tensor, "height width 3"] | None
    """The rendering, beside a photograph."""

    drawn: Int[Tensor, "height width"]
    """The layer."""

    confidence: Float[Tensor, "height width"]
    """How sure the labels of what a pixel shows are, -1 where there is nothing."""

    evidence: Int[Tensor, "height width"] | None
    truth: Int[Tensor, "height width"] | None
    agreement: Agreement | None
    """Of the evidence with the layer."""


def view_panel(
    field: Renderable,
    layer: str,
    view: View,
    *,
    held_out: bool,
    evidence: LabelSource | None,
    truth: LabelSource | None,
    same_ids: bool,
) -> ViewPanel:
    """Render a view in the pixels of its truth, else of its photograph reduced.

    Raises:
        ShapeError: If the truth does not have the photograph's proportions.
        MissingFileError: If the photograph is not where it was.
    """
    true = None
    if truth is not None and view.name in truth.view_names:
        true = truth.label_map(view.name).ids
    camera = image_camera(view, _LONGEST) if true is None else camera_of_map(view, *true.shape)
    size = (camera.height, camera.width)
    with field.view(camera) as looked_at:
        shown = label_map_in(looked_at, layer, camera).ids
        confidence = looked_at.confidence(layer)
        image = rendered = rendered_image(looked_at, size)
        picture = view.image or _kept_render(evidence, view.name)
        if picture is not None:
            image = _resized(load_image(replace(view, image=picture), longest=max(size)), size)
    seen = _evidence_ids(evidence, view.name)
    seen = None if seen is None else _nearest(seen, size)
    return ViewPanel(
        name=view.name,
        held_out=held_out,
        image=image,
        photographed=view.image is not None,
        rendered=None if view.image is None else rendered,
        drawn=shown,
        confidence=confidence,
        evidence=seen,
        truth=true,
        agreement=None if seen is None else agreement(shown, seen, same_ids=same_ids),
    )


def rendered_image(
    looked_at: RenderableView, size: tuple[int, int]
) -> UInt8[Tensor, "height width 3"]:
    """What a view shows, in 8 bits; black where the field has no colours."""
    colours = looked_at.signals().colour
    if colours is None:
        return torch.zeros(*size, 3, dtype=torch.uint8)
    return (colours.float().cpu().clamp(0, 1) * 255 + 0.5).to(torch.uint8)


def rename_truth(panels: Sequence[ViewPanel]) -> dict[int, int]:
    """Ids of the layer by true id, matched over the views that are shown.

    A true id without a match gets one that no layer has.
    """
    total = Overlaps.none()
    for panel in panels:
        if panel.truth is not None:
            total = total + Overlaps.of(panel.drawn, panel.truth)
    if not len(total.pairs):
        return {}
    matches = instance_score(total).matches
    return {
        id: matches[id][0] if id in matches else _UNMATCHED + id
        for id in total.truth_sizes[0].tolist()
    }


def confidence_range(panels: Sequence[ViewPanel]) -> tuple[float, float]:
    """What confidence is shown darkest and lightest: what all but a fiftieth of the pixels have.

    Both are whole twentieths, at least two of them apart.
    """
    values = torch.cat([torch.zeros(0), *(panel.confidence.reshape(-1) for panel in panels)])
    values = values[values >= 0].double()
    if not len(values):
        return 0.0, 1.0
    values = values[:: max(1, len(values) // 1_000_000)]
    low, high = torch.quantile(values, torch.tensor((0.02, 0.98), dtype=values.dtype)).tolist()
    high = min(1.0, math.ceil(20 * high) / 20)
    low = max(0.0, math.floor(20 * low) / 20)
    return (low, high) if high - low >= 0.1 else (max(0.0, high - 0.1), max(high, 0.1))


def gallery(
    panels: Sequence[ViewPanel],
    classes: ClassTable,
    *,
    truth_names: dict[int, int] | None,
    evidence_has_same_ids: bool,
    longest: int,
) -> Gallery:
    """Rows of pictures, one a view: what came, what became of it, and the truth if there is one.

    Args:
        panels: The views.
        classes: Names and colours of the layer's ids.
        truth_names: Ids of the layer by true id where they differ, see `rename_truth`.
        evidence_has_same_ids: Evidence is coloured as the layer is; otherwise by its own ids.
        longest: Of the pictures, pixels.
    """
    with_photographs = any(panel.rendered is not None for panel in panels)
    with_evidence = any(panel.evidence is not None for panel in panels)
    with_truth = any(panel.truth is not None for panel in panels)
    columns = [_picture_name(panels)] + ["rendered"] * with_photographs
    columns += ["evidence as it came"] * with_evidence + ["labels on it", "confidence"]
    columns += ["truth", "errors in red"] * with_truth
    low, high = confidence_range(panels)
    rows: list[tuple[str, tuple[GalleryImage, ...]]] = []
    for panel in panels:
        size = _size(panel.image, longest)
        photograph = _resized(panel.image, size)
        drawn = _nearest(panel.drawn, size)
        shown = [GalleryImage(photograph)]
        if with_photographs:
            shown.append(_rendered(panel, size))
        if with_evidence:
            table = classes if evidence_has_same_ids else None
            shown.append(_evidence_image(panel, table, size))
        confidence = _nearest(panel.confidence, size)
        shown += [
            GalleryImage(draw_ids(overlay_labels(photograph, drawn, classes), drawn)),
            GalleryImage(colour_share(confidence, low=low, high=high)),
        ]
        if with_truth:
            shown += _truth_images(panel, classes, truth_names, photograph)
        rows.append((f"{panel.name}, held out" if panel.held_out else panel.name, tuple(shown)))
    return Gallery(
        "What it looks like",
        tuple(columns),
        tuple(rows),
        note="Numbers are ids of the layer. A click, or the Enter key, enlarges a picture. "
        + (
            "Errors: red is a wrong label, blue none; grey pixels are right or void."
            if with_truth
            else ""
        ),
    )


def _rendered(panel: ViewPanel, size: tuple[int, int]) -> GalleryImage:
    if panel.rendered is None:
        return _nothing(size)
    likeness = psnr(panel.rendered, panel.image)
    return GalleryImage(_resized(panel.rendered, size), f"{likeness:.1f} dB")


def _picture_name(panels: Sequence[ViewPanel]) -> str:
    """What the pictures of views are."""
    if all(panel.photographed for panel in panels):
        return "photograph"
    return "photograph or render" if any(panel.photographed for panel in panels) else "render"


def _kept_render(evidence: LabelSource | None, name: str) -> Path | None:
    """What the model was shown of a view without a photograph, where it was kept."""
    return evidence.render(name) if isinstance(evidence, Evidence) else None


def _evidence_image(
    panel: ViewPanel, classes: ClassTable | None, size: tuple[int, int]
) -> GalleryImage:
    if panel.evidence is None or panel.agreement is None:
        return _nothing(size)
    return GalleryImage(
        colour_labels(_nearest(panel.evidence, size), classes),
        kind="chart",
        caption=f"{panel.agreement.differ:.1%} differs",
    )


def _truth_images(
    panel: ViewPanel,
    classes: ClassTable,
    names: dict[int, int] | None,
    photograph: UInt8[Tensor, "height width 3"],
) -> list[GalleryImage]:
    size = (int(photograph.shape[0]), int(photograph.shape[1]))
    if panel.truth is None:
        return [_nothing(size), _nothing(size)]
    truth = panel.truth if names is None else map_ids(panel.truth, names, default=None)
    known = truth != UNLABELLED
    right = float((panel.drawn == truth)[known].double().mean()) if bool(known.any()) else 0.0
    marked = mark_errors(
        photograph, _nearest(panel.drawn, size).long(), truth=_nearest(truth, size).long()
    )
    return [
        GalleryImage(colour_labels(_nearest(truth, size), classes), kind="chart"),
        GalleryImage(marked, f"{right:.1%} right"),
    ]


def _nothing(size: tuple[int, int]) -> GalleryImage:
    grey = torch.full((*size, 3), 128, dtype=torch.uint8)
    return GalleryImage(grey, kind="chart", caption="there is none of this view")


def _evidence_ids(evidence: LabelSource | None, name: str) -> Int[Tensor, "height width"] | None:
    """Ids of a view's evidence; masks are painted from the largest to the smallest."""
    if evidence is None or name not in evidence.view_names:
        return None
    if not isinstance(evidence, Evidence) or evidence.kind in ("labels", "panoptic", "tracked"):
        return evidence.label_map(name).ids
    if evidence.kind != "masks":
        return None
    masks = evidence.masks(name)
    ids = torch.full((masks.height, masks.width), UNLABELLED, dtype=torch.int32)
    areas = [mask.area for mask in masks.masks]
    for i in sorted(range(len(areas)), key=lambda i: (-areas[i], i)):
        ids[masks.masks[i].decode()] = i + 1
    return LabelMap(ids=ids).ids


def _size(image: Tensor, longest: int) -> tuple[int, int]:
    width, height = reduced_size(int(image.shape[1]), int(image.shape[0]), longest)
    return height, width


def _nearest(values: Tensor, size: tuple[int, int]) -> Tensor:
    """A map in another size; each pixel takes the value under its centre."""
    rows, columns = (
        ((torch.arange(to) + 0.5) * (of / to)).long().clamp(max=of - 1)
        for to, of in zip(size, values.shape[:2], strict=True)
    )
    return values[rows][:, columns]


def _resized(
    image: UInt8[Tensor, "height width 3"], size: tuple[int, int]
) -> UInt8[Tensor, "rows columns 3"]:
    if tuple(image.shape[:2]) == size:
        return image
    planes = image.movedim(-1, 0)[None].float()
    small = torch.nn.functional.interpolate(planes, size=size, mode="bilinear", antialias=True)
    return small[0].movedim(0, -1).round().clamp(0, 255).to(torch.uint8)


# What a report shows of a tree of instances: its nodes, and pictures of its cuts.


_CUT_LONGEST = 448
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
        camera = image_camera(view, _CUT_LONGEST)
        size = (camera.height, camera.width)
        with field.view(camera) as looked_at:
            drawn = [
                label_map_in(looked_at, f"{layer}@{level}", camera).ids for level in TREE_LEVELS
            ]
            if view.image is None:
                photograph = rendered_image(looked_at, size)
            else:
                photograph = load_image(view, longest=_CUT_LONGEST)
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
        "The tree at three levels",
        tuple(f"{level}s" for level in TREE_LEVELS),
        tuple(rows),
        note="Groups hold objects, objects hold parts. What has no level above it, or none below, "
        "is shown at the next.",
    )


def _picture(photograph: Tensor, ids: Tensor, colours: ClassTable) -> GalleryImage:
    return GalleryImage(draw_ids(overlay_labels(photograph, ids, colours), ids))


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
        "The tree",
        ("node", "id", "level", "Gaussians", "support", "masks", "views"),
        cells,
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
