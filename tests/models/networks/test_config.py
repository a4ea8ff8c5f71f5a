"""config.json is foreign: what it may say, and that nothing is fetched, run or built beyond it."""

import importlib
import json
import os
import shutil
import socket
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

import support
from splatseg.errors import FileFormatError, InputError, MissingFileError
from splatseg.models import LoadOptions, find_model
from splatseg.models.networks._config import (
    FLAGS,
    NUMBERS,
    WORDS,
    checked_config,
    library_config,
    offline,
)
from splatseg.models.networks._library import side_of
from support.networks import IMAGE, KINDS, asked, checkpoint, copied, in_parts


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
        ({"id2label": {"0": "a\0"}}, "config.json: id2label: 0: expected text that UTF-8 can hold"),
        ({"eos_token_id": [1, 2]}, "eos_token_id: expected the number of one token"),
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


def test_maps_that_do_not_fit_each_other(changed) -> None:
    """Fewer sizes of maps than SAM 2's decoder takes; no block at all."""
    folder = changed("sam2", vision_config__backbone_feature_sizes=[[16, 16]])
    with pytest.raises(FileFormatError, match=r"weights: expected a network that takes an image"):
        asked("sam2", folder)
    with pytest.raises(FileFormatError, match=r"num_hidden_layers: expected a whole .* 1 to 200"):
        load(changed("dino", num_hidden_layers=0), "dino")


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
def test_nothing_is_asked_of_the_network(name, checkpoints, tmp_path, monkeypatch) -> None:
    """Whatever the file names, and though the library of the hub was imported online."""
    seen: list[object] = []

    def refuse(*words, **more):
        seen.append(words)
        raise OSError("no network here")

    monkeypatch.setattr(socket.socket, "connect", refuse)
    monkeypatch.setattr(socket, "getaddrinfo", refuse)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", False)
    family, kind = KINDS[name]
    folder = copied(family, checkpoints(kind), tmp_path)
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
        for without in ((), *((name,) for name in ("backbone_config",) if name in part)):
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


def test_a_tokenizer_that_ends_in_a_panic(checkpoints, tmp_path, capfd) -> None:
    """Parts of words that are longer than the words: the library counts below zero."""
    folder = Path(shutil.copytree(checkpoint("oneformer", "oneformer", tmp_path), tmp_path / "w"))
    content = json.loads((folder / "tokenizer.json").read_text())
    words = ["<pad>", "<unk>", "a", "b", "ab"]
    content["model"] = {
        "type": "BPE", "continuing_subword_prefix": "x" * 9, "merges": [["a", "b"]],
        "vocab": {word: i for i, word in enumerate(words)}, "unk_token": "<unk>",
    }  # fmt: skip
    (folder / "tokenizer.json").write_text(json.dumps(content))
    match = r"w: expected the tokenizer of the weights, but it cannot be read \(range end index"
    with pytest.raises(FileFormatError, match=match):
        asked("oneformer", folder)


def test_a_tokenizer_that_fails_when_it_is_asked(checkpoints, tmp_path) -> None:
    """What it says of words that it does not know is in no vocabulary either."""
    folder = Path(shutil.copytree(checkpoint("oneformer", "oneformer", tmp_path), tmp_path / "w"))
    content = json.loads((folder / "tokenizer.json").read_text())
    content["model"]["unk_token"] = "nowhere"
    content["model"]["vocab"] = {"<pad>": 0, "<unk>": 1}
    (folder / "tokenizer.json").write_text(json.dumps(content))
    with pytest.raises(FileFormatError, match="w: expected the tokenizer of the weights, but it"):
        asked("oneformer", folder)


@pytest.mark.parametrize("name", ["tokenizer.json", "tokenizer.5.0.0.json"])
@pytest.mark.parametrize(
    "steps",
    [
        {"normalizer": {"type": "Sequence", "normalizers": [
            {"type": "Replace", "pattern": {"String": "a"}, "content": "a" * 1000}] * 4}},
        {"normalizer": {"type": "Sequence", "normalizers": [
            {"type": "Sequence", "normalizers": [{"type": "Prepend", "prepend": "a"}] * 9}] * 9}},
        {"post_processor": {"type": "Sequence", "processors": [
            {"type": "TemplateProcessing", "single": [{"Sequence": {"id": "A", "type_id": 0}}] * 99,
             "pair": [], "special_tokens": {}}] * 9}},
    ],
)  # fmt: skip
def test_a_tokenizer_whose_texts_fill_the_memory(checkpoints, tmp_path, steps, name) -> None:
    """Where none is left the library ends the process."""
    folder = Path(shutil.copytree(checkpoint("oneformer", "oneformer", tmp_path), tmp_path / "w"))
    content = json.loads((folder / "tokenizer.json").read_text())
    (folder / name).write_text(json.dumps(content | steps))
    with pytest.raises(FileFormatError, match=f"{name}: expected steps that make a text at most "):
        asked("oneformer", folder)


@pytest.mark.parametrize("family", ["clipseg", "clip"])
def test_a_tokenizer_of_a_network_that_knows_more(checkpoints, tmp_path, family) -> None:
    """A GPU would read beside its memory."""
    folder = Path(shutil.copytree(checkpoints(family), tmp_path / "w"))
    content = json.loads((folder / "tokenizer_config.json").read_text())
    (folder / "tokenizer_config.json").write_text(json.dumps(content | {"bos_token": "<new>"}))
    with pytest.raises(FileFormatError, match=r"w: expected the tokenizer of a network that knows"):
        asked(family, folder)


def test_weights_in_parts(checkpoints, tmp_path) -> None:
    folder = Path(shutil.copytree(checkpoints("dinov2"), tmp_path / "weights"))
    whole = load(folder)
    first, second = in_parts(folder)
    found, wanted = (model.features(IMAGE).class_token for model in (load(folder), whole))
    torch.testing.assert_close(found, wanted, rtol=0, atol=0)
    second.unlink()
    match = f"safetensors.index.json: expected the files .*, but there is no {second.name}.$"
    with pytest.raises(MissingFileError, match=match):
        load(folder)
    first.unlink()
    with pytest.raises(MissingFileError, match=f"there is no {first.name}, {second.name}.$"):
        load(folder)
    index = folder / "model.safetensors.index.json"
    index.write_text(json.dumps({"weight_map": {"a": "x" * 5000}}))
    with pytest.raises(MissingFileError, match="there is no x") as caught:
        load(folder)
    assert len(str(caught.value)) < 600


def test_an_index_beside_whole_weights_is_not_followed(checkpoints, tmp_path) -> None:
    folder = Path(shutil.copytree(checkpoints("dinov2"), tmp_path / "weights"))
    index = {"weight_map": {"a": "model-00001-of-00002.safetensors"}}
    (folder / "model.safetensors.index.json").write_text(json.dumps(index))
    load(folder)


def test_a_size_that_a_file_gives_is_a_multiple_of_the_patch_too(checkpoints, tmp_path) -> None:
    folder = Path(shutil.copytree(checkpoints("clipseg"), tmp_path / "weights"))
    (folder / "preprocessor_config.json").write_text(json.dumps({"size": {"height": 65}}))
    match = "weights: expected a size of images that is a multiple of 16, got 65"
    with pytest.raises(FileFormatError, match=match):
        asked("clipseg", folder)


def test_an_adapter_is_no_network(checkpoints, tmp_path) -> None:
    """With the package peft the library would put it in, and import what it names."""
    folder = Path(shutil.copytree(checkpoints("dinov2"), tmp_path / "weights"))
    (folder / "adapter_config.json").write_text('{"peft_type": "LORA"}')
    with pytest.raises(FileFormatError, match="adapter_config.json: expected the weights of a net"):
        load(folder)


@pytest.mark.parametrize(
    ("family", "kind", "values", "words"),
    [
        ("dinov3", "dinov3", {"image_size": 0}, "expected sides in pixels, got 0"),
        ("clipseg", "clipseg", {"extract_layers": [0, 77]}, r"some of \d+ blocks, got \[0, 77\]"),
        ("clipseg", "clipseg", {"extract_layers": [-1]}, r"some of \d+ blocks, got \[-1\]"),
    ],
)
def test_sizes_that_are_none(changed, family, kind, values, words) -> None:
    with pytest.raises(FileFormatError, match=f"config.json: .*{words}"):
        asked(family, changed(kind, **values))


@pytest.mark.parametrize(("value", "side"), [(14, 14), ([14, 16], 16), ((3,), 3)])
def test_a_side(value, side) -> None:
    assert side_of(Path("a"), value) == side


@pytest.mark.parametrize("value", [0, -1, 2.0, None, [], [4, 0], "8"])
def test_no_side(value) -> None:
    with pytest.raises(FileFormatError, match=r"a/config.json: expected sides in pixels, got "):
        side_of(Path("a"), value)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ({"size": {"height": 1 << 15}}, "size: height: expected a number of pixels up to 16384"),
        ({"size": {"height": True}}, "size: height: expected a number of pixels up to 16384"),
        ({"image_std": [0.5, 0.0, 0.5]}, r"image_std: expected three numbers in \[0.001, 1\]"),
        ({"image_mean": [0.5, -0.1, 0.5]}, r"image_mean: expected three numbers in \[0, 1\]"),
    ],
)
def test_what_is_said_of_pictures(checkpoints, tmp_path, content, words) -> None:
    folder = Path(shutil.copytree(checkpoints("clipseg"), tmp_path / "weights"))
    (folder / "preprocessor_config.json").write_text(json.dumps(content))
    with pytest.raises(FileFormatError, match=f"preprocessor_config.json: {words}"):
        asked("clipseg", folder)


def test_nothing_reaches_the_hub_while_a_library_loads() -> None:
    constants = importlib.import_module("huggingface_hub").constants
    before = constants.HF_HUB_OFFLINE
    with offline():
        assert constants.HF_HUB_OFFLINE is True
    assert constants.HF_HUB_OFFLINE is before


# What published weights say in config.json is taken, and reaches the library as it is.


TYPES = (
    *("clip", "clipseg", "depth_anything", "dinov2", "dinov2_with_registers", "dinov3_vit", "dpt"),
    *("eomt", "eomt_dinov3", "grounding-dino", "mask2former", "maskformer", "mm-grounding-dino"),
    *("oneformer", "sam", "sam2", "sam2_video", "sam3", "sam3_tracker", "sam3_tracker_video"),
    *("sam3_video", "sam_hq", "segformer", "siglip", "siglip2", "vit"),
)
EARLIER = {
    "_commit_hash": None, "_name_or_path": "", "add_cross_attention": False, "architectures": None,
    "bad_words_ids": None, "chunk_size_feed_forward": 0, "diversity_penalty": 0.0,
    "do_sample": False, "early_stopping": False, "finetuning_task": None, "is_decoder": False,
    "length_penalty": 1.0, "max_length": 20, "min_length": 0, "num_beams": 1,
    "output_attentions": False, "problem_type": None, "pruned_heads": {}, "return_dict": True,
    "sep_token_id": None, "temperature": 1.0, "tf_legacy_loss": False, "tie_encoder_decoder": False,
    "tie_word_embeddings": True, "top_k": 50, "torch_dtype": "float32", "torchscript": False,
    "transformers_version": "4.29.0.dev0", "typical_p": 1.0, "use_bfloat16": False,
}  # fmt: skip
"""What files of releases 4 hold, of every network."""

STAGES = {"stage_names": ["stem", *(f"stage{i}" for i in range(1, 13))]}
UNNAMED = {
    "backbone": None, "backbone_kwargs": None, "use_timm_backbone": False,
    "use_pretrained_backbone": False,
}  # fmt: skip
OWN = {
    "depth_anything": UNNAMED,
    "dinov2": {**STAGES, "out_features": ["stage12"], "out_indices": [12]},
    "dinov2_with_registers": {"interpolate_antialias": True, "interpolate_offset": 0.0},
    "grounding-dino": UNNAMED,
    "mm-grounding-dino": UNNAMED,
    "oneformer": {"max_seq_len": 77, "num_classes": 150},
    "sam2_video": {
        "memory_attention_rope_k_sizes": [16, 16],
        "preserve_temporal_direction_in_object_pointers": True,
        "project_temporal_pos_encoding_in_object_pointers": True,
    },
    "segformer": {"downsampling_rates": [1, 4, 8, 16], "reshape_last_stage": True},
}
"""What files of one network hold besides its settings of today."""

CHANGED = {"out_features", "out_indices", "tie_word_embeddings", "torch_dtype", "return_dict"}


def read(tmp_path, kind: str, content: dict) -> dict:
    """What the library makes of a file, but for numbers of classes, which `id2label` says."""
    path = tmp_path / "config.json"
    path.write_text(json.dumps(content))
    auto = importlib.import_module("transformers.models.auto.configuration_auto")
    network = SimpleNamespace(config_class=auto.CONFIG_MAPPING[kind], __name__=kind)
    made, rest = library_config(path, checked_config(path, (kind,)), network)
    assert rest == {}
    return settings(json.loads(made.to_json_string(use_diff=False)))


def settings(content: dict) -> dict:
    """Values by dotted names."""
    found = {}
    for key, value in content.items():
        inner = value if isinstance(value, dict) and key != "label2id" else None
        below = {key: value} if inner is None else settings(inner)
        found |= {name if inner is None else f"{key}.{name}": one for name, one in below.items()}
    return {name: one for name, one in found.items() if not name.endswith("label2id")}


@pytest.mark.parametrize("kind", TYPES)
def test_what_the_library_saves(tmp_path, kind) -> None:
    auto = importlib.import_module("transformers.models.auto.configuration_auto")
    saved = json.loads(auto.CONFIG_MAPPING[kind]().to_json_string(use_diff=False))
    found = read(tmp_path, kind, saved)
    assert found == settings(saved)
    added = EARLIER | OWN.get(kind, {})
    earlier = {key: value for key, value in added.items() if key not in saved or key in CHANGED}
    for key, value in saved.items():
        if key.endswith("_config") and isinstance(value, dict):
            saved[key] = value | {one: EARLIER[one] for one in EARLIER if one not in value}
            saved[key] |= {"gradient_checkpointing": False, "path_norm": True} | STAGES
    later = read(tmp_path, kind, saved | earlier)
    changed = {name for name in found if found[name] != later[name]}
    assert {name.rsplit(".")[-1] for name in changed} <= CHANGED


# No family of networks lets its weights call the package kernels, which fetches and runs code.


FAKE = """
from pathlib import Path

CALLS = Path(__file__).with_name("calls")

def __getattr__(name):
    if name.startswith("__"):
        raise AttributeError(name)
    def called(*words, **more):
        CALLS.open("a").write(name + chr(10))
        raise OSError("no kernels here")
    return called

def unchanged(*words, **more):  # what the library decorates its classes with, at import
    return lambda wrapped: wrapped

use_kernel_forward_from_hub = use_kernelized_func = unchanged
"""
ASK = """
import json
import sys
from pathlib import Path

import transformers

from splatseg.errors import FileFormatError
from support.networks import asked

packages, checkpoints = Path(sys.argv[1]), json.loads(sys.argv[2])
calls = packages / "kernels" / "calls"
HUB = "kernels-community/flash-attn2"
others = {"use_kernels": True, "kernel_config": {"a": HUB}, "experts_implementation": HUB}
for family, folder in checkpoints:
    file = Path(folder) / "config.json"
    sound = file.read_text()
    names = [key for key, value in json.loads(sound).items() if isinstance(value, dict)]
    parts = [None, *(name for name in names if name.endswith("_config"))]
    for part in parts:
        for key in ("attn_implementation", "_attn_implementation", "_attn_implementation_internal"):
            content = json.loads(sound)
            (content if part is None else content[part])[key] = HUB
            file.write_text(json.dumps(content))
            try:
                asked(family, Path(folder))
            except FileFormatError as error:
                known = f"{key}: expected eager or sdpa" in str(error)
                print(family, "refused" if known else error)
            else:
                print(family, "took", part, key)
    content = json.loads(sound)
    for part in parts:
        (content if part is None else content[part]).update(others)
    file.write_text(json.dumps(content))
    asked(family, Path(folder))
print("calls", calls.exists())
content["attn_implementation"] = HUB
file.write_text(json.dumps(content))
try:
    transformers.AutoModel.from_pretrained(folder)
except Exception:
    print("calls of the library itself", calls.read_text().split())
"""


def test_kernels_are_never_called(checkpoints, tmp_path) -> None:
    from transformers.utils.import_utils import KERNELS_MIN_VERSION

    packages = tmp_path / "packages"
    (packages / "kernels" / "layer").mkdir(parents=True)
    (packages / "kernels" / "__init__.py").write_text(FAKE)
    (packages / "kernels" / "layer" / "__init__.py").touch()
    (packages / "kernels" / "layer" / "mode.py").write_text("Mode = object\n")
    about = packages / f"kernels-{KERNELS_MIN_VERSION}.dist-info"
    about.mkdir()
    (about / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: kernels\nVersion: {KERNELS_MIN_VERSION}\n"
    )
    names = [name for name in KINDS if name != "dinov2"] + ["dinov2"]
    folders = [
        (family, str(copied(family, checkpoints(kind), tmp_path)))
        for family, kind in (KINDS[name] for name in names)
    ]
    tests = str(Path(support.__path__[0]).parent)
    paths = os.pathsep.join([str(packages), tests, os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        [sys.executable, "-c", ASK, str(packages), json.dumps(folders)],
        capture_output=True, text=True, env={**os.environ, "PYTHONPATH": paths},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    *said, ours, theirs = done.stdout.splitlines()
    assert {line.split(maxsplit=1)[1] for line in said} == {"refused"}, said
    assert {line.split()[0] for line in said} == {family for family, _ in KINDS.values()}
    assert ours == "calls False"
    assert theirs == "calls of the library itself ['get_kernel']", "the fake is what it asks"
