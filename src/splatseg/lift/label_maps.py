r"""From a layer of labels to the label map of a view.

A pixel's id is the one with the largest blending weight:

.. math:: s_c(p) = \sum_i w_{pi}\, a_{ic} + [c = b] \Bigl(1 - \sum_i w_{pi}\Bigr), \qquad
          \mathrm{id}(p) = \arg\max_c s_c(p)

where :math:`a_{ic}` is 1 for the label of Gaussian i and 0 else (a hard layer), or its share of
the evidence (a soft layer). No label, -1, competes as one more id: a hard layer's unlabelled
Gaussians stand for it, a soft layer's missing shares. The transmittance behind all Gaussians
stands for the layer's background label b, and for no label where it has none.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from splatseg.core import UNLABELLED, Camera, Gaussians, LabelMap, Labels
from splatseg.errors import RangeError, ShapeError
from splatseg.render import PreparedView, RenderOptions, prepare
from splatseg.render.warp import undistorted_camera, warp_into_photograph


def label_map(
    gaussians: Gaussians,
    camera: Camera,
    labels: Labels,
    *,
    options: RenderOptions | None = None,
    backend: str = "auto",
    channels: int = 32,
) -> LabelMap:
    """The label map that a layer has in a view, in the pixels of any camera.

    Ids are rendered a few at a time with a running maximum, so that memory does not grow with
    their number; of many ids only those with a Gaussian in this view are rendered. Ties go to the
    smaller id, and -1 loses every tie. With lens distortion a pixel of the photograph takes the
    id of the pinhole pixel that its centre falls into.

    Args:
        gaussians: The Gaussians of the scene.
        camera: Any camera.
        labels: Their labels, one row a Gaussian; soft where it has candidates.
        options: Switches of the blending model.
        backend: Name of the rendering backend.
        channels: Ids rendered at a time, at least 1.

    Returns:
        Ids, and as confidence the winner's score, its share of the pixel's weight in [0, 1].

    Raises:
        ShapeError: If `labels` has another number of rows than `gaussians`.
        RangeError: If `channels` is below 1.
    """
    if len(labels) != len(gaussians):
        raise ShapeError(
            f"labels: expected {len(gaussians)} rows, one a Gaussian, got {len(labels)}."
        )
    if channels < 1:
        raise RangeError(f"channels: expected at least 1, got {channels}.")
    pinhole = undistorted_camera(camera)
    with prepare(gaussians, pinhole, options=options, backend=backend) as view:
        renderer = _ViewRenderer(gaussians, view)
        winner, best = _best_ids(
            renderer, labels, _possible_ids(renderer, labels, channels), channels
        )
    return _warped(camera, winner, best.clamp(0, 1))


def _best_ids(
    renderer: "_ViewRenderer", labels: Labels, ids: Sequence[int], channels: int
) -> tuple[Tensor, Tensor]:
    """The id with the highest score of each pixel, and the score."""
    best = torch.full(renderer.size, -1.0)
    winner = torch.full(renderer.size, UNLABELLED, dtype=torch.int32)
    residual: Tensor | None = None
    for start in range(0, len(ids), channels):
        chunk = ids[start : start + channels]
        scores, alpha = renderer.scores(_signal(labels, chunk))
        if residual is None:
            residual = (1 - alpha).clamp_min(0)
        if labels.background in chunk:
            scores[..., chunk.index(labels.background)] += residual
        score, column = scores.max(dim=-1)
        better = score > best
        best = torch.where(better, score, best)
        winner = torch.where(better, torch.tensor(chunk, dtype=torch.int32)[column], winner)
    return winner, best


class _ViewRenderer:
    """Renders one signal after another in a pinhole view."""

    def __init__(self, gaussians: Gaussians, view: PreparedView) -> None:
        self._means = gaussians.means
        self._view = view
        self.size = (view.camera.height, view.camera.width)

    def scores(self, signal: Float[Tensor, "n ids"]) -> tuple[Tensor, Tensor]:
        """Scores (H, W, ids) and alpha (H, W) of the view."""
        with torch.no_grad():
            rendered = self._view.render(signal.to(self._means))
        return rendered.image.float().cpu(), rendered.alpha.float().cpu()

    def visible(self) -> Bool[Tensor, "n"]:
        """Which Gaussians have any weight in the view."""
        with torch.no_grad():
            seen = self._view.back_project(self._means.new_zeros(*self.size, 1))
        return seen.weights.cpu() > 0


def _possible_ids(renderer: _ViewRenderer, labels: Labels, channels: int) -> list[int]:
    """Ids that can win a pixel, ascending, with -1 behind them so that it loses ties."""
    labels_cpu = labels.ids.cpu() if labels.candidates is None else labels.candidates.cpu()
    present_ids = torch.unique(labels_cpu)
    if len(present_ids) > channels:
        present_ids = torch.unique(labels_cpu[renderer.visible()])
    ids = {int(i) for i in present_ids.tolist()} | {labels.background}
    return [*sorted(ids - {UNLABELLED}), UNLABELLED]


def _signal(labels: Labels, ids: Sequence[int]) -> Float[Tensor, "n ids"]:
    """The columns of a that belong to `ids`."""
    wanted = torch.tensor(ids)
    if labels.candidates is None or labels.shares is None:
        return (labels.ids.cpu().unsqueeze(1) == wanted).float()
    shares = labels.shares.float().cpu()
    candidates: Int[Tensor, "n k"] = labels.candidates.cpu()
    real = candidates != UNLABELLED
    signal = torch.zeros(len(labels), len(ids))
    for rank in range(candidates.shape[1]):
        matches = (candidates[:, rank : rank + 1] == wanted) & real[:, rank : rank + 1]
        signal += shares[:, rank : rank + 1] * matches
    if UNLABELLED in ids:
        claimed = (shares * real).sum(dim=1)
        signal[:, list(ids).index(UNLABELLED)] = (1 - claimed).clamp_min(0)
    return signal


def _warped(camera: Camera, ids: Tensor, confidence: Tensor) -> LabelMap:
    if camera.is_pinhole:
        return LabelMap(ids=ids, confidence=confidence)
    # float64 holds every int32 exactly.
    warp = warp_into_photograph(camera, "nearest")
    both = warp.apply(torch.stack((ids.double(), confidence.double()), dim=-1))
    return LabelMap(ids=both[..., 0].to(torch.int32), confidence=both[..., 1].float())
