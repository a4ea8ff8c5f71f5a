"""What is written comes back within half a step of the layout, and says so when it cannot."""

import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from splatseg.core import Gaussians
from splatseg.core.sh import evaluate_sh
from splatseg.errors import FileFormatError, InputError, MissingFileError, RangeError
from splatseg.io.splats import SplatWarning, read_splats, write_splats
from splatseg.io.splats.compressed_ply import CHUNK, morton_order
from splatseg.io.splats.spz import _FLIP_SH

Make = Callable[..., Gaussians]


def round_trip(g: Gaussians, folder: Path, name: str, **options: str) -> Gaussians:
    """Write and read; a warning is an error here."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        write_splats(g, folder / name, **options)  # type: ignore[arg-type]
        return read_splats(folder / name)


def assert_within(got: torch.Tensor, want: torch.Tensor, bound: torch.Tensor | float) -> None:
    assert got.shape == want.shape
    error = (got.double() - want.double()).abs()
    assert bool((error <= bound + 1e-6 * want.abs()).all()), float((error - bound).max())


def assert_turned(got: torch.Tensor, want: torch.Tensor, bound: float) -> None:
    """Quaternions up to their sign."""
    sign = (got * want).sum(dim=1, keepdim=True).sign()
    assert_within(got * sign, want, bound)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_ply_keeps_everything(make_splats: Make, tmp_path: Path, degree: int) -> None:
    g = make_splats(20000, degree=degree, extra=True)  # more than one block of rows
    back = round_trip(g, tmp_path, "a.ply")
    assert torch.equal(back.means, g.means)
    assert torch.equal(back.sh, g.sh)
    torch.testing.assert_close(back.scales, g.scales, rtol=1e-6, atol=0)
    torch.testing.assert_close(back.opacities, g.opacities, rtol=1e-6, atol=0)
    torch.testing.assert_close(back.rotations, g.rotations, rtol=0, atol=1e-7)
    assert set(back.extra) == set(g.extra)
    for name, column in g.extra.items():
        assert back.extra[name].dtype == column.dtype, name
        assert torch.equal(back.extra[name], column), name


def test_ply_is_stable(make_splats: Make, tmp_path: Path) -> None:
    """Reading and writing again does not move what the file's float32 can hold."""
    once = round_trip(make_splats(degree=1), tmp_path, "a.ply")
    twice = round_trip(once, tmp_path, "b.ply")
    assert torch.equal(once.rotations, twice.rotations)
    torch.testing.assert_close(twice.scales, once.scales, rtol=1e-6, atol=0)


def test_ply_layout_is_the_original_one(make_splats: Make, tmp_path: Path) -> None:
    """The columns and the order of harmonics that 3DGS viewers look for."""
    g = make_splats(5, degree=1)
    write_splats(g, tmp_path / "a.ply")
    data = (tmp_path / "a.ply").read_bytes()
    end = data.index(b"end_header\n") + 11
    lines = data[:end].decode().splitlines()
    assert lines[:3] == ["ply", "format binary_little_endian 1.0", "element vertex 5"]
    names = [line.removeprefix("property float ") for line in lines[3:-1]]
    rest = [f"f_rest_{i}" for i in range(9)]
    scales_and_rotation = [f"scale_{i}" for i in range(3)] + [f"rot_{i}" for i in range(4)]
    standard = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    assert names == [*standard, *rest, "opacity", *scales_and_rotation]
    rows = np.frombuffer(data, "<f4", offset=end).reshape(5, len(names))
    red_then_green_then_blue = g.sh[:, 1:].transpose(1, 2).reshape(5, 9).numpy()
    np.testing.assert_array_equal(rows[:, 9:18], red_then_green_then_blue)
    opacities = g.opacities.double().numpy()
    np.testing.assert_allclose(rows[:, 18], np.log(opacities / (1 - opacities)), rtol=1e-6)


@pytest.mark.parametrize("name", ["a.ply", "a.splat", "a.spz", "a.compressed.ply"])
def test_ends_of_the_ranges(make_splats: Make, tmp_path: Path, name: str) -> None:
    """Opacity 0 and 1 and scale 0 are allowed; files get finite numbers for them."""
    g = make_splats(3, degree=0)
    g = g.replace(opacities=torch.tensor([0.0, 1.0, 0.5]), scales=torch.full((3, 3), 0.5))
    if name in ("a.ply", "a.splat"):
        g = g.replace(scales=torch.tensor([[0.0, 1e-30, 1.0]]).expand(3, 3))
    back = round_trip(g, tmp_path, name)
    order = back.opacities.argsort()
    assert back.opacities[order][[0, 2]].tolist() == [0.0, 1.0]
    if name == "a.ply":
        assert bool((back.scales[:, 0] == 0).all())
        rows = (tmp_path / name).read_bytes()[-17 * 4 * 3 :]
        assert np.isfinite(np.frombuffer(rows, "<f4")).all()


def test_ply_of_other_tools_with_infinite_logits(make_splats: Make, tmp_path: Path) -> None:
    """Opacity logits of +-inf are the ends of their range; a log scale of -inf is no Gaussian."""
    write_splats(make_splats(3, degree=0), tmp_path / "a.ply")
    data = bytearray((tmp_path / "a.ply").read_bytes())
    rows = np.frombuffer(data, "<f4", offset=data.index(b"end_header\n") + 11).reshape(3, 17)
    rows[0, 9], rows[1, 9], rows[2, 10] = np.inf, -np.inf, -np.inf
    (tmp_path / "b.ply").write_bytes(data)
    with pytest.warns(SplatWarning, match=r"1 of 3 .*the first is row 2 \(scale\).*left out"):
        back = read_splats(tmp_path / "b.ply")
    assert back.opacities.tolist() == [1.0, 0.0]


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("count", [1, 255, 256, 257, 3000])
def test_compressed_ply(make_splats: Make, tmp_path: Path, degree: int, count: int) -> None:
    g = make_splats(count, degree=degree)
    back = round_trip(g, tmp_path, "a.compressed.ply")
    sorted_g = g[torch.from_numpy(morton_order(g.means.numpy()))]
    chunk = torch.arange(count) // CHUNK

    def half_steps(values: torch.Tensor, bits: tuple[int, int, int]) -> torch.Tensor:
        spans = [
            values[chunk == i].amax(0) - values[chunk == i].amin(0) for i in range(chunk[-1] + 1)
        ]
        return torch.stack(spans)[chunk] / (2.0 ** torch.tensor(bits) - 1) / 2

    log_scales, colours = sorted_g.scales.log(), sorted_g.colours
    assert_within(back.means, sorted_g.means, half_steps(sorted_g.means, (11, 10, 11)))
    assert_within(back.scales.log(), log_scales, half_steps(log_scales, (11, 10, 11)) + 2e-6)
    assert_turned(back.rotations, sorted_g.rotations, 3 * 2**0.5 / 1023 / 2)
    assert_within(back.colours, colours, half_steps(colours, (8, 8, 8)) + 1e-6)
    assert_within(back.opacities, sorted_g.opacities, 1 / 510)
    assert_within(back.sh[:, 1:], sorted_g.sh[:, 1:], 8 / 256 / 2)


def test_compressed_ply_ends_of_harmonics(make_splats: Make, tmp_path: Path) -> None:
    """-4 and 4 are exact, although the steps between are read as their middles."""
    sh = torch.tensor([-4.0, 4.0, 0.0, 3.99])[:, None, None].expand(4, 4, 3)
    g = make_splats(4, degree=1).replace(sh=sh, means=torch.arange(4.0)[:, None].expand(4, 3))
    back = round_trip(g, tmp_path, "a.compressed.ply")
    assert back.sh[:, 1, 0].tolist() == [-4.0, 4.0, 1 / 64, 4.0]


def test_morton_order_by_hand() -> None:
    """x is the lowest bit, then y, then z; ties keep their order."""
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], np.float32)
    codes = corners @ np.array([1, 2, 4])
    np.testing.assert_array_equal(morton_order(corners), np.argsort(codes))
    np.testing.assert_array_equal(morton_order(np.zeros((5, 3), np.float32)), np.arange(5))
    cells = np.random.default_rng(1).integers(0, 1024, (300, 3))
    cells[0], cells[1] = 0, 1023  # the extent, so that a cell is 1
    bits = [f"{x:010b}{y:010b}{z:010b}" for x, y, z in cells]
    mixed = [int("".join(b[20 + i] + b[10 + i] + b[i] for i in range(10)), 2) for b in bits]
    expected = np.argsort(mixed, kind="stable")
    np.testing.assert_array_equal(morton_order(cells.astype(np.float32)), expected)
    line = np.zeros((2000, 3), np.float32)
    line[:, 1] = np.arange(2000)[::-1]
    np.testing.assert_array_equal(morton_order(line[::2]), np.arange(1000)[::-1])


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize(("format", "version"), [("spz", 4), ("spz3", 3)])
def test_spz(make_splats: Make, tmp_path: Path, degree: int, format: str, version: int) -> None:
    g = make_splats(2000, degree=degree)
    back = round_trip(g, tmp_path, "a.spz", format=format)
    head = (tmp_path / "a.spz").read_bytes()
    assert head[:8] == b"NGSP\4\0\0\0" if version == 4 else head[:2] == b"\x1f\x8b"
    assert_within(back.means, g.means, 2.0**-21)  # 6 takes 3 bits and the sign: 20 remain
    assert_within(back.scales.log(), g.scales.log(), 1 / 32 + 2e-6)
    assert_turned(back.rotations, g.rotations, 3 * 2**-0.5 / 511 / 2)
    assert_within(back.opacities, g.opacities, 1 / 510)
    assert_within(back.sh[:, 0], g.sh[:, 0], 1 / 510 / 0.15 + 1e-6)
    assert_within(back.sh[:, 1:], g.sh[:, 1:], 1 / 256)


@pytest.mark.parametrize(
    ("largest", "bits"), [(0.0, 20), (7.99, 20), (8.0, 19), (2047.0, 12), (8388607.0, 0)]
)
def test_spz_fractional_bits(make_splats: Make, tmp_path: Path, largest: float, bits: int) -> None:
    g = make_splats(2, degree=0)
    g = g.replace(means=torch.tensor([[largest, 0, 0], [0, -largest, largest]]))
    back = round_trip(g, tmp_path, "a.spz")
    assert (tmp_path / "a.spz").read_bytes()[13] == bits
    assert_within(back.means, g.means, 2.0 ** -(bits + 1))


def test_spz_rounds_positions(make_splats: Make, tmp_path: Path) -> None:
    """To the nearest step of 1/4096, on both sides of zero (y and z change sign in the file)."""
    steps = torch.tensor([[2047 * 4096, 0.75, -0.75], [0.25, -0.25, 1.75], [-1.75, 1.25, -1.25]])
    g = make_splats(3, degree=0).replace(means=steps / 4096)
    back = round_trip(g, tmp_path, "a.spz").means * 4096
    assert back.tolist() == [[2047 * 4096, 1, -1], [0, 0, 2], [-2, 1, -1]]


def test_spz_refuses_what_is_too_far(make_splats: Make, tmp_path: Path) -> None:
    g = make_splats(1, degree=0).replace(means=torch.tensor([[0, 1e7, 0]]))
    with pytest.raises(RangeError, match="coordinates below 8388608 for an SPZ file, got 1e"):
        write_splats(g, tmp_path / "a.spz")
    assert list(tmp_path.iterdir()) == []


def test_spz_axes_turn_colours_too(make_splats: Make) -> None:
    """Harmonics with the signs of SPZ, seen along turned directions, give the same colours."""
    g = make_splats(50)
    directions = torch.nn.functional.normalize(torch.randn(50, 3, generator=torch.manual_seed(3)))
    turned = g.sh.clone()
    turned[:, 1:] *= torch.from_numpy(_FLIP_SH)[:, None]
    seen = evaluate_sh(turned, directions * torch.tensor([1.0, -1.0, -1.0]))
    torch.testing.assert_close(seen, evaluate_sh(g.sh, directions))


def test_splat(make_splats: Make, tmp_path: Path) -> None:
    g = make_splats(1000, degree=0)
    back = round_trip(g, tmp_path, "a.splat")
    assert torch.equal(back.means, g.means)
    assert torch.equal(back.scales, g.scales)
    # Bytes are half a step of 1/128 off (a whole one at +1), then the length is made 1.
    assert_turned(back.rotations, g.rotations, 2.5 / 128)
    assert_within(back.colours, g.colours, 1 / 510 + 1e-6)
    assert_within(back.opacities, g.opacities, 1 / 510)


def test_splat_bytes_by_hand(make_splats: Make, tmp_path: Path) -> None:
    """The bytes that viewers of the layout decode: 128 is 0, 255 is what is left of 1."""
    g = make_splats(2, degree=0).replace(
        rotations=torch.tensor([[1.0, 0, 0, 0], [0.5, -0.5, 0.5, -0.5]]),
        opacities=torch.tensor([0.0, 1.0]),
        sh=torch.tensor([[[0.0, 0.5, -0.5]], [[-0.5, 0.5, 0.25]]]) / 0.28209479,
    )
    write_splats(g, tmp_path / "a.splat")
    data = (tmp_path / "a.splat").read_bytes()
    assert list(data[24:32]) == [128, 255, 0, 0, 255, 128, 128, 128]
    assert list(data[56:64]) == [0, 255, 191, 255, 192, 64, 192, 64]
    assert read_splats(tmp_path / "a.splat").rotations.tolist() == g.rotations.tolist()


@pytest.mark.parametrize("name", ["a.ply", "a.spz", "a.compressed.ply"])
def test_no_gaussians_at_all(make_splats: Make, tmp_path: Path, name: str) -> None:
    back = round_trip(make_splats(0, degree=2), tmp_path, name)
    assert len(back) == 0
    assert back.sh_degree == 2


def test_splat_file_cannot_be_empty(make_splats: Make, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"a \.splat file cannot hold a scene without"):
        write_splats(make_splats(0, degree=0), tmp_path / "a.splat")


def test_what_is_lost_is_said(make_splats: Make, tmp_path: Path) -> None:
    g = make_splats(4, degree=1, extra=True)
    with pytest.warns(SplatWarning) as caught:
        write_splats(g, tmp_path / "a.splat")
    assert str(caught[0].message) == (
        f"{tmp_path / 'a.splat'}: a .splat file has no place for harmonics above degree 0 and "
        "the extra columns chosen, class_id, feature, instance, kind, long, single, weight."
    )
    assert caught[0].filename == __file__
    sh = g.sh.clone()
    sh[0, 0, 0], sh[:2, 1:, 1] = 40.0, -3.0
    scales = g.scales.clone()
    scales[1] = 1e-9
    with pytest.warns(SplatWarning, match=r"\(1 colours, 3 scales, 6 harmonics\)"):
        write_splats(g.replace(sh=sh, scales=scales, extra={}), tmp_path / "a.spz")
    back = read_splats(tmp_path / "a.spz")
    assert back.sh[0, 1, 1] == -1 or back.sh[0, 1, 1] == -127 / 128


def test_names_and_formats(make_splats: Make, tmp_path: Path) -> None:
    g = make_splats(2, degree=0)
    with pytest.raises(InputError, match=r"a\.obj: expected a name that ends in \.ply"):
        write_splats(g, tmp_path / "a.obj")
    with pytest.raises(InputError, match=r"format: expected one of .*got 'ksplat'"):
        write_splats(g, tmp_path / "a.ksplat", format="ksplat")  # type: ignore[arg-type]
    with pytest.raises(MissingFileError, match="nowhere is missing"):
        write_splats(g, tmp_path / "nowhere" / "a.ply")
    write_splats(g, tmp_path / "a.COMPRESSED.PLY")
    assert b"packed_position" in (tmp_path / "a.COMPRESSED.PLY").read_bytes()
    write_splats(g, tmp_path / "b.bin", format="splat")
    assert (tmp_path / "b.bin").stat().st_size == 64


@pytest.mark.parametrize(
    ("name", "column", "message"),
    [
        ("x", torch.zeros(2), "PLY uses the name 'x'"),
        ("f_rest_7", torch.zeros(2), "PLY uses the name 'f_rest_7'"),
        ("two words", torch.zeros(2), "printable ASCII without spaces"),
        ("", torch.zeros(2), "printable ASCII without spaces"),
        ("id\n", torch.zeros(2), "printable ASCII without spaces"),
        ("nx", torch.ones(2), "PLY uses the name 'nx'"),
        ("big", torch.tensor([0, 2**31]), "fit into 32 bits.*0 to 2147483648"),
        ("complex", torch.zeros(2, dtype=torch.complex64), "no columns of type torch.complex64"),
        ("none", torch.zeros(2, 0), "expected at least one component"),
        ("b", torch.zeros(2, 1), "the column name 'b_0' is taken"),
    ],
)
def test_extra_columns_ply_cannot_hold(
    make_splats: Make, tmp_path: Path, name: str, column: torch.Tensor, message: str
) -> None:
    g = make_splats(2, degree=1)
    with pytest.raises(InputError, match=message):
        write_splats(g.replace(extra={"b_0": torch.zeros(2), name: column}), tmp_path / "a.ply")
    assert list(tmp_path.iterdir()) == []


def test_normals_survive_where_there_are_any(make_splats: Make, tmp_path: Path) -> None:
    normals = {name: torch.tensor([0.5, i]) for i, name in enumerate(("nx", "ny", "nz"))}
    back = round_trip(make_splats(2, degree=0).replace(extra=normals), tmp_path, "a.ply")
    assert {name: column.tolist() for name, column in back.extra.items()} == {
        name: column.tolist() for name, column in normals.items()
    }


def test_columns_an_editor_dropped(make_splats: Make, tmp_path: Path) -> None:
    """Notes about columns that are gone are passed over, the rest comes back as it is."""
    write_splats(
        make_splats(2, degree=0).replace(extra={"f": torch.ones(2, 2), "k": torch.ones(2)}),
        tmp_path / "a.ply",
    )
    data = (tmp_path / "a.ply").read_bytes()
    (tmp_path / "b.ply").write_bytes(data.replace(b"float f_0\n", b"float g_0\n"))
    extra = read_splats(tmp_path / "b.ply").extra
    assert sorted(extra) == ["f_1", "g_0", "k"]


@pytest.mark.parametrize("poison", [float("nan"), float("inf")])
@pytest.mark.parametrize("name", ["a.ply", "a.splat", "a.spz", "a.compressed.ply"])
def test_poison_is_not_written(make_splats: Make, tmp_path: Path, name: str, poison: float) -> None:
    g = make_splats(5, degree=0)
    means = g.means.clone()
    means[3, 1] = poison
    with pytest.raises(RangeError, match="means: 1 of 15 values are not finite"):
        write_splats(g.replace(means=means), tmp_path / name)
    assert list(tmp_path.iterdir()) == []


def test_gradients_and_double_precision_are_no_obstacle(make_splats: Make, tmp_path: Path) -> None:
    g = make_splats(3, degree=0).to(dtype=torch.float64)
    back = round_trip(g.replace(means=g.means.clone().requires_grad_()), tmp_path, "a.ply")
    assert back.dtype == torch.float32
    torch.testing.assert_close(back.means.double(), g.means)


def test_writing_does_not_change_the_gaussians(make_splats: Make, tmp_path: Path) -> None:
    """Quaternions of any length are written with length 1, on a copy."""
    g = make_splats(4, degree=0)
    g = g.replace(rotations=g.rotations * 3)
    before = g.rotations.clone()
    back = round_trip(g, tmp_path, "a.ply")
    assert torch.equal(g.rotations, before)
    torch.testing.assert_close(back.rotations, before / 3)


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("name", ["a.ply", "a.compressed.ply", "a.spz", "b.spz"])
def test_what_they_are_meant_for_is_written(
    make_splats: Make, tmp_path: Path, name: str, antialiased: bool
) -> None:
    g = make_splats(5, degree=1).replace(antialiased=antialiased)
    options = {"format": "spz3"} if name == "b.spz" else {}
    assert round_trip(g, tmp_path, name, **options).antialiased == antialiased


def test_splat_files_cannot_say_what_they_are_meant_for(make_splats: Make, tmp_path: Path) -> None:
    g = make_splats(5, degree=0).replace(antialiased=True)
    with pytest.warns(SplatWarning, match="no place for a note that they are meant for antialias"):
        write_splats(g, tmp_path / "a.splat")
    assert not read_splats(tmp_path / "a.splat").antialiased


@pytest.mark.parametrize("name", ["a.ply", "a.compressed.ply"])
def test_the_low_pass_is_written_where_it_is_not_the_usual(
    make_splats: Make, tmp_path: Path, name: str
) -> None:
    g = make_splats(5, degree=1)
    back = round_trip(g.replace(low_pass=0.1, antialiased=True), tmp_path, name)
    assert (back.low_pass, back.antialiased) == (0.1, True)
    assert b"low_pass 0.1\n" in (tmp_path / name).read_bytes()
    assert round_trip(g, tmp_path, name).low_pass == 0.3
    assert b"low_pass" not in (tmp_path / name).read_bytes()


@pytest.mark.parametrize("text", ["nan", "-0.1", "inf", "wide"])
def test_a_low_pass_that_is_none_is_refused(make_splats: Make, tmp_path: Path, text: str) -> None:
    path = tmp_path / "a.ply"
    write_splats(make_splats(5, degree=0).replace(low_pass=0.1), path)
    path.write_bytes(path.read_bytes().replace(b"low_pass 0.1", f"low_pass {text}".encode()))
    with pytest.raises(FileFormatError, match=f"a.ply: expected 'low_pass' .* got '{text}'"):
        read_splats(path)


@pytest.mark.parametrize("name", ["a.splat", "a.spz"])
def test_formats_that_cannot_say_the_low_pass_warn(
    make_splats: Make, tmp_path: Path, name: str
) -> None:
    g = make_splats(5, degree=0).replace(low_pass=0.1)
    with pytest.warns(SplatWarning, match="meant for a low-pass of 0.1"):
        write_splats(g, tmp_path / name)
    assert read_splats(tmp_path / name).low_pass == 0.3
