"""A scene held against truth: its layers and pictures drawn in views and scored there.

Predictions are drawn in the pixels of the truth, so nothing that is scored was resized. A layer
that learned from a view it is scored on is said to, in the report's `learned_from`.
"""

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import UInt8
from torch import Tensor

from splatseg.core import (
    UNLABELLED,
    Gaussians,
    LabelMap,
    Labels,
    LabelSource,
    Selection,
    View,
    camera_of_map,
)
from splatseg.errors import InputError
from splatseg.evaluate.boundary import (
    BoundaryCounts,
    BoundaryScore,
    boundary_overlap,
    boundary_score,
)
from splatseg.evaluate.metrics import (
    SSIM_WINDOW,
    BinaryScore,
    Confusion,
    SemanticScore,
    binary_score,
    per_image_miou,
    psnr,
    semantic_score,
    ssim,
)
from splatseg.io.images import load_alpha, load_image, load_mask
from splatseg.lift import label_map
from splatseg.render import RenderOptions, render

Progress = Callable[[int, int], None]

MaskUse = Literal["off", "ignore", "alpha"]
"""What the masks of views mean, as in a fit."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SemanticReport:
    """Scores of a layer's classes."""

    score: SemanticScore
    """Pooled over all views."""

    per_image_miou: float
    """Mean over views of each view's own mean IoU."""

    boundary: BoundaryScore
    """Boundary IoU, pooled over all views."""

    views: tuple[str, ...]
    """Views that were scored."""

    learned_from: tuple[str, ...]
    """Those of them that the layer was made from."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BinaryReport:
    """Scores of one object, or of a selection."""

    score: BinaryScore
    boundary_mean: float
    """Mean over views of boundary IoU; a view where both masks are empty counts 1."""

    boundary_pooled: float
    """Boundary IoU of all views' pixels together; 0 where there are none."""

    views: tuple[str, ...]
    """Views that were scored."""

    learned_from: tuple[str, ...]
    """Those of them that the layer was made from."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewScore:
    """How like its photograph one picture is."""

    name: str
    """Of the view."""

    psnr: float
    """Decibels."""

    ssim: float
    lpips: float | None = None
    """None where no network was given."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PhotographReport:
    """How like the photographs the pictures are."""

    psnr: float
    """Mean over views, decibels."""

    psnr_min: float
    """Of the worst view, decibels."""

    ssim: float
    """Mean over views."""

    views: tuple[str, ...]
    """Views that were scored."""

    per_view: tuple[ViewScore, ...] = ()
    """The scores of each of them."""

    lpips: float | None = None
    """Mean over views; None where no network was given."""


def evaluate_semantic(
    gaussians: Gaussians,
    views: Sequence[View],
    labels: Labels,
    truth: LabelSource,
    *,
    options: RenderOptions | None = None,
    backend: str = "auto",
    progress: Progress | None = None,
) -> SemanticReport:
    """Score the classes of a layer in the views that have a truth.

    Args:
        gaussians: The Gaussians of the scene.
        views: Where to look; those without a truth are left out.
        labels: The layer.
        truth: Label maps by view name; -1 is void.
        options: Switches of the blending model.
        backend: Name of the rendering backend.
        progress: Called with the views done and their number.

    Raises:
        InputError: If no view has a truth.
        ShapeError: If a truth does not have its photograph's proportions.
    """
    scored = with_truth(views, truth)
    confusions: list[Confusion] = []
    outlines = BoundaryCounts.none()
    for done, view in enumerate(scored, start=1):
        true = truth.label_map(view.name)
        drawn = drawn_like(gaussians, view, labels, true, options=options, backend=backend)
        confusions.append(Confusion.of(drawn.ids, true.ids))
        outlines = outlines + BoundaryCounts.of(drawn.ids, true.ids)
        if progress is not None:
            progress(done, len(scored))
    return SemanticReport(
        score=semantic_score(sum(confusions, start=Confusion.none())),
        per_image_miou=per_image_miou(confusions),
        boundary=boundary_score(outlines),
        views=tuple(view.name for view in scored),
        learned_from=learned_from(labels, scored),
    )


def evaluate_binary(
    gaussians: Gaussians,
    views: Sequence[View],
    layer: Labels | Selection,
    truth: LabelSource,
    *,
    id: int | None = None,
    options: RenderOptions | None = None,
    backend: str = "auto",
    progress: Progress | None = None,
) -> BinaryReport:
    """Score a selection, or one id of a layer, as a mask in the views that have a truth.

    Args:
        gaussians: The Gaussians of the scene.
        views: Where to look; those without a truth are left out.
        layer: A selection, or labels.
        truth: Label maps by view name.
        id: The id to score, of the truth and of a layer of labels; None takes every labelled
            pixel.
        options: Switches of the blending model.
        backend: Name of the rendering backend.
        progress: Called with the views done and their number.

    Raises:
        InputError: If no view has a truth.
        ShapeError: If a truth does not have its photograph's proportions.
    """
    scored = with_truth(views, truth)
    labels = layer if isinstance(layer, Labels) else labels_of(layer)
    wanted = id if isinstance(layer, Labels) else None
    outlines: list[tuple[int, int]] = []

    def pairs() -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
        for done, view in enumerate(scored, start=1):
            true = truth.label_map(view.name)
            drawn = drawn_like(gaussians, view, labels, true, options=options, backend=backend)
            masks = _mask(drawn, wanted), _mask(true, id)
            outlines.append(boundary_overlap(*masks))
            yield masks
            if progress is not None:
                progress(done, len(scored))

    score = binary_score(pairs())
    both, either = (sum(counts) for counts in zip(*outlines, strict=True))
    return BinaryReport(
        score=score,
        boundary_mean=math.fsum(b / e if e else 1.0 for b, e in outlines) / len(outlines),
        boundary_pooled=both / max(either, 1),
        views=tuple(view.name for view in scored),
        learned_from=learned_from(layer, scored),
    )


def evaluate_photographs(
    gaussians: Gaussians,
    views: Sequence[View],
    *,
    masks: MaskUse = "off",
    lpips: Callable[[torch.Tensor, torch.Tensor], float] | None = None,
    seconds: float = math.inf,
    options: RenderOptions | None = None,
    backend: str = "auto",
    progress: Progress | None = None,
) -> PhotographReport:
    """Score the pictures against the photographs, as 8-bit files of both would score.

    Args:
        gaussians: The Gaussians of the scene.
        views: Views with photographs.
        masks: What masks mean. ``ignore``: only pixels that a view's mask keeps are scored, for a
            fit that ignored the others knows nothing of them; a view of which nothing is kept is
            left out. ``alpha``: what the mask, or the alpha channel of the photograph, cuts out is
            scored, photograph and picture over white, as is the custom for such scenes. ``off``,
            and a view without a mask: every pixel.
        lpips: A network with weights (`splatseg.evaluate.lpips.load_lpips`); None leaves that
            score out.
        seconds: After so long no further view is begun; at least one is scored.
        options: Switches of the blending model.
        backend: Name of the rendering backend.
        progress: Called with the views done and their number.

    Raises:
        InputError: If there are no views, one has no photograph, or masks leave nothing to score.
        MissingFileError: If a photograph is not where it was.
    """
    if not views:
        raise InputError("views: expected at least one view with a photograph, got none.")
    scores: list[ViewScore] = []
    begin = time.monotonic()
    for done, view in enumerate(views, start=1):
        score = _view_score(
            gaussians, view, masks=masks, lpips=lpips, options=options, backend=backend
        )
        if score is not None:
            scores.append(score)
        if progress is not None:
            progress(done, len(views))
        if scores and time.monotonic() - begin > seconds:
            break
    if not scores:
        raise InputError(f"views: expected pixels to score, but masks keep none of {len(views)}.")
    distances = [score.lpips for score in scores if score.lpips is not None]
    return PhotographReport(
        psnr=math.fsum(score.psnr for score in scores) / len(scores),
        psnr_min=min(score.psnr for score in scores),
        ssim=math.fsum(score.ssim for score in scores) / len(scores),
        views=tuple(score.name for score in scores),
        per_view=tuple(scores),
        lpips=math.fsum(distances) / len(distances) if distances else None,
    )


def _view_score(
    gaussians: Gaussians,
    view: View,
    *,
    masks: MaskUse,
    lpips: Callable[[torch.Tensor, torch.Tensor], float] | None,
    options: RenderOptions | None,
    backend: str,
) -> ViewScore | None:
    """The scores of a view; None where its mask keeps nothing that could be scored."""
    picture, photograph = picture_and_photograph(
        gaussians, view, masks=masks, options=options, backend=backend
    )
    mask = load_mask(view) if masks == "ignore" else None
    keep = None if mask is None else mask > 0
    if keep is not None:
        border = SSIM_WINDOW // 2
        if not keep[border:-border, border:-border].any():
            return None
        # A network sees whole pictures: where nothing is known, the photograph stands.
        picture = torch.where(keep[..., None], picture, photograph)
    return ViewScore(
        name=view.name,
        psnr=psnr(picture, photograph, keep),
        ssim=ssim(picture, photograph, keep),
        lpips=None if lpips is None else lpips(picture, photograph),
    )


def picture_and_photograph(
    gaussians: Gaussians,
    view: View,
    *,
    masks: MaskUse = "off",
    options: RenderOptions | None = None,
    backend: str = "auto",
) -> tuple[UInt8[Tensor, "height width 3"], UInt8[Tensor, "height width 3"]]:
    """What the Gaussians show in a view, and what the camera saw, both as 8-bit files hold them.

    Arguments and errors are those of `evaluate_photographs`.
    """
    photograph = load_image(view)
    with torch.no_grad():
        drawn = render(gaussians, view.camera, options=options, backend=backend)
    image = drawn.image.cpu().double()
    opaque = load_alpha(view) if masks == "alpha" else None
    if opaque is not None:
        image = image + (1 - drawn.alpha.cpu().double())[..., None]
        photograph = _over_white(photograph, opaque, view)
    return (image.clamp(0, 1) * 255 + 0.5).to(torch.uint8), photograph


def _over_white(photograph: torch.Tensor, opaque: torch.Tensor, view: View) -> torch.Tensor:
    """A photograph cut out by a mask, over white; its own alpha was blended so when it was read."""
    if view.mask is None:
        return photograph
    share = opaque.double()[..., None] / 255
    return (photograph * share + 255 * (1 - share) + 0.5).to(torch.uint8)


def labels_of(selection: Selection) -> Labels:
    """A selection as labels, 1 inside and none outside, to be drawn as a mask."""
    ids = torch.where(selection.mask, 1, UNLABELLED)
    return Labels(ids=ids, confidence=selection.mask.float(), metadata=selection.metadata)


def drawn_like(
    gaussians: Gaussians,
    view: View,
    labels: Labels,
    truth: LabelMap,
    *,
    options: RenderOptions | None = None,
    backend: str = "auto",
) -> LabelMap:
    """A layer drawn in a view, in the pixels of its truth.

    Raises:
        ShapeError: If the truth does not have the photograph's proportions.
    """
    camera = camera_of_map(view, truth.height, truth.width)
    return label_map(gaussians, camera, labels, options=options, backend=backend)


def _mask(ids: LabelMap, id: int | None) -> torch.Tensor:
    return ids.ids != UNLABELLED if id is None else ids.ids == id


def with_truth(views: Sequence[View], truth: LabelSource) -> list[View]:
    """The views that have a truth.

    Raises:
        InputError: If none has.
    """
    known = set(truth.view_names)
    scored = [view for view in views if view.name in known]
    if not scored:
        raise InputError(f"truth: expected the truth of at least one of {len(views)} views.")
    return scored


def learned_from(layer: Labels | Selection, views: Sequence[View]) -> tuple[str, ...]:
    """Names of those views that a layer says it was made from."""
    voters = layer.metadata.get("views")
    known = set(map(str, voters)) if isinstance(voters, (list, tuple)) else set[str]()  # pyright: ignore[reportUnknownArgumentType]
    return tuple(view.name for view in views if view.name in known)
