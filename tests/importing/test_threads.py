"""Aligned and placed the same to the last bit, whatever the number of threads."""

import os
import subprocess
import sys

import numpy as np

from splatseg.io.splats import write_splats

from .conftest import gaussians_at

PROGRAM = """
import hashlib, sys
from splatseg.importing import align, place_cameras
from splatseg.io.captures import read_capture
from splatseg.io.splats import read_splats
gaussians = read_splats(sys.argv[1])
found = align(gaussians, read_capture(sys.argv[2]))
print(found.correlation.hex(), found.psnr.hex(), found.correlation_as_is.hex())
placed = place_cameras(gaussians, up=(0.0, -1.0, 0.0), count=2)
digest = hashlib.sha256()
for view in placed.views:
    digest.update(view.camera.cam_from_world.numpy().tobytes())
print(placed.coverage.hex(), placed.kind, digest.hexdigest())
"""


def test_the_same_on_any_number_of_threads(make_capture, tmp_path) -> None:
    """Photographs and Gaussians of more numbers than torch sums in one thread (32 768)."""
    rng = np.random.default_rng(5)
    directions = rng.normal(size=(40_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    means = directions * rng.random((40_000, 1)) ** (1 / 3) * [1, 2, 1] + [5, -3, 2]
    gaussians = gaussians_at(means, rng, 0.03)
    capture = make_capture(gaussians, size=160)
    write_splats(gaussians, tmp_path / "scene.ply")

    def run(threads: int) -> str:
        count = str(threads)
        return subprocess.run(
            [sys.executable, "-c", PROGRAM, tmp_path / "scene.ply", capture.path],
            env=os.environ | {"OMP_NUM_THREADS": count, "SPLATSEG_THREADS": count},
            capture_output=True,
            text=True,
            check=True,
        ).stdout

    first = run(1)
    assert len(first.split()) == 6
    assert run(3) == first
