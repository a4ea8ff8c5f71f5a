"""Votes sharpened into memberships, with views that contradict the others left out."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatseg._check import check_range
from splatseg.core import Gaussians, LabelMap, View, camera_of_map
from splatseg.core.boundary import convert_fields
from splatseg.errors import RangeError
from splatseg.lift.memberships.problem import MembershipProblem
from splatseg.lift.memberships.rows import drawn_pixels, rows_of_pixels
from splatseg.render import RenderOptions

_SHOWN = 0.3
"""Share of a pixel's light from which on it shows an id."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MembershipOptions:
    """How memberships are solved for."""

    pixels: int = 12_000
    """Pixels of each view."""

    border_share: float = 0.67
    """Share of them near borders of labels, in [0, 1]."""

    min_weight: float = 0.01
    """Blending weight in [0, 1] below which a Gaussian is left out of a pixel."""

    min_votes: float = 0.03
    """Least share of a Gaussian's votes, in [0, 1], that makes an id possible for it."""

    rounds: int = 1
    """How often views are held against what all of them say."""

    solver_steps: int = 4
    """Steps of the solver after each time. Few are better where labels err near borders: the
    more, the nearer the solution comes to their errors."""

    min_agreement: float = 0.5
    """Intersection over union, in [0, 1], of an id in a view with what all views say of it there;
    below it the view has no say about it: it missed the thing, or mistook it."""

    def __post_init__(self) -> None:
        convert_fields(self)
        for name in ("pixels", "rounds", "solver_steps"):
            if getattr(self, name) < 1:
                raise RangeError(f"{name}: expected at least 1, got {getattr(self, name)}.")
        for name in ("border_share", "min_weight", "min_votes", "min_agreement"):
            check_range(name, getattr(self, name), 0.0, 1.0)


DEFAULT_MEMBERSHIPS = MembershipOptions()


def fit_memberships(
    gaussians: Gaussians,
    views: Sequence[View],
    label_map: Callable[[View], LabelMap],
    start: Any,
    *,
    options: MembershipOptions | None = None,
    render_options: RenderOptions | None = None,
    backend: str = "auto",
    seed: int = 0,
) -> Any:
    """Memberships of Gaussians in the ids of label maps, see `MembershipProblem`.

    Same seed, same result, whatever the number of threads.

    Args:
        gaussians: The Gaussians of the scene.
        views: Those whose label maps count.
        label_map: Ids of a view, 0 or more, of any size in its proportions; -1 has no say.
        start: scipy rows (Gaussians, ids) of float32: what is known of each Gaussian before, such
            as its votes, in [0, 1]. Ids it does not have there, it cannot get.
        options: How memberships are solved for.
        render_options: Switches of the blending model.
        backend: Name of the rendering backend.
        seed: Of the pixels.

    Returns:
        scipy rows (Gaussians, ids) with the entries of `start`, values in [0, 1].
    """
    options = options or MembershipOptions()
    drawn: list[tuple[Any, NDArray[np.int64]]] = []
    labels: list[NDArray[np.int32]] = []
    for place, view in enumerate(views):
        ids = label_map(view)
        rng = np.random.default_rng((seed, place))
        pixels = drawn_pixels(ids, options.pixels, options.border_share, rng)
        drawn.append((camera_of_map(view, ids.height, ids.width), pixels))
        labels.append(ids.ids.reshape(-1).numpy()[pixels])
    rows = rows_of_pixels(
        gaussians,
        drawn,
        min_weight=options.min_weight,
        render_options=render_options,
        backend=backend,
    )
    problem = MembershipProblem(rows, start, np.concatenate(labels))
    view_of = np.repeat(np.arange(len(views)), [len(pixels) for _, pixels in drawn])
    for _ in range(options.rounds):
        kept = _agreeing(problem, view_of, start.shape[1], options.min_agreement)
        problem.run(kept, options.solver_steps)
    return problem.memberships()


def _agreeing(
    problem: MembershipProblem, view_of: NDArray[np.int64], ids: int, least: float
) -> NDArray[np.bool_]:
    """Pixels whose label, and what they show, are seen alike by their view and by all views.

    Of each id in each view the drawn pixels that have it as their label are held against those
    that show it.
    """
    shown, share = problem.shown()
    shown = np.where(share > _SHOWN * problem.light, shown, -1)
    count = (int(view_of.max(initial=0)) + 1) * ids
    key = view_of * ids + problem.label
    shown_key = view_of * ids + np.maximum(shown, 0)
    both = np.bincount(key[shown == problem.label], minlength=count)
    either = np.bincount(key, minlength=count) - both
    either += np.bincount(shown_key[shown >= 0], minlength=count)
    agrees = both >= least * np.maximum(either, 1)
    return agrees[key] & (agrees[shown_key] | (shown < 0))
