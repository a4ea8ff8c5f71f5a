"""Files of ours, and of DNMP's training program."""

import argparse
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from splatseg.errors import FileFormatError, InputError, MissingFileError
from splatseg.io.tensors_writing import write_tensors
from splatseg.street.shape_files import load_shapes, save_shapes
from splatseg.street.shapes import ShapeAutoEncoder, ShapeConfig, new_shapes, template

SMALL = ShapeConfig(code_size=4, encoder_widths=(5, 6), decoder_widths=(7,))
WIDTH, CODE = 12, 8


def their_layers(first: int, last: int, seed: int) -> dict[str, Tensor]:
    """Tensors in DNMP's layout: four convolutions of length 1 and one more, narrower here."""
    rng = np.random.default_rng(seed)
    found: dict[str, Tensor] = {}
    names = [*(f"layer{i}.0" for i in range(1, 5)), "out_layer"]
    sizes = [first, *[WIDTH] * 4, last]
    for name, inputs, outputs in zip(names, sizes, sizes[1:], strict=False):
        weight = rng.normal(size=(outputs, inputs, 1)) / math.sqrt(inputs)
        found[f"{name}.weight"] = torch.from_numpy(weight).float()
        found[f"{name}.bias"] = torch.from_numpy(0.1 * rng.normal(size=outputs)).float()
    return found


def checkpoint() -> dict[str, Any]:
    """All that their trainer saves, besides its options."""
    encoder, decoder = their_layers(3, CODE, 1), their_layers(CODE, 126, 2)
    parameters = [nn.Parameter(one.clone()) for one in (*encoder.values(), *decoder.values())]
    optimiser = torch.optim.Adam(parameters, lr=1e-3, weight_decay=1e-6)
    sum(one.sum() for one in parameters).backward()
    optimiser.step()
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimiser, 0.999999)
    return {
        "step": 200000,
        "encoder_state_dict": encoder,
        "decoder_state_dict": decoder,
        "optimizer": optimiser.state_dict(),
        "scheduler": schedule.state_dict(),
        "config": argparse.Namespace(mesh_dir="meshes", lr=1e-3, max_iter=200000),
    }


def convolved(state: dict[str, Tensor], x: Tensor, *, pooled: bool) -> Tensor:
    """What a network of their layout makes of (batch, channels, points), by convolutions."""
    for i in range(1, 5):
        weight, bias = state[f"layer{i}.0.weight"], state[f"layer{i}.0.bias"]
        x = nn.functional.conv1d(x, weight, bias).relu()
    if pooled:
        x = x.amax(dim=2, keepdim=True)
    out = nn.functional.conv1d(x, state["out_layer.weight"], state["out_layer.bias"])
    return out.squeeze(2)


def test_the_published_layout_gives_what_its_program_finds(tmp_path: Path) -> None:
    content = checkpoint()
    path = tmp_path / "mesh_ae.pth"
    torch.save(content, path)
    shapes = load_shapes(path)
    assert shapes.config == ShapeConfig(
        code_size=CODE, encoder_widths=(WIDTH,) * 4, decoder_widths=(WIDTH,) * 4
    )
    assert not shapes.training
    points = torch.randn(3, 42, 3, generator=torch.Generator().manual_seed(0))
    found = convolved(content["encoder_state_dict"], points.transpose(1, 2), pooled=True)
    codes = found / found.norm(dim=1, keepdim=True)
    torch.testing.assert_close(shapes.encode(points), codes)
    offsets = convolved(content["decoder_state_dict"], codes[:, :, None], pooled=False)
    wanted = template()[0] + offsets.reshape(3, 42, 3)
    torch.testing.assert_close(shapes.decode(codes), wanted)


@pytest.mark.parametrize("kind", ["dict", "flat", "safetensors", "npz"])
def test_a_published_decoder_alone_is_enough_for_geometry(kind: str, tmp_path: Path) -> None:
    state = their_layers(CODE, 126, 2)
    path = tmp_path / {"safetensors": "a.safetensors", "npz": "a.npz"}.get(kind, "a.pth")
    if kind == "safetensors":
        write_tensors(state, path, metadata={})
    elif kind == "npz":
        np.savez(path, **{name: value.numpy() for name, value in state.items()})
    else:
        torch.save({"decoder_state_dict": state} if kind == "dict" else state, path)
    shapes = load_shapes(path)
    assert shapes.encoder is None
    codes = torch.eye(CODE)
    offsets = convolved(state, codes[:, :, None], pooled=False)
    torch.testing.assert_close(shapes.decode(codes) - template()[0], offsets.reshape(-1, 42, 3))
    with pytest.raises(InputError, match="got a decoder alone"):
        save_shapes(shapes, tmp_path / "b.safetensors", facts={})


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda c: c["decoder_state_dict"].pop("layer3.0.bias"), "layer3.0.bias: expected shape"),
        (
            lambda c: c["decoder_state_dict"].update({"out_layer.weight": torch.zeros(96, 12, 1)}),
            r"out_layer.weight: expected shape \(126, 12\), got \(96, 12, 1\)",
        ),
        (
            lambda c: c["encoder_state_dict"]["layer1.0.weight"].fill_(math.nan),
            "layer1.0.weight: expected finite numbers",
        ),
        (
            lambda c: c["encoder_state_dict"].update({"layer9.0.weight": torch.zeros(2, 2, 1)}),
            "layer9.0.weight: expected no tensor of this name",
        ),
        (lambda c: c.pop("decoder_state_dict"), "expected shapes of splatseg, or DNMP's"),
        (
            lambda c: c.update(decoder_state_dict={"layer1.0.weight": torch.zeros(4)}),
            r"layer1.0.weight: expected a matrix, got shape \(4,\)",
        ),
        (lambda c: c.update(decoder_state_dict=[1, 2]), "got something else"),
    ],
)
def test_published_files_with_faults_are_refused(spoil: Any, words: str, tmp_path: Path) -> None:
    content = checkpoint()
    spoil(content)
    path = tmp_path / "mesh_ae.pth"
    torch.save(content, path)
    with pytest.raises(FileFormatError, match=words):
        load_shapes(path)


def test_ours_come_back_as_they_were(tmp_path: Path) -> None:
    shapes = new_shapes(SMALL, seed=1)
    path = tmp_path / "a.safetensors"
    save_shapes(shapes, path, facts={"recipe": {"steps": 3}})
    found = load_shapes(path)
    assert found.config == SMALL
    wanted, got = shapes.state_dict(), found.state_dict()
    assert list(wanted) == list(got)
    for name, value in got.items():
        assert value.dtype == torch.float32
        assert torch.equal(value, wanted[name].half().float())
    again = tmp_path / "b.safetensors"
    save_shapes(found, again, facts={"recipe": {"steps": 3}})
    assert again.read_bytes() == path.read_bytes()


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('"version":"1"', '"version":"2"', "expected version 1 of splatseg.street.shapes, got '2'"),
        (r"\"code_size\"", r"\"code_sizo\"", "expected facts and a config of code_size"),
        (r"\"code_size\": 4", r"\"code_size\": 1", r"code_size: expected a value in \[2, 4096\]"),
        (r"\"code_size\": 4", r"\"code_size\": 5", "expected shape"),
        (r"\"code_size\": 4", r"\"code_size\":[]", "code_size"),
        ("decoder.layers.0.bias", "decoder.layers.9.bias", "decoder.layers"),
    ],
)
def test_files_of_ours_with_faults_are_refused(
    old: str, new: str, words: str, tmp_path: Path
) -> None:
    path = tmp_path / "a.safetensors"
    save_shapes(new_shapes(SMALL, seed=1), path, facts={})
    data = path.read_bytes()
    assert old.encode() in data or old.replace(": ", ":").encode() in data, data[:600]
    if old.encode() not in data:
        old, new = old.replace(": ", ":"), new.replace(": ", ":")
    size = int.from_bytes(data[:8], "little")
    header = data[8 : 8 + size].replace(old.encode(), new.encode())
    path.write_bytes(len(header).to_bytes(8, "little") + header + data[8 + size :])
    with pytest.raises(FileFormatError, match=words):
        load_shapes(path)


def test_files_that_are_not_there_or_none_are_refused(tmp_path: Path) -> None:
    with pytest.raises(MissingFileError):
        load_shapes(tmp_path / "none.safetensors")
    damaged = tmp_path / "a.safetensors"
    damaged.write_bytes(b"\x09\0\0\0\0\0\0\0{")
    with pytest.raises(FileFormatError, match="header is cut off"):
        load_shapes(damaged)
    text = tmp_path / "a.pth"
    text.write_text("weights")
    with pytest.raises(FileFormatError, match="got another kind of file"):
        load_shapes(text)


def test_weights_that_cannot_be_halved_are_refused(tmp_path: Path) -> None:
    shapes = ShapeAutoEncoder(SMALL)
    with torch.no_grad():
        shapes.decoder.layers[0].bias[2] = 1e6
    with pytest.raises(InputError, match=r"decoder.layers.0.bias: expected weights .* got 1e\+06"):
        save_shapes(shapes, tmp_path / "a.safetensors", facts={})
    assert not list(tmp_path.iterdir())
