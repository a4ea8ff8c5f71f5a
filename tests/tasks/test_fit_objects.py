"""``splatseg fit --evidence``: a scene whose Gaussians were fitted to objects, and bad evidence."""

from pathlib import Path

import pytest
import torch

from splatseg.cli import main
from splatseg.core import Capture
from splatseg.errors import InputError
from splatseg.fit import FitOptions
from splatseg.io.captures import read_capture
from splatseg.io.scene import load_scene
from splatseg.tasks.fit_objects import object_labels


@pytest.fixture
def capture(generated_room: Path) -> Capture:
    return read_capture(generated_room)


def test_a_fit_from_evidence_is_another_one_and_the_scene_says_so(
    generated_room: Path, tmp_path: Path
) -> None:
    words = ["fit", str(generated_room), "--steps", "30", "--max-gaussians", "1500"]
    assert main([*words, "-o", str(tmp_path / "plain")]) == 0
    assert main([*words, "-o", str(tmp_path / "objects"), "--evidence", "instance"]) == 0
    plain, objects = (load_scene(tmp_path / name) for name in ("plain", "objects"))
    assert "evidence" not in plain.provenance
    assert objects.provenance["evidence"] == "instance"
    one, other = plain.gaussians, objects.gaussians
    assert len(one) != len(other) or not torch.equal(one.means, other.means)


@pytest.mark.parametrize("kind", ["masks_sam", "labels_panoptic", "labels_tracked"])
def test_segments_of_all_kinds_take_the_ids_of_one_layer(
    fitted_room: Path, capture: Capture, kind: str
) -> None:
    """On a fit that is done: most pixels have an id, and the same one in most views."""
    gaussians = load_scene(fitted_room).gaussians
    options = FitOptions()
    labels = object_labels(capture, kind, scene=fitted_room, options=options, backend="cpu")
    labels.decide(gaussians, room=0)
    assert float((labels.labels >= 0).float().mean()) > 0.5
    assert len(labels.labels.unique()) > 2


def test_label_maps_have_no_more_pixels_than_the_photographs_of_the_fit(
    capture: Capture, tmp_path: Path
) -> None:
    for longest in (160, 1600):
        labels = object_labels(
            capture, "instance", scene=tmp_path, options=FitOptions(longest=longest), backend="cpu"
        )
        assert labels._evidence.label_map("train_0000").ids.shape[1] == min(longest, 320)


def test_other_evidence_is_refused(capture: Capture, tmp_path: Path) -> None:
    for name, words in (
        ("features_dino", "expected label maps or segments of objects .* got features"),
        ("nothing", "nothing"),
    ):
        with pytest.raises(InputError, match=words):
            object_labels(capture, name, scene=tmp_path, options=FitOptions(), backend="cpu")
