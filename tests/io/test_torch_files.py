"""Files of PyTorch are read without running what is in them."""

import argparse
import pickle
import tempfile
import zipfile
from collections import OrderedDict
from pathlib import Path

import numpy as np
import pytest
import torch

from splatseg.errors import FileFormatError, MissingFileError
from splatseg.io.tensors import InertNumber, read_torch_file


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
    assert type(found["best"]) is type(found["history"]) is InertNumber
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
