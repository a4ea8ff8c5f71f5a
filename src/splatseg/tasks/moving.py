"""Moving things that a command is asked to leave out: of views, and of scans."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from splatseg.core import Capture, ScanSource, View
from splatseg.core.scans import MovingBox
from splatseg.errors import InputError
from splatseg.io.atomic import atomic_folder
from splatseg.io.evidence import Evidence, open_evidence
from splatseg.io.images import load_mask
from splatseg.io.moving import MovingOptions, StaticScans, mask_moving, read_moving
from splatseg.io.scene_folder import MASKS_FOLDER
from splatseg.tasks.work import find_label_maps

MovingClock = Literal["recorded", "frames"]
"""What times of boxes are."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MovingThings:
    """What moves: boxes of it, and classes of label maps."""

    boxes: tuple[MovingBox, ...] = ()
    classes: tuple[str, ...] = ()
    clock: MovingClock = "recorded"

    @property
    def record(self) -> dict[str, Any]:
        """The same in values that JSON holds; boxes are counted."""
        return {"boxes": len(self.boxes), "classes": list(self.classes), "clock": self.clock}


@dataclass(frozen=True, slots=True, kw_only=True)
class LeftOut:
    """What views lose with moving things."""

    things: MovingThings

    views: int
    """How many lose anything."""

    of: int
    """How many there are."""

    share: float
    """Of the pixels of all of them, in [0, 1]; what their own masks leave out is not counted."""

    @property
    def sentence(self) -> str:
        """In words, without a full stop."""
        return (
            f"moving things are left out of {self.views} of the {self.of} training views, "
            f"{self.share:.1%} of their pixels"
        )

    @property
    def record(self) -> dict[str, Any]:
        """In values that JSON holds."""
        return self.things.record | {
            "masked_views": self.views,
            "masked_share": round(self.share, 6),
        }


def moving_things(
    boxes: Path | None, classes: Sequence[str], clock: MovingClock
) -> MovingThings | None:
    """What moves, as options say it; None where they say nothing.

    Args:
        boxes: The option ``moving``: a file of boxes, or a data set that has some.
        classes: The option ``moving_classes``.
        clock: The option ``moving_clock``.

    Raises:
        InputError: If there is a clock without boxes.
        MissingFileError: If there is no such file.
        FileFormatError: If it has no boxes.
    """
    if boxes is None and clock != "recorded":
        raise InputError(f"moving_clock: expected boxes with it (`moving`), got {clock} alone.")
    if boxes is None and not classes:
        return None
    found = () if boxes is None else read_moving(boxes, clock=clock)
    return MovingThings(boxes=found, classes=tuple(classes), clock=clock)


def without_moving(
    capture: Capture,
    folder: Path,
    things: MovingThings,
    *,
    labels: Evidence | None,
    times: Mapping[str, float] | None = None,
) -> tuple[Capture, LeftOut]:
    """The capture whose training views have masks without what moves.

    Args:
        capture: The capture.
        folder: Where masks are written, by view name.
        things: What moves.
        labels: Label maps that know the classes.
        times: Of the views, where they are known better than the capture knows them.

    Raises:
        InputError: If there is a class that the label maps do not know, or boxes are there at no
            time of any view.
        OutputError: If a mask cannot be written.
    """
    _check_classes(things.classes, labels)
    masked = mask_moving(
        capture,
        folder,
        boxes=things.boxes,
        labels=labels if things.classes else None,
        classes=things.classes,
        times=times if things.boxes else None,
        options=MovingOptions(clock=things.clock),
    )
    pairs = zip(capture.train_views, masked.train_views, strict=True)
    changed = [(before, after) for before, after in pairs if before.mask != after.mask]
    pixels = sum(view.camera.width * view.camera.height for view in capture.train_views)
    lost = sum(_used(before) - _used(after) for before, after in changed)
    return masked, LeftOut(
        things=things,
        views=len(changed),
        of=len(capture.train_views),
        share=lost / max(pixels, 1),
    )


def without_moving_points(
    scans: ScanSource, things: MovingThings | None, *, metres_per_unit: float
) -> ScanSource:
    """Scans without their points in boxes of moving things; the same ones where there are none."""
    if things is None or not things.boxes:
        return scans
    margin = MovingOptions().margin / metres_per_unit
    return StaticScans(scans, things.boxes, margin=margin, clock=things.clock)


def _used(view: View) -> int:
    """Pixels that the mask of a view leaves."""
    mask = load_mask(view)
    return view.camera.width * view.camera.height if mask is None else int(mask.sum())


def _check_classes(classes: Sequence[str], labels: Evidence | None) -> None:
    """Refuse classes that label maps do not know, by the name of the option."""
    if not classes:
        return
    if labels is None or labels.classes is None:
        raise InputError(
            "moving_classes: expected label maps with names of classes, to know what moves, got "
            f"{'none' if labels is None else f'maps without names in {labels.folder}'}."
        )
    known = {row.name for row in labels.classes.rows}
    for name in classes:
        if name not in known:
            raise InputError(
                f"moving_classes: expected classes of {labels.folder} "
                f"({', '.join(sorted(known))}), got {name!r:.80}."
            )


def capture_without_moving(
    capture: Capture, things: MovingThings, *, scene: Path, evidence: str | None, masks: str
) -> tuple[Capture, LeftOut]:
    """The capture whose training views have masks without what moves, in the scene's folder.

    Args:
        capture: The capture.
        things: What moves.
        scene: The scene folder that the fit writes; masks of an earlier fit are replaced.
        evidence: The option ``moving_evidence``: a folder of label maps, or its name; None takes
            the only ones.
        masks: What the fit takes masks for.

    Raises:
        InputError: If masks mean something else to the fit, or what moves cannot be told.
        OutputError: If the masks cannot be written.
    """
    if masks != "ignore":
        raise InputError(f"masks: expected ignore with moving things, got {masks}.")
    if evidence is not None and not things.classes:
        raise InputError(
            f"moving_evidence: expected classes with it (`moving_classes`), got {evidence!r:.80} "
            "alone."
        )
    labels = _labels(capture, scene, evidence) if things.classes else None
    target = scene / MASKS_FOLDER
    with atomic_folder(target) as folder:
        masked, left_out = without_moving(capture, folder, things, labels=labels)
        views = tuple(
            replace(view, mask=target / view.mask.relative_to(folder))
            if view.mask is not None and view.mask.is_relative_to(folder)
            else view
            for view in masked.views
        )
    return replace(masked, views=views), left_out


def _labels(capture: Capture, scene: Path, asked: str | None) -> Evidence:
    folder = Path(asked or "")
    if asked is None or not folder.is_dir():
        folder = find_label_maps([capture.path, scene], asked, option="moving_evidence")
    found = open_evidence(folder)
    if found.kind != "labels":
        raise InputError(
            f"moving_evidence: expected evidence of labels, got {found.kind} in {folder}."
        )
    return found
