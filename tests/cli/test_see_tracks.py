"""splatseg see with a tracker: masks -> tracks -> segments, with tiny networks."""

import json

import pytest
import torch

from splatseg.io.evidence import TrackedEvidence, open_evidence
from splatseg.io.scene import load_scene_layer
from support.checkpoints import saved

TRAIN = ("train_0", "train_1", "train_3")


def refused(result: tuple[int, str, str]) -> str:
    """The one sentence of a refusal."""
    status, out, err = result
    assert (status, out) == (2, ""), err
    return err


@pytest.mark.parametrize(
    ("model", "kind"), [("sam2-video", "sam2_video"), ("sam3-video", "sam3_tracker_video")]
)
def test_from_masks_to_segments(small, splatseg, tmp_path, model, kind) -> None:
    pytest.importorskip("transformers")
    weights = saved(kind, tmp_path)
    made = splatseg("see", small.scene, "--model", "classical", "--evidence", "masks")
    assert made[0] == 0, made[2]
    words = ("--model", model, "--weights", weights, "--evidence", "tracks", "--device", "cpu")
    words = ("see", small.scene, *words, "--seeds", "masks", "--json")
    status, out, err = splatseg(*words, "--seed-every", 2, "--seeds-remembered", 2)
    assert status == 0, err
    told = json.loads(out)
    assert (told["kind"], told["views"], told["views_kept"]) == ("tracked", 3, 0)
    assert "tracks, from seeds of 2 views (train_0, train_3)" in err
    found = open_evidence(small.scene / "evidence" / "tracks")
    assert isinstance(found, TrackedEvidence)
    assert found.order == TRAIN
    masks = open_evidence(small.scene / "evidence" / "masks").masks("train_0")
    assert len(found.tracks) > 1
    first = found.label_map("train_0").ids
    painted = torch.full_like(first, -1)
    for i in sorted(range(len(masks)), key=lambda i: masks.masks[i].area, reverse=True):
        painted[masks.dense(i)] = i + 1
    assert torch.equal(first, painted), "smaller masks on larger ones"
    assert len({tuple(map(tuple, found.label_map(n).ids.tolist())) for n in TRAIN}) == 3
    status, out, err = splatseg(*words, "--seed-every", 2, "--seeds-remembered", 2)
    assert json.loads(out)["views_kept"] == 3, err
    assert "seeds_remembered" in refused(splatseg(*words, "--seed-every", 2))
    status, out, err = splatseg(
        "segment", small.scene, "--method", "vote", "--evidence", "tracks", "--layer", "objects"
    )
    assert status == 0, err
    layer = load_scene_layer(small.scene, "objects")
    ids = set(torch.unique(layer.ids).tolist()) - {-1}
    assert ids <= {track.id for track in found.tracks}
    assert ids


def test_what_only_trackers_are_told(small, splatseg) -> None:
    words = ("see", small.scene, "--evidence", "x")
    for flags in (("--seeds", "masks"), ("--seed-every", 3), ("--view-order", "path")):
        assert str(flags[0]) in refused(splatseg(*words, "--model", "classical", *flags))
    status, out, err = splatseg("see", "--model", "sam2-video", "--help")
    assert status == 0, err
    for flag in ("--seeds", "--seed-every", "--seed-iou", "--seed-level", "--seed-area",
                 "--view-order", "--seeds-remembered"):  # fmt: skip
        assert flag in out
    assert "facebook/sam2.1-hiera-small (184 MB, Apache-2.0)" in out


def test_seeds_that_are_not_there(small, splatseg, tmp_path) -> None:
    pytest.importorskip("transformers")
    weights = saved("sam2_video", tmp_path)
    words = ("see", small.scene, "--model", "sam2-video", "--weights", weights, "--evidence", "x")
    assert "expected seeds, the name of evidence" in refused(splatseg(*words))
    err = refused(splatseg(*words, "--seed-every", 3))
    assert "expected seeds, the name of evidence" in err
    assert "evidence: expected one of those at hand" in refused(splatseg(*words, "--seeds", "no"))
    assert not (small.scene / "evidence" / "x").exists()
