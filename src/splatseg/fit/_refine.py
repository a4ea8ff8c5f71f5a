"""Refinement: existing Gaussians are optimised further, from photographs and from other losses.

None is added, relocated or removed: row i stays row i, so that layers stay aligned.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, cast

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatseg._check import check_range
from splatseg.core import Camera, Gaussians, View
from splatseg.core.boundary import boundary
from splatseg.errors import InputError
from splatseg.fit._options import REFINEMENT_RATES, FitOptions
from splatseg.fit._parameters import (
    Parameters,
    UpdateSettings,
    final_gaussians,
    rates_at,
    raw_parameters,
)
from splatseg.fit._photographs import TrainingPhotographs
from splatseg.fit._start import scene_extent
from splatseg.fit._step import ExtraLoss, StepSettings, TrainingStep
from splatseg.fit._views import Exposure, ViewModules
from splatseg.render import get_backend, options_for, prepare, render
from splatseg.render.warp import undistorted_camera

_DEPTH_PIXELS = 64
"""Longest side of the depth maps that replace start points."""


class Refinement:
    """Optimises Gaussians step by step, with the training step of `fit` (`TrainingStep`).

    Points on the rendered surfaces replace the start points: relative depth maps are aligned to
    them. With `FitOptions.refine_poses` the poses of the views are optimised too, see `views`.

    Args:
        gaussians: The initial Gaussians.
        views: Views with photographs; each is used equally often.
        steps: Number of steps, for the schedule of the learning rates.
        start: Progress, in [0, 1], of a fit whose learning rates the first step has; the last
            step has those of the end of a fit.
        options: Rates, loss, background, masks, exposures, depth and poses of `fit`. Its length,
            density control, penalties and noise are not used.
        exposures: Exposures of a fit (`FitResult.exposures`) by name of the view, the initial
            values of `FitOptions.exposure`. Views without one begin with gain 1 and bias 0;
            None is an empty mapping.
        backend: Name of the renderer.

    Raises:
        InputError: If there are no Gaussians, no view with a photograph, or depth is asked for
            and no view has a depth map.
        RangeError: If `start` is outside [0, 1].
    """

    @boundary
    def __init__(
        self,
        gaussians: Gaussians,
        views: Sequence[View],
        *,
        steps: int,
        start: float,
        options: FitOptions,
        exposures: Mapping[str, Exposure] | None = None,
        backend: str = "auto",
    ) -> None:
        check_range("start", start, 0.0, 1.0)
        if not len(gaussians):
            raise InputError("gaussians: expected at least one, got none.")
        if not views:
            raise InputError("views: expected at least one to learn from, got none.")
        renderer = get_backend(backend)
        self._render_options = options_for(gaussians, renderer.name)
        self._options, self._steps, self._start = options, steps, start
        self._model = gaussians
        self._generator = torch.Generator().manual_seed(options.seed)
        needs_points = options.refine_poses or options.depth == "relative"
        self._views = ViewModules.of(
            views,
            points=_points_of(gaussians, views, backend=renderer.name) if needs_points else None,
            options=options,
            where="refine",
            exposures=exposures,
        )
        self._training = TrainingStep(
            name="refine",
            options=options,
            backend=renderer,
            photographs=TrainingPhotographs.of(views, options=options),
            views=self._views,
            generator=self._generator,
        )
        raw = raw_parameters(gaussians)
        device = self._training.device
        parameters = Parameters(**{name: part.to(device) for name, part in raw.tensors()})
        self._state = (parameters, parameters.zeros_like(), parameters.zeros_like())
        self._extent = scene_extent(tuple(views), raw.means)
        self._steps_done = 0

    @property
    def generator(self) -> torch.Generator:
        """The source of randomness."""
        return self._generator

    @property
    def views(self) -> tuple[View, ...]:
        """The views, with `FitOptions.refine_poses` at their current poses."""
        return self._views.refined(self._views.views)

    @property
    def exposures(self) -> dict[str, Exposure]:
        """Current exposures by name of the view; empty without `FitOptions.exposure`."""
        return self._views.learned_exposures()

    @boundary
    def gaussians(self) -> Gaussians:
        """The current Gaussians, on the CPU, in the rows of the initial ones."""
        now = self._views.in_capture_frame(final_gaussians(self._state[0]))
        return self._model.replace(
            means=now.means,
            rotations=now.rotations,
            scales=now.scales,
            opacities=now.opacities,
            sh=now.sh,
        )

    @boundary
    def step(self, extra_loss: ExtraLoss | None = None) -> None:
        """One step on the photograph of the next view, and on a further loss.

        Raises:
            SplatsegError: If the loss is no longer a number.
        """
        progress = self._start + (1 - self._start) * self._steps_done / max(1, self._steps)
        progress = min(1.0, progress)
        example = self._training.next_example()
        settings = StepSettings(
            step=self._steps_done,
            progress=progress,
            render_options=self._render_options,
            extra_loss=extra_loss,
        )
        found = self._training.gradients(self._state[0], example, settings=settings)
        self._steps_done += 1
        options = self._options
        rates = rates_at(
            progress,
            rates=REFINEMENT_RATES[options.rates],
            options=options,
            extent=self._extent,
        )
        with torch.no_grad():
            update = UpdateSettings(rates=rates, step=self._steps_done)
            self._training.update(self._state, found, settings=update)
            self._views.update(example.index, progress=progress)


def _points_of(gaussians: Gaussians, views: Sequence[View], *, backend: str) -> Tensor:
    """Points on the visible surfaces, as structure from motion would find them.

    Centres of Gaussians are not suitable: many lie inside objects.
    """
    found: list[Tensor] = []
    for view in views:
        camera = undistorted_camera(view.camera)
        longest = max(camera.width, camera.height)
        share = min(1.0, _DEPTH_PIXELS / longest)
        size = (max(1, round(share * camera.width)), max(1, round(share * camera.height)))
        camera = camera.resized(*size)
        with torch.no_grad():
            depth = render(gaussians, camera, backend=backend).median_depth.cpu().double()
        covered = depth > 0
        found.append(camera.unproject(camera.pixel_centres()[covered], depth[covered]))
    return torch.cat(found).float()


@boundary
def refine(
    gaussians: Gaussians,
    views: Sequence[View],
    *,
    steps: int,
    extra_loss: ExtraLoss | None = None,
    start: float = 0.6,
    options: FitOptions = FitOptions(),
    exposures: Mapping[str, Exposure] | None = None,
    backend: str = "auto",
    progress: Callable[[int, int], None] | None = None,
) -> Gaussians:
    """Optimise Gaussians for some steps; see `Refinement`.

    With the same seed the result is the same, whatever the number of threads.
    """
    run = Refinement(
        gaussians,
        views,
        steps=steps,
        start=start,
        options=options,
        exposures=exposures,
        backend=backend,
    )
    for done in range(steps):
        run.step(extra_loss)
        if progress is not None:
            progress(done + 1, steps)
    return run.gaussians()


# What a scene records of its fit, for a later refinement.


EXPOSURES = "exposures"
"""Key of a scene's provenance: gain and bias of each training view by its name."""

_COMPARISON_OPTIONS = (
    "background",
    "longest",
    "masks",
    "exposure",
    "depth",
    "depth_weight",
)
"""Options of the comparison with photographs. Learning rates and the weight of D-SSIM are the
refinement's own; refined poses are in the scene's cameras already."""


@boundary
def refinement_options(provenance: Mapping[str, Any]) -> FitOptions:
    """Options to refine a scene with: photographs are compared as in its fit.

    Poses are not refined further: layers and evidence were made with those of the scene. A scene
    that was not made by a fit is rendered over black, and masks are not used.

    Args:
        provenance: The provenance of the scene.

    Raises:
        InputError: If an option was recorded with an invalid value.
    """
    options = _table(provenance, "options")
    if not options:
        return FitOptions(background="black", masks="off")
    comparison = {"masks": "off"} | {
        name: options[name] for name in _COMPARISON_OPTIONS if name in options
    }
    if isinstance(comparison.get("background"), list):
        comparison["background"] = tuple(cast("list[float]", comparison["background"]))
    try:
        return FitOptions(**cast("dict[str, Any]", comparison))
    except TypeError as error:
        raise InputError(
            f"scene: expected the options of a fit as its provenance, got {comparison!r:.200}."
        ) from error


@boundary
def exposures_record(exposures: Mapping[str, Exposure]) -> dict[str, Any]:
    """Exposures as JSON values, for the key `EXPOSURES`."""
    return {name: asdict(exposure) for name, exposure in exposures.items()}


@boundary
def recorded_exposures(provenance: Mapping[str, Any]) -> dict[str, Exposure]:
    """The exposures of a scene's training views; empty where its fit had none.

    Args:
        provenance: The provenance of the scene.

    Raises:
        InputError: If the record has another form.
    """
    found: dict[str, Exposure] = {}
    for name, value in _table(provenance, EXPOSURES).items():
        try:
            red, green, blue = value["gain"]
            biases = value["bias"]
            found[name] = Exposure(
                gain=(float(red), float(green), float(blue)),
                bias=(float(biases[0]), float(biases[1]), float(biases[2])),
            )
        except (TypeError, KeyError, ValueError, IndexError) as error:
            raise InputError(
                f"scene: expected gain and bias, three numbers each, as the exposure of view "
                f"{name!r}, got {value!r:.80}."
            ) from error
    return found


def _table(provenance: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    value = provenance.get(key)
    return cast("Mapping[str, Any]", value) if isinstance(value, Mapping) else {}


# Pruning of a finished fit: Gaussians that no photograph shows, and floaters.


# Minimum blending weight of a Gaussian, summed over pixels and training views. One fully visible
# pixel of one photograph counts 1.
_MIN_WEIGHT = 1.0
# A floater is visible in at most this many views with at least this weight, and more than half of
# its weight is where its depth is less than this share of the median depth.
_MAX_FLOATER_VIEWS = 2
_MIN_VIEW_WEIGHT = 0.5
_MAX_DEPTH_RATIO = 0.5
# Views are rendered downsampled if all of them together have more pixels: a matter of seconds.
_MAX_PIXELS = 10_000_000


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MaskedView:
    """A view and the mask of its valid pixels."""

    camera: Camera
    """Pinhole."""

    mask: Bool[Tensor, "height width"] | None = None
    """None is all."""


def without_floaters(
    gaussians: Gaussians, photographs: TrainingPhotographs, views: Sequence[View], *, backend: str
) -> Gaussians:
    """The Gaussians that the photographs need; see `needed`.

    Args:
        gaussians: The fitted Gaussians.
        photographs: The photographs that they were fitted to.
        views: Views with the final poses, found by name; there may be others.
        backend: Name of the renderer.
    """
    poses = {view.name: view.camera.cam_from_world for view in views}
    names = [view.name for view in photographs.views]
    reduction = reduction_for([photographs.camera(i) for i in range(len(names))])

    def seen() -> Iterator[MaskedView]:
        for i, name in enumerate(names):
            example = photographs.example(i, reduction=reduction)
            camera = replace(example.camera, cam_from_world=poses[name])
            yield MaskedView(camera=camera, mask=example.mask)

    return gaussians[needed(gaussians, seen(), reduction=reduction, backend=backend)]


def reduction_for(cameras: Sequence[Camera]) -> int:
    """Downsampling factor of the views, so that rendering all takes a few seconds."""
    pixels = sum(camera.width * camera.height for camera in cameras)
    shortest_side = min(min(camera.width, camera.height) for camera in cameras)
    return max(1, min(math.ceil(math.sqrt(pixels / _MAX_PIXELS)), shortest_side))


def needed(
    gaussians: Gaussians,
    views: Iterable[MaskedView],
    *,
    reduction: int = 1,
    backend: str = "auto",
) -> Bool[Tensor, "n"]:
    r"""Which Gaussians the training views need.

    With :math:`w_{vpi}` the blending weight of Gaussian i in pixel p of view v, those are pruned
    whose :math:`\sum_{v,p} w_{vpi}` is less than 1: they are hidden inside or behind surfaces.
    Floaters are pruned too: they are visible in at most two views, and more than half of their
    weight is in pixels whose median depth is more than twice theirs. Thin and long Gaussians are
    kept: they form edges, and renders are much worse without them.

    Args:
        gaussians: The fitted Gaussians.
        views: The training views, with their sides divided by `reduction`.
        reduction: See `reduction_for`. Weights are multiplied by its square.
        backend: Name of the renderer.
    """
    total = torch.zeros(len(gaussians))
    in_front = torch.zeros(len(gaussians))
    view_counts = torch.zeros(len(gaussians), dtype=torch.int32)
    area = reduction * reduction
    for view in views:
        weights, depth_behind = _view_weights(gaussians, view, backend)
        weights = area * weights
        pose = view.camera.cam_from_world
        depth = (gaussians.means.double() @ pose[2, :3] + pose[2, 3]).float()
        total += weights
        view_counts += weights >= _MIN_VIEW_WEIGHT
        in_front += torch.where(depth < _MAX_DEPTH_RATIO * depth_behind, weights, 0.0)
    floating = (view_counts <= _MAX_FLOATER_VIEWS) & (in_front > 0.5 * total)
    return (total >= _MIN_WEIGHT) & ~floating


def _view_weights(
    gaussians: Gaussians, view: MaskedView, backend: str
) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"]]:
    """Weight of each Gaussian in a view, and the weighted mean median depth of its pixels."""
    with torch.no_grad(), prepare(gaussians, view.camera, backend=backend) as prepared:
        depth = prepared.render().median_depth
        used = torch.ones_like(depth) if view.mask is None else view.mask.to(depth)
        # Where nothing opaque is behind, the background counts as the farthest depth.
        behind = torch.where(depth > 0, depth, depth.max())
        image = torch.stack((used, used * behind), dim=-1)
        sums = prepared.back_project(image).sums.cpu()
    return sums[:, 0], sums[:, 1] / sums[:, 0].clamp_min(1e-12)
