"""Does a splat file lie where a capture's cameras look? If not, what brings it there?"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from splatseg.core import Camera, Capture, Gaussians, PointCloud, Similarity
from splatseg.core.boundary import boundary
from splatseg.core.threads import one_torch_thread
from splatseg.errors import InputError
from splatseg.io.images import image_camera, load_image
from splatseg.pose.doctor import (
    PointCorrection,
    axis_rotations,
    declared_transforms,
    describe_move,
    find_points,
)
from splatseg.render import render

FITS = 0.5
"""Least correlation of renders with photographs that is called a fit. Splats in their place have
0.8 to 0.99, in a wrong one 0.3 at most."""

FITS_SEARCHED = 0.75
"""The same for a frame that nothing declares and that is no change of axes."""

_LONGEST = 128
_VIEWS = 8
_POINTS = 30000
# An alternative must be better by this much than leaving the file as it is.
_BETTER = 0.1


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Alignment:
    """How Gaussians lie to a capture."""

    capture_from_file: Similarity
    """What was applied to the Gaussians; the identity where they fit as they are."""

    what: str
    """The move in words; empty for the identity."""

    correlation: float
    """Mean correlation of renders with photographs after the move, -1 to 1."""

    psnr: float
    """Mean PSNR of the small renders after it, dB."""

    correlation_as_is: float
    """The same without the move."""

    @property
    def moved(self) -> bool:
        """Whether the Gaussians had to be moved."""
        return bool(self.what)


@one_torch_thread()  # its sums would round differently with the number of threads
@boundary
def align(
    gaussians: Gaussians,
    capture: Capture,
    *,
    splats: Path | None = None,
    backend: str = "auto",
) -> Alignment:
    """Find the similarity that lays Gaussians onto a capture, by drawing it.

    Eight views are drawn small and correlated with their photographs. Gaussians that fit stay.
    Otherwise these are tried: what a ``dataparser_transforms.json`` beside the splat file or in
    the capture says (nerfstudio trains in a world of its own), and transforms.json's
    ``applied_transform``, each way; the 24 changes of axes; and the similarity that lays the
    Gaussians' centres onto what the photographs' matches triangulate.

    Args:
        gaussians: What the file holds.
        capture: Photographs with cameras.
        splats: The file, for what lies beside it.
        backend: Who renders.

    Raises:
        InputError: If nothing fits, with the best correlation that was reached; or if the
            capture has no photographs.
    """
    views = [view for view in (capture.train_views or capture.views) if view.image is not None]
    if not views:
        raise InputError(f"{capture.path}: expected photographs to compare with, got none.")
    index = np.unique(np.linspace(0, len(views) - 1, min(_VIEWS, len(views))).round().astype(int))
    photographs = [
        (image_camera(views[i], _LONGEST), load_image(views[i], longest=_LONGEST).float() / 255)
        for i in index.tolist()
    ]
    unchanged = PointCorrection(matrix=np.eye(3))
    as_is = _compare(gaussians, unchanged, photographs, backend)
    if as_is[0] >= FITS:
        return _alignment(unchanged, as_is, as_is)
    # The cheap ones first; the similarity takes seconds and is rarely needed.
    candidates = [
        *declared_transforms(capture.path),
        *(declared_transforms(splats.parent) if splats is not None else ()),
        *(PointCorrection(matrix=matrix) for matrix in axis_rotations()[1:]),
    ]
    best, figures = _best(gaussians, candidates, photographs, backend)
    if figures[0] < FITS:
        found = find_points(capture, _centres(gaussians))
        if found is not None and np.linalg.det(found.matrix) > 0:
            again = _compare(gaussians, found, photographs, backend)
            # A search that only came close shows by less than a good fit has.
            if again[0] >= FITS_SEARCHED:
                best, figures = found, again
    if figures[0] < FITS or figures[0] < as_is[0] + _BETTER:
        raise InputError(
            f"{capture.path}: the splats do not fit its photographs (correlation "
            f"{as_is[0]:.2f} as they are, {max(figures[0], as_is[0]):.2f} at best after a change "
            "of axes or frame); `splatseg doctor` says whether the capture itself is wrong."
        )
    return _alignment(best, figures, as_is)


def similarity_of(move: PointCorrection) -> Similarity:
    """A correction of points as a similarity.

    Raises:
        InputError: If it mirrors, which Gaussians with harmonics cannot follow.
    """
    if np.linalg.det(move.matrix) < 0:
        raise InputError("move: expected a rotation, got a reflection.")
    return Similarity(
        rotation=torch.from_numpy(np.ascontiguousarray(move.matrix)),
        translation=torch.tensor(move.offset, dtype=torch.float64),
        scale=move.scale,
    )


_Photograph = tuple[Camera, Tensor]
"""A small camera, and what it photographed in [0, 1]."""


def _best(
    gaussians: Gaussians,
    candidates: Sequence[PointCorrection],
    photographs: Sequence[_Photograph],
    backend: str,
) -> tuple[PointCorrection, tuple[float, float]]:
    able = [c for c in candidates if np.linalg.det(c.matrix) > 0]
    scored = [(_compare(gaussians, c, photographs, backend), c) for c in able]
    figures, best = max(scored, key=lambda item: item[0][0])
    return best, figures


def _compare(
    gaussians: Gaussians,
    move: PointCorrection,
    photographs: Sequence[_Photograph],
    backend: str,
) -> tuple[float, float]:
    """Mean correlation and PSNR of what is drawn with what was photographed.

    The cameras are moved instead of the Gaussians: the pictures are the same.
    """
    file_from_capture = similarity_of(move).inverse()
    correlations: list[float] = []
    decibels: list[float] = []
    for camera, pixels in photographs:
        moved = camera.moved(file_from_capture)
        with torch.no_grad():
            drawn = render(gaussians, moved, backend=backend).image.clamp(0, 1).cpu()
        error = float(((drawn - pixels) ** 2).mean())
        decibels.append(-10 * float(np.log10(max(error, 1e-10))))
        correlations.append(_correlation(drawn, pixels))
    return sum(correlations) / len(correlations), sum(decibels) / len(decibels)


def _correlation(first: Tensor, second: Tensor) -> float:
    """Pearson's correlation of the pixels, each channel about its own mean; 0 if one is flat."""
    a, b = (x.reshape(-1, 3) - x.reshape(-1, 3).mean(dim=0) for x in (first, second))
    norm = float(torch.linalg.vector_norm(a) * torch.linalg.vector_norm(b))
    return float((a * b).sum()) / norm if norm > 1e-9 else 0.0


def _centres(gaussians: Gaussians) -> PointCloud:
    """Centres and colours of solid Gaussians, as many as points are looked at."""
    solid = torch.nonzero(gaussians.opacities.detach().cpu() >= 0.3)[:, 0]
    if len(solid) < 100:
        solid = torch.arange(len(gaussians))
    rng = np.random.default_rng(0)
    if len(solid) > _POINTS:
        solid = solid[torch.from_numpy(np.sort(rng.permutation(len(solid))[:_POINTS]))]
    colours = (gaussians.colours.detach().cpu()[solid].clamp(0, 1) * 255 + 0.5).to(torch.uint8)
    return PointCloud(points=gaussians.means.detach().cpu()[solid].float(), colours=colours)


def _alignment(
    move: PointCorrection, figures: tuple[float, float], as_is: tuple[float, float]
) -> Alignment:
    what = "" if move.changes_nothing else describe_move(move)
    if what and move.source is not None:
        what = f"{move.source.split(',')[0]}, {what}"
    return Alignment(
        capture_from_file=similarity_of(move),
        what=what,
        correlation=figures[0],
        psnr=figures[1],
        correlation_as_is=as_is[0],
    )
