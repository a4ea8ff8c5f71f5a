"""`splatseg edit` as a person types it."""

import base64
import io
import json
import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from splatseg.cli import main
from splatseg.core import Camera, Gaussians, LabelMap, Scene, View
from splatseg.io.evidence import save_label_map
from splatseg.io.scene import load_scene, load_scene_layer, save_scene, save_scene_layer
from splatseg.lift import UpliftOptions, uplift


class Maps:
    def __init__(self, maps) -> None:
        self.maps = maps

    @property
    def view_names(self):
        return tuple(self.maps)

    def label_map(self, name):
        return self.maps[name]


def camera(x: float) -> Camera:
    pose = torch.eye(4, dtype=torch.float64)
    pose[0, 3], pose[2, 3] = -x, 4.0
    return Camera(width=48, height=36, fx=50, fy=50, cx=24, cy=18, cam_from_world=pose)


@pytest.fixture
def room(tmp_path):
    """A wall of Gaussians, the left half of it a thing; masks of two views say where it ends."""
    rng = np.random.default_rng(5)
    means = np.concatenate((rng.uniform(-1.5, 1.5, (400, 2)), rng.normal(0, 0.02, (400, 1))), 1)
    n = len(means)
    gaussians = Gaussians(
        means=torch.from_numpy(means.astype(np.float32)),
        rotations=torch.eye(4)[:1].expand(n, 4).clone(),
        scales=torch.from_numpy(rng.uniform(0.05, 0.2, (n, 3)).astype(np.float32)),
        opacities=torch.full((n,), 0.7),
        sh=torch.from_numpy(rng.normal(0, 0.5, (n, 4, 3)).astype(np.float32)),
    )
    views = tuple(View(name=f"v{i}", camera=camera(0.2 * i)) for i in range(3))
    maps = {}
    for view in views:
        u = view.camera.pixel_centres()[..., 0]
        edge = 24 - 50 * float(-view.camera.cam_from_world[0, 3]) / 4
        maps[view.name] = LabelMap(ids=torch.where(u < edge, 3, 8).int())
    root = tmp_path / "room"
    save_scene(Scene(gaussians=gaussians, views=views), root)
    folder = root / "evidence" / "truth"
    for name, label_map in maps.items():
        save_label_map(label_map, folder, name)
    labels = uplift(
        gaussians, views, Maps(maps), options=UpliftOptions(candidates=2), backend="cpu"
    )
    info = replace(labels.info, evidence="truth", names={3: "thing", 8: "wall"})
    save_scene_layer(
        labels.__class__(
            **{
                f: getattr(labels, f)
                for f in ("ids", "confidence", "background", "candidates", "shares")
            },
            info=info,
        ),
        root,
        "objects",
    )
    return root


def history(root):
    return json.loads((root / "scene.json").read_text())["provenance"]["edits"]


def test_a_thing_is_removed_at_its_masks_and_comes_back(
    room, tmp_path, capsys, monkeypatch
) -> None:
    monkeypatch.setattr("splatseg.lift.boundaries.cut._MIN_WEIGHT", 0)
    out = tmp_path / "out"
    words = ["edit", str(room), "-o", str(out), "--remove", "--layer", "objects"]
    assert main([*words, "--names", "thing"]) == 0
    said = capsys.readouterr().out
    assert "Gaussians split at the boundary (masks): renders before and after are" in said
    (edit,) = history(out)
    assert edit["kind"] == "remove"
    assert edit["where"] == {"layer": "objects", "ids": [3]}
    assert edit["cut"]["views"] == ["v0", "v1", "v2"]
    assert edit["result"]["split"] > 20
    assert edit["result"]["split_psnr"] > 30
    scene, labels = load_scene(out), load_scene_layer(out, "objects")
    assert len(scene.gaussians) == len(labels) == edit["result"]["after"]
    assert set(labels.ids.tolist()) == {8}
    assert [view.name for view in scene.views] == ["v0", "v1", "v2"]
    assert float(scene.gaussians.means[:, 0].min()) > -0.15

    again = tmp_path / "again"
    assert (
        main(
            [
                "edit",
                str(out),
                "-o",
                str(again),
                "--extract",
                "--layer",
                "objects",
                "--ids",
                "8",
                "--box",
                "-2",
                "-2",
                "-1",
                "2",
                "0",
                "1",
            ]
        )
        == 0
    )
    assert [e["kind"] for e in history(again)] == ["remove", "extract"]
    assert history(again)[1]["cut"]["by"] == "layer"
    back = tmp_path / "back"
    assert main(["edit", str(again), "-o", str(back), "--undo"]) == 0
    assert "undone: extract; 1 edits are left" in capsys.readouterr().out
    for name in ("means", "scales", "opacities", "sh"):
        assert torch.equal(
            getattr(load_scene(back).gaussians, name), getattr(scene.gaussians, name)
        )
    assert torch.equal(load_scene_layer(back, "objects").ids, labels.ids)


def test_a_copy_is_moved_and_a_thing_coloured(room, tmp_path) -> None:
    out = tmp_path / "out"
    thing = ["--layer", "objects", "--ids", "3", "--cut", "off"]
    assert (
        main(
            [
                "edit",
                str(room),
                "-o",
                str(out),
                "--duplicate",
                *thing,
                "--move",
                "0",
                "0",
                "5",
                "--rotate",
                "0",
                "0",
                "2",
                "90",
                "--scale",
                "2",
            ]
        )
        == 0
    )
    before, after = load_scene(room).gaussians, load_scene(out).gaussians
    chosen = load_scene_layer(room, "objects").ids == 3
    copy, own = after.means[len(before) :], before.means[chosen]
    middle = own.double().median(dim=0).values.float()
    turned = 2 * (own - middle) @ torch.tensor([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]) + middle
    torch.testing.assert_close(copy, turned + torch.tensor([0.0, 0, 5]), atol=1e-5, rtol=0)

    red = tmp_path / "red"
    assert (
        main(
            [
                "edit",
                str(room),
                "-o",
                str(red),
                *thing,
                "--colour",
                "1",
                "0",
                "0",
                "--flat-colour",
                "--move",
                "1",
                "0",
                "0",
            ]
        )
        == 0
    )
    assert [e["kind"] for e in history(red)] == ["recolour", "transform"]
    coloured = load_scene(red).gaussians
    torch.testing.assert_close(
        coloured.colours[chosen], torch.tensor([[1.0, 0, 0]]).expand(int(chosen.sum()), 3)
    )
    torch.testing.assert_close(coloured.means[chosen], own + torch.tensor([1.0, 0, 0]))
    assert torch.equal(coloured.means[~chosen], before.means[~chosen])


def test_colours_are_scaled(room, tmp_path) -> None:
    before = load_scene(room).gaussians.colours
    out = tmp_path / "tinted"
    words = ["--colour-scale", "0.5", "1", "1"]
    assert main(["edit", str(room), "-o", str(out), *words, "--cut", "off"]) == 0
    expected = before * torch.tensor([0.5, 1, 1])
    found = load_scene(out).gaussians.colours
    inside = ((expected > 0) & (expected < 1)).all(dim=1)
    assert int(inside.sum()) > 100
    torch.testing.assert_close(found[inside], expected[inside], rtol=0, atol=1e-4)


def test_scenes_are_joined(room, tmp_path) -> None:
    out = tmp_path / "out"
    assert (
        main(["edit", str(room), "-o", str(out), "--merge", str(room), "--move", "9", "0", "0"])
        == 0
    )
    before, after = load_scene(room).gaussians, load_scene(out).gaussians
    assert len(after) == 2 * len(before)
    torch.testing.assert_close(after.means[400:], before.means + torch.tensor([9.0, 0, 0]))
    labels = load_scene_layer(out, "objects")
    assert torch.equal(labels.ids[400:], labels.ids[:400]), "the same names are the same ids"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "edit: expected something to do"),
        (["--remove"], "--remove: expected --layer, --box or another condition of what is meant"),
        (["--remove", "--extract", "--layer", "objects"], "expected one of the two, got both"),
        (["--remove", "--layer", "objects"], "ids: expected at least one id of layer 'objects'"),
        (["--remove", "--layer", "objects", "--ids", "4"], "no Gaussian with id 4; it has 3, 8"),
        (["--remove", "--layer", "things", "--ids", "4"], "expected one of the scene (objects)"),
        (["--remove", "--layer", "objects", "--names", "cat"], "names of the layer (thing, wall)"),
        (["--remove", "--box", "0", "0", "0", "0", "1", "1"], "a first corner below the second"),
        (["--remove", "--box", "9", "9", "9", "10", "10", "10"], "expected at least one Gaussian"),
        (["--remove", "--box", "-9", "-9", "-9", "9", "9", "9"], "expected to leave Gaussians"),
        (["--ids", "3", "--move", "1", "0", "0"], "expected --layer that they are of"),
        (["--rotate", "0", "0", "0", "30"], "expected an axis that is not zero"),
        (["--scale", "0"], "scale: expected more than 0"),
        (["--move", "nan", "0", "0"], "translation: 1 of 3 values are not finite"),
        (["--colour", "2", "0", "0"], "colour: expected values in [0, 1]"),
        (["--extract", "--layer", "objects", "--ids", "3", "--fill", "opencv"], "--fill: go with"),
        (["--move", "1", "0", "0", "--refit", "9"], "--fill: go with --remove only"),
        (
            ["--remove", "--layer", "objects", "--ids", "3", "--fill", "classical"],
            "fill: expected exemplar, opencv or a model that inpaints, got 'classical'",
        ),
        (
            ["--remove", "--layer", "objects", "--ids", "3", "--cut", "off", "--refit", "9"],
            "refit: expected a photograph that shows what is removed, got none",
        ),
        (["--undo"], "expected a scene with an edit to undo, got one without"),
        (["--merge", "nowhere"], "nowhere: expected a scene folder, got none"),
        (["--merge", "nowhere", "--colour", "1", "0", "0"], "--merge: takes no colours"),
        (
            ["--remove", "--layer", "objects", "--ids", "3", "--min-side", "0.7"],
            "--min-side: expected a value in [0, 0.5], got 0.7",
        ),
        (
            [
                "--extract",
                "--layer",
                "objects",
                "--ids",
                "3",
                "--cut",
                "masks",
                "--evidence",
                "no",
            ],
            "no",
        ),
    ],
)
def test_bad_edits_get_one_sentence_and_leave_nothing(
    room, tmp_path, capsys, words, message
) -> None:
    out = tmp_path / "out"
    assert main(["edit", str(room), "-o", str(out), *words]) == 2
    said = capsys.readouterr().err
    assert message in said.replace("\n", " ")
    assert not out.exists()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["room"]


def test_nothing_is_overwritten(room, capsys) -> None:
    before = (room / "gaussians.ply").read_bytes()
    words = ["edit", str(room), "-o", str(room), "--colour", "1", "0", "0"]
    assert main(words) == 2
    assert "expected a new folder, got one that is there" in capsys.readouterr().err
    assert (room / "gaussians.ply").read_bytes() == before


def test_ctrl_c_leaves_nothing_half_written(room, tmp_path, monkeypatch, capsys) -> None:
    """Neither during the cut nor between the files of the new scene."""
    before = (room / "gaussians.ply").read_bytes()
    out = tmp_path / "out"
    words = ["edit", str(room), "-o", str(out), "--remove", "--layer", "objects", "--ids", "3"]

    def stop(*args, **kwargs):
        raise KeyboardInterrupt

    for where in ("splatseg.lift.boundaries.cut.sides_of", "splatseg.io.scene.save_layer"):
        with monkeypatch.context() as patch:
            patch.setattr(where, stop)
            assert main(words) == 1
        assert "interrupted" in capsys.readouterr().err
        assert sorted(p.name for p in tmp_path.iterdir()) == ["room"]
    assert (room / "gaussians.ply").read_bytes() == before
    assert main(words) == 0, "it can be done again under the same name"
    assert main(words) == 2, "and then it is there"
    assert f"{out}: expected a new folder" in capsys.readouterr().err.replace("\n", "")


def run(room, out, *words):
    return main(["edit", str(room), "-o", str(out), *map(str, words)])


def test_pictures_before_and_after(room, tmp_path, capsys) -> None:
    out = tmp_path / "out"
    assert run(room, out, "--remove", "--layer", "objects", "--ids", 3, "--pictures", 2) == 0
    said = capsys.readouterr().out
    assert "pictures before and after" in said
    reports = out / "reports"
    facts = json.loads((reports / "edit.json").read_text())
    assert facts["views"] == ["v0", "v1"], "the views that change most: they see most of it"
    assert facts["before"] == 400
    (step,) = facts["operations"]
    assert facts["after"] == 400 + step["added"] - step["selected"]
    page = (reports / "edit.html").read_text()
    assert page.count("<img") == 4
    assert f"{step['selected']} Gaussians selected" in page
    shots = re.findall(r'src="data:image/jpeg;base64,([^"]+)"', page)
    before, after = (
        np.asarray(Image.open(io.BytesIO(base64.b64decode(shot)))).astype(int) for shot in shots[:2]
    )
    assert np.abs(before - after).max() > 60, "what is gone is seen"
    without = tmp_path / "without"
    assert run(room, without, "--invert", "--box", 0, -9, -9, 9, 9, 9, "--move", 1, 0, 0) == 0
    assert (without / "reports" / "edit.html").is_file()
    none = tmp_path / "none"
    assert run(room, none, "--remove", "--layer", "objects", "--ids", 3, "--pictures", 0) == 0
    assert not any((none / "reports").iterdir())


def test_growth_by_splitting_is_said(room, tmp_path, capsys) -> None:
    thing = ["--remove", "--layer", "objects", "--names", "thing", "--pictures", 0]
    assert run(room, tmp_path / "split", *thing) == 0
    said = " ".join(capsys.readouterr().out.split())
    (edit,) = history(tmp_path / "split")
    added = edit["result"]["added"]
    assert added >= 2 * edit["result"]["split"] > 0
    assert f"splitting added {added} Gaussians, {added / 400:.0%} of the scene; --cut off" in said
    assert run(room, tmp_path / "whole", *thing, "--cut", "off") == 0
    assert "splitting added" not in capsys.readouterr().out
    assert history(tmp_path / "whole")[0]["result"]["added"] == 0


def test_selections_by_value_and_place(room, tmp_path) -> None:
    g = load_scene(room).gaussians
    size, far = g.scales.amax(dim=1), torch.linalg.vector_norm(g.means.double(), dim=1)
    grey = torch.linalg.vector_norm(g.colours.double() - 0.5, dim=1)
    for number, (words, gone) in enumerate(
        [
            (["--sphere", 0, 0, 0, 0.5], far <= 0.5),
            (["--size", 0.15, "inf"], size >= 0.15),
            (["--colour-near", 0.5, 0.5, 0.5, 0.2], grey <= 0.2),
            (["--sphere", 0, 0, 0, 0.5, "--size", 0.15, 9], (far <= 0.5) & (size >= 0.15)),
            (
                ["--sphere", 0, 0, 0, 0.5, "--size", 0.15, 9, "--match", "any"],
                (far <= 0.5) | (size >= 0.15),
            ),
            (["--opacity", 0.8, 1, "--invert", "--sphere", 0, 0, 0, 9], None),
        ]
    ):
        out = tmp_path / f"out{number}"
        code = run(room, out, "--remove", *words, "--pictures", 0)
        if gone is None:
            assert code == 2, "none is as opaque, and all others are all"
            continue
        assert code == 0
        assert 0 < int(gone.sum()) < 400
        assert torch.equal(load_scene(out).gaussians.means, g.means[~gone]), words


def test_one_piece_of_a_layer(room, tmp_path) -> None:
    """The wall's far half is moved away, so that the wall is two pieces."""
    apart = tmp_path / "apart"
    half = ["--layer", "objects", "--ids", 8, "--box", 0.8, -9, -9, 9, 9, 9, "--cut", "off"]
    assert run(room, apart, *half, "--move", 20, 0, 0, "--pictures", 0) == 0
    wall = ["--extract", "--layer", "objects", "--ids", 8, "--cut", "off", "--pictures", 0]
    assert run(apart, tmp_path / "near", *wall, "--largest-component") == 0
    assert run(apart, tmp_path / "far", *wall, "--component-at", 21, 0, 0) == 0
    near, far = (load_scene(tmp_path / n).gaussians.means[:, 0] for n in ("near", "far"))
    assert len(near) > len(far) > 20
    assert float(near.max()) < 1
    assert float(far.min()) > 20


def test_specks_go_along(room, tmp_path, capsys) -> None:
    """Three Gaussians of the thing that carry the wall's label, in the midst of the thing."""
    labels = load_scene_layer(room, "objects")
    means = load_scene(room).gaussians.means
    away = torch.linalg.vector_norm(means - torch.tensor([-1.2, 0, 0]), dim=1)
    specks = away.argsort()[:3]
    ids = labels.ids.clone()
    ids[specks] = 8
    save_scene_layer(replace(labels, ids=ids, candidates=None, shares=None), room, "objects")
    thing = ["--remove", "--layer", "objects", "--ids", 3, "--cut", "off", "--pictures", 0]
    assert run(room, tmp_path / "clean", *thing) == 0
    assert "3 of them specks" in " ".join(capsys.readouterr().out.split())
    (edit,) = history(tmp_path / "clean")
    assert edit["specks"] == 30
    assert edit["result"]["specks"] == 3
    left = load_scene(tmp_path / "clean").gaussians.means
    assert float(left[:, 0].min()) > -0.4
    assert run(room, tmp_path / "dirty", *thing, "--specks", 0) == 0
    assert len(load_scene(tmp_path / "dirty").gaussians) == len(left) + 3
    assert "specks" not in history(tmp_path / "dirty")[0]
    twice = ["--duplicate", "--layer", "objects", "--ids", 8, "--cut", "off", "--move", 0, 0, 9]
    assert run(tmp_path / "clean", tmp_path / "twice", *twice) == 0
    assert run(tmp_path / "twice", tmp_path / "again", "--undo") == 0
    again = load_scene(tmp_path / "again").gaussians
    assert torch.equal(again.means, left), "undo does it again, specks included"


def test_what_was_hidden_is_filled(room, tmp_path, capsys) -> None:
    thing = ["--remove", "--layer", "objects", "--ids", 3, "--cut", "off", "--pictures", 0]
    assert run(room, tmp_path / "out", *thing, "--fill", "opencv") == 0
    (edit,) = history(tmp_path / "out")
    assert edit["fill"] == {"views": ["v0", "v1", "v2"], "inpainter": "opencv"}
    counts = edit["result"]
    scene = load_scene(tmp_path / "out")
    assert len(scene.gaussians) == counts["after"]
    assert len(load_scene_layer(tmp_path / "out", "objects")) == counts["after"]
    said = " ".join(capsys.readouterr().out.split())
    assert f"filled with {counts['filled']} Gaussians what was hidden" in said
