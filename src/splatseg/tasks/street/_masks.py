"""Depth of views without the pixels that their masks leave out: what moves is no surface."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace

from splatseg.core import View
from splatseg.io.images import left_out_pixels
from splatseg.street.depth_views import DepthView


def masked_depths(views: Sequence[View], depths: Iterable[DepthView]) -> Iterator[DepthView]:
    """Depth of views, 0 where their masks are 0.

    Args:
        views: The views.
        depths: Of each of them, in their order.

    Raises:
        ValueError: If there are not as many of one as of the other.
    """
    for view, depth in zip(views, depths, strict=True):
        yield _masked(view, depth)


def masked_depths_of(
    views: Iterable[View], depth_of: Callable[[View], Iterable[DepthView]]
) -> Iterator[DepthView]:
    """The same of a source that has no depth of some views.

    Args:
        views: The views.
        depth_of: Gives the depth of a view, or nothing.
    """
    for view in views:
        for depth in depth_of(view):
            yield _masked(view, depth)


def _masked(view: View, depth: DepthView) -> DepthView:
    """The depth with the pixels of the mask that are nearest to its own."""
    left_out = left_out_pixels(view, *depth.depth.shape)
    return depth if left_out is None else replace(depth, depth=depth.depth.masked_fill(left_out, 0))
