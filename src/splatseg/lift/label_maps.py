r"""From a layer of labels to the label map of a view.

A pixel's id is the one with the largest blending weight:

.. math:: s_c(p) = \sum_i w_{pi}\, a_{ic} + [c = b] \Bigl(1 - \sum_i w_{pi}\Bigr), \qquad
          \mathrm{id}(p) = \arg\max_c s_c(p)

where :math:`a_{ic}` is 1 for the label of Gaussian i and 0 else (a hard layer), or its share of
the evidence (a soft layer). No label, -1, competes as one more id: a hard layer's unlabelled
Gaussians stand for it, a soft layer's missing shares. The transmittance behind all Gaussians
stands for the layer's background label b, and for no label where it has none.
"""

import torch
from jaxtyping import Int64
from torch import Tensor

from splatseg.core import UNLABELLED, Camera, Gaussians, LabelMap, Labels
from splatseg.core.boundary import boundary
from splatseg.errors import ShapeError
from splatseg.render import PreparedView, RenderOptions, SparseSignal, prepare


@boundary
def label_map(
    gaussians: Gaussians,
    camera: Camera,
    labels: Labels,
    *,
    options: RenderOptions | None = None,
    backend: str = "auto",
) -> LabelMap:
    """The label map that a layer has in a view, in the pixels of any camera.

    One pass, whose time and memory do not grow with the number of ids (`PreparedView.argmax`).
    Ties go to the smaller id, and -1 loses every tie. With lens distortion a pixel of the
    photograph takes the id of the pinhole pixel that its centre falls into.

    Args:
        gaussians: The Gaussians of the scene.
        camera: Any camera.
        labels: Their labels, one row a Gaussian; soft where it has candidates.
        options: Switches of the blending model.
        backend: Name of the rendering backend.

    Returns:
        Ids, and as confidence the winner's score, its share of the pixel's weight in [0, 1].

    Raises:
        ShapeError: If `labels` has another number of rows than `gaussians`.
    """
    if len(labels) != len(gaussians):
        raise ShapeError(
            f"labels: expected {len(gaussians)} rows, one a Gaussian, got {len(labels)}."
        )
    with prepare(gaussians, camera, options=options, backend=backend) as view:
        return view_label_map(view, labels)


def view_label_map(view: PreparedView, labels: Labels) -> LabelMap:
    """`label_map` of a view that is prepared, for any number of layers."""
    named = labels.ids if labels.candidates is None else labels.candidates
    ids = torch.unique(torch.cat((torch.unique(named.cpu()), torch.tensor([labels.background]))))
    none = torch.tensor([UNLABELLED])
    ids = torch.cat((ids[ids != UNLABELLED], none)).long()  # behind the ids: it loses ties
    background = int(torch.nonzero(ids == labels.background)[0])
    found = view.argmax(_signal(labels, ids), background=background)
    winner = ids.to(torch.int32)[found.channels.long()]
    return LabelMap(ids=winner, confidence=found.values.clamp(0, 1))


def _signal(labels: Labels, ids: Int64[Tensor, "m"]) -> SparseSignal:
    """The entries of a, with the ids by their index; the last, -1, has what no id claims."""
    if labels.candidates is None or labels.shares is None:
        return SparseSignal(channels=_indices(labels.ids.cpu().unsqueeze(1), ids), count=len(ids))
    candidates, shares = labels.candidates.cpu(), labels.shares.float().cpu()
    known = candidates != UNLABELLED
    unclaimed = (1 - (shares * known).sum(dim=1, keepdim=True)).clamp_min(0)
    none = torch.full((len(labels), 1), len(ids) - 1, dtype=torch.int32)
    named = torch.where(known, _indices(candidates, ids), -1)
    return SparseSignal(
        channels=torch.cat((named, none), dim=1),
        values=torch.cat((shares, unclaimed), dim=1),
        count=len(ids),
    )


def _indices(of: Tensor, ids: Int64[Tensor, "m"]) -> Tensor:
    """Indices into `ids`, which ascend but for the last, -1."""
    found = torch.searchsorted(ids[:-1], of.long().contiguous())
    return torch.where(of == UNLABELLED, len(ids) - 1, found).to(torch.int32)
