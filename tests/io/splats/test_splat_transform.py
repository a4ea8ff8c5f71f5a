"""Agreement with a reader and writer nobody here wrote: PlayCanvas's splat-transform.

There, it writes and we read; and back, we write and it reads. Each bound is half a step of the
layout the file passed through, with the reason beside it.
"""

import json
import math
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from splatseg.core import Gaussians, Similarity
from splatseg.io.ply import read_ply_header
from splatseg.io.splats import read_splats, write_splats
from splatseg.io.splats.compressed_ply import CHUNK

Make = Callable[..., Gaussians]
Convert = Callable[..., Path]

COUNT = 3000

SMALLEST_THREE = 3 * 2**0.5 / 1023 / 2
"""Ten bits over sqrt 2, half a step; the fourth component follows from three such errors and
is at least as large as each, so that its own error is at most their sum."""

SIGNED_THREE = 3 * 2**-0.5 / 511 / 2
"""The same with 511 steps for a magnitude of at most 1 / sqrt 2."""

BYTE_THREE = 3 * 2**0.5 / 255
"""The same with 8 bits that are cut, not rounded: a whole step."""

BYTE = 1 / 255 / 2
FLOAT = 2e-6
"""Rounding of logs, exponentials and float32 on the way."""


@pytest.fixture
def scene(make_splats: Make) -> Gaussians:
    """Positions apart from each other by more than any layout's step, harmonics of 40 kinds.

    SOG keeps harmonics as a palette, which is exact only where there are few different ones.
    """
    g = make_splats(COUNT)
    grid = torch.cartesian_prod(*[torch.arange(15.0)] * 3)[:COUNT] * 0.6 - 4
    sh = g.sh.clone()
    sh[:, 1:] = sh[torch.arange(COUNT) % 40, 1:]
    return g.replace(means=grid + g.means * 0.02, sh=sh)


def write_uncompressed(g: Gaussians, folder: Path) -> Path:
    write_splats(g, folder / "ours.ply")
    return folder / "ours.ply"


def matched(got: Gaussians, want: Gaussians) -> Gaussians:
    """The rows of `want` in the order of `got`: by position, a permutation."""
    _, order = cKDTree(want.means.numpy()).query(got.means.numpy())
    assert sorted(order) == list(range(len(want)))
    return want[torch.from_numpy(order)]


def within(got: torch.Tensor, want: torch.Tensor, bound: torch.Tensor | float) -> None:
    """Within the bound everywhere, up to float32 rounding."""
    assert got.shape == want.shape
    error = (got - want).abs() - bound
    assert float(error.max()) <= FLOAT * (1 + float(want.abs().max())), float(error.max())


def turned(got: torch.Tensor, want: torch.Tensor, bound: float) -> None:
    """Quaternions up to their sign."""
    within(got * (got * want).sum(dim=1, keepdim=True).sign(), want, bound)


def half_steps(path: Path, name: str, count: int) -> torch.Tensor:
    """Half a step of packed columns of a compressed PLY, from the chunks in the file."""
    header = read_ply_header(path)
    chunk = header.element("chunk")
    table = np.fromfile(path, chunk.dtype("<"), chunk.count, offset=header.offset)
    axes = ("r", "g", "b") if name == "colour" else [f"{name}{axis}" for axis in "xyz"]
    spans = np.stack([table[f"max_{axis}"] - table[f"min_{axis}"] for axis in axes], axis=1)
    top = [255, 255, 255] if name == "colour" else [2047, 1023, 2047]
    return torch.from_numpy(spans / top / 2)[torch.arange(count) // CHUNK].float()


def compressed_ply_agrees(path: Path, got: Gaussians, want: Gaussians) -> None:
    """`got` was read from `path`, or from what another tool made of it."""
    want = matched(got, want)
    within(got.means, want.means, half_steps(path, "", COUNT))  # 11, 10, 11 bits in a chunk
    within(got.scales.log(), want.scales.log(), half_steps(path, "scale_", COUNT))  # the same
    turned(got.rotations, want.rotations, SMALLEST_THREE)
    within(got.colours, want.colours, half_steps(path, "colour", COUNT))  # a byte in a chunk
    within(got.opacities, want.opacities, BYTE)
    within(got.sh[:, 1:], want.sh[:, 1:], 8 / 256 / 2)  # a byte over [-4, 4], read in the middle


def test_ply_there_and_back(scene: Gaussians, tmp_path: Path, splat_transform: Convert) -> None:
    source = write_uncompressed(scene, tmp_path)
    got = read_splats(splat_transform(source, tmp_path / "theirs.ply"))
    assert torch.equal(got.means, scene.means)
    assert torch.equal(got.sh, scene.sh)
    within(got.scales.log(), scene.scales.log(), 0)
    within(got.opacities, scene.opacities, 0)
    turned(got.rotations, scene.rotations, 0)


def test_their_compressed_ply(scene: Gaussians, tmp_path: Path, splat_transform: Convert) -> None:
    source = write_uncompressed(scene, tmp_path)
    theirs = splat_transform(source, tmp_path / "theirs.compressed.ply")
    compressed_ply_agrees(theirs, read_splats(theirs), scene)


def test_our_compressed_ply(scene: Gaussians, tmp_path: Path, splat_transform: Convert) -> None:
    ours = tmp_path / "ours.compressed.ply"
    write_splats(scene, ours)
    got = read_splats(splat_transform(ours, tmp_path / "theirs.ply"))
    compressed_ply_agrees(ours, got, scene)
    same = read_splats(ours)  # both decode the same bits: equal row by row, not only near
    within(got.means, same.means, 0)
    within(got.scales.log(), same.scales.log(), 0)
    turned(got.rotations, same.rotations, 0)
    within(got.sh, same.sh, 0)


@pytest.mark.parametrize("version", [3, 4])
def test_their_spz(
    scene: Gaussians, tmp_path: Path, splat_transform: Convert, version: int
) -> None:
    source = write_uncompressed(scene, tmp_path)
    theirs = splat_transform(source, tmp_path / "a.spz", "--spz-version", str(version))
    got = read_splats(theirs)
    assert theirs.read_bytes()[:2] == (b"NG" if version == 4 else b"\x1f\x8b")
    within(got.means, scene.means, 2**-13)  # 12 fractional bits
    within(got.scales.log(), scene.scales.log(), 1 / 16 / 2)
    turned(got.rotations, scene.rotations, SIGNED_THREE)
    within(got.opacities, scene.opacities, BYTE)
    within(got.sh[:, 0], scene.sh[:, 0], BYTE / 0.15)
    # They round to a byte of 1/128 and then to 5 bits in degree 1, 4 bits in the others.
    within(got.sh[:, 1:4], scene.sh[:, 1:4], (0.5 + 4) / 128)
    within(got.sh[:, 4:], scene.sh[:, 4:], (0.5 + 8) / 128)


@pytest.mark.parametrize("format", ["spz", "spz3"])
def test_our_spz(scene: Gaussians, tmp_path: Path, splat_transform: Convert, format: str) -> None:
    write_splats(scene, tmp_path / "ours.spz", format=format)  # type: ignore[arg-type]
    got = read_splats(splat_transform(tmp_path / "ours.spz", tmp_path / "theirs.ply"))
    within(got.means, scene.means, 2.0**-21)  # 20 fractional bits are left beside 3 and a sign
    within(got.scales.log(), scene.scales.log(), 1 / 16 / 2)
    turned(got.rotations, scene.rotations, SIGNED_THREE)
    within(got.opacities, scene.opacities, BYTE)
    within(got.sh[:, 0], scene.sh[:, 0], BYTE / 0.15)
    within(got.sh[:, 1:], scene.sh[:, 1:], 1 / 128 / 2)  # all eight bits


def test_our_splat(scene: Gaussians, tmp_path: Path, splat_transform: Convert) -> None:
    g = scene.replace(sh=scene.sh[:, :1])
    write_splats(g, tmp_path / "ours.splat")
    got = read_splats(splat_transform(tmp_path / "ours.splat", tmp_path / "theirs.ply"))
    assert torch.equal(got.means, g.means)
    within(got.scales.log(), g.scales.log(), 0)
    within(got.colours, g.colours, BYTE)
    within(got.opacities, g.opacities, BYTE)
    # A byte is half a step of 1/128 off, 128 means 0 to us and 1/255 to them, and +1 is 255;
    # making the length 1 spreads these errors over the four components, at most doubling them.
    turned(got.rotations, g.rotations, 2 * (0.5 / 128 + 1 / 255))


@pytest.mark.parametrize("bundled", [True, False])
def test_their_sog(
    scene: Gaussians, tmp_path: Path, splat_transform: Convert, bundled: bool
) -> None:
    source = write_uncompressed(scene, tmp_path)
    if bundled:
        theirs = splat_transform(source, tmp_path / "theirs.sog")
        with zipfile.ZipFile(theirs) as archive:
            meta = json.loads(archive.read("meta.json"))
    else:
        (tmp_path / "sog").mkdir()
        theirs = splat_transform(source, tmp_path / "sog" / "meta.json")
        meta = json.loads(theirs.read_bytes())
    got = read_splats(theirs)
    want = matched(got, scene)
    # 16 bits of sign(x) log(1 + |x|), whose slope is 1 / (1 + |x|). They cut, not round, so
    # that the bound is a whole step.
    ends = zip(meta["means"]["mins"], meta["means"]["maxs"], strict=True)
    step = torch.tensor([high - low for low, high in ends]) / 65535
    within(got.means, want.means, 1.01 * step * (1 + want.means.abs()))
    turned(got.rotations, want.rotations, BYTE_THREE)
    within(got.opacities + BYTE, want.opacities, BYTE)  # cut: ours is up to a step too low
    # Codebooks: no other entry would have been nearer.
    nearest(got.scales.log(), want.scales.log(), meta["scales"]["codebook"])
    nearest(got.sh[:, 0], want.sh[:, 0], meta["sh0"]["codebook"])
    # Forty vectors fit into the palette; what is left is the codebook of its numbers.
    nearest(got.sh[:, 1:], want.sh[:, 1:], meta["shN"]["codebook"])
    assert meta["shN"]["count"] >= 40


def nearest(got: torch.Tensor, want: torch.Tensor, codebook: list[float]) -> None:
    """Each value is the entry of the codebook that is nearest to what was wanted."""
    entries = torch.tensor(codebook).sort().values
    at = torch.searchsorted(entries, want.contiguous()).clamp(1, len(entries) - 1)
    best = torch.minimum((entries[at] - want).abs(), (entries[at - 1] - want).abs())
    within(got, want, best + 1e-5)


def test_their_glb(scene: Gaussians, tmp_path: Path, splat_transform: Convert) -> None:
    """glTF is y up: they turn what PLY holds by half a turn about z, harmonics included."""
    source = write_uncompressed(scene, tmp_path)
    got = read_splats(splat_transform(source, tmp_path / "theirs.glb"))
    half_turn = Similarity(
        rotation=torch.diag(torch.tensor([-1.0, -1.0, 1.0], dtype=torch.float64)),
        translation=torch.zeros(3, dtype=torch.float64),
    )
    want = scene.transformed(half_turn)
    within(got.means, want.means, 0)
    within(got.scales.log(), want.scales.log(), 0)
    turned(got.rotations, want.rotations, 0)
    within(got.opacities, want.opacities, 0)
    within(got.sh, want.sh, 1e-5)


def test_biker_is_the_same_to_both(
    shared_data: Path, tmp_path: Path, splat_transform: Convert
) -> None:
    """A real SPZ file of another tool, read by them and by us."""
    path = shared_data / "splats" / "biker.spz"
    theirs, ours = read_splats(splat_transform(path, tmp_path / "a.ply")), read_splats(path)
    assert torch.equal(ours.means, theirs.means)
    within(ours.scales.log(), theirs.scales.log(), 0)
    turned(ours.rotations, theirs.rotations, 0)
    within(ours.opacities, theirs.opacities, 0)
    within(ours.sh, theirs.sh, 0)
    assert math.isclose(float(ours.means[:, 1].min()), -3.18017578125)  # down is positive y


def test_our_sog(scene: Gaussians, tmp_path: Path, splat_transform: Convert) -> None:
    """They decode what we decode, row by row, in the order in which it was written."""
    write_splats(scene, tmp_path / "ours.sog")
    ours = read_splats(tmp_path / "ours.sog")
    got = read_splats(splat_transform(tmp_path / "ours.sog", tmp_path / "theirs.ply"))
    within(got.means, ours.means, 0)
    within(got.scales.log(), ours.scales.log(), 0)
    turned(got.rotations, ours.rotations, 0)
    within(got.opacities, ours.opacities, 0)
    within(got.sh, ours.sh, 0)
