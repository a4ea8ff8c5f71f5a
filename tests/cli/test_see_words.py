"""Models that understand words: from the photographs to evidence, and from that to a layer."""

import json

import pytest

from splatseg.core import InstanceTree, Labels
from splatseg.io.evidence import load_text_embeddings, open_evidence
from splatseg.io.scene import load_scene, load_scene_layer
from splatseg.models import LoadOptions, find_family
from splatseg.tasks import SeeOptions, see
from splatseg.tasks.segment import SegmentOptions, segment
from support.checkpoints import saved

TRAIN = ("train_0", "train_1", "train_3")
WORDS = ("chair", "red mug", "table")
LOOSE = {"box_threshold": 0.0, "text_threshold": 0.0}

pytest.importorskip("transformers")


@pytest.fixture(scope="module")
def checkpoints(tmp_path_factory):
    folder = tmp_path_factory.mktemp("checkpoints")
    return lambda kind: str(saved(kind, folder))


@pytest.fixture(autouse=True)
def offline(monkeypatch) -> None:
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)


CASES = [
    ("clip", "clip", {}, "text", "features"),
    ("siglip2", "siglip", {}, "text", "features"),
    ("siglip2", "siglip2", {}, "text", "features"),
    ("clipseg", "clipseg", {}, "labels", "uplift"),
    ("langsam", "grounding_dino", LOOSE, "panoptic", "associate"),
    ("langsam", "mm_grounding_dino", LOOSE, "masks", "associate"),
    ("sam3-text", "sam3", {"threshold": 0.0}, "panoptic", "associate"),
    ("sam3-text", "sam3_video", {"threshold": 0.0}, "masks", "associate"),
]


@pytest.mark.parametrize(("family", "kind", "more", "what", "method"), CASES)
def test_from_photographs_to_a_layer(small, checkpoints, family, kind, more, what, method) -> None:
    if family == "langsam":
        more = {**more, "sam_model": "sam2", "sam_weights": checkpoints("sam2")}
    found = find_family(family)
    assert found is not None
    assert what in found.gives
    see(
        load_scene(small.scene),
        family,
        "words",
        options=SeeOptions(what=(what,)),
        model_options=found.options(words=WORDS, **more),
        loading=LoadOptions(weights=checkpoints(kind), device="cpu"),
    )
    evidence = open_evidence(small.scene / "evidence" / "words")
    assert evidence.kind == ("features" if what == "text" else what)
    assert evidence.view_names == TRAIN
    if what in ("labels", "panoptic"):
        assert [row.name for row in evidence.classes.rows] == list(WORDS)
    if what == "text":
        width = load_text_embeddings(evidence.folder).vectors.shape[1]
        assert evidence.features("train_0").channels == width
    scene = load_scene(small.scene)
    made = segment(scene, method, options=SegmentOptions(evidence="words"))
    if what != "text":
        assert isinstance(made.layer, Labels | InstanceTree)


def test_the_commands_of_words(small, checkpoints, splatseg) -> None:
    words = ("see", small.scene, "--model", "clip", "--weights", checkpoints("clip"))
    words += ("--evidence", "clip", "--words", "chair", "red mug")
    status, out, err = splatseg(*words)
    assert status == 0, err
    assert out.startswith("features of 3 views by clip, ")
    folder = small.scene / "evidence" / "clip"
    assert load_text_embeddings(folder).labels[:3] == ("chair", "red mug", "object")
    metadata = json.loads((folder / "evidence.json").read_text())["metadata"]
    assert "words" not in metadata["settings"], "other words may be asked for"
    assert metadata["settings"]["patches"] == "value"
    status, out, err = splatseg(
        "segment", small.scene, "--method", "features", "--evidence", "clip"
    )
    assert status == 0, err
    assert load_scene_layer(small.scene, "clip").values.shape[1] == 24


def test_the_command_of_two_networks(small, checkpoints, splatseg) -> None:
    status, out, err = splatseg(
        "see", small.scene, "--model", "langsam", "--weights", checkpoints("grounding_dino"),
        "--sam-model", "sam-hq", "--sam-weights", checkpoints("sam_hq"), "--evidence", "found",
        "--words", "chair", "table", "--box-threshold", "0", "--text-threshold", "0",
        "--what", "panoptic,masks",
    )  # fmt: skip
    assert status == 0, err
    assert out.startswith("panoptic of 3 views by langsam, ")
    assert open_evidence(small.scene / "evidence" / "found.masks").kind == "masks"
    status, _, err = splatseg(
        "segment", small.scene, "--method", "associate", "--evidence", "found"
    )
    assert status == 0, err


@pytest.mark.parametrize(
    ("model", "kind", "more"),
    [
        ("clipseg", "clipseg", ("--threshold", "0.1", "--words", "chair", "table")),
        ("siglip2", "siglip2", ("--words", "chair", "--template", "a {}")),
        ("sam3-text", "sam3", ("--threshold", "0.1", "--mask-threshold", "0.4", "--words", "a")),
    ],
)
def test_the_command_of_one_network(small, checkpoints, splatseg, model, kind, more) -> None:
    status, out, err = splatseg(
        "see", small.scene, "--model", model, "--weights", checkpoints(kind), "--evidence", "e",
        *more,
    )  # fmt: skip
    assert status == 0, err
    assert f" of 3 views by {model}, " in out


def test_words_that_are_needed_and_a_model_of_boxes(small, checkpoints, splatseg) -> None:
    for model, kind in (("clipseg", "clipseg"), ("sam3-text", "sam3")):
        status, _, err = splatseg(
            "see", small.scene, "--model", model, "--weights", checkpoints(kind), "--evidence", "e"
        )
        assert status == 2
        assert f"{model} looks for what words name, so expected at least one word (--words" in err
        assert not (small.scene / "evidence" / "e").exists()
    status, _, err = splatseg(
        "see", small.scene, "--model", "grounding-dino", "--evidence", "e", "--weights",
        checkpoints("grounding_dino"),
    )  # fmt: skip
    assert status == 2
    assert "model 'grounding-dino': expected one that gives evidence of views." in err
