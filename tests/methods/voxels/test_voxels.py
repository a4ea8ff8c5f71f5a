"""Voxels as a method: a wall in front of another, by hand; options; the file; words."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch

from splatseg.cli import main
from splatseg.core import VoxelFeatures
from splatseg.errors import FileFormatError, InputError, RangeError
from splatseg.io.arrays import save_arrays
from splatseg.io.evidence import FeatureEvidence, open_evidence
from splatseg.io.layers import load_layer, save_layer
from splatseg.io.scene import load_scene, load_scene_layer
from splatseg.lift.vocabulary import vocabulary_of
from splatseg.lift.voxels import HitOptions, VoxelWords, surface_points, voxelise
from splatseg.methods import find_method
from splatseg.methods.voxels import VoxelOptions
from splatseg.tasks import SegmentOptions, segment

OPTIONS = VoxelOptions(voxels=600)
DEPTH = replace(OPTIONS, cells="depth", projection=HitOptions(hits="first"))


@pytest.fixture(scope="module")
def scene(fitted_room):
    return load_scene(fitted_room)


def made(scene, options=OPTIONS, **more) -> VoxelFeatures:
    asked = SegmentOptions(evidence="features_text", **more)
    layer = segment(scene, "voxels", options=asked, method_options=options).layer
    assert isinstance(layer, VoxelFeatures)
    return layer


@pytest.fixture(scope="module")
def layer(scene) -> VoxelFeatures:
    return made(scene)


def test_cells_of_depth_lie_where_views_see_surfaces(scene) -> None:
    layer = made(scene, DEPTH)
    points = surface_points(scene.gaussians, scene.train_views)
    cells = torch.floor((points - layer.grid.origin) / layer.grid.size).int()
    seen = {tuple(cell) for cell in cells.tolist()}
    assert {tuple(cell) for cell in layer.grid.cells.tolist()} <= seen
    assert 200 < len(layer.grid) < 1500
    assert layer.info.details["hit"] == len(layer.grid)
    assert len(layer) == len(scene.gaussians)
    assert layer.table.precision == "float16"


def test_points_of_a_view_project_onto_its_pixels(scene) -> None:
    view = scene.train_views[0]
    points = surface_points(scene.gaussians, [view], stride=4)
    pixels, depth = view.camera.project(points)[:2]
    assert bool((depth > 0).all())
    off = (pixels - 2.5) % 4
    assert float(torch.minimum(off, 4 - off).abs().max()) < 1e-3, "every fourth pixel's centre"
    with pytest.raises(RangeError, match="stride: expected at least 1"):
        surface_points(scene.gaussians, [view], stride=0)
    with pytest.raises(InputError, match="pixels that show a surface"):
        surface_points(scene.gaussians, [])


def test_cells_of_few_points_are_left_out() -> None:
    points = torch.tensor([[0.5, 0.5, 0.5]] * 3 + [[5.5, 0.5, 0.5]] + [[9.5, 0.5, 0.5]] * 2)
    assert voxelise(points, 1.0).cells[:, 0].tolist() == [0, 5, 9]
    assert voxelise(points, 1.0, min_points=2).cells[:, 0].tolist() == [0, 9]
    assert voxelise(points, 1.0, min_points=3).cells[:, 0].tolist() == [0]
    with pytest.raises(InputError, match="min_points: expected a cell of 4"):
        voxelise(points, 1.0, min_points=4)


@pytest.mark.parametrize(
    "changed",
    [
        {"voxels": 200},
        {"cell": 0.5},
        {"cells": "depth"},
        {"min_points": 40, "cells": "depth"},
        {"projection": HitOptions(hits="first")},
        {"projection": HitOptions(hits="several")},
        {"projection": HitOptions(hits="weights")},
        {"precision": "int8"},
        {"precision": "product", "parts": 2},
    ],
)
def test_each_option_makes_a_difference(scene, layer, changed) -> None:
    found = made(scene, replace(OPTIONS, **changed))
    if "min_points" in changed:
        layer = made(scene, replace(OPTIONS, cells="depth"))
    same = len(found.grid) == len(layer.grid) and torch.equal(
        found.table.decode(), layer.table.decode()
    )
    assert not same
    if changed.get("cell"):
        assert found.grid.size == 0.5


def test_parts_are_bytes_of_a_voxel(scene) -> None:
    few = made(scene, replace(OPTIONS, precision="product", parts=2)).table
    more = made(scene, replace(OPTIONS, precision="product", parts=4)).table
    assert few.codes.shape[1] < more.codes.shape[1] <= 4


def test_filtering_counts_where_centres_make_cells(scene) -> None:
    strict = replace(OPTIONS, filtering=replace(OPTIONS.filtering, scale_share=0.4))
    assert made(scene, strict).grid.size != made(scene).grid.size
    depth = replace(DEPTH, filtering=strict.filtering)
    assert made(scene, depth).grid.size == made(scene, DEPTH).grid.size


def test_published_is_the_paper(scene) -> None:
    """Written out from sections 3.2, 3.4 and 3.5 and, where they are silent, its code."""
    found = made(scene, None, published=True)
    assert found.grid.size == 0.04
    assert found.table.precision == "float32"
    options = found.info.options
    assert options["cells"] == "centres"
    projection, reading = options["projection"], options["assignment"]
    assert (projection["hits"], projection["average"]) == ("first", "hits")
    assert (reading["interpolation"], reading["max_distance"]) == ("nearest", None)
    kept = options["filtering"]
    assert (kept["opaque_share"], kept["min_neighbours"], kept["radius"]) == (0.5, 4, 0.2)
    assert (kept["min_opacity"], kept["max_elongation"], kept["scale_share"]) == (None, None, None)
    method = find_method("voxels")
    assert (method.words, method.published_words) == ("span", "cosines")


@pytest.mark.parametrize("precision", ["float32", "float16", "int8", "product"])
def test_a_file_gives_back_the_layer(scene, layer, precision, tmp_path) -> None:
    kept = made(scene, replace(OPTIONS, precision=precision))
    path = tmp_path / "voxels.npz"
    save_layer(kept, path)
    again = load_layer(path)
    assert isinstance(again, VoxelFeatures)
    assert torch.equal(again.grid.cells, kept.grid.cells)
    assert again.grid.size == kept.grid.size
    assert torch.equal(again.grid.origin, kept.grid.origin)
    assert torch.equal(again.table.decode(), kept.table.decode())
    assert torch.equal(again.rows, kept.rows)
    assert torch.equal(again.weights, kept.weights)
    assert again.info == kept.info


@pytest.mark.parametrize(
    ("name", "said"), [("cells", "'cells'"), ("codes", "'codes'"), ("rows", "'rows'")]
)
def test_a_file_that_lacks_an_array_is_refused(layer, tmp_path, name, said) -> None:
    path = tmp_path / "voxels.npz"
    save_layer(layer, path)
    with np.load(path) as archive:
        arrays = dict(archive)
    header = json.loads(bytes(arrays.pop("header")).decode())
    del arrays[name]
    save_arrays(header, arrays, path, name=path)
    with pytest.raises(FileFormatError, match=said):
        load_layer(path)


def test_words_of_voxels_compare_as_the_paper_does(scene, layer) -> None:
    evidence = open_evidence(scene.source / "features_text")
    assert isinstance(evidence, FeatureEvidence)
    vocabulary = vocabulary_of(evidence)
    words = vocabulary.words[:3]
    plain = VoxelWords(layer, vocabulary, components=None)
    vectors = vocabulary.vectors(words)
    expected = vocabulary.space.cosines(layer.table.decode(), vectors)
    torch.testing.assert_close(plain.cosines(vectors), expected, rtol=0, atol=2e-3)
    spread = plain.of_gaussians(expected)
    read = layer.rows[:, 0].long()
    there = read >= 0
    torch.testing.assert_close(spread[there], expected[read[there]])
    assert bool((spread[~there] == 0).all())
    asked = VoxelWords(layer, vocabulary).ask(words)
    assert asked.probabilities.shape == (len(layer.grid), 3)
    assert bool(((asked.probabilities >= 0) & (asked.probabilities <= 1)).all())


def test_query_answers_from_voxels(fitted_room, tmp_path, capsys) -> None:
    folder = shutil.copytree(fitted_room, tmp_path / "scene")
    make = ["segment", str(folder), "--method", "voxels", "--evidence", "features_text"]
    assert main([*make, "--voxels", "600", "--layer", "vox", "--quiet"]) == 0
    assert isinstance(load_scene_layer(folder, "vox"), VoxelFeatures)
    scene = load_scene(folder)
    evidence = open_evidence(scene.source / "features_text")
    assert isinstance(evidence, FeatureEvidence)
    word = vocabulary_of(evidence).words[0]
    ask = ["query", str(folder), word, "--from-layer", "vox", "--min-probability", "0", "--every"]
    assert main([*ask, "--layer", "found"]) == 0
    out = capsys.readouterr().out
    assert word in out
    assert load_scene_layer(folder, "found").info.details["words"] == [word]
