"""Weights from files that run no code."""

import json
import pickle

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from splatseg.errors import FileFormatError, InputError, MissingFileError
from splatseg.io.tensors import read_safetensors, read_safetensors_words, read_tensors


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
        ({"x": {"dtype": "F32"}}, "type, shape and place"),
        ({"x": 3}, "type, shape and place"),
        ({"x": {"dtype": "F8", "shape": [1], "data_offsets": [0, 1]}}, "got 'F8'"),
        ({"x": {"dtype": "F32", "shape": [3], "data_offsets": [0, 8]}}, "size"),
        ({"x": {"dtype": "F32", "shape": [2], "data_offsets": [4, 12]}}, "size"),
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
        (len(text := b'{"__metadata__": 3}').to_bytes(8, "little") + text, "text in __metadata__"),
    ):
        path.write_bytes(damaged)
        with pytest.raises(FileFormatError, match=words):
            read_safetensors_words(path)
    with pytest.raises(MissingFileError, match="there is no such file"):
        read_safetensors_words(tmp_path / "none.safetensors")
