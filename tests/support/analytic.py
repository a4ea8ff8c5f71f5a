"""A field that is no Gaussians: a labelled ball over a labelled floor, hit by rays in closed form.

What another package would write: it knows `splatseg.core` and nothing else of splatseg.
"""

import math
from collections.abc import Sequence
from typing import Self

import torch

from splatseg.core import (
    Camera,
    LabelMap,
    LayerInfo,
    PointLabels,
    RenderableLayer,
    ViewSignals,
)
from splatseg.errors import InputError

FLOOR, BALL = 3, 8
BALL_COLOUR, FLOOR_COLOUR = (0.8, 0.4, 0.2), (0.2, 0.2, 0.6)


class BallOverFloor:
    """A ball of radius r around c, and the plane y = h (y points down) up to z = far.

    Args:
        radius: r.
        centre: c.
        floor: h.
        far: Where the floor ends.
        views: Names of views that its layer says it learned from.
    """

    def __init__(
        self,
        *,
        radius: float = 0.5,
        centre: Sequence[float] = (0.0, 0.0, 3.0),
        floor: float = 0.6,
        far: float = 9.0,
        views: Sequence[str] = (),
    ) -> None:
        self.radius, self.floor, self.far = radius, floor, far
        self.centre = torch.tensor(centre, dtype=torch.float64)
        self.views = tuple(views)
        self.opened = 0
        self.open = 0

    @property
    def layer_names(self) -> Sequence[str]:
        return ("things", "marks", "selected")

    def layer(self, layer: str) -> RenderableLayer:
        if layer == "marks":
            return RenderableLayer(kind="features")
        if layer == "selected":
            return RenderableLayer(kind="selection", ids=(1,))
        if layer not in ("things", "things@part"):
            raise InputError(f"layer: expected things, got {layer!r}.")
        return RenderableLayer(
            ids=(FLOOR, BALL),
            info=LayerInfo(
                method="by hand",
                names={FLOOR: "floor", BALL: "ball"},
                views=self.views,
                class_of={FLOOR: 1, BALL: 2},
            ),
        )

    def view(self, camera: Camera) -> "_View":
        self.opened += 1
        return _View(self, camera)

    def labels_at(self, points: torch.Tensor, layer: str) -> PointLabels:
        """The ball's within it, the floor's beneath it."""
        self.layer(layer)
        inside = (points.double() - self.centre).norm(dim=-1) <= self.radius
        below = points[:, 1] >= self.floor
        ids = torch.where(inside, BALL, torch.where(below, FLOOR, -1))
        return PointLabels(ids=ids.int(), confidence=(ids >= 0).float())

    def hits(self, camera: Camera) -> tuple[torch.Tensor, torch.Tensor]:
        """Ids of the first hits (H, W), -1 none, and their z-depths, 0 none."""
        origin, directions = camera.rays(camera.pixel_centres())
        directions = directions.double() / directions.double().norm(dim=-1, keepdim=True)
        origin = origin.double()
        # |o + t d - c|^2 = r^2, and (o + t d)_y = h.
        offset = origin - self.centre
        along = (directions * offset).sum(-1)
        inside = along.square() - offset.square().sum(-1) + self.radius**2
        ball = torch.where(inside >= 0, -along - inside.clamp_min(0).sqrt(), math.inf)
        down = directions[..., 1]
        floor = torch.where(down > 1e-9, (self.floor - origin[..., 1]) / down, math.inf)
        beyond = (origin + floor[..., None] * directions)[..., 2] > self.far
        floor = torch.where(beyond | ~floor.isfinite(), math.inf, floor)
        nearest = torch.minimum(ball, floor)
        hit = nearest.isfinite()
        ids = torch.where(hit, torch.where(ball <= floor, BALL, FLOOR), -1)
        axis = camera.cam_from_world[2, :3].double()
        depth = torch.where(hit, nearest, 0.0) * (directions * axis).sum(-1)
        return ids, torch.where(hit, depth, 0.0)


class _View:
    def __init__(self, field: BallOverFloor, camera: Camera) -> None:
        self._field = field
        self._ids, self._depth = field.hits(camera)

    def __enter__(self) -> Self:
        self._field.open += 1
        assert self._field.open == 1, "one view at a time: memory is bounded by that"
        return self

    def __exit__(self, *_: object) -> None:
        self._field.open -= 1

    def signals(self, *, colour: bool = True) -> ViewSignals:
        alpha = (self._ids >= 0).float()
        image = torch.zeros(*self._ids.shape, 3)
        image[self._ids == BALL] = torch.tensor(BALL_COLOUR)
        image[self._ids == FLOOR] = torch.tensor(FLOOR_COLOUR)
        return ViewSignals(alpha=alpha, depth=self._depth.float(), colour=image if colour else None)

    def features(self, layer: str) -> torch.Tensor:
        return torch.nn.functional.one_hot(self._ids + 1).float()

    def label_map(self, layer: str) -> LabelMap:
        ids = self._ids
        if self._field.layer(layer).kind == "selection":
            ids = torch.where(ids == BALL, 1, -1)
        return LabelMap(ids=ids.int(), confidence=(ids >= 0).float())

    def confidence(self, layer: str) -> torch.Tensor:
        return torch.where(self._ids >= 0, 0.5, -1.0)
