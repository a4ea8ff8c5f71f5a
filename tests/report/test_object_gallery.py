"""Objects are cut out of the views that show most of them, and told by their numbers."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
import torch

from splatseg.core import Camera, Gaussians, Labels, LayerInfo, Scene, View
from splatseg.io.images import save_png
from splatseg.lift import GaussianField
from splatseg.report import objects, segment_report
from splatseg.report.objects import sightings
from splatseg.report.segment_report import SegmentationRun, write_segmentation_report

WIDTH, HEIGHT = 48, 36
BOX, DOT = 7, 12


def camera(x: float) -> Camera:
    pose = torch.eye(4, dtype=torch.float64)
    pose[0, 3] = -x
    return Camera(width=WIDTH, height=HEIGHT, fx=40, fy=40, cx=24, cy=18, cam_from_world=pose)


@pytest.fixture
def scene(tmp_path) -> Scene:
    """A box to the left and a dot to the right, seen by views that move to the right."""
    x, y = torch.meshgrid(
        torch.linspace(-0.9, -0.3, 9), torch.linspace(-0.3, 0.3, 9), indexing="ij"
    )
    box = torch.stack((x, y, torch.full_like(x, 2.0)), -1).reshape(-1, 3)
    dot = torch.tensor([[1.0, 0.0, 2.0], [1.05, 0.0, 2.0]])
    means = torch.cat((box, dot))
    n = len(means)
    gaussians = Gaussians(
        means=means,
        rotations=torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
        scales=torch.full((n, 3), 0.05),
        opacities=torch.full((n,), 0.95),
        sh=torch.zeros(n, 1, 3),
    )
    views = []
    for i, x in enumerate((-0.6, -0.3, 1.0)):
        image = tmp_path / f"v{i}.png"
        save_png(torch.full((HEIGHT, WIDTH, 3), 0.2 + 0.3 * i), image)
        views.append(View(name=f"v{i}", camera=camera(x), image=image))
    return Scene(gaussians=gaussians, views=tuple(views))


@pytest.fixture
def labels(scene) -> Labels:
    ids = torch.where(scene.gaussians.means[:, 0] < 0, BOX, DOT).int()
    return Labels(
        ids=ids,
        confidence=torch.full((len(ids),), 0.5),
        info=LayerInfo(names={BOX: "red box"}, method="associate"),
    )


def field_of(scene, labels) -> GaussianField:
    return GaussianField(scene.gaussians, {"things": labels}, backend="cpu")


def test_each_is_cut_out_of_its_best_view(scene, labels) -> None:
    colours = {BOX: (255, 0, 0), DOT: (0, 0, 255), 99: (1, 2, 3)}
    found = sightings(field_of(scene, labels), "things", scene.views, colours)
    assert set(found) == {BOX, DOT}
    assert (found[BOX].view, found[DOT].view) == ("v0", "v2")
    for id, grey in ((BOX, 51), (DOT, 204)):
        image = found[id].image.image
        assert image.shape == (256, 256, 3)
        middle = image[118:138, 118:138].float().mean(dim=(0, 1))
        assert torch.allclose(middle, torch.full((3,), float(grey)), atol=3), "the photograph"
        outline = (image.int() - torch.tensor(colours[id])).abs().sum(dim=-1) == 0
        assert 100 < int(outline.sum()) < 256 * 30, id
    assert found[BOX].pixels > found[DOT].pixels > 0


def test_what_the_border_cuts_is_shown_from_where_it_is_whole(scene, labels) -> None:
    """Nearer views show more pixels of the box, but not all of it."""
    near = replace(scene.views[0], name="near", camera=camera(0.05))
    near = replace(near, camera=replace(near.camera, fx=90.0, fy=90.0))
    found = sightings(field_of(scene, labels), "things", (near, scene.views[0]), {BOX: (255, 0, 0)})
    assert found[BOX].view == "v0"


def test_views_without_photographs_are_rendered(scene, labels) -> None:
    bare = tuple(replace(view, image=None) for view in scene.views)
    found = sightings(field_of(scene, labels), "things", bare, {BOX: (255, 0, 0)})
    grey = found[BOX].image.image[128, 128].float().mean()
    assert abs(float(grey) - 127) < 20


def written(scene, labels, folder, **words) -> tuple[str, dict]:
    write_segmentation_report(
        scene,
        folder / "things.html",
        field=field_of(scene, labels),
        layer="things",
        evidence=None,
        views=scene.views,
        labels=labels,
        run=SegmentationRun(backend="cpu", **words),
    )
    return (folder / "things.html").read_text(), json.loads((folder / "things.json").read_text())


def test_cards_and_json_say_which_object_is_which(scene, labels, tmp_path) -> None:
    page, record = written(
        scene,
        labels,
        tmp_path,
        files={BOX: "exports/things/objects/007_red-box.ply"},
        warnings=("The fit is poor.",),
        command="splatseg segment S --report",
    )
    card = re.search(rf'<li id="object-{BOX}">.*?</li>', page, re.S)
    assert card is not None
    said = re.sub(r"<img[^>]*>|<[^>]+>", " ", card[0])
    for words in ("7 red box", "81", "0.50", "v0", "007_red-box.ply"):
        assert words in said, words
    assert "exports/things/objects" in page
    assert 'segment S <span class="option">--report</span></code>' in page
    assert "The fit is poor." in page
    first, second = record["objects"]
    assert (first["id"], first["name"], first["gaussians"], first["best_view"]) == (
        BOX, "red box", 81, "v0",
    )  # fmt: skip
    assert first["file"] == "exports/things/objects/007_red-box.ply"
    assert (second["id"], second["file"]) == (DOT, None)
    assert record["warnings"] == ["The fit is poor."]
    colour = ",".join(str(value) for value in first["colour"])
    assert f"background:rgb({colour})" in card[0]


def test_a_thousand_objects_stay_bounded(scene, tmp_path, monkeypatch) -> None:
    """Only so many are shown, in pictures that grow smaller; the JSON has all."""
    ids = torch.arange(len(scene.gaussians)).int()
    labels = Labels(ids=ids, confidence=torch.ones(len(ids)))
    monkeypatch.setattr(objects, "_SIZES", ((10, 64), (50, 24)))
    monkeypatch.setattr(objects, "MAX_OBJECTS", 50)
    monkeypatch.setattr(segment_report, "MAX_OBJECTS", 50)
    page, record = written(scene, labels, tmp_path)
    cards = re.findall(r'<li id="object-\d+">', page)
    assert len(cards) == 50
    assert f"The 50 largest; {len(ids) - 50} more are in the JSON file." in page
    assert len(record["objects"]) == len(ids)
    sizes = set(re.findall(r'width="(\d+)" height="24"', page))
    assert sizes == {"24"}


def test_instances_that_no_gaussian_carries_are_told(scene, labels, tmp_path) -> None:
    info = replace(labels.info, details={"associate": {"instances": 5}})
    page, _ = written(scene, replace(labels, info=info), tmp_path)
    assert "Masks were joined into 5 instances; 3 instances have no label" in page
    info = replace(labels.info, details={"associate": {"instances": 2}})
    page, _ = written(scene, replace(labels, info=info), tmp_path)
    assert "Masks were joined" not in page


def test_confidence_is_stretched_over_what_there_is(scene, labels, tmp_path) -> None:
    sure = torch.linspace(0.6, 0.9, len(labels.ids))
    page, _ = written(scene, replace(labels, confidence=sure), tmp_path)
    low, high = re.findall(r'<div class="scale"><b>([\d.]+)[^<]*</b>.*?<b>([\d.]+)', page)[0]
    assert 0.55 <= float(low) <= 0.65
    assert 0.85 <= float(high) <= 0.95
    assert np.isfinite(float(low))
