"""Folders of pointmaps: what is written comes back, and what is none is refused in a sentence."""

import json

import numpy as np
import pytest
import torch

from splatseg.core import Pointmap
from splatseg.errors import FileFormatError, InputError, MissingFileError
from splatseg.io.pointmaps import create_pointmaps, holds_pointmaps, open_pointmaps

NAMES = ("a.jpg", "b.jpg", "c d.png")


def _map(rows: int = 3, columns: int = 4, scale: float = 1.0) -> Pointmap:
    points = torch.linspace(-2, 5, rows * columns * 3).reshape(rows, columns, 3) * scale
    return Pointmap(points=points, confidence=torch.full((rows, columns), 2.5))


def _folder(tmp_path):
    kept = create_pointmaps(tmp_path / "maps", photographs=NAMES, metadata={"model": "m"})
    kept.save("a.jpg", "c d.png", (_map(), _map(2, 5)))
    return kept


def test_what_is_written_comes_back(tmp_path) -> None:
    kept = _folder(tmp_path)
    kept.save("b.jpg", "a.jpg", (_map(scale=1e5), _map()))  # beyond float16
    again = open_pointmaps(tmp_path / "maps")
    assert again == kept
    assert holds_pointmaps(tmp_path / "maps")
    assert not holds_pointmaps(tmp_path)
    assert again.pairs == (("a.jpg", "c d.png"), ("b.jpg", "a.jpg"))
    assert again.holds("a.jpg", "c d.png")
    assert not again.holds("c d.png", "a.jpg")
    one, two = again.pointmaps("a.jpg", "c d.png")
    torch.testing.assert_close(one.points, _map().points, rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(one.confidence, _map().confidence)
    assert two.points.shape == (2, 5, 3)
    torch.testing.assert_close(again.pointmaps("b.jpg", "a.jpg")[0].points, _map(scale=1e5).points)


def test_work_goes_on_in_a_folder_of_the_same_and_no_other(tmp_path) -> None:
    _folder(tmp_path)
    again = create_pointmaps(tmp_path / "maps", photographs=NAMES, metadata={"model": "m"})
    assert again.holds("a.jpg", "c d.png")
    with pytest.raises(InputError, match="got those of others"):
        create_pointmaps(tmp_path / "maps", photographs=NAMES, metadata={"model": "other"})
    with pytest.raises(InputError, match="got one twice"):
        create_pointmaps(tmp_path / "x", photographs=("a", "a"), metadata={})


def test_a_pair_or_a_photograph_that_is_not_there(tmp_path) -> None:
    kept = _folder(tmp_path)
    with pytest.raises(MissingFileError, match="expected pointmaps of 'c d.png' and 'a.jpg'"):
        kept.pointmaps("c d.png", "a.jpg")
    with pytest.raises(InputError, match="expected one of its 3 photographs, got 'e.jpg'"):
        kept.pointmaps("a.jpg", "e.jpg")
    with pytest.raises(MissingFileError, match="expected a folder of pointmaps"):
        open_pointmaps(tmp_path)
    np.savez(kept.folder / "0000_0007.npz", points_1=np.zeros(3))
    with pytest.raises(FileFormatError, match="two of the 3 photographs"):
        _ = kept.pairs


@pytest.mark.parametrize(
    ("header", "words"),
    [
        ({"version": 2}, "of version 1 or less, got version 2"),
        ({"photographs": "a.jpg"}, "photographs: expected a list"),
        ({"photographs": ["a", "a"]}, "distinct photographs"),
        ({"metadata": 3}, "metadata: expected an object"),
    ],
)
def test_headers_that_are_none(tmp_path, header, words: str) -> None:
    good = {"format": "splatseg-pointmaps", "version": 1, "photographs": list(NAMES)}
    (tmp_path / "pointmaps.json").write_text(json.dumps(good | header))
    with pytest.raises(FileFormatError, match=words):
        open_pointmaps(tmp_path)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"points_1": np.zeros((3, 4, 2), "f4")}, r"points_1 of shape \(rows, columns, 3\)"),
        ({"points_1": np.zeros((3, 4, 3), "i4")}, "in real numbers, got int32"),
        ({"points_2": np.zeros((0, 4, 3), "f4")}, "1 to 16384 a side"),
        ({"points_2": np.full((3, 4, 3), np.nan, "f4")}, "36 of 36 values are not finite"),
        ({"confidence_2": np.full((3, 4), 0.5, "f4")}, r"expected values in \[1, inf\], got 0.5"),
        ({"confidence_1": np.ones((4, 3), "f4")}, r"confidence_1 of shape \(3, 4\)"),
    ],
)
def test_maps_that_are_none(tmp_path, change, words: str) -> None:
    kept = _folder(tmp_path)
    good = {f"points_{k}": np.ones((3, 4, 3), "f4") for k in (1, 2)}
    good |= {f"confidence_{k}": np.ones((3, 4), "f4") for k in (1, 2)}
    np.savez(kept.folder / "0000_0001.npz", **(good | change))
    with pytest.raises(FileFormatError, match=words) as error:
        kept.pointmaps("a.jpg", "b.jpg")
    assert "0000_0001.npz" in str(error.value)
