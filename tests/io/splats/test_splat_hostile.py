"""Files that are not what they should be: one sentence that starts with the path, each time."""

import gzip
import io
import json
import struct
import tracemalloc
import warnings
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import zstandard
from PIL import Image

from splatseg.core import Gaussians
from splatseg.errors import FileFormatError, MissingFileError, SplatsegError
from splatseg.io.splats import read_splats, splat_format

Make = Callable[..., Gaussians]

NAMES = (
    "three.ply",
    "three.compressed.ply",
    "three.splat",
    "three.v2.spz",
    "three.v3.spz",
    "three.v4.spz",
    "three.v1.sog",
    "three.v2.sog",
    "three.glb",
    "three.draft.gltf",
    "three.ksplat",
)


@pytest.fixture
def golden(project_root: Path) -> Path:
    return project_root / "tests" / "golden" / "splats"


def refused(path: Path, data: bytes, message: str) -> None:
    """Writing these bytes to `path` and reading them gives this error about this file."""
    path.write_bytes(data)
    with pytest.raises(FileFormatError, match=message) as caught:
        read_splats(path, strict=True)
    assert str(caught.value).startswith(f"{path}: ")
    assert str(caught.value).endswith(".")


# What no format is.


def test_nothing_that_could_be_read(tmp_path: Path) -> None:
    with pytest.raises(MissingFileError, match=r"missing\.ply: no such file"):
        read_splats(tmp_path / "missing.ply")
    with pytest.raises(FileFormatError, match=r"got a folder without the meta\.json"):
        read_splats(tmp_path)
    refused(tmp_path / "a.ply", b"", "got an empty file")
    refused(tmp_path / "a.splat", b"", "got an empty file")
    refused(tmp_path / "a.xyz", b"0.5 0.5 0.5\n", r"expected a splat file .*b'0\.5 0\.5 '")
    refused(tmp_path / "a.spz", b"hello", "starts with b'hello'")
    refused(tmp_path / "a.gz", gzip.compress(b"hello"), "expected a splat file")
    refused(tmp_path / "a.spz", gzip.compress(b"hello" * 9), "SPZ magic b'NGSP', got b'hell'")
    refused(tmp_path / "a.json", b'{"a": 1}', "expected a splat file")
    refused(tmp_path / "a.json", b'{"a": ' + b"[" * 100_000, "expected a splat file")
    assert splat_format(tmp_path / "a.spz") == "spz"


@pytest.mark.parametrize("name", NAMES)
def test_truncated_anywhere(golden: Path, tmp_path: Path, name: str) -> None:
    """A file cut at any byte is refused, except a .splat between two rows."""
    data = (golden / name).read_bytes()
    path = tmp_path / name
    for length in range(0, len(data), max(1, len(data) // 150)):
        path.write_bytes(data[:length])
        if name == "three.splat" and length and length % 32 == 0:
            assert len(read_splats(path)) == length // 32
            continue
        with pytest.raises(FileFormatError):
            read_splats(path)


@pytest.mark.parametrize("name", [name for name in NAMES if "sog" not in name])
def test_longer_than_it_should_be(golden: Path, tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.write_bytes((golden / name).read_bytes() + b"\0" * 20 + b"x")
    if name in ("three.v2.spz", "three.v3.spz"):
        return  # gzip streams end by themselves; what follows is not part of them
    with pytest.raises(FileFormatError, match=r"longer|multiple of 32|too long|as its header|JSON"):
        read_splats(path)


@pytest.mark.parametrize("name", NAMES)
def test_damaged_bytes(golden: Path, tmp_path: Path, rng: np.random.Generator, name: str) -> None:
    """Any byte changed: Gaussians that can be rendered or our own error, nothing else."""
    data = np.frombuffer((golden / name).read_bytes(), np.uint8)
    path = tmp_path / name
    refusals: list[str] = []
    for _ in range(250):
        changed = data.copy()
        at = rng.integers(0, len(data), rng.integers(1, 4))
        changed[at] = rng.integers(0, 256, len(at))
        path.write_bytes(changed.tobytes())
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                read_splats(path).check_values()
        except SplatsegError as error:
            refusals.append(str(error))
    assert all(str(tmp_path) in message for message in refusals)
    assert refusals or name == "three.splat"


# PLY.


def edited_ply(golden: Path, old: bytes, new: bytes) -> bytes:
    data = (golden / "three.ply").read_bytes()
    assert old in data
    return data.replace(old, new)


def test_ply_headers(golden: Path, tmp_path: Path) -> None:
    def edited(old: bytes, new: bytes, message: str) -> None:
        refused(tmp_path / "a.ply", edited_ply(golden, old, new), message)

    edited(b"binary_little_endian", b"ascii", "expected 3 rows of 'vertex'")
    edited(b"binary_little_endian", b"morse", "cannot read the PLY header line 'format morse")
    edited(b"format binary_little_endian 1.0\n", b"", "one PLY line of the format, got 0")
    edited(b"vertex 3\n", b"vertex 4\n", "the file ends early")
    edited(b"vertex 3\n", b"vertex 2\n", "expected the end of the file .*, got 112 bytes more")
    edited(b"vertex 3\n", b"vertex 99999999999999\n", "the file ends early")
    edited(b"vertex 3\n", b"vertex -3\n", "cannot read the PLY header line 'element vertex -3'")
    edited(b"vertex 3\n", b"vertex 3.0\n", "cannot read the PLY header line")
    edited(b"float x\n", b"quad x\n", "cannot read the PLY header line 'property quad x'")
    edited(b"float y\n", b"float x\n", "the PLY property 'x' stands twice")
    edited(b"float y\n", b"list uchar int y\n", "without an element vertex that has no lists")
    edited(b"end_header", b"and_header", "expected a PLY header that ends with 'end_header'")
    edited(b"float opacity\n", b"float opaque\n", r"without opacity \(found 'x, y, z, ")
    edited(b"float f_rest_8\n", b"float f_rest_9\n", "columns f_rest_0, f_rest_1 and so on, got 9")
    edited(b"float f_rest_8\n", b"float g_rest_8\n", "expected 0, 9, 24 or 45 columns")
    edited(b"float x\n", b"int x\n", "expected the PLY column x to be float or double, got int32")
    edited(b"element vertex", b"element points", r"without an element vertex .*'points'")
    edited(
        b"element vertex 3\n",
        b"element face 9\nproperty list uint double i\nelement vertex 3\n",
        "expected a list that fits the file",
    )


def test_point_cloud_is_no_splat(generated_room: Path) -> None:
    path = generated_room / "points3D.ply"
    found = r"got points with colours, no Gaussians \(found 'x, y, z, .*fit CAPTURE --points poi"
    with pytest.raises(FileFormatError, match=found):
        read_splats(path)


def test_other_elements_before_and_after_are_stepped_over(golden: Path, tmp_path: Path) -> None:
    data = (golden / "three.ply").read_bytes()
    end = data.index(b"end_header\n") + 11
    head = data[:end].replace(
        b"element vertex", b"obj_info a\nelement a 2\nproperty short s\nelement vertex"
    )
    head = head.replace(b"end_header", b"element z 1\nproperty double d\nend_header")
    (tmp_path / "a.ply").write_bytes(head + b"\0" * 4 + data[end:] + b"\0" * 8)
    got, want = read_splats(tmp_path / "a.ply"), read_splats(golden / "three.ply")
    assert got.means.tolist() == want.means.tolist()
    assert list(got.extra) == list(want.extra)


def poisoned_ply(golden: Path, column: int, row: int, value: float) -> bytes:
    """The golden PLY with one number exchanged; a row has 28 of them."""
    data = bytearray((golden / "three.ply").read_bytes())
    start = data.index(b"end_header\n") + 11
    struct.pack_into("<f", data, start + 4 * (28 * row + column), value)
    return bytes(data)


@pytest.mark.parametrize(
    ("column", "name"),
    [(1, "position"), (7, "colour"), (17, "colour"), (18, "opacity"), (20, "scale"), (24, "rotat")],
)
def test_nan_rows(golden: Path, tmp_path: Path, column: int, name: str) -> None:
    data = poisoned_ply(golden, column, 1, float("nan"))
    message = rf"1 of 3 Gaussians hold values that are NaN or infinite; the first is row 1 \({name}"
    refused(tmp_path / "a.ply", data, message)


@pytest.mark.parametrize(("column", "value"), [(0, np.inf), (6, -np.inf), (19, np.inf), (19, 100)])
def test_infinite_rows(golden: Path, tmp_path: Path, column: int, value: float) -> None:
    """A log scale of 100 is more than float32 can hold."""
    data = poisoned_ply(golden, column, 2, value)
    refused(tmp_path / "a.ply", data, "1 of 3 Gaussians hold values .*the first is row 2")


def test_zero_rotations(golden: Path, tmp_path: Path) -> None:
    data = bytearray((golden / "three.ply").read_bytes())
    start = data.index(b"end_header\n") + 11
    for row in (0, 2):
        struct.pack_into("<4f", data, start + 4 * (28 * row + 22), 0, 0, 0, 0)
    message = r"2 of 3 Gaussians have a rotation of length zero; the first is row 0 \(rotation\)"
    refused(tmp_path / "a.ply", bytes(data), message)


def test_rotations_of_any_length(golden: Path, tmp_path: Path) -> None:
    """Also where the square of the length is no float32."""
    for size in (1e-30, 1e30):
        data = bytearray((golden / "three.ply").read_bytes())
        start = data.index(b"end_header\n") + 11
        struct.pack_into("<4f", data, start + 4 * 22, 0, 3 * size, 0, -4 * size)
        (tmp_path / "a.ply").write_bytes(data)
        got = read_splats(tmp_path / "a.ply").rotations[0]
        np.testing.assert_allclose(got, [0, 0.6, 0, -0.8], rtol=1e-6)


# .splat and compressed PLY.


def test_splat_rows(golden: Path, tmp_path: Path) -> None:
    data = bytearray((golden / "three.splat").read_bytes())
    refused(tmp_path / "a.splat", bytes(data[:-1]), "a multiple of 32 bytes.* got 95 bytes")
    struct.pack_into("<f", data, 32 + 16, -0.5)
    refused(tmp_path / "a.splat", bytes(data), "1 of 3 Gaussians have a negative scale.* row 1")
    data[28:32] = b"\x80" * 4
    refused(tmp_path / "a.splat", bytes(data), "1 of 3 .*rotation of length zero.* row 0")


def test_compressed_ply_headers(golden: Path, tmp_path: Path) -> None:
    whole = (golden / "three.compressed.ply").read_bytes()

    def edited(old: bytes, new: bytes, message: str, more: bytes = b"") -> None:
        assert old in whole
        refused(tmp_path / "a.compressed.ply", whole.replace(old, new) + more, message)

    edited(b"element chunk", b"element chump", "expected the elements chunk and vertex")
    edited(b"uint packed_color", b"float packed_color", "'packed_color' of type uint32")
    edited(b"uint packed_scale", b"uint packed_size", "'packed_scale' of type uint32")
    edited(b"float min_x", b"float mix_x", "expected the columns 'min_x' of type float32")
    edited(b"float max_b", b"int max_b", "expected the columns 'max_b' of type float32")
    edited(b"chunk 1\n", b"chunk 2\n", "expected 1 chunks for 3 Gaussians, got 2", b"\0" * 72)
    more_rows = "3 rows of 9, 24 or 45 harmonics, got 4 rows of 9"
    edited(b"element sh 3", b"element sh 4", more_rows, b"\0" * 9)
    edited(b"uchar f_rest_8", b"uchar f_rest_9", "expected the columns 'f_rest_8' of type uint8")
    swapped = whole.replace(b"f_rest_7", b"f_rest_X").replace(b"f_rest_8", b"f_rest_7")
    swapped = swapped.replace(b"f_rest_X", b"f_rest_8")
    refused(tmp_path / "a.ply", swapped, "expected the harmonics f_rest_0, ... in order")


def test_compressed_ply_without_chunk_colours(golden: Path, tmp_path: Path) -> None:
    """Older files have 12 numbers a chunk; colours are then bytes of [0, 1]."""
    whole = (golden / "three.compressed.ply").read_bytes()
    end = whole.index(b"end_header\n") + 11
    head = whole[:end]
    for name in ("min_r", "min_g", "min_b", "max_r", "max_g", "max_b"):
        head = head.replace(b"property float " + name.encode() + b"\n", b"")
    (tmp_path / "a.ply").write_bytes(head + whole[end : end + 48] + whole[end + 72 :])
    got = read_splats(tmp_path / "a.ply")
    packed = np.frombuffer(whole, "<u4", 12, end + 72).reshape(3, 4)[:, 3]
    shifts = np.array([24, 16, 8])
    np.testing.assert_allclose(got.colours, ((packed[:, None] >> shifts) & 255) / 255, atol=1e-6)


def test_compressed_ply_bounds_that_are_not_finite(golden: Path, tmp_path: Path) -> None:
    data = bytearray((golden / "three.compressed.ply").read_bytes())
    struct.pack_into("<f", data, data.index(b"end_header\n") + 11, float("nan"))
    refused(tmp_path / "a.ply", bytes(data), r"3 of 3 Gaussians hold .* row 0 \(position\)")


# SPZ.


def spz_header(
    *,
    version: int = 3,
    count: int = 3,
    degree: int = 1,
    bits: int = 12,
    flags: int = 0,
    last: int = 0,
) -> bytes:
    return struct.pack("<4sIIBBBB", b"NGSP", version, count, degree, bits, flags, last)


def test_spz_headers(golden: Path, tmp_path: Path) -> None:
    body = gzip.decompress((golden / "three.v3.spz").read_bytes())[16:]

    def edited(message: str, data: bytes = body, **fields: int) -> None:
        refused(tmp_path / "a.spz", gzip.compress(spz_header(**fields) + data), message)

    edited("expected SPZ version 2, 3 or 4, got 1", version=1)
    edited("expected SPZ version 2, 3 or 4, got 5", version=5)
    edited("expected SPZ version 2 or 3 inside gzip, got 4", version=4)
    edited("expected harmonics of degree 0 to 4, got 5", degree=5)
    edited("expected at most 24 fractional bits, got 25", bits=25)
    edited("expected 116 bytes for 4 Gaussians of degree 1, got 87: the file is trunc", count=4)
    edited("expected 58 bytes for 2 Gaussians of degree 1, got more", count=2)
    edited("expected 60 bytes for 3 Gaussians of degree 0, got more", degree=0)
    edited("4000000000 Gaussians, which is .*--max-unpacked", count=4_000_000_000)
    refused(tmp_path / "a.spz", gzip.compress(b"NGSP"), "expected an SPZ header of 16 bytes, got 4")
    refused(tmp_path / "a.spz", spz_header(version=3), "version 4 outside gzip, got 3")
    good = gzip.compress(spz_header() + body)
    refused(tmp_path / "a.spz", good[:-5], "gzip data with their check sum, got none: truncated")
    refused(tmp_path / "a.spz", good[:-8] + b"\0" * 8, "expected gzip data of an SPZ file")
    with_extension = gzip.compress(spz_header(flags=2) + body + b"\1\0\0\0\0\0\0\0")
    (tmp_path / "a.spz").write_bytes(with_extension)
    assert len(read_splats(tmp_path / "a.spz")) == 3


def test_spz_made_for_antialiasing_is_remembered(golden: Path, tmp_path: Path) -> None:
    body = gzip.decompress((golden / "three.v3.spz").read_bytes())[16:]
    for flags in (0, 1):
        (tmp_path / "a.spz").write_bytes(gzip.compress(spz_header(flags=flags) + body))
        assert read_splats(tmp_path / "a.spz").antialiased == bool(flags)


def spz_4(streams: list[bytes], *, sizes: list[int] | None = None, **fields: int) -> bytes:
    """A version 4 file; `sizes` are the unpacked sizes that the table claims."""
    fields = {"version": 4, "degree": 0, "last": len(streams)} | fields
    frames = [zstandard.ZstdCompressor().compress(stream) for stream in streams]
    table = b"".join(
        struct.pack("<QQ", len(frame), size)
        for frame, size in zip(frames, sizes or [len(s) for s in streams], strict=True)
    )
    return spz_header(**fields) + struct.pack("<I12x", 32) + table + b"".join(frames)


def test_spz_4_streams(tmp_path: Path) -> None:
    good = [bytes(27), bytes(3), bytes(9), bytes(9), struct.pack("<3I", *[3 << 30] * 3)]
    path = tmp_path / "a.spz"
    path.write_bytes(spz_4(good))
    assert read_splats(path).rotations.tolist() == [[1, 0, 0, 0]] * 3
    refused(path, spz_4(good[:4]), "expected 5 streams for degree 0, got 4")
    refused(path, spz_4(good, degree=1), "expected 6 streams for degree 1, got 5")
    refused(path, spz_4([*good[:1], bytes(4), *good[2:]]), "3 bytes in stream 1 .* got 4")
    wrong = [27, 3, 9, 9, 12]
    refused(path, spz_4([bytes(26), *good[1:]], sizes=wrong), "27 bytes in stream 0 .*, got 26")
    refused(path, spz_4([bytes(28), *good[1:]], sizes=wrong), "27 bytes in stream 0 .*, got more")
    refused(path, spz_4(good) + b"x", "too long")
    refused(path, spz_4(good)[:-1], "truncated")
    refused(path, spz_4(good)[:20], "a header of 32 bytes, got 20: truncated")
    for table in (0, 31, 2000, 2**32 - 1):
        data = bytearray(spz_4(good))
        struct.pack_into("<I", data, 16, table)
        refused(
            path, bytes(data), f"a table of streams within the file .*, got one at byte {table}"
        )
    data = bytearray(spz_4(good))
    data[32 + 5 * 16] ^= 255
    refused(path, bytes(data), "stream 0 is no zstd data")
    huge = [9 * 10**9, 10**9, 3 * 10**9, 3 * 10**9, 4 * 10**9]
    refused(path, spz_4(good, count=10**9, sizes=huge), "1000000000 Gaussians, which is 56 GB")


# SOG.


def members(golden: Path, name: str) -> dict[str, bytes]:
    with zipfile.ZipFile(golden / name) as archive:
        return {entry: archive.read(entry) for entry in archive.namelist()}


def bundle(files: dict[str, bytes]) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return buffer.getvalue()


def picture(width: int, height: int, value: int = 255, format: str = "WEBP") -> bytes:
    buffer = io.BytesIO()
    Image.new("RGBA", (width, height), (value,) * 4).save(buffer, format, lossless=True)
    return buffer.getvalue()


def test_sog_bundles(golden: Path, tmp_path: Path) -> None:
    path = tmp_path / "a.sog"
    files = members(golden, "three.v2.sog")

    def edited(message: str, **changes: bytes | None) -> None:
        new = files | {f"{n.replace('_webp', '.webp')}": d for n, d in changes.items() if d}
        dropped = [n.replace("_webp", ".webp") for n, d in changes.items() if d is None]
        refused(path, bundle({n: d for n, d in new.items() if n not in dropped}), message)

    edited("expected a member 'quats.webp', got none", quats_webp=None)
    edited("expected at least 3 pixels in 'sh0.webp'.*, got 1 x 2", sh0_webp=picture(1, 2))
    edited(
        "expected at least 3 pixels in 'sh0.webp', and not many more", sh0_webp=picture(3000, 3000)
    )
    edited("expected a WebP picture in 'sh0.webp'", sh0_webp=b"no picture")
    edited("expected a WebP picture in 'sh0.webp'", sh0_webp=picture(4, 4, format="PNG"))
    broken = files["sh0.webp"][:30] + b"\xff" + files["sh0.webp"][31:]
    edited("'sh0.webp', but it cannot be read .failed to read", sh0_webp=broken)
    edited("3 of 3 Gaussians have a rotation whose alpha is not 252", quats_webp=picture(4, 4, 9))
    edited("3 of 3 Gaussians have a label beyond the palette", shN_labels_webp=picture(4, 4))
    edited("a palette of 192, 512 or 960 pixels", shN_centroids_webp=picture(100, 1))
    no_meta = {name: data for name, data in files.items() if name != "meta.json"}
    refused(path, bundle(no_meta), "expected a zip file with one meta.json, got 0")
    two = files | {"b/meta.json": files["meta.json"]}
    refused(path, bundle(two), "expected a zip file with one meta.json, got 2")
    path.write_bytes(bundle({f"folder/{name}": data for name, data in files.items()}))
    assert len(read_splats(path)) == 3
    damaged = bytearray(bundle(files))
    damaged[damaged.index(files["sh0.webp"]) + 20] ^= 255
    refused(path, bytes(damaged), "cannot be read .Bad CRC-32")


def edited_meta(files: dict[str, bytes], change: Callable[[dict], object]) -> bytes:  # type: ignore[type-arg]
    meta = json.loads(files["meta.json"])
    change(meta)
    return bundle(files | {"meta.json": json.dumps(meta).encode()})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m: m.update(version=3), "expected SOG version 1 or 2, got 3"),
        (lambda m: m.update(count=-1), r"count: expected .*, got -1"),
        (lambda m: m.update(count=True), r"count: expected .*, got True"),
        (lambda m: m.update(count=10**12), "1000000000000 Gaussians, which is 236000 GB"),
        (lambda m: m.update(count=2000), "expected at least 2000 pixels in"),
        (lambda m: m.pop("scales"), "expected a field scales, got none"),
        (lambda m: m["means"].pop("mins"), "means: expected a field mins, got none"),
        (lambda m: m["means"].update(mins=[0, 1]), "means.mins: expected .*length 3"),
        (
            lambda m: m["means"].update(mins=[0, 1, None]),
            r"means\.mins\[2\]: expected .*, got None",
        ),
        (lambda m: m["means"].update(maxs=[0, 1, float("nan")]), r"means\.maxs\[2\]: expected"),
        (lambda m: m["means"].update(maxs=[0, 1, 1e9]), "hold values that are NaN or infinite"),
        (lambda m: m["means"].update(files=["a"]), "means.files: expected .*length 2"),
        (lambda m: m["means"].update(files=[1, 2]), r"means\.files\[0\]: expected text, got 1"),
        (lambda m: m["quats"].update(files="x"), "quats.files: expected a list"),
        (lambda m: m.update(quats=3), "quats: expected an object, got 3"),
        (lambda m: m["scales"].update(codebook=[]), "scales.codebook: expected .*length"),
        (lambda m: m["scales"].update(codebook=[0.0]), "hold values that are NaN"),
        (
            lambda m: m["shN"].update(bands=2),
            "shN.bands: expected the degree of 3 coefficients, got 2",
        ),
        (lambda m: m["shN"].update(count=65), "at most the 64 entries of the palette"),
        (lambda m: m["shN"].update(count=2), "1 of 3 Gaussians have a label beyond the palette"),
    ],
)
def test_sog_meta(
    golden: Path,
    tmp_path: Path,
    change: Callable[[dict], object],  # type: ignore[type-arg]
    message: str,
) -> None:
    files = members(golden, "three.v2.sog")
    refused(tmp_path / "a.sog", edited_meta(files, change), message)


def test_sog_made_for_antialiasing_is_remembered(golden: Path, tmp_path: Path) -> None:
    files = members(golden, "three.v2.sog")
    for said, antialiased in ((True, True), (False, False), (1, False)):
        data = edited_meta(files, lambda meta, said=said: meta.update(antialias=said))
        (tmp_path / "a.sog").write_bytes(data)
        assert read_splats(tmp_path / "a.sog").antialiased == antialiased


def test_sog_names_stay_in_the_folder(golden: Path, tmp_path: Path) -> None:
    files = members(golden, "three.v2.sog")
    folder = tmp_path / "scene"
    folder.mkdir()
    for name, data in files.items():
        (folder / name).write_bytes(data)
    (tmp_path / "quats.webp").write_bytes(files["quats.webp"])
    for name in ("../quats.webp", str(tmp_path / "quats.webp")):
        meta = json.loads(files["meta.json"])
        meta["quats"]["files"] = [name]
        (folder / "meta.json").write_text(json.dumps(meta))
        with pytest.raises(FileFormatError, match="expected the name of a file in its folder"):
            read_splats(folder)
    (folder / "meta.json").write_bytes(files["meta.json"])
    (folder / "quats.webp").unlink()
    with pytest.raises(
        MissingFileError, match=r"a file 'quats\.webp', which meta\.json names, got none"
    ):
        read_splats(folder)


# Bombs: small files that unpack to a great deal.


def test_bombs_are_not_unpacked(golden: Path, tmp_path: Path) -> None:
    """Over 100 MB of zeros in each, of which only a part is ever held."""
    count = 20_000_000
    gzip_bomb = zlib.compressobj(1, wbits=31)
    packed = gzip_bomb.compress(spz_header(count=3, degree=0, flags=2))
    counted = gzip.compress(spz_header(count=count, degree=0) + bytes(1000))
    zeros = bytes(1 << 24)
    packed += b"".join(gzip_bomb.compress(zeros) for _ in range(8)) + gzip_bomb.flush()
    (tmp_path / "extension.spz").write_bytes(packed)
    (tmp_path / "count.spz").write_bytes(counted)
    streams = [bytes(16)] * 5
    sizes = [size * count for size in (9, 1, 3, 3, 4)]
    (tmp_path / "a.4.spz").write_bytes(spz_4(streams, count=count, sizes=sizes))
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("meta.json", bytes(130_000_000))
    (tmp_path / "a.sog").write_bytes(buffer.getvalue())
    del buffer, zeros, packed
    tracemalloc.start()
    for name in ("count.spz", "a.4.spz", "a.sog"):
        with pytest.raises(FileFormatError):
            read_splats(tmp_path / name)
    assert len(read_splats(tmp_path / "extension.spz")) == 3  # what follows is not unpacked
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 60_000_000
