"""Arguments that functions of the point network take."""

from pathlib import Path
from typing import Any

import torch


def of_points(folder: Path) -> dict[str, Any]:
    """A small network, points enough for its levels, and files of it."""
    from splatseg.lift.point_network import (
        PointInputs,
        PyramidOptions,
        RandlaConfig,
        RandlaEncoder,
        RandlaNet,
        SpatialOptions,
        load_point_encoder,
        point_pyramid,
        save_point_encoder,
        save_point_network,
    )

    config = RandlaConfig(inputs=3, widths=(4, 6), neighbours=2, ratios=(2, 2))
    encoder, network = RandlaEncoder(config), RandlaNet(config)
    inputs = PointInputs(grid_size=0.1)
    saved, whole = folder / "encoder.safetensors", folder / "network.safetensors"
    save_point_encoder(encoder, saved, inputs=inputs, facts={})
    save_point_network(network, whole, inputs=inputs, facts={})
    loaded = load_point_encoder(saved)
    options = PyramidOptions(neighbours=2, ratios=(2, 2))
    points = torch.rand(16, 3, generator=torch.Generator().manual_seed(0))
    pyramid = point_pyramid(points, options=options, seed=0)
    arguments = {
        "RandlaEncoder": {"config": config},
        "RandlaNet": {"config": config},
        "load_point_encoder": {"path": saved, "inputs": inputs},
        "load_point_network": {"path": whole},
        "save_point_encoder": {"encoder": encoder, "path": saved, "inputs": inputs, "facts": {}},
        "save_point_network": {"network": network, "path": whole, "inputs": inputs, "facts": {}},
        "PointInputs": {"grid_size": 0.1, "origin": "mean", "colour_range": 1.0},
        "RandlaConfig": {"variant": config.variant},
        "point_pyramid": {"positions": points, "options": options, "seed": 0},
        "join_pyramids": {"pyramids": (pyramid,)},
        "average_on_grid": {"positions": points, "colours": points, "side": 0.5},
        "feed_points": {"positions": points, "colours": points, "inputs": inputs},
        "points_origin": {"positions": points, "inputs": inputs},
        "scene_options": {
            "encoder": loaded,
            "positions": points,
            "options": SpatialOptions(),
            "seed": 0,
        },
        "spatial_features": {
            "encoder": loaded,
            "positions": points,
            "colours": points,
            "options": SpatialOptions(),
            "seed": 0,
        },
    }
    return {
        f"lift.point_network.{name}.{parameter}": value
        for name, given in arguments.items()
        for parameter, value in given.items()
    }
