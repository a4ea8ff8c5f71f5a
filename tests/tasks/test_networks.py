"""Networks of classes, segments and depth from tiny checkpoints to layers and to a fit."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from splatseg.core import DepthMap
from splatseg.errors import InputError
from splatseg.fit import FitOptions
from splatseg.io.captures import read_capture
from splatseg.io.evidence import open_evidence, save_depth_map
from splatseg.io.scene import load_scene
from splatseg.models import LoadOptions
from splatseg.models.networks.segmenters import SegmenterOptions, SemanticOptions
from splatseg.tasks import MakeSceneOptions, SeeOptions, SegmentOptions, fit_capture, see, segment
from splatseg.tasks.photographs import with_depth_evidence
from splatseg.tasks.work import SILENT
from support.checkpoints import saved
from support.checkpoints_labels import save_tokenizer
from support.observers import Stopping

pytest.importorskip("transformers")

LABELS = [("maskformer", "maskformer"), ("mask2former", "mask2former"), ("oneformer", "oneformer"),
          ("eomt", "eomt"), ("eomt", "eomt_dinov3"), ("segformer", "segformer"),
          ("dpt-semantic", "dpt_semantic")]  # fmt: skip
PANOPTIC = LABELS[:5]
DEPTH = [("dpt", "dpt"), ("depth-anything", "depth_anything"),
         ("depth-anything", "depth_anything_metric")]  # fmt: skip
MANY = {"min_score": 0.2, "min_visible": 0.05, "mask_threshold": 0.3}
FEW = FitOptions(minutes=None, steps=3, max_gaussians=300)
SOLID = replace(FEW, rates="published", depth_weight=5.0)


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    folder = tmp_path_factory.mktemp("weights")

    def of(kind: str) -> LoadOptions:
        path = saved(kind, folder)
        if kind == "oneformer":
            save_tokenizer(path)
        return LoadOptions(weights=str(path), size=64, device="cpu")

    return of


@pytest.mark.parametrize(("family", "kind"), LABELS)
def test_labels_become_a_layer(made, weights, family, kind) -> None:
    scene = load_scene(made)
    chosen = SegmenterOptions(**MANY) if (family, kind) in PANOPTIC else SemanticOptions()
    seen = see(
        scene, family, "classes", options=SeeOptions(what=("labels",)), loading=weights(kind),
        model_options=chosen, backend="cpu",
    )  # fmt: skip
    assert (seen.kind, seen.views) == ("labels", 5)
    evidence = open_evidence(seen.folder)
    assert evidence.classes.name_of(2) == "floor"
    assert evidence.label_map(evidence.view_names[0]).confidence is not None
    asked = SegmentOptions(evidence="classes", layer="seen")
    layer = segment(scene, "vote", options=asked, backend="cpu").layer
    present = set(torch.as_tensor(layer.present).tolist())
    assert present
    assert present <= set(range(1, 7))


@pytest.mark.parametrize(("family", "kind"), PANOPTIC)
def test_segments_become_a_layer(made, weights, family, kind) -> None:
    scene = load_scene(made)
    seen = see(
        scene, family, "things", loading=weights(kind), model_options=SegmenterOptions(**MANY),
        backend="cpu",
    )  # fmt: skip
    assert seen.kind == "panoptic", "what such a network has first"
    evidence = open_evidence(seen.folder)
    assert any(evidence.segments(name) for name in evidence.view_names)
    asked = SegmentOptions(evidence="things", layer="seen")
    assert len(segment(scene, "associate", options=asked, backend="cpu").layer) == len(
        scene.gaussians
    )


@pytest.mark.parametrize(("family", "kind"), DEPTH)
def test_depth_is_fitted_and_not_segmented(made, small_room, weights, tmp_path, family, kind):
    scene = load_scene(made)
    seen = see(scene, family, "far", loading=weights(kind), backend="cpu")
    assert seen.kind == "depth"
    evidence = open_evidence(seen.folder)
    found = evidence.depth_map(evidence.view_names[0])
    assert (found.height, found.width) == (48, 64)
    for method, words in (("vote", "labels or tracked"), ("associate", "masks or panoptic or tr")):
        with pytest.raises(InputError, match=f"method {method} takes evidence of {words}.*depth"):
            segment(scene, method, options=SegmentOptions(evidence="far", layer="seen"))
    use = "metric" if kind.endswith("metric") else "relative"
    done = fit_capture(
        small_room, tmp_path / "fitted", fit_options=replace(FEW, depth=use),
        options=MakeSceneOptions(depth_evidence=str(seen.folder)), backend="cpu",
    )  # fmt: skip
    assert done.result.steps == 3
    views = load_scene(done.folder).train_views
    assert all(view.depth.parent == seen.folder.resolve() for view in views)
    assert load_scene(done.folder).provenance["depth_evidence"] == str(seen.folder)


@pytest.fixture
def capture(small_room, tmp_path, monkeypatch) -> Path:
    """The room with evidence of its true depth, in metres, in the depth_true of the capture.

    Fits are opaque from the start, so that depth counts where something is seen.
    """
    monkeypatch.setattr("splatseg.fit._start.START_OPACITY", 0.95)
    folder = shutil.copytree(small_room, tmp_path / "capture")
    (folder / "depth_true").mkdir()
    for view in read_capture(folder).train_views:
        steps = np.array(Image.open(folder / "depth" / f"{view.name}.png"), np.float32)
        given = DepthMap(values=torch.from_numpy(steps * 0.001), kind="metric")
        save_depth_map(given, folder / "depth_true", view.name)
    return folder


def fitted(capture: Path, out: Path, depth: str, evidence: str | None, observer=SILENT):
    done = fit_capture(
        capture, out, fit_options=replace(SOLID, depth=depth),
        options=MakeSceneOptions(depth_evidence=evidence), backend="cpu", observer=observer,
    )  # fmt: skip
    return done.result.gaussians.means


def test_evidence_is_as_the_capture_s_own_maps(capture, tmp_path) -> None:
    """The same depths, once as the capture has them and once as evidence; found by its name."""
    without = fitted(capture, tmp_path / "a", "off", None)
    by_name = fitted(capture, tmp_path / "b", "metric", "depth_true")
    evidence = open_evidence(capture / "depth_true")
    content = json.loads((capture / "transforms.json").read_text())
    for frame in content["frames"]:
        name = Path(frame["file_path"]).stem
        if name in evidence.view_names:
            np.save(capture / f"{name}.npy", evidence.depth_map(name).values.numpy())
            frame |= {"depth_file_path": f"{name}.npy", "depth_unit_scale_factor": 1.0}
    (capture / "transforms.json").write_text(json.dumps(content))
    own = fitted(capture, tmp_path / "c", "metric", None)
    assert torch.equal(by_name, own)
    assert not torch.equal(by_name, without)
    relative = fitted(capture, tmp_path / "d", "relative", "depth_true")
    assert not torch.equal(relative, without)


def test_metres_become_units_of_the_capture(capture, tmp_path) -> None:
    """In a capture of centimetres 100 units are a metre."""
    found = with_depth_evidence(
        replace(read_capture(capture), metres_per_unit=0.01), "depth_true", scene=tmp_path,
        depth="metric", report=print,
    )  # fmt: skip
    assert {view.depth_unit for view in found.train_views} == {100.0}
    assert all(view.depth is None for view in found.test_views)
    relative = with_depth_evidence(
        read_capture(capture), "depth_true", scene=tmp_path, depth="relative", report=print
    )
    assert {view.depth_unit for view in relative.train_views} == {1.0}
    unknown = replace(read_capture(capture), metres_per_unit=None)
    with pytest.raises(InputError, match="a capture that tells how long its unit is"):
        with_depth_evidence(unknown, "depth_true", scene=tmp_path, depth="metric", report=print)


def test_views_without_evidence_have_no_depth(capture, tmp_path) -> None:
    observer = Stopping()
    first = next(iter(open_evidence(capture / "depth_true").view_names))
    (capture / "depth_true" / f"{first}.npz").unlink()
    fitted(capture, tmp_path / "a", "relative", "depth_true", observer)
    assert any("has depth of 4 of the 5 training views" in line for line in observer.heard)


def test_what_is_refused_of_evidence_of_depth(capture, tmp_path) -> None:
    out = tmp_path / "fitted"
    with pytest.raises(InputError, match="depth: expected metric or relative with evidence"):
        fitted(capture, out, "off", "depth_true")
    with pytest.raises(InputError, match="labels_semantic: expected evidence of depth, got labels"):
        fitted(capture, out, "metric", "labels_semantic")
    with pytest.raises(InputError, match=r"expected one of those at hand \(depth_true, labels_"):
        fitted(capture, out, "metric", "nothing")
    other = tmp_path / "other"
    other.mkdir()
    save_depth_map(DepthMap(values=torch.ones(4, 4), kind="relative"), other, "nobody")
    with pytest.raises(InputError, match="evidence of metric depth, got relative depth"):
        fitted(capture, out, "metric", str(other))
    with pytest.raises(InputError, match=r"depth of the 5 training views, got that of .*\(nobody"):
        fitted(capture, out, "relative", str(other))
    assert not out.exists()
