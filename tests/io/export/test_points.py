"""Point clouds, read back by readers of others where there are."""

import sys

import laspy
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from splatseg.errors import InputError, MissingPackageError, RangeError
from splatseg.io.captures.points import read_ply_points
from splatseg.io.export import write_points


def columns(ids) -> dict[str, torch.Tensor]:
    ids = torch.tensor(ids, dtype=torch.int32)
    return {
        "class_id": ids,
        "confidence": torch.linspace(0, 1, len(ids)),
        "instance_id": ids * 100_000,
    }


def test_ply(make, tmp_path) -> None:
    g = make([[0, 1, 2], [3, 4, 5]], colours=[[1, 0, 0.5], [-1, 2, 0]])
    path = tmp_path / "a.ply"
    assert write_points(g, path, columns=columns([0, 7])) == {}
    cloud = read_ply_points(path)
    assert cloud.points.tolist() == [[0, 1, 2], [3, 4, 5]]
    assert cloud.colours is not None
    assert cloud.colours.tolist() == [[255, 0, 128], [0, 255, 0]]
    head, _, data = path.read_bytes().partition(b"end_header\n")
    for line in ("int class_id", "float confidence", "int instance_id", "uchar red"):
        assert f"property {line}\n".encode() in head
    row = np.dtype("<3f4,3u1,<i4,<f4,<i4")
    table = np.frombuffer(data, row)
    assert table["f2"].tolist() == [0, 7]
    assert table["f4"].tolist() == [0, 700_000]


@pytest.mark.parametrize("ending", ["las", "laz"])
def test_las(make, tmp_path, ending) -> None:
    g = make([[-100, 1e-3, 2], [3, 4, 5], [1, 1, 1]], colours=[[1, 0, 0.5]])
    path = tmp_path / f"a.{ending}"
    assert write_points(g, path, columns=columns([0, 7, 192])) == {7: 70, 192: 255}
    las = laspy.read(path)
    assert (str(las.header.version), las.header.point_format.id) == ("1.4", 7)
    assert np.abs(las.xyz - g.means.numpy()).max() < 1e-6
    assert las.red.tolist() == [65535] * 3
    assert las.blue.tolist() == [32768] * 3
    # 0 to 63 mean things of their own in LAS (7 is noise, which programs drop).
    assert np.asarray(las.classification).tolist() == [0, 70, 255]
    assert np.asarray(las["class_id"]).tolist() == [0, 7, 192]
    assert np.asarray(las["instance_id"]).tolist() == [0, 700_000, 19_200_000]
    assert np.asarray(las["confidence"]).tolist() == [0, 0.5, 1]
    assert las["class_id"].dtype == np.int32


def test_las_with_more_classes_than_a_byte_holds(make, tmp_path) -> None:
    g = make([[0, 0, 0], [1, 0, 0]])
    assert write_points(g, tmp_path / "a.las", columns=columns([1, 193])) == {}
    las = laspy.read(tmp_path / "a.las")
    assert np.asarray(las.classification).tolist() == [0, 0]
    assert np.asarray(las["class_id"]).tolist() == [1, 193]


@given(exponent=st.integers(-6, 8), offset=st.floats(-1e6, 1e6), seed=st.integers(0, 1000))
def test_las_keeps_places_of_any_size(make, tmp_path, exponent, offset, seed) -> None:
    means = np.random.default_rng(seed).normal(0, 1, (20, 3)) * 10.0**exponent + offset
    g = make(means)
    write_points(g, tmp_path / "b.las")
    exact = g.means.double().numpy()
    extent = float((exact - exact.min(axis=0)).max())
    assert np.abs(laspy.read(tmp_path / "b.las").xyz - exact).max() <= max(extent, 1e-6) * 1e-8


def test_the_same_points_give_the_same_bytes(make, tmp_path) -> None:
    g = make([[0, 1, 2], [3, 4, 5]])
    for ending in ("ply", "las"):
        for name in ("a", "b"):
            write_points(g, tmp_path / f"{name}.{ending}", columns=columns([1, 2]))
        assert (tmp_path / f"a.{ending}").read_bytes() == (tmp_path / f"b.{ending}").read_bytes()


@pytest.mark.parametrize("ending", ["ply", "las"])
def test_no_points(make, tmp_path, ending) -> None:
    write_points(make(torch.zeros(0, 3)), tmp_path / f"a.{ending}", columns=columns([]))
    assert (tmp_path / f"a.{ending}").is_file()


def test_refusals(make, tmp_path, monkeypatch) -> None:
    g = make([[0, 0, 0]])
    with pytest.raises(InputError, match=r"\.ply, \.las or \.laz"):
        write_points(g, tmp_path / "a.xyz")
    with pytest.raises(InputError, match="class_id.*expected 1 values"):
        write_points(g, tmp_path / "a.ply", columns=columns([1, 2]))
    with pytest.raises(InputError, match="32 bit"):
        write_points(g, tmp_path / "a.ply", columns={"class_id": torch.tensor([2**40])})
    with pytest.raises(RangeError, match="finite"):
        write_points(make([[0, float("inf"), 0]]), tmp_path / "a.ply")
    monkeypatch.setitem(sys.modules, "lazrs", None)
    with pytest.raises(MissingPackageError, match=r"lazrs.*splatseg\[las\]"):
        write_points(g, tmp_path / "a.laz")
    monkeypatch.setitem(sys.modules, "laspy", None)
    with pytest.raises(MissingPackageError, match=r"laspy.*splatseg\[las\]"):
        write_points(g, tmp_path / "a.las")
    assert list(tmp_path.iterdir()) == []
