"""Our own checkpoints: what is saved comes back, and what is damaged is told in a sentence."""

import json
from pathlib import Path
from typing import Any

import pytest
import torch

from splatseg.errors import FileFormatError, InputError, MissingFileError
from splatseg.io.tensors import read_safetensors, write_tensors
from splatseg.lift.point_network import (
    PUBLISHED_S3DIS,
    PointInputs,
    RandlaConfig,
    RandlaEncoder,
    RandlaNet,
    RandlaVariant,
    checkpoint,
    load_point_encoder,
    load_point_network,
    save_point_encoder,
    save_point_network,
)

from .conftest import pyramid_of, randomised, scene, small_config

INPUTS = PointInputs(grid_size=0.05, origin="floor", colour_range=255.0)
FACTS = {"rooms": 12, "rate": 0.01, "augmented": ["rotated", "scaled"]}
VARIANT = RandlaVariant(
    distance="squared", second_encoding="direct", paired_features="own", sampling="own",
    start_slope=0.3, entry_slope=0.1, slope=0.0, sum_slope=0.01, epsilon=1e-5,
)  # fmt: skip


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    path = tmp_path / "a.safetensors"
    encoder = randomised(RandlaEncoder(small_config(VARIANT)))
    save_point_encoder(encoder, path, inputs=INPUTS, facts=FACTS)
    return path


def test_an_encoder_comes_back(saved: Path) -> None:
    found = load_point_encoder(saved)
    assert found.config == small_config(VARIANT)
    assert found.inputs == INPUTS
    assert (found.source, found.layout, found.assumed) == ("a.safetensors", "splatseg", ())
    assert found.recipe == FACTS
    assert found.colour
    assert not found.encoder.training
    assert not any(parameter.requires_grad for parameter in found.encoder.parameters())
    before = randomised(RandlaEncoder(small_config(VARIANT))).state_dict()
    for name, tensor in found.encoder.state_dict().items():
        if name.endswith("num_batches_tracked"):
            continue
        wanted = before[name].half().float() if tensor.ndim == 2 else before[name]
        assert torch.equal(tensor, wanted), name
    types = {tensor.dtype for tensor in read_safetensors(saved)[0].values() if tensor.ndim == 2}
    assert types == {torch.float16}


def test_features_are_those_of_rounded_weights(saved: Path) -> None:
    config = small_config(VARIANT)
    positions, colours = scene()
    pyramid, inputs = pyramid_of(positions, config), torch.cat((positions, colours), dim=1)
    before = randomised(RandlaEncoder(config))(pyramid, inputs)
    for one, two in zip(before, load_point_encoder(saved).encoder(pyramid, inputs), strict=True):
        assert float((one - two).detach().abs().max()) < 1e-2 * float(one.detach().abs().max())


def test_inputs_can_be_said(saved: Path) -> None:
    said = PointInputs(grid_size=0.02)
    assert load_point_encoder(saved, inputs=said).inputs == said


def test_a_published_one_is_small(tmp_path: Path) -> None:
    path = tmp_path / "a.safetensors"
    save_point_encoder(RandlaEncoder(PUBLISHED_S3DIS), path, inputs=INPUTS, facts={})
    assert path.stat().st_size < 6_000_000


def test_a_network_comes_back(tmp_path: Path) -> None:
    path = tmp_path / "a.safetensors"
    network = randomised(RandlaNet(small_config()))
    save_point_network(network, path, inputs=INPUTS, facts=FACTS)
    found = load_point_network(path)
    assert found.training
    assert all(parameter.requires_grad for parameter in found.parameters())
    positions, colours = scene()
    pyramid, inputs = pyramid_of(positions, found.config), torch.cat((positions, colours), dim=1)
    assert torch.equal(found.eval()(pyramid, inputs), network(pyramid, inputs))
    encoder = load_point_encoder(path)
    assert (encoder.inputs, encoder.recipe) == (INPUTS, FACTS)
    for one, two in zip(
        encoder.encoder(pyramid, inputs), network.encoder(pyramid, inputs), strict=True
    ):
        assert torch.equal(one, two)


def test_an_encoder_is_no_network(saved: Path) -> None:
    with pytest.raises(FileFormatError, match="expected a whole network of splatseg, got an enc"):
        load_point_network(saved)


def test_what_cannot_be_saved(tmp_path: Path) -> None:
    encoder = randomised(RandlaEncoder(small_config()))
    path = tmp_path / "a.safetensors"
    with pytest.raises(InputError, match="facts"):
        save_point_encoder(encoder, path, inputs=INPUTS, facts={"a": object()})
    with torch.no_grad():
        encoder.blocks[1].exit.linear.weight[0, 0] = 1e6
    with pytest.raises(InputError) as caught:
        save_point_encoder(encoder, path, inputs=INPUTS, facts={})
    assert str(caught.value) == (
        "encoder: blocks.1.exit.linear.weight: expected weights that float16 holds, got 1e+06."
    )
    assert not path.exists()


def test_the_shipped_one(saved: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checkpoint, "SHIPPED", saved)
    assert load_point_encoder(None).recipe == FACTS
    monkeypatch.setattr(checkpoint, "SHIPPED", saved.with_name("none.safetensors"))
    with pytest.raises(MissingFileError) as caught:
        load_point_encoder()
    assert str(caught.value) == (
        "none.safetensors: this installation has no weights of a point network; give the file of "
        "a checkpoint: one of Open3D-ML's RandLA-Net, or of save_point_encoder."
    )
    with pytest.raises(MissingFileError, match="other"):
        load_point_encoder(saved.with_name("other.safetensors"))


NAME = "blocks.1.exit.linear.weight"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t.pop(NAME), f"{NAME}: expected shape (16, 8), got no such tensor."),
        (
            lambda t: t.update({NAME: torch.zeros(16, 9)}),
            f"{NAME}: expected shape (16, 8), got (16, 9).",
        ),
        (
            lambda t: t.update({NAME: torch.zeros(16, 8, dtype=torch.int32)}),
            f"{NAME}: expected floating-point numbers, got torch.int32.",
        ),
        (
            lambda t: t.update({NAME: torch.full((16, 8), torch.nan)}),
            f"{NAME}: expected finite numbers, got NaN or infinite ones.",
        ),
        (
            lambda t: t["start.norm.running_var"].sub_(9),
            "start.norm.running_var: expected variances of 0 or more, got -8",
        ),
        (
            lambda t: t.update({"blocks.3.odd": torch.zeros(2)}),
            "blocks.3.odd: expected no tensor of this name in such a network, "
            "got one of shape (2,).",
        ),
        (
            lambda t: t.update({"head.0.linear.bias": torch.zeros(2)}),
            "head.0.linear.bias: expected no tensor of this name in such a network",
        ),
    ],
)
def test_tensors_that_do_not_fit(saved: Path, change: Any, message: str) -> None:
    tensors, metadata = read_safetensors(saved)
    change(tensors)
    write_tensors(tensors, saved, metadata=metadata)
    with pytest.raises(FileFormatError) as caught:
        load_point_encoder(saved)
    assert str(caught.value).startswith(f"{saved}: {message}")


def about(metadata: dict[str, str], path: str, value: Any) -> None:
    content = json.loads(metadata["about"])
    *parents, last = path.split(".")
    place = content
    for parent in parents:
        place = place[parent]
    place[last] = value
    metadata["about"] = json.dumps(content)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m: m.update(version="2"), "expected version 1 of splatseg.point_network, got '2'"),
        (lambda m: m.update(about="{"), "about: expected JSON"),
        (lambda m: m.pop("about"), "about: expected JSON"),
        (lambda m: about(m, "part", "decoder"), "about: expected encoder or network, got 'deco"),
        (lambda m: about(m, "config", 3), "about: expected objects config and recipe"),
        (lambda m: about(m, "config.inputs", 4), "config: inputs: expected 3 or 6 channels, got 4"),
        (lambda m: about(m, "config.widths", "ab"), "config: widths"),
        (lambda m: about(m, "config.classes", 1e40), "config: classes: expected finite numbers"),
        (lambda m: about(m, "config.other", 1), "config: expected classes, first_width"),
        (lambda m: about(m, "config.variant.slope", 7), "variant: slope: expected a value in"),
        (lambda m: about(m, "inputs", None), "inputs: expected colour_range, grid_size, origin"),
        (lambda m: about(m, "inputs.grid_size", -1), "inputs: grid_size: expected above 0"),
        (
            lambda m: m.update(format="x"),
            "expected a RandLA-Net of splatseg, or tensors of a known",
        ),
    ],
)
def test_facts_that_cannot_be_read(saved: Path, change: Any, message: str) -> None:
    tensors, metadata = read_safetensors(saved)
    change(metadata)
    write_tensors(tensors, saved, metadata=metadata)
    with pytest.raises(FileFormatError) as caught:
        load_point_encoder(saved)
    assert str(caught.value).startswith(f"{saved}")
    assert message in str(caught.value)


def test_a_file_asks_for_no_memory(saved: Path) -> None:
    """Of a network that is not in the file nothing is allocated: it would be 6 GB."""
    tensors, metadata = read_safetensors(saved)
    large = RandlaConfig(widths=(4096,) * 12, ratios=(2,) * 12)
    about(metadata, "config.widths", list(large.widths))
    about(metadata, "config.ratios", list(large.ratios))
    write_tensors(tensors, saved, metadata=metadata)
    with pytest.raises(FileFormatError, match="blocks.0.entry.linear.weight: expected shape"):
        load_point_encoder(saved)
