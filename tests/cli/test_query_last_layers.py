"""Features from before the last layers of LSeg: recorded, lifted to voxels, and led to words."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
import torch.nn.functional as F

from splatseg.core import StoredTable, VoxelFeatures
from splatseg.errors import InputError
from splatseg.io.evidence import open_evidence
from splatseg.io.scene import load_scene, load_scene_layer
from splatseg.lift.vocabulary import vocabulary_of
from splatseg.methods.voxels.words import VoxelWords
from splatseg.models import LoadOptions, find_model
from splatseg.models.lseg import LSegOptions
from splatseg.tasks import QueryOptions, QuerySession
from support.checkpoints import saved
from support.checkpoints_lseg import DECODER, EMBEDDING, LSegFiles

pytest.importorskip("transformers")

WORDS = ("chair", "a", "b c")


@pytest.fixture(scope="module")
def weights(tmp_path_factory) -> Path:
    """A tiny LSeg that reads the words of the context, letter by letter."""
    folder = tmp_path_factory.mktemp("lseg") / "lseg"
    LSegFiles(context=48).save_pretrained(folder)
    return folder


@pytest.fixture(autouse=True)
def offline(monkeypatch) -> None:
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)


@pytest.fixture
def voxels(small, weights, splatseg) -> VoxelFeatures:
    """The layer `voxels` of the decoder's maps, made by the commands."""
    status, out, err = splatseg(
        "see", small.scene, "--model", "lseg", "--weights", weights, "--what", "features",
        "--evidence", "decoded", "--size", "64",
    )  # fmt: skip
    assert status == 0, err
    assert out.startswith("features of 3 views by lseg, ")
    few = ("--voxels", "40")  # of pictures of some hundred pixels
    for method, more in (("voxels", few), ("features", ())):
        words = ("segment", small.scene, "--method", method, "--evidence", "decoded")
        status, _, err = splatseg(*words, "--layer", method, *more)
        assert status == 0, err
    layer = load_scene_layer(small.scene, "voxels")
    assert isinstance(layer, VoxelFeatures)
    assert layer.table.channels == DECODER
    return layer


def network(weights: Path):
    return find_model(
        "lseg", LSegOptions(), loading=LoadOptions(weights=str(weights), size=64, device="cpu")
    )


def by_hand(model, decoded: torch.Tensor) -> torch.Tensor:
    """Section 3.5.1: the last convolution of each voxel, and a unit vector of it."""
    weight, bias = (one.detach() for one in model._network.head.parameters())
    return F.normalize(decoded @ weight[:, :, 0, 0].T + bias, dim=1)


def test_voxels_answer_after_the_last_layers(small, weights, voxels, splatseg) -> None:
    words = ("query", small.scene, *WORDS, "--from-layer", "voxels", "--model", f"lseg={weights}")
    status, out, err = splatseg(*words, "--json")
    assert status == 0, err
    answered = json.loads(out)
    model = network(weights)
    table = StoredTable(codes=by_hand(model, voxels.table.decode()).half())
    assert table.channels == EMBEDDING
    vocabulary = vocabulary_of(open_evidence(small.scene / "evidence" / "decoded"), model)
    wanted = VoxelWords(replace(voxels, table=table), vocabulary).ask(WORDS)
    for column, word in enumerate(WORDS):
        assert answered["surest"][word] == pytest.approx(
            float(wanted.probabilities[:, column].max()), abs=2e-3
        )
    options = QueryOptions(from_layer="voxels")
    found = QuerySession(load_scene(small.scene), options=options, encoder=model).ask(WORDS)
    torch.testing.assert_close(found.vectors.cosines, wanted.cosines, rtol=0, atol=2e-3)
    # Different words, different cosines: it is no constant that agrees.
    assert float(found.vectors.cosines.std(dim=1).mean()) > 1e-3


def test_features_of_gaussians_answer_so_as_well(small, weights, voxels) -> None:
    model = network(weights)
    options = QueryOptions(from_layer="features")
    session = QuerySession(load_scene(small.scene), options=options, encoder=model)
    decoded = load_scene_layer(small.scene, "features").values.float()
    known = decoded.abs().amax(dim=1) > 0
    rows = session.index.rows
    assert bool((rows[known] >= 0).all())
    torch.testing.assert_close(
        session.index.values[rows[known]], by_hand(model, decoded[known]), rtol=0, atol=1e-5
    )


def test_without_the_model_that_made_them(small, weights, voxels, splatseg, tmp_path) -> None:
    words = ("query", small.scene, "chair", "--from-layer", "voxels")
    status, _, err = splatseg(*words)
    assert status == 2
    assert "features 'decoded' of lseg lie before its last layers" in err
    assert "(--model lseg=WEIGHTS), got none." in err
    status, _, err = splatseg(*words, "--model", f"clip={saved('clip', tmp_path / 'clip')}")
    assert status == 2
    assert "leads from them to words, got clip." in err
    torch.manual_seed(7)
    status, _, err = splatseg(*words, "--model", f"lseg={saved('lseg', tmp_path / 'other')}")
    assert status == 2
    assert "which made them, got" in err


def test_a_model_whose_last_layers_come_at_once(small, voxels) -> None:
    """Features of another kind of network lie in no space of words."""

    class Plain:
        name, note, settings = "lseg", "", {"weights": "?"}

        def text_features(self, image): ...

        def encode_text(self, words): ...

    options = QueryOptions(from_layer="voxels")
    with pytest.raises(InputError, match="^model: .*which lseg cannot apply later"):
        QuerySession(load_scene(small.scene), options=options, encoder=Plain())
