"""glTF: the conformance files, nodes that move Gaussians, and what is not understood."""

import base64
import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from splatseg.core import Similarity
from splatseg.core.rigid import rotation_from_quaternion
from splatseg.errors import FileFormatError, MissingFileError
from splatseg.io.splats import SplatWarning, read_splats
from splatseg.io.splats.gltf import LINEAR_COLOUR

Change = Callable[[dict[str, Any]], object]


@pytest.fixture
def golden(project_root: Path) -> Path:
    return project_root / "tests" / "golden" / "splats"


def draft(golden: Path) -> dict[str, Any]:
    return json.loads((golden / "three.draft.gltf").read_text())


def written(folder: Path, document: object) -> Path:
    (folder / "a.gltf").write_text(json.dumps(document))
    return folder / "a.gltf"


def extension(document: dict[str, Any]) -> dict[str, Any]:
    return document["meshes"][0]["primitives"][0]["extensions"]["KHR_gaussian_splatting"]


def attributes(document: dict[str, Any]) -> dict[str, int]:
    return document["meshes"][0]["primitives"][0]["attributes"]


@pytest.mark.parametrize("suffix", ["gltf", "glb"])
def test_conformance_matrix(shared_data: Path, suffix: str) -> None:
    """Fifteen primitives in all component types, from two tests of what scales may be."""
    with pytest.warns(SplatWarning, match="14 of 15 Gaussians have linear colours"):
        g = read_splats(shared_data / "splats" / f"khr_conformance_matrix.{suffix}")
    assert g.means.tolist() == [[1, 2, 3]] * 15
    assert g.rotations.tolist() == [[0, 1, 0, 0]] * 15  # stored as x, y, z, w
    plain = torch.tensor([0.0, 0.5, -0.5])
    logs = plain.expand(15, 3).clone()
    logs[3] = torch.tensor([0.2, -0.1, 0.7])  # float
    logs[4] = torch.tensor([1.0, -2.0, 3.0])  # bytes as they are
    logs[5] = torch.tensor([1.0, 0.0, -1.0])  # normalised bytes
    logs[6] = torch.tensor([2.0, -3.0, 4.0])  # shorts as they are
    logs[7] = torch.tensor([1.0, 0.0, -1.0])  # normalised shorts
    torch.testing.assert_close(g.scales, logs.exp())
    opacities = torch.full((15,), 0.25)
    opacities[8:11] = torch.tensor([0.75, 64 / 255, 16384 / 65535])
    torch.testing.assert_close(g.opacities, opacities)
    assert g.sh_degree == 3
    torch.testing.assert_close(g.sh[:, 0], torch.tensor([0.1, 0.2, 0.3]).expand(15, 3))
    assert [int(row.any(dim=1).sum()) for row in g.sh[11:]] == [1, 4, 9, 16]
    torch.testing.assert_close(g.sh[14, 1:4, 0], torch.tensor([1.1, 2.1, 3.1]))
    marks = g.extra[LINEAR_COLOUR].tolist()
    assert marks == [1, 1, 1, 0, *[1] * 11]


COMPONENTS = {np.int8: 5120, np.uint8: 5121, np.int16: 5122, np.uint16: 5123}


def stored_as(document: dict[str, Any], name: str, rows: list, dtype: type, *, unit: bool) -> None:
    """Let an attribute be of integers, each row on a boundary of four bytes."""
    array = np.array(rows, dtype)
    stride = -(-array.itemsize * array.shape[1] // 4) * 4
    data = b"".join(row.tobytes().ljust(stride, b"\0") for row in array)
    uri = "data:application/octet-stream;base64," + base64.b64encode(data).decode()
    document["buffers"].append({"byteLength": len(data), "uri": uri})
    document["bufferViews"].append(
        {"buffer": len(document["buffers"]) - 1, "byteLength": len(data), "byteStride": stride}
    )
    accessor = document["accessors"][attributes(document)[f"KHR_gaussian_splatting:{name}"]]
    accessor.pop("byteOffset", None)
    accessor |= {"bufferView": len(document["bufferViews"]) - 1}
    accessor |= {"componentType": COMPONENTS[dtype], "normalized": unit}


@pytest.mark.parametrize(
    ("name", "dtype", "unit", "rows", "values"),
    [
        ("SCALE", np.int8, False, [[1, -2, 3]], [[1.0, -2, 3]]),
        ("SCALE", np.int16, False, [[2, -3, 4]], [[2.0, -3, 4]]),
        ("SCALE", np.int8, True, [[127, 0, -128]], [[1.0, 0, -1]]),
        ("SCALE", np.int16, True, [[32767, 0, -32768]], [[1.0, 0, -1]]),
        ("OPACITY", np.uint8, True, [[64]], [[64 / 255]]),
        ("OPACITY", np.uint16, True, [[16384]], [[16384 / 65535]]),
        ("ROTATION", np.int8, True, [[0, 127, 0, 0]], [[0.0, 1, 0, 0]]),
        ("ROTATION", np.int16, True, [[0, 0, 0, -32767]], [[0.0, 0, 0, -1]]),
    ],
)
def test_component_types(golden: Path, tmp_path: Path, name, dtype, unit, rows, values) -> None:
    document = draft(golden)
    stored_as(document, name, rows * 3, dtype, unit=unit)
    g, want = read_splats(written(tmp_path, document)), torch.tensor(values * 3)
    if name == "SCALE":
        torch.testing.assert_close(g.scales.log(), want)
    elif name == "OPACITY":
        torch.testing.assert_close(g.opacities, want[:, 0])
    else:
        assert torch.equal(g.rotations, want[:, [3, 0, 1, 2]])  # stored as x, y, z, w


def test_unknown_kernels_and_colour_spaces_are_told(golden: Path, tmp_path: Path) -> None:
    document, plain = draft(golden), read_splats(golden / "three.draft.gltf")
    extension(document).update(kernel="customShape", colorSpace="custom_space_display")
    with pytest.warns(SplatWarning) as caught:
        g = read_splats(written(tmp_path, document))
    messages = " ".join(str(warning.message) for warning in caught)
    assert "the kernel 'customShape' is not known" in messages
    assert "the colour space 'custom_space_display' is not known" in messages
    assert torch.equal(g.sh, plain.sh)


def test_unknown_kernel_and_colour_space_fall_back(shared_data: Path) -> None:
    with pytest.warns(SplatWarning) as caught:
        g = read_splats(shared_data / "splats" / "khr_extensible_fallback.gltf")
    messages = " ".join(str(warning.message) for warning in caught)
    assert "the kernel 'customShape' is not known" in messages
    assert "the colour space 'custom_space_display' is not known" in messages
    assert g.opacities.tolist() == [0.5]
    assert g.scales.tolist() == [[1, 1, 1]]  # logs: linear zeros could not be seen
    torch.testing.assert_close(g.colours, torch.tensor([[0.282095, 0.56419, 0.846285]]))


def test_colour_0_is_linear(golden: Path, tmp_path: Path) -> None:
    """The fallback colour is decoded from sRGB by the writer, so it is encoded again here."""
    document = draft(golden)
    table = attributes(document)
    degree_0 = table.pop("KHR_gaussian_splatting:SH_DEGREE_0_COEF_0")
    for k in range(3):
        table.pop(f"KHR_gaussian_splatting:SH_DEGREE_1_COEF_{k}")
    table["COLOR_0"] = degree_0
    linear = torch.tensor([[0.5, 0.0, 0.25], [0.0, 1.0, 0.0], [0.0, 0.75, 1.0]])  # clamped
    want = torch.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    torch.testing.assert_close(read_splats(written(tmp_path, document)).colours, want)


def test_nodes_move_turn_and_scale(golden: Path, tmp_path: Path) -> None:
    """A chain of nodes, one by parts and one by matrix, and the mesh shown twice."""
    document = draft(golden)
    turn = [0.5, -0.5, 0.5, 0.5]  # x, y, z, w
    matrix = np.array([[0, -2, 0, 1], [2, 0, 0, 0], [0, 0, 2, -3], [0, 0, 0, 1]], float)
    document["nodes"] = [
        {"translation": [1, 2, 3], "rotation": turn, "scale": [3, 3, 3], "children": [2]},
        {"mesh": 0},
        {"mesh": 0, "matrix": matrix.T.ravel().tolist()},
    ]
    document["scenes"][0]["nodes"] = [1, 0]
    still = read_splats(golden / "three.draft.gltf")
    both = read_splats(written(tmp_path, document))
    assert torch.equal(both[:3].means, still.means)
    outer = Similarity(
        rotation=rotation_from_quaternion(torch.tensor([0.5, 0.5, -0.5, 0.5]).double()),
        translation=torch.tensor([1.0, 2.0, 3.0]).double(),
        scale=3.0,
    )
    inner = Similarity(
        rotation=torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]).double(),
        translation=torch.tensor([1.0, 0.0, -3.0]).double(),
        scale=2.0,
    )
    want = still.transformed(outer.compose(inner))
    moved = both[3:]
    torch.testing.assert_close(moved.means, want.means, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(moved.scales, want.scales, rtol=1e-5, atol=0)
    torch.testing.assert_close(moved.sh, want.sh, rtol=1e-5, atol=1e-5)
    sign = (moved.rotations * want.rotations).sum(dim=1, keepdim=True).sign()
    torch.testing.assert_close(moved.rotations * sign, want.rotations, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    "node",
    [
        {"scale": [1, 2, 1]},
        {"scale": [-1, 1, 1]},
        {"scale": [0, 0, 0]},
        {"matrix": [1, 0, 0, 0, 0.5, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]},
        {"matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 2]},
    ],
)
def test_nodes_that_shear_or_mirror(golden: Path, tmp_path: Path, node: dict[str, Any]) -> None:
    document = draft(golden)
    document["nodes"] = [{"mesh": 0} | node]
    with pytest.raises(FileFormatError, match="expected nodes that move, turn and scale alike"):
        read_splats(written(tmp_path, document))


def test_scenes_choose_what_is_read(golden: Path, tmp_path: Path) -> None:
    document = draft(golden)
    document["nodes"] = [{"mesh": 0, "translation": [i, 0, 0]} for i in range(3)]
    document["nodes"][0]["children"] = [2]
    document["scenes"] = [{"nodes": [0]}, {"nodes": [1]}]
    document["scene"] = 1
    assert len(read_splats(written(tmp_path, document))) == 3
    del document["scene"]
    assert len(read_splats(written(tmp_path, document))) == 6
    del document["scenes"]
    assert len(read_splats(written(tmp_path, document))) == 9


def test_other_meshes_are_passed_over(golden: Path, tmp_path: Path) -> None:
    document = draft(golden)
    document["meshes"].append({"primitives": [{"attributes": {"POSITION": 0}}]})
    document["nodes"].append({"mesh": 1})
    document["scenes"][0]["nodes"] = [1, 0]
    assert len(read_splats(written(tmp_path, document))) == 3


def test_linear_scales(golden: Path, tmp_path: Path) -> None:
    """Ratified files: linear float scales, told by that none is negative; also as bytes."""
    document = draft(golden)
    index = attributes(document)["KHR_gaussian_splatting:SCALE"]
    document["accessors"][index] |= {"componentType": 5121, "normalized": True}
    document["buffers"].append({"uri": "scales.bin", "byteLength": 12})
    document["bufferViews"].append({"buffer": 1, "byteLength": 12, "byteStride": 4})
    document["accessors"][index]["bufferView"] = len(document["bufferViews"]) - 1
    (tmp_path / "scales.bin").write_bytes(bytes([255, 51, 0, 9] * 3))
    g = read_splats(written(tmp_path, document))
    torch.testing.assert_close(g.scales, torch.tensor([1, 0.2, 0.0]).expand(3, 3))


def test_signed_scales_are_logs(golden: Path, tmp_path: Path) -> None:
    """Also where none is negative: only drafts had signed types."""
    document = draft(golden)
    index = attributes(document)["KHR_gaussian_splatting:SCALE"]
    document["accessors"][index]["componentType"] = 5120
    document["buffers"].append({"uri": "scales.bin", "byteLength": 9})
    document["bufferViews"].append({"buffer": 1, "byteLength": 9})
    document["accessors"][index]["bufferView"] = len(document["bufferViews"]) - 1
    (tmp_path / "scales.bin").write_bytes(bytes([1, 2, 0] * 3))
    logs = read_splats(written(tmp_path, document)).scales.log()
    torch.testing.assert_close(logs, torch.tensor([1.0, 2.0, 0.0]).expand(3, 3))


def test_buffers_in_files_beside(golden: Path, tmp_path: Path) -> None:
    document = draft(golden)
    data = read_buffer(document)
    (tmp_path / "a b.bin").write_bytes(data)
    document["buffers"][0]["uri"] = "a%20b.bin"
    assert len(read_splats(written(tmp_path, document))) == 3
    document["buffers"][0]["uri"] = "c.bin"
    with pytest.raises(MissingFileError, match=r"a file 'c\.bin', which a\.gltf names, got none"):
        read_splats(written(tmp_path, document))
    for uri in ("../x.bin", "/etc/hostname", "file:///etc/hostname", "https://host/x", "C:x"):
        document["buffers"][0]["uri"] = uri
        with pytest.raises(FileFormatError, match="expected the name of a file in its folder"):
            read_splats(written(tmp_path, document))


def read_buffer(document: dict[str, Any]) -> bytes:
    import base64

    return base64.b64decode(document["buffers"][0]["uri"].partition(",")[2])


def set_in(*path: str | int, value: object) -> Change:
    """A change of one member of the document."""

    def change(document: Any) -> None:
        for name in path[:-1]:
            document = document[name]
        document[path[-1]] = value

    return change


SCALE = "KHR_gaussian_splatting:SCALE"
REST = "KHR_gaussian_splatting:SH_DEGREE_1_COEF_1"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.pop("asset"), "expected a field asset"),
        (set_in("asset", "version", value="1.0"), "expected glTF version 2"),
        (
            set_in("extensionsRequired", value=["EXT_meshopt_compression"]),
            "needs the glTF extension 'EXT_meshopt_compression'",
        ),
        (lambda d: d["meshes"][0]["primitives"][0].pop("extensions"), "got a glTF without"),
        (set_in("meshes", 0, "primitives", 0, "mode", value=4), "points .mode 0."),
        (set_in("scenes", 0, "nodes", value=[]), "got a glTF without"),
        (set_in("scenes", 0, "nodes", value=[0, 0]), "this one has two parents"),
        (set_in("scenes", 0, "nodes", value=[7]), "expected a list nodes with an element 7, got 1"),
        (
            set_in("scenes", 0, "nodes", value=[-1]),
            "scenes\\[0\\].nodes\\[0\\]: expected .*, got -1",
        ),
        (set_in("nodes", 0, "children", value=[0]), "this one has two parents"),
        (set_in("nodes", 0, "rotation", value=[0, 0, 0, 0]), "a quaternion that is not zero"),
        (lambda d: attributes(d).pop(SCALE), "the attribute SCALE of Gaussians, got none"),
        (lambda d: attributes(d).pop("POSITION"), "the attribute POSITION of Gaussians"),
        (lambda d: attributes(d).pop(REST), "got 2 of 3 of degree 1 after degree 0"),
        (
            lambda d: attributes(d).pop("KHR_gaussian_splatting:SH_DEGREE_0_COEF_0"),
            "expected SH_DEGREE_0_COEF_0 or COLOR_0",
        ),
        (
            lambda d: attributes(d).update({"KHR_gaussian_splatting:SH_DEGREE_2_COEF_0": 0}),
            "got 1 of 5 of degree 2 after degree 1",
        ),
        (lambda d: extension(d).pop("kernel"), "expected a field kernel"),
        (
            set_in("accessors", 0, "componentType", value=5130),
            "a component type and shape of glTF, got 5130",
        ),
        (
            set_in("accessors", 0, "type", value="MAT4"),
            "a component type and shape of glTF, .*MAT4",
        ),
        (set_in("accessors", 1, "type", value="VEC3"), r"shape \(3, 4\) of the attribute ROTATION"),
        (set_in("accessors", 0, "count", value=2), r"expected the shape \(2, 4\)"),
        (
            set_in("accessors", 0, "count", value=10**12),
            "1000000000000 Gaussians, which is 236000 GB",
        ),
        (set_in("accessors", 0, "sparse", value={}), "got a sparse accessor"),
        (lambda d: d["accessors"][0].pop("bufferView"), "compressed or empty accessor"),
        (set_in("accessors", 0, "byteOffset", value=4), "accessors.0.: expected 40 bytes"),
        (set_in("bufferViews", 0, "byteStride", value=8), "one row each 8 bytes"),
        (set_in("bufferViews", 0, "byteOffset", value=10**9), "at byte 1000000000 of"),
        (set_in("buffers", 0, "byteLength", value=10**9), "truncated"),
        (lambda d: d["buffers"][0].pop("uri"), "expected a uri, or buffer 0 of a .glb"),
        (set_in("buffers", 0, "uri", value="data:,abc"), "expected a data URI in base64"),
        (set_in("buffers", 0, "uri", value="data:a;base64,%%%"), "expected a data URI in base64"),
    ],
)
def test_what_is_wrong_is_named(golden: Path, tmp_path: Path, change: Change, message: str) -> None:
    document = draft(golden)
    change(document)
    path = written(tmp_path, document)
    with pytest.raises(FileFormatError, match=message) as caught:
        read_splats(path)
    assert str(caught.value).startswith(f"{path}: ")


def test_values_out_of_range(golden: Path, tmp_path: Path) -> None:
    """An opacity above 1 and, with signed scales in no other place, a negative linear one."""
    path = tmp_path / "a.glb"
    data = bytearray((golden / "three.glb").read_bytes())
    opacities = data.index(struct.pack("<f", 51 / 255))
    struct.pack_into("<f", data, opacities, 1.5)
    path.write_bytes(data)
    with pytest.raises(FileFormatError, match=r"1 of 3 Gaussians have an opacity outside \[0, 1\]"):
        read_splats(path)


def test_glb_headers(golden: Path, tmp_path: Path) -> None:
    path = tmp_path / "a.glb"
    whole = (golden / "three.glb").read_bytes()

    def edited(at: int, value: int, message: str) -> None:
        data = bytearray(whole)
        struct.pack_into("<I", data, at, value)
        path.write_bytes(data)
        with pytest.raises(FileFormatError, match=message):
            read_splats(path)

    edited(4, 1, "expected .glb version 2, got 1")
    edited(8, 12, "expected 12 bytes as its header says")
    edited(12, 10**9, "a part of 1000000000 bytes at byte 12, got a truncated one")
    edited(16, 0, "expected a JSON part")
    path.write_bytes(b"glTF\2\0")
    with pytest.raises(FileFormatError, match=r"a \.glb header of 12 bytes, got 6"):
        read_splats(path)
