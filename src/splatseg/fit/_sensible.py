"""How many steps make sense for a capture."""

from splatseg.core.boundary import boundary

_LEAST = 1000
_A_VIEW = 20


@boundary
def sensible_steps(train_views: int) -> int:
    """Steps below which a fit of so many training views is too short to be judged.

    Twenty a view, and at least 1000: until then growth and resolution have hardly begun, and a
    fit of twice the length is better by decibels (decision 0025).

    Example:
        >>> sensible_steps(48), sensible_steps(300)
        (1000, 6000)
    """
    return max(_LEAST, _A_VIEW * train_views)
