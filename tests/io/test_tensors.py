"""Tensors in files that run no code: read, written, and checkpoints of PyTorch."""

import argparse
import json
import pickle
import tempfile
import zipfile
from collections import OrderedDict
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from splatseg.errors import FileFormatError, InputError, MissingFileError
from splatseg.io.tensors import (
    NumpyStub,
    read_safetensors,
    read_safetensors_words,
    read_tensors,
    read_torch_file,
    write_tensors,
)


def test_safetensors_as_its_own_library_writes_them(tmp_path) -> None:
    generator = torch.Generator().manual_seed(1)
    tensors = {
        "a.weight": torch.randn(3, 2, 5, generator=generator),
        "half": torch.randn(7, generator=generator).half(),
        "brain": torch.randn(4, generator=generator).bfloat16(),
        "double": torch.randn(2, 2, generator=generator).double(),
        "whole": torch.arange(-3, 4),
        "int": torch.arange(5, dtype=torch.int32),
        "bytes": torch.arange(250, 256, dtype=torch.uint8),
        "scalar": torch.tensor(2.5),
        "empty": torch.zeros(0, 3),
    }
    save_file(tensors, tmp_path / "w.safetensors", metadata={"format": "pt"})
    back = read_tensors(tmp_path / "w.safetensors")
    assert back.keys() == tensors.keys()
    for name, tensor in tensors.items():
        assert back[name].dtype == tensor.dtype
        assert torch.equal(back[name], tensor)


def test_npz(tmp_path) -> None:
    np.savez(tmp_path / "w.npz", **{"a.b": np.eye(3, dtype=np.float32)})
    assert torch.equal(read_tensors(tmp_path / "w.npz")["a.b"], torch.eye(3))


def test_pickles_are_refused_and_not_opened(tmp_path) -> None:
    class Trap:
        def __reduce__(self):
            return (pytest.fail, ("the pickle was run",))

    for name in ("w.pth", "w.pt", "w.bin"):
        (tmp_path / name).write_bytes(pickle.dumps(Trap()))
        with pytest.raises(InputError, match="weights_only=True"):
            read_tensors(tmp_path / name)
    (tmp_path / "w.npz").write_bytes(pickle.dumps(Trap()))
    with pytest.raises(FileFormatError, match=r"w.npz"):
        read_tensors(tmp_path / "w.npz")
    np.savez(tmp_path / "o.npz", x=np.array([Trap()], dtype=object))
    with pytest.raises(FileFormatError, match=r"o.npz"):
        read_tensors(tmp_path / "o.npz")


def _file(path, header: object, body: bytes = b"") -> None:
    words = json.dumps(header).encode() if not isinstance(header, bytes) else header
    path.write_bytes(len(words).to_bytes(8, "little") + words + body)


@pytest.mark.parametrize(
    ("header", "match"),
    [
        (b"{", "JSON"),
        ([], "a JSON object"),
        ({"x": {"dtype": "F32"}}, "tensor 'x': expected a field shape"),
        ({"x": 3}, "tensor 'x': expected an object, got 3"),
        ({"x": {"dtype": "F8", "shape": [1], "data_offsets": [0, 1]}}, "got 'F8'"),
        ({"x": {"dtype": "F32", "shape": [3], "data_offsets": [0, 8]}}, "12 bytes within the file"),
        ({"x": {"dtype": "F32", "shape": [2], "data_offsets": [4, 12]}}, "8 bytes within the file"),
        ({"x": {"dtype": "F32", "shape": [-2], "data_offsets": [8, 0]}}, "whole number"),
    ],
)
def test_damaged_headers(tmp_path, header, match) -> None:
    _file(tmp_path / "w.safetensors", header, bytes(8))
    with pytest.raises(FileFormatError, match=match):
        read_tensors(tmp_path / "w.safetensors")


def test_cut_off_or_not_there(tmp_path) -> None:
    path = tmp_path / "w.safetensors"
    for data in (b"", b"1234", (10**15).to_bytes(8, "little") + b"{}"):
        path.write_bytes(data)
        with pytest.raises(FileFormatError, match="cut off"):
            read_tensors(path)
    with pytest.raises(MissingFileError):
        read_tensors(tmp_path / "none.npz")
    path.rename(tmp_path / "w.txt")
    with pytest.raises(InputError, match="got .txt"):
        read_tensors(tmp_path / "w.txt")


def test_the_words_of_a_header_are_read_alone(tmp_path) -> None:
    path = tmp_path / "w.safetensors"
    save_file({"a": torch.zeros(9)}, path, metadata={"format": "pt", "about": "it"})
    assert (
        read_safetensors_words(path)
        == read_safetensors(path)[1]
        == {
            "format": "pt",
            "about": "it",
        }
    )
    save_file({"a": torch.zeros(9)}, tmp_path / "bare.safetensors")
    assert read_safetensors_words(tmp_path / "bare.safetensors") == {}
    data = path.read_bytes()
    for damaged, words in (
        (data[:4], "its header is cut off"),
        (data[:40], "its header is cut off"),
        (b"\xff" * 8 + data[8:], "its header is cut off"),
        (data[:8] + b"x" + data[9:], "header"),
        (
            len(text := b'{"__metadata__": 3}').to_bytes(8, "little") + text,
            "__metadata__: expected an object, got 3",
        ),
    ):
        path.write_bytes(damaged)
        with pytest.raises(FileFormatError, match=words):
            read_safetensors_words(path)
    with pytest.raises(MissingFileError, match="there is no such file"):
        read_safetensors_words(tmp_path / "none.safetensors")


# Tensors written as safetensors are read back the same, by our reader and by the library's.


def tensors() -> dict[str, torch.Tensor]:
    numbers = torch.arange(6.0).reshape(2, 3) - 2.5
    return {
        "b.weight": numbers.T,
        "a": numbers.half(),
        "brain": numbers.bfloat16(),
        "count": torch.tensor(7),
        "none": torch.zeros(0, 3),
    }


def test_what_is_written_is_read(tmp_path: Path) -> None:
    path = tmp_path / "a.safetensors"
    write_tensors(tensors(), path, metadata={"made by": "é"})
    found, words = read_safetensors(path)
    assert words == {"made by": "é"}
    assert list(found) == list(tensors())
    for name, tensor in tensors().items():
        assert found[name].dtype == tensor.dtype
        assert torch.equal(found[name], tensor)
    assert read_tensors(path).keys() == found.keys()


def test_the_library_reads_it(tmp_path: Path) -> None:
    path = tmp_path / "a.safetensors"
    write_tensors(tensors(), path, metadata={"x": "y"})
    with safe_open(path, "pt") as file:
        assert file.metadata() == {"x": "y"}
        for name, tensor in tensors().items():
            assert torch.equal(file.get_tensor(name), tensor)


def test_the_same_tensors_give_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a", "b"):
        write_tensors(tensors(), tmp_path / f"{name}.safetensors", metadata={})
    first, second = ((tmp_path / f"{name}.safetensors").read_bytes() for name in "ab")
    assert first == second
    assert int.from_bytes(first[:8], "little") % 8 == 0


def test_what_cannot_be_written(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"a\.npz: expected \.safetensors, got \.npz"):
        write_tensors({}, tmp_path / "a.npz", metadata={})
    with pytest.raises(InputError, match="x: expected a type of safetensors, got torch.complex64"):
        write_tensors({"x": torch.zeros(1) * 1j}, tmp_path / "a.safetensors", metadata={})
    with pytest.raises(MissingFileError, match="missing"):
        write_tensors({}, tmp_path / "no" / "a.safetensors", metadata={})


def test_metadata_are_text(tmp_path: Path) -> None:
    words = json.dumps({"__metadata__": {"a": 3}}).encode()
    path = tmp_path / "a.safetensors"
    path.write_bytes(len(words).to_bytes(8, "little") + words)
    with pytest.raises(FileFormatError, match="__metadata__: .*expected text"):
        read_safetensors(path)


# Files of PyTorch are read without running what is in them.


class Trap:
    """Makes a folder when it is unpickled as pickles are."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def __reduce__(self) -> tuple:
        return tempfile.mkdtemp, ("", "made", str(self.folder))


def test_what_is_no_tensor_is_inert(tmp_path: Path) -> None:
    content = {
        "weights": {"a": torch.arange(3.0)},
        "best": np.float64(0.5),
        "history": np.arange(4),
        "options": argparse.Namespace(rate=0.1),
        "trap": Trap(tmp_path),
        "epoch": 3,
    }
    torch.save(content, tmp_path / "a.pth")
    found = read_torch_file(tmp_path / "a.pth")
    assert isinstance(found, dict)
    assert found["epoch"] == 3
    assert not list(tmp_path.glob("made*"))
    assert torch.equal(found["weights"]["a"], torch.arange(3.0))
    assert type(found["best"]) is type(found["history"]) is NumpyStub
    assert type(found["options"]) is type(found["trap"]) is OrderedDict


def test_other_files(tmp_path: Path) -> None:
    with pytest.raises(MissingFileError, match="there is no such file"):
        read_torch_file(tmp_path / "a.pth")
    (tmp_path / "b.pth").write_bytes(pickle.dumps(Trap(tmp_path)))
    with pytest.raises(FileFormatError, match="got another kind of file"):
        read_torch_file(tmp_path / "b.pth")
    assert not list(tmp_path.glob("made*"))
    with pytest.raises(FileFormatError, match=r"expected a checkpoint of PyTorch 1\.6 or later"):
        read_torch_file(tmp_path)
    with zipfile.ZipFile(tmp_path / "c.pth", "w") as file:
        file.writestr("c/data.pkl", b"o no pickle")
        file.writestr("c/version", b"3")
    with pytest.raises(FileFormatError, match=r"c\.pth: expected a checkpoint"):
        read_torch_file(tmp_path / "c.pth")
