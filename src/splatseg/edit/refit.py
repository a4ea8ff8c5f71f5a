r"""A short fit before a removal, so that light of a thing's pixels comes from the thing alone.

A fit on photographs leaves a few per cent of it on other Gaussians: some straddle the outline,
some lie before the thing, and things let a little of what is behind them through. With m the
thing's mask of a view and T the Gaussians of the thing,

.. math:: L = L_{\mathrm{photo}} + 1 - \sum_p m_p \sum_{i \in T} w_{pi} \Big/ \sum_p m_p .

It is the loss of `sharpen` for one thing, and one-sided: a thing that covers a little more than
its mask does no harm when it is removed, while what stays is compared with the photographs.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Int64
from torch import Tensor

from splatseg.core import Gaussians, LabelSource, Selection, View, camera_of_map
from splatseg.core.boundary import boundary
from splatseg.errors import InputError
from splatseg.fit import Refinement, recorded_exposures, refinement_options
from splatseg.render import back_project, render

_RATES_FROM = 0.6
"""Progress of a fit whose learning rates the first step has, as for `sharpen`."""

_TOUCHED = 0.05
"""Blending weight in the masks, in pixels, above which a Gaussian is refitted."""


@boundary
def refit(
    gaussians: Gaussians,
    thing: Selection,
    views: Sequence[View],
    masks: LabelSource,
    ids: Sequence[int],
    *,
    steps: int,
    provenance: Mapping[str, Any],
    backend: str = "auto",
    progress: Callable[[int, int], None] | None = None,
) -> Gaussians:
    """Fit a thing and what is in its pixels further, until it is opaque and by itself.

    Number and order stay. Gaussians with no weight in the masks stay as they are to the last bit.

    Args:
        gaussians: The Gaussians of the scene.
        thing: Those of the thing.
        views: Views with photographs and label maps; those that do not show the thing are left
            out.
        masks: The label maps.
        ids: Ids of the thing in them.
        steps: Steps, each from one photograph.
        provenance: Of the scene: photographs are compared as in its fit.
        backend: Rendering backend.
        progress: Called with the steps done and all there are to do.

    Raises:
        InputError: If no view with a photograph shows the thing.
    """
    loss = _MaskLoss(masks, tuple(ids), thing.mask.cpu().float()[:, None], backend)
    shown = [view for view in views if view.image is not None and bool(loss.mask(view).any())]
    if not shown:
        raise InputError("refit: expected a photograph that shows what is removed, got none.")
    touched = thing.mask.cpu().clone()
    for view in shown:
        mask = loss.mask(view)
        camera = camera_of_map(view, *mask.shape)
        weights = back_project(gaussians, camera, mask.float()[..., None], backend=backend).sums
        touched |= weights[:, 0].cpu() > _TOUCHED
    options = replace(refinement_options(provenance), depth="off", refine_poses=False)
    run = Refinement(
        gaussians,
        sorted(shown, key=lambda view: view.name),
        steps=steps,
        start=_RATES_FROM,
        options=options,
        exposures=recorded_exposures(provenance),
        backend=backend,
    )
    for done in range(steps):
        run.step(loss)
        if progress is not None:
            progress(done + 1, steps)
    now = run.gaussians()
    rows = torch.nonzero(touched)[:, 0]
    columns = ("means", "rotations", "scales", "opacities", "sh")
    return gaussians.replace(
        **{n: getattr(gaussians, n).index_copy(0, rows, getattr(now, n)[rows]) for n in columns}
    )


@dataclass(frozen=True, slots=True, eq=False)
class _MaskLoss:
    """The second term of the loss."""

    masks: LabelSource
    ids: tuple[int, ...]
    signal: Tensor
    """1 for Gaussians of the thing, (n, 1)."""

    backend: str

    def mask(self, view: View) -> Tensor:
        """Pixels of the thing, of the size of its label map."""
        found = self.masks.label_map(view.name).ids
        return torch.isin(found, torch.tensor(self.ids, dtype=found.dtype))

    def __call__(self, view: View, gaussians: Gaussians, rows: Int64[Tensor, "m"]) -> Tensor:
        mask = self.mask(view)
        signal = self.signal[rows.cpu()].to(gaussians.means)
        camera = camera_of_map(view, *mask.shape)
        own = render(gaussians, camera, signal, backend=self.backend).image[..., 0]
        return 1 - (own * mask.to(own)).sum() / mask.sum().clamp_min(1)
