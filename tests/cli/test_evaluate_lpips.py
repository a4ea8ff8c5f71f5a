"""evaluate --lpips with the user's files."""

import json

import torch
from PIL import Image
from safetensors.torch import save_file


def _weights(path) -> None:
    """AlexNet of random weights, seeded."""
    torch.manual_seed(5)
    shapes = {
        0: (64, 3, 11),
        3: (192, 64, 5),
        6: (384, 192, 3),
        8: (256, 384, 3),
        10: (256, 256, 3),
    }
    state = {}
    for level, (index, (out, channels, side)) in enumerate(shapes.items()):
        state[f"features.{index}.weight"] = torch.randn(out, channels, side, side) * 0.05
        state[f"features.{index}.bias"] = torch.rand(out) * 0.1
        state[f"lin{level}.model.1.weight"] = torch.rand(1, out, 1, 1)
    save_file(state, path)


def test_lpips_is_one_more_figure(small, splatseg, tmp_path) -> None:
    _weights(tmp_path / "alex.safetensors")
    cameras = small.scene / "cameras" / "transforms.json"
    content = json.loads(cameras.read_text())
    for key in ("w", "h", "fl_x", "fl_y", "cx", "cy"):
        content[key] *= 2
    cameras.write_text(json.dumps(content))
    for path in (small.capture / "images").glob("*.png"):
        with Image.open(path) as image:
            image.resize((56, 40)).save(path)
    words = ("evaluate", small.scene, "--backend", "cpu", "--json")
    status, out, err = splatseg(*words, "--lpips", tmp_path / "alex.safetensors")
    assert status == 0, err
    figures = json.loads(out)
    assert figures["LPIPS_network"] == "alex"
    assert 0 < figures["LPIPS"] < 5
    status, out, err = splatseg(*words)
    assert status == 0, err
    assert "LPIPS" not in json.loads(out)


def test_refusals(small, splatseg, tmp_path) -> None:
    status, _, err = splatseg("evaluate", small.scene, "--lpips", tmp_path / "none.npz")
    assert (status, "none.npz: there is no such file" in err) == (2, True)
    (tmp_path / "a.pth").write_bytes(b"x")
    status, _, err = splatseg("evaluate", small.scene, "--lpips", tmp_path / "a.pth")
    assert (status, "weights_only=True" in err) == (2, True)
