"""The auto-encoder of shapes and its files."""

import argparse
import math
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional

from splatseg.errors import FileFormatError, InputError, MissingFileError, RangeError, ShapeError
from splatseg.io.tensors import write_tensors
from splatseg.street.shape_files import SHIPPED, load_shapes
from splatseg.street.shapes import ShapeAutoEncoder, ShapeConfig, sphere_code, template
from splatseg_bench.worlds._recorded import surface_points
from splatseg_bench.worlds._streets import street
from splatseg_bench.worlds._varied_rooms import varied_room
from support.shape_quality import (
    cut_patches,
    interpolate_codes,
    new_shapes,
    save_shapes,
    score_shapes,
    self_intersections,
    topology,
)


def test_it_is_a_closed_sphere_of_level_one() -> None:
    vertices, faces = template()
    assert (vertices.shape, vertices.dtype) == ((42, 3), torch.float32)
    assert (faces.shape, faces.dtype) == ((80, 3), torch.int64)
    np.testing.assert_allclose(vertices.norm(dim=1), np.ones(42), rtol=1e-6)
    assert sorted(set(faces.flatten().tolist())) == list(range(42))
    # Each directed edge once, its reverse once: watertight and of one orientation.
    directed = [(a, b) for f in faces.tolist() for a, b in zip(f, f[1:] + f[:1], strict=True)]
    assert len(set(directed)) == 240
    assert {(b, a) for a, b in directed} == set(directed)
    # Six times the volume that faces enclose is positive: they look outwards.
    volumes = torch.linalg.det(vertices[faces].double())
    assert bool((volumes > 0).all())
    assert float(volumes.sum() / 6) == pytest.approx(3.659, abs=1e-3)
    valence = torch.bincount(faces.flatten())
    assert valence[:12].tolist() == [5] * 12
    assert valence[12:].tolist() == [6] * 30


def test_vertices_come_in_the_published_order() -> None:
    """PyTorch3D's: its table of 12, then middles of edges in the order of their vertices."""
    vertices, _ = template()
    short, long = 0.5257, 0.8507
    wanted = {
        0: (-short, long, 0),
        5: (0, short, long),
        6: (0, -short, -long),
        8: (long, 0, -short),
    }
    for row, value in wanted.items():
        np.testing.assert_allclose(vertices[row], value, atol=1e-4)
    # The five edges of vertex 0 go to 1, 5, 7, 10 and 11, the next of vertex 1 to 5, 7, 8, 9.
    edges = [(0, 1), (0, 5), (0, 7), (0, 10), (0, 11), (1, 5), (1, 7), (1, 8), (1, 9)]
    for number, (a, b) in enumerate(edges):
        middle = vertices[a] + vertices[b]
        np.testing.assert_allclose(vertices[12 + number], middle / middle.norm(), atol=1e-6)


def test_it_is_the_callers_own() -> None:
    first = template()
    for part in first:
        part.zero_()
    assert bool(template()[0].any())
    assert bool(template()[1].any())


def test_edges_know_their_faces() -> None:
    _, faces = template()
    found = topology(faces, 42)
    assert len(found.edges) == 120
    for edge, pair in zip(found.edges.tolist(), found.edge_faces.tolist(), strict=True):
        assert len(set(pair)) == 2
        for face in pair:
            assert set(edge) <= set(faces[face].tolist())


def test_open_meshes_are_refused() -> None:
    _, faces = template()
    with pytest.raises(InputError, match=r"watertight mesh of 42 vertices, got the edge \d+ to"):
        topology(faces[1:], 42)
    with pytest.raises(InputError, match="faces at each of 43 vertices"):
        topology(faces, 43)


# The code of the sphere, and codes between others.


def test_the_sphere_is_found_among_shapes_that_are_none() -> None:
    """A decoder of one code at which all offsets are 0: they grow as it is left."""
    shapes = new_shapes(ShapeConfig(code_size=3, encoder_widths=(4,), decoder_widths=(6,)), seed=0)
    wanted = torch.tensor([2.0, -1, 2]) / 3
    generator = torch.Generator().manual_seed(5)
    with torch.no_grad():
        # relu(+-(z - wanted)) in each of three axes, times anything.
        first, last = shapes.decoder.layers
        first.weight.copy_(torch.cat((torch.eye(3), -torch.eye(3))))
        first.bias.copy_(torch.cat((-wanted, wanted)))
        last.weight.copy_(torch.randn(126, 6, generator=generator))
        last.bias.zero_()
    found = sphere_code(shapes)
    np.testing.assert_allclose(found, wanted, atol=5e-3)
    assert float(found.norm()) == pytest.approx(1, abs=1e-6)
    assert not found.requires_grad
    assert torch.equal(sphere_code(shapes), found)
    with torch.no_grad():
        assert torch.equal(sphere_code(shapes), found)
    mesh = shapes.decode(found[None]).detach()
    assert self_intersections(mesh, shapes.faces).tolist() == [0]


def test_between_codes_lies_the_shorter_arc() -> None:
    start, end = torch.tensor([[2.0, 0, 0]]), torch.tensor([[0, 0.5, 0]])
    found = interpolate_codes(start, end, torch.tensor([0, 1 / 3, 1.0]))
    thirty = math.pi / 6
    wanted = [[1, 0, 0], [math.cos(thirty), math.sin(thirty), 0], [0, 1, 0]]
    np.testing.assert_allclose(found[0], wanted, atol=1e-6)


def test_steps_between_codes_are_equal(rng: np.random.Generator) -> None:
    start, end = (torch.from_numpy(rng.normal(size=(20, 8))) for _ in range(2))
    found = interpolate_codes(start, end, torch.linspace(0, 1, 11))
    np.testing.assert_allclose(found.norm(dim=-1), np.ones((20, 11)), atol=1e-9)
    cosines = (found[:, 1:] * found[:, :-1]).sum(dim=-1)
    np.testing.assert_allclose(cosines, cosines[:, :1].expand(-1, 10), atol=1e-7)


def test_between_a_code_and_itself_is_the_code() -> None:
    codes = torch.nn.functional.normalize(torch.tensor([[1.0, 2, 3, 4], [1, 0, 0, 0]]), dim=1)
    codes.requires_grad_()
    found = interpolate_codes(codes, codes, torch.tensor([0.0, 0.3, 1.0]))
    torch.testing.assert_close(found, codes[:, None].expand(-1, 3, -1))
    found.square().sum().backward()
    assert codes.grad is not None
    assert bool(torch.isfinite(codes.grad).all())


def test_as_many_codes_at_both_ends() -> None:
    with pytest.raises(ShapeError, match=r"end: expected shape \(2, 4\), got \(1, 4\)"):
        interpolate_codes(torch.ones(2, 4), torch.ones(1, 4), torch.tensor([0.5]))


# Points to codes to meshes.


SMALL = ShapeConfig(code_size=5, encoder_widths=(7, 9), decoder_widths=(11,))


@pytest.fixture
def shapes() -> ShapeAutoEncoder:
    return new_shapes(SMALL, seed=3)


def test_codes_are_of_length_one_and_of_sets(shapes: ShapeAutoEncoder) -> None:
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(6, 20, 3, generator=generator)
    codes = shapes.encode(points)
    assert codes.shape == (6, 5)
    np.testing.assert_allclose(codes.norm(dim=1).detach(), np.ones(6), rtol=1e-6)
    # A set has no order, and a point twice is no other set.
    shuffled = points[:, torch.randperm(20, generator=generator)]
    twice = torch.cat((points, points[:, :4]), dim=1)
    for same in (shuffled, twice):
        torch.testing.assert_close(shapes.encode(same), codes)
    assert float((shapes.encode(points + 0.5) - codes).norm(dim=1).min().detach()) > 1e-3


def test_layers_are_those_of_the_equations(shapes: ShapeAutoEncoder) -> None:
    """PointNet and decoder written out in NumPy."""
    weights = {name: value.detach().numpy() for name, value in shapes.named_parameters()}
    points = torch.randn(2, 4, 3, generator=torch.Generator().manual_seed(1))

    def linear(x: np.ndarray, name: str) -> np.ndarray:
        return x @ weights[f"{name}.weight"].T + weights[f"{name}.bias"]

    hidden = np.maximum(linear(points.numpy(), "encoder.layers.0"), 0)
    hidden = np.maximum(linear(hidden, "encoder.layers.1"), 0).max(axis=1)
    code = linear(hidden, "encoder.layers.2")
    code /= np.linalg.norm(code, axis=1, keepdims=True)
    np.testing.assert_allclose(shapes.encode(points).detach(), code, atol=1e-6)
    offsets = linear(np.maximum(linear(code, "decoder.layers.0"), 0), "decoder.layers.1")
    wanted = template()[0].numpy() + offsets.reshape(2, 42, 3)
    np.testing.assert_allclose(shapes.decode(torch.from_numpy(code)).detach(), wanted, atol=1e-5)


def test_only_the_direction_of_a_code_counts(shapes: ShapeAutoEncoder) -> None:
    codes = torch.randn(4, 5, generator=torch.Generator().manual_seed(2))
    meshes = shapes.decode(codes)
    torch.testing.assert_close(shapes.decode(3 * codes), meshes)
    codes.requires_grad_()
    shapes.decode(codes).square().sum().backward()
    assert codes.grad is not None
    along = (codes.grad * functional.normalize(codes.detach(), dim=1)).sum(dim=1)
    np.testing.assert_allclose(along, np.zeros(4), atol=1e-4)
    assert float(codes.grad.norm()) > 1e-2


def test_no_primitives_are_no_meshes(shapes: ShapeAutoEncoder) -> None:
    assert shapes.decode(torch.zeros(0, 5)).shape == (0, 42, 3)
    assert shapes.encode(torch.zeros(0, 2, 3)).shape == (0, 5)


def test_a_new_one_decodes_near_spheres_by_its_seed(shapes: ShapeAutoEncoder) -> None:
    codes = torch.randn(50, 5, generator=torch.Generator().manual_seed(4))
    with torch.no_grad():
        assert float((shapes.decode(codes).norm(dim=-1) - 1).abs().max()) < 0.2
        assert torch.equal(new_shapes(SMALL, seed=3).decode(codes), shapes.decode(codes))
        assert not torch.equal(new_shapes(SMALL, seed=4).decode(codes), shapes.decode(codes))


def test_the_published_widths_are_the_default() -> None:
    shapes = ShapeAutoEncoder()
    assert shapes.code_size == shapes.config.code_size == 8
    assert sum(value.numel() for value in shapes.parameters()) == 1_651_334


def test_bad_input_is_refused(shapes: ShapeAutoEncoder) -> None:
    with pytest.raises(ShapeError, match=r"points: expected shape \(any, any, 3\), got \(4, 3\)"):
        shapes.encode(torch.zeros(4, 3))
    with pytest.raises(ShapeError, match="points: expected a point in each set"):
        shapes.encode(torch.zeros(4, 0, 3))
    with pytest.raises(ShapeError, match=r"codes: expected shape \(any, 5\), got \(2, 8\)"):
        shapes.decode(torch.zeros(2, 8))
    alone = ShapeAutoEncoder(SMALL, has_encoder=False)
    assert alone.decode(torch.ones(1, 5)).shape == (1, 42, 3)
    with pytest.raises(InputError, match="got a decoder alone"):
        alone.encode(torch.zeros(1, 2, 3))


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"code_size": 1}, r"code_size: expected a value in \[2, 4096\], got 1"),
        ({"encoder_widths": ()}, "encoder_widths: expected 1 to 12 layers, got 0"),
        ({"decoder_widths": (8, 0)}, r"decoder_widths: expected widths of 1 to 4096, got \(8, 0\)"),
    ],
)
def test_widths_that_make_no_network_are_refused(fields: dict[str, object], words: str) -> None:
    with pytest.raises(RangeError, match=words):
        ShapeConfig(**fields)


# Files of ours, and of DNMP's training program.


TINY = ShapeConfig(code_size=4, encoder_widths=(5, 6), decoder_widths=(7,))
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
    shapes = new_shapes(TINY, seed=1)
    path = tmp_path / "a.safetensors"
    save_shapes(shapes, path, facts={"recipe": {"steps": 3}})
    found = load_shapes(path)
    assert found.config == TINY
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
        (r"\"code_size\"", r"\"code_sizo\"", "expected shape"),
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
    save_shapes(new_shapes(TINY, seed=1), path, facts={})
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
    shapes = ShapeAutoEncoder(TINY)
    with torch.no_grad():
        shapes.decoder.layers[0].bias[2] = 1e6
    with pytest.raises(InputError, match=r"decoder.layers.0.bias: expected weights .* got 1e\+06"):
        save_shapes(shapes, tmp_path / "a.safetensors", facts={})
    assert not list(tmp_path.iterdir())


# The auto-encoder that comes with the package.


def test_it_loads_first_of_all_and_is_frozen() -> None:
    """In a fresh process: nothing was made before that it could lean on."""
    words = "from splatseg.street.shape_files import load_shapes as f; print(f().vertices.device)"
    done = subprocess.run([sys.executable, "-c", words], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "cpu"
    shapes = load_shapes()
    assert not shapes.training
    assert not any(value.requires_grad for value in shapes.parameters())
    assert shapes.decode(torch.ones(2, 8)).shape == (2, 42, 3)
    assert SHIPPED.stat().st_size <= 1_000_000


def test_patches_of_other_scenes_keep_their_shape() -> None:
    """What is asked of it, on a room and a street that it was not trained on."""
    clouds = [
        surface_points(scene, 20_000, seed=9).positions
        for scene in (varied_room(300_000), street(300_000, length=30.0))
    ]
    generator = torch.Generator().manual_seed(0)
    patches = torch.cat([
        cut_patches(one, voxel_size=1.0, count=256, min_points=40, generator=generator)
        for one in clouds
    ])  # fmt: skip
    assert len(patches) > 100
    patches = patches[torch.randperm(len(patches), generator=generator)[:100]]
    found = score_shapes(load_shapes(), patches, pairs=60)
    assert found.chamfer_squared < found.sphere_squared / 8
    assert found.chamfer < found.sphere / 4
    assert found.intact_pairs >= 0.95
    assert found.intact_shapes >= 0.95
    assert found.sphere_deviation < 0.06
