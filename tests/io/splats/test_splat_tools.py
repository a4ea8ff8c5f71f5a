"""Files that other programs wrote of one scene, kept in tests/golden/tools."""

import importlib.metadata
import importlib.util
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from splatseg.core import Gaussians, Similarity
from splatseg.io.splats import read_splats, splat_format, write_splats

ROUNDING = 1e-5
BYTE = 1 / 255 / 2
# Largest errors of means, logs of scales, opacities, colours' coefficients, further ones: half a
# step of the layout, over the 5.4 x 3.1 x 5.4 units, 2 logs and 2.6 coefficients of this scene.
EXACT = (0.0, 0.0, 0.0, 0.0, 0.0)
CHUNKED = (5.4 / 1023 / 2, 2 / 1023 / 2, BYTE, 2.7 / 255 / 2, 8 / 256 / 2)
SPZ = (2**-13, 1 / 32, BYTE, BYTE / 0.15, 8.5 / 128)
# Places go by their logs; scales and colours by codebooks of 256 entries, the widest gap of which
# is a few times the mean one; opacities are cut.
# Colours and harmonics are cut, not rounded; a position has 32767 steps for half of 5 units.
KSPLAT = (0.0, 1e-6, 2 * BYTE, 2 * BYTE / 0.28209479, 0.0)
KSPLAT_HALF = (2.5 / 32767 / 2, 2**-10, 2 * BYTE, 2 * BYTE / 0.28209479, 2**-12)
KSPLAT_BYTE = (*KSPLAT_HALF[:4], 0.8 / 255)
SOG = (4e-4, 5 / 255, 2 * BYTE, 2.7 / 255, 1 / 255)
BOUNDS = {
    "ring.ply": ("ply", EXACT),
    "ring.glb": ("gltf", EXACT),
    "ring.splat": ("splat", (0.0, 0.0, 2 * BYTE, 2 * BYTE / 0.28209479, None)),
    "ring.compressed.ply": ("compressed.ply", CHUNKED),
    "ring.gsplat.compressed.ply": ("compressed.ply", CHUNKED),
    "ring.spz": ("spz", SPZ),
    "ring.v3.spz": ("spz", SPZ),
    "ring.sog": ("sog", SOG),
    "ring.0.ksplat": ("ksplat", KSPLAT),
    "ring.1.ksplat": ("ksplat", KSPLAT_HALF),
    "ring.2.ksplat": ("ksplat", KSPLAT_BYTE),
}
HALF_TURN = Similarity(  # glTF is y up: what PLY holds is turned about z
    rotation=torch.diag(torch.tensor([-1.0, -1.0, 1.0], dtype=torch.float64)),
    translation=torch.zeros(3, dtype=torch.float64),
)


@pytest.fixture
def tools(project_root: Path) -> Path:
    return project_root / "tests" / "golden" / "tools"


@pytest.fixture
def ring(tools: Path) -> Gaussians:
    """What went into the other programs."""
    with np.load(tools / "ring.npz", allow_pickle=False) as file:
        a = {name: torch.from_numpy(file[name]) for name in file.files}
    return Gaussians(
        means=a["means"],
        rotations=a["rotations"],
        scales=a["log_scales"].exp(),
        opacities=a["logits"].sigmoid(),
        sh=torch.cat((a["sh0"], a["shN"]), dim=1),
    )


@pytest.mark.parametrize("name", BOUNDS)
def test_files_of_other_tools(tools: Path, ring: Gaussians, name: str) -> None:
    layout, bounds = BOUNDS[name]
    assert splat_format(tools / name) == layout
    got = read_splats(tools / name)
    want = ring.transformed(HALF_TURN) if layout == "gltf" else ring
    _, order = cKDTree(want.means.numpy()).query(got.means.numpy())
    assert sorted(order) == list(range(len(ring)))
    want = want[torch.from_numpy(order)]
    pairs = [
        (got.means, want.means),
        (got.scales.log(), want.scales.log()),
        (got.opacities, want.opacities),
        (got.sh[:, :1], want.sh[:, :1]),
        (got.sh[:, 1:], want.sh[:, 1:]),
    ]
    for (ours, theirs), bound in zip(pairs, bounds, strict=True):
        if bound is None:  # the layout has no room for them
            assert ours.shape[1] == 0
        else:
            torch.testing.assert_close(ours, theirs, atol=bound + ROUNDING, rtol=0)
    assert float((got.rotations * want.rotations).sum(dim=1).abs().min()) > 1 - 2e-4


@pytest.mark.bits
def test_gsplat_writes_the_same_again(tools: Path, project_root: Path, tmp_path: Path) -> None:
    """The script beside the files is what made them.

    All but a byte in a hundred: torch's exp and sigmoid, which gsplat rounds to bytes, differ by
    the last bit from one processor to the next.
    """
    versions = json.loads((tools / "versions.json").read_text())
    if importlib.metadata.version("gsplat") != versions["gsplat"]:
        pytest.skip(f"the files were made by gsplat {versions['gsplat']}")
    path = project_root / "tests" / "golden" / "make_tools.py"
    spec = importlib.util.spec_from_file_location("make_tools", path)
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    script.write_with_gsplat(tmp_path)
    for name in script.GSPLAT:
        again, kept = (
            np.frombuffer((folder / name).read_bytes(), np.uint8) for folder in (tmp_path, tools)
        )
        assert len(again) == len(kept), name
        assert np.count_nonzero(again != kept) <= len(kept) // 100, name
    with np.load(tools / "ring.npz", allow_pickle=False) as file:
        for name, array in script.ring().items():
            np.testing.assert_array_equal(file[name], array)


def test_their_splat_through_ours(tools: Path, tmp_path: Path) -> None:
    """A .splat file has coarse values, so that only positions need room elsewhere."""
    given = read_splats(tools / "ring.splat")
    write_splats(given, tmp_path / "a.ply")
    write_splats(read_splats(tmp_path / "a.ply"), tmp_path / "a.splat")
    again = read_splats(tmp_path / "a.splat")
    for name in ("means", "sh", "opacities"):
        assert torch.equal(getattr(again, name), getattr(given, name)), name
