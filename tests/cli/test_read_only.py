"""Where nothing can be written every command says so before its work, with the status of input."""

import builtins
import errno
import io
import os
from pathlib import Path

import pytest
import torch

from splatseg.cli import COMMANDS, main
from splatseg.core import Labels
from splatseg.io.scene import load_scene, save_scene_layer
from splatseg.io.splats import write_splats

LINES = {
    "fit": "fit CAPTURE -o HERE/made --steps 10",
    "import": "import PLY -o HERE/made --max-views 2",
    "chunks": "chunks SCENE -o HERE/made",
    "doctor": "doctor CAPTURE --fix HERE/made",
    "see": "see SCENE --model classical --evidence new",
    "segment": "segment SCENE --method uplift --evidence labels_semantic --layer classes",
    "street": "street SCENE --evidence labels_semantic --iterations 2",
    "select": "select SCENE --view train_0 --point 8,15 --layer picked",
    "query": "query SCENE chair --layer picked",
    "view": "view SCENE --no-open",
    "render": "render SCENE --split all -o HERE/made",
    "evaluate": "evaluate SCENE --layer classes --truth CAPTURE/semantic --json-file HERE/a.json",
    "bench": "bench cosseg-replica-semantic --data CAPTURE -o HERE/made",
    "edit": "edit SCENE -o HERE/made --remove --box 0 0 0 1 1 1",
    "sharpen": "sharpen SCENE -o HERE/made --layer classes",
    "export": "export SCENE --what splat -o HERE/made.ply",
    "attach": "attach SCENE PLY -o HERE/made",
    "demo": "demo -o HERE/made",
}
READERS = {"info", "completion"}
OTHERS = {"bench"}  # of other distributions


def close(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let nothing be written below a folder, as on a disk that is mounted so; root is told too."""

    def refuse(path) -> None:
        if Path(os.fsdecode(path)).absolute().is_relative_to(folder):
            raise OSError(errno.EROFS, os.strerror(errno.EROFS), os.fsdecode(path))

    def guarded(function, writes):
        def call(path, *words, **more):
            if not isinstance(path, int) and writes(*words, **more):
                refuse(path)
            return function(path, *words, **more)

        return call

    flags = os.O_WRONLY | os.O_RDWR | os.O_CREAT
    opened = guarded(io.open, lambda mode="r", *words, **more: bool(set(mode) & set("wax+")))
    monkeypatch.setattr(os, "open", guarded(os.open, lambda how, *words, **more: bool(how & flags)))
    monkeypatch.setattr(io, "open", opened)
    monkeypatch.setattr(builtins, "open", opened)
    for name in ("mkdir", "rename", "replace", "unlink", "rmdir", "utime"):
        monkeypatch.setattr(os, name, guarded(getattr(os, name), lambda *words, **more: True))


def test_every_command_is_here() -> None:
    assert set(LINES) | READERS == set(COMMANDS) | OTHERS


@pytest.mark.parametrize("command", LINES)
def test_a_refusal_before_work_is_one_status(command, small, tmp_path, monkeypatch, capsys) -> None:
    scene = load_scene(small.scene)
    ids = torch.full((len(scene.gaussians),), 2)
    save_scene_layer(Labels(ids=ids, confidence=torch.ones(len(ids))), small.scene, "classes")
    places = {"SCENE": small.scene, "CAPTURE": small.capture, "PLY": tmp_path / "small" / "a.ply"}
    write_splats(scene.gaussians, places["PLY"])
    places["HERE"] = tmp_path / "small"
    line = LINES[command]
    for word, path in places.items():
        line = line.replace(word, str(path))
    before = sorted((tmp_path / "small").rglob("*"))
    with monkeypatch.context() as patched:
        close(tmp_path / "small", patched)
        status = main([*line.split(), *(["--quiet"] if command != "doctor" else [])])
    message = capsys.readouterr().err
    assert (status, "cannot be written: it lies on a disk that can only be read" in message) == (
        2, True
    ), message  # fmt: skip
    assert message.count("\n") == 1
    assert sorted((tmp_path / "small").rglob("*")) == before
