"""Evidence of depth: our own files, those of others, and what is refused."""

import numpy as np
import pytest
import torch
from PIL import Image

from splatseg.core import DepthMap
from splatseg.errors import FileFormatError, InputError, RangeError, ShapeError
from splatseg.io.depths import depth_kind, load_depth
from splatseg.io.evidence import (
    DepthEvidence,
    create_evidence,
    evidence_names,
    find_evidence,
    open_evidence,
    save_depth_map,
)
from support.arrays import arrays_of
from support.fuzz.targets.base import view_of


@pytest.fixture
def values(rng) -> torch.Tensor:
    found = torch.from_numpy(rng.uniform(0.5, 9, (6, 8))).float()
    found[0, :3] = 0
    return found


@pytest.mark.parametrize("kind", ["metric", "relative"])
@pytest.mark.parametrize("sure", [True, False])
def test_a_round_trip_as_float16(tmp_path, values, kind, sure) -> None:
    confidence = (values / 9).clamp(0, 1) if sure else None
    folder = create_evidence(tmp_path / "e", kind="depth")
    given = DepthMap(values=values, kind=kind, confidence=confidence)
    save_depth_map(given, folder, "stairs/a")
    for path in (folder, folder / "stairs"):  # with evidence.json, and told by the file
        evidence = open_evidence(path)
        assert isinstance(evidence, DepthEvidence)
        assert evidence.kind == "depth"
        assert evidence.depth_kind() == kind
        assert (evidence.classes, evidence.source_ids) == (None, None)
        (name,) = evidence.view_names
        found = evidence.depth_map(name)
        assert found.kind == kind
        assert torch.equal(found.values, values.half().float())
        assert (found.confidence is not None) == sure
        if sure:
            assert torch.equal(found.confidence, confidence.half().float())
        for ask in (evidence.masks, evidence.features, evidence.label_map):
            with pytest.raises(InputError, match="got depth"):
                ask(name)
    arrays = arrays_of(folder / "stairs" / "a.npz")
    assert set(arrays) == {"depth", "kind", *(["confidence"] if sure else [])}
    assert arrays["depth"].dtype == np.float16
    assert str(arrays["kind"]) == kind
    save_depth_map(given, tmp_path, "again")
    again = (tmp_path / "again.npz").read_bytes()
    assert again == (folder / "stairs" / "a.npz").read_bytes(), "the same bytes each time"


def test_a_view_reads_the_same_file(tmp_path, values) -> None:
    save_depth_map(DepthMap(values=values, kind="metric"), tmp_path, "a")
    path = tmp_path / "a.npz"
    assert depth_kind(path) == "metric"
    assert depth_kind(tmp_path / "a.png") is None
    found = load_depth(view_of(tmp_path / "a.png", depth=path, depth_unit=2.0))
    assert torch.equal(found, values.half().float() * 2)


def test_maps_of_other_programs(tmp_path) -> None:
    """Pictures and arrays are depth only where one says so, and metric where a unit is told."""
    steps = np.array([[0, 1500, 3000]], np.uint16)
    (tmp_path / "png").mkdir()
    Image.fromarray(steps).save(tmp_path / "png" / "a_depth.png")
    (tmp_path / "npy").mkdir()
    np.save(tmp_path / "npy" / "a.npy", np.array([[np.nan, 1.5, 3.0]], np.float32))
    assert open_evidence(tmp_path / "png").kind == "labels"
    metric = open_evidence(tmp_path / "png", kind="depth", depth_unit=0.001, suffix="_depth")
    assert metric.view_names == ("a",)
    assert metric.depth_kind() == "metric"
    assert metric.depth_map("a").values.tolist() == pytest.approx(
        np.array([[0, 1.5, 3.0]]), abs=1e-6
    )
    relative = open_evidence(tmp_path / "npy", kind="depth")
    assert relative.depth_kind() == "relative"
    assert relative.depth_map("a").values.tolist() == [[0, 1.5, 3.0]]
    scaled = open_evidence(tmp_path / "npy", kind="depth", depth_unit=2.0)
    assert scaled.depth_map("a").values.tolist() == [[0, 3.0, 6.0]]
    with pytest.raises(InputError, match="depth_unit: goes with depth maps"):
        open_evidence(tmp_path / "png", depth_unit=0.001)
    for unit in (0.0, -1.0, float("nan")):
        with pytest.raises(RangeError, match="depth_unit: expected a number of metres above 0"):
            open_evidence(tmp_path / "png", kind="depth", depth_unit=unit)
    (tmp_path / "npz").mkdir()
    save_depth_map(DepthMap(values=torch.ones(2, 2), kind="metric"), tmp_path / "npz", "a")
    with pytest.raises(InputError, match="whose npz files tell it"):
        open_evidence(tmp_path / "npz", depth_unit=1.0)


def test_it_is_found_by_name(tmp_path) -> None:
    (tmp_path / "depth_anything").mkdir()
    (tmp_path / "depth").mkdir()  # what a sensor measured is no evidence
    assert evidence_names([tmp_path]) == ("depth_anything",)
    assert find_evidence([tmp_path], None) == tmp_path / "depth_anything"


@pytest.mark.parametrize(
    ("arrays", "words"),
    [
        ({"depth": np.ones((2, 3, 4))}, r"expected a depth map of one channel, got shape"),
        ({"depth": np.ones((0, 3))}, r"expected a depth map of one channel, got shape"),
        ({"depth": np.array([["a"]])}, r"expected a depth map of numbers, got text"),
        ({"depth": np.ones((2, 3)), "kind": np.array("near")}, "kind metric or relative, got 'ne"),
        ({"depth": np.ones((2, 3)), "kind": np.array(3)}, "kind metric or relative"),
        ({"depth": np.ones((2, 3)), "kind": np.array(["metric"] * 2)}, "kind metric or relative"),
        ({"depth": np.ones((2, 3)), "confidence": np.ones((3, 2))}, "a confidence of each of 3x2"),
        ({"depth": np.ones((2, 3)), "confidence": np.full((2, 3), 2.0)}, r"in \[0, 1\]"),
        ({"depth": np.ones((2, 3)), "confidence": np.full((2, 3), np.nan)}, r"in \[0, 1\]"),
    ],
)  # fmt: skip
def test_files_that_are_broken(tmp_path, arrays, words) -> None:
    np.savez(tmp_path / "a.npz", **{"kind": np.array("metric"), **arrays})
    with pytest.raises(FileFormatError, match=words):
        open_evidence(tmp_path).depth_map("a")


def test_without_a_kind_or_of_two(tmp_path) -> None:
    np.savez(tmp_path / "a.npz", depth=np.ones((2, 3)))
    with pytest.raises(FileFormatError, match="expected an array 'kind'"):
        open_evidence(tmp_path).depth_map("a")
    save_depth_map(DepthMap(values=torch.ones(2, 2), kind="metric"), tmp_path, "a")
    save_depth_map(DepthMap(values=torch.ones(2, 2), kind="relative"), tmp_path, "b")
    with pytest.raises(FileFormatError, match="expected depth of one kind, got metric and rel"):
        open_evidence(tmp_path).depth_kind()


def test_what_a_depth_map_is(values, tmp_path) -> None:
    found = DepthMap(values=values, kind="metric")
    assert (found.height, found.width) == (6, 8)
    assert repr(found) == "DepthMap(metric, 8x6 pixels, 94% known)"
    with pytest.raises(InputError, match="kind: expected"):
        DepthMap(values=values, kind="far")
    with pytest.raises(RangeError, match="values: expected values in"):
        DepthMap(values=values - 1, kind="metric")
    with pytest.raises(InputError, match="values"):
        DepthMap(values=values / 0, kind="metric")
    with pytest.raises(ShapeError, match="confidence: expected shape"):
        DepthMap(values=values, kind="metric", confidence=torch.ones(2, 2))
    with pytest.raises(RangeError, match="confidence"):
        DepthMap(values=values, kind="metric", confidence=values)
    with pytest.raises(RangeError, match="a: depth as float16"):
        save_depth_map(DepthMap(values=values * 1e5, kind="relative"), tmp_path, "a")
