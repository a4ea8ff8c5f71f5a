"""Moving things left out of a fit: masks of training views, kept in the scene that is made."""

from dataclasses import replace
from pathlib import Path

from splatseg.core import Capture
from splatseg.errors import InputError
from splatseg.io.atomic import atomic_folder
from splatseg.io.evidence import Evidence, open_evidence
from splatseg.io.scene_folder import MASKS_FOLDER
from splatseg.tasks._label_evidence import find_label_maps
from splatseg.tasks._moving import LeftOut, MovingThings, without_moving


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
