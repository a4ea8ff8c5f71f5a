"""Roads, scans of numbers, and fields of which it is known what they say."""

import math
import weakref
from collections.abc import Callable, Iterator, Sequence
from typing import ClassVar

import torch

from splatseg.core import Camera, LayerInfo, PointLabels, RenderableLayer, RenderableView
from splatseg.core.scans import Scan
from splatseg.street.blocks import DriveBlock


def straight(length: float, step: float = 1.0) -> torch.Tensor:
    """Places along +x."""
    x = torch.arange(0, length + step / 2, step, dtype=torch.float64)
    return torch.stack((x, torch.zeros_like(x), torch.zeros_like(x)), dim=1)


def bend(radius: float = 15.0, straight_part: float = 60.0) -> torch.Tensor:
    """Along +x, a quarter turn to the left, along +y."""
    there = straight(straight_part)
    turn = torch.linspace(0, math.pi / 2, 24, dtype=torch.float64)
    arc = torch.stack((radius * turn.sin(), radius * (1 - turn.cos()), 0 * turn), dim=1)
    end = there[-1] + arc[-1]
    back = torch.stack((there[:, 1], there[:, 0], there[:, 2]), dim=1)
    return torch.cat((there, there[-1] + arc[1:], end + back[1:]))


def crossing(length: float = 200.0) -> torch.Tensor:
    """An eight in the plane: the drive crosses its own line in the middle."""
    t = torch.linspace(0, 2 * math.pi, 400, dtype=torch.float64)
    return length / 4 * torch.stack((t.sin(), (2 * t).sin() / 2, 0 * t), dim=1)


class Says:
    """A field whose points have the label and confidence of a function."""

    live: ClassVar["weakref.WeakSet[Says]"] = weakref.WeakSet()

    def __init__(
        self,
        block: DriveBlock,
        says: Callable[[int, torch.Tensor], tuple[torch.Tensor, torch.Tensor]],
        ids: Sequence[int] = (1, 2, 3),
    ) -> None:
        self.block, self.says, self.ids = block, says, tuple(ids)
        self.live.add(self)

    @property
    def layer_names(self) -> Sequence[str]:
        return ("classes",)

    def layer(self, layer: str) -> RenderableLayer:
        del layer
        return RenderableLayer(ids=self.ids, info=LayerInfo(method="said"))

    def view(self, camera: Camera) -> RenderableView:
        raise KeyError(self.block.index)

    def labels_at(self, points: torch.Tensor, layer: str) -> PointLabels:
        assert layer == "classes"
        ids, confidence = self.says(self.block.index, points)
        return PointLabels(ids=ids.int(), confidence=confidence.float())


class Opener:
    """Opens blocks, counts how often, and how many were in memory at once."""

    def __init__(
        self,
        says: Callable[[int, torch.Tensor], tuple[torch.Tensor, torch.Tensor]],
        kind: type[Says] = Says,
        ids: Callable[[int], Sequence[int]] = lambda block: (1, 2, 3),
    ) -> None:
        self.says, self.kind, self.ids = says, kind, ids
        self.opened: list[int] = []
        self.most = 0

    def __call__(self, block: DriveBlock) -> Says:
        field = self.kind(block, self.says, self.ids(block.index))
        self.opened.append(block.index)
        self.most = max(self.most, len(Says.live))
        return field


def own_number(block: int, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Each block names its own number, and is sure."""
    return torch.full((len(points),), block), torch.ones(len(points))


class NumberedScans:
    """Scans at places, each of points around it; counts how often each is read."""

    def __init__(self, places: torch.Tensor, points: int = 40, spread: float = 12.0) -> None:
        rng = torch.Generator().manual_seed(3)
        self.scans = {}
        for i, place in enumerate(places):
            around = spread * (2 * torch.rand(points, 3, generator=rng, dtype=torch.float64) - 1)
            ids = torch.arange(points, dtype=torch.int32)
            self.scans[f"{i:04d}"] = Scan(
                name=f"{i:04d}", points=place + around, origin=place, labels={"semantic": ids}
            )
        self.reads: list[str] = []

    @property
    def scan_names(self) -> Sequence[str]:
        return tuple(self.scans)

    def scan(self, name: str) -> Scan:
        self.reads.append(name)
        return self.scans[name]

    def __iter__(self) -> Iterator[Scan]:
        return iter(self.scans.values())
