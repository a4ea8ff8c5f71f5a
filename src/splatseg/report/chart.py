"""Lines over an axis, as SVG inside a page: no scripts, and colours that follow the page's."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from splatseg.report.words import text

_WIDTH, _HEIGHT = 380, 220
_LEFT, _RIGHT, _TOP, _BOTTOM = 52, 14, 10, 34
_TICKS = 5
_MAX_POINTS = 400


@dataclass(frozen=True, slots=True)
class Line:
    """One line of a chart."""

    name: str
    points: tuple[tuple[float, float], ...]
    """(x, y) from left to right."""


@dataclass(frozen=True, slots=True)
class Chart:
    """Lines over one axis."""

    title: str
    across: str
    """What goes to the right, with its unit."""

    lines: tuple[Line, ...]


def ticks(low: float, high: float, *, count: int = _TICKS) -> tuple[float, ...]:
    """Round numbers within a range, about `count` of them, in steps of 1, 2 or 5.

    Example:
        >>> ticks(0.3, 9.8)
        (2.0, 4.0, 6.0, 8.0)
    """
    span = high - low
    if not span > 0:
        return (low,)
    power = 10.0 ** math.floor(math.log10(span / count))
    step = next(f * power for f in (1, 2, 5, 10) if span / (f * power) <= count)
    # Products of whole numbers, so that 3 steps of 0.1 are 0.3 and not 0.30000000000000004.
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    digits = max(0, -math.floor(math.log10(step)))
    return tuple(round(i * step, digits) for i in range(first, last + 1))


def chart_svg(chart: Chart) -> str:
    """The chart as an ``svg`` element with classes that the page's style colours.

    Without a style, in a program that knows none, it is still lines in the colour of the text.
    """
    xs = [x for line in chart.lines for x, _ in line.points]
    ys = [y for line in chart.lines for _, y in line.points]
    x_low, x_high = _range(xs)
    y_low, y_high = _range(ys)

    def to_pixels(x: float, y: float) -> tuple[float, float]:
        across = (x - x_low) / (x_high - x_low)
        up = (y - y_low) / (y_high - y_low)
        return (
            _LEFT + across * (_WIDTH - _LEFT - _RIGHT),
            _HEIGHT - _BOTTOM - up * (_HEIGHT - _TOP - _BOTTOM),
        )

    parts: list[str] = []
    for value in ticks(y_low, y_high):
        _, y = to_pixels(x_low, value)
        parts.append(
            f'<line class="grid" stroke="currentColor" x1="{_LEFT}" x2="{_WIDTH - _RIGHT}" '
            f'y1="{y:.1f}" y2="{y:.1f}"/>'
        )
        parts.append(
            f'<text x="{_LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{_shown(value)}</text>'
        )
    for value in ticks(x_low, x_high):
        x, _ = to_pixels(value, y_low)
        parts.append(
            f'<text x="{x:.1f}" y="{_HEIGHT - _BOTTOM + 15}" text-anchor="middle">'
            f"{_shown(value)}</text>"
        )
    parts.append(
        f'<text x="{(_LEFT + _WIDTH - _RIGHT) / 2:.0f}" y="{_HEIGHT - 4}" text-anchor="middle">'
        f"{text(chart.across)}</text>"
    )
    for i, line in enumerate(chart.lines):
        spots = [to_pixels(x, y) for x, y in _thinned(line.points)]
        if len(spots) == 1:
            x, y = spots[0]
            parts.append(f'<circle class="dot{i}" cx="{x:.1f}" cy="{y:.1f}" r="3"/>')
        elif spots:
            path = " ".join(f"{x:.1f},{y:.1f}" for x, y in spots)
            parts.append(
                f'<polyline class="line{i}" fill="none" stroke="currentColor" points="{path}"/>'
            )
    named = [line.name for line in chart.lines]
    summary = text(f"{chart.title}: {', '.join(named)}")
    return (
        f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" font-size="11" aria-label="{summary}">'
        f"{''.join(parts)}</svg>"
    )


def _range(values: Sequence[float]) -> tuple[float, float]:
    """From the least to the largest; a lone value gets room on both sides."""
    low, high = min(values), max(values)
    if high - low > 1e-9 * max(abs(low), abs(high), 1e-12):
        return low, high
    room = 0.5 * abs(low) or 0.5
    return low - room, high + room


def _thinned(points: tuple[tuple[float, float], ...]) -> Sequence[tuple[float, float]]:
    """At most about 400 points, the last among them."""
    step = max(1, len(points) // _MAX_POINTS)
    return points if step == 1 else (*points[:-1:step], points[-1])


def _shown(value: float) -> str:
    if abs(value) >= 1e6:
        return f"{value / 1e6:g} M"
    if abs(value) >= 1e4:
        return f"{value / 1e3:g} k"
    return f"{value:g}"
