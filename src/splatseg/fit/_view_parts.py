"""What a fit learns about single training views besides the scene: exposure, depth, pose."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from splatseg.core import Camera, Capture, Gaussians, View
from splatseg.fit._depth import DepthMaps
from splatseg.fit._exposure import Exposures
from splatseg.fit._options import FitOptions
from splatseg.fit._poses import Poses
from splatseg.fit._state import Part


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ViewParts:
    """The optional parts of a fit that go by view; None is one that is switched off."""

    views: tuple[View, ...]
    """The training views that are learned from."""

    exposures: Exposures | None
    depths: DepthMaps | None
    poses: Poses | None

    @classmethod
    def of(cls, capture: Capture, views: Sequence[View], *, options: FitOptions) -> "ViewParts":
        """Those that the options ask for.

        Raises:
            InputError: If depth is asked for and there are no depth maps.
        """
        poses = None
        if options.refine_poses:
            points = torch.zeros(0, 3) if capture.points is None else capture.points.points
            poses = Poses([view.camera for view in views], points=points, options=options)
        return cls(
            views=tuple(views),
            exposures=Exposures(len(views), options=options) if options.exposure else None,
            depths=None
            if options.depth == "off"
            else DepthMaps(views, capture=capture, options=options),
            poses=poses,
        )

    def parts(self) -> dict[str, Part]:
        """Those that remember something."""
        found: dict[str, Part] = {}
        if self.exposures is not None:
            found["exposures"] = self.exposures
        if self.poses is not None:
            found["poses"] = self.poses
        return found

    def camera(self, index: int, camera: Camera) -> Camera:
        """A view's camera where it is now."""
        return camera if self.poses is None else self.poses.camera(index, camera)

    def camera_to_draw(self, index: int, camera: Camera) -> Camera:
        """The same, with a pose that learns from the gradient."""
        return camera if self.poses is None else self.poses.leaf(index, camera)

    def update(self, index: int, *, progress: float) -> None:
        """Take a step along the gradients of the last view."""
        if self.exposures is not None:
            self.exposures.update(index, progress=progress)
        if self.poses is not None:
            self.poses.update(index, progress=progress)

    def settled(self, gaussians: Gaussians) -> Gaussians:
        """Gaussians of the fit in the world of the capture."""
        return gaussians if self.poses is None else gaussians.transformed(self.poses.aligned()[0])

    def refined(self, capture: Capture) -> tuple[View, ...]:
        """All views of the capture, training views where they are now."""
        if self.poses is None:
            return capture.views
        moved = {view.name: view for view in self.poses.refined(self.views)}
        return tuple(moved.get(view.name, view) for view in capture.views)

    def notes(self) -> tuple[str, ...]:
        """Sentences on what was learned."""
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
