"""Layers: round trips, bytes that stay the same, and files that are refused."""

import importlib.util
import io
import json
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch

from splatseg.core import (
    Features,
    InstanceFacts,
    InstanceTree,
    Labels,
    LayerInfo,
    Selection,
    StoredTable,
    TreeNode,
    VoxelFeatures,
    VoxelGrid,
)
from splatseg.errors import FileFormatError, InputError, MissingFileError
from splatseg.io.layers import load_layer, save_layer

INFO = LayerInfo(
    method="uplift", names={3: "Stuhl — chair"}, details={"list": [1, 2.5, None, True]}
)


def labels(n: int = 5, **more) -> Labels:
    ids = torch.tensor([-1, 3, 70000, 1, 2**31 - 1])[:n]
    return Labels(ids=ids, confidence=torch.linspace(0, 1, n), info=INFO, **more)


def same(a, b) -> None:
    assert type(a) is type(b)
    for name in type(a).__dataclass_fields__:
        one, other = getattr(a, name), getattr(b, name)
        if isinstance(one, torch.Tensor):
            assert one.dtype == other.dtype
            assert torch.equal(one, other), name
        elif isinstance(one, Labels | VoxelGrid | StoredTable):
            same(one, other)
        else:
            assert one == other


LAYERS = {
    "labels": labels(),
    "background": labels(background=4),
    "soft": labels(
        candidates=torch.tensor([[-1, -1], [3, 1], [70000, -1], [1, 2], [9, 8]], dtype=torch.int32),
        shares=torch.rand(5, 2, generator=torch.Generator().manual_seed(1)),
        evidence=torch.tensor([3.0, 0.0, 1.5, 2.0, 1e6]),
        effective_views=torch.tensor([1.0, 2.5, 0.0, 7.25, 3.0]),
        inferred=torch.tensor([False, True, False, False, True]),
    ),
    "features": Features(values=torch.randn(4, 3), weights=torch.rand(4), info=INFO),
    "half": Features(values=torch.randn(4, 3).half()),
    "tree": InstanceTree(
        nodes=(
            TreeNode(id=3, level="group", name="Gruppe", support=1 / 3),
            TreeNode(id=70000, parent=3, class_id=2, segments=7, views=5),
            TreeNode(id=1, parent=70000, level="part", name="Fu\u00df"),
            TreeNode(id=2**31 - 1),
        ),
        labels=labels(
            background=1,
            evidence=torch.tensor([3.0, 0.0, 1.5, 2.0, 1e6]),
            inferred=torch.tensor([False, True, False, False, True]),
        ),
    ),
    "selection": Selection(mask=torch.tensor([True, False, True]), info=INFO),
    "soft selection": Selection.of_confidence(torch.tensor([0.75, 0.5, 1.0, 1 / 3]), info=INFO),
    "voxels": VoxelFeatures(
        grid=VoxelGrid(
            cells=torch.tensor([[-9, 4, 0], [1, 0, 2]]),
            size=1 / 3,
            origin=torch.tensor([0.1, 2, 3]),
        ),
        table=StoredTable(
            codes=torch.tensor([[127, -3, 5], [0, -127, 1]], dtype=torch.int8),
            scales=torch.tensor([0.25, 1 / 3]),
        ),
        weights=torch.tensor([2.5, 1.0]),
        rows=torch.tensor([[1, 0], [-1, -1], [0, -1]]),
        shares=torch.tensor([[0.25, 0.75], [0.0, 0.0], [1.0, 0.0]]),
        info=INFO,
    ),
    "empty": Labels(ids=torch.zeros(0, dtype=torch.int32), confidence=torch.zeros(0)),
    "none": Selection(mask=torch.zeros(0, dtype=torch.bool)),
}


@pytest.mark.parametrize("name", LAYERS)
def test_round_trip_and_same_bytes(tmp_path, name) -> None:
    save_layer(LAYERS[name], tmp_path / "a.npz")
    read = load_layer(tmp_path / "a.npz")
    same(LAYERS[name], read)
    save_layer(read, tmp_path / "b.npz")
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


@pytest.fixture(scope="module")
def golden(project_root: Path):
    """The script that made the golden files, as a module."""
    path = project_root / "tests/golden/make_io.py"
    spec = importlib.util.spec_from_file_location("make_io", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_a_tree_of_version_2_is_read(golden, project_root) -> None:
    tree = load_layer(project_root / "tests/golden/layers-v2/tree.npz")
    assert isinstance(tree, InstanceTree)
    same(golden.golden_tree(), tree)
    assert tree.cut("group").ids.tolist() == [4, -1, 4, 4, 4, 3]
    assert tree.cut().ids.tolist() == [1, -1, -1, 1, 2, 3]
    assert tree.cut("part").background == 3


@pytest.mark.parametrize("name", ["semantic", "features", "chosen"])
def test_layers_of_version_1_are_read(golden, project_root, name) -> None:
    layer = load_layer(project_root / f"tests/golden/scene-v1/layers/{name}.npz")
    same(golden.golden_layers()[name], layer)


@pytest.mark.parametrize("name", ["semantic", "features", "chosen", "tree"])
def test_layers_of_version_3_are_read_and_written_as_they_were(
    golden, project_root, tmp_path, name
) -> None:
    path = project_root / f"tests/golden/layers-v3/{name}.npz"
    layer = load_layer(path)
    same(golden.golden_layers_of_version_3()[name], layer)
    save_layer(layer, tmp_path / "again.npz")
    assert (tmp_path / "again.npz").read_bytes() == path.read_bytes()


def test_selections_with_confidence_of_version_4_are_read_and_written_as_they_were(
    golden, project_root, tmp_path
) -> None:
    path = project_root / "tests/golden/layers-v4/chosen.npz"
    layer = load_layer(path)
    same(golden.golden_soft_selection(), layer)
    save_layer(layer, tmp_path / "again.npz")
    assert (tmp_path / "again.npz").read_bytes() == path.read_bytes()


@pytest.mark.parametrize("name", ["float32", "float16", "int8", "product", "shares"])
def test_voxels_of_version_5_are_read_and_written_as_they_were(
    golden, project_root, tmp_path, name
) -> None:
    path = project_root / f"tests/golden/layers-v5/{name}.npz"
    layer = load_layer(path)
    same(golden.golden_voxels()[name], layer)
    assert layer.table.precision == ("float16" if name == "shares" else name)
    save_layer(layer, tmp_path / "again.npz")
    assert (tmp_path / "again.npz").read_bytes() == path.read_bytes()


def test_a_confidence_that_contradicts_its_mask_is_refused(tmp_path) -> None:
    path = tmp_path / "a.npz"
    save_layer(LAYERS["soft selection"], path)
    with np.load(path) as archive:
        arrays = {name: archive[name] for name in archive.files}
    np.savez(path, **arrays | {"mask": ~arrays["mask"]})
    with pytest.raises(FileFormatError, match=r"a\.npz.*contradict"):
        load_layer(path)


def test_records_as_deep_as_they_may_be_have_a_place_in_files(tmp_path) -> None:
    deep: list = []
    for _ in range(89):
        deep = [deep]
    facts = {1: InstanceFacts(details={"a": deep})}
    info = LayerInfo(instances=facts, details={"a": deep}).with_edit("merge", {"a": deep})
    save_layer(Selection(mask=torch.ones(1).bool(), info=info), tmp_path / "a.npz")
    assert load_layer(tmp_path / "a.npz").info == info


def test_a_number_of_more_digits_than_python_reads_is_refused(tmp_path) -> None:
    path = tmp_path / "a.npz"
    save_layer(LAYERS["labels"], path)
    text = '{"format": "splatseg-layer", "count": ' + "1" * 5000 + "}"
    np.savez(path, header=np.frombuffer(text.encode(), np.uint8))
    with pytest.raises(FileFormatError, match=f"^{path}: expected JSON"):
        load_layer(path)


def test_a_record_of_version_0_is_that_of_a_file_without_its_version(tmp_path) -> None:
    """A method could call a key of its own version."""

    def flat(header, arrays) -> None:
        del header["info"]
        header.update(version=1, metadata={"method": "m", "version": "2.0", "names": {"3": "a"}})

    info = load_layer(changed(tmp_path, flat)).info
    assert info == LayerInfo(method="m", names={3: "a"}, details={"version": "2.0"})


def test_layers_of_a_later_version_are_refused(tmp_path) -> None:
    path = changed(tmp_path, lambda h, a: h.update(version=6), layer="tree")
    with pytest.raises(FileFormatError, match="version 5 or less, got version 6"):
        load_layer(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda h, a: h.pop("nodes"), "expected a list of nodes, got none"),
        (lambda h, a: h["nodes"][0].pop("level"), "nodes of a tree.*level"),
        (lambda h, a: h["nodes"][0].update(id="x"), "nodes of a tree"),
        (lambda h, a: h["nodes"][1].update(parent=1), "nodes of a tree.*in a group or alone"),
        (lambda h, a: h["nodes"].pop(0), "nodes of a tree.*parent that is there, got 3"),
        (lambda h, a: a.update(ids=a["ids"] // 2), "nodes of a tree.*ids of nodes"),
        (lambda h, a: a.pop("confidence"), "an array 'confidence'"),
    ],
)
def test_files_that_hold_no_tree(tmp_path, change, message) -> None:
    path = changed(tmp_path, change, layer="tree")
    with pytest.raises(FileFormatError, match=message):
        load_layer(path)


def test_none_is_0_in_the_file(tmp_path) -> None:
    save_layer(LAYERS["soft"], tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz", allow_pickle=False) as archive:
        assert archive["ids"].tolist() == [0, 3, 70000, 1, 2**31 - 1]
        assert archive["candidates"][0].tolist() == [0, 0]
        header = json.loads(archive["header"].tobytes())
    assert header["background"] == 0
    assert "metadata" not in header
    assert header["info"] == {
        "version": 1,
        "method": "uplift",
        "names": {"3": "Stuhl — chair"},
        "details": {"list": [1, 2.5, None, True]},
    }


@pytest.mark.parametrize(
    ("layer", "message"),
    [
        (Labels(ids=torch.tensor([0, 1]), confidence=torch.ones(2)), "0, which is void"),
        (labels(background=0), "0, which is void"),
    ],
)
def test_layers_that_have_no_place_in_a_file(tmp_path, layer, message) -> None:
    with pytest.raises(InputError, match=message):
        save_layer(layer, tmp_path / "a.npz")
    assert not list(tmp_path.iterdir())


def changed(tmp_path, change, layer="soft"):
    """The file of a layer after a change of its entries; header as a dict."""
    path = tmp_path / "a.npz"
    save_layer(LAYERS[layer], path)
    with np.load(path, allow_pickle=False) as archive:
        arrays = dict(archive)
    header = json.loads(arrays.pop("header").tobytes())
    change(header, arrays)
    text = json.dumps(header).encode()
    np.savez(path, header=np.frombuffer(text, np.uint8), **arrays)
    return path


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda h, a: h.update(version=6), "version 5 or less, got version 6; a later splatseg"),
        (lambda h, a: h.update(version=0), "got version 0"),
        (lambda h, a: h.update(format="other"), "expected a layer, got 'other'"),
        (lambda h, a: h.update(kind="clouds"), "got 'clouds'"),
        (lambda h, a: h.update(count=4), r"'ids' of type i4 and shape \(4\), got int32 of \(5,\)"),
        (lambda h, a: h.update(count=-1), "count: expected .*, got -1"),
        (lambda h, a: h.update(background=-1), "background: expected a whole number"),
        (lambda h, a: h.pop("info"), "expected an object 'info' in the header, got none"),
        (lambda h, a: h.update(info=[]), "info: expected .*object"),
        (lambda h, a: h.update(version=2), "expected an object 'metadata' in the header"),
        (lambda h, a: h["info"].update(version=2), "info: .*version 1 or less, got version 2"),
        (lambda h, a: h["info"].update(names=["a"]), "info: names: expected an object, got list"),
        (lambda h, a: a.pop("ids"), "an array 'ids', which is not there"),
        (lambda h, a: a.pop("shares"), "an array 'shares', which is not there"),
        (lambda h, a: a.update(ids=a["ids"].astype(float)), "'ids' of type i4"),
        (lambda h, a: a["ids"].__setitem__(1, -1), r"'ids' of 0 \(none\) or more, got -1"),
        (lambda h, a: a.update(confidence=a["confidence"][:, None]), "'confidence' of type f4"),
    ],
)
def test_files_that_contradict_themselves(tmp_path, change, message) -> None:
    path = changed(tmp_path, change)
    with pytest.raises(FileFormatError, match=f"^{path}: .*{message}"):
        load_layer(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda h, a: h.update(precision="int4"), "precision: "),
        (lambda h, a: h.update(precision=["int8"]), "precision: "),
        (lambda h, a: h.update(precision="float32"), "'codes' of type f4 .*, got int8 of"),
        (lambda h, a: h.update(voxels=3), r"'codes' of type i1 and shape \(3, any\)"),
        (lambda h, a: h.update(size=0), "size: expected more than 0"),
        (lambda h, a: h.update(origin=[0, 0]), "origin: expected .*length 3"),
        (lambda h, a: a.pop("codes"), "an array 'codes', which is not there"),
        (lambda h, a: a.pop("scales"), "an array 'scales', which is not there"),
        (lambda h, a: a.pop("shares"), "shares: expected those of 2 voxels a Gaussian, got none"),
        (lambda h, a: a.update(cells=a["cells"][::-1]), "cells in their order, each once"),
        (lambda h, a: a.update(cells=a["cells"][:, :2]), r"'cells' of type i4 and shape \(2, 3\)"),
        (lambda h, a: a["rows"].__setitem__((0, 0), 3), "rows of 2 voxels"),
        (lambda h, a: a["shares"].__setitem__((0, 0), -1), "shares: expected at least 0"),
        (lambda h, a: a["voxel_weights"].__setitem__(0, np.nan), "finite 'voxel_weights'"),
    ],
)
def test_files_that_hold_no_voxels(tmp_path, change, message) -> None:
    path = changed(tmp_path, change, layer="voxels")
    with pytest.raises(FileFormatError, match=f"^{path}: .*{message}"):
        load_layer(path)


def test_files_that_are_no_layers(tmp_path) -> None:
    path = tmp_path / "a.npz"
    with pytest.raises(MissingFileError, match="there is no such file"):
        load_layer(path)
    save_layer(LAYERS["labels"], path)
    whole = path.read_bytes()
    for length in range(0, len(whole), 37):
        path.write_bytes(whole[:length])
        with pytest.raises(FileFormatError, match=f"^{path}: "):
            load_layer(path)
    np.savez(path, a=np.zeros(3))
    with pytest.raises(FileFormatError, match="without a header"):
        load_layer(path)


def test_a_damaged_byte_is_noticed(tmp_path) -> None:
    path = tmp_path / "a.npz"
    save_layer(LAYERS["features"], path)
    data = bytearray(path.read_bytes())
    data[data.index(b"values.npy") + 200] ^= 1
    path.write_bytes(data)
    with pytest.raises(FileFormatError, match="cannot be read"):
        load_layer(path)


def test_nothing_is_unpickled(tmp_path) -> None:
    """A layer that would run code when it is opened is refused."""
    path = tmp_path / "a.npz"
    save_layer(LAYERS["labels"], path)
    entry = io.BytesIO()
    np.save(entry, np.array([print], dtype=object), allow_pickle=True)
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("shares.npy", entry.getvalue())
    with pytest.raises(FileFormatError, match="expected an array of numbers"):
        load_layer(path)
