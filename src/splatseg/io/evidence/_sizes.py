"""Label maps against the photographs they are of, by their headers, before any is decoded."""

from collections.abc import Iterable

from splatseg.core import View
from splatseg.errors import FileFormatError
from splatseg.io.evidence._base import PICTURE_SUFFIXES, Evidence
from splatseg.io.evidence._labels import LabelEvidence
from splatseg.io.evidence._segments import TableEvidence
from splatseg.io.images import open_image

_TIMES = 4
"""Pixels of a label map for each pixel of its photograph; more are of another picture."""


def check_map_sizes(evidence: Evidence, views: Iterable[View]) -> None:
    """Refuse label maps that are far larger than their photographs, before they cost memory.

    Evidence of other kinds passes: masks and features are held against `io.limits` alone.

    Args:
        evidence: Of any kind.
        views: The views whose maps will be read; those without a map are passed over.

    Raises:
        FileFormatError: If a map has more than four times the pixels of its photograph.
    """
    maps = evidence.maps if isinstance(evidence, TableEvidence) else evidence
    if not isinstance(maps, LabelEvidence):
        return
    for view in views:
        path = maps.files.get(view.name)
        if path is None or path.suffix not in PICTURE_SUFFIXES:
            continue  # an .npy takes as much on the disk as in memory, `io.limits` holds an .npz
        with open_image(path) as image:
            width, height = image.size
        camera = view.camera
        if width * height > _TIMES * camera.width * camera.height:
            raise FileFormatError(
                f"{path}: expected a label map of {camera.width}x{camera.height} pixels as the "
                f"photograph of the view has, got {width}x{height}."
            )
