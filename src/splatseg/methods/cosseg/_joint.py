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
from dataclasses import dataclass

import torch
from jaxtyping import Int64
from torch import Tensor

from splatseg._check import check_range
from splatseg.core import UNLABELLED, Gaussians, LabelSource, View, camera_of_map
from splatseg.core.boundary import convert_fields
from splatseg.core.threads import one_torch_thread
from splatseg.errors import InputError, RangeError
from splatseg.fit import FitOptions, Refinement
from splatseg.methods._trained_options import check_rate
from splatseg.methods.cosseg._fusion import decode
from splatseg.methods.cosseg._points import PointSet
from splatseg.render import options_for, render

PUBLISHED_RGB_WEIGHT = 0.2
"""On L1, as equation 5 is printed; the usual is 0.8."""
PUBLISHED_LABEL_WEIGHT = 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class JointOptions:
    """How Gaussians and decoder are trained together."""

    joint_steps: int = 2000
    """Steps, each with one whole picture."""

    rgb_weight: float = PUBLISHED_RGB_WEIGHT
    """Lambda_rgb, in [0, 1]: the share of L1 beside D-SSIM. 0.2 as printed, usually 0.8."""

    label_weight: float = PUBLISHED_LABEL_WEIGHT
    """Lambda_s, the weight of labels beside that of photographs, 0 or more."""

    joint_start: float = 0.6
    """Progress, in [0, 1], of a fit whose rates Gaussians begin with."""

    def __post_init__(self) -> None:
        convert_fields(self)
        if self.joint_steps < 1:
            raise RangeError(f"joint_steps: expected at least 1, got {self.joint_steps}.")
        check_range("rgb_weight", self.rgb_weight, 0.0, 1.0)
        check_range("joint_start", self.joint_start, 0.0, 1.0)
        check_rate("label_weight", self.label_weight)


class LabelLoss:
    """The loss of labels of a whole picture; an `ExtraLoss` of `fit`.

    Args:
        points: What is decoded of each Gaussian.
        weights: First weights of decoder and classifier.
        evidence: Label maps; views without one are refused.
        ids: All ids, ascending.
        weight: Lambda_s.
        rate: Adam's rate for the weights.
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
        backend: str,
    ) -> None:
        self._points = points
        self.weights = {name: one.clone().requires_grad_() for name, one in weights.items()}
        self._adam = torch.optim.Adam(list(self.weights.values()), lr=rate)
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
        decoded = decode(self._points.inputs, self.weights, local[there])
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
