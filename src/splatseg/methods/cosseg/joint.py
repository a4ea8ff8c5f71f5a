r"""Joint training: the scene's own parameters learn from labels together with the decoder.

As the paper has it, Gaussians are optimised by their photographs and by labels at once,

.. math:: \ell = \lambda_{rgb} \ell_1 + (1 - \lambda_{rgb}) \ell_{D-SSIM} + \lambda_s \ell_s

with :math:`\lambda_{rgb} = 0.2` and :math:`\lambda_s = 0.1`. Printed like this the first weight
stands at :math:`\ell_1`, where Kerbl et al. (2023) have 0.8; the two make no difference (decision
0035). Rows of W change with every step, so that whole pictures are rendered, one view a step
(`fit.Refinement`); none is added or removed. Features and encodings of space are those of the
Gaussians at the start.

References:
    Dou et al., CoSSegGaussians (2024), eq. 4 and 5.
"""

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import torch
from jaxtyping import Int64
from torch import Tensor

from splatseg.core import (
    UNLABELLED,
    ClassTable,
    Features,
    Gaussians,
    LabelSource,
    View,
    camera_of_map,
)
from splatseg.core.boundary import boundary
from splatseg.errors import InputError
from splatseg.fit import FitOptions, Refinement
from splatseg.lift.training import TrainingResult
from splatseg.methods._trained import TrainingContext, label_data
from splatseg.methods.cosseg.decoder import (
    DROPPED,
    RUNNING,
    START,
    Statistics,
    decode,
    dropped,
    first_weights,
    running,
    running_momentum,
)
from splatseg.methods.cosseg.features import BlockSource, pixel_counts
from splatseg.methods.cosseg.options import PUBLISHED_STEPS, CossegOptions
from splatseg.methods.cosseg.points import PointSet
from splatseg.methods.cosseg.train import decoded_layer, decoded_together, prepare
from splatseg.render import options_for, render

RGB_WEIGHT = 0.2
"""On L1, as equation 5 is printed."""
LABEL_WEIGHT = 0.1
PROGRESS = 0.6
"""Progress of a fit whose rates Gaussians begin with."""


class LabelLoss:
    """The loss of labels of a whole picture; an `ExtraLoss` of `fit`.

    Args:
        points: What is decoded of each Gaussian.
        weights: First weights of decoder and classifier.
        evidence: Label maps; views without one are refused.
        ids: All ids, ascending.
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
        return LABEL_WEIGHT * loss

    def update(self) -> None:
        """One step of Adam on decoder and classifier, by the gradients of the last loss."""
        self._adam.step()
        self._adam.zero_grad(set_to_none=True)


def train_jointly(
    gaussians: Gaussians,
    views: Sequence[View],
    loss: LabelLoss,
    *,
    steps: int,
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
        steps: How many.
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
        steps=steps,
        start=PROGRESS,
        options=FitOptions(dssim_weight=1 - RGB_WEIGHT, seed=seed),
        backend=backend,
    )
    for done in range(steps):
        run.step(loss)
        loss.update()
        if progress is not None:
            progress(done + 1, steps)
    return run.gaussians()


@boundary
def train_cosseg_jointly(
    gaussians: Gaussians,
    views: Sequence[View],
    evidence: LabelSource,
    *,
    features: BlockSource | None = None,
    options: CossegOptions | None = None,
    classes: ClassTable | None = None,
    metres_per_unit: float | None = None,
    up: tuple[float, float, float] | None = None,
    context: TrainingContext | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[Gaussians, Features]:
    """Train the decoder of `train_cosseg` with the Gaussians themselves, see `_joint`.

    What is decoded is rendered and then classified, as published, in whole pictures; nothing is
    kept to resume from. Same seed, same result, whatever the number of threads.

    Args:
        gaussians: The Gaussians to begin with; they stay as they are.
        views: Those to learn from, with photographs.
        evidence: Their label maps.
        features: Several blocks of a network for the same views. None decodes space alone.
        options: What is decoded from, and how both learn together.
        classes: Names of the ids, for the info.
        metres_per_unit: Of the scene; None takes it to be as dense as what the point network was
            trained on.
        up: Direction away from the ground; None takes it to be z.
        context: Seed and backend.
        progress: Called with the steps done and all there are.

    Returns:
        The Gaussians, row for row, and what is decoded of each.

    Raises:
        InputError: If there are no views, one has no photograph, label map or features, no pixel
            has a label, or there are too few Gaussians for the point network.
        ShapeError: If maps or features do not have their photograph's proportions.
        SplatsegError: If the loss is no longer a number.
    """
    options, context = options or CossegOptions(), context or TrainingContext()
    data = label_data(gaussians, views, evidence, options=options, context=context)
    prepared = prepare(
        gaussians,
        data,
        features,
        options=options,
        context=context,
        metres_per_unit=metres_per_unit,
        up=up,
    )
    rng = np.random.default_rng((context.seed, START))
    loss = LabelLoss(
        prepared.everything,
        first_weights(prepared.shape, len(data.ids), rng),
        evidence,
        ids=data.ids,
        rate=options.rate,
        dropout=options.dropout,
        rng=np.random.default_rng((context.seed, DROPPED)),
        backend=context.backend,
    )
    learnt = train_jointly(
        gaussians,
        data.views,
        loss,
        steps=options.joint_steps,
        backend=context.backend,
        seed=context.seed,
        progress=progress,
    )
    shown = pixel_counts(learnt, data.views, backend=context.backend)
    result = TrainingResult(
        rows={},
        shared={name: one.detach() for name, one in loss.weights.items()},
        visibility=shown.to(torch.float32),
        losses=loss.losses,
        scores=(),
        best_step=len(loss.losses),
        stopped="steps",
    )
    steps = len(loss.losses)
    layer = decoded_layer(
        prepared,
        decoded_together(prepared.everything, result.shared),
        data,
        result,
        blend="features",
        classes=classes,
        seed=context.seed,
        trained=f"{steps} of {PUBLISHED_STEPS} published steps of a whole picture, jointly",
    )
    return learnt, layer
