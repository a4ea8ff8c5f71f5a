"""A field of another package, with no Gaussians at all, is rendered, scored and reported."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from splatseg.core import Camera, ClassInfo, ClassTable, Gaussians, LabelMap, Scene, View
from splatseg.errors import InputError, ShapeError
from splatseg.evaluate import evaluate_semantic
from splatseg.io.images import save_png
from splatseg.report.segment_report import write_segmentation_report
from splatseg.tasks import EvaluationOptions, RenderingOptions, evaluate_scene, render_views
from support.analytic import BALL, BALL_COLOUR, FLOOR, BallOverFloor

WIDTH, HEIGHT = 48, 36
CLASSES = ClassTable(
    rows=(
        ClassInfo(id=FLOOR, name="floor", isthing=False, colour=(9, 9, 90)),
        ClassInfo(id=BALL, name="ball", colour=(200, 0, 0)),
    )
)


def camera(x: float) -> Camera:
    pose = torch.eye(4, dtype=torch.float64)
    pose[0, 3] = -x
    lens = {"model": "opencv", "distortion": (-0.1, 0.01)} if x > 0.3 else {}
    return Camera(
        width=WIDTH, height=HEIGHT, fx=40.0, fy=40.0, cx=24.0, cy=18.0, cam_from_world=pose, **lens
    )


@pytest.fixture
def field() -> BallOverFloor:
    return BallOverFloor(views=["v0", "v1"])


@pytest.fixture
def scene(field) -> Scene:
    """Views of nothing: whatever they show comes from the field."""
    none = torch.zeros(0, 3)
    gaussians = Gaussians(
        means=none, rotations=torch.zeros(0, 4), scales=none, opacities=torch.zeros(0),
        sh=torch.zeros(0, 1, 3),
    )  # fmt: skip
    views = [
        View(name=f"v{i}", camera=camera(0.2 * i), split="test" if i > 1 else "train")
        for i in range(4)
    ]
    return Scene(gaussians=gaussians, views=tuple(views), classes=CLASSES)


@pytest.fixture
def truth(scene, field, tmp_path):
    """True ids of all views, of classes 1 and 2 too; in them the ball is another, larger one."""
    larger = BallOverFloor(radius=0.6)
    for name in ("things", "classes"):
        (tmp_path / name).mkdir()
    for view in scene.views:
        ids, _ = larger.hits(view.camera)
        save_png(torch.where(ids < 0, 0, ids).int(), tmp_path / "things" / f"{view.name}.png")
        classes = torch.where(ids == BALL, 2, torch.where(ids == FLOOR, 1, 0))
        save_png(classes.int(), tmp_path / "classes" / f"{view.name}.png")
    rows = [{"id": 1, "name": "a", "isthing": False}, {"id": 2, "name": "b", "isthing": True}]
    (tmp_path / "metadata.json").write_text(json.dumps({"classes": rows}))
    return tmp_path


def test_render_writes_what_rays_hit(scene, field, tmp_path) -> None:
    what = ("rgb", "depth", "alpha", "things", "selected")
    options = RenderingOptions(split="all", what=what, coloured=True)
    made = render_views(scene, tmp_path / "out", options=options, field=field)
    assert made.views == field.opened == 4, "one view a camera, whatever is rendered of it"
    assert field.open == 0
    unit = json.loads((tmp_path / "out" / "depth" / "depth.json").read_text())["unit"]
    for view in scene.views:
        ids, depth = field.hits(view.camera)
        pixels = {name: np.array(Image.open(tmp_path / "out" / name / f"{view.name}.png")) for name
                  in (*what, "things_coloured")}  # fmt: skip
        assert np.array_equal(pixels["things"], torch.where(ids < 0, 0, ids).numpy())
        assert np.array_equal(pixels["selected"] > 0, (ids == BALL).numpy())
        assert np.array_equal(pixels["alpha"] > 0, (ids >= 0).numpy())
        assert np.abs(pixels["depth"] * unit - depth.numpy()).max() <= unit
        assert set(map(tuple, pixels["rgb"][(ids == BALL).numpy()])) == {
            tuple(round(255 * value) for value in BALL_COLOUR)
        }
        assert set(map(tuple, pixels["things_coloured"][(ids == BALL).numpy()])) == {(200, 0, 0)}
        # Straight ahead the ball is hit a radius before its centre.
    ids, depth = field.hits(replace(scene.views[0].camera, cx=23.5, cy=17.5))
    assert ids[17, 23] == BALL
    assert float(depth[17, 23]) == pytest.approx(3.0 - 0.5)
    legend = json.loads((tmp_path / "out" / "things" / "legend.json").read_text())
    assert {id: row["name"] for id, row in legend["ids"].items()} == {"3": "floor", "8": "ball"}


def test_a_path_goes_through_the_field(scene, field, tmp_path) -> None:
    """Forward-facing views turn about the depth of what the field shows."""
    options = RenderingOptions(split="path", frames=3, what=("things",))
    beside = replace(scene, views=tuple(replace(view, split="train") for view in scene.views))
    made = render_views(beside, tmp_path / "out", options=options, field=field)
    assert made.views == 3
    assert field.opened > 3, "depths were asked for"
    assert BALL in np.array(Image.open(tmp_path / "out" / "things" / "path_0001.png"))


def test_paths_turn_about_the_median_depth_where_it_is_known(scene, tmp_path) -> None:
    """Fields that differ in expected depth, and agree in the median, have one path."""

    class Known(BallOverFloor):
        factor = 1.0

        def view(self, camera):
            found = super().view(camera)
            whole = found.signals

            def signals(**words):
                shown = whole(**words)
                return replace(shown, depth=self.factor * shown.depth, median_depth=shown.depth)

            found.signals = signals
            return found

    class Twice(Known):
        factor = 2.0

    class Alone(Twice):
        def view(self, camera):
            found = super().view(camera)
            both = found.signals
            found.signals = lambda **words: replace(both(**words), median_depth=None)
            return found

    beside = replace(scene, views=tuple(replace(view, split="train") for view in scene.views))
    options = RenderingOptions(split="path", frames=3, what=("things",))
    paths = []
    for i, field in enumerate((Known(), Twice(), Alone())):
        render_views(beside, tmp_path / str(i), options=options, field=field)
        paths.append((tmp_path / str(i) / "transforms.json").read_text())
    assert paths[0] == paths[1]
    assert paths[0] != paths[2]


@pytest.mark.parametrize("metric", ["semantic", "instances", "binary"])
def test_scores_are_those_of_the_files(scene, field, truth, score, metric) -> None:
    layer = "selected" if metric == "binary" else "things"
    render_views(
        scene,
        truth / "out",
        options=RenderingOptions(split="all", what=(layer,)),
        field=field,
    )
    id = BALL if metric == "binary" else None
    options = EvaluationOptions(
        layer=layer, truth=truth / "things", split="all", metric=metric, id=id
    )
    ours = evaluate_scene(scene, options=options, field=field)
    where = truth / "things"
    if metric == "binary":
        where = truth / "mask"
        where.mkdir()
        for path in (truth / "things").glob("*.png"):
            mask = np.array(Image.open(path)) == BALL
            Image.fromarray((255 * mask).astype(np.uint8)).save(where / path.name)
    theirs = score(metric, "--pred", truth / "out" / layer, "--truth", where)
    shared = theirs.keys() & ours.keys() - {"per_class"}
    assert len(shared) >= 3
    for key in shared:
        assert ours[key] == pytest.approx(theirs[key], abs=1e-9), key
    if metric != "binary":
        assert 0.5 < ours["mIoU"] < 0.99
        assert ours["learned_from"] == 2
    assert field.open == 0


def test_panoptic_scores_by_the_classes_that_the_layer_tells(scene, field, truth, score) -> None:
    options = RenderingOptions(split="all", what=("things",))
    render_views(scene, truth / "out", options=options, field=field)
    ours = evaluate_scene(
        scene,
        options=EvaluationOptions(
            layer="things", truth=truth / "classes", truth_instances=truth / "things",
            classes=str(truth / "metadata.json"), split="all", metric="panoptic",
        ),
        field=field,
    )  # fmt: skip
    (truth / "named").mkdir()
    for path in (truth / "out" / "things").glob("*.png"):
        ids = np.array(Image.open(path))
        named = np.where(ids == BALL, 2, np.where(ids == FLOOR, 1, 0)).astype(np.uint16)
        Image.fromarray(named).save(truth / "named" / path.name)
    theirs = score(
        "panoptic", "--pred-instance", truth / "out" / "things",
        "--pred-semantic", truth / "named", "--truth-instance", truth / "things",
        "--truth-semantic", truth / "classes", "--metadata", truth / "metadata.json",
    )  # fmt: skip
    assert 0.3 < theirs["PQ_scene"] < 1
    for key, value in theirs.items():
        assert ours[key] == pytest.approx(value, abs=1e-9), key


def test_points_and_photographs(scene, field, tmp_path) -> None:
    xyz = np.array([[0, 0, 3], [0, 0.49, 3], [0, 0.7, 3], [0, 0, 1]], np.float32)
    np.savez(tmp_path / "points.npz", xyz=xyz, semantic=np.array([BALL, BALL, FLOOR, FLOOR]))
    given = EvaluationOptions(layer="things", points=tmp_path / "points.npz")
    figures = evaluate_scene(scene, options=given, field=field)
    assert figures["points_accuracy"] == pytest.approx(3 / 4)
    assert figures["points_unlabelled"] == pytest.approx(1 / 4)
    assert "points_rule" not in figures
    photographed = []
    for view in scene.views:
        with field.view(view.camera) as looked_at:
            save_png(looked_at.signals().colour, tmp_path / f"{view.name}.png")
        photographed.append(replace(view, image=tmp_path / f"{view.name}.png"))
    seen = replace(scene, views=tuple(photographed))
    figures = evaluate_scene(seen, options=EvaluationOptions(split="all"), field=field)
    assert figures["PSNR"] > 60
    assert figures["photographs"] == 4
    smaller = evaluate_scene(
        seen, options=EvaluationOptions(split="all"), field=BallOverFloor(radius=0.3)
    )
    assert smaller["PSNR"] < 30


def test_a_report_of_a_field_without_gaussians(scene, field, truth) -> None:
    from splatseg.io.evidence import open_evidence

    def page(**words) -> str:
        write_segmentation_report(
            scene,
            truth / "report.html",
            field=field,
            layer="things",
            evidence=open_evidence(truth / "things"),
            views=scene.train_views,
            **words,
        )
        return (truth / "report.html").read_text()

    found = page(truth=open_evidence(truth / "things"))
    assert "2 labels, by by hand from 2 views" in found
    for words in ("pixels of the views shown", "mIoU", "Evidence that differs", "v2, held out"):
        assert words in found, words
    for words in ("Gaussians with a label", "Coverage", "What the labels rest on", "Conflicts"):
        assert words not in found, words
    shown = sum(int((field.hits(view.camera)[0] == BALL).sum()) for view in scene.views)
    assert f'<td>ball</td><td class="number">{shown}</td><td class="number">0.500</td>' in found
    assert "There is no truth to score" in page()
    assert field.open == 0
    assert page().count('<li id="object-') == 2, "objects of any field are cut out"


def test_what_fields_must_not_do_is_refused(scene, field, truth, tmp_path) -> None:
    options = EvaluationOptions(layer="marks", truth=truth / "things")
    with pytest.raises(InputError, match="features without a classifier"):
        evaluate_scene(scene, options=options, field=field)
    with pytest.raises(InputError, match="no image"):
        render_views(scene, tmp_path / "o", options=RenderingOptions(what=("marks",)), field=field)
    with pytest.raises(InputError, match=r"a layer of the scene \(marks, selected, things\)"):
        render_views(scene, tmp_path / "o", options=RenderingOptions(what=("walls",)), field=field)

    class Cropped(BallOverFloor):
        def view(self, camera):
            return super().view(camera.resized(camera.width // 2, camera.height // 2))

    maps = {view.name: field.hits(view.camera)[0] for view in scene.views}

    class Truth:
        view_names = tuple(maps)

        def label_map(self, name):
            return LabelMap(ids=maps[name])

    assert evaluate_semantic(field, scene.views, "things", Truth()).score.miou == 1
    with pytest.raises(ShapeError, match="'things' of 48x36 pixels, those of .* got 24x18"):
        evaluate_semantic(Cropped(), scene.views, "things", Truth())
