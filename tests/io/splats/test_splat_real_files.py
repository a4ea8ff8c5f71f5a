"""Files that other tools wrote, as they are found in the wild."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from splatseg.io.splats import read_splats, splat_format, write_splats


@pytest.fixture(scope="module")
def splats(shared_data: Path) -> Path:
    return shared_data / "splats"


@pytest.mark.parametrize(
    ("name", "format", "count", "degree"),
    [
        ("inria_point_cloud_9080.ply", "ply", 9080, 3),
        ("biker.compressed.ply", "compressed.ply", 152746, 0),
        ("guitar.compressed.ply", "compressed.ply", 90854, 0),
        ("biker.spz", "spz", 152746, 0),
        ("lastchance_14007.splat", "splat", 14007, 0),
        ("sog_playbot_3_0", "sog", 31000, 2),
        ("sog_playbot_6_0/meta.json", "sog", 1873, 2),
        ("sog_playcanvas-logo", "sog", 307128, 0),
    ],
)
def test_real_file(splats: Path, name: str, format: str, count: int, degree: int) -> None:
    assert splat_format(splats / name) == format
    g = read_splats(splats / name)
    assert (len(g), g.sh_degree, dict(g.extra)) == (count, degree, {})
    g.check_values()
    torch.testing.assert_close(g.rotations.norm(dim=1), torch.ones(count), rtol=0, atol=2e-6)
    # A scene is not made of Gaussians larger than itself or colours nobody can see.
    extent = (g.means.quantile(0.95, dim=0) - g.means.quantile(0.05, dim=0)).max()
    assert float(g.scales.median()) < 0.1 * float(extent)
    assert 0.1 < float(g.colours.median()) < 0.8
    assert 0.05 < float(g.opacities.mean()) < 0.95


def test_two_layouts_of_one_scene(splats: Path) -> None:
    """`biker` as compressed PLY and as SPZ: row by row the same within both steps."""
    ply, spz = (read_splats(splats / name) for name in ("biker.compressed.ply", "biker.spz"))
    # SPZ has 12 fractional bits here; it was made from the compressed PLY, so that only its
    # own rounding lies between the two.
    assert float((ply.means - spz.means).abs().max()) <= 2**-13 + 1e-6
    logs = ply.scales.log().clamp(min=-10)  # what SPZ can say starts at -10
    assert float((logs - spz.scales.log()).abs().max()) <= 1 / 32 + 1e-5
    assert torch.equal(ply.opacities, spz.opacities)
    assert float((ply.colours - spz.colours).abs().max()) <= 0.5 / 255 * 0.28209479 / 0.15 + 1e-6
    cosine = (ply.rotations.double() * spz.rotations).sum(dim=1).abs()
    assert float(cosine.min()) > 1 - 2e-6


def test_sog_against_its_own_description(splats: Path) -> None:
    """Values are entries of the codebooks, positions fill the bounds, in both versions."""
    meta = json.loads((splats / "sog_playbot_3_0" / "meta.json").read_bytes())
    g = read_splats(splats / "sog_playbot_3_0")
    book = torch.tensor(meta["scales"]["codebook"])
    assert set(g.scales.log().flatten().mul(1e4).round().long().tolist()) <= set(
        (book.mul(1e4).round().long()[:, None] + torch.arange(-1, 2)).flatten().tolist()
    )
    assert set(g.sh[:, 0].flatten().tolist()) <= set(torch.tensor(meta["sh0"]["codebook"]).tolist())
    assert set(g.sh[:, 1:].flatten().tolist()) <= set(
        torch.tensor(meta["shN"]["codebook"]).tolist()
    )
    for name in ("sog_playbot_3_0", "sog_playcanvas-logo"):
        meta = json.loads((splats / name / "meta.json").read_bytes())
        g = read_splats(splats / name)
        for bounds, ends in (("mins", g.means.amin(0)), ("maxs", g.means.amax(0))):
            logs = np.array(meta["means"][bounds])
            want = np.sign(logs) * np.expm1(np.abs(logs))
            np.testing.assert_allclose(ends, want, atol=1e-4)


def test_real_file_through_every_layout(splats: Path, tmp_path: Path) -> None:
    """The .splat file has coarse values, so that only positions need room elsewhere."""
    g = read_splats(splats / "lastchance_14007.splat")
    write_splats(g, tmp_path / "a.ply")
    ply = read_splats(tmp_path / "a.ply")
    assert torch.equal(ply.means, g.means)
    assert torch.equal(ply.sh, g.sh)
    write_splats(ply, tmp_path / "a.splat")
    again = read_splats(tmp_path / "a.splat")
    assert torch.equal(again.means, g.means)
    assert torch.equal(again.sh, g.sh)
    assert torch.equal(again.opacities, g.opacities)
