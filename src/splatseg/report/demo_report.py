"""What the demo shows at its end: a contact sheet and a report."""

import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Int
from PIL import Image
from torch import Tensor

from splatseg.core import ClassTable, InstanceTree, Labels, RenderableLayer, Scene
from splatseg.errors import InputError
from splatseg.evaluate import Confusion, SemanticScore, psnr, semantic_score
from splatseg.io.atomic import atomic_file
from splatseg.io.evidence import Evidence, open_evidence
from splatseg.io.images import load_image, save_png
from splatseg.io.json_files import read_json
from splatseg.io.scene import load_scene, load_scene_layer
from splatseg.lift import label_map
from splatseg.report.colours import colour_labels, draw_ids, layer_colours
from splatseg.report.html import Bars, Commands, Figure, Legend, Report, Table, report_html
from splatseg.report.images import Gallery, GalleryImage, colour_depth, contact_sheet, mark_errors
from splatseg.report.words import count_text, counted, environment, spread

_HELD_OUT_ROWS = 6
_TRAIN_ROWS = 4
_SHEET_ROWS = 4


@dataclass(frozen=True, slots=True, kw_only=True)
class DemoFigures:
    """What the demo measured."""

    came: SemanticScore
    """Machine labels against the truth, on the train views."""

    train: Mapping[str, Any]
    """What evaluate says of the lifted labels on train views."""

    test: Mapping[str, Any]
    """The same of held-out views."""

    objects: Mapping[str, Any]
    """What evaluate says of the objects on held-out views."""

    steps: tuple[tuple[str, float], ...]
    """Names and seconds."""

    commands: tuple[str, ...]
    """Lines that were run."""

    started: float
    """`time.monotonic` at the beginning."""


def machine_score(capture: Path, evidence: str) -> SemanticScore:
    """Score the recorded labels of a capture in the views that have them, pooled."""
    labels, truth = open_evidence(capture / evidence), open_evidence(capture / "semantic")
    pairs = ((labels.label_map(name).ids, truth.label_map(name).ids) for name in labels.view_names)
    return semantic_score(sum((Confusion.of(*pair) for pair in pairs), Confusion.none()))


def write_report(
    figures: DemoFigures, folder: Path, *, seed: int, layer: str, evidence: str, objects: str
) -> None:
    """Write contact_sheet.png and report.html of a demo's folder."""
    scene = load_scene(folder / "scene")
    truth = open_evidence(folder / "capture" / "semantic")
    classes = scene.classes or ClassTable(rows=())
    held_out = _held_out_gallery(folder, scene, truth, layer=layer, objects=objects)
    labels = load_scene_layer(folder / "scene", layer)
    if not isinstance(labels, Labels):
        raise InputError(f"{layer}: expected a layer of labels.")
    came = open_evidence(folder / "capture" / evidence)
    mended = _train_gallery(scene, truth, came, labels)
    save_png(_sheet(figures, held_out, classes), folder / "contact_sheet.png")
    report = Report(
        title="A generated room, segmented in 3D",
        summary=(
            "Photographs of a room that does not exist, and class maps with the mistakes a "
            "network makes, went in. Out came Gaussians that look like the room and whose labels "
            "agree with each other from all sides. The truth is known exactly, because the room "
            "was generated; held-out views were not used for anything but this report."
        ),
        figures=_figures(figures, scene),
        blocks=(
            held_out,
            Legend(classes=classes, title="Colours of the classes"),
            mended,
            _class_bars(figures, classes),
            _score_table(figures),
            _step_table(figures),
            Commands(
                "The same from the shell",
                figures.commands,
                note="What the demo ran after it had generated the capture.",
            ),
        ),
        facts=_facts(folder, scene, seed),
    )
    with atomic_file(folder / "report.html") as path:
        path.write_text(report_html(report), encoding="utf-8", newline="\n")


def _sheet(figures: DemoFigures, held_out: Gallery, classes: ClassTable) -> Tensor:
    """The contact sheet: some rows of the gallery under the figures that matter."""
    return contact_sheet(
        Gallery(
            "splatseg demo: a generated room, seen from held-out views",
            held_out.columns,
            spread(held_out.rows, _SHEET_ROWS),
        ),
        subtitle=(
            f"PSNR {figures.test['PSNR']:.1f} dB on "
            f"{counted(figures.test['photographs'], 'held-out view')}; "
            f"mIoU of the labels {figures.came.miou:.2f} as they came, "
            f"{figures.test['mIoU']:.2f} lifted into 3D and rendered"
        ),
        classes=classes,
        cell_width=288,
    )


def _figures(figures: DemoFigures, scene: Scene) -> tuple[Figure, ...]:
    before, after = figures.came.miou, figures.test["mIoU"]
    test, objects = figures.test, figures.objects
    rows = (
        ("Pictures of held-out views", f"{test['PSNR']:.1f} dB",
         f"PSNR, mean of {counted(test['photographs'], 'view')}; SSIM {test['SSIM']:.3f}"),
        ("Labels as they came", f"{before:.3f}", "pooled mIoU of the machine labels, train views"),
        ("Labels lifted and rendered", f"{after:.3f}",
         f"pooled mIoU on held-out views, {100 * (after - before):+.1f} points"),
        ("Objects, from masks without weights", f"{objects['mIoU']:.3f}",
         f"instance mIoU on held-out views; {objects['predicted_instances']} found, "
         f"{objects['truth_instances']} true ones"),
        ("Gaussians", count_text(len(scene.gaussians)),
         f"from {len(scene.train_views)} photographs"),
    )  # fmt: skip
    return tuple(Figure(*row) for row in rows)


def _held_out_gallery(
    folder: Path, scene: Scene, truth: Evidence, *, layer: str, objects: str
) -> Gallery:
    """Photograph, rendering, depth, labels, truth, errors and objects of some test views."""
    renders = folder / "render"
    tree = load_scene_layer(folder / "scene", objects)
    found = tree.cut() if isinstance(tree, InstanceTree) else tree
    colours = None
    if isinstance(found, Labels):
        colours = layer_colours(
            RenderableLayer.of(found), None, gaussians=scene.gaussians, labels=found
        )
    unit = read_json(renders / "depth" / "depth.json")["unit"]
    views = spread(scene.test_views, _HELD_OUT_ROWS)
    depths = [_read(renders / "depth" / f"{view.name}.png").double() * unit for view in views]
    far = max(float(depth.max()) for depth in depths)
    rows: list[tuple[str, tuple[GalleryImage, ...]]] = []
    columns: tuple[str, ...] = ()
    for view, depth in zip(views, depths, strict=True):
        photograph = load_image(view)
        drawn = _read(renders / "rgb" / f"{view.name}.png").to(torch.uint8)
        ids = _ids(renders / layer / f"{view.name}.png")
        things = _ids(renders / objects / f"{view.name}.png")
        true = truth.label_map(view.name).ids
        errors = mark_errors(photograph, ids, truth=true)
        pictures = {
            "photograph": GalleryImage(photograph),
            "rendered": GalleryImage(drawn, f"{psnr(drawn, photograph):.1f} dB"),
            "depth": GalleryImage(colour_depth(depth, near=0.3, far=far)),
            "labels, rendered": _labels(ids, scene.classes),
            "truth": _labels(true, scene.classes),
            "errors in red": GalleryImage(errors, f"{_right(ids, true):.1%} right"),
            "objects": GalleryImage(draw_ids(colour_labels(things, colours), things), kind="chart"),
        }
        columns = tuple(pictures)
        rows.append((view.name, tuple(pictures.values())))
    return Gallery(
        "Held-out views",
        columns,
        tuple(rows),
        note="No photograph and no label of these views was used before. Objects come from masks "
        "that need no weights, joined in 3D; objects.html in scene/reports shows each of "
        "them by its number.",
    )


def _train_gallery(scene: Scene, truth: Evidence, came: Evidence, labels: Labels) -> Gallery:
    """What lifting mends: the labels of train views before and after."""
    rows: list[tuple[str, tuple[GalleryImage, ...]]] = []
    for view in spread(scene.train_views, _TRAIN_ROWS):
        true = truth.label_map(view.name).ids
        before = came.label_map(view.name).ids
        after = label_map(scene.gaussians, view.camera, labels).ids
        pictures = (
            GalleryImage(load_image(view)),
            _labels(before, scene.classes, right=_right(before, true)),
            _labels(after, scene.classes, right=_right(after, true)),
            _labels(true, scene.classes),
        )
        rows.append((view.name, pictures))
    return Gallery(
        "What lifting mends",
        ("photograph", "labels as they came", "lifted and rendered", "truth"),
        tuple(rows),
        note=(
            "Train views. Mistakes of single views are outvoted by the others; an object that "
            "is mistaken from most sides stays mistaken."
        ),
    )


def _class_bars(figures: DemoFigures, classes: ClassTable) -> Bars:
    lifted: Mapping[str, float] = figures.test["per_class"]
    return Bars(
        "IoU of each class",
        ("as they came, train views", "lifted, held-out views"),
        tuple(
            (row.name, (figures.came.per_class.get(row.id), lifted.get(str(row.id))))
            for row in classes.rows
        ),
        note="Intersection over union, pooled over the pixels of all views.",
    )


def _score_table(figures: DemoFigures) -> Table:
    came = figures.came
    rows: list[tuple[str | float, ...]] = [
        ("as they came", "train", came.miou, came.fwiou, came.accuracy)
    ]
    for views, of in (("train", figures.train), ("held out", figures.test)):
        rows.append(("lifted and rendered", views, of["mIoU"], of["fwIoU"], of["accuracy"]))
    return Table(
        "Class maps against the truth",
        ("labels", "views", "mIoU", "fwIoU", "accuracy"),
        tuple(rows),
        note="Pooled over the pixels of all views of a row.",
    )


def _step_table(figures: DemoFigures) -> Table:
    rows = [(name, f"{seconds:.1f}") for name, seconds in figures.steps]
    rows.append(("until this report", f"{time.monotonic() - figures.started:.1f}"))
    return Table("Time", ("step", "seconds"), tuple(rows))


def _facts(folder: Path, scene: Scene, seed: int) -> dict[str, Any]:
    capture = read_json(folder / "capture" / "metadata.json")
    return {
        "room": f"splatseg.synthetic.room(seed={seed})",
        "photographs": f"{len(scene.train_views)} train and {len(scene.test_views)} held out, "
        f"{capture['width']} x {capture['height']} pixels",
        "fit": f"{scene.provenance.get('steps')} steps",
    } | environment()


def _labels(
    ids: Int[Tensor, "height width"], classes: ClassTable | None, *, right: float | None = None
) -> GalleryImage:
    caption = "" if right is None else f"{right:.1%} right"
    return GalleryImage(colour_labels(ids, classes), kind="chart", caption=caption)


def _right(ids: Tensor, truth: Tensor) -> float:
    return float((ids == truth)[truth >= 0].float().mean())


def _ids(path: Path) -> Tensor:
    ids = _read(path).int()
    return torch.where(ids == 0, -1, ids)


def _read(path: Path) -> Tensor:
    with Image.open(path) as image:
        return torch.from_numpy(np.array(image).astype(np.int32))
