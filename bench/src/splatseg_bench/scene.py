"""What a benchmark asks of a scene, and its truth: read from its layout, scored by `evaluate`."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from splatseg._check import check_finite, check_shape
from splatseg.core.boundary import convert_fields
from splatseg.core.evidence import LabelMap
from splatseg.core.layers import Labels
from splatseg.core.scene import Capture, ClassTable
from splatseg.errors import InputError


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrueMask:
    """Where something is in a view. The pixels stay on disk until somebody asks."""

    view: str
    """Name of the view in the capture."""

    read: Callable[[], Bool[Tensor, "height width"]]
    """The mask, in the pixels that the annotation has; they may be fewer than the photograph's."""

    boxes: Float[Tensor, "n 4"] = field(default_factory=lambda: torch.zeros(0, 4))
    """x0, y0, x1, y1 of its pieces in the same pixels, where the annotation has boxes."""

    def __post_init__(self) -> None:
        convert_fields(self)
        check_shape("boxes", self.boxes, (None, 4))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scribble:
    """Strokes of a person in a view: on the thing, and on what it is not."""

    view: str
    read: Callable[[], tuple[Bool[Tensor, "height width"], Bool[Tensor, "height width"]]]
    """Pixels on the thing and pixels off it, which may be fewer than the photograph's."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TargetTask:
    """One thing that is asked for, by what a person would give, and where it truly is."""

    name: str
    """Within the scene, such as ``horns_left`` or ``green apple``."""

    truth: tuple[TrueMask, ...]
    """At most one a view; the views that are scored, before a protocol's own choice of them."""

    words: str | None = None
    """The text that asks for it."""

    scribble: Scribble | None = None
    reference: TrueMask | None = None
    """Its mask in one view, given as the prompt."""

    def __post_init__(self) -> None:
        convert_fields(self)
        views = [one.view for one in self.truth]
        if not views or len(set(views)) != len(views):
            raise InputError(
                f"truth: expected one mask a view and at least one, got {len(views)} masks of "
                f"{len(set(views))} views for {self.name!r}."
            )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrueMaps:
    """Ids of every pixel of views: classes, or instances."""

    read: Mapping[str, Callable[[], LabelMap]]
    """By name of the view; -1 is none."""

    table: ClassTable | None = None
    """Names of the ids, where they are classes; classes of the ids, where they are instances and
    the layout has them."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TruePoints:
    """Labelled points of the surface."""

    points: Float[Tensor, "n 3"]
    """In the world of the capture."""

    labels: Labels
    """One row a point."""

    table: ClassTable | None = None

    visible: Bool[Tensor, "n"] | None = None
    """Which of them the data set says that a photograph shows; None where it does not say."""

    faces: Int[Tensor, "m 3"] | None = None
    """Triangles between the points, where the annotation is that of a mesh."""

    def __post_init__(self) -> None:
        convert_fields(self)
        check_shape("points", self.points, (len(self.labels), 3))
        check_finite("points", self.points)
        if self.visible is not None:
            check_shape("visible", self.visible, (len(self.labels),))
        if self.faces is not None:
            check_shape("faces", self.faces, (None, 3))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BenchmarkScene:
    """One scene of a benchmark: what is fitted, what is asked, what is true."""

    name: str
    """As the benchmark calls it: ``fern``, ``scene0000_00``."""

    layout: str
    """Which layout it was read from: nvos, spin-nerf, lerf-mask, ..."""

    capture: Capture
    """With the benchmark's own split."""

    tasks: tuple[TargetTask, ...] = ()
    semantic: TrueMaps | None = None
    instances: TrueMaps | None = None
    points: TruePoints | None = None

    notes: tuple[str, ...] = ()
    """What a person should know of how it was read, a sentence each."""

    def __post_init__(self) -> None:
        convert_fields(self)
        names = [task.name for task in self.tasks]
        if len(set(names)) != len(names):
            raise InputError(f"tasks: expected distinct names, got {names}.")
        known = {view.name for view in self.capture.views}
        asked = {one.view for task in self.tasks for one in task.truth}
        for task in self.tasks:
            asked |= {one.view for one in (task.scribble, task.reference) if one is not None}
        for maps in (self.semantic, self.instances):
            asked |= set(maps.read) if maps is not None else set()
        if asked - known:
            raise InputError(
                f"scene {self.name!r}: expected truth of its {len(known)} views, got some of "
                f"others ({', '.join(sorted(asked - known)[:3])})."
            )
