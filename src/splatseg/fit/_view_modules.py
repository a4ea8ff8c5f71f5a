"""Optional modules of a fit with data per training view: exposure, depth, pose."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg.core import Camera, Gaussians, View
from splatseg.fit._depth import DepthMaps
from splatseg.fit._exposure import Exposure, Exposures
from splatseg.fit._options import FitOptions
from splatseg.fit._poses import Poses
from splatseg.fit._state import StatefulModule


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ViewModules:
    """The optional modules of a fit with data per view; None is one that is switched off."""

    views: tuple[View, ...]
    """The training views."""

    exposures: Exposures | None
    depths: DepthMaps | None
    poses: Poses | None

    @classmethod
    def of(
        cls,
        views: Sequence[View],
        *,
        points: Float[Tensor, "n 3"] | None,
        options: FitOptions,
        where: str,
        exposures: Mapping[str, Exposure] | None = None,
    ) -> "ViewModules":
        """The modules that the options ask for.

        Args:
            views: The training views.
            points: Points on the surfaces, for their distances.
            options: Which modules, and their learning rates.
            where: Prefix of messages.
            exposures: Initial exposures, by name of the view.

        Raises:
            InputError: If depth is asked for and there are no depth maps.
        """
        poses = None
        if options.refine_poses:
            surface_points = torch.zeros(0, 3) if points is None else points
            poses = Poses([view.camera for view in views], points=surface_points, options=options)
        learned = None
        if options.exposure:
            known = exposures or {}
            start = [known.get(view.name, Exposure()) for view in views]
            learned = Exposures(len(views), options=options, start=start)
        depths = None
        if options.depth != "off":
            depths = DepthMaps(views, points=points, options=options, where=where)
        return cls(views=tuple(views), exposures=learned, depths=depths, poses=poses)

    def stateful_modules(self) -> dict[str, StatefulModule]:
        """Modules with state, by name."""
        found: dict[str, StatefulModule] = {}
        if self.exposures is not None:
            found["exposures"] = self.exposures
        if self.poses is not None:
            found["poses"] = self.poses
        return found

    def camera(self, index: int, camera: Camera) -> Camera:
        """A view's camera at its current pose."""
        return camera if self.poses is None else self.poses.camera(index, camera)

    def differentiable_camera(self, index: int, camera: Camera) -> Camera:
        """The same, with a pose that requires a gradient."""
        return camera if self.poses is None else self.poses.leaf(index, camera)

    def view(self, index: int) -> View:
        """A view at its current pose."""
        view = self.views[index]
        return view if self.poses is None else replace(view, camera=self.camera(index, view.camera))

    def update(self, index: int, *, progress: float) -> None:
        """One step along the gradients of the last view."""
        if self.exposures is not None:
            self.exposures.update(index, progress=progress)
        if self.poses is not None:
            self.poses.update(index, progress=progress)

    def in_capture_frame(self, gaussians: Gaussians) -> Gaussians:
        """Gaussians of the fit in the world frame of the capture."""
        return gaussians if self.poses is None else gaussians.transformed(self.poses.aligned()[0])

    def refined(self, views: Sequence[View]) -> tuple[View, ...]:
        """The given views, training views with their refined poses."""
        if self.poses is None:
            return tuple(views)
        moved = {view.name: view for view in self.poses.refined(self.views)}
        return tuple(moved.get(view.name, view) for view in views)

    def learned_exposures(self) -> dict[str, Exposure]:
        """Exposures by name of the view; empty where they are not optimised."""
        if self.exposures is None:
            return {}
        names = (view.name for view in self.views)
        return dict(zip(names, self.exposures.learned(), strict=True))

    def notes(self) -> tuple[str, ...]:
        """Sentences on exposures and poses."""
        found: list[str] = []
        if self.exposures is not None:
            gains = self.exposures.gains.mean(dim=1)
            found.append(
                f"Exposure: gains of {float(gains.min()):.3f} to {float(gains.max()):.3f} "
                f"over {len(gains)} training views."
            )
        if self.poses is not None:
            shift = self.poses.shift()
            found.append(
                f"Poses: {len(self.views)} training views turned by {shift.degrees_mean:.3f} "
                f"degrees (at most {shift.degrees_max:.3f}) and moved by "
                f"{shift.distance_mean:.4g} scene units (at most {shift.distance_max:.4g}) "
                "on average, against those given."
            )
        return tuple(found)
