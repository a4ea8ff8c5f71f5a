"""Weights: a folder, the hub's cache, or fetched when asked; otherwise one sentence."""

import hashlib
import json
import shutil
from pathlib import Path

import pytest

from splatseg.errors import BackendError, FileFormatError, InputError, MissingFileError, RangeError
from splatseg.models import LoadOptions, find_family, find_model
from splatseg.models._weights import digest_of, weight_files
from support.hub import in_place_of_the_real, local_hub


def load(**options) -> object:
    return find_model("dinov2", loading=LoadOptions(device="cpu", **options))


def test_a_folder(checkpoints, tmp_path) -> None:
    model = load(weights=str(checkpoints("dinov2")))
    assert model.note == "weights dinov2"
    copy = shutil.copytree(checkpoints("dinov2"), tmp_path / "elsewhere")
    assert load(weights=str(copy)).settings == model.settings, "by content, not by place"


@pytest.mark.parametrize(
    ("weights", "words"),
    [
        ("no-such-folder", "there is no such folder of weights, and it is no id"),
        ("../x/y", "there is no such folder of weights"),
        ("facebook/dinov2-base", r"not on this machine \(346 MB, licence Apache-2.0\); --download"),
        ("some/body", r"not on this machine \(its size and licence are said before it is fetched"),
        (None, "facebook/dinov2-small is not on this machine"),
    ],
)
def test_weights_that_are_not_there(weights, words, monkeypatch, tmp_path) -> None:
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path))
    with pytest.raises(MissingFileError, match=words) as caught:
        load(weights=weights)
    assert "\n" not in str(caught.value)


def test_no_network_is_one_sentence(monkeypatch, tmp_path) -> None:
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path))
    with pytest.raises(MissingFileError, match=r"cannot be fetched \(\w+\); is there a network\?"):
        load(weights="facebook/dinov2-small", download=True)


def test_gated_weights_say_so() -> None:
    (known,) = find_family("dinov3").checkpoints
    with pytest.raises(MissingFileError, match="access must be asked for"):
        find_model("dinov3", loading=LoadOptions(weights=known.id))


def test_folders_that_hold_no_weights(checkpoints, tmp_path) -> None:
    with pytest.raises(MissingFileError, match=r"config.json and model.safetensors"):
        load(weights=str(tmp_path))
    file = tmp_path / "model.safetensors"
    file.touch()
    with pytest.raises(InputError, match="expected a folder with config.json"):
        load(weights=str(file))
    folder = Path(shutil.copytree(checkpoints("dinov2"), tmp_path / "broken"))
    weights = folder / "model.safetensors"
    whole = weights.read_bytes()
    weights.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(FileFormatError, match=f"{folder}: expected weights of Dinov2Model"):
        load(weights=str(folder))
    weights.write_bytes(whole)
    config = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps(config | {"num_hidden_layers": 5}))
    with pytest.raises(FileFormatError, match=r"none or others for \d+ of its tensors \(.*layer.4"):
        load(weights=str(folder))
    (folder / "config.json").write_text("{")
    with pytest.raises(FileFormatError, match=r"config.json"):
        load(weights=str(folder))


def test_the_digest_is_of_contents_and_names(checkpoints, tmp_path) -> None:
    folder = Path(shutil.copytree(checkpoints("dinov2"), tmp_path / "a"))
    digest = digest_of(folder)
    (folder / "README.md").write_text("no part of it")
    (folder / "pytorch_model.bin").write_text("not looked at beside safetensors")
    assert digest_of(folder) == digest
    assert [path.name for path in weight_files(folder)] == ["config.json", "model.safetensors"]
    blob = tmp_path / hashlib.sha256((folder / "model.safetensors").read_bytes()).hexdigest()
    (folder / "model.safetensors").rename(blob)
    (folder / "model.safetensors").symlink_to(blob)
    assert digest_of(folder) == digest, "the hub's cache names contents by their digest"
    (folder / "config.json").write_text("{}")
    assert digest_of(folder) != digest


def test_devices_that_are_not_there(checkpoints) -> None:
    for device in ("tpu", "meta", ""):
        with pytest.raises(InputError, match="expected cpu, cuda or cuda:N"):
            find_model("dinov2", loading=LoadOptions(device=device))
    with pytest.raises(BackendError, match="GPUs that PyTorch sees, got cuda:77"):
        find_model("dinov2", loading=LoadOptions(device="cuda:77"))
    for name in ("batch", "size"):
        with pytest.raises(RangeError, match=f"{name}: expected at least 1, got 0"):
            LoadOptions(**{name: 0})


def test_fetching_says_what_and_how_much_and_only_when_asked(checkpoints, tmp_path) -> None:
    folder = Path(shutil.copytree(checkpoints("dinov2"), tmp_path / "repository"))
    (folder / "pytorch_model.bin").write_bytes(bytes(1000))
    (folder / "README.md").write_text("a card")

    def run(id: str, download: str) -> str:
        said: list[str] = []
        options = LoadOptions(weights=id, download=download == "yes", device="cpu")
        try:
            said.append(find_model("dinov2", loading=options, report=said.append).note)
        except MissingFileError as error:
            return str(error)
        return "\n".join(said)

    hubs = local_hub({"tiny/dinov2": folder}, gated=("tiny/gated",))
    with hubs as hub, in_place_of_the_real(hub, tmp_path / "home"):
        assert "is not on this machine" in run("tiny/dinov2", "no")
        assert not hub.asked, "nothing is asked without leave"
        said = run("tiny/dinov2", "yes")
        size = sum((folder / name).stat().st_size for name in ("config.json", "model.safetensors"))
        assert f"fetching {size / 1e6:.0f} MB from the Hugging Face hub, licence apache-2.0" in said
        assert said.endswith("\nweights tiny/dinov2")
        assert not any("pytorch_model" in path or "README" in path for path in hub.asked)
        hub.asked.clear()
        assert run("tiny/dinov2", "no") == "weights tiny/dinov2", "it is in the cache now"
        assert not hub.asked
        config = next((tmp_path / "home").rglob("config.json"))
        parts = {"weight_map": {"a": "model.safetensors", "b": "model-2.safetensors"}}
        (config.parent / "model.safetensors.index.json").write_text(json.dumps(parts))
        assert "is not on this machine" in run("tiny/dinov2", "no"), "it was stopped half-way"
        assert "the Hugging Face hub has no tiny/none" in run("tiny/none", "yes")
        assert "accepted its licence" in run("tiny/gated", "yes")
