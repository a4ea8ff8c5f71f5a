"""Arrays of NumPy from files: headers are held against bytes, and nothing else is unpacked."""

import io
import re
import zipfile
from pathlib import Path

import numpy as np
import pytest

from splatseg.errors import FileFormatError, MissingFileError
from splatseg.io.arrays import npz_names, open_npz, read_npy, read_npz
from splatseg.io.limits import FREE

HUGE = "(1099511627775, 4)"


def header(shape: str, *, dtype: str = "<f4", fortran: str = "False") -> bytes:
    words = f"{{'descr': '{dtype}', 'fortran_order': {fortran}, 'shape': {shape}, }}"
    return b"\x93NUMPY\x01\x00" + (len(words) + 1).to_bytes(2, "little") + words.encode() + b"\n"


def npz(path: Path, **members: bytes) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(f"{name}.npy", content)
    return path


@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("dtype", ["<f4", ">f8", "?", "<i8", ">u2", "<f2", "<U3"])
def test_what_numpy_writes_is_read_back(tmp_path, order, dtype) -> None:
    values = np.asarray(np.arange(12).reshape(3, 4) % 2, dtype=dtype, order=order)
    np.save(tmp_path / "a.npy", values)
    np.savez_compressed(tmp_path / "a.npz", a=values)
    for back in (read_npy(tmp_path / "a.npy"), read_npz(tmp_path / "a.npz", ["a"])["a"]):
        np.testing.assert_array_equal(back, values)
        assert back.dtype.isnative


@pytest.mark.parametrize("shape", [(), (0,), (0, 4), (4, 0)])
def test_scalars_and_empty_arrays(tmp_path, shape) -> None:
    np.save(tmp_path / "a.npy", np.zeros(shape, np.float32))
    assert read_npy(tmp_path / "a.npy").shape == shape
    assert read_npy(tmp_path / "a.npy", mapped=True).shape == shape


def test_mapped_arrays_are_copied_on_write(tmp_path) -> None:
    np.save(tmp_path / "a.npy", np.arange(5))
    mapped = read_npy(tmp_path / "a.npy", mapped=True)
    mapped[0] = 9
    assert isinstance(mapped, np.memmap)
    assert read_npy(tmp_path / "a.npy").tolist() == [0, 1, 2, 3, 4]


@pytest.mark.parametrize(
    "content",
    [
        header(HUGE) + b"\0" * 64,
        header("(2,)") + b"\0" * 7,
        header("(2,)") + b"\0" * 9,
        header("(-1, -2)") + b"\0" * 8,
        header("(4,)", dtype="|O") + b"\0" * 32,
        header("(2,)", dtype="<c16") + b"\0" * 32,
        header("(2,)", dtype="|V4") + b"\0" * 8,
        header("(1000000000000000000,)", dtype="<U0"),
        header("(1,)", dtype="<U1000000000") + b"\0" * 64,
        header("(" + "1," * 400 + ")") + b"\0" * 4,
        header("(" * 3000),
        header("(2,)", dtype="x" * 2000),
        b"\x93NUMPY\x01\x00\xff\xff{",
        b"\x93NUMPY\x07\x00" + b"\0" * 64,
        header("(1,)", dtype="<U1") + b"\0\xd8\0\0",
        header("(1,)", dtype="<U1") + b"\xff\xff\xff\x7f",
        b"",
    ],
)
def test_a_header_that_is_not_true_is_refused_in_short_words(tmp_path, content) -> None:
    (tmp_path / "a.npy").write_bytes(content)
    npz(tmp_path / "a.npz", a=content)
    for path in (tmp_path / "a.npy", tmp_path / "a.npz"):
        with pytest.raises(FileFormatError, match=re.escape(str(path))) as caught:
            read_npy(path) if path.suffix == ".npy" else read_npz(path, ["a"])
        assert len(str(caught.value)) < len(str(path)) + 300


def test_files_that_are_not_there_and_folders(tmp_path) -> None:
    (tmp_path / "f.npy").mkdir()
    with pytest.raises(MissingFileError, match="none.npy"):
        read_npy(tmp_path / "none.npy")
    with pytest.raises(MissingFileError, match="none.npz"):
        read_npz(tmp_path / "none.npz", ["a"])
    with pytest.raises(FileFormatError, match="f.npy"):
        read_npy(tmp_path / "f.npy")
    assert npz_names(tmp_path / "none.npz") == ()


def test_zeros_that_were_compressed_are_refused_unread(tmp_path) -> None:
    side = FREE // 4 + 1
    content = header(f"({side},)") + b"\0" * (4 * side)
    path = npz(tmp_path / "a.npz", a=content)
    assert path.stat().st_size < FREE // 500
    with pytest.raises(FileFormatError, match=r"a.npz.*--max-unpacked 1GB"):
        read_npz(path, ["a"])


def test_members_that_nobody_asks_for_are_not_unpacked(tmp_path) -> None:
    good = io.BytesIO()
    np.save(good, np.arange(3))
    path = npz(tmp_path / "a.npz", a=good.getvalue(), b=header(HUGE), c=b"junk")
    assert read_npz(path, ["a"], optional=["d"])["a"].tolist() == [0, 1, 2]
    assert npz_names(path) == ("a", "b", "c")


def test_arrays_of_one_archive_count_together(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("splatseg.io.limits._free", 100_000)
    np.savez_compressed(tmp_path / "a.npz", a=np.zeros(9000), b=np.zeros(9000))
    with open_npz(tmp_path / "a.npz") as archive:
        archive.array("a")
        with pytest.raises(FileFormatError, match="arrays"):
            archive.array("b")


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_other_compressions_are_refused(tmp_path, method) -> None:
    with zipfile.ZipFile(tmp_path / "a.npz", "w", method) as archive:
        archive.writestr("a.npy", header("(1,)") + b"\0" * 4)
    with pytest.raises(FileFormatError, match=r"a.npz.*stored or deflated"):
        read_npz(tmp_path / "a.npz", ["a"])


def test_a_flipped_bit_of_the_values_is_found(tmp_path) -> None:
    np.savez(tmp_path / "a.npz", a=np.arange(100))
    data = bytearray((tmp_path / "a.npz").read_bytes())
    data[600] ^= 1
    (tmp_path / "a.npz").write_bytes(data)
    with pytest.raises(FileFormatError, match=r"a.npz.*CRC"):
        read_npz(tmp_path / "a.npz", ["a"])


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_a_check_sum_that_is_not_that_of_the_values_is_found(tmp_path, save) -> None:
    save(tmp_path / "a.npz", a=np.arange(100))
    data = bytearray((tmp_path / "a.npz").read_bytes())
    data[data.index(b"PK\x01\x02") + 16] ^= 1  # the CRC of the member, in the directory
    (tmp_path / "a.npz").write_bytes(data)
    with pytest.raises(FileFormatError, match=r"a.npz.*CRC"):
        read_npz(tmp_path / "a.npz", ["a"])


def test_long_names_are_cut_in_messages(tmp_path) -> None:
    path = npz(tmp_path / "a.npz", **{"x" * 5000: b"", "y" * 5000: b""})
    with pytest.raises(FileFormatError) as caught:
        read_npz(path, ["a"])
    assert len(str(caught.value)) < len(str(path)) + 300


def test_no_other_reader_of_arrays_or_json_is_in_the_package() -> None:
    """`io.arrays` and `io.json_files` refuse what hurts; anything beside them would not."""
    source = Path(__file__).parents[2] / "src" / "splatseg"
    calls = re.compile(
        r"\b(np|numpy)\.(load|memmap|fromregex|genfromtxt|loadtxt)\(|\bjson\.loads?\(|torch\.load\("
    )
    allowed = {"io/json_files.py": ["json.loads("], "io/arrays.py": ["np.memmap("]}
    allowed |= {"io/ply.py": ["np.memmap("], "io/text_numbers.py": ["np.loadtxt("]}  # of lines
    # With weights_only: a checkpoint as its authors published it.
    allowed["io/tensors.py"] = ["torch.load("]
    allowed["street/training_rays.py"] = ["np.memmap("]
    allowed["pose/_worker.py"] = ["json.loads("]  # a job of ours, and the core would bring torch
    found = {
        path.relative_to(source).as_posix(): [m.group() for m in calls.finditer(text)]
        for path in sorted(source.rglob("*.py"))
        if calls.search(text := _without_strings(path.read_text(encoding="utf-8")))
    }
    assert found == allowed


def _without_strings(text: str) -> str:
    return re.sub(r'""".*?"""|"(?:[^"\\\n]|\\.)*"', '""', text, flags=re.DOTALL)
