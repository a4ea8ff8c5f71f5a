"""The published checkpoint: read without running it, tensor by tensor, or refused."""

import os
import shutil
import sys
import types
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from splatseg.errors import FileFormatError, MissingFileError
from splatseg.models._lseg_network import Sizes
from splatseg.models.lseg import network_of, published_name, published_tensors, read_checkpoint
from support.checkpoints_lseg import CHANNELS, DECODER, extras, published, shapes

FULL = shapes(
    width=1024, blocks=24, grid=24, channels=(256, 512, 1024, 1024), decoder=256, embedding=512,
    text=512, text_blocks=12, context=77, vocabulary=49408,
)  # fmt: skip


def test_the_published_network_has_the_published_tensors() -> None:
    """Names and shapes of ViT-L/16 at 384, DPT's parts and CLIP ViT-B/32, written by hand."""
    found = published_tensors(Sizes())
    assert set(found) == set(FULL)
    assert found == FULL
    assert len(found) == 547
    hand = {
        "pretrained.model.pos_embed": (1, 577, 1024),
        "pretrained.model.blocks.23.attn.qkv.weight": (3072, 1024),
        "pretrained.model.blocks.0.mlp.fc1.bias": (4096,),
        "pretrained.act_postprocess1.0.project.0.weight": (1024, 2048),
        "pretrained.act_postprocess1.3.weight": (256, 1024, 1, 1),
        "pretrained.act_postprocess1.4.weight": (256, 256, 4, 4),
        "pretrained.act_postprocess2.4.weight": (512, 512, 2, 2),
        "pretrained.act_postprocess3.3.weight": (1024, 1024, 1, 1),
        "pretrained.act_postprocess4.4.weight": (1024, 1024, 3, 3),
        "scratch.layer2_rn.weight": (256, 512, 3, 3),
        "scratch.refinenet1.resConfUnit1.bn2.running_var": (256,),
        "scratch.refinenet4.out_conv.bias": (256,),
        "scratch.head1.weight": (512, 256, 1, 1),
        "clip_pretrained.positional_embedding": (77, 512),
        "clip_pretrained.transformer.resblocks.11.attn.in_proj_weight": (1536, 512),
        "clip_pretrained.text_projection": (512, 512),
    }
    assert hand.items() <= found.items()
    absent = ("pretrained.act_postprocess3.4.weight", "scratch.refinenet2.resConfUnit1.conv1.bias")
    assert not set(absent) & set(found)


def test_a_file_in_the_published_layout_is_read_back_tensor_by_tensor(weights: Path) -> None:
    path = weights / "demo_e200.ckpt"
    network, unknown = network_of(read_checkpoint(path), path)
    assert unknown == [], "what is published and not needed is no news"
    raw = torch.load(path, weights_only=True)["state_dict"]
    state = network.state_dict()
    compared = 0
    for name, tensor in state.items():
        if not name.endswith("num_batches_tracked"):
            assert torch.equal(tensor, raw[f"net.{published_name(name)}"].float()), name
            compared += 1
    assert compared == len(shapes())
    assert not network.training
    assert not any(one.requires_grad for one in network.parameters())


def test_safetensors_and_plain_tensors_give_the_same_network(weights: Path, tmp_path) -> None:
    path = weights / "demo_e200.ckpt"
    tensors = read_checkpoint(path)
    save_file(dict(tensors), tmp_path / "lseg.safetensors")
    bare = {name.removeprefix("net."): value for name, value in tensors.items()}
    torch.save(bare, tmp_path / "lseg.pt")
    first = network_of(tensors, path)[0].state_dict()
    for other in ("lseg.safetensors", "lseg.pt"):
        found = network_of(read_checkpoint(tmp_path / other), path)[0].state_dict()
        assert all(torch.equal(first[name], found[name]) for name in first), other


def test_what_is_unknown_is_listed_and_what_is_missing_refused(weights: Path) -> None:
    state = published() | extras()
    _, unknown = network_of(state | {"net2.w": torch.ones(1), "a.b": torch.ones(2)}, weights)
    assert unknown == ["a.b", "net2.w"]
    for gone in ("scratch.head1.weight", "scratch.refinenet2.resConfUnit1.bn1.running_mean",
                 "pretrained.model.blocks.2.mlp.fc1.weight"):  # fmt: skip
        fewer = {name: value for name, value in state.items() if name != gone}
        with pytest.raises(FileFormatError, match=rf"got none for 1 of its \d+ tensors \({gone}\)"):
            network_of(fewer, weights)
    with pytest.raises(FileFormatError, match=r"got none for 9 .*\(clip.*, \.\.\.\)\."):
        network_of({"some.weight": torch.ones(3)}, weights)


@pytest.mark.parametrize(
    ("name", "shape", "words"),
    [
        ("scratch.layer3_rn.weight", (DECODER, 8, 3, 3),
         r"expected scratch.layer3_rn.weight of shape \(32, 32, 3, 3\), as the other tensors ask"),
        ("scratch.head1.weight", (24, DECODER), r"expected scratch.head1.weight of 4 axes"),
        ("pretrained.model.patch_embed.proj.weight", (128, 3, 32, 32), "patches of 16x16 pixels"),
        ("pretrained.model.pos_embed", (1, 11, 128), r"pos_embed of shape \(1, 10, 128\)"),
        ("pretrained.act_postprocess1.3.weight", (CHANNELS[0], 0, 1, 1), "of 4 axes, got shape"),
    ],
)  # fmt: skip
def test_shapes_that_do_not_go_together(weights: Path, name: str, shape, words: str) -> None:
    with pytest.raises(FileFormatError, match=words):
        network_of(published() | {name: torch.zeros(shape)}, weights)


def test_a_number_of_blocks_that_has_no_quarters(weights: Path) -> None:
    state = {k: v for k, v in published().items() if "model.blocks.3." not in k}
    with pytest.raises(FileFormatError, match="blocks of the image side that 4 divides, got 3"):
        network_of(state, weights)


@pytest.fixture
def lightning(monkeypatch):
    """A module as a training program has it, which is gone when its files are read."""
    module = types.ModuleType("lightning_like")
    ran: list[str] = []

    class Callback:
        def __init__(self) -> None:
            self.best = 3

        def __setstate__(self, state: object) -> None:
            ran.append("setstate")

    class Options(dict):
        pass

    class Runs:
        def __reduce__(self):
            return run, ("ran",)

    def run(word: str) -> object:
        ran.append(word)
        return None

    for one in (Callback, Options, Runs, run):
        one.__module__, one.__qualname__ = module.__name__, one.__name__
        setattr(module, one.__name__, one)
    monkeypatch.setitem(sys.modules, module.__name__, module)
    return module, ran


def test_classes_of_the_training_program_are_neither_needed_nor_run(
    weights: Path, tmp_path, lightning, monkeypatch
) -> None:
    module, ran = lightning
    content = torch.load(weights / "demo_e200.ckpt", weights_only=True)
    content |= {
        "callbacks": {module.Callback: {"best": module.Callback()}, "names": {module.Options}},
        "hyper_parameters": module.Options(a=1, b=[module.Callback()]),
        "ran": module.Runs(),
    }
    torch.save(content, tmp_path / "full.ckpt")
    for present in (True, False):
        if not present:
            monkeypatch.delitem(sys.modules, module.__name__)
        found = read_checkpoint(tmp_path / "full.ckpt")
        assert not ran
        assert set(found) == set(read_checkpoint(weights / "demo_e200.ckpt"))


class Commands:
    """What runs a command where it is read without restriction."""

    def __reduce__(self):
        return os.system, ("exit 1",)


class Listed(list):
    """What a restricted reader does not fill."""


def test_files_of_other_kinds(weights: Path, tmp_path) -> None:
    whole = (weights / "demo_e200.ckpt").read_bytes()
    cut = tmp_path / "cut.ckpt"
    cut.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(FileFormatError, match=r"cut.ckpt: expected a checkpoint of PyTorch 1\.6"):
        read_checkpoint(cut)
    torch.save([1, 2], tmp_path / "list.ckpt")
    with pytest.raises(FileFormatError, match=r"expected tensors by name or .*, got list"):
        read_checkpoint(tmp_path / "list.ckpt")
    torch.save({"state_dict": {"a": 1}}, tmp_path / "none.ckpt")
    with pytest.raises(FileFormatError, match="expected tensors by name, got none"):
        read_checkpoint(tmp_path / "none.ckpt")
    torch.save({"a": torch.ones(2)}, tmp_path / "old.ckpt", _use_new_zipfile_serialization=False)
    with pytest.raises(FileFormatError, match="got another kind of file"):
        read_checkpoint(tmp_path / "old.ckpt")
    with pytest.raises(MissingFileError):
        read_checkpoint(tmp_path / "gone.ckpt")
    torch.save({"a": Listed([1])}, tmp_path / "listed.ckpt")
    with pytest.raises(FileFormatError, match="got one that only the program it is of can read"):
        read_checkpoint(tmp_path / "listed.ckpt")
    torch.save({"a": Commands()}, tmp_path / "commands.ckpt")
    with pytest.raises(FileFormatError, match="got one that only the program it is of can read"):
        read_checkpoint(tmp_path / "commands.ckpt")
    shutil.copy(cut, tmp_path / "cut.safetensors")
    with pytest.raises(FileFormatError, match="safetensors"):
        read_checkpoint(tmp_path / "cut.safetensors")
