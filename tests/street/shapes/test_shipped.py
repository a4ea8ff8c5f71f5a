"""The auto-encoder that comes with the package."""

import subprocess
import sys

import torch

from splatseg.street.shape_files import SHIPPED, load_shapes
from splatseg.synthetic import street, surface_points, varied_room
from support.shape_quality import cut_patches, score_shapes


def test_it_loads_first_of_all_and_is_frozen() -> None:
    """In a fresh process: nothing was made before that it could lean on."""
    words = "from splatseg.street.shape_files import load_shapes as f; print(f().vertices.device)"
    done = subprocess.run([sys.executable, "-c", words], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "cpu"
    shapes = load_shapes()
    assert not shapes.training
    assert not any(value.requires_grad for value in shapes.parameters())
    assert shapes.decode(torch.ones(2, 8)).shape == (2, 42, 3)
    assert SHIPPED.stat().st_size <= 1_000_000


def test_patches_of_other_scenes_keep_their_shape() -> None:
    """What is asked of it, on a room and a street that it was not trained on."""
    clouds = [
        surface_points(scene, 20_000, seed=9).positions
        for scene in (varied_room(300_000), street(300_000, length=30.0))
    ]
    generator = torch.Generator().manual_seed(0)
    patches = torch.cat([
        cut_patches(one, voxel_size=1.0, count=256, min_points=40, generator=generator)
        for one in clouds
    ])  # fmt: skip
    assert len(patches) > 100
    patches = patches[torch.randperm(len(patches), generator=generator)[:100]]
    found = score_shapes(load_shapes(), patches, pairs=60)
    assert found.chamfer_squared < found.sphere_squared / 8
    assert found.chamfer < found.sphere / 4
    assert found.intact_pairs >= 0.95
    assert found.intact_shapes >= 0.95
    assert found.sphere_deviation < 0.06
