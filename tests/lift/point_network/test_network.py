"""The whole network: its decoder against loops, and that it learns."""

import numpy as np
import torch
from torch.nn import functional

from splatseg.lift.point_network import PUBLISHED_S3DIS, RandlaNet

from .conftest import pyramid_of, randomised, scene, small_config
from .test_encoder import array, reference_layer


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
