"""From a file to a rendering: the same bits with any number of torch's threads."""

from collections.abc import Generator

import numpy as np
import pytest
import torch

from splatseg.core import Camera, Gaussians
from splatseg.io.splats import read_splats, write_splats
from splatseg.io.splats._rows import logits
from splatseg.render import render

COUNT = 80_003
"""More than torch gives to one thread, and no multiple of a vector register."""

THREADS = (1, 2, 3)


@pytest.fixture
def torch_threads() -> Generator[None]:
    """Tests may change the number."""
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.fixture
def delicate(rng: np.random.Generator) -> Gaussians:
    """Opacities whose logits torch turns into others in a vector register than alone."""
    opacities = rng.uniform(0.02, 0.98, 3000).astype(np.float32)
    written = torch.from_numpy(logits(opacities))
    together = torch.sigmoid(written)
    alone = torch.cat([torch.sigmoid(one) for one in written.split(1)])
    differing = opacities[(together != alone).numpy()]
    chosen = np.resize(differing if len(differing) else opacities, COUNT)
    means = rng.uniform(-1, 1, (COUNT, 3)) + np.array([0, 0, 3])
    rotations = rng.normal(size=(COUNT, 4))
    rotations /= np.linalg.norm(rotations, axis=1, keepdims=True)

    def tensor(values: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(values.astype(np.float32))

    return Gaussians(
        means=tensor(means),
        rotations=tensor(rotations),
        scales=tensor(rng.uniform(0.002, 0.01, (COUNT, 3))),
        opacities=tensor(chosen),
        sh=tensor(rng.uniform(-0.9, 0.9, (COUNT, 4, 3))),
    )


@pytest.mark.parametrize("ending", ["ply", "compressed.ply", "splat", "spz"])
def test_from_file_to_rendering(tmp_path, delicate, torch_threads, ending: str) -> None:
    path = tmp_path / f"scene.{ending}"
    # .splat holds no more than one colour.
    written = delicate.replace(sh=delicate.sh[:, :1]) if ending == "splat" else delicate
    write_splats(written, path)
    cameras = [
        Camera(
            width=64, height=48, fx=60.0, fy=60.0, cx=32.0, cy=24.0,
            cam_from_world=torch.eye(4, dtype=torch.float64), **lens,
        )
        for lens in (
            {},
            {"model": "opencv", "distortion": (0.1, -0.02)},
            {"model": "fisheye", "distortion": (0.05, 0.01, 0.0, 0.0)},
        )
    ]  # fmt: skip
    found = []
    for threads in THREADS:
        torch.set_num_threads(threads)
        read = read_splats(path)
        tensors = [read.means, read.rotations, read.scales, read.opacities, read.sh]
        for camera in cameras:
            drawn = render(read, camera, backend="cpu")
            tensors += [drawn.image, drawn.alpha, drawn.depth, drawn.median_depth]
        found.append(tensors)
    for other in found[1:]:
        assert all(torch.equal(a, b) for a, b in zip(found[0], other, strict=True))


def test_a_row_is_the_same_wherever_it_stands(tmp_path, delicate) -> None:
    """Some rows of a scene, written alone, are read as they are read among all."""
    write_splats(delicate, tmp_path / "all.ply")
    write_splats(delicate[5::7], tmp_path / "some.ply")
    every, some = (read_splats(tmp_path / name) for name in ("all.ply", "some.ply"))
    assert torch.equal(every.opacities[5::7], some.opacities)
    assert torch.equal(every.scales[5::7], some.scales)
