"""The auto-encoder that comes with the package."""

import subprocess
import sys

import torch

from splatseg.street.shapes import load_shapes
from splatseg.street.shapes.checkpoint import SHIPPED


def test_it_loads_first_of_all_and_is_frozen() -> None:
    """In a fresh process: nothing was made before that it could lean on."""
    words = "from splatseg.street.shapes import load_shapes as f; print(f().vertices.device)"
    done = subprocess.run([sys.executable, "-c", words], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "cpu"
    shapes = load_shapes()
    assert not shapes.training
    assert not any(value.requires_grad for value in shapes.parameters())
    assert shapes.decode(torch.ones(2, 8)).shape == (2, 42, 3)
    assert SHIPPED.stat().st_size <= 1_000_000
