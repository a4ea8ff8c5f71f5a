"""Voxels as a method: a wall in front of another, by hand; options; the file; words."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch

from splatseg.cli import main
from splatseg.core import StoredTable, VoxelFeatures
from splatseg.errors import FileFormatError, InputError, RangeError, ShapeError
from splatseg.io.arrays import save_arrays
from splatseg.io.evidence import FeatureEvidence, open_evidence
from splatseg.io.layers import load_layer, save_layer
from splatseg.io.scene import load_scene, load_scene_layer
from splatseg.lift.vocabulary import vocabulary_of
from splatseg.methods import find_method
from splatseg.methods.voxels import VoxelOptions
from splatseg.methods.voxels.words import VoxelWords, products, store
from splatseg.tasks import SegmentOptions, segment

OPTIONS = VoxelOptions(voxels=600)


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


@pytest.mark.parametrize(
    "changed",
    [
        {"voxels": 200},
        {"cell": 0.5},
        {"filter": "opaque"},
        {"hits": "first"},
        {"precision": "int8"},
        {"precision": "product"},
    ],
)
def test_each_option_makes_a_difference(scene, layer, changed) -> None:
    found = made(scene, replace(OPTIONS, **changed))
    same = len(found.grid) == len(layer.grid) and torch.equal(
        found.table.decode(), layer.table.decode()
    )
    assert not same
    if changed.get("cell"):
        assert found.grid.size == 0.5


def test_options_that_went_say_what_to_use_instead() -> None:
    with pytest.raises(InputError, match="cells: this option was removed; cells are made of"):
        VoxelOptions(cells="depth")
    with pytest.raises(RangeError, match="voxels: expected at least 1"):
        VoxelOptions(voxels=0)


def test_published_is_the_paper(scene) -> None:
    """Written out from sections 3.2, 3.4 and 3.5 and, where they are silent, its code."""
    found = made(scene, None, published=True)
    assert found.grid.size == 0.04
    assert found.table.precision == "float32"
    options = found.info.options
    assert (options["filter"], options["hits"]) == ("opaque", "first")
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


PRECISIONS = ("float32", "float16", "int8", "product")


def rows_of(rng, count: int = 700, channels: int = 24) -> torch.Tensor:
    return torch.from_numpy(rng.normal(size=(count, channels))).float()


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("count", [1, 3, 17])
def test_products_are_those_of_the_rows_that_were_kept(rng, precision, count) -> None:
    values = rows_of(rng)
    vectors = torch.from_numpy(rng.normal(size=(count, 24))).float()
    table = store(values, precision=precision, parts=8)
    assert table.precision == precision
    assert table.channels == 24
    expected = table.decode().double() @ vectors.double().T
    found = products(table, vectors)
    torch.testing.assert_close(found.double(), expected, rtol=0, atol=2e-5)


@pytest.mark.parametrize(("precision", "most"), [("float32", 0), ("float16", 2e-3), ("int8", 2e-2)])
def test_what_is_lost_is_bounded(rng, precision, most) -> None:
    values = rows_of(rng)
    lost = (store(values, precision=precision).decode() - values).abs().max()
    assert float(lost) <= most
    assert store(values, precision=precision).nbytes < values.nbytes + 1


def test_a_product_code_is_the_nearest_of_its_codebook(rng) -> None:
    values = rows_of(rng, count=400)
    table = store(values, precision="product", parts=6)
    assert table.codebooks is not None
    cut = values.reshape(400, 6, 4)
    distance = (cut[:, :, None] - table.codebooks[None]).square().sum(dim=-1)
    taken = distance.gather(2, table.codes.long()[..., None]).squeeze(-1)
    torch.testing.assert_close(taken, distance.amin(dim=2), rtol=1e-4, atol=1e-5)
    assert table.nbytes == 400 * 6 + table.codebooks.nbytes
    again = store(values, precision="product", parts=6)
    assert torch.equal(again.codes, table.codes)
    other = store(values, precision="product", parts=6, seed=1)
    assert not torch.equal(other.codebooks, table.codebooks)


def test_few_distinct_rows_are_kept_without_loss(rng) -> None:
    distinct = rows_of(rng, count=40)
    values = distinct[torch.from_numpy(rng.integers(0, 40, 900))]
    table = store(values, precision="product", parts=24)
    # More vectors than distinct rows: k-means ends on the rows themselves where it begins on them.
    assert float((table.decode() - values).square().mean()) < 0.01


def test_bad_tables(rng) -> None:
    values = rows_of(rng, count=5)
    with pytest.raises(RangeError, match="float16, got 1e\\+06"):
        store(values * 0 + 1e6, precision="float16")
    with pytest.raises(RangeError, match="at most 65504 for float16"):
        store(values * 0 + 65600, precision="float16")
    assert bool((store(values * 0 + 65504, precision="float16").decode() == 65504).all())
    with pytest.raises(RangeError, match="parts: expected at least 1"):
        store(values, precision="product", parts=0)
    with pytest.raises(RangeError):
        store(values * float("nan"))
    with pytest.raises(ShapeError):
        products(store(values), torch.zeros(2, 7))
    with pytest.raises(InputError, match="scales: expected them with codes of int8"):
        StoredTable(codes=values, scales=torch.ones(5))
    with pytest.raises(InputError, match="codes: expected float32"):
        StoredTable(codes=values.double())
