"""Files of mesh fields: the same after a round trip, the same bytes, one sentence for damage."""

import json
from dataclasses import asdict
from pathlib import Path

import pytest
import torch

from splatseg.errors import FileFormatError, InputError, MissingFileError, SplatsegError
from splatseg.io.tensors import read_safetensors
from splatseg.io.tensors_writing import write_tensors
from splatseg.street.field import VERTEX_RULES, MeshField
from splatseg.street.files import FORMAT, load_mesh_field, load_mesh_field_layer, save_mesh_field
from support.mesh_fields import SMALL, balls, random_field, told_field


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    path = tmp_path / "field.safetensors"
    save_mesh_field(random_field(), path)
    return path


def changed(path: Path, **values: object) -> Path:
    """The file with keys of its record, of its header, or tensors replaced; None removes one."""
    tensors, metadata = read_safetensors(path)
    about = json.loads(metadata["about"])
    for name, value in values.items():
        key = name.replace("__", ".")
        at = tensors if key in tensors else metadata if key in metadata else about
        if value is None:
            del at[key]
        else:
            at[key] = value
    write_tensors(tensors, path, metadata=metadata | {"about": json.dumps(about)})
    return path


def test_all_comes_back(saved: Path) -> None:
    field, found = random_field(), load_mesh_field(saved)
    assert torch.equal(found.mesh.vertices, field.mesh.vertices)
    assert torch.equal(found.mesh.levels, field.mesh.levels)
    assert found.mesh.sizes == field.mesh.sizes
    assert found.model.ids == field.model.ids
    assert found.model.options == field.model.options
    assert (found.layer_names, found.radius, found.info) == (
        field.layer_names, field.radius, field.info,
    )  # fmt: skip
    state = found.model.state
    assert set(state) == set(field.model.state)
    for name, tensor in field.model.state.items():
        assert torch.equal(state[name], tensor), name
    points = field.mesh.vertices + 0.1
    assert torch.equal(
        found.labels_at(points, "classes").confidence, field.labels_at(points, "classes").confidence
    )


def test_the_same_values_give_the_same_bytes(saved: Path, tmp_path: Path) -> None:
    again = tmp_path / "again.safetensors"
    save_mesh_field(load_mesh_field(saved), again)
    assert again.read_bytes() == saved.read_bytes()


def test_what_float16_holds_is_float16(tmp_path: Path) -> None:
    path = tmp_path / "told.safetensors"
    field = told_field(balls([[0, 0, 2]]), [1])
    save_mesh_field(MeshField(field.mesh, field.model, radius=0.7, layer="x"), path)
    tensors, metadata = read_safetensors(path)
    assert tensors["model.features"].dtype == torch.float16
    assert tensors["vertices"].dtype == torch.float32
    assert metadata["format"] == FORMAT
    found = load_mesh_field(path)
    assert found.model.features.dtype == torch.float32
    assert (found.radius, found.layer_names) == (0.7, ("x",))


def test_no_file_and_other_files(tmp_path: Path) -> None:
    with pytest.raises(MissingFileError):
        load_mesh_field(tmp_path / "none.safetensors")
    other = tmp_path / "other.safetensors"
    write_tensors({"a": torch.zeros(2)}, other, metadata={})
    with pytest.raises(FileFormatError, match="expected a mesh field, got None"):
        load_mesh_field(other)
    with pytest.raises(InputError, match=r"expected \.safetensors, got \.npz"):
        save_mesh_field(random_field(), tmp_path / "a.npz")


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"version": "2"}, "of version 1, got version '2'; a later splatseg wrote it"),
        ({"sizes": None}, "about: expected sizes, got none"),
        ({"sizes": 3}, "sizes: expected a list, got 3"),
        ({"sizes": [-1.0]}, "sizes: expected positive lengths"),
        ({"ids": [3, 3, 5]}, "ids: expected distinct ids"),
        ({"ids": [0, 3, 5]}, "ids: expected a whole number in"),
        ({"ids": [3, 5]}, "expected floating-point numbers of shape"),
        ({"radius": 0}, "radius: expected a positive length"),
        ({"radius": "wide"}, "radius: expected a finite number"),
        ({"layer": 3}, "expected a name as layer, got 3"),
        ({"layer": "a@b"}, "layer: expected a name without @"),
        ({"info": []}, r"expected an object as info, got \[\]"),
        ({"info": {"version": 9}}, "record of version 1 or less, got version 9"),
        ({"options": 3}, "expected an object as options, got 3"),
        ({"options": {}}, "options: expected those .*background_widths, .*, got none"),
        ({"options": asdict(SMALL) | {"colour": 3}}, "of this splatseg .*, got colour; a later"),
        ({"options": asdict(SMALL) | {"width": "16"}}, "width"),
        ({"options": asdict(SMALL) | {"width": 16.5}}, "width"),
        ({"options": asdict(SMALL) | {"width": True}}, "width"),
        ({"options": asdict(SMALL) | {"sides": "back"}}, "sides"),
        ({"options": asdict(SMALL) | {"rate": [1]}}, "rate"),
        ({"vertices": None}, "expected a tensor vertices, got none"),
        ({"vertices": torch.zeros(42, 3)}, "expected 42 vertices for each of 2 primitives"),
        ({"vertices": torch.full((84, 3), torch.nan)}, "vertices: .* not finite"),
        ({"levels": torch.zeros(2)}, "expected levels of uint8"),
        ({"levels": torch.full((2,), 7, dtype=torch.uint8)}, "levels: expected levels of 1 sizes"),
        ({"model__features": None}, "expected a tensor model.features, got none"),
        ({"model__features": torch.full((84, 4), torch.inf)}, "features: .* not finite"),
        ({"model__features": torch.zeros(84, 4).int()}, "got torch.int32 of shape"),
        ({"model__scale": torch.tensor(0.0)}, "model.scale: expected a positive length, got 0"),
        ({"model__scale": torch.tensor(torch.nan)}, "model.scale: expected .*, got nan"),
        ({"model__other": torch.zeros(1)}, "got others"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)  # fmt: skip
def test_every_key_is_checked(saved: Path, values: dict[str, object], words: str) -> None:
    if "model__other" in values:
        tensors, metadata = read_safetensors(saved)
        write_tensors(tensors | {"model.other": torch.zeros(1)}, saved, metadata=metadata)
    else:
        changed(saved, **values)
    with pytest.raises(FileFormatError, match=words) as error:
        load_mesh_field(saved)
    assert str(error.value).startswith(str(saved))
    assert str(error.value).count("\n") == 0


def test_what_is_known_of_the_layer_is_in_the_header(saved: Path) -> None:
    """Of a file whose numbers are gone as well."""
    field = load_mesh_field(saved)
    name = field.layer_names[0]
    expected = repr((name, field.layer(name)))
    assert repr(load_mesh_field_layer(saved)) == expected
    length = 8 + int.from_bytes(saved.read_bytes()[:8], "little")
    saved.write_bytes(saved.read_bytes()[:length])
    assert repr(load_mesh_field_layer(saved)) == expected
    saved.write_bytes(saved.read_bytes()[: length - 1])
    with pytest.raises(FileFormatError, match="its header is cut off"):
        load_mesh_field_layer(saved)
    with pytest.raises(MissingFileError, match="none"):
        load_mesh_field_layer(saved.with_name("none.safetensors"))


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"version": "2"}, "of version 1, got version '2'; a later splatseg wrote it"),
        ({"ids": [0, 3, 5]}, "ids: expected a whole number in"),
        ({"layer": 3}, "expected a name as layer, got 3"),
        ({"info": []}, r"expected an object as info, got \[\]"),
    ],
)
def test_the_header_is_checked_by_itself(saved: Path, values: dict[str, object], words) -> None:
    with pytest.raises(FileFormatError, match=words):
        load_mesh_field_layer(changed(saved, **values))


def test_options_that_ask_for_all_memory_are_refused_before_it_is_taken(saved: Path) -> None:
    options = asdict(random_field().model.options) | {"width": 4096, "depth": 32}
    with pytest.raises(FileFormatError, match="expected floating-point numbers of shape"):
        load_mesh_field(changed(saved, options=options))
    with pytest.raises(FileFormatError, match="width"):
        load_mesh_field(changed(saved, options=options | {"width": 10**12}))


def test_files_of_before_sides_were_an_option_met_both(saved: Path) -> None:
    options = {name: value for name, value in asdict(SMALL).items() if name != "sides"}
    assert load_mesh_field(changed(saved, options=options)).model.options.sides == "both"


def test_a_file_cut_anywhere_is_one_sentence(saved: Path) -> None:
    whole = saved.read_bytes()
    for end in range(0, len(whole), max(1, len(whole) // 60)):
        saved.write_bytes(whole[:end])
        with pytest.raises(SplatsegError):
            load_mesh_field(saved)


def test_what_training_saw_comes_back(tmp_path: Path) -> None:
    field = random_field()
    seen = torch.linspace(0, 1, len(field.mesh.vertices)).half().float()
    path = tmp_path / "seen.safetensors"
    save_mesh_field(MeshField(field.mesh, field.model, seen=seen, layer="x"), path)
    tensors, metadata = read_safetensors(path)
    assert tensors["seen"].dtype == torch.float16
    assert torch.equal(load_mesh_field(path).seen, seen)
    assert load_mesh_field(path).vertex_rule == "weighed"
    for rule in VERTEX_RULES:
        asked = MeshField(field.mesh, field.model, seen=seen, vertex_rule=rule)
        save_mesh_field(asked, tmp_path / "asked.safetensors")
        assert load_mesh_field(tmp_path / "asked.safetensors").vertex_rule == rule
    about = json.loads(metadata["about"])
    # The first files say no rule; those with `seen` weighed by it.
    for rule, found in ((None, "weighed"), ("all", "all")):
        told = {k: v for k, v in about.items() if k != "vertex_rule"}
        told |= {} if rule is None else {"vertex_rule": rule}
        write_tensors(tensors, path, metadata=metadata | {"about": json.dumps(told)})
        assert load_mesh_field(path).vertex_rule == found
    write_tensors(
        tensors, path, metadata=metadata | {"about": json.dumps(about | {"vertex_rule": "near"})}
    )
    with pytest.raises(FileFormatError, match="vertex_rule: expected one of adjusted, weighed"):
        load_mesh_field(path)
    for wrong, words in (
        (seen[1:], "seen: expected shape"),
        (2 * seen, "seen: expected values"),
        (torch.ones(len(seen), dtype=torch.int32), "seen: expected floating-point numbers"),
    ):
        write_tensors(tensors | {"seen": wrong}, path, metadata=metadata)
        with pytest.raises(FileFormatError, match=words):
            load_mesh_field(path)
