"""config.json is foreign: what it may say, and that nothing is fetched, run or built beyond it."""

import json
import os
import shutil
import socket
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import pytest

from splatseg.errors import FileFormatError, InputError
from splatseg.models import LoadOptions, find_model
from splatseg.models.networks._config_keys import FLAGS, NUMBERS, WORDS
from support.networks import KINDS, asked, checkpoint

LOAD = """
import sys
from splatseg.errors import FileFormatError
from splatseg.models import LoadOptions, find_model
try:
    find_model("dinov2", loading=LoadOptions(weights=sys.argv[1], device="cpu"))
    print("loaded")
except FileFormatError as error:
    print(error)
"""
FAKE = """
from pathlib import Path
def __getattr__(name):
    Path(__file__).with_name("called").touch()
    raise AttributeError(name)
"""


@pytest.fixture
def changed(checkpoints, tmp_path):
    """A copy of a checkpoint with other values in its config.json, by dotted keys."""

    def change(kind: str, **values) -> Path:
        shutil.rmtree(tmp_path / "weights", ignore_errors=True)
        folder = Path(shutil.copytree(checkpoints(kind), tmp_path / "weights"))
        content = json.loads((folder / "config.json").read_text())
        for name, value in values.items():
            *parts, key = name.split("__")
            holder = content
            for part in parts:
                holder = holder[part]
            holder[key] = value
        (folder / "config.json").write_text(json.dumps(content))
        return folder

    return change


def load(folder: Path, family: str = "dinov2") -> object:
    return find_model(family, loading=LoadOptions(weights=str(folder), device="cpu"))


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"attn_implementation": "someone/kernels"}, "attn_implementation: expected eager or sdpa"),
        ({"_attn_implementation": "flash_attention_2"}, "expected eager or sdpa"),
        ({"quantization_config": {"quant_method": "torchao"}}, "weights that are not quantised"),
        ({"auto_map": {"AutoModel": "a.B"}}, "without code"),
        ({"torch_dtype": "os"}, "torch_dtype: expected float32 or"),
        ({"dtype": ["float32"]}, "dtype: expected float32 or"),
        ({"num_hidden_layers": 100_000}, "num_hidden_layers: expected a whole number fro"),
        ({"hidden_size": 10**7}, "hidden_size: expected a whole number"),
        ({"hidden_size": True}, "hidden_size: expected a whole number"),
        ({"hidden_size": "32"}, "hidden_size: expected a whole number"),
        ({"image_size": [56] * 1000}, "image_size: expected at most 128 numbers"),
        ({"layer_norm_eps": float("nan")}, "layer_norm_eps: expected a number"),
        ({"qkv_bias": 1}, "qkv_bias: expected true or false"),
        ({"hidden_act": "os.system"}, "hidden_act: expected a word"),
        ({"out_features": ["../../a"]}, "out_features: expected a word"),
        ({"id2label": {"x": "a"}}, "id2label: expected a name by the number"),
        ({"id2label": {str(i): "a" for i in range(70_000)}}, "names of 1 to 65535 classes"),
        ({"num_labels": 10**9}, "num_labels: expected a whole number from 1 to 65535"),
        ({"hidden_size": 1 << 16, "mlp_ratio": 8}, "expected a network of the size of its weights"),
        ({"num_attention_heads": 0}, "expected a configuration of Dinov2Model"),
        ({"mlp_ratio": 2.5}, "config.json: expected a configuration of Dinov2Model"),
        ({"x": "y" * (1 << 22)}, "expected a configuration of at most 4194304 bytes"),
        ({"model_type": "x" * 5000}, "expected weights of dinov2"),
    ],
)  # fmt: skip
def test_what_a_configuration_may_not_say(changed, values, words) -> None:
    with pytest.raises(FileFormatError, match=words) as caught:
        load(changed("dinov2", **values))
    assert len(str(caught.value)) < 600
    assert "\n" not in str(caught.value)


def test_parts_are_looked_at_too(changed) -> None:
    folder = changed("depth_anything", backbone_config__attn_implementation="a/b")
    with pytest.raises(FileFormatError, match=r"backbone_config\.attn_implementation: expected e"):
        load(folder, "depth-anything")
    folder = changed("depth_anything", backbone_config__model_type="timm_backbone")
    with pytest.raises(FileFormatError, match=r"backbone_config\.model_type: expected dinov2 or"):
        load(folder, "depth-anything")
    folder = changed("depth_anything", backbone_config=None, backbone="someone/network")
    with pytest.raises(FileFormatError, match="backbone: expected backbone_config, not the name"):
        load(folder, "depth-anything")
    with pytest.raises(FileFormatError, match="depths: expected a sum of at most 200"):
        load(changed("segformer", depths=[60, 60, 60, 60]), "segformer")


def test_settings_of_a_later_library_are_not_left_out_in_silence(changed, monkeypatch) -> None:
    known = dict(NUMBERS)
    del known["layerscale_value"]
    monkeypatch.setattr("splatseg.models.networks._config.NUMBERS", known)
    folder = changed("dinov2", layerscale_value=1.0, nobody_knows=3)
    load(folder)  # the default, and what the library does not know either
    with pytest.raises(FileFormatError, match="layerscale_value: expected no such setting"):
        load(changed("dinov2", layerscale_value=0.5))


def test_sizes_that_leave_nothing_of_an_image(changed) -> None:
    """They fit the weights, so it shows when the network looks."""
    folder = changed("segformer", strides=[64, 64, 64, 64])
    with pytest.raises(FileFormatError, match=r"weights: expected a network that takes an image"):
        asked("segformer", folder)


def test_what_is_said_reaches_the_library(changed) -> None:
    """None is a value, which is not the default of each key."""
    content = {"layerscale_value": 0.25, "out_features": None, "hidden_dropout_prob": 0.5}
    model = load(changed("dinov2", attn_implementation="eager", **content))
    config = model._network.config
    assert config._attn_implementation == "eager"
    assert (config.layerscale_value, config.hidden_dropout_prob) == (0.25, 0.5)
    with pytest.raises(FileFormatError, match="expected a configuration of Dinov2With"):
        load(changed("dinov2_with_registers", mlp_ratio=None))


def test_no_key_is_of_two_kinds() -> None:
    names = [*NUMBERS, *FLAGS, *WORDS]
    assert len(names) == len(set(names))


@pytest.mark.parametrize("name", KINDS)
def test_nothing_is_asked_of_the_network(name, tmp_path, monkeypatch) -> None:
    """Whatever the file names, and though the library of the hub was imported online."""
    seen: list[object] = []

    def refuse(*words, **more):
        seen.append(words)
        raise OSError("no network here")

    monkeypatch.setattr(socket.socket, "connect", refuse)
    monkeypatch.setattr(socket, "getaddrinfo", refuse)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", False)
    family, kind = KINDS[name]
    folder = checkpoint(family, kind, tmp_path)
    asked(family, folder)
    file = folder / "config.json"
    content = json.loads(file.read_text())
    hostile = {"backbone": "someone/network", "use_timm_backbone": False,
               "use_pretrained_backbone": True, "_name_or_path": "someone/network",
               "configuration_files": ["config.9.0.0.json"],
               "transformers_weights": "/dev/zero"}  # fmt: skip
    parts = [
        value for value in content.values() if isinstance(value, dict) and "model_type" in value
    ]
    for part in (content, *parts):
        for without in ((), ("backbone_config",)):
            kept = {key: part.pop(key) for key in without if key in part}
            added = {key: hostile[key] for key in hostile if key not in part}
            part.update(added)
            file.write_text(json.dumps(content))
            with suppress(InputError):
                asked(family, folder)
            for key in added:
                del part[key]
            part.update(kept)
    assert seen == []


def test_no_code_is_fetched_for_attention(changed, tmp_path) -> None:
    """transformers asks the package `kernels`, where there is one, for what the file names."""
    packages = tmp_path / "packages"
    (packages / "kernels").mkdir(parents=True)
    (packages / "kernels" / "__init__.py").write_text(FAKE)
    about = packages / "kernels-0.99.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: kernels\nVersion: 0.99.0\n")
    folder = changed("dinov2", attn_implementation="kernels-community/flash-attn2")
    paths = os.pathsep.join([str(packages), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        [sys.executable, "-c", LOAD, str(folder)], capture_output=True, text=True, check=True,
        env={**os.environ, "PYTHONPATH": paths},
    )  # fmt: skip
    assert "attn_implementation: expected eager or sdpa" in done.stdout
    assert not (packages / "kernels" / "called").exists()


@pytest.mark.parametrize("name", ["config.json", "model.safetensors", "preprocessor_config.json"])
def test_pipes_and_folders_in_place_of_files(checkpoints, tmp_path, name) -> None:
    folder = Path(shutil.copytree(checkpoints("dinov2"), tmp_path / "weights"))
    (folder / name).unlink(missing_ok=True)
    os.mkfifo(folder / name)
    with pytest.raises(FileFormatError, match=f"{name}: expected a regular file"):
        load(folder)
    (folder / name).unlink()
    (folder / name).mkdir()
    with pytest.raises(FileFormatError, match=f"{name}: expected a regular file"):
        load(folder)


def test_parts_of_weights_lie_beside_their_index(checkpoints, tmp_path) -> None:
    folder = Path(shutil.copytree(checkpoints("dinov2"), tmp_path / "weights"))
    index = folder / "model.safetensors.index.json"
    index.write_text(json.dumps({"weight_map": {"a": "../../other.safetensors"}}))
    with pytest.raises(FileFormatError, match="weight_map: expected names of files beside it"):
        load(folder)
