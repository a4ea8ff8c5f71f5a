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

import numpy as np
import torch
from jaxtyping import Int64
from numpy.typing import NDArray
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
    loss = _MaskLoss({}, thing.mask.cpu().float()[:, None], backend)
    shown: list[View] = []
    touched = thing.mask.cpu().clone()
    for view in views:
        if view.image is None:
            continue
        found = masks.label_map(view.name).ids
        mask = torch.isin(found, torch.tensor(tuple(ids), dtype=found.dtype))
        if not bool(mask.any()):
            continue
        shown.append(view)
        loss.masks[view.name] = _Bits.of(mask)
        camera = camera_of_map(view, *mask.shape)
        weights = back_project(gaussians, camera, mask.float()[..., None], backend=backend).sums
        touched |= weights[:, 0].cpu() > _TOUCHED
    if not shown:
        raise InputError("refit: expected a photograph that shows what is removed, got none.")
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
class _Bits:
    """A mask, a bit a pixel: reading or drawing a label map costs more than a step of the fit."""

    shape: tuple[int, int]
    bits: NDArray[np.uint8]

    @staticmethod
    def of(mask: Tensor) -> "_Bits":
        height, width = mask.shape
        return _Bits((height, width), np.packbits(mask.cpu().numpy()))

    def mask(self) -> Tensor:
        flat = np.unpackbits(self.bits, count=self.shape[0] * self.shape[1])
        return torch.from_numpy(flat.reshape(self.shape))


@dataclass(frozen=True, slots=True, eq=False)
class _MaskLoss:
    """The second term of the loss."""

    masks: dict[str, _Bits]
    """Pixels of the thing, of the size of its label map, by the name of the view."""

    signal: Tensor
    """1 for Gaussians of the thing, (n, 1)."""

    backend: str

    def __call__(self, view: View, gaussians: Gaussians, rows: Int64[Tensor, "m"]) -> Tensor:
        mask = self.masks[view.name].mask()
        signal = self.signal[rows.cpu()].to(gaussians.means)
        camera = camera_of_map(view, *mask.shape)
        own = render(gaussians, camera, signal, backend=self.backend).image[..., 0]
        mask = mask.to(own)
        return 1 - (own * mask).sum() / mask.sum()
