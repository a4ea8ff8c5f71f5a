"""Our own checkpoints: what is saved comes back, and what is damaged is told in a sentence."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from splatseg.errors import FileFormatError, InputError, MissingFileError
from splatseg.io.tensors import read_safetensors, write_tensors
from splatseg.methods.cosseg import checkpoint
from splatseg.methods.cosseg.checkpoint import (
    SHIPPED,
    load_point_encoder,
)
from splatseg.methods.cosseg.network import RandlaEncoder
from splatseg.methods.cosseg.points import spatial_features, spatial_frame
from splatseg.methods.cosseg.pyramid import (
    PUBLISHED_S3DIS,
    PointInputs,
    PyramidOptions,
    RandlaConfig,
    point_pyramid,
)
from splatseg_bench.point_network import save_point_encoder
from splatseg_bench.worlds._recorded import SurfaceOptions, surface_points
from splatseg_bench.worlds._streets import street

from .layouts import FIRST, WIDTHS, answer, state_dict
from .point_scenes import pyramid_of, randomised, scene, small_config

INPUTS = PointInputs(grid_size=0.05, origin="floor", colour_range=255.0)
FACTS = {"rooms": 12, "rate": 0.01, "augmented": ["rotated", "scaled"]}
SUM_SLOPE = 0.01


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    path = tmp_path / "a.safetensors"
    encoder = randomised(RandlaEncoder(small_config(SUM_SLOPE)))
    save_point_encoder(encoder, path, inputs=INPUTS, facts=FACTS)
    return path


def test_an_encoder_comes_back(saved: Path) -> None:
    found = load_point_encoder(saved)
    assert found.config == small_config(SUM_SLOPE)
    assert found.inputs == INPUTS
    assert (found.source, found.layout, found.assumed) == ("a.safetensors", "splatseg", ())
    assert found.recipe == FACTS
    assert found.colour
    assert not found.encoder.training
    assert not any(parameter.requires_grad for parameter in found.encoder.parameters())
    before = randomised(RandlaEncoder(small_config(SUM_SLOPE))).state_dict()
    for name, tensor in found.encoder.state_dict().items():
        if name.endswith("num_batches_tracked"):
            continue
        wanted = before[name].half().float() if tensor.ndim == 2 else before[name]
        assert torch.equal(tensor, wanted), name
    types = {tensor.dtype for tensor in read_safetensors(saved)[0].values() if tensor.ndim == 2}
    assert types == {torch.float16}


def test_features_are_those_of_rounded_weights(saved: Path) -> None:
    config = small_config(SUM_SLOPE)
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
        "a checkpoint: one of Open3D-ML's RandLA-Net, or of scripts/train_point_network."
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
        (
            lambda m: about(m, "part", "decoder"),
            "about: part: expected one of the words that are known",
        ),
        (lambda m: about(m, "config", 3), "about: config: expected an object, got 3"),
        (
            lambda m: about(m, "config.inputs", 4),
            "config.inputs: expected one of the words that are known, got 4",
        ),
        (lambda m: about(m, "config.widths", "ab"), "config.widths: expected a list"),
        (lambda m: about(m, "config.classes", 1e40), "config.classes: expected a whole number"),
        (lambda m: about(m, "config.ratios", [4]), "ratios: expected 3, one a level"),
        (
            lambda m: about(m, "config.sum_slope", 7),
            "config.sum_slope: expected a number of at most 1",
        ),
        (lambda m: about(m, "inputs", None), "about: inputs: expected an object, got None"),
        (
            lambda m: about(m, "inputs.grid_size", -1),
            "inputs.grid_size: expected a number above 0, got -1",
        ),
        (
            lambda m: m.update(format="x"),
            "expected a RandLA-Net of splatseg, or tensors of Open3D-ML's",
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


def saved_of_layouts(state: dict[str, Tensor], path: Path) -> Path:
    """As the programs that train do: with more than the tensors."""
    rest = {"param_groups": [{"lr": np.float64(0.1)}], "state": {0: torch.zeros(3)}}
    torch.save({"epoch": 3, "model_state_dict": state, "optimizer_state_dict": rest}, path)
    return path


@pytest.mark.parametrize("inputs", [3, 6])
def test_features_are_those_of_its_program(inputs: int, tmp_path: Path) -> None:
    state = state_dict(inputs)
    found = load_point_encoder(saved_of_layouts(state, tmp_path / "a.pth"))
    assert (found.layout, found.source, found.colour) == ("open3d", "a.pth", inputs == 6)
    assert (found.config.first_width, found.config.widths) == (FIRST, WIDTHS)
    assert (found.config.neighbours, found.config.ratios) == (16, (4, 4, 4, 4))
    positions, colours = scene(120)
    # As few neighbours and points as loops can go through.
    options = PyramidOptions(neighbours=3, ratios=(3, 2, 2, 2))
    pyramid = point_pyramid(positions, options=options, seed=2)
    fed = torch.cat((positions, colours), dim=1)[:, :inputs]
    wanted = answer(state, pyramid, fed)
    for one, two in zip(found.encoder(pyramid, fed), wanted, strict=True):
        assert np.abs(two).max() > 0.1
        np.testing.assert_allclose(one, two, rtol=2e-4, atol=2e-4)


@pytest.mark.parametrize(
    ("inputs", "wanted"),
    [
        (6, PointInputs(grid_size=0.04, origin="floor", colour_range=255.0)),
        (3, PointInputs(grid_size=0.06)),
    ],
)
def test_what_a_file_does_not_say_is_told(inputs: int, wanted: PointInputs, tmp_path: Path) -> None:
    path = saved_of_layouts(state_dict(inputs), tmp_path / "a.pth")
    found = load_point_encoder(path)
    assert found.inputs == wanted
    assert found.assumed == ("neighbours", "ratios", "inputs")
    said = PointInputs(grid_size=0.01)
    found = load_point_encoder(path, inputs=said)
    assert (found.inputs, found.assumed) == (said, ("neighbours", "ratios"))


VERSION_0_1 = {
    "distance": "euclidean", "second_encoding": "chained", "paired_features": "neighbour",
    "sampling": "max", "start_slope": 0.2, "entry_slope": 0.2, "slope": 0.2, "sum_slope": 0.05,
    "epsilon": 1e-6,
}  # fmt: skip


def test_files_of_version_0_1_are_read(saved: Path) -> None:
    tensors, metadata = read_safetensors(saved)
    about(metadata, "config.variant", VERSION_0_1)
    write_tensors(tensors, saved, metadata=metadata)
    assert load_point_encoder(saved).config.sum_slope == 0.05
    about(metadata, "config.variant", VERSION_0_1 | {"distance": "squared"})
    write_tensors(tensors, saved, metadata=metadata)
    with pytest.raises(
        FileFormatError, match=r"config\.variant: distance: expected one of the words"
    ):
        load_point_encoder(saved)


def test_five_levels_are_those_of_rooms(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(state_dict.__module__ + ".WIDTHS", (4, 4, 4, 4, 4))
    found = load_point_encoder(saved_of_layouts(state_dict(6), tmp_path / "a.pth"))
    assert found.config.ratios == (4, 4, 4, 4, 2)


def test_ways_of_saving(tmp_path: Path) -> None:
    """Tensors alone, safetensors, NumPy's, and those of several GPUs."""
    state = state_dict(6)
    plain = {name: value for name, value in state.items() if value.ndim}
    torch.save(state, tmp_path / "bare.pth")
    torch.save({"state_dict": state}, tmp_path / "lightning.ckpt")
    torch.save({f"module.{name}": value for name, value in state.items()}, tmp_path / "gpus.pth")
    write_tensors(state, tmp_path / "a.safetensors", metadata={"format": "pt"})
    np.savez(tmp_path / "a.npz", **{name: value.numpy() for name, value in plain.items()})
    wanted = load_point_encoder(tmp_path / "bare.pth").encoder.state_dict()
    for name in ("lightning.ckpt", "gpus.pth", "a.safetensors", "a.npz"):
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
            "inputs: expected one of 3, 6, got 4.",
        ),
        (
            lambda s: s.pop("fc0.weight"),
            "expected a RandLA-Net of splatseg, or tensors of Open3D-ML's",
        ),
        (lambda s: s.clear(), "expected tensors by name or a state_dict, got none."),
    ],
)
def test_tensors_that_do_not_fit_of_layouts(change: Any, message: str, tmp_path: Path) -> None:
    state = state_dict(6)
    change(state)
    path = saved_of_layouts(state, tmp_path / "a.pth")
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


def test_it_is_small_and_says_how_it_was_made():
    assert SHIPPED.stat().st_size < 6_000_000
    encoder = load_point_encoder()
    assert encoder.layout == "splatseg"
    assert encoder.assumed == ()
    assert encoder.colour
    assert encoder.config == RandlaConfig(classes=45)  # the published shape for S3DIS
    assert (encoder.inputs.grid_size, encoder.inputs.origin) == (0.04, "floor")
    assert {"recipe", "score", "seconds"} <= set(encoder.recipe)
    said = "120 generated rooms and 24 generated streets, 5500 steps; not S3DIS"
    assert encoder.trained_on == said
    assert replace(encoder, recipe={}).trained_on == "what the file does not say"


def test_its_features_tell_classes_apart_that_colours_do_not():
    """The nearest mean of a class, in a street that it was not trained on."""
    noise = SurfaceOptions(noise=0.01)
    cloud = surface_points(street(200_000), 9000, options=noise)
    encoder = load_point_encoder()
    frame = spatial_frame(encoder, cloud.positions, metres_per_unit=1.0, seed=0)
    pyramid, found = spatial_features(encoder, cloud.positions, cloud.colours, frame=frame, seed=0)
    # Each point has its own features and those of the coarser points nearest to it.
    rows, levels = torch.arange(len(cloud)), [found[0].float()]
    for level, up in zip(found[1:3], pyramid.up[:2], strict=True):
        rows = up[rows]
        levels.append(level[rows].float())
    right = [share_right(x, cloud.semantic) for x in (torch.cat(levels, 1), cloud.colours)]
    assert right[0] > right[1] + 0.1, right


def share_right(features: torch.Tensor, classes: torch.Tensor) -> float:
    """Of every second point, whose class is that of the nearest mean of the others."""
    x = (features - features.mean(0)) / features.std(0)
    known = classes[::2].unique()
    means = torch.stack([x[::2][classes[::2] == one].mean(0) for one in known])
    return float((known[torch.cdist(x[1::2], means).argmin(1)] == classes[1::2]).float().mean())
