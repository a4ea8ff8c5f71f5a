"""Colours that ids have of their own; loads nothing heavy."""

import colorsys

Colour = tuple[int, int, int]
"""Red, green, blue, 0 to 255."""

NOTHING: Colour = (24, 24, 28)
"""Where there is no id, or nothing at all."""


def own_colour(id: int) -> Colour:
    """A colour of an id's own; -1 is nearly black.

    They walk round the hues by the golden ratio, and through brightness by another irrational
    step, so that no two of the first forty look alike.
    """
    if id < 0:
        return NOTHING
    hue = (id * 0.6180339887) % 1.0
    light = 0.40 + 0.38 * ((id * 0.7548776662) % 1.0)
    red, green, blue = colorsys.hls_to_rgb(hue, light, 0.62)
    return round(255 * red), round(255 * green), round(255 * blue)
