"""The golden mesh field: read, shown and written as when it was made, on any processor."""

import importlib.util
import json
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from torch import Tensor

from splatseg.core import Camera
from splatseg.core.options import removed_options
from splatseg.errors import FileFormatError
from splatseg.io.tensors import read_safetensors
from splatseg.io.tensors_writing import write_tensors
from splatseg.street.field import MeshField
from splatseg.street.files import load_mesh_field, save_mesh_field
from splatseg.street.radiance import RadianceOptions


@pytest.fixture(scope="module")
def golden(project_root: Path) -> ModuleType:
    """The script that made the golden files, as a module."""
    path = project_root / "tests/golden/make_fields.py"
    spec = importlib.util.spec_from_file_location("make_fields", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def version_1(project_root: Path) -> Path:
    return project_root / "tests/golden/field-v1"


def test_values_come_back(golden: ModuleType, version_1: Path) -> None:
    made, found = golden.golden_field(), load_mesh_field(version_1 / golden.FIELD)
    assert torch.equal(found.mesh.vertices, made.mesh.vertices)
    assert found.mesh.levels.tolist() == [0, 0, 1]
    assert found.mesh.sizes == (0.5, 1.0)
    assert found.model.ids == golden.IDS
    assert found.model.options == golden.OPTIONS
    assert (found.layer_names, found.radius) == ((golden.LAYER,), 0.625)
    assert found.info == made.info
    assert set(found.model.state) == set(made.model.state)
    for name, tensor in made.model.state.items():
        assert torch.equal(found.model.state[name], tensor), name


PIXELS = ("colour", "alpha", "depth", "label_map", "label_map_confidence")
ROUNDING = 1e-5
"""What a field shows differs by less between processors, but for rays at edges."""


def largest(one: Tensor, two: Tensor) -> Tensor:
    """The largest difference of each pixel (or point)."""
    return (one.double() - two.double()).abs().reshape(*one.shape[:2], -1).amax(dim=-1)


def at_edges(field: MeshField, camera: Camera) -> Tensor:
    """Pixels whose rays pass an edge of a triangle so closely that rounding decides on the side.

    A ray moved by a hundred thousandth of a pixel, ten times what rounding moves it, shows other
    things: elsewhere it changes colours and depths by a few millionths.
    """

    def shown(right: float, down: float) -> dict[str, Tensor]:
        moved = replace(camera, cx=camera.cx + right, cy=camera.cy + down)
        with field.view(moved) as view:
            signals = view.signals()
        assert signals.colour is not None
        return {"colour": signals.colour, "alpha": signals.alpha, "depth": signals.depth}

    here = shown(0, 0)
    found = torch.zeros(camera.height, camera.width, dtype=torch.bool)
    for right, down in ((-1e-5, 0), (1e-5, 0), (0, -1e-5), (0, 1e-5)):
        there = shown(right, down)
        for name, values in here.items():
            found |= largest(values, there[name]).reshape(found.shape) > 2e-4
    return found


@pytest.mark.bits
def test_views_and_points_are_as_recorded(golden: ModuleType, version_1: Path) -> None:
    """Tight inside; at edges, which are few, a ray may have fallen on the other side."""
    recorded: dict[str, Any] = json.loads((version_1 / golden.SHOWN).read_text())
    field = load_mesh_field(version_1 / golden.FIELD)
    shown = golden.shown_of(field)
    assert set(shown) == set(recorded)
    edges = at_edges(field, golden.golden_camera())
    assert int(edges.sum()) <= 3, "of 54 pixels"
    for name, values in recorded.items():
        found, expected = torch.tensor(shown[name]), torch.tensor(values)
        if name not in PIXELS:
            exact = name == "point_ids"
            assert torch.allclose(found, expected, rtol=0, atol=0 if exact else ROUNDING), name
            continue
        away = largest(found, expected)
        assert float(away[~edges].max()) <= (0 if name == "label_map" else ROUNDING), name
        assert name == "label_map" or float(away.max()) < (0.3 if name == "depth" else 0.05), name
    # What is recorded is worth comparing: all classes, cover in part, a point without a label.
    assert {id for row in recorded["label_map"] for id in row} == set(golden.IDS)
    assert set(recorded["point_ids"]) == {*golden.IDS, -1}
    alpha = torch.tensor(recorded["alpha"])
    assert bool(((alpha > 0.5) & (alpha < 0.97)).any())


def test_it_is_written_as_it_was_read_without_options_that_are_none_any_more(
    golden: ModuleType, version_1: Path, tmp_path: Path
) -> None:
    committed, again = version_1 / golden.FIELD, tmp_path / "again.safetensors"
    save_mesh_field(load_mesh_field(committed), again)
    (before, old), (after, new) = read_safetensors(committed), read_safetensors(again)
    assert list(before) == list(after)
    assert all(torch.equal(before[name], after[name]) for name in before)
    old_about, new_about = json.loads(old["about"]), json.loads(new["about"])
    gone = old_about["options"].keys() - new_about["options"].keys()
    assert gone == {*removed_options(RadianceOptions)}
    old_about["options"] = {k: v for k, v in old_about["options"].items() if k not in gone}
    assert new_about == old_about


@pytest.mark.parametrize(("name", "value"), [("background", "none"), ("view_encoding", "view")])
def test_what_no_field_has_any_more_is_refused(
    golden: ModuleType, version_1: Path, tmp_path: Path, name: str, value: str
) -> None:
    tensors, metadata = read_safetensors(version_1 / golden.FIELD)
    about = json.loads(metadata["about"])
    about["options"][name] = value
    path = tmp_path / "other.safetensors"
    write_tensors(tensors, path, metadata=metadata | {"about": json.dumps(about)})
    with pytest.raises(FileFormatError, match=f"as {name}, which no field has another of"):
        load_mesh_field(path)


def test_the_file_is_as_the_page_of_formats_says(golden: ModuleType, version_1: Path) -> None:
    """Byte for byte by hand: length, header, numbers without gaps in its order."""
    content = (version_1 / golden.FIELD).read_bytes()
    length = int.from_bytes(content[:8], "little")
    assert length % 8 == 0
    header: dict[str, Any] = json.loads(content[8 : 8 + length])
    metadata = header.pop("__metadata__")
    assert list(metadata) == ["format", "version", "about"]
    assert (metadata["format"], metadata["version"]) == ("splatseg.street.field", "1")
    about = json.loads(metadata["about"])
    assert list(about) == ["sizes", "ids", "layer", "radius", "options", "info"]
    assert about["options"]["sides"] == "both"
    names = ["vertices", "levels", "model.features", "model.centre", "model.scale"]
    assert list(header)[:5] == names
    assert header["vertices"]["dtype"] == "F32"
    assert header["levels"]["dtype"] == "U8"
    assert header["model.features"] == {
        "dtype": "F16", "shape": [126, 3], "data_offsets": [1515, 2271]
    }  # fmt: skip
    end = 0
    widths = {"F32": 4, "F16": 2, "U8": 1}
    for row in header.values():
        begin, end_of_it = row["data_offsets"]
        count = torch.Size(row["shape"]).numel()
        assert (begin, end_of_it - begin) == (end, widths[row["dtype"]] * count)
        end = end_of_it
    assert 8 + length + end == len(content)
    tensors, _ = read_safetensors(version_1 / golden.FIELD)
    at = 8 + length + header["model.features"]["data_offsets"][0]
    values = torch.frombuffer(bytearray(content[at : at + 756]), dtype=torch.float16)
    assert torch.equal(values.view(126, 3), tensors["model.features"])


def test_the_page_of_formats_lists_what_is_written(
    golden: ModuleType, version_1: Path, project_root: Path
) -> None:
    page = (project_root / "docs/formats.md").read_text()
    start = page.index("## fields/NAME.safetensors")
    section = page[start : page.index("\n## ", start)]
    tensors, metadata = read_safetensors(version_1 / golden.FIELD)
    about = json.loads(metadata["about"])
    for name in tensors:
        parts = name.split(".")
        told = f"`{name}`" in section or f"`{'.'.join(parts[:-2])}.J." in section
        told |= f"`{'.'.join(parts[:-1])}.weight` `.bias`" in section
        assert told, name
    for key in (*about, *about["options"]):
        assert f"`{key}`" in section, key
