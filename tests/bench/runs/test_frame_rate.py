"""The rate of label maps, with a clock that stands still but for the drawing."""

from collections.abc import Iterator
from contextlib import contextmanager

import pytest
import torch

from splatseg.core import Camera, LabelMap, RenderableView, View
from splatseg.errors import InputError, RangeError
from splatseg_bench.measures import frames_per_second, timed_label_maps

CAMERA = Camera(
    width=8, height=6, fx=8, fy=8, cx=4, cy=3, cam_from_world=torch.eye(4, dtype=torch.float64)
)


class Slow:
    """A field whose first map takes a minute and each other as long as it is told."""

    def __init__(self, seconds: dict[int, float]) -> None:
        self.now = 0.0
        self.sizes: list[tuple[int, int]] = []
        self._seconds = seconds

    def clock(self) -> float:
        return self.now

    @contextmanager
    def view(self, camera: Camera) -> Iterator[RenderableView]:
        self.now += 60 if not self.sizes else self._seconds[len(self.sizes)]
        self.sizes.append((camera.width, camera.height))
        yield Shown(camera)


class Shown:
    def __init__(self, camera: Camera) -> None:
        self._shape = (camera.height, camera.width)

    def label_map(self, layer: str) -> LabelMap:
        return LabelMap(ids=torch.ones(self._shape, dtype=torch.int32))


class Truth:
    view_names = ("a", "b", "c")

    def __init__(self, field: Slow) -> None:
        self._field = field

    def label_map(self, name: str) -> LabelMap:
        self._field.now += 1000  # reading files is not drawing
        return LabelMap(ids=torch.zeros(3, 4, dtype=torch.int32))


def test_the_first_view_is_drawn_once_before_it_is_timed() -> None:
    field = Slow({1: 0.25, 2: 2.0, 3: 0.5})
    views = [View(name=name, camera=CAMERA) for name in "abc"]
    told: list[tuple[int, int]] = []
    found = list(
        timed_label_maps(
            field, views, "things", Truth(field), clock=field.clock,
            progress=lambda done, count: told.append((done, count)),
        )
    )  # fmt: skip
    assert [one.seconds for one in found] == [0.25, 2.0, 0.5]
    assert field.sizes == [(4, 3)] * 4, "in the pixels of the truth"
    assert [one.view.name for one in found] == ["a", "b", "c"]
    assert told == [(1, 3), (2, 3), (3, 3)]
    assert frames_per_second([one.seconds for one in found]) == 2.0


@pytest.mark.parametrize(
    ("seconds", "rate"), [([0.5], 2), ([0.1, 0.2, 9], 5), ([0.1, 0.3], 5), ([4, 1, 2, 2], 0.5)]
)
def test_the_rate_is_that_of_the_median_view(seconds, rate) -> None:
    assert frames_per_second(seconds) == pytest.approx(rate)


@pytest.mark.parametrize("seconds", [[0.0], [1.0, -1.0], [float("nan")], [float("inf")]])
def test_times_that_cannot_be(seconds) -> None:
    with pytest.raises(RangeError, match="seconds: expected times above 0, got"):
        frames_per_second(seconds)


def test_no_view_has_no_rate() -> None:
    with pytest.raises(InputError, match="seconds: expected those of at least one view, got none"):
        frames_per_second([])
