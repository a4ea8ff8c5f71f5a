"""Protocols of streets end to end on a tiny drive in the layouts of KITTI-360 and Waymo."""

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from splatseg.core import Gaussians, Scene
from splatseg.core.sh import SH_C0
from splatseg.errors import InputError, RangeError
from splatseg.evaluate import Confusion, semantic_score
from splatseg.io.scene import load_scene, save_scene
from splatseg.methods import Method, register_method, uplift
from splatseg.methods import _method as registry
from splatseg.tasks.work import scene_field
from splatseg_bench.layouts import read_benchmark
from splatseg_bench.options import BenchOptions
from splatseg_bench.protocols import TABLE_1, find_protocol, merged_name
from splatseg_bench.results import load_result
from splatseg_bench.run import BenchRun, bench
from splatseg_bench.scene import BenchmarkScene
from splatseg_bench.scenes import scans_of
from splatseg_bench.tables import bench_table
from support.benchmark_layouts import read_source, write_layout
from support.benchmark_layouts.evidence import write_evidence

LAYOUTS = ("kitti360", "waymo")
NAME = "labels_semantic"


@dataclass(frozen=True, slots=True, kw_only=True)
class Set:
    """A data set with evidence, and a fit."""

    scene: BenchmarkScene
    folder: Path
    fit: Path


@pytest.fixture(scope="module")
def sets(generated_drive: Path, tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Set]:
    """The drive in a layout, a Gaussian at every second point of the truth; not to be changed."""
    made: dict[str, Set] = {}

    def of(layout: str) -> Set:
        if layout not in made:
            root = tmp_path_factory.mktemp(layout)
            folder = write_layout(layout, generated_drive, root / "set")
            (scene,) = read_benchmark(layout, folder)
            write_evidence(read_source(generated_drive), scene.capture, NAME, root / "evidence")
            fit = root / "fit"
            views = scene.capture.views
            save_scene(
                Scene(
                    gaussians=gaussians_of(scene), views=views, metres_per_unit=1.0,
                    source=scene.capture.path,
                ),
                fit,
            )  # fmt: skip
            made[layout] = Set(scene=scene, folder=folder, fit=fit)
        return made[layout]

    return of


def gaussians_of(scene: BenchmarkScene) -> Gaussians:
    assert scene.points is not None
    means = scene.points.points.float()[::2]
    gaps = torch.cdist(means, means).topk(4, largest=False).values[:, 3:]
    return Gaussians(
        means=means,
        rotations=torch.tensor([[1.0, 0, 0, 0]]).repeat(len(means), 1),
        scales=0.6 * gaps.clamp(0.05, 0.5).repeat(1, 3),
        opacities=torch.full((len(means),), 0.97),
        sh=torch.full((len(means), 1, 3), 0.1 / SH_C0),
    )


@pytest.fixture
def run(sets: Callable[[str], Set], tmp_path: Path) -> Callable[..., BenchRun]:
    """Runs uplift on a copy of the fit, beside it for its photographs; what it found."""

    def go(layout: str, *switches: str, **options: Any) -> BenchRun:
        data = sets(layout)
        fit = copied(data, tmp_path)
        given: dict[str, Any] = {
            "models": (str(data.fit.parent / "evidence" / NAME),),
            "fitted": str(fit),
            "switches": ("points=views,density,region,fair", *switches),
        }
        return bench(layout, data.folder, tmp_path / "out", options=BenchOptions(**given | options))

    return go


def copied(data: Set, tmp_path: Path) -> Path:
    """The fit, which gets evidence and fields of a test."""
    fit = data.fit.parent / tmp_path.name
    if not fit.exists():
        shutil.copytree(data.fit, fit)
    return fit


def only(run: BenchRun, row: str) -> dict[str, float]:
    return dict(next(one for one in run.methods if one.method == row).scores)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_row_a_rule_and_scores_of_another_scorer(layout, run, tmp_path, score) -> None:
    """The table has Table 1's classes; points are as in files, which another scorer reads."""
    done = run(layout)
    assert [one.method for one in done.methods] == [
        f"uplift-{rule}" for rule in ("views", "density", "region", "fair")
    ]
    for one in done.methods:
        (scene,) = one.scenes
        found = tmp_path / "out/predictions" / layout / one.method / f"{scene.scene}.npz"
        with np.load(found) as arrays:
            np.savez(tmp_path / "p.npz", semantic=arrays["semantic"])
            np.savez(tmp_path / "t.npz", semantic=arrays["truth"])
        theirs = score("points", "--pred", tmp_path / "p.npz", "--truth", tmp_path / "t.npz")
        assert one.scores["miou"] == pytest.approx(theirs["mIoU"], abs=1e-6)
        columns = [name for name in one.scores if name in TABLE_1]
        assert np.mean([one.scores[name] for name in columns]) == pytest.approx(theirs["mIoU"])
        assert {"view_miou", "psnr", "ssim", "undefined"} <= set(one.scores)
        kept = load_result(tmp_path / "out/results" / layout / one.method / f"{scene.scene}.json")
        assert kept.made["rule"] == one.method.removeprefix("uplift-")
        assert kept.rows == scene.rows
    views, region = only(done, "uplift-views"), only(done, "uplift-region")
    assert views["miou"] > 0.2, "chance is a few percent"
    assert views["undefined"] == 0
    assert views["miou"] != region["miou"]
    assert views["view_miou"] == region["view_miou"], "rules are of points"


def test_what_was_measured_is_kept_and_published_stands_beside(run) -> None:
    first = run("waymo", "points=density,region")
    assert first.kept == 0
    assert run("waymo", "points=density,region").kept == 2
    columns, rows = bench_table(first, notes=False)
    assert "road" in columns
    assert [row[0] for row in rows[-2:]] == ["DNMP with semantics", "StreetGaussians"]
    assert rows[-2][columns.index("psnr")] == 29.31
    short, _ = bench_table(first, notes=False, classes=False)
    assert not set(TABLE_1) & set(short)


def test_rules_and_choices_count(run) -> None:
    usual = run("kitti360", "points=region,fair")
    wider = run("kitti360", "points=region,fair", "radius=2.5")
    for rule in ("region", "fair"):
        assert only(wider, f"uplift-{rule}") != only(usual, f"uplift-{rule}")
    skipped = run("kitti360", "points=region", "undefined=skipped", "radius=0.02")
    wrong = run("kitti360", "points=region", "radius=0.02")
    assert only(wrong, "uplift-region")["undefined"] > 0
    assert only(skipped, "uplift-region")["miou"] > only(wrong, "uplift-region")["miou"]
    assert only(skipped, "uplift-region")["undefined"] == only(wrong, "uplift-region")["undefined"]
    no_sky = run("kitti360", "points=fair", "sky=no")
    assert only(no_sky, "uplift-fair")["view_miou"] != only(usual, "uplift-fair")["view_miou"]
    assert only(no_sky, "uplift-fair")["miou"] == only(usual, "uplift-fair")["miou"]


@pytest.fixture
def half_hidden(sets, monkeypatch) -> BenchmarkScene:
    """The drive as if photographs showed every second point alone, of uneven confidence."""
    scene = sets("kitti360").scene
    assert scene.points is not None
    count = len(scene.points.labels)
    confidence = torch.linspace(0.1, 1, count)
    told = replace(
        scene.points,
        visible=torch.arange(count) % 2 == 0,
        labels=replace(scene.points.labels, confidence=confidence),
    )
    changed = replace(scene, points=told)
    monkeypatch.setattr("splatseg_bench.scenes.read_benchmark", lambda *_, **__: (changed,))
    return changed


def test_points_that_photographs_show_are_scored_apart(run, half_hidden, tmp_path, score) -> None:
    """All count, as in KITTI-360's own evaluation, unless only visible ones are asked for."""
    usual = run("kitti360", "points=region", "radius=0.05")
    whole = only(usual, "uplift-region")
    (scene,) = usual.methods[0].scenes
    with np.load(tmp_path / f"out/predictions/kitti360/uplift-region/{scene.scene}.npz") as file:
        found, true = file["semantic"], file["truth"]
    shown = half_hidden.points.visible.numpy()
    for name, among in (("visible", shown), ("hidden", ~shown)):
        np.savez(tmp_path / "p.npz", semantic=found[among])
        np.savez(tmp_path / "t.npz", semantic=true[among])
        theirs = score("points", "--pred", tmp_path / "p.npz", "--truth", tmp_path / "t.npz")
        assert whole[f"{name}_miou"] == pytest.approx(theirs["mIoU"], abs=1e-6)
    assert whole["visible_miou"] != whole["hidden_miou"]
    visible = only(run("kitti360", "points=region", "radius=0.05", "visible=yes"), "uplift-region")
    assert visible["miou"] == whole["visible_miou"] != whole["miou"]
    assert visible["hidden_miou"] == whole["hidden_miou"]
    assert visible["undefined"] != whole["undefined"]
    sure = only(run("kitti360", "points=region", "radius=0.05", "confidence=yes"), "uplift-region")
    assert sure["miou"] != whole["miou"]
    weights = half_hidden.points.labels.confidence
    ids, truth = (torch.from_numpy(a.astype(np.int64)) for a in (found, true))
    ids, truth = (torch.where(a == 0, -1, a) for a in (ids, truth))
    expected = semantic_score(Confusion.of(ids, truth, weights)).miou
    assert sure["miou"] == pytest.approx(expected, abs=1e-9)


def test_points_must_say_what_is_visible(run) -> None:
    with pytest.raises(InputError, match="^visible: expected points that say whether a photograph"):
        run("waymo", "points=density", "visible=yes")
    assert "visible_miou" not in only(run("waymo", "points=density"), "uplift-density")


def test_windows_of_a_list(run, sets) -> None:
    data = sets("kitti360")
    folder = data.folder / "data_3d_semantics/train"
    (file,) = folder.glob("*/static/*.ply")
    line = file.relative_to(data.folder)
    listed = folder / "2013_05_28_drive_val.txt"
    try:
        listed.write_text(f"{line}\n")
        assert len(run("kitti360", "points=density", "windows=val").methods[0].scenes) == 1
        listed.write_text(f"{line.with_name('0000000900_0000000950.ply')}\n")
        with pytest.raises(InputError, match="expected windows of the list 2013_05_28_drive_val"):
            run("kitti360", "points=density", "windows=val")
        listed.write_text("some words\n")
        with pytest.raises(InputError, match="expected lines such as data_3d_"):
            run("kitti360", "points=density", "windows=val")
    finally:
        listed.unlink()
    with pytest.raises(InputError, match="2013_05_28_drive_train.txt"):
        run("kitti360", "points=density", "windows=train")
    with pytest.raises(InputError, match="^windows: scenes of layout waymo are no windows"):
        run("waymo", "points=density", "windows=val")
    with pytest.raises(InputError, match="^windows: expected the word of a list"):
        run("kitti360", "points=density", "windows=../val")


def test_own_classes_have_their_own_names(run) -> None:
    merged, own = (run("waymo", "points=density", f"classes={c}") for c in ("table-1", "own"))
    names = {row["name"] for row in own.methods[0].scenes[0].rows if "class" in row}
    assert "sign" in names, "Waymo's name of it"
    assert not names & {"traffic sign", "others"}
    assert not set(TABLE_1) & set(own.methods[0].scores)
    assert "traffic sign" in merged.methods[0].scores


@pytest.mark.parametrize("classes", ["table-1", "own"])
@pytest.mark.parametrize(
    ("layout", "names"),
    [
        ("kitti360", {"traffic sign": "Sign", "terrain": "ground", "pole": "pole"}),
        ("waymo", {"traffic sign": "sign", "wall": "building", "terrain": "walkable"}),
    ],
)
def test_maps_of_other_names_score_the_same(layout, names, classes, run, sets, tmp_path) -> None:
    """Evidence of the same classes, called as another data set does."""
    evidence = sets(layout).fit.parent / "evidence"
    other = tmp_path / "renamed"
    shutil.copytree(evidence, other)
    (other / "metadata.json").unlink()
    content = json.loads((evidence / "metadata.json").read_text())
    for row in content["classes"]:
        row["name"] = names.get(row["name"], row["name"])
    (other / "metadata.json").write_text(json.dumps(content))
    switches = ("points=density", f"classes={classes}")
    usual = run(layout, *switches, fitted=str(fresh(sets(layout), tmp_path, "usual")))
    renamed = run(
        layout,
        *switches,
        models=(str(other / NAME),),
        fitted=str(fresh(sets(layout), tmp_path, "renamed-fit")),
    )
    ours, theirs = (dict(one.methods[0].scores) for one in (usual, renamed))
    assert theirs == ours
    notes = [note for note in renamed.methods[0].scenes[0].notes if "by other names" in note]
    if layout == "kitti360":
        assert [note.partition(":")[0] for note in notes] == ["points", "views"]
        assert all("Sign is traffic sign, ground is terrain" in note for note in notes)
    else:
        assert "walkable is ground" in notes[1]


def fresh(data: Set, tmp_path: Path, name: str) -> Path:
    """A copy of the fit without evidence."""
    return Path(shutil.copytree(data.fit, data.fit.parent / f"{tmp_path.name}-{name}"))


def test_a_method_has_at_least_one_of_the_rules(run) -> None:
    with pytest.raises(InputError, match="expected one of views, density, region, fair for"):
        run("waymo", "points=field")
    with pytest.raises(InputError, match="points: expected one of"):
        run("waymo", "points=nearest")
    with pytest.raises(InputError, match="points: expected each rule once"):
        run("waymo", "points=views,views")
    with pytest.raises(RangeError, match="radius: expected a positive number"):
        run("waymo", "radius=0")


def test_segments_are_no_classes(run) -> None:
    with pytest.raises(InputError, match="expected one that takes labels"):
        run("waymo", methods=("associate",))


def test_a_mesh_field_is_its_own_row(run, sets, tmp_path) -> None:
    """Points by eq. 9, and by what its views show; the field is kept in the scene."""
    few = ("geometry_iterations=2", "iterations=4", "rays=64", "voxels=1.0,2.0", "radius=0.1")
    done = run("waymo", "points=field,views", methods=("dnmp",), method_options=few)
    assert [one.method for one in done.methods] == ["dnmp-field", "dnmp-views"]
    field, views = (one.scores for one in done.methods)
    assert field["undefined"] > 0
    assert field["miou"] != views["miou"]
    assert field["psnr"] == views["psnr"]
    kept = scene_field(load_scene(copied(sets("waymo"), tmp_path)), "dnmp")
    assert kept.layer_names == ("layer",)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_scans_are_those_of_the_layout(layout, sets) -> None:
    scene, protocol = sets(layout).scene, find_protocol(layout)
    assert scans_of(scene, protocol) == scene.capture.path
    assert scans_of(scene, protocol.with_switches({"scans": False})) is None
    assert scans_of(scene, find_protocol("replica")) is None


def test_a_drive_without_scans_has_none(sets, tmp_path) -> None:
    scene = sets("waymo").scene
    bare = replace(scene, capture=replace(scene.capture, path=tmp_path))
    assert scans_of(bare, find_protocol("waymo")) is None


def test_fits_learn_the_depth_of_scans(sets, tmp_path) -> None:
    data = sets("waymo")
    options = BenchOptions(
        models=(str(data.fit.parent / "evidence" / NAME),), steps=3, max_gaussians=300,
        switches=("points=density",),
    )  # fmt: skip
    for name, switches in (("with", ()), ("without", ("scans=no",))):
        out = tmp_path / name
        chosen = replace(options, switches=(*options.switches, *switches))
        bench("waymo", data.folder, out, options=chosen)
        (folder,) = (out / "scenes/waymo").iterdir()
        depth = load_scene(folder).provenance["options"]["depth"]
        assert (depth == "metric") == (name == "with")


def test_classes_are_merged_by_name() -> None:
    assert [merged_name(name) for name in ("Road", "gate", "person", "out of roi", "sky")] == [
        "road", "fence", "others", None, "sky",
    ]  # fmt: skip
    assert all(merged_name(name) == name for name in TABLE_1)


def test_truth_without_points_is_scored_in_views_alone(sets, tmp_path, monkeypatch) -> None:
    data = sets("waymo")
    bare = replace(data.scene, points=None)
    monkeypatch.setattr("splatseg_bench.scenes.read_benchmark", lambda *_, **__: (bare,))
    fit = copied(data, tmp_path)
    options = BenchOptions(models=(str(data.fit.parent / "evidence" / NAME),), fitted=str(fit))
    done = bench("waymo", data.folder, tmp_path / "out", options=options)
    assert [one.method for one in done.methods] == ["uplift-views"]
    said = "there are no scans beside the photographs"
    assert not any(said in note for note in done.methods[0].scenes[0].notes)
    monkeypatch.setattr("splatseg_bench.scenes.scan_formats", lambda _: ())
    again = bench("waymo", data.folder, tmp_path / "again", options=options)
    assert any(said in note for note in again.methods[0].scenes[0].notes)
    assert set(done.methods[0].scores) == {"view_miou", "psnr", "ssim"}


def test_no_held_out_view_is_refused(sets, tmp_path, monkeypatch) -> None:
    data = sets("waymo")
    capture = data.scene.capture
    views = tuple(replace(view, split="train") for view in capture.views)
    bare = replace(data.scene, capture=replace(capture, views=views))
    monkeypatch.setattr("splatseg_bench.scenes.read_benchmark", lambda *_, **__: (bare,))
    options = BenchOptions(models=(str(data.fit.parent / "evidence" / NAME),), fitted=str(data.fit))
    with pytest.raises(InputError, match="expected held-out views, got none"):
        bench("waymo", data.folder, tmp_path / "out", options=options)


@pytest.fixture
def bare_labels(monkeypatch: pytest.MonkeyPatch) -> Method:
    """A method whose labels do not say how much views saw."""
    monkeypatch.setattr(registry, "_REGISTERED", {})

    def run(inputs: Any, options: Any) -> Any:
        return replace(uplift.METHOD.run(inputs, options), evidence=None)

    method = replace(uplift.METHOD, name="bare", run=run, reference="-")
    register_method(method)
    return method


def test_fair_votes_need_how_much_was_seen(run, bare_labels) -> None:
    with pytest.raises(InputError, match="expected labels that say how much views saw"):
        run("waymo", "points=fair", methods=(bare_labels.name,))
