"""Tensors written as safetensors are read back the same, by our reader and by the library's."""

import json
from pathlib import Path

import pytest
import torch
from safetensors import safe_open

from splatseg.errors import FileFormatError, InputError, MissingFileError
from splatseg.io.tensors import read_safetensors, read_tensors, write_tensors


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
    with pytest.raises(FileFormatError, match="expected text in __metadata__, got {'a': 3}"):
        read_safetensors(path)
