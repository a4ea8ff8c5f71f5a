r"""Joint training: the scene's own parameters learn from labels together with the decoder.

As the paper has it, Gaussians are optimised by their photographs and by labels at once,

.. math:: \ell = \lambda_{rgb} \ell_1 + (1 - \lambda_{rgb}) \ell_{D-SSIM} + \lambda_s \ell_s

with :math:`\lambda_{rgb} = 0.2` and :math:`\lambda_s = 0.1`. Printed like this the first weight
stands at :math:`\ell_1`, where Kerbl et al. (2023) have 0.8; ``rgb_weight`` is either. Rows of W
change with every step, so that whole pictures are rendered, one view a step (`fit.Refinement`);
none is added or removed. Features and encodings of space are those of the Gaussians at the start.

References:
    Dou et al., CoSSegGaussians (2024), eq. 4 and 5.
"""

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import torch
from jaxtyping import Int64
from torch import Tensor

from splatseg.core import UNLABELLED, Gaussians, LabelSource, View, camera_of_map
from splatseg.core.threads import one_torch_thread
from splatseg.errors import InputError
from splatseg.fit import FitOptions, Refinement
from splatseg.methods.cosseg._fusion import (
    RUNNING,
    Statistics,
    decode,
    dropped,
    running,
    running_momentum,
)
from splatseg.methods.cosseg._joint_options import JointOptions
from splatseg.methods.cosseg._points import PointSet
from splatseg.render import options_for, render


class LabelLoss:
    """The loss of labels of a whole picture; an `ExtraLoss` of `fit`.

    Args:
        points: What is decoded of each Gaussian.
        weights: First weights of decoder and classifier.
        evidence: Label maps; views without one are refused.
        ids: All ids, ascending.
        weight: Lambda_s.
        rate: Adam's rate for the weights.
        dropout: Share of what is decoded that is dropped before the classifier.
        rng: Draws what is dropped.
        backend: Name of the rendering backend.
    """

    def __init__(
        self,
        points: PointSet,
        weights: Mapping[str, Tensor],
        evidence: LabelSource,
        *,
        ids: Int64[Tensor, "classes"],
        weight: float,
        rate: float,
        dropout: float,
        rng: np.random.Generator,
        backend: str,
    ) -> None:
        self._points = points
        self.weights = {
            name: one.clone().requires_grad_(not name.endswith(RUNNING))
            for name, one in weights.items()
        }
        learnt = [one for one in self.weights.values() if one.requires_grad]
        self._adam = torch.optim.Adam(learnt, lr=rate)
        self._dropout, self._rng = dropout, rng
        self._evidence = evidence
        self._ids = ids
        self._weight = weight
        self._backend = backend
        self.losses: list[float] = []
        """Of each step, not weighted."""

    def __call__(self, view: View, gaussians: Gaussians, rows: Int64[Tensor, "m"]) -> Tensor:
        """Weighted mean cross-entropy of what labelled pixels show, over the log of the ids."""
        label_map = self._evidence.label_map(view.name)
        flat = label_map.ids.cpu().long().reshape(-1)
        labelled = torch.nonzero(flat != UNLABELLED).squeeze(1)
        if not len(labelled):
            self.losses.append(0.0)
            return torch.zeros(())
        local = self._points.rows[rows.cpu()]
        there = torch.nonzero(local >= 0).squeeze(1)
        statistics: Statistics = {}
        decoded = decode(self._points.inputs, self.weights, local[there], statistics=statistics)
        momentum = running_momentum(len(self.losses) + 1)
        self.weights |= running(self.weights, statistics, momentum)
        decoded = dropped(decoded, self._dropout, self._rng)
        signal = decoded.new_zeros(len(rows), decoded.shape[1]).index_copy(0, there, decoded)
        camera = camera_of_map(view, label_map.height, label_map.width)
        image = render(
            gaussians,
            camera,
            signal.to(gaussians.means),
            options=options_for(gaussians, self._backend),
            backend=self._backend,
            warp="nearest",
        ).image
        shown = image.reshape(-1, image.shape[-1])[labelled].cpu()
        logits = shown @ self.weights["classifier.weight"].T + self.weights["classifier.bias"]
        label = torch.searchsorted(self._ids, flat[labelled])
        loss = torch.nn.functional.cross_entropy(logits, label)
        loss = loss / math.log(max(len(self._ids), 2))
        self.losses.append(float(loss.detach()))
        return self._weight * loss

    def update(self) -> None:
        """One step of Adam on decoder and classifier, by the gradients of the last loss."""
        self._adam.step()
        self._adam.zero_grad(set_to_none=True)


def train_jointly(
    gaussians: Gaussians,
    views: Sequence[View],
    loss: LabelLoss,
    *,
    options: JointOptions,
    backend: str,
    seed: int,
    progress: Callable[[int, int], None] | None = None,
) -> Gaussians:
    """Optimise Gaussians by their photographs and a loss of labels, and its weights along.

    Same seed, same result, whatever the number of threads.

    Args:
        gaussians: The Gaussians to begin with; they stay as they are.
        views: Views with photographs and label maps.
        loss: Of the labels; its weights change.
        options: Steps and weights.
        backend: Name of the renderer.
        seed: Of the order of the views.
        progress: Called with the steps done and all there are. An exception from it ends training.

    Returns:
        The Gaussians, row for row.

    Raises:
        InputError: If a view has no photograph.
        SplatsegError: If the loss is no longer a number.
    """
    without = [view.name for view in views if view.image is None]
    if without:
        raise InputError(
            f"views: expected photographs of all of them, {len(without)} of {len(views)} have "
            f"none, the first is {without[0]}."
        )
    run = Refinement(
        gaussians,
        views,
        steps=options.joint_steps,
        start=options.joint_start,
        options=FitOptions(dssim_weight=1 - options.rgb_weight, seed=seed),
        backend=backend,
    )
    for done in range(options.joint_steps):
        run.step(loss)
        with one_torch_thread():
            loss.update()
        if progress is not None:
            progress(done + 1, options.joint_steps)
    return run.gaussians()
