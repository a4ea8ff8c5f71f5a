"""Random scenes for the splat formats, and a reader and writer that nobody here wrote."""

import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from splatseg.core import Gaussians

SPLAT_TRANSFORM = "@playcanvas/splat-transform@2.7.1"


@pytest.fixture
def make_splats(rng: np.random.Generator) -> Callable[..., Gaussians]:
    """Gaussians whose values lie inside what every format can hold."""

    def make(count: int = 600, *, degree: int = 3, extra: bool = False) -> Gaussians:
        def column(low: float, high: float, *shape: int) -> torch.Tensor:
            return torch.from_numpy(rng.uniform(low, high, (count, *shape)).astype(np.float32))

        rotations = torch.from_numpy(rng.normal(size=(count, 4)).astype(np.float32))
        sh = column(-0.9, 0.9, (degree + 1) ** 2, 3)
        columns = {
            "class_id": torch.from_numpy(rng.integers(0, 2**32, count, dtype=np.uint32)),
            "instance": torch.from_numpy(rng.integers(-(2**31), 2**31, count).astype(np.int32)),
            "weight": column(-5, 5),
            "kind": torch.from_numpy(rng.integers(0, 256, count).astype(np.uint8)),
            "chosen": torch.from_numpy(rng.integers(0, 2, count).astype(bool)),
            "long": torch.from_numpy(rng.integers(-9, 9, count)),
            "feature": column(-1, 1, 5),
            "single": column(-1, 1, 1),
        }
        return Gaussians(
            means=column(-4, 6, 3),
            rotations=torch.nn.functional.normalize(rotations, dim=1),
            scales=column(-8, 1, 3).exp(),
            opacities=column(0.02, 0.98),
            sh=sh,
            extra=columns if extra else {},
        )

    return make


@pytest.fixture(scope="session")
def splat_transform(
    tmp_path_factory: pytest.TempPathFactory,
) -> Callable[..., Path]:
    """Convert a file with PlayCanvas's splat-transform: ``convert(source, target, *options)``.

    It comes from the npm registry into a folder of the test session. Where there is no npm the
    tests are skipped; where there is, failing to install it is an error, not a skip.
    """
    npm, node = shutil.which("npm"), shutil.which("node")
    if npm is None or node is None:
        pytest.skip("npm is not installed, so there is no other reader to compare with")
    folder = tmp_path_factory.mktemp("npm")
    install = subprocess.run(
        [npm, "install", "--no-audit", "--no-fund", "--ignore-scripts", SPLAT_TRANSFORM],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    if install.returncode:
        pytest.fail(f"npm could not install {SPLAT_TRANSFORM}:\n{install.stderr}", pytrace=False)
    package = folder / "node_modules" / "@playcanvas" / "splat-transform"

    def convert(source: Path, target: Path, *options: str) -> Path:
        command = [node, str(package / "bin" / "cli.mjs"), "-q", "-w", "-g", "cpu", *options]
        done = subprocess.run(
            [*command, str(source), str(target)],
            capture_output=True,
            text=True,
            timeout=120,
            check=False,
        )
        assert done.returncode == 0, done.stdout + done.stderr
        assert target.is_file(), done.stdout + done.stderr
        return target

    return convert
