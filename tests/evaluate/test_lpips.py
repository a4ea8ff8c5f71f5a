"""LPIPS with random weights: against the formula by hand, and against torch.nn's layers."""

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from torch import nn

from splatseg.errors import InputError, ShapeError
from splatseg.evaluate.photographs import load_lpips

ALEX_TAPS, VGG_TAPS = (1, 4, 7, 9, 11), (3, 8, 15, 22, 29)


def alexnet() -> nn.Sequential:
    """The feature layers in the order of the paper's code, numbered as torchvision's are."""
    return nn.Sequential(
        nn.Conv2d(3, 64, 11, 4, 2), nn.ReLU(), nn.MaxPool2d(3, 2),
        nn.Conv2d(64, 192, 5, padding=2), nn.ReLU(), nn.MaxPool2d(3, 2),
        nn.Conv2d(192, 384, 3, padding=1), nn.ReLU(),
        nn.Conv2d(384, 256, 3, padding=1), nn.ReLU(),
        nn.Conv2d(256, 256, 3, padding=1), nn.ReLU(),
    )  # fmt: skip


def vgg16() -> nn.Sequential:
    layers: list[nn.Module] = []
    channels = 3
    for width in (64, 64, 0, 128, 128, 0, 256, 256, 256, 0, 512, 512, 512, 0, 512, 512, 512):
        if width == 0:
            layers.append(nn.MaxPool2d(2, 2))
            continue
        layers += [nn.Conv2d(channels, width, 3, padding=1), nn.ReLU()]
        channels = width
    return nn.Sequential(*layers)


def heads(taps: tuple[int, ...], network: nn.Sequential) -> dict[str, torch.Tensor]:
    widths = [network[tap - 1].out_channels for tap in taps]
    return {f"lin{i}.model.1.weight": torch.rand(1, w, 1, 1) for i, w in enumerate(widths)}


def by_the_formula(network, taps, weights, one: np.ndarray, other: np.ndarray) -> float:
    """Eq. 1 pixel by pixel, in float64."""
    features = []
    for image in (one, other):
        x = torch.from_numpy(image / 255.0 * 2 - 1).double().permute(2, 0, 1)
        x = (x - torch.tensor([[[-0.030]], [[-0.088]], [[-0.188]]])) / torch.tensor(
            [[[0.458]], [[0.448]], [[0.450]]]
        )
        taken = []
        for i, layer in enumerate(network.double()):
            x = layer(x[None])[0]
            if i in taps:
                taken.append(x.detach().numpy())
        features.append(taken)
    total = 0.0
    for level, (a, b) in enumerate(zip(*features, strict=True)):
        weight = weights[f"lin{level}.model.1.weight"].double().numpy().reshape(-1)
        _, rows, columns = a.shape
        for i in range(rows):
            for j in range(columns):
                p, q = a[:, i, j], b[:, i, j]
                p, q = p / (np.linalg.norm(p) + 1e-10), q / (np.linalg.norm(q) + 1e-10)
                total += (weight * (p - q) ** 2).sum() / (rows * columns)
    return total


@pytest.mark.parametrize(
    ("make", "taps", "name"), [(alexnet, ALEX_TAPS, "alex"), (vgg16, VGG_TAPS, "vgg")]
)
def test_both_networks_against_the_formula(make, taps, name, tmp_path, rng) -> None:
    torch.manual_seed(3)
    network = make()
    weights = heads(taps, network)
    state = {f"features.{key}": value for key, value in network.state_dict().items()}
    save_file(state, tmp_path / "network.safetensors")
    np.savez(tmp_path / "heads.npz", **{k: v.numpy() for k, v in weights.items()})
    one = rng.integers(0, 256, (48, 67, 3), dtype=np.uint8)
    other = np.clip(one + rng.normal(scale=40, size=one.shape), 0, 255).astype(np.uint8)

    measure = load_lpips([tmp_path / "network.safetensors", tmp_path / "heads.npz"])
    assert measure.network == name
    found = measure(torch.from_numpy(one), torch.from_numpy(other))
    expected = by_the_formula(network, taps, weights, one, other)
    assert found == pytest.approx(expected, rel=1e-4)
    assert expected > 1e-3
    assert measure(torch.from_numpy(other), torch.from_numpy(one)) == pytest.approx(found, rel=1e-5)
    assert measure(torch.from_numpy(one), torch.from_numpy(one)) == 0


def blank() -> dict[str, torch.Tensor]:
    """AlexNet of zeros under the names of the lpips package's own module."""
    slices = {0: 1, 3: 2, 6: 3, 8: 4, 10: 5}
    state = {}
    for key, value in alexnet().state_dict().items():
        index, kind = key.split(".")
        state[f"net.slice{slices[int(index)]}.{index}.{kind}"] = torch.zeros_like(value)
    for i, width in enumerate((64, 192, 384, 256, 256)):
        state[f"lins.{i}.model.1.weight"] = torch.zeros(1, width, 1, 1)
    return state


def test_a_case_by_hand(tmp_path) -> None:
    """One channel sees red, another is always 1; white against black.

    White is r = (1 + 0.030) / 0.458 = 2.2489 in red, black is negative and cut off by the ReLU.
    The unit features are (r, 1) / sqrt(r^2 + 1) = (0.9137, 0.4063) and (0, 1), whose squared
    differences are 0.8349 and 0.3525; weights of 3 and 5 make 4.267.
    """
    state = blank()
    # The middle of the 11 x 11 window never lies in the padding.
    state["net.slice1.0.weight"][7, 0, 5, 5] = 1
    state["net.slice1.0.bias"][9] = 1
    state["lins.0.model.1.weight"][0, 7] = 3
    state["lins.0.model.1.weight"][0, 9] = 5
    state["scaling_layer.shift"] = torch.zeros(1, 3, 1, 1)
    save_file(state, tmp_path / "whole.safetensors")
    measure = load_lpips([tmp_path / "whole.safetensors"])
    white = torch.full((40, 40, 3), 255, dtype=torch.uint8)
    black = torch.zeros_like(white)
    assert measure(white, black) == pytest.approx(4.267, abs=1e-3)
    only_red = white.clone()
    only_red[..., 1:] = 0
    assert measure(white, only_red) == 0, "nothing else is seen"


def test_refusals(tmp_path) -> None:
    good = blank()
    path = tmp_path / "w.safetensors"

    def load(state: dict[str, torch.Tensor]):
        save_file(state, path)
        return load_lpips([path])

    with pytest.raises(InputError, match="got none"):
        load_lpips([])
    with pytest.raises(InputError, match=r"features\.0\.weight"):
        load({"x": torch.zeros(1)})
    with pytest.raises(InputError, match=r"got \(64, 3, 5, 5\)"):
        load(good | {"net.slice1.0.weight": torch.zeros(64, 3, 5, 5)})
    without = {k: v for k, v in good.items() if k != "net.slice3.6.bias"}
    with pytest.raises(InputError, match="weight and bias of convolution 6"):
        load(without)
    with pytest.raises(InputError, match="convolution 8"):
        load(good | {"net.slice4.8.weight": torch.zeros(256, 256, 3, 3)})
    without = {k: v for k, v in good.items() if not k.startswith("lins.2")}
    with pytest.raises(InputError, match="heads lin0 to lin4"):
        load(without)
    measure = load(good)
    image = torch.zeros(40, 40, 3, dtype=torch.uint8)
    with pytest.raises(ShapeError, match="32x32"):
        measure(image[:20], image[:20])
    with pytest.raises(ShapeError, match="picture"):
        measure(image[:, :39], image)
