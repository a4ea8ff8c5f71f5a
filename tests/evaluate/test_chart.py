"""Charts: lines where the values say, round ticks, and valid SVG."""

import re
import xml.etree.ElementTree as ElementTree

import pytest

from splatseg.report.chart import (
    _BOTTOM,
    _HEIGHT,
    _LEFT,
    _RIGHT,
    _TOP,
    _WIDTH,
    Chart,
    Line,
    chart_svg,
    ticks,
)


def drawn(*lines: Line) -> ElementTree.Element:
    return ElementTree.fromstring(chart_svg(Chart(title='a "b" <c>', across="min", lines=lines)))


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [
        (0, 10, (0, 2, 4, 6, 8, 10)),
        (0, 0.3, (0, 0.1, 0.2, 0.3)),
        (0.05, 0.32, (0.1, 0.2, 0.3)),
        (17.9, 31.2, (20, 25, 30)),
        (30000, 60000, (30000, 40000, 50000, 60000)),
        (3, 3, (3,)),
        (-1, 1, (-1, -0.5, 0, 0.5, 1)),
    ],
)
def test_ticks_are_round(low, high, expected) -> None:
    assert ticks(low, high) == pytest.approx(expected, abs=1e-12)
    assert all(len(f"{tick:g}") <= 5 for tick in ticks(low, high))


def test_points_stand_where_they_should() -> None:
    svg = drawn(Line(name="one", points=((0, 10), (1, 30), (4, 20))))
    line = svg.find("polyline")
    assert line is not None
    points = [tuple(map(float, pair.split(","))) for pair in line.attrib["points"].split()]
    left, right, top, bottom = _LEFT, _WIDTH - _RIGHT, _TOP, _HEIGHT - _BOTTOM
    middle = (top + bottom) / 2
    quarter = left + (right - left) / 4
    expected = [(left, bottom), (quarter, top), (right, middle)]
    for point, wanted in zip(points, expected, strict=True):
        assert point == pytest.approx(wanted, abs=0.06)
    words = [text.text for text in svg.iter("text")]
    assert words == ["10", "15", "20", "25", "30", "0", "1", "2", "3", "4", "min"]
    assert svg.attrib["aria-label"] == 'a "b" <c>: one'


def test_several_lines_share_the_axes() -> None:
    svg = drawn(
        Line(name="one", points=((0, 0), (1, 1))), Line(name="two", points=((0, 4), (2, 4)))
    )
    assert [line.attrib["class"] for line in svg.iter("polyline")] == ["line0", "line1"]
    ends = [line.attrib["points"].split()[-1] for line in svg.iter("polyline")]
    assert ends[1] == f"{_WIDTH - _RIGHT:.1f},{_TOP:.1f}"


def test_one_point_and_flat_lines() -> None:
    svg = drawn(Line(name="one", points=((3, 0),)))
    dot = svg.find("circle")
    assert dot is not None
    assert float(dot.attrib["cy"]) == pytest.approx((_TOP + _HEIGHT - _BOTTOM) / 2, abs=0.06)
    assert "nan" not in chart_svg(
        Chart(title="", across="", lines=(Line(name="", points=((0, 5), (1, 5))),))
    )


def test_long_lines_are_thinned_but_keep_their_end() -> None:
    points = tuple((i, i % 7) for i in range(5005))
    line = drawn(Line(name="", points=points)).find("polyline")
    assert line is not None
    places = line.attrib["points"].split()
    assert 400 <= len(places) <= 420
    assert len(set(places)) == len(places), "the end is there once"
    assert re.fullmatch(rf"{_WIDTH - _RIGHT:.1f},[\d.]+", places[-1])
