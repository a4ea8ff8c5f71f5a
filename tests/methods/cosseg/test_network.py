"""The encoder against loops over points and neighbours, in blocks, on threads, and trained."""

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn import functional

from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.methods.cosseg import network
from splatseg.methods.cosseg.network import RandlaEncoder, SharedMlp
from splatseg.methods.cosseg.pyramid import PUBLISHED_S3DIS, RandlaConfig
from splatseg.render.cpu import set_threads, threads
from splatseg_bench.point_network import RandlaNet

from .point_scenes import pyramid_of, randomised, scene, small_config
from .reference import Layer, LayerOf, ScoreOf, encoder_levels


def array(tensor: Tensor | None) -> np.ndarray:
    assert tensor is not None
    return tensor.detach().double().numpy()


def reference_layer(layer: SharedMlp) -> Layer:
    norm = layer.norm
    return Layer(
        weight=array(layer.linear.weight),
        bias=array(layer.linear.bias),
        norm=tuple(array(t) for t in (norm.weight, norm.bias, norm.running_mean, norm.running_var)),
    )


def reference_levels(encoder: RandlaEncoder, pyramid, inputs, sum_slope: float) -> list[np.ndarray]:
    """Loops with the weights of an encoder, in our order."""
    names = {"pool1": "pool1.mlp", "pool2": "pool2.mlp"}

    def layer(level: int) -> LayerOf:
        part = encoder.blocks[level]
        return lambda name: reference_layer(part.get_submodule(names.get(name, name)))

    def score(level: int) -> ScoreOf:
        return lambda name: array(encoder.blocks[level].get_submodule(f"{name}.score").weight)

    first = reference_layer(encoder.start)
    return encoder_levels(pyramid, inputs.double().numpy(), first, layer, score, sum_slope)


@pytest.mark.parametrize("sum_slope", [0.2, 0.01])
def test_the_encoder_is_that_of_loops(sum_slope: float) -> None:
    config = small_config(sum_slope)
    encoder = randomised(RandlaEncoder(config))
    positions, colours = scene()
    pyramid = pyramid_of(positions, config)
    inputs = torch.cat((positions, colours), dim=1)
    found = encoder(pyramid, inputs)
    wanted = reference_levels(encoder, pyramid, inputs, sum_slope)
    assert [tuple(level.shape) for level in found] == [(40, 8), (20, 8), (6, 16), (3, 12)]
    for level, (one, two) in enumerate(zip(found, wanted, strict=True)):
        assert np.abs(two).max() > 0.1
        np.testing.assert_allclose(one.detach(), two, rtol=2e-5, atol=2e-5, err_msg=str(level))
    published = reference_levels(encoder, pyramid, inputs, 0.2)
    differs = max(np.abs(one - two).max() for one, two in zip(published, wanted, strict=True))
    assert (differs > 1e-3) == (sum_slope != 0.2)


@pytest.mark.parametrize("values", [1, 640, 4096])
@pytest.mark.parametrize("threads", [1, 3])
def test_blocks_of_points_are_the_whole(
    values: int, threads: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = small_config()
    encoder = randomised(RandlaEncoder(config))
    positions, colours = scene(400)
    pyramid = pyramid_of(positions, config)
    inputs = torch.cat((positions, colours), dim=1)
    whole = encoder(pyramid, inputs)
    assert whole[0].requires_grad
    seen: list[int] = []
    made = network._made

    def counted(make: network.Make, neighbours: Tensor, rows: slice) -> Tensor:
        found = made(make, neighbours, rows)
        seen.append(len(found))
        return found

    monkeypatch.setattr(network, "VALUES", values)
    monkeypatch.setattr(network, "_made", counted)
    monkeypatch.setattr(network._native, "threads", lambda: threads)
    in_blocks = encoder.requires_grad_(False)(pyramid, inputs)
    # Three passes and the sampling of level 0, and so on; the widest blocks are of 4 channels.
    assert max(seen) == min(400, max(16, values // (4 * 4)))
    assert sum(seen) == 3 * (400 + 200 + 66) + 200 + 66 + 33
    for one, two in zip(whole, in_blocks, strict=True):
        assert torch.allclose(one, two, rtol=1e-5, atol=1e-6)


@pytest.mark.bits
def test_threads_do_not_change_features() -> None:
    config = RandlaConfig(widths=(16, 32), neighbours=16, ratios=(4, 4))
    encoder = randomised(RandlaEncoder(config)).requires_grad_(False)
    positions, colours = scene(3000)
    pyramid = pyramid_of(positions, config)
    before = torch.get_num_threads(), threads()
    try:
        found = []
        for count in (1, 2, 3):
            torch.set_num_threads(count)
            set_threads(count)
            found.append(encoder(pyramid, torch.cat((positions, colours), dim=1)))
            assert torch.get_num_threads() == count
    finally:
        torch.set_num_threads(before[0])
        set_threads(before[1])
    for others in found[1:]:
        for one, two in zip(found[0], others, strict=True):
            assert torch.equal(one, two)


def plain_block(part, positions: Tensor, features: Tensor, neighbours: Tensor) -> Tensor:
    """A block as the published code writes it: nothing split, nothing folded."""

    def layer(mlp: SharedMlp, x: Tensor) -> Tensor:
        y = mlp.linear(x)
        rows = y.reshape(-1, y.shape[-1])
        mean, variance = rows.mean(0), rows.var(0, unbiased=False)
        y = (y - mean) / (variance + mlp.norm.eps).sqrt() * mlp.norm.weight + mlp.norm.bias
        return functional.leaky_relu(y, mlp.slope)

    def pool(pooling, x: Tensor) -> Tensor:
        return layer(pooling.mlp, (x * torch.softmax(pooling.score(x), dim=1)).sum(dim=1))

    near = neighbours.long()
    here, there = positions[:, None].expand(-1, near.shape[1], -1), positions[near]
    distance = (here - there).square().sum(-1, keepdim=True).sqrt()
    first = layer(part.encode1, torch.cat((distance, here - there, here, there), dim=-1))
    found = layer(part.entry, features)
    found = pool(part.pool1, torch.cat((found[near], first), dim=-1))
    found = pool(part.pool2, torch.cat((found[near], layer(part.encode2, first)), dim=-1))
    return functional.leaky_relu(layer(part.exit, found) + layer(part.shortcut, features), 0.2)


def test_training_is_that_of_the_plain_block() -> None:
    """Values and gradients with the batch's own statistics, and what the running ones become."""
    part = randomised(RandlaEncoder(small_config()).blocks[0]).train()
    positions, _ = scene(60)
    pyramid = pyramid_of(positions, small_config())
    features = torch.randn(60, 5, generator=torch.Generator().manual_seed(0))
    weights = torch.randn(60, 8, generator=torch.Generator().manual_seed(1))
    gradients, values = [], []
    before = part.encode1.norm.running_mean.clone()
    for run in (part, lambda *a: plain_block(part, *a)):
        part.zero_grad()
        found = run(positions, features, pyramid.neighbours[0])
        (found * weights).sum().backward()
        values.append(found)
        gradients.append({name: p.grad.clone() for name, p in part.named_parameters()})
    assert torch.allclose(*values, rtol=1e-4, atol=1e-4)
    for name, gradient in gradients[0].items():
        wanted = gradients[1][name]
        error = float((gradient - wanted).abs().max())
        assert error < 1e-4 * max(1.0, float(wanted.abs().max())), name
    here, there = positions[:, None], positions[pyramid.neighbours[0].long()]
    offset = here - there
    ten = torch.cat(
        (offset.norm(dim=-1, keepdim=True), offset, here.expand_as(there), there), dim=-1
    )
    mean = part.encode1.linear(ten).mean(dim=(0, 1))
    assert torch.allclose(part.encode1.norm.running_mean, 0.99 * before + 0.01 * mean, atol=1e-5)


def test_gradients_reach_every_parameter_frozen_or_not() -> None:
    config = small_config()
    positions, colours = scene(60)
    pyramid = pyramid_of(positions, config)
    inputs = torch.cat((positions, colours), dim=1)
    for training in (True, False):
        encoder = randomised(RandlaEncoder(config)).train(training)
        sum((level**2).sum() for level in encoder(pyramid, inputs)).backward()
        for name, parameter in encoder.named_parameters():
            # What goes into a batch norm of the batch may have any constant added.
            if not (training and name.endswith("linear.bias")):
                assert parameter.grad is not None
                assert float(parameter.grad.abs().max()) > 1e-6, name


def test_published_shape() -> None:
    assert PUBLISHED_S3DIS.level_widths == (32, 32, 128, 256, 512, 1024)
    assert PUBLISHED_S3DIS.min_points == 4096
    assert PUBLISHED_S3DIS.colour
    with torch.device("meta"):
        encoder = RandlaEncoder(PUBLISHED_S3DIS)
    assert [part.entry.linear.in_features for part in encoder.blocks] == [8, 32, 128, 256, 512]
    assert encoder.start.norm.momentum == 0.01
    assert encoder.start.norm.eps == 1e-6


def test_what_does_not_fit() -> None:
    config = small_config()
    encoder = RandlaEncoder(config)
    positions, colours = scene()
    pyramid = pyramid_of(positions, config)
    with pytest.raises(ShapeError, match=r"inputs: expected shape \(40, 6\), got \(40, 3\)"):
        encoder(pyramid, positions)
    with pytest.raises(RangeError, match="inputs: 40 of 240 values are not finite"):
        encoder(pyramid, torch.cat((positions, colours * torch.tensor([1, torch.inf, 1])), dim=1))
    other = pyramid_of(positions, RandlaConfig(widths=(4,), neighbours=4, ratios=(2,)))
    with pytest.raises(InputError, match="pyramid: expected 3 levels with neighbours, got 1"):
        encoder(other, torch.cat((positions, colours), dim=1))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"inputs": 4}, "inputs: expected one of 3, 6, got 4"),
        ({"first_width": 0}, r"first_width: expected a value in \[1, 4096\], got 0"),
        ({"widths": ()}, "widths: expected 1 to 12 levels, got 0"),
        ({"widths": (4, 5), "ratios": (2, 2)}, "widths: expected even numbers"),
        ({"ratios": (2,)}, "ratios: expected 5, one a level, got 1"),
        ({"ratios": (4, 4, 4, 4, 0)}, r"ratios\[4\]: expected a value in \[1, 4096\]"),
        ({"neighbours": 0}, r"neighbours: expected a value in \[1, 4096\], got 0"),
        ({"classes": 0}, r"classes: expected a value in \[1, 4096\], got 0"),
        ({"sum_slope": -0.1}, r"sum_slope: expected a value in \[0, 1\], got -0.1"),
    ],
)
def test_wrong_shapes(fields: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        RandlaConfig(**fields)


def test_the_decoder_is_that_of_loops() -> None:
    """A point's logits are made of its skip and of the nearest point of the next level."""
    config = small_config()
    network = randomised(RandlaNet(config))
    positions, colours = scene()
    pyramid = pyramid_of(positions, config)
    inputs = torch.cat((positions, colours), dim=1)
    levels = [array(level) for level in network.encoder(pyramid, inputs)]

    features = [reference_layer(network.middle)(x, 0.2) for x in levels[-1]]
    for number, step in enumerate(network.steps):
        finer = len(pyramid.up) - 1 - number
        up = pyramid.up[finer].tolist()
        layer = reference_layer(step)
        skip = levels[finer] if finer else levels[0]
        features = [
            layer(np.concatenate((skip[i], features[up[i]])), 0.2) for i in range(len(skip))
        ]
    first, second, _, last = network.head
    wanted = [
        array(last.weight) @ reference_layer(second)(reference_layer(first)(x, 0.2), 0.2)
        + array(last.bias)
        for x in features
    ]
    assert np.abs(np.array(wanted)).max() > 0.1
    np.testing.assert_allclose(
        network(pyramid, inputs).detach(), np.array(wanted), rtol=1e-4, atol=1e-4
    )


def test_published_widths() -> None:
    with torch.device("meta"):
        network = RandlaNet(PUBLISHED_S3DIS)
    shapes = [(step.linear.in_features, step.linear.out_features) for step in network.steps]
    assert shapes == [(1536, 512), (768, 256), (384, 128), (160, 32), (64, 32)]
    sides = [network.head[i].linear.weight.shape for i in (0, 1)]
    assert [*sides, network.head[3].weight.shape] == [(64, 32), (32, 64), (13, 32)]
    assert network.head[2].p == 0.5


def test_channels_are_dropped_in_training_only() -> None:
    config = small_config()
    network = randomised(RandlaNet(config))
    positions, colours = scene()
    pyramid = pyramid_of(positions, config)
    inputs = torch.cat((positions, colours), dim=1)
    assert torch.equal(network(pyramid, inputs), network(pyramid, inputs))
    network.head.train()
    assert not torch.equal(network(pyramid, inputs), network(pyramid, inputs))


def test_it_learns() -> None:
    """Which side of a plane points are on, to which colours give no hint."""
    torch.manual_seed(0)
    config = small_config()
    network = RandlaNet(config).train()
    positions, colours = scene(200)
    pyramid = pyramid_of(positions, config)
    inputs = torch.cat((positions, colours), dim=1)
    target = (positions @ torch.tensor([1.0, 2.0, -1.0]) > 0).long()
    optimiser = torch.optim.Adam(network.parameters(), lr=1e-2)
    losses = []
    for _ in range(60):
        optimiser.zero_grad()
        loss = functional.cross_entropy(network(pyramid, inputs), target)
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
    assert losses[-1] < 0.4 < losses[0]
    untouched = [name for name, p in network.named_parameters() if p.grad is None]
    assert not untouched
