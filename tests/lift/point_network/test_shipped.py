"""The encoder that comes with the package."""

from dataclasses import replace

import torch

from splatseg.lift.point_network import (
    RandlaConfig,
    SpatialOptions,
    load_point_encoder,
    spatial_features,
)
from splatseg.lift.point_network.checkpoint import SHIPPED
from splatseg_bench.worlds import SurfaceOptions, street, surface_points


def test_it_is_small_and_says_how_it_was_made():
    assert SHIPPED.stat().st_size < 6_000_000
    encoder = load_point_encoder()
    assert encoder.layout == "splatseg"
    assert encoder.assumed == ()
    assert encoder.colour
    assert encoder.config == RandlaConfig(classes=45)  # the published shape for S3DIS
    assert (encoder.inputs.grid_size, encoder.inputs.origin) == (0.04, "floor")
    assert {"recipe", "score", "seconds"} <= set(encoder.recipe)
    said = "120 generated rooms and 24 generated streets, 5500 steps; not S3DIS"
    assert encoder.trained_on == said
    assert replace(encoder, recipe={}).trained_on == "what the file does not say"


def test_its_features_tell_classes_apart_that_colours_do_not():
    """The nearest mean of a class, in a street that it was not trained on."""
    noise = SurfaceOptions(noise=0.01)
    cloud = surface_points(street(200_000), 9000, options=noise)
    found = spatial_features(
        load_point_encoder(),
        cloud.positions,
        cloud.colours,
        options=SpatialOptions(metres_per_unit=1.0),
        seed=0,
    )
    # Each point has its own features and those of the coarser points nearest to it.
    rows, levels = torch.arange(len(cloud)), [found.levels[0]]
    for level, up in zip(found.levels[1:3], found.pyramid.up[:2], strict=True):
        rows = up[rows]
        levels.append(level[rows])
    right = [share_right(x, cloud.semantic) for x in (torch.cat(levels, 1), cloud.colours)]
    assert right[0] > right[1] + 0.1, right


def share_right(features: torch.Tensor, classes: torch.Tensor) -> float:
    """Of every second point, whose class is that of the nearest mean of the others."""
    x = (features - features.mean(0)) / features.std(0)
    known = classes[::2].unique()
    means = torch.stack([x[::2][classes[::2] == one].mean(0) for one in known])
    return float((known[torch.cdist(x[1::2], means).argmin(1)] == classes[1::2]).float().mean())
