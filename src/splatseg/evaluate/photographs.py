"""Renders held against photographs."""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import UInt8
from torch import Tensor

from splatseg.core import Renderable, View
from splatseg.core.boundary import boundary
from splatseg.errors import InputError
from splatseg.evaluate.held_out import Progress
from splatseg.evaluate.metrics import SSIM_WINDOW, psnr, ssim
from splatseg.io.images import image_camera, load_alpha, load_image, load_mask

MaskUse = Literal["off", "ignore", "alpha"]
"""What the masks of views mean, as in a fit."""


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


@boundary
def evaluate_photographs(
    field: Renderable,
    views: Sequence[View],
    *,
    masks: MaskUse = "off",
    lpips: Callable[[torch.Tensor, torch.Tensor], float] | None = None,
    longest: int | None = None,
    seconds: float = math.inf,
    progress: Progress | None = None,
) -> PhotographReport:
    """Score the pictures against the photographs, as 8-bit files of both would score.

    Args:
        field: What is rendered.
        views: Views with photographs.
        masks: What masks mean. ``ignore``: only pixels that a view's mask keeps are scored, for a
            fit that ignored the others knows nothing of them; a view of which nothing is kept is
            left out. ``alpha``: what the mask, or the alpha channel of the photograph, cuts out is
            scored, photograph and picture over white, as is the custom for such scenes. ``off``,
            and a view without a mask: every pixel.
        lpips: A network with weights (`splatseg.evaluate.lpips.load_lpips`); None leaves that
            score out.
        longest: Longest side in pixels to which larger photographs are reduced, and drawn in;
            None keeps every pixel.
        seconds: After so long no further view is begun; at least one is scored.
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
        score = _view_score(field, view, masks=masks, lpips=lpips, longest=longest)
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
    field: Renderable,
    view: View,
    *,
    masks: MaskUse,
    lpips: Callable[[torch.Tensor, torch.Tensor], float] | None,
    longest: int | None,
) -> ViewScore | None:
    """The scores of a view; None where its mask keeps nothing that could be scored."""
    rendered, photograph = render_and_photograph(field, view, masks=masks, longest=longest)
    mask = load_mask(view, longest=longest) if masks == "ignore" else None
    keep = None if mask is None else mask > 0
    if keep is not None:
        border = SSIM_WINDOW // 2
        if not keep[border:-border, border:-border].any():
            return None
        # A network sees whole pictures: where nothing is known, the photograph stands.
        rendered = torch.where(keep[..., None], rendered, photograph)
    return ViewScore(
        name=view.name,
        psnr=psnr(rendered, photograph, keep),
        ssim=ssim(rendered, photograph, keep),
        lpips=None if lpips is None else lpips(rendered, photograph),
    )


@boundary
def render_and_photograph(
    field: Renderable,
    view: View,
    *,
    masks: MaskUse = "off",
    longest: int | None = None,
) -> tuple[UInt8[Tensor, "height width 3"], UInt8[Tensor, "height width 3"]]:
    """What a field shows in a view, and what the camera saw, both as 8-bit files hold them.

    Arguments and errors are those of `evaluate_photographs`.
    """
    photograph = load_image(view, longest=longest)
    with field.view(image_camera(view, longest)) as looked_at:
        shown = looked_at.signals()
    if shown.colour is None:
        raise InputError("field: expected colours of a view, got none.")
    image = shown.colour.double()
    opaque = load_alpha(view, longest=longest) if masks == "alpha" else None
    if opaque is not None:
        image = image + (1 - shown.alpha.double())[..., None]
        photograph = _over_white(photograph, opaque, view)
    return (image.clamp(0, 1) * 255 + 0.5).to(torch.uint8), photograph


def _over_white(photograph: torch.Tensor, opaque: torch.Tensor, view: View) -> torch.Tensor:
    """A photograph cut out by a mask, over white; its own alpha was blended so when it was read."""
    if view.mask is None:
        return photograph
    share = opaque.double()[..., None] / 255
    return (photograph * share + 255 * (1 - share) + 0.5).to(torch.uint8)
