"""``splatseg fit`` from the command line's side: what it writes, says and refuses."""

import json
import os
import signal
import threading
from pathlib import Path

import pytest
import torch

from splatseg.cli import main
from splatseg.core import Capture, Labels
from splatseg.fit import recorded_exposures
from splatseg.io.scene import load_scene, save_scene_layer


@pytest.fixture
def folder(capture: Capture) -> Path:
    """The tiny capture as a nerfstudio folder."""
    root = capture.path
    frames = []
    for view in capture.views:
        pose = torch.linalg.inv(view.camera.cam_from_world) @ torch.diag(
            torch.tensor([1.0, -1, -1, 1], dtype=torch.float64)
        )
        frames.append(
            {
                "file_path": f"{view.name}.png",
                "transform_matrix": pose.tolist(),
                "split": view.split,
            }
        )
    camera = capture.views[0].camera
    content = {
        "w": camera.width,
        "h": camera.height,
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
        "frames": frames,
        "ply_file_path": "points.ply",
        "train_filenames": [f"{v.name}.png" for v in capture.train_views],
        "val_filenames": [],
        "test_filenames": [f"{v.name}.png" for v in capture.test_views],
    }
    (root / "transforms.json").write_text(json.dumps(content))
    assert capture.points is not None
    rows = "\n".join(
        " ".join(map(str, point.tolist() + colour.tolist()))
        for point, colour in zip(capture.points.points, capture.points.colours, strict=True)
    )
    names = "".join(f"property float {n}\n" for n in "xyz")
    names += "".join(f"property uchar {n}\n" for n in ("red", "green", "blue"))
    (root / "points.ply").write_text(
        f"ply\nformat ascii 1.0\nelement vertex {len(capture.points)}\n{names}end_header\n{rows}\n"
    )
    return root


def test_a_scene_is_written_and_scored(folder: Path, tmp_path: Path, capsys) -> None:
    scene_path = tmp_path / "scene"
    words = ["fit", str(folder), "-o", str(scene_path), "--steps", "60", "--seed", "4"]
    assert main([*words, "--max-gaussians", "80"]) == 0
    output = capsys.readouterr().out
    assert str(scene_path) in output
    assert "11 training views, 3 held out, 60 start points" in output
    assert "dB on 3 held-out views" in output

    scene = load_scene(scene_path)
    assert 0 < len(scene.gaussians) <= 80
    assert len(scene.train_views) == 11
    assert [view.name for view in scene.test_views] == ["view_02", "view_07", "view_12"]
    record = scene.provenance
    assert record["steps"] == 60
    assert record["seed"] == 4
    assert record["seconds"] > 0
    assert record["interrupted"] is False
    assert record["options"]["max_gaussians"] == 80
    assert record["options"]["minutes"] is None
    assert set(record["versions"]) == {"splatseg", "torch"}


def test_exposures_go_into_the_scene(folder: Path, tmp_path: Path) -> None:
    words = ["fit", str(folder), "--steps", "12", "--max-gaussians", "80"]
    assert main([*words, "-o", str(tmp_path / "plain")]) == 0
    assert "exposures" not in load_scene(tmp_path / "plain").provenance
    assert main([*words, "-o", str(tmp_path / "freed"), "--exposure"]) == 0
    scene = load_scene(tmp_path / "freed")
    found = recorded_exposures(scene.provenance)
    assert sorted(found) == sorted(view.name for view in scene.train_views)
    assert any(one.gain != (1.0, 1.0, 1.0) for one in found.values())


def test_how_often_a_checkpoint_is_written_is_asked_for(
    folder: Path, tmp_path: Path, capsys, monkeypatch
) -> None:
    """A billionth of a second passes in 20 steps, a billion seconds do not."""
    from splatseg.fit import _checkpoint

    written: list[int] = []
    monkeypatch.setattr(
        _checkpoint.CheckpointClock, "write", lambda self, *_, **__: written.append(1) or 0.0
    )
    scene = str(tmp_path / "scene")
    for seconds, expected in (("1e-9", True), ("1e9", False)):
        written.clear()
        words = ["fit", str(folder), "-o", scene, "--steps", "20", "--checkpoint-every", seconds]
        assert main([*words, "--max-gaussians", "80", "--overwrite"]) == 0
        assert bool(written) is expected
    assert main(["fit", str(folder), "-o", scene, "--checkpoint-every", "0"]) == 2
    assert "--checkpoint-every: expected more than 0" in capsys.readouterr().err


def test_without_points_it_says_where_it_starts(folder: Path, tmp_path: Path, capsys) -> None:
    words = ["fit", str(folder), "-o", str(tmp_path / "scene"), "--steps", "5"]
    assert main([*words, "--start", "random", "--max-gaussians", "90"]) == 0
    assert "starting at 90 places where photographs agree" in capsys.readouterr().out
    assert load_scene(tmp_path / "scene").provenance["options"]["start"] == "random"


def test_same_command_same_file(folder: Path, tmp_path: Path) -> None:
    files = []
    for name in ("a", "b"):
        assert main(["fit", str(folder), "-o", str(tmp_path / name), "--steps", "40"]) == 0
        files.append((tmp_path / name / "gaussians.ply").read_bytes())
    assert files[0] == files[1]


def test_ctrl_c_leaves_a_scene_that_loads(folder: Path, tmp_path: Path, capsys) -> None:
    timer = threading.Timer(1.0, os.kill, (os.getpid(), signal.SIGINT))
    timer.start()
    status = main(["fit", str(folder), "-o", str(tmp_path / "scene"), "--minutes", "5"])
    timer.join()
    assert status == 1
    output = capsys.readouterr().out
    assert "Gaussians stopped after" in output
    assert "the same command with --resume goes on" in output
    scene = load_scene(tmp_path / "scene")
    assert scene.provenance["interrupted"] is True
    scene.gaussians.check_values()


def test_a_scene_without_layers_is_replaced(folder: Path, tmp_path: Path, capsys) -> None:
    words = ["fit", str(folder), "-o", str(tmp_path / "scene"), "--steps"]
    assert main([*words, "2"]) == 0
    assert main([*words, "3"]) == 0
    scene = load_scene(tmp_path / "scene")
    assert scene.provenance["steps"] == 3
    labels = Labels(
        ids=torch.ones(len(scene.gaussians), dtype=torch.int32),
        confidence=torch.ones(len(scene.gaussians)),
    )
    save_scene_layer(labels, tmp_path / "scene", "semantic")
    capsys.readouterr()
    assert main([*words, "4"]) == 2
    assert "got a scene with layers (semantic)" in capsys.readouterr().err


def test_what_cannot_be_done_is_said_before_the_work(folder: Path, tmp_path: Path, capsys) -> None:
    def refused(*words: str) -> str:
        assert main(["fit", *words]) == 2
        return capsys.readouterr().err

    scene = str(tmp_path / "scene")
    assert "--minutes, --steps: expected one of the two" in refused(
        str(folder), "-o", scene, "--steps", "2", "--minutes", "1"
    )
    assert "expected an empty folder or a new one" in refused(
        str(folder), "-o", str(folder), "--steps", "2"
    )
    assert "expected a place in a folder that is there" in refused(
        str(folder), "-o", str(tmp_path / "no" / "scene"), "--steps", "2"
    )
    file = tmp_path / "file"
    file.write_text("x")
    assert "expected a folder to write to, got a file" in refused(
        str(folder), "-o", str(file), "--steps", "2"
    )
    assert "no_such" in refused(str(tmp_path / "no_such"), "-o", scene)
    assert "--max-gaussians" in refused(str(folder), "-o", scene, "--max-gaussians", "0")
    (folder / "points.ply").unlink()
    content = json.loads((folder / "transforms.json").read_text())
    del content["ply_file_path"]
    (folder / "transforms.json").write_text(json.dumps(content))
    assert "start points" in refused(str(folder), "-o", scene, "--steps", "2", "--start", "points")
    assert not Path(scene).exists()


def _stopped(folder: Path, scene: Path, *words: str) -> None:
    timer = threading.Timer(1.0, os.kill, (os.getpid(), signal.SIGINT))
    timer.start()
    assert main(["fit", str(folder), "-o", str(scene), "--minutes", "5", *words]) == 1
    timer.join()


def test_a_stopped_fit_is_resumed_or_begun_again(folder: Path, tmp_path: Path, capsys) -> None:
    scene = tmp_path / "scene"
    words = ["fit", str(folder), "-o", str(scene)]
    _stopped(folder, scene)
    steps = load_scene(scene).provenance["steps"]
    checkpoint = scene / "fit" / "checkpoint.npz"
    assert checkpoint.is_file()
    assert main(["info", str(scene)]) == 0
    assert f"its fit was stopped at step {steps} (" in capsys.readouterr().out

    assert main([*words, "--minutes", "5"]) == 2
    output = capsys.readouterr().err
    assert f"got a fit that was stopped at step {steps} (" in output
    assert "--resume continues it, --overwrite begins again" in output
    assert main([*words, "--steps", str(steps + 9), "--resume", "--seed", "8"]) == 2
    assert "seed 0 instead of 8" in capsys.readouterr().err
    assert main([*words, "--resume", "--overwrite"]) == 2
    assert "--resume, --overwrite: expected one of the two" in capsys.readouterr().err

    assert main([*words, "--steps", str(steps + 9), "--resume"]) == 0
    assert f"{scene}: going on from step {steps} (" in capsys.readouterr().out
    assert load_scene(scene).provenance["steps"] == steps + 9
    assert load_scene(scene).provenance["interrupted"] is False
    assert not checkpoint.parent.exists()
    assert main([*words, "--steps", "9", "--resume"]) == 2
    assert "got a scene without a checkpoint" in capsys.readouterr().err
    _stopped(folder, scene)
    assert main([*words, "--steps", "9", "--overwrite"]) == 0
    assert load_scene(scene).provenance["steps"] == 9
    assert not checkpoint.parent.exists()


def test_a_kept_checkpoint_makes_a_finished_fit_longer(
    folder: Path, tmp_path: Path, capsys
) -> None:
    scene = tmp_path / "scene"
    words = ["fit", str(folder), "-o", str(scene), "--keep-checkpoint", "--steps"]
    assert main([*words, "20", "--resume"]) == 0
    assert "nothing to go on from, beginning" in capsys.readouterr().out
    assert main([*words, "30", "--resume"]) == 0
    assert "going on from step 20 (100 %" in capsys.readouterr().out
    assert load_scene(scene).provenance["steps"] == 30
    assert main(["info", str(scene)]) == 0
    assert "stopped" not in capsys.readouterr().out
    assert main([*words, "5"]) == 0, "a finished scene is replaced, with its checkpoint"
    assert load_scene(scene).provenance["steps"] == 5


def test_a_fit_that_an_older_build_left_stopped(
    folder: Path, tmp_path: Path, capsys, monkeypatch
) -> None:
    """It cannot be resumed, and that is said in a sentence; it can be begun again."""
    from splatseg.fit import _checkpoint

    scene = tmp_path / "scene"
    words = ["fit", str(folder), "-o", str(scene), "--steps", "5"]
    with monkeypatch.context() as patch:
        patch.setattr(_checkpoint, "VERSION", 0)
        assert main([*words, "--keep-checkpoint"]) == 0
    capsys.readouterr()
    assert main([*words, "--resume"]) == 2
    output = capsys.readouterr().err
    assert "this fit cannot be resumed" in output
    assert len(output.strip().splitlines()) == 1
    assert main(words) == 2
    output = capsys.readouterr().err
    assert "was stopped by another splatseg and cannot be resumed; --overwrite begins" in output
    assert "--resume" not in output
    assert main([*words, "--overwrite"]) == 0


def test_a_folder_with_a_checkpoint_alone_is_known(folder: Path, tmp_path: Path, capsys) -> None:
    """What is left of a process that was killed."""
    scene = tmp_path / "scene"
    words = ["fit", str(folder), "-o", str(scene), "--steps", "20"]
    assert main([*words, "--keep-checkpoint"]) == 0
    for path in scene.iterdir():
        if path.name == "scene.json":
            path.unlink()
    (scene / ".splatseg-rest").mkdir()
    capsys.readouterr()
    assert main(["info", str(scene)]) == 0
    output = capsys.readouterr().out
    assert "unfinished fit, 100 % done: " in output
    assert "Gaussians after 20 steps" in output
    assert main([*words, "--resume"]) == 0
    assert load_scene(scene).provenance["steps"] == 20
    (scene / "scene.json").unlink()
    (scene / "fit").mkdir()
    capsys.readouterr()
    assert main(["info", str(scene)]) == 0
    assert "stopped before its first checkpoint" in capsys.readouterr().out
    (scene / "fit" / "checkpoint.npz").write_bytes(b"PK nothing")
    assert main([*words, "--resume"]) == 2
    assert "checkpoint.npz: expected the checkpoint of a fit" in capsys.readouterr().err
    assert main(words) == 2
    assert "was stopped and has a damaged checkpoint" in capsys.readouterr().err
    (scene / "holiday.jpg").write_bytes(b"mine")
    assert main([*words, "--overwrite"]) == 2
    assert "expected an empty folder or a new one" in capsys.readouterr().err
    (scene / "holiday.jpg").unlink()
    assert main([*words, "--overwrite"]) == 0
    assert not (scene / "fit").exists()


def test_a_capture_that_lacks_photographs(folder, tmp_path, capsys) -> None:
    """They are named, in the report too; --strict refuses the capture."""
    lost = folder / f"{sorted(p.stem for p in folder.glob('*.png'))[3]}.png"
    lost.unlink()
    words = ["fit", str(folder), "-o", str(tmp_path / "s"), "--steps", "2"]
    assert main([*words, "--strict"]) == 2
    sentence = capsys.readouterr().err
    assert "photographs that it lists are not there, expected all of them" in sentence
    assert lost.name in sentence
    assert not (tmp_path / "s").exists()
    assert main(words) == 0
    assert f"is not there and left out ({lost.name})" in capsys.readouterr().err
    assert lost.stem not in {view.name for view in load_scene(tmp_path / "s").views}
    assert lost.name in (tmp_path / "s" / "reports" / "fit.html").read_text()
