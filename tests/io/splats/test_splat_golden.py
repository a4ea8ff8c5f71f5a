"""Every layout holds the same three Gaussians, written by a script that shares no code."""

import json
import shutil
import zipfile
from dataclasses import dataclass
from pathlib import Path

import pytest
import torch
from PIL import Image

from splatseg.io.splats import read_splats, splat_format


@dataclass(frozen=True, kw_only=True)
class Bound:
    """How far each attribute may be from what was meant: the layout's step, half of it."""

    format: str
    mean: float = 1e-6
    log_scale: float = 1e-6
    opacity: float = 1e-6
    rotation: float = 1e-6
    dc: float = 1e-6
    rest: float | None = 1e-6  # None: the layout has no harmonics


_TEN_BITS = 3 * 2**0.5 / 1023 / 2  # the largest component follows from three others
_BYTE_ROTATION = 3 * 2**0.5 / 255 / 2
_SPZ_COLOUR = 0.5 / 255 / 0.15

BOUNDS = {
    "three.ply": Bound(format="ply"),
    "three.compressed.ply": Bound(
        format="compressed.ply",
        mean=10 / 2047 / 2,
        log_scale=9.5 / 1023 / 2,
        rotation=_TEN_BITS,
        dc=2.5 / 255 / 2,
        rest=8 / 256 / 2,
    ),
    "three.splat": Bound(format="splat", rotation=1.5 / 128, dc=0.5 / 255 / 0.282, rest=None),
    "three.ksplat": Bound(
        format="ksplat",
        mean=2e-3,
        log_scale=5e-4,
        rotation=1e-3,
        dc=0.5 / 255 / 0.282,
        rest=2 / 255,
    ),
    "three.v2.spz": Bound(format="spz", rotation=1.5 / 127.5, dc=_SPZ_COLOUR),
    "three.v3.spz": Bound(format="spz", rotation=3 / 1022, dc=_SPZ_COLOUR),
    "three.v4.spz": Bound(format="spz", rotation=3 / 1022, dc=_SPZ_COLOUR),
    "three.v1.sog": Bound(
        format="sog",
        mean=11 * 3.5 / 65535 / 2,
        log_scale=10 / 255 / 2,
        opacity=8 / 255 / 2 / 4,
        rotation=_BYTE_ROTATION,
        dc=3 / 255 / 2,
        rest=2 / 255 / 2,
    ),
    "three.v2.sog": Bound(format="sog", mean=11 * 3.5 / 65535 / 2, rotation=_BYTE_ROTATION),
    "three.glb": Bound(format="gltf"),
    "three.draft.gltf": Bound(format="gltf"),
}


@pytest.fixture(scope="module")
def golden(project_root: Path) -> Path:
    return project_root / "tests" / "golden" / "splats"


@pytest.fixture(scope="module")
def truth(golden: Path) -> dict[str, torch.Tensor]:
    rows = json.loads((golden / "three.json").read_text())
    return {name: torch.tensor([row[name] for row in rows]) for name in rows[0]}


def test_every_golden_file_is_tested(golden: Path) -> None:
    assert {path.name for path in golden.iterdir()} == {*BOUNDS, "three.json"}


@pytest.mark.bits
@pytest.mark.parametrize("name", BOUNDS)
def test_golden_file(golden: Path, truth: dict[str, torch.Tensor], name: str) -> None:
    bound = BOUNDS[name]
    assert splat_format(golden / name) == bound.format
    g = read_splats(golden / name)
    assert len(g) == 3

    def close(got: torch.Tensor, want: torch.Tensor, tolerance: float) -> None:
        torch.testing.assert_close(got, want, rtol=1e-6, atol=tolerance)

    close(g.means, truth["mean"], bound.mean)
    close(g.scales.log(), truth["log_scale"], bound.log_scale)
    close(g.opacities, truth["opacity"], bound.opacity)
    sign = (g.rotations * truth["rotation"]).sum(dim=1, keepdim=True).sign()
    close(g.rotations * sign, truth["rotation"], bound.rotation)
    close(g.rotations.norm(dim=1), torch.ones(3), 1e-6)
    close(g.sh[:, 0], truth["sh"][:, 0], bound.dc)
    if bound.rest is None:
        assert g.sh.shape == (3, 1, 3)
    else:
        close(g.sh[:, 1:], truth["sh"][:, 1:], bound.rest)


def test_extra_columns_of_the_golden_ply(golden: Path) -> None:
    extra = read_splats(golden / "three.ply").extra
    assert list(extra) == ["class_id", "weight"]  # normals are zero and say nothing
    assert extra["class_id"].dtype == torch.uint32
    assert extra["class_id"].tolist() == [7, 4000000000, 0]
    assert extra["weight"].dtype == torch.float32
    assert extra["weight"].tolist() == [0.5, -1.25, 3.0]


@pytest.mark.parametrize("version", ["v1", "v2"])
def test_unbundled_sog_is_the_same(golden: Path, tmp_path: Path, version: str) -> None:
    bundled = read_splats(golden / f"three.{version}.sog")
    with zipfile.ZipFile(golden / f"three.{version}.sog") as archive:
        archive.extractall(tmp_path)
    for path in (tmp_path, tmp_path / "meta.json"):
        assert splat_format(path) == "sog"
        unbundled = read_splats(path)
        assert torch.equal(unbundled.means, bundled.means)
        assert torch.equal(unbundled.sh, bundled.sh)


def test_sog_labels_have_two_bytes(golden: Path, tmp_path: Path) -> None:
    """Entry 256 * 1 + 2 of a palette of five rows, all other entries being another number."""
    with zipfile.ZipFile(golden / "three.v2.sog") as archive:
        archive.extractall(tmp_path)
    book = json.loads((tmp_path / "meta.json").read_bytes())
    book["shN"] |= {"count": 320, "codebook": [0.5, -0.25]}
    (tmp_path / "meta.json").write_text(json.dumps(book))
    centroids = Image.new("RGB", (192, 5), (0, 0, 0))
    centroids.paste((1, 1, 1), (6, 4, 9, 5))  # row 4, columns 3 * 2 to 3 * 2 + 2
    centroids.save(tmp_path / "shN_centroids.webp", lossless=True)
    labels = Image.new("RGB", (3, 1), (2, 1, 0))
    labels.putpixel((0, 0), (2, 0, 0))
    labels.save(tmp_path / "shN_labels.webp", lossless=True)
    rest = read_splats(tmp_path).sh[:, 1:]
    assert rest.unique(dim=1).squeeze().tolist() == [[0.5] * 3, [-0.25] * 3, [-0.25] * 3]


@pytest.mark.parametrize("name", [name for name in BOUNDS if not name.endswith("splat")])
def test_content_comes_before_the_name(golden: Path, tmp_path: Path, name: str) -> None:
    for wrong in ("a.splat", "noname"):
        shutil.copy(golden / name, tmp_path / wrong)
        assert splat_format(tmp_path / wrong) == BOUNDS[name].format
        assert len(read_splats(tmp_path / wrong)) == 3


def test_big_endian_ply(golden: Path, tmp_path: Path) -> None:
    """The same rows, bytes of each number turned around."""
    import numpy as np

    data = (golden / "three.ply").read_bytes()
    end = data.index(b"end_header\n") + 11
    head = data[:end].replace(b"binary_little_endian", b"binary_big_endian")
    numbers = np.frombuffer(data, "<u4", offset=end).astype(">u4")
    (tmp_path / "big.ply").write_bytes(head + numbers.tobytes())
    little, big = read_splats(golden / "three.ply"), read_splats(tmp_path / "big.ply")
    assert torch.equal(little.means, big.means)
    assert torch.equal(little.sh, big.sh)
    assert torch.equal(little.extra["class_id"], big.extra["class_id"])
