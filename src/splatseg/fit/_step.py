"""One training step on one photograph, shared by `fit` and `refine`."""

import math
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from splatseg import _native
from splatseg._check import check_range, check_shape
from splatseg.core import Camera, Gaussians, View
from splatseg.errors import SplatsegError
from splatseg.fit._density import State
from splatseg.fit._options import FitOptions, background_colour
from splatseg.fit._parameters import (
    Parameters,
    UpdateSettings,
    gathered,
    gradients_of,
    rows_in_view,
    update_rows,
)
from splatseg.fit._photographs import Example, TrainingPhotographs
from splatseg.fit._views import ViewModules
from splatseg.fit.depth import DepthLoss
from splatseg.render import Backend, Rendered, RenderOptions


@runtime_checkable
class ExtraLoss(Protocol):
    """A loss besides that of the photograph of a view."""

    def __call__(self, view: View, gaussians: Gaussians, rows: Int64[Tensor, "m"]) -> Tensor:
        """A scalar to be added to the loss.

        Args:
            view: The view of this step, with its current pose.
            gaussians: Those that may be visible in it, leaves that require a gradient.
            rows: Their rows among all Gaussians.
        """
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class StepSettings:
    """Settings of one step."""

    step: int
    """Steps done before; used in messages."""

    progress: float
    """In [0, 1]: rates and weights decrease with it."""

    render_options: RenderOptions
    """Low-pass filter and degree of the spherical harmonics."""

    screen_gradients: bool = False
    """Whether gradients with respect to the projected centres are computed."""

    extra_loss: ExtraLoss | None = None
    """A further loss."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Loss:
    """The loss of one render."""

    value: float
    """(1 - weight) mean \\|x - y\\| + weight (1 - mean SSIM)."""

    squared_error: float
    """Mean squared difference, from which PSNR is -10 log10."""

    gradient: Float[Tensor, "height width 3"]
    """Derivative of `value` with respect to the render."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StepGradients:
    """Gradients of one view's loss with respect to the Gaussians that may be visible in it."""

    example: Example
    rows: Int64[Tensor, "m"]
    """Rows of these Gaussians among all."""

    gradients: Gaussians
    """Of the loss with respect to the Gaussians of these rows."""

    loss: Loss
    """Of the photograph alone."""

    screen_gradients: Float[Tensor, "m 2"] | None
    """Gradient with respect to the projected centres, per pixel; None unless it was asked for."""


class TrainingStep:
    """Renders a training view, compares it with its photograph, and returns gradients.

    Exposures, depth maps and poses of the views (`ViewModules`) are used where they are given, and
    photographs with an alpha channel are blended over the same background as the render. The
    order of the views left in this epoch is kept here; the Gaussians belong to the caller.

    Args:
        name: ``fit`` or ``refine``; messages begin with it.
        options: Loss and background.
        backend: The renderer.
        photographs: The training photographs.
        views: Exposures, depth maps and poses of the same views.
        generator: Source of the order of the views and of random backgrounds.
    """

    def __init__(
        self,
        *,
        name: str,
        options: FitOptions,
        backend: Backend,
        photographs: TrainingPhotographs,
        views: ViewModules,
        generator: torch.Generator,
    ) -> None:
        self._name = name
        self._options = options
        self._backend = backend
        self._photographs = photographs
        self._views = views
        self._generator = generator
        self.device = torch.device("cuda" if backend.name == "cuda" else "cpu")
        self.order: list[int] = []
        """Indices of the views left in this epoch; the last is the next."""
        self.stages: dict[str, float] = {}
        """Seconds spent in each stage of a step."""

    def next_example(self, reduction: Callable[[Camera], int] = lambda _: 1) -> Example:
        """The next view, in a new random order each epoch.

        Args:
            reduction: Downsampling factor of a camera's photograph.
        """
        with self.timed("read"):
            if not self.order:
                count = len(self._photographs)
                self.order = torch.randperm(count, generator=self._generator).tolist()
            index = self.order.pop()
            camera = self._photographs.camera(index)
            example = self._photographs.example(index, reduction=reduction(camera))
            mask, alpha = example.mask, example.alpha
            return Example(
                index=index,
                camera=self._views.camera(index, example.camera),
                photograph=example.photograph.to(self.device),
                mask=None if mask is None else mask.to(self.device),
                alpha=None if alpha is None else alpha.to(self.device),
            )

    def gradients(
        self, parameters: Parameters, example: Example, *, settings: StepSettings
    ) -> StepGradients:
        """Render the view of an example and back-propagate the loss. Changes no parameters.

        Raises:
            SplatsegError: If the loss is no longer a number.
        """
        options = settings.render_options
        with self.timed("gather"):
            rows = rows_in_view(parameters, example.camera, near=options.near)
            gaussians = gathered(parameters, rows)
            if settings.extra_loss is not None:
                # A further loss renders them with the same filter as here.
                gaussians = gaussians.replace(
                    antialiased=options.antialiased, low_pass=options.low_pass
                )
        with self.timed("render"):
            offsets = None
            if settings.screen_gradients:
                offsets = torch.zeros_like(gaussians.means[:, :2]).requires_grad_()
            camera = self._views.differentiable_camera(example.index, example.camera)
            rendered = self._backend.render(
                gaussians, camera, None, options=options, screen_offsets=offsets
            )
        with self.timed("loss"):
            image, photograph = self._over_background(rendered, example)
            loss = l1_dssim(
                image, photograph, mask=example.mask, dssim_weight=self._options.dssim_weight
            )
            depth = self._depth_loss(rendered, example, progress=settings.progress)
            extra = None
            if settings.extra_loss is not None:
                view = self._views.view(example.index)
                extra = settings.extra_loss(view, gaussians, rows)
        self._check_finite(loss, depth, extra, step=settings.step)
        with self.timed("backward"):
            outputs, gradients = [image], [loss.gradient]
            if depth is not None:
                outputs.append(rendered.depth)
                gradients.append(depth.gradient)
            if extra is not None and extra.requires_grad:
                outputs.append(extra)
                gradients.append(torch.ones_like(extra))
            torch.autograd.backward(outputs, gradients)
        return StepGradients(
            example=example,
            rows=rows,
            gradients=gradients_of(gaussians),
            loss=loss,
            screen_gradients=None if offsets is None else offsets.grad,
        )

    def update(self, state: State, found: StepGradients, *, settings: UpdateSettings) -> None:
        """One step of Adam on the visible rows, in place."""
        update_rows(*state, found.gradients, rows=found.rows, settings=settings)

    @contextmanager
    def timed(self, stage: str) -> Generator[None]:
        """Add the time spent inside to a stage."""
        begin = time.perf_counter()
        try:
            yield
        finally:
            self.stages[stage] = self.stages.get(stage, 0.0) + time.perf_counter() - begin

    def _over_background(self, rendered: Rendered, example: Example) -> tuple[Tensor, Tensor]:
        """Render and photograph for comparison: over the same background, in the same exposure."""
        image, photograph = rendered.image, example.photograph
        if self._views.exposures is not None:
            image = self._views.exposures.applied(example.index, image, rendered.alpha)
        colour = background_colour(self._options.background, generator=self._generator)
        if colour is not None:
            colour = colour.to(image)
            image = image + (1 - rendered.alpha).unsqueeze(-1) * colour
            if example.alpha is not None:
                photograph = photograph + (1 - example.alpha).unsqueeze(-1) * colour
        return image, photograph

    def _depth_loss(
        self, rendered: Rendered, example: Example, *, progress: float
    ) -> DepthLoss | None:
        if self._views.depths is None:
            return None
        return self._views.depths.loss(
            example.index,
            rendered.depth,
            rendered.alpha,
            progress=progress,
            mask=example.mask,
        )

    def _check_finite(
        self, loss: Loss, depth: DepthLoss | None, extra: Tensor | None, *, step: int
    ) -> None:
        value = loss.value
        value += 0.0 if depth is None else depth.value
        value += 0.0 if extra is None else float(extra.detach())
        if not math.isfinite(value):
            raise SplatsegError(
                f"{self._name}: expected a finite loss, got {value} at step {step}; try "
                "lower learning rates."
            )


# Photometric loss: L1 + D-SSIM, with its gradient.


_WINDOW = 11
_SIGMA = 1.5
# Wang et al. 2004, section III.B: K1 = 0.01, K2 = 0.03, values in [0, 1].
_C1 = 0.01**2
_C2 = 0.03**2


def l1_dssim(
    image: Float[Tensor, "height width 3"],
    photograph: Float[Tensor, "height width 3"],
    *,
    mask: Bool[Tensor, "height width"] | None = None,
    dssim_weight: float = 0.2,
) -> Loss:
    """L1 + D-SSIM (Kerbl et al. 2023, eq. 7) and its gradient with respect to `image`.

    SSIM has a Gaussian window of 11 pixels and sigma 1.5. At a border, and where the mask
    is False, both images count as 0.

    Args:
        image: The render, float32.
        photograph: The target, [0, 1].
        mask: Valid pixels, over which means are taken. None is all. If none is valid, the
            loss is 0.
        dssim_weight: Share of D-SSIM, in [0, 1].

    Raises:
        ShapeError: If the shapes differ.
        RangeError: If the weight lies outside [0, 1].
    """
    check_shape("image", image, (None, None, 3))
    check_shape("photograph", photograph, tuple(image.shape))
    if mask is not None:
        check_shape("mask", mask, tuple(image.shape[:2]))
    check_range("dssim_weight", dssim_weight, 0.0, 1.0)
    image = image.detach()
    if image.device.type != "cpu" or image.dtype != torch.float32:
        return l1_dssim_torch(image, photograph, mask=mask, dssim_weight=dssim_weight)
    gradient = torch.empty_like(image, memory_format=torch.contiguous_format)
    value, squared_error = _native.l1_dssim(
        image.contiguous(),
        photograph.contiguous(),
        None if mask is None else mask.to(torch.uint8).contiguous(),
        gradient,
        dssim_weight,
    )
    return Loss(value=value, squared_error=squared_error, gradient=gradient)


def l1_dssim_torch(
    image: Float[Tensor, "height width 3"],
    photograph: Float[Tensor, "height width 3"],
    *,
    mask: Bool[Tensor, "height width"] | None = None,
    dssim_weight: float = 0.2,
) -> Loss:
    r"""The readable reference of `l1_dssim`, by autograd; any device and floating-point type.

    With G the window and :math:`\mu_x = G x`, :math:`\sigma_x^2 = G x^2 - \mu_x^2`,
    :math:`\sigma_{xy} = G xy - \mu_x \mu_y` (Wang et al. 2004, eq. 13),

    .. math:: s = \frac{(2 \mu_x \mu_y + C_1)(2 \sigma_{xy} + C_2)}
                       {(\mu_x^2 + \mu_y^2 + C_1)(\sigma_x^2 + \sigma_y^2 + C_2)}.
    """
    used = torch.ones_like(image[..., 0]) if mask is None else mask.to(image)
    count = 3 * float(used.sum())
    if count == 0:
        return Loss(value=0.0, squared_error=0.0, gradient=torch.zeros_like(image))
    leaf = image.detach().clone().requires_grad_()
    with torch.enable_grad():
        x, y = leaf * used[..., None], photograph * used[..., None]
        mean_x, mean_y = _blur(x), _blur(y)
        variance_x = _blur(x * x) - mean_x**2
        variance_y = _blur(y * y) - mean_y**2
        covariance = _blur(x * y) - mean_x * mean_y
        ssim = ((2 * mean_x * mean_y + _C1) * (2 * covariance + _C2)) / (
            (mean_x**2 + mean_y**2 + _C1) * (variance_x + variance_y + _C2)
        )
        similarity = (ssim * used[..., None]).sum() / count
        difference = (x - y).abs().sum() / count
        value = (1 - dssim_weight) * difference + dssim_weight * (1 - similarity)
        (gradient,) = torch.autograd.grad(value, leaf)
    squared = (x - y).square().sum() / count
    return Loss(
        value=float(value.detach()), squared_error=float(squared.detach()), gradient=gradient
    )


def _blur(image: Tensor) -> Tensor:
    """The Gaussian window over rows and columns, zeros outside."""
    taps = torch.arange(_WINDOW, dtype=torch.float64) - _WINDOW // 2
    window = torch.exp(-0.5 * (taps / _SIGMA) ** 2)
    window = (window / window.sum()).to(image)
    planes = image.movedim(-1, 0)[:, None]
    half = _WINDOW // 2
    planes = torch.nn.functional.conv2d(planes, window.view(1, 1, -1, 1), padding=(half, 0))
    planes = torch.nn.functional.conv2d(planes, window.view(1, 1, 1, -1), padding=(0, half))
    return planes[:, 0].movedim(0, -1)
