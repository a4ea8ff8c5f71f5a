"""Checkpoints of other implementations give what those implementations find."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from splatseg.errors import FileFormatError, MissingFileError
from splatseg.io.tensors import write_tensors
from splatseg.lift.point_network import PointInputs, load_point_encoder, point_pyramid
from splatseg.lift.point_network.pyramid import PyramidOptions

from .conftest import scene
from .layouts import FIRST, WIDTHS, WRITERS, answer, state_dict


def saved(state: dict[str, Tensor], path: Path) -> Path:
    """As the programs that train do: with more than the tensors."""
    rest = {"param_groups": [{"lr": np.float64(0.1)}], "state": {0: torch.zeros(3)}}
    torch.save({"epoch": 3, "model_state_dict": state, "optimizer_state_dict": rest}, path)
    return path


@pytest.mark.parametrize("inputs", [3, 6])
@pytest.mark.parametrize("name", WRITERS)
def test_features_are_those_of_its_program(name: str, inputs: int, tmp_path: Path) -> None:
    writer = WRITERS[name]
    state = state_dict(writer, inputs)
    found = load_point_encoder(saved(state, tmp_path / "a.pth"))
    assert (found.layout, found.source, found.colour) == (name, "a.pth", inputs == 6)
    assert (found.config.first_width, found.config.widths) == (FIRST, WIDTHS)
    assert (found.config.neighbours, found.config.ratios) == (16, (4, 4, 4, 4))
    positions, colours = scene(120)
    # As few neighbours and points as loops can go through.
    options = PyramidOptions(neighbours=3, ratios=(3, 2, 2, 2))
    pyramid = point_pyramid(positions, options=options, seed=2)
    fed = torch.cat((positions, colours), dim=1)[:, :inputs]
    wanted = answer(writer, state, pyramid, fed)
    for one, two in zip(found.encoder(pyramid, fed), wanted, strict=True):
        assert np.abs(two).max() > 0.1
        np.testing.assert_allclose(one, two, rtol=2e-4, atol=2e-4)


@pytest.mark.parametrize(
    ("name", "inputs", "wanted"),
    [
        ("open3d", 6, PointInputs(grid_size=0.04, origin="floor", colour_range=255.0)),
        ("open3d-2020", 3, PointInputs(grid_size=0.06)),
        ("ari0u", 6, PointInputs(grid_size=0.04)),
        ("tsunghan-wu", 3, PointInputs(grid_size=0.06)),
    ],
)
def test_what_a_file_does_not_say_is_told(
    name: str, inputs: int, wanted: PointInputs, tmp_path: Path
) -> None:
    path = saved(state_dict(WRITERS[name], inputs), tmp_path / "a.pth")
    found = load_point_encoder(path)
    assert found.inputs == wanted
    assert found.assumed == ("neighbours", "ratios", "inputs")
    said = PointInputs(grid_size=0.01)
    found = load_point_encoder(path, inputs=said)
    assert (found.inputs, found.assumed) == (said, ("neighbours", "ratios"))


def test_five_levels_are_those_of_rooms(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(state_dict.__module__ + ".WIDTHS", (4, 4, 4, 4, 4))
    found = load_point_encoder(saved(state_dict(WRITERS["open3d"], 6), tmp_path / "a.pth"))
    assert found.config.ratios == (4, 4, 4, 4, 2)


def test_ways_of_saving(tmp_path: Path) -> None:
    """Tensors alone, safetensors, NumPy's, those of several GPUs, and an older name."""
    state = state_dict(WRITERS["ari0u"], 6)
    plain = {name: value for name, value in state.items() if value.ndim}
    torch.save(state, tmp_path / "bare.pth")
    torch.save({"state_dict": state}, tmp_path / "lightning.ckpt")
    torch.save({f"module.{name}": value for name, value in state.items()}, tmp_path / "gpus.pth")
    write_tensors(state, tmp_path / "a.safetensors", metadata={"format": "pt"})
    np.savez(tmp_path / "a.npz", **{name: value.numpy() for name, value in plain.items()})
    older = {name.replace("bn_start.0", "bn_start"): value for name, value in state.items()}
    torch.save(older, tmp_path / "older.pth")
    wanted = load_point_encoder(tmp_path / "bare.pth").encoder.state_dict()
    for name in ("lightning.ckpt", "gpus.pth", "a.safetensors", "a.npz", "older.pth"):
        found = load_point_encoder(tmp_path / name).encoder.state_dict()
        assert all(torch.equal(found[key], wanted[key]) for key in wanted), name


LAYER = "encoder.1.lse1.mlp.conv.weight"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda s: s.pop(LAYER), f"{LAYER}: expected shape (4, 10), got no such tensor."),
        (
            lambda s: s.pop("encoder.1.lse1.mlp.conv.bias"),
            "encoder.1.lse1.mlp.conv.bias: expected shape (4,), got no such tensor.",
        ),
        (
            lambda s: s.update({LAYER: torch.zeros(4, 11, 1, 1)}),
            f"{LAYER}: expected shape (4, 10), got (4, 11, 1, 1).",
        ),
        (
            lambda s: s.update({LAYER: torch.zeros(4, 10, 3, 3)}),
            f"{LAYER}: expected shape (4, 10), got (4, 10, 3, 3).",
        ),
        (
            lambda s: s.update({"encoder.1.mlp1.conv.weight": torch.zeros(4)}),
            "encoder.1.mlp1.conv.weight: expected a matrix, got shape (4,).",
        ),
        (
            lambda s: s.update({"encoder.1.lse3.mlp.conv.weight": torch.zeros(4)}),
            "encoder.1.lse3.mlp.conv.weight: expected no tensor of this name in such a network, "
            "got one of shape (4,).",
        ),
        (
            lambda s: s.update({"encoder.5.mlp1.conv.weight": torch.zeros(4, 2)}),
            "encoder.5.mlp1.conv.weight: expected no tensor of this name in such a network",
        ),
        (
            lambda s: s.update({"fc0.weight": torch.zeros(8, 4)}),
            "inputs: expected 3 or 6 channels, got 4.",
        ),
        (lambda s: s.pop("fc0.weight"), "expected a RandLA-Net of splatseg, or tensors of a known"),
        (lambda s: s.clear(), "expected tensors by name or a state_dict, got none."),
    ],
)
def test_tensors_that_do_not_fit(change: Any, message: str, tmp_path: Path) -> None:
    state = state_dict(WRITERS["open3d"], 6)
    change(state)
    path = saved(state, tmp_path / "a.pth")
    with pytest.raises(FileFormatError) as caught:
        load_point_encoder(path)
    assert str(caught.value).startswith(f"{path}: {message}")


def test_files_that_are_none(tmp_path: Path) -> None:
    with pytest.raises(MissingFileError, match=r"a\.pth: there is no such file"):
        load_point_encoder(tmp_path / "a.pth")
    (tmp_path / "b.pth").write_bytes(b"no checkpoint")
    with pytest.raises(FileFormatError, match=r"b\.pth: expected a checkpoint of PyTorch 1\.6"):
        load_point_encoder(tmp_path / "b.pth")
    torch.save([1, 2], tmp_path / "c.pth")
    with pytest.raises(FileFormatError, match=r"c\.pth: expected tensors by name or a state_dict"):
        load_point_encoder(tmp_path / "c.pth")
