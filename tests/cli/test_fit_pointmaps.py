"""``splatseg fit --poses pointmaps``: photographs of the generated room, and what was said of them.

The cameras are compared with those that the room was photographed with.
"""

import json
import shutil
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest
import torch

from splatseg.core import Pointmap
from splatseg.io.captures import read_capture
from splatseg.io.depths import read_depth_map
from splatseg.io.images import load_image
from splatseg.io.pointmaps import create_pointmaps
from splatseg.io.scene import load_scene
from splatseg.models import ENTRY_POINT_GROUP, _registry
from splatseg_bench.worlds import PointmapErrors, SyntheticPointmaps, synthetic_pointmaps
from support.pointmaps import camera_errors

QUICK = ("--steps", 40, "--max-gaussians", 1500, "--backend", "cpu")
ERRORS = PointmapErrors(outliers=0.1)
HERE = __name__


@pytest.fixture(scope="module")
def room(generated_room: Path):
    """Cameras, depths and files of every second of the room's train views, by file name."""
    views = [view for view in read_capture(generated_room).train_views if view.image is not None]
    views = views[::2]
    cameras = {view.image.name: view.camera for view in views}
    maps = {
        view.image.name: read_depth_map(generated_room / "depth" / f"{view.name}.png", unit=1e-3)
        for view in views
    }
    # Depth is of every second pixel; of cells of eight it takes the one in the middle.
    depths = {name: one.values[2::4, 2::4] for name, one in maps.items()}
    return cameras, depths, {view.image.name: view.image for view in views}


@pytest.fixture(scope="module")
def answers(room) -> SyntheticPointmaps:
    cameras, depths, _ = room
    pairs = [(a, b) for a in cameras for b in cameras if a != b]
    return synthetic_pointmaps(cameras, depths, pairs, errors=ERRORS)


@pytest.fixture
def photographs(room, tmp_path: Path) -> Path:
    folder = tmp_path / "photos"
    folder.mkdir()
    for path in room[2].values():
        shutil.copy(path, folder)
    return folder


@pytest.fixture
def recorded(room, answers, tmp_path: Path) -> Path:
    names = sorted(room[0])
    kept = create_pointmaps(tmp_path / "said", photographs=names, metadata={"model": "generated"})
    for i, a in enumerate(names):
        for step in (1, 2, 4):
            b = names[(i + step) % len(names)]
            for one, two in ((a, b), (b, a)):
                kept.save(one, two, answers.pointmaps(one, two))
    return tmp_path / "said"


def _errors(scene: Path, room):
    found = {view.image.name: view.camera for view in load_scene(scene).views}
    return camera_errors(found, room[0])


def test_a_scene_of_recorded_pointmaps(splatseg, room, photographs, recorded, tmp_path) -> None:
    scene = tmp_path / "scene"
    words = ("fit", photographs, "-o", scene, "--poses", "pointmaps", "--pointmaps", recorded)
    status, out, err = splatseg(*words, *QUICK)
    assert status == 0, err
    assert "8 photographs placed by 40 pairs of pointmaps (said)" in out
    assert "pairs contradict the rest and were left out" in out
    off = _errors(scene, room)
    assert off.rotation.max() < 1.0
    assert off.centre.max() < 0.02
    assert abs(off.focal).max() < 0.01
    assert len(load_scene(scene).gaussians) <= 1500
    record = json.loads((scene / "reports" / "fit.json").read_text())
    assert record["poses"]["pairs"] == 40
    assert "poses: residual" in (scene / "reports" / "fit.html").read_text()
    # The folder beside the photographs needs no name, and what was found is not found again.
    shutil.copytree(recorded, photographs / "pointmaps")
    again = ("fit", photographs, "-o", scene, "--poses", "pointmaps", "--overwrite")
    status, out, err = splatseg(*again, *QUICK)
    assert status == 0, err
    assert "placed by 40 pairs of pointmaps (pointmaps)" in out
    status, out, err = splatseg(*again, *QUICK)
    assert "(as found before;" in out


def test_a_fixed_fit_keeps_as_many_points_as_asked(
    splatseg, photographs, recorded, tmp_path
) -> None:
    scene = tmp_path / "scene"
    words = ("fit", photographs, "-o", scene, "--poses", "pointmaps", "--pointmaps", recorded)
    status, out, err = splatseg(*words, *QUICK, "--strategy", "fixed", "--no-prune-floaters")
    assert status == 0, err
    assert "1500 start points" in out
    assert len(load_scene(scene).gaussians) == 1500


class Knows:
    """A network: it knows photographs by what they show."""

    name, settings, note = "knows", {"size": 64}, ""
    answers: SyntheticPointmaps
    seen: dict[int, str]

    def pointmaps(self, first: torch.Tensor, second: torch.Tensor) -> tuple[Pointmap, Pointmap]:
        one, two = (self.seen[int(image.long().sum())] for image in (first, second))
        return self.answers.pointmaps(one, two)


class Blind:
    """A model that gives no pointmaps."""

    name, settings, note = "blind", {}, ""


@pytest.fixture
def installed(monkeypatch, room, answers) -> None:
    """Two models of another package, by its entry points."""
    views = {view.image.name: view for view in _views(room)}
    Knows.answers = answers
    Knows.seen = {int(load_image(view).long().sum()): name for name, view in views.items()}
    entries = [
        EntryPoint(name=one.lower(), value=f"{HERE}:{one}", group=ENTRY_POINT_GROUP)
        for one in ("Knows", "Blind")
    ]
    monkeypatch.setattr(
        _registry, "entry_points", lambda group: entries if group == ENTRY_POINT_GROUP else []
    )


def _views(room):
    from splatseg.core import View

    return [View(name=n, camera=room[0][n], image=path) for n, path in room[2].items()]


@pytest.mark.usefixtures("installed")
def test_a_network_of_another_package(splatseg, room, photographs, tmp_path) -> None:
    scene = tmp_path / "scene"
    words = ("fit", photographs, "-o", scene, "--poses", "pointmaps", "--pointmaps")
    status, out, err = splatseg(*words, "knows", *QUICK)
    assert status == 0, err
    assert "8 photographs placed by 56 pairs of pointmaps (knows)" in out
    assert _errors(scene, room).rotation.max() < 1.0
    assert len(list((scene / "capture" / "pointmaps").glob("*.npz"))) == 56
    status, _, err = splatseg(*words[:3], tmp_path / "b", *words[4:], "blind", *QUICK)
    assert status != 0
    assert "pointmaps: expected a model that gives pointmaps, got blind" in err


def test_what_cannot_be(splatseg, photographs, tmp_path) -> None:
    scene = tmp_path / "scene"
    words = ("fit", photographs, "-o", scene, *QUICK)
    for more, message in (
        (("--poses", "pointmaps"), "expected a folder of recorded ones or the name of a model"),
        (("--pointmaps", "x"), "pointmaps: expected none with --poses auto, got 'x'"),
        (
            ("--poses", "pointmaps", "--pointmaps", "nobody"),
            "expected a folder with pointmaps.json, or a model of another package, got 'nobody'",
        ),
        (("--poses", "pointmaps", "--pointmaps", photographs), "a folder of pointmaps, with"),
        (("--poses", "pointmaps", "--format", "colmap"), "with --poses pointmaps"),
    ):
        status, _, err = splatseg(*words, *more)
        assert status != 0
        assert message in err, err
        assert "Traceback" not in err
        assert not scene.exists()
    status, _, err = splatseg("fit", tmp_path / "no", "-o", scene, "--poses", "pointmaps", *QUICK)
    assert status != 0
    assert "there is no such folder of photographs" in err


def test_a_broken_pair_leaves_no_scene(splatseg, photographs, recorded, tmp_path) -> None:
    """Each in a sentence that names the file, and a second run works when it is mended."""
    scene = tmp_path / "scene"
    words = ("fit", photographs, "-o", scene, "--poses", "pointmaps", "--pointmaps", recorded)
    path = sorted(recorded.glob("*.npz"))[7]
    whole = path.read_bytes()
    for bad in (b"", whole[:1000], whole[:-100]):
        path.write_bytes(bad)
        status, _, err = splatseg(*words, *QUICK)
        assert status == 2
        assert path.name in err
        assert "Traceback" not in err
        assert not scene.exists()
    path.write_bytes(whole)
    assert splatseg(*words, *QUICK)[0] == 0
