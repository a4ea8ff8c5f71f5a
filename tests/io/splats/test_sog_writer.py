"""SOG as we write it: what comes back, how near it is, and that the same gives the same bytes."""

import json
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from splatseg.core import Gaussians
from splatseg.errors import InputError
from splatseg.io.splats import SplatWarning, read_splats, splat_format, write_splats
from splatseg.io.splats._quantisation import scalar_codebook, vector_palette

Make = Callable[..., Gaussians]

BYTE = 1 / 255 / 2
BYTE_THREE = 3 * 2**0.5 / 255 / 2
"""Half a step of a byte over sqrt 2; the largest component follows from three of them."""


def written(g: Gaussians, folder: Path) -> tuple[Gaussians, dict]:
    """Write and read; a warning is an error here."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        write_splats(g, folder / "a.sog")
        back = read_splats(folder / "a.sog")
    with zipfile.ZipFile(folder / "a.sog") as archive:
        return back, json.loads(archive.read("meta.json"))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("count", [1, 5, 700])
def test_there_and_back(make_splats: Make, tmp_path: Path, count: int, degree: int) -> None:
    """Rows keep their order; each attribute is within half a step of its own layout."""
    g = make_splats(count, degree=degree)
    back, meta = written(g, tmp_path)
    assert splat_format(tmp_path / "a.sog") == "sog"
    assert back.sh.shape == g.sh.shape
    span = torch.tensor(meta["means"]["maxs"]) - torch.tensor(meta["means"]["mins"])
    steps = span / 65535 / 2 * (1 + g.means.abs())
    assert bool(((back.means - g.means).abs() <= 1.01 * steps + 1e-6).all())
    alike = (back.rotations * g.rotations).sum(dim=1, keepdim=True).sign()
    assert float((back.rotations * alike - g.rotations).abs().max()) <= BYTE_THREE
    assert float((back.opacities - g.opacities).abs().max()) <= BYTE + 1e-6
    nearest(back.scales.log(), g.scales.log(), meta["scales"]["codebook"])
    nearest(back.sh[:, 0], g.sh[:, 0], meta["sh0"]["codebook"])
    if degree:  # as many entries as rows: only the codebook rounds
        assert meta["shN"]["bands"] == degree
        assert meta["shN"]["count"] == count
        nearest(back.sh[:, 1:], g.sh[:, 1:], meta["shN"]["codebook"])


def nearest(got: torch.Tensor, want: torch.Tensor, codebook: list[float]) -> None:
    """No other entry of the codebook would have been nearer, and they are spread well."""
    entries = torch.tensor(codebook)
    assert len(entries) == 256
    best = (want.reshape(-1, 1) - entries).abs().min(dim=1).values.reshape(want.shape)
    assert float(((got - want).abs() - best).max()) <= 1e-5
    spread = float(want.max() - want.min())
    assert float(best.max()) <= 2 * spread / 256 + 1e-6


def test_ends_of_the_ranges(make_splats: Make, tmp_path: Path) -> None:
    """Opacity 0 hides no colour; scale 0 stays 0; all in one place is a scene."""
    g = make_splats(4, degree=0)
    g = g.replace(
        opacities=torch.tensor([0.0, 1.0, 0.5, 0.0]),
        scales=torch.tensor([[0.0, 1.0, 2.0]]).expand(4, 3),
        means=torch.full((4, 3), -2.5),
    )
    back, _ = written(g, tmp_path)
    assert back.opacities[[0, 1, 3]].tolist() == [0, 1, 0]
    torch.testing.assert_close(back.scales, g.scales)
    torch.testing.assert_close(back.means, g.means)
    torch.testing.assert_close(back.sh, g.sh)


def test_few_kinds_of_harmonics_are_kept(make_splats: Make, tmp_path: Path) -> None:
    """2500 Gaussians of 40 kinds: the palette has 40 entries and each finds its own."""
    g = make_splats(2500, degree=2)
    sh = g.sh.clone()
    sh[:, 1:] = sh[torch.arange(2500) % 40, 1:]
    back, meta = written(g.replace(sh=sh), tmp_path)
    assert meta["shN"]["count"] == 40
    nearest(back.sh[:, 1:], sh[:, 1:], meta["shN"]["codebook"])


def test_the_same_gives_the_same_bytes(make_splats: Make, tmp_path: Path) -> None:
    g = make_splats(300, degree=1)
    for name in ("a.sog", "b.sog"):
        write_splats(g, tmp_path / name)
    assert (tmp_path / "a.sog").read_bytes() == (tmp_path / "b.sog").read_bytes()


def test_antialiased_is_kept_and_columns_are_missed(make_splats: Make, tmp_path: Path) -> None:
    g = make_splats(3, degree=0, extra=True).replace(antialiased=True)
    with pytest.warns(SplatWarning, match="a SOG file has no place for the extra columns"):
        write_splats(g, tmp_path / "a.sog")
    assert read_splats(tmp_path / "a.sog").antialiased
    with pytest.raises(InputError, match="cannot hold a scene without Gaussians"):
        write_splats(g[:0], tmp_path / "b.sog")
    assert not (tmp_path / "b.sog").exists()


def test_a_codebook_is_near_the_best_there_is(rng: np.random.Generator) -> None:
    """256 entries of a normal distribution: at most the asymptotic least error."""
    values = rng.normal(size=20_000).astype(np.float32)
    book, index = scalar_codebook(values)
    error = float(np.square(book[index] - values).mean())
    # Panter and Dite: sqrt(3) pi / 2 sigma^2 / N^2.
    assert error < 3**0.5 * np.pi / 2 / 256**2
    assert bool((np.diff(book) > 0).all())


def test_a_palette_is_nearer_than_a_sample(rng: np.random.Generator) -> None:
    """Of clustered vectors: much nearer than as many of the vectors themselves."""
    centres = rng.normal(size=(300, 9))
    vectors = centres[rng.integers(0, 300, 4000)] + rng.normal(0, 0.05, (4000, 9))
    vectors = vectors.astype(np.float32)
    palette, index = vector_palette(vectors, 512)
    assert len(palette) <= 512
    assert index.min() >= 0
    error = np.square(palette[index] - vectors).sum(axis=1).mean()
    sample = vectors[rng.choice(4000, 512, replace=False)]
    distances = (
        np.square(vectors).sum(1)[:, None] - 2 * vectors @ sample.T + np.square(sample).sum(1)
    )
    assert error < 0.6 * distances.min(axis=1).mean()
    # Each entry is the mean of what it stands for, up to the last round.
    means = np.stack([vectors[index == entry].mean(axis=0) for entry in np.unique(index)])
    assert np.abs(means - palette[np.unique(index)]).max() < 0.5
