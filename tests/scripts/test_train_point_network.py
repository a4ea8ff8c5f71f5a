"""Training of the shipped encoder: by seed, and the same whether it was interrupted or not."""

import sys
from dataclasses import replace
from importlib.machinery import SourceFileLoader
from importlib.util import module_from_spec, spec_from_loader
from pathlib import Path

import numpy as np
import pytest
import torch

from splatseg.core.threads import one_torch_thread

SCRIPT = Path(__file__).parents[2] / "scripts" / "train_point_network"


@pytest.fixture(scope="module")
def script():
    loader = SourceFileLoader("train_point_network", str(SCRIPT))
    spec = spec_from_loader(loader.name, loader)
    assert spec is not None
    module = module_from_spec(spec)
    # Dataclasses look their module up.
    sys.modules[loader.name] = module
    loader.exec_module(module)
    yield module
    del sys.modules[loader.name]


@pytest.fixture(scope="module")
def recipe(script):
    return script.Recipe(
        rooms=1, streets=1, held_out_rooms=1, held_out_streets=0, points_per_room=9000,
        points_per_street=9000, points_per_crop=4200, steps=4, settling_steps=3,
    )  # fmt: skip


@pytest.fixture(scope="module")
def clouds(script, recipe, tmp_path_factory):
    return script.clouds(recipe, tmp_path_factory.mktemp("clouds"))


def test_clouds_are_kept_and_labels_count_through_both_tables(script, clouds):
    room, street = clouds
    assert room.labels.max() < script.ROOMS <= street.labels[street.labels >= 0].min()
    assert street.labels.max() < script.ROOMS + script.STREETS
    assert (room.labels == -1).mean() < 0.1


def test_a_grid_keeps_a_point_a_cell(script, clouds):
    fine = script.gridded(clouds[0], 0.1, np.random.default_rng(0))
    cells = np.unique(np.floor(clouds[0].positions / 0.1), axis=0)
    assert len(fine.labels) == len(cells)
    assert set(fine.labels) <= set(clouds[0].labels)
    one = replace(clouds[0], positions=np.zeros_like(clouds[0].positions))
    mean = script.gridded(one, 0.1, np.random.default_rng(0))
    np.testing.assert_allclose(mean.colours[0], one.colours.mean(axis=0), atol=1e-3)


def test_the_second_part_keeps_the_statistics(script, recipe, clouds, tmp_path):
    net = script.RandlaNet(script.CONFIG)
    before = {name: value.clone() for name, value in net.state_dict().items()}
    adam = torch.optim.Adam(net.parameters(), lr=1e-3)
    rates = torch.optim.lr_scheduler.ConstantLR(adam)
    part = script.Part(net=net, adam=adam, rates=rates, start=0, end=1, are_norms_kept=True)
    part.run(recipe, clouds, tmp_path / "part.pt")
    for name, value in net.state_dict().items():
        if "running" in name:
            assert torch.equal(value, before[name])
    assert not torch.equal(net.encoder.start.linear.weight, before["encoder.start.linear.weight"])


def test_other_domain_has_no_say(script):
    logits = torch.zeros(2, script.ROOMS + script.STREETS)
    shares = script.masked(logits, torch.tensor([0, script.ROOMS])).softmax(dim=1)
    assert float(shares[0, script.ROOMS :].sum()) == 0
    assert float(shares[1, : script.ROOMS].sum()) == 0


def often_kept(script, patch):
    """A checkpoint every second step."""
    patch.setattr(script, "CHECKPOINT_EVERY", 2)
    patch.setattr(script, "CALIBRATION", 2)


@pytest.fixture(scope="module")
def whole(script, recipe, clouds, tmp_path_factory):
    """What a training gives that nobody interrupts."""
    with one_torch_thread(), pytest.MonkeyPatch.context() as patch:
        often_kept(script, patch)
        return script.train(recipe, clouds, tmp_path_factory.mktemp("whole"))[0]


@pytest.mark.parametrize("at", [3, 8])
def test_what_was_interrupted_ends_the_same(
    script, whole, recipe, clouds, at, tmp_path, monkeypatch
):
    """In the first part, and in the second, which begins at step 4 + 2. One thread, as the script
    trains by default: torch adds gradients up by its threads in any order."""
    often_kept(script, monkeypatch)
    with one_torch_thread():
        drawn = script.drawn

        def stop(clouds, recipe, step):
            if step == at:
                raise KeyboardInterrupt
            return drawn(clouds, recipe, step)

        with monkeypatch.context() as patch:
            patch.setattr(script, "drawn", stop)
            with pytest.raises(KeyboardInterrupt):
                script.train(recipe, clouds, tmp_path)
        resumed, _ = script.train(recipe, clouds, tmp_path)
    for name, tensor in whole.state_dict().items():
        assert torch.equal(tensor, resumed.state_dict()[name]), name
    with pytest.raises(SystemExit, match="another recipe"):
        script.train(replace(recipe, seed=1), clouds, tmp_path)


def test_scores_are_of_the_classes_that_are_there(script, recipe, clouds):
    net = script.RandlaNet(script.CONFIG).eval()
    report = script.scores(net, clouds[:1], colour=True)
    assert set(report["rooms"]) > {"mIoU", "accuracy", "wall", "floor"}
    assert all(0 <= value <= 1 for value in report["rooms"].values())
    assert report["streets"]["mIoU"] == 0.0


def test_offsets_and_positions_start_at_one_size(script):
    """Offsets of 8 cm count more than a metre aside, and than they did."""
    net = script.RandlaNet(script.CONFIG)
    weight = net.encoder.blocks[0].encode1.linear.weight
    before = weight.detach().abs().mean(dim=0)
    script.balance(net)
    after = weight.detach().abs().mean(dim=0)
    assert bool((0.08 * after[1:4] > 5 * after[[4, 5, 7, 8]].max()).all())
    assert bool((0.08 * before[1:4] < before[[4, 5, 7, 8]].min()).all())


def test_rare_classes_weigh_more(script, clouds):
    weights = script.class_weights(clouds)
    room = clouds[0].labels[clouds[0].labels >= 0]
    shares = np.bincount(room, minlength=script.ROOMS) / len(room)
    assert float(weights[shares.argmax()]) == weights[: script.ROOMS].min()
    missing = np.flatnonzero(shares == 0)
    np.testing.assert_allclose(weights[missing], 0.02**-0.5, rtol=1e-5)


def test_calibration_takes_the_mean_over_crops(script, recipe, clouds, monkeypatch):
    monkeypatch.setattr(script, "CALIBRATION", 2)
    torch.manual_seed(0)
    net = script.RandlaNet(script.CONFIG)
    script.calibrate(net, clouds, recipe)
    assert not net.training
    inputs = [script.drawn(clouds, recipe, recipe.steps + i)[1] for i in range(2)]
    first = net.encoder.start
    means = torch.stack([first.linear(x).mean(dim=0) for x in inputs]).mean(dim=0)
    torch.testing.assert_close(first.norm.running_mean, means, rtol=1e-3, atol=1e-4)


def test_what_is_scored_is_what_is_written(script):
    net = script.RandlaNet(script.CONFIG)
    script.round_encoder(net)
    for parameter in net.encoder.parameters():
        if parameter.ndim == 2:
            assert torch.equal(parameter, parameter.half().float())
