"""From pairs that were read to one world, by either way."""

from collections.abc import Callable

from splatseg.pose.pointmaps._align import Aligned, align, initial
from splatseg.pose.pointmaps._averaging import average
from splatseg.pose.pointmaps._focal import lens_focals
from splatseg.pose.pointmaps._geometry import pair_geometry
from splatseg.pose.pointmaps._gradient import align_by_gradients
from splatseg.pose.pointmaps._options import PointmapOptions
from splatseg.pose.pointmaps._refine import refine
from splatseg.pose.pointmaps._samples import PairSamples
from splatseg.pose.pointmaps._start import agreement, confidence_score, spanning_tree, tree_world

_ROBUST_ITERATIONS = 60
_PUBLISHED_ITERATIONS = 300


def solve(
    samples: PairSamples, *, options: PointmapOptions, progress: Callable[[int, int], None]
) -> Aligned:
    """Cameras, depths and pairs in one world."""
    focal = lens_focals(samples)
    geometry = pair_geometry(samples, focal)
    published = options.alignment == "published"
    score = confidence_score(samples) if published else agreement(samples, geometry)
    world = tree_world(samples, geometry, spanning_tree(samples, score))
    if published:
        start = initial(samples, geometry, world, focal)
        return align_by_gradients(
            samples,
            start,
            iterations=options.iterations or _PUBLISHED_ITERATIONS,
            progress=progress,
        )
    start = initial(samples, geometry, average(samples, geometry, world), focal)
    stages = 2 if options.refine else 1

    def percent(stage: int) -> Callable[[int, int], None]:
        return lambda done, total: progress(100 * stage + 100 * done // total, 100 * stages)

    aligned = align(
        samples,
        start,
        iterations=options.iterations or _ROBUST_ITERATIONS,
        block=options.block,
        progress=percent(0),
    )
    if not options.refine:
        return aligned
    return refine(samples, aligned, progress=percent(1))
