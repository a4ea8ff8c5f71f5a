"""Splat files as other programs write them, made here by plain code.

Cases after reports of users of other tools: supersplat 189, 360 and 975, UnityGaussianSplatting
179, and the files that Mip-Splatting, 2DGS and exporters of parameters write.
"""

import gzip
import json
import math
import struct
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
import torch

from splatseg.core import Gaussians
from splatseg.errors import FileFormatError, InputError
from splatseg.io.captures import read_start_points
from splatseg.io.splats import (
    SplatWarning,
    read_scene_splats,
    read_splats,
    splat_format,
    write_splats,
)
from splatseg.io.splats._rows import SOURCE_ROW

Columns = dict[str, list[float]]
_KINDS = {"float": "f", "double": "d", "uchar": "B", "ushort": "H", "int": "i", "uint": "I"}
COUNT = 40
MEANS = ("x", "y", "z")


def columns(count: int = COUNT) -> Columns:
    """Values of no pattern, in float32: row i of column c is a sine of both."""
    names = [*"xyz", *(f"f_dc_{i}" for i in range(3)), "opacity"]
    names += [*(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    made = {n: [math.sin(7.3 * c + 1.7 * i) for i in range(count)] for c, n in enumerate(names)}
    for i in range(3):
        made[f"scale_{i}"] = [value - 4 for value in made[f"scale_{i}"]]
    made["opacity"] = [3 * value for value in made["opacity"]]
    return {n: [struct.unpack("<f", struct.pack("<f", v))[0] for v in c] for n, c in made.items()}


def write_ply(
    path: Path,
    made: Columns,
    *,
    ascii: bool = False,
    kinds: dict[str, str] | None = None,
    end: str = "\n",
    before: str = "",
    after: str = "",
    tail: bytes = b"",
) -> Path:
    """A PLY file of these columns; `before` and `after` are lines around its element."""
    kinds = dict.fromkeys(made, "float") | (kinds or {})
    rows = list(zip(*made.values(), strict=True))
    order = "ascii" if ascii else "binary_little_endian"
    lines = ["ply", f"format {order} 1.0", "comment of another program", *before.splitlines()]
    lines += [f"element vertex {len(rows)}", *(f"property {kinds[n]} {n}" for n in made)]
    lines += [*after.splitlines(), "end_header", ""]
    if ascii:
        body = "".join(" ".join(repr(v) for v in row) + end for row in rows).encode()
    else:
        layout = struct.Struct("<" + "".join(_KINDS[kinds[name]] for name in made))
        body = b"".join(layout.pack(*row) for row in rows)
    path.write_bytes(end.join(lines).encode() + body + tail)
    return path


def told(path: Path, **asked: object) -> tuple[Gaussians, str]:
    """The Gaussians of a file, and all that was said of it."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        read = read_splats(path, **asked)  # type: ignore[arg-type]
    assert all(issubclass(warning.category, SplatWarning) for warning in caught)
    return read, "\n".join(str(warning.message) for warning in caught)


def same(a: Gaussians, b: Gaussians) -> bool:
    names = ("means", "rotations", "scales", "opacities", "sh")
    return all(torch.equal(getattr(a, name), getattr(b, name)) for name in names)


@pytest.fixture
def usual(tmp_path: Path) -> Gaussians:
    """The columns as 3DGS writes them."""
    return read_splats(write_ply(tmp_path / "usual.ply", columns()))


@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_ascii(tmp_path: Path, usual: Gaussians, end: str) -> None:
    made = columns() | {"kind": list(range(COUNT)), "tall": [70000.0] * COUNT}
    kinds = {"kind": "uchar", "tall": "int", "x": "double"}
    read, said = told(write_ply(tmp_path / "a.ply", made, ascii=True, kinds=kinds, end=end))
    assert same(read, usual)
    assert said == ""
    assert read.extra["kind"].dtype == torch.uint8
    assert read.extra["kind"].tolist() == list(range(COUNT))
    assert read.extra["tall"].dtype == torch.int32


def test_ascii_with_other_elements_and_empty_lines(tmp_path: Path, usual: Gaussians) -> None:
    path = write_ply(
        tmp_path / "a.ply",
        columns(),
        ascii=True,
        before="element camera 1\nproperty float f\nproperty list uchar int ids",
        after="element face 1\nproperty list uchar int vertex_indices",
        tail=b"\n  \n3 0 1 2\n",
    )
    head, _, body = path.read_bytes().partition(b"end_header\n")
    path.write_bytes(head + b"end_header\n0.5 2 7 8\n\n" + body)
    assert same(read_splats(path), usual)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (
            lambda body: body[: body.rindex(b"\n", 0, -1) + 1],
            "40 rows of 'vertex', got 39",
        ),
        (lambda body: body + b"1 2 3\n", "expected the end of the file .*, got 1 lines more"),
        (lambda body: body.replace(b" ", b" one ", 1), "expected 40 rows of 14 numbers"),
        (lambda body: body.replace(b" ", b" 1 ", 1), "expected 40 rows of 14 numbers"),
        (lambda body: b"", "expected 40 rows of 'vertex', got 0"),
    ],
)
def test_ascii_that_is_damaged(
    tmp_path: Path, damage: Callable[[bytes], bytes], message: str
) -> None:
    path = write_ply(tmp_path / "a.ply", columns(), ascii=True)
    head, mark, body = path.read_bytes().partition(b"end_header\n")
    path.write_bytes(head + mark + damage(body))
    with pytest.raises(FileFormatError, match=message):
        read_splats(path)


@pytest.mark.parametrize("value", ["300", "-1", "1.5", "nan"])
def test_ascii_integers_fit_their_type(tmp_path: Path, value: str) -> None:
    path = write_ply(
        tmp_path / "a.ply", {"kind": [77] * COUNT} | columns(), ascii=True, kinds={"kind": "uchar"}
    )
    head, mark, body = path.read_bytes().partition(b"end_header\n")
    path.write_bytes(head + mark + body.replace(b"77 ", f"{value} ".encode(), 1))
    with pytest.raises(FileFormatError, match="'kind' has a value that its type has not"):
        read_splats(path)


def test_ascii_of_many_rows_is_read_in_blocks(tmp_path: Path) -> None:
    """More rows than one block has."""
    made = columns(9000)
    read = read_splats(write_ply(tmp_path / "a.ply", made, ascii=True))
    assert same(read, read_splats(write_ply(tmp_path / "b.ply", made)))


def test_surfels_of_2dgs(tmp_path: Path, usual: Gaussians) -> None:
    made = columns()
    del made["scale_2"]
    read, said = told(write_ply(tmp_path / "a.ply", made))
    assert "surfels of 2DGS" in said
    assert "0.001 times" in said
    assert torch.equal(read.scales[:, :2], usual.scales[:, :2])
    thin = read.scales[:, 2] / usual.scales[:, :2].amin(dim=1)
    np.testing.assert_allclose(thin, 1e-3, rtol=1e-6)
    covariance = torch.diag_embed(read.scales**2)
    assert (torch.linalg.matrix_rank(covariance, rtol=1e-7) == 3).all()
    write_splats(read, tmp_path / "b.ply")
    back, nothing = told(tmp_path / "b.ply")
    assert nothing == ""
    np.testing.assert_allclose(back.scales, read.scales, rtol=1e-6)


OTHER_NAMES = {
    "gsplat": {
        **{f"scale_{i}": f"scales_{i}" for i in range(3)},
        **{f"rot_{i}": f"quats_{i}" for i in range(4)},
        "opacity": "opacities",
        **{f"f_dc_{i}": f"sh0_{i}" for i in range(3)},
        **{axis: f"means_{i}" for i, axis in enumerate("xyz")},
    },
    "parameters of 3DGS": {
        **{f"scale_{i}": f"scaling_{i}" for i in range(3)},
        **{f"rot_{i}": f"rotation_{i}" for i in range(4)},
        **{f"f_dc_{i}": f"features_dc_{i}" for i in range(3)},
        **{axis: f"xyz_{i}" for i, axis in enumerate("xyz")},
    },
    "letters": {
        **{f"scale_{i}": f"scale_{axis}" for i, axis in enumerate("xyz")},
        **{f"rot_{i}": f"q{axis}" for i, axis in enumerate("wxyz")},
        "opacity": "alpha",
    },
}


@pytest.mark.parametrize("program", OTHER_NAMES)
def test_other_names(tmp_path: Path, usual: Gaussians, program: str) -> None:
    names = OTHER_NAMES[program]
    made = {names.get(name, name): values for name, values in columns().items()}
    read, said = told(write_ply(tmp_path / "a.ply", dict(reversed(made.items()))))
    assert same(read, usual)
    assert not read.extra
    for ours, theirs in names.items():
        assert theirs in said, "what was taken for what is said"
        assert ours in said


def test_quaternions_whose_names_tell_their_order(tmp_path: Path, usual: Gaussians) -> None:
    made = columns()
    turned = {f"q{axis}": made.pop(f"rot_{i}") for i, axis in ((1, "x"), (2, "y"), (3, "z"))}
    turned["qw"] = made.pop("rot_0")
    assert same(told(write_ply(tmp_path / "a.ply", made | turned))[0], usual)


def test_names_of_3dgs_come_first(tmp_path: Path, usual: Gaussians) -> None:
    """A file that has both keeps the others as columns."""
    made = columns() | {name: [9.0] * COUNT for name in ("red", "green", "blue", "alpha")}
    made |= {f"quats_{i}": [0.0] * COUNT for i in range(4)}
    read, said = told(write_ply(tmp_path / "a.ply", made))
    assert same(read, usual)
    assert said == ""
    assert len(read.extra) == 8


def test_colours_instead_of_harmonics(tmp_path: Path) -> None:
    made = columns()
    for i in range(3):
        del made[f"f_dc_{i}"]
    del made["opacity"]
    made |= {"red": [255] * COUNT, "green": [0] * COUNT, "blue": [51] * COUNT}
    made |= {"alpha": [204] * COUNT}
    kinds = dict.fromkeys(("red", "green", "blue", "alpha"), "uchar")
    read, said = told(write_ply(tmp_path / "a.ply", made, kinds=kinds))
    np.testing.assert_allclose(read.colours, [[1, 0, 0.2]] * COUNT, atol=1e-6)
    np.testing.assert_allclose(read.opacities, 0.8, rtol=1e-6)
    assert "red green blue as f_dc_0 f_dc_1 f_dc_2" in said


def rest(count: int, prefix: str = "f_rest") -> Columns:
    return {f"{prefix}_{c}": [math.cos(i * c) for i in range(COUNT)] for c in range(count)}


@pytest.mark.parametrize("prefix", ["features_rest", "shN"])
def test_harmonics_of_unknown_order_are_kept_as_columns_and_said(
    tmp_path: Path, usual: Gaussians, prefix: str
) -> None:
    read, said = told(write_ply(tmp_path / "a.ply", columns() | rest(9, prefix)))
    assert same(read, usual)
    assert len(read.extra) == 9
    assert f"{prefix}_0 and others look like harmonics" in said


def test_names_of_cloudcompare(tmp_path: Path) -> None:
    ours = columns() | rest(9) | {"filter_3D": [0.01] * COUNT}
    theirs = {n if n in MEANS else f"scalar_{n}": values for n, values in ours.items()}
    want = told(write_ply(tmp_path / "a.ply", ours))[0]
    read, said = told(write_ply(tmp_path / "b.ply", theirs))
    assert want.sh_degree == 1
    assert same(read, want)
    assert not read.extra
    assert "scalar_f_rest_0 as f_rest_0" in said
    del theirs["scalar_scale_2"]
    assert "surfels" in told(write_ply(tmp_path / "c.ply", theirs))[1]


def test_degree_4_is_left_out_and_said(tmp_path: Path) -> None:
    """Of 24 coefficients a channel the first 15 are those of degrees 1 to 3."""
    made = rest(72)
    first = [f"f_rest_{24 * channel + i}" for channel in range(3) for i in range(15)]
    renamed = {f"f_rest_{i}": made[name] for i, name in enumerate(first)}
    want = read_splats(write_ply(tmp_path / "a.ply", columns() | renamed))
    path = write_ply(tmp_path / "b.ply", columns() | made)
    read, said = told(path)
    assert same(read, want)
    assert not read.extra
    assert "harmonics of degree 4, of which those up to 3 are rendered" in said
    with pytest.raises(FileFormatError, match="harmonics of degree 4"):
        read_splats(path, strict=True)


def test_degree_4_of_spz(tmp_path: Path) -> None:
    def spz(degree: int) -> Path:
        count = (degree + 1) ** 2 - 1
        body = bytes(9) + bytes([255, 9, 8, 7, 90, 91, 92, 128, 128, 128])
        body += bytes(range(100, 100 + 3 * min(count, 15))) + bytes(3 * max(count - 15, 0))
        head = struct.pack("<4sIIBBBB", b"NGSP", 2, 1, degree, 12, 0, 0)
        path = tmp_path / f"{degree}.spz"
        path.write_bytes(gzip.compress(head + body))
        return path

    read, said = told(spz(4))
    assert same(read, read_splats(spz(3)))
    assert "harmonics of degree 4" in said
    with pytest.raises(FileFormatError, match="harmonics of degree 4"):
        read_splats(spz(4), strict=True)


@pytest.mark.parametrize(
    ("comments", "antialiased"),
    [
        (["SplatRenderMode: mip"], True),
        (["SPLATRENDERMODE:  Mip"], True),
        (["SplatRenderMode: default"], False),
        (["antialiased 1"], True),
        (["antialiased 0"], False),
        (["antialiased 1", "SplatRenderMode: default"], False),
        (["SplatRenderMode: mip", "antialiased 0"], False),
        (["SH degree: 0", "Exported from Brush"], False),
    ],
)
def test_comments_of_brush_and_postshot(
    tmp_path: Path, comments: list[str], antialiased: bool
) -> None:
    before = "\n".join(f"comment {line}" for line in comments)
    read, said = told(write_ply(tmp_path / "a.ply", columns(), before=before))
    assert read.antialiased is antialiased
    assert said == ""


@pytest.mark.parametrize(
    "names", [("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue")]
)
def test_colours_of_other_names(tmp_path: Path, names: tuple[str, ...]) -> None:
    made = columns()
    for i in range(3):
        made[names[i]] = [(0.0, 0.5, 1.0)[i]] * COUNT
        del made[f"f_dc_{i}"]
    path = write_ply(tmp_path / "a.ply", made)
    np.testing.assert_allclose(told(path)[0].colours, [[0, 0.5, 1]] * COUNT, atol=1e-6)
    made[names[1]] = [200.0] * COUNT
    with pytest.raises(FileFormatError, match=rf"real colours {names[0]} .* in \[0, 1\]"):
        read_splats(write_ply(tmp_path / "a.ply", made))


@pytest.mark.parametrize("lengths", [(3, 3), (3, 5)])
def test_lists_before_gaussians_are_stepped_over(
    tmp_path: Path, usual: Gaussians, lengths: tuple[int, int]
) -> None:
    path = write_ply(
        tmp_path / "a.ply",
        columns(),
        before="element camera 1\nproperty ushort f\n"
        "element face 2\nproperty uchar kind\nproperty list uchar int indices",
    )
    faces = b"\1\2" + b"".join(struct.pack(f"<BB{n}i", 7, n, *range(n)) for n in lengths)
    head, mark, body = path.read_bytes().partition(b"end_header\n")
    path.write_bytes(head + mark + faces + body)
    assert same(read_splats(path), usual)
    path.write_bytes(head + mark + faces + body[:-1])
    with pytest.raises(FileFormatError, match="the file ends early"):
        read_splats(path)
    path.write_bytes(head + mark + faces[:5])
    with pytest.raises(FileFormatError, match="a.ply"):
        read_splats(path)


def test_filter_3d_of_mip_splatting(tmp_path: Path, usual: Gaussians) -> None:
    widths = [0.0, *(0.01 * i for i in range(1, COUNT))]
    read, said = told(write_ply(tmp_path / "a.ply", columns() | {"filter_3D": widths}))
    assert "3D filter of Mip-Splatting" in said
    assert "filter_3D" not in read.extra, "else it would be applied again when read again"
    for i, width in enumerate(widths):
        scales = [float(s) for s in usual.scales[i]]
        smooth = [math.sqrt(s * s + width * width) for s in scales]
        share = math.prod(s * s for s in scales) / math.prod(s * s for s in smooth)
        np.testing.assert_allclose(read.scales[i], smooth, rtol=1e-5)
        np.testing.assert_allclose(
            float(read.opacities[i]), float(usual.opacities[i]) * math.sqrt(share), rtol=1e-5
        )
    write_splats(read, tmp_path / "b.ply")
    again, nothing = told(tmp_path / "b.ply")
    assert nothing == ""
    np.testing.assert_allclose(again.scales, read.scales, rtol=1e-6)


def test_a_scene_of_splatseg_keeps_its_columns(tmp_path: Path, usual: Gaussians) -> None:
    """There `filter_3D` is a column that somebody kept, and nothing is doubted."""
    path = write_ply(tmp_path / "a.ply", columns() | {"filter_3D": [0.5] * COUNT})
    read = read_scene_splats(path)
    assert same(read, usual)
    assert list(read.extra) == ["filter_3D"]


@pytest.mark.parametrize(
    ("name", "value"), [("x", math.nan), ("f_dc_1", math.inf), ("scale_2", -math.inf),
                        ("rot_0", math.nan), ("opacity", math.nan)],
)  # fmt: skip
def test_rows_that_cannot_be_rendered(tmp_path: Path, usual: Gaussians, name: str, value: float):
    made = columns() | {"kind": list(range(COUNT))}
    made[name][3::7] = [value] * len(made[name][3::7])
    path = write_ply(tmp_path / "a.ply", made, kinds={"kind": "uchar"})
    kept = [i for i in range(COUNT) if (i - 3) % 7]
    read, said = told(path)
    assert same(read, usual[torch.tensor(kept)])
    assert read.extra["kind"].tolist() == kept
    assert read.extra[SOURCE_ROW].tolist() == kept
    assert f"{COUNT - len(kept)} of {COUNT} Gaussians hold values" in said
    assert "the first is row 3" in said
    for refuse in (lambda: read_splats(path, strict=True), lambda: read_scene_splats(path)):
        with pytest.raises(FileFormatError, match=rf"^{path}: 6 of 40 Gaussians hold"):
            refuse()


def test_rotations_of_length_zero_are_left_out_too(tmp_path: Path) -> None:
    made = columns()
    for i in range(4):
        made[f"rot_{i}"][5] = 0.0
    made["y"][6] = math.nan
    read, said = told(write_ply(tmp_path / "a.ply", made))
    assert len(read) == COUNT - 2
    assert "1 of 40 Gaussians hold values" in said
    assert "1 of 40 Gaussians have a rotation of length zero; the first is row 5" in said


def test_nothing_left_is_refused(tmp_path: Path) -> None:
    made = columns() | {"x": [math.nan] * COUNT}
    with pytest.raises(FileFormatError, match="40 of 40 Gaussians hold values"):
        read_splats(write_ply(tmp_path / "a.ply", made))


def test_rows_of_the_first_file_are_told_through_a_second(tmp_path: Path) -> None:
    """What was left out stays said in what is written and loses rows once more."""
    made = columns()
    made["z"][0] = made["z"][10] = math.nan
    write_splats(told(write_ply(tmp_path / "a.ply", made))[0], tmp_path / "b.ply")
    data = bytearray((tmp_path / "b.ply").read_bytes())
    struct.pack_into("<f", data, data.index(b"end_header\n") + 11, math.nan)
    (tmp_path / "b.ply").write_bytes(data)
    assert told(tmp_path / "b.ply")[0].extra[SOURCE_ROW].tolist() == [
        i for i in range(2, COUNT) if i != 10
    ]


def test_other_formats_lose_rows_alike(tmp_path: Path, usual: Gaussians) -> None:
    write_splats(usual, tmp_path / "a.splat")
    data = bytearray((tmp_path / "a.splat").read_bytes())
    struct.pack_into("<f", data, 32 * 4, math.nan)
    (tmp_path / "a.splat").write_bytes(data)
    read, said = told(tmp_path / "a.splat")
    assert read.extra[SOURCE_ROW].tolist() == [i for i in range(COUNT) if i != 4]
    assert "1 of 40" in said


def test_gltf_of_two_meshes_counts_rows_through(tmp_path: Path, project_root: Path) -> None:
    source = project_root / "tests" / "golden" / "splats" / "three.draft.gltf"
    content = json.loads(source.read_text())
    want = read_splats(source)
    content["nodes"].append(dict(content["nodes"][0]))
    scene = content["scenes"][content.get("scene", 0)]
    scene["nodes"] = [*scene["nodes"], len(content["nodes"]) - 1]
    (tmp_path / "a.gltf").write_text(json.dumps(content))
    for other in source.parent.glob("*.bin"):
        (tmp_path / other.name).write_bytes(other.read_bytes())
    assert len(read_splats(tmp_path / "a.gltf")) == len(want) + 3
    assert not read_splats(tmp_path / "a.gltf").extra


def test_a_folder_that_3dgs_trained_in(tmp_path: Path, usual: Gaussians) -> None:
    """By the number of the iteration, not by its spelling."""
    for name, count in (("7000", 3), ("30000", COUNT), ("x", 2)):
        folder = tmp_path / f"model/point_cloud/iteration_{name}"
        folder.mkdir(parents=True)
        write_ply(folder / "point_cloud.ply", {n: v[:count] for n, v in columns().items()})
    assert splat_format(tmp_path / "model") == "ply"
    read, said = told(tmp_path / "model")
    assert same(read, usual)
    assert "of which point_cloud/iteration_30000/point_cloud.ply was read" in said
    with pytest.raises(FileFormatError, match="a folder without the meta.json of SOG or"):
        read_splats(tmp_path)


@pytest.mark.parametrize("linear", [["scales"], ["opacities"], ["scales", "opacities"]])
def test_values_that_are_no_logs(tmp_path: Path, usual: Gaussians, linear: Sequence[str]) -> None:
    made = columns()
    if "scales" in linear:
        for i in range(3):
            made[f"scale_{i}"] = [math.exp(value) for value in made[f"scale_{i}"]]
    if "opacities" in linear:
        made["opacity"] = [1 / (1 + math.exp(-value)) for value in made["opacity"]]
    path = write_ply(tmp_path / "a.ply", made)
    _, said = told(path)
    assert f"`--linear {' '.join(linear)}` reads them so" in said
    assert ("never logs" in said) == ("scales" in linear)
    assert ("never logits" in said) == ("opacities" in linear)
    read, said = told(path, linear=linear)
    assert said == ""
    np.testing.assert_allclose(read.scales, usual.scales, rtol=1e-5)
    np.testing.assert_allclose(read.opacities, usual.opacities, rtol=1e-5)


def test_few_values_are_not_judged(tmp_path: Path) -> None:
    made = {name: values[:5] for name, values in columns().items()} | {"opacity": [0.5] * 5}
    assert told(write_ply(tmp_path / "a.ply", made))[1] == ""


def test_one_opacity_for_all_is_not_judged(tmp_path: Path) -> None:
    assert told(write_ply(tmp_path / "a.ply", columns() | {"opacity": [0.5] * COUNT}))[1] == ""


def test_linear_is_for_ply(tmp_path: Path, usual: Gaussians) -> None:
    write_splats(usual, tmp_path / "a.splat")
    with pytest.raises(InputError, match="expected a PLY file of 3DGS"):
        read_splats(tmp_path / "a.splat", linear=["scales"])
    with pytest.raises(FileFormatError, match="negative scale"):
        read_splats(tmp_path / "usual.ply", linear=["scales"])


POINTS = {"x": [0.0, 1.0], "y": [0.0, 2.0], "z": [0.0, 3.0]}
COLOURS = {"red": [255, 0], "green": [0, 9], "blue": [0, 8]}


@pytest.mark.parametrize("faces", [False, True])
@pytest.mark.parametrize("coloured", [False, True])
def test_points_and_meshes_say_what_they_are(tmp_path: Path, coloured: bool, faces: bool) -> None:
    made = POINTS | (COLOURS if coloured else {})
    path = write_ply(
        tmp_path / "a.ply",
        made,
        kinds=dict.fromkeys(COLOURS, "uchar"),
        after="element face 1\nproperty list uchar int vertex_indices" if faces else "",
        tail=struct.pack("<B3i", 3, 0, 1, 0) if faces else b"",
    )
    with pytest.raises(FileFormatError) as caught:
        read_splats(path)
    what = ("a mesh" if faces else "points") + (" with colours" if coloured else "")
    assert f"got {what}, no Gaussians (found '{', '.join(made)}')" in str(caught.value)
    assert "`splatseg fit CAPTURE --points a.ply`" in str(caught.value)
    points = read_start_points(path, strict=True)[0].points
    assert points.tolist() == [[0, 0, 0], [1, 2, 3]], "and so it is read"


def test_a_mesh_of_gaussians_is_read(tmp_path: Path, usual: Gaussians) -> None:
    """Programs for meshes write an element of faces, of none."""
    path = write_ply(
        tmp_path / "a.ply", columns(), after="element face 0\nproperty list uchar int indices"
    )
    assert same(read_splats(path), usual)


def test_names_that_were_found_stand_beside_those_that_lack(tmp_path: Path) -> None:
    made = columns()
    made["size"] = made.pop("scale_0")
    with pytest.raises(FileFormatError, match=r"without scale_0, scale_1, scale_2 \(found 'x, y"):
        read_splats(write_ply(tmp_path / "a.ply", made))
