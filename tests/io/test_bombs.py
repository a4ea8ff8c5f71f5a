"""Small files that stand for much: refused before it is unpacked, and read where it is allowed.

The limit is lowered, so that the files are small as well; each test reads its file once more
with the limit raised.
"""

import gzip
import json
import struct
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from splatseg.cli import main
from splatseg.core import Camera, Gaussians, Rle, View
from splatseg.errors import FileFormatError, InputError, RangeError
from splatseg.io import limits
from splatseg.io.evidence import check_map_sizes, open_evidence, read_id_map
from splatseg.io.images import image_size, load_image
from splatseg.io.limits import check_unpacked, max_unpacked, parse_size, unpacking
from splatseg.io.splats import read_splats, write_splats

LOW = 20_000


@pytest.fixture
def low(monkeypatch) -> None:
    monkeypatch.setattr(limits, "_free", LOW)


def refused(path: Path, read: Callable[[Path], object]) -> object:
    """Refused as it is, naming file and option; gives what is read with the limit raised."""
    with pytest.raises(FileFormatError, match=r"--max-unpacked 1GB") as caught:
        read(path)
    assert str(path) in str(caught.value)
    with unpacking(10**9):
        return read(path)


def spz(path: Path, count: int) -> Path:
    """Zeros: version 2, no harmonics."""
    header = struct.pack("<4sIIBBBB", b"NGSP", 2, count, 0, 12, 0, 0)
    path.write_bytes(gzip.compress(header + b"\0" * (19 * count)))
    return path


def test_spz_of_zeros(tmp_path, low) -> None:
    assert len(refused(spz(tmp_path / "a.spz", 5000), read_splats)) == 5000


def test_the_ratio_that_zeros_reach_is_refused_at_the_default_limit(tmp_path) -> None:
    header = struct.pack("<4sIIBBBB", b"NGSP", 2, 5_000_000, 0, 12, 0, 0)
    (tmp_path / "a.spz").write_bytes(gzip.compress(header) + bytes(1000))
    with pytest.raises(FileFormatError, match="5000000 Gaussians, which is 280 MB"):
        read_splats(tmp_path / "a.spz")


def gltf(path: Path, *, nodes: int) -> Path:
    """One mesh of 100 Gaussians that every node shows."""
    count, at, views, accessors, attributes = 100, 0, [], [], {}
    buffer = b""
    extension = "KHR_gaussian_splatting"
    for name, kind, row in (
        ("POSITION", "VEC3", [0, 0, 0]),
        (f"{extension}:ROTATION", "VEC4", [0, 0, 0, 1]),
        (f"{extension}:SCALE", "VEC3", [1, 1, 1]),
        (f"{extension}:OPACITY", "SCALAR", [1]),
        (f"{extension}:SH_DEGREE_0_COEF_0", "VEC3", [0, 0, 0]),
    ):
        data = np.tile(np.array(row, "<f4"), (count, 1)).tobytes()
        attributes[name] = len(accessors)
        accessors.append(
            {"bufferView": len(views), "componentType": 5126, "count": count, "type": kind}
        )
        views.append({"buffer": 0, "byteOffset": at, "byteLength": len(data)})
        buffer += data
        at += len(data)
    (path.parent / "a.bin").write_bytes(buffer)
    said = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    primitive = {"mode": 0, "attributes": attributes, "extensions": {extension: said}}
    content = {
        "asset": {"version": "2.0"},
        "buffers": [{"uri": "a.bin", "byteLength": len(buffer)}],
        "bufferViews": views,
        "accessors": accessors,
        "meshes": [{"primitives": [primitive]}],
        "nodes": [{"mesh": 0} for _ in range(nodes)],
        "scenes": [{"nodes": list(range(nodes))}],
    }
    path.write_text(json.dumps(content))
    return path


def test_gltf_nodes_that_repeat_a_mesh(tmp_path, low) -> None:
    assert len(read_splats(gltf(tmp_path / "one.gltf", nodes=3))) == 300
    assert len(refused(gltf(tmp_path / "a.gltf", nodes=300), read_splats)) == 30_000


def test_sog_that_counts_more_than_it_has(tmp_path, project_root) -> None:
    source = project_root / "tests/golden/splats/three.v2.sog"
    with (
        zipfile.ZipFile(source) as old,
        zipfile.ZipFile(tmp_path / "a.sog", "w") as new,
    ):
        for name in old.namelist():
            content = old.read(name)
            if name == "meta.json":
                content = json.dumps({**json.loads(content), "count": 16_000_000}).encode()
            new.writestr(name, content)
    with pytest.raises(FileFormatError, match=r"a.sog.*16000000 Gaussians.*--max-unpacked"):
        read_splats(tmp_path / "a.sog")


def test_members_of_a_sog_in_other_compressions_are_refused(tmp_path, project_root) -> None:
    source = project_root / "tests/golden/splats/three.v2.sog"
    with (
        zipfile.ZipFile(source) as old,
        zipfile.ZipFile(tmp_path / "a.sog", "w", zipfile.ZIP_BZIP2) as new,
    ):
        for name in old.namelist():
            new.writestr(name, old.read(name))
    with pytest.raises(FileFormatError, match=r"a.sog.*stored or deflated"):
        read_splats(tmp_path / "a.sog")


def test_a_ply_header_of_many_columns_takes_no_quadratic_time(tmp_path) -> None:
    """Counted in calls, not in seconds: eight times the columns are eight times the work."""

    def calls(columns: int) -> int:
        lines = ["ply", "format binary_little_endian 1.0", "element vertex 0"]
        lines += [f"property uchar c{i}" for i in range(columns)]
        path = tmp_path / f"{columns}.ply"
        path.write_text("\n".join([*lines, "end_header\n"]))
        count = 0

        def counting(frame: object, event: str, argument: object) -> None:
            nonlocal count
            count += event in ("call", "c_call")

        sys.setprofile(counting)
        try:
            with pytest.raises(FileFormatError, match=r"\d.ply.*point cloud|without x") as caught:
                read_splats(path)
        finally:
            sys.setprofile(None)
        assert len(str(caught.value)) < 400
        return count

    assert calls(4_000) < 10 * calls(500)


def test_a_note_of_endless_components_is_passed_over(tmp_path) -> None:
    path = tmp_path / "a.ply"
    write_splats(
        Gaussians(
            means=torch.zeros(1, 3),
            rotations=torch.eye(4)[:1],
            scales=torch.ones(1, 3),
            opacities=torch.ones(1),
            sh=torch.zeros(1, 1, 3),
        ),
        path,
    )
    for number in ("9999999999", "999999", "x", "²"):
        note = f"format binary_little_endian 1.0\ncomment splatseg column a {number} float32"
        data = path.read_bytes().replace(b"format binary_little_endian 1.0", note.encode("latin-1"))
        (tmp_path / "b.ply").write_bytes(data)
        assert not read_splats(tmp_path / "b.ply").extra


def flat_png(path: Path, side: int, *, mode: str = "L") -> Path:
    Image.new(mode, (side, side)).save(path, compress_level=9)
    return path


def test_label_maps_of_one_colour(tmp_path, low) -> None:
    assert refused(flat_png(tmp_path / "a.png", 100), read_id_map).shape == (100, 100)


@pytest.mark.parametrize(("suffix", "options"), [("png", {}), ("tiff", {"compression": "group4"})])
def test_pictures_of_one_colour(tmp_path, low, suffix, options) -> None:
    path = tmp_path / f"a.{suffix}"
    Image.new("1" if options else "RGB", (300, 300)).save(path, **options)
    assert refused(path, image_size) == (300, 300)


def test_pictures_beyond_pillows_own_limit_name_the_option_too(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 10)
    with pytest.raises(FileFormatError, match=r"a.png.*--max-unpacked"):
        image_size(flat_png(tmp_path / "a.png", 100))
    with unpacking(10**9):
        assert image_size(tmp_path / "a.png") == (100, 100)
    assert Image.MAX_IMAGE_PIXELS == 10


def view(side: int) -> View:
    camera = Camera(
        width=side, height=side, fx=9, fy=9, cx=4, cy=4, cam_from_world=torch.eye(4).double()
    )
    return View(name="a", camera=camera, split="train")


def test_label_maps_far_larger_than_their_photograph_are_refused_undecoded(tmp_path) -> None:
    flat_png(tmp_path / "a.png", 64)
    evidence = open_evidence(tmp_path)
    for side in (32, 64, 640):  # half the size of a map is its photograph's, or more
        check_map_sizes(evidence, [view(side)])
    data = (tmp_path / "a.png").read_bytes()
    (tmp_path / "a.png").write_bytes(data[:50])  # no pixels: the header is enough
    with pytest.raises(FileFormatError, match=r"a.png: expected a label map of 31x31.*64x64"):
        check_map_sizes(evidence, [view(31)])


def masks(path: Path, counts: object, *, side: int = 2) -> Path:
    row = {"segmentation": {"size": [side, side], "counts": counts}}
    path.write_text(json.dumps({"height": side, "width": side, "masks": [row]}))
    return path


def test_coco_counts_without_an_end_take_no_quadratic_time(tmp_path) -> None:
    masks(tmp_path / "a.json", "o" * 300_000 + "0")
    with pytest.raises(FileFormatError, match=r"a.json.*longer number"):
        open_evidence(tmp_path).masks("a")


def test_the_longest_run_of_coco_is_still_read() -> None:
    side = 1 << 16
    with pytest.raises(InputError, match="add up"):
        Rle.from_coco("0", height=side, width=side)
    for runs in ([0, side * side - 1, 1], [1, side * side - 2, 1]):
        rle = Rle(height=side, width=side, counts=np.array(runs, np.uint32))
        assert Rle.from_coco(rle.to_coco(), height=side, width=side).counts.tolist() == runs


def test_coco_runs_that_overflow_are_not_wrapped() -> None:
    runs = [2**32, 4 - 2**32, 2**32]  # 4 of 2 x 2 pixels in 32 bits
    with pytest.raises(InputError):
        Rle.from_coco(_coco(runs), height=2, width=2)


def _coco(runs: list[int]) -> str:
    out = ""
    for i, run in enumerate(runs):
        value, more = run - (runs[i - 2] if i > 2 else 0), True
        while more:
            code, value = value & 31, value >> 5
            more = value != (-1 if code & 16 else 0)
            out += chr((code | (32 if more else 0)) + 48)
    return out


def test_masks_of_huge_pictures(tmp_path, low) -> None:
    path = masks(tmp_path / "a.json", [300 * 300], side=300)
    assert refused(path, lambda path: open_evidence(path.parent).masks("a")).height == 300


def test_photographs_are_held_against_the_limit_before_they_are_decoded(tmp_path, low) -> None:
    path = flat_png(tmp_path / "a.png", 300, mode="RGB")
    path.write_bytes(path.read_bytes()[:60])
    photograph = View(name="a", camera=view(300).camera, split="train", image=path)
    with pytest.raises(FileFormatError, match="--max-unpacked"):
        load_image(photograph)


def test_what_a_limit_is() -> None:
    assert max_unpacked(0) == limits.FREE
    assert max_unpacked(limits.FREE) == limits.RATIO * limits.FREE
    check_unpacked("a", limits.FREE, packed=0, what="x")
    with pytest.raises(FileFormatError, match=r"^a: .* 268 MB from a file of 5 bytes.* x, which"):
        check_unpacked("a", limits.FREE + 1, packed=5, what="x")
    with unpacking(7):
        assert max_unpacked(0) == 7
        with unpacking(None):
            assert max_unpacked(0) == 7
    assert max_unpacked(0) == limits.FREE
    with pytest.raises(RangeError), unpacking(-1):
        pass


@pytest.mark.parametrize("text", ["", "4 GBB", "GB", "-1GB", "1e9", "1.5GB", "9" * 40, "4Tb"])
def test_what_is_no_size(text) -> None:
    with pytest.raises(InputError, match="--max-unpacked"):
        parse_size(text)


@pytest.mark.parametrize("words", [["--max-unpacked", "1kB"], ["--max-unpacked=1 kB"]])
def test_the_option_holds_for_a_whole_command(tmp_path, capsys, words) -> None:
    path = str(spz(tmp_path / "a.spz", 500))
    assert main([*words, "info", path]) == 2
    error = capsys.readouterr().err
    assert path in error
    assert "--max-unpacked 1GB" in error
    assert main(["info", path, "--max-unpacked", "1MB"]) == 0
    assert main(["info", path, "--max-unpacked"]) == 2
    assert max_unpacked(0) == limits.FREE
