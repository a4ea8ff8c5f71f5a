"""Refusals and failures leave no trace, signals end every command, and closed streams no work."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
import torch

from splatseg.cli import main
from splatseg.errors import FileFormatError
from splatseg.io.evidence import evidence_header, open_evidence
from splatseg.io.images import load_image
from splatseg.io.json_files import read_json, write_json
from splatseg.io.scene import load_scene
from splatseg.io.scene_folder import CHECKPOINT_FILE, scene_lock
from splatseg.models import EvidenceRequest, record_evidence
from splatseg.models.classical import Classical
from splatseg.render.cpu import threads

SEE = ("--model", "classical", "--evidence", "masks")


def entries(folder: Path) -> list[str]:
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*"))


def test_a_failed_see_leaves_no_folder(small, splatseg) -> None:
    before = entries(small.scene)
    first = small.capture / "images" / "train_0.png"
    photograph = first.read_bytes()
    first.write_bytes(photograph[:60])
    status, _, err = splatseg("see", small.scene, *SEE)
    assert status == 2, err
    assert entries(small.scene) == before
    first.write_bytes(photograph)
    assert splatseg("see", small.scene, *SEE)[0] == 0
    assert open_evidence(small.scene / "evidence" / "masks").view_names


def test_views_that_a_model_saw_stay_if_a_later_one_fails(small, splatseg) -> None:
    last = small.capture / "images" / "train_3.png"
    photograph = last.read_bytes()
    last.write_bytes(photograph[:60])
    assert splatseg("see", small.scene, *SEE)[0] == 2
    folder = small.scene / "evidence" / "masks"
    assert open_evidence(folder, unfinished="allow").view_names == ("train_0", "train_1")
    last.write_bytes(photograph)
    status, out, _ = splatseg("see", small.scene, *SEE)
    assert status == 0
    assert "2 of them were there" in out


def test_copied_evidence_that_fails_leaves_no_folder(small, splatseg) -> None:
    recorded = small.capture / "labels_semantic"
    whole = (recorded / "train_3.png").read_bytes()
    (recorded / "train_3.png").write_bytes(whole[:50])
    words = ("see", small.scene, "--model", recorded, "--evidence", "copied")
    assert splatseg(*words)[0] == 2
    assert not (small.scene / "evidence" / "copied").exists()
    (recorded / "train_3.png").write_bytes(whole)
    assert splatseg(*words)[0] == 0


def test_a_header_without_views_bars_nobody(small, splatseg) -> None:
    """What a kill before the first view leaves."""
    folder = small.scene / "evidence" / "masks"
    assert splatseg("see", small.scene, *SEE)[0] == 0
    header = read_json(folder / "evidence.json")
    for path in folder.glob("train_*"):
        path.unlink()
    header["metadata"]["complete"] = False
    write_json(header, folder / "evidence.json")
    status, _, err = splatseg("see", small.scene, *SEE, "--min-area", "0.02")
    assert status == 0, err
    found = evidence_header(folder)
    assert found is not None
    assert found["metadata"]["settings"]["regions"]["min_area"] == 0.02


@pytest.mark.parametrize("ending", [KeyboardInterrupt, FileFormatError])
def test_old_evidence_stays_until_the_new_is_complete(small, splatseg, ending) -> None:
    assert splatseg("see", small.scene, *SEE)[0] == 0
    folder = small.scene / "evidence" / "masks"
    before = {path.name: path.read_bytes() for path in folder.iterdir()}

    def stop(done: int, total: int) -> None:
        if done == 2:
            raise ending("stop")

    views = load_scene(small.scene, data=small.capture).train_views
    with pytest.raises(ending):
        record_evidence(Classical(), views, folder, EvidenceRequest(overwrite=True), progress=stop)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    assert (folder.parent / ".splatseg-see-masks").is_dir()
    seen = record_evidence(Classical(), views, folder, EvidenceRequest(overwrite=True))
    assert seen.kept == 2, "it goes on"
    assert [path.name for path in folder.parent.iterdir()] == ["masks"]
    assert sorted(path.name for path in folder.iterdir()) == sorted(before)


@pytest.mark.parametrize(
    "words",
    [
        ("see", *SEE),
        ("segment", "--method", "uplift", "--evidence", "labels_semantic", "--layer", "classes"),
    ],
)
def test_a_scene_that_another_process_works_on(small, splatseg, monkeypatch, words) -> None:
    program = (
        "import sys, time; from pathlib import Path\n"
        "from splatseg.io.scene_folder import scene_lock\n"
        "with scene_lock(Path(sys.argv[1]), 'fit'):\n  print(flush=True); time.sleep(60)"
    )
    with subprocess.Popen(
        [sys.executable, "-c", program, str(small.scene)], stdout=subprocess.PIPE
    ) as holder:
        assert holder.stdout is not None
        holder.stdout.readline()
        before = entries(small.scene)
        status, out, err = splatseg(words[0], small.scene, *words[1:])
        assert (status, out) == (2, "")
        assert f"another splatseg works on this scene (fit, process {holder.pid}" in err
        assert entries(small.scene) == before
        told = json.loads(splatseg("info", small.scene, "--json")[1])
        assert told["running"]["process"] == holder.pid
        assert f"a process works on it (fit, process {holder.pid}" in " ".join(told["notes"])
        holder.kill()
    status, _, err = splatseg(words[0], small.scene, *words[1:])
    assert status == 0, err
    assert json.loads(splatseg("info", small.scene, "--json")[1])["running"] is None


def test_info_tells_a_running_fit_from_a_stopped_one(tmp_path, splatseg) -> None:
    (tmp_path / CHECKPOINT_FILE).parent.mkdir()
    assert "fit that was stopped before its first checkpoint" in splatseg("info", tmp_path)[1]
    with scene_lock(tmp_path, "fit"):
        out = splatseg("info", tmp_path)[1]
        assert f"fit, running, process {os.getpid()}; no checkpoint yet" in out


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGINT])
def test_signals_end_a_see_half_way(small, splatseg, monkeypatch, number) -> None:
    """What is under way in other threads is waited for, nothing further is begun."""
    masks, seen = Classical.masks, []
    first = load_image(load_scene(small.scene).view("train_0"))
    folder = small.scene / "evidence" / "masks"

    def slow(self: Classical, image: torch.Tensor) -> object:
        if not torch.equal(image, first):
            seen.append(image)
            if len(seen) == 1:
                while not (folder / "train_0.json").is_file():
                    time.sleep(0.01)
                signal.pthread_kill(threading.main_thread().ident or 0, number)
            time.sleep(0.5)
        return masks(self, image)

    monkeypatch.setattr(Classical, "masks", slow)
    # What a shell starts in the background ignores Ctrl-C, what nohup starts ignores hang-ups, and
    # tests may run there.
    handlers = dict.fromkeys((signal.SIGTERM, signal.SIGHUP), signal.SIG_DFL)
    handlers[signal.SIGINT] = signal.default_int_handler
    before = {one: signal.signal(one, handler) for one, handler in handlers.items()}
    began = time.monotonic()
    try:
        status, _, err = splatseg("see", small.scene, *SEE)
        assert {one: signal.getsignal(one) for one in handlers} == handlers, "as it was before"
    finally:
        for one, handler in before.items():
            signal.signal(one, handler)
    assert time.monotonic() - began < 15
    assert status == 1
    assert "interrupted" in err
    assert len(seen) <= threads()
    assert open_evidence(folder, unfinished="allow").view_names == ("train_0",)
    assert not list(small.scene.rglob(".splatseg*"))
    assert "1 of them were there" in splatseg("see", small.scene, *SEE)[1]


def test_an_ignored_hangup_stays_ignored(small, splatseg) -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        signal.raise_signal(signal.SIGHUP)
        assert splatseg("info", small.scene)[0] == 0
        assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


PROGRAM = "import sys, splatseg.cli; sys.exit(splatseg.cli.main())"


@pytest.mark.parametrize(
    ("redirection", "status"), [(">&-", 0), (">&- 2>&-", 0), (">/dev/full", 1)]
)
def test_closed_and_full_streams_give_no_traceback(redirection, status) -> None:
    done = subprocess.run(
        ["sh", "-c", f'"$0" -c "{PROGRAM}" --help {redirection}', sys.executable],
        capture_output=True,
        text=True,
    )
    assert "Traceback" not in done.stderr
    assert "Exception ignored" not in done.stderr
    assert done.returncode == status
    if status:
        assert "the disk is full" in done.stderr


def test_a_reader_that_goes_away_does_not_end_the_work(small, monkeypatch) -> None:
    """Progress and remarks are worth no failure; only the result is."""
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "w") as gone:
        monkeypatch.setattr(sys, "stderr", gone)
        assert main(["see", str(small.scene), *SEE]) == 0
        assert open_evidence(small.scene / "evidence" / "masks").view_names
        gone.flush()


def test_names_that_are_no_utf8_are_shown_with_escapes(tmp_path, splatseg) -> None:
    bad = Path(os.fsdecode(bytes(tmp_path) + b"/caf\xe9"))
    bad.mkdir()
    status, _, err = splatseg("info", bad)
    assert status == 2
    err.encode()


def test_the_json_file_is_looked_at_before_the_scores(small, splatseg) -> None:
    status, _, err = splatseg(
        *("evaluate", small.scene, "--layer", "none", "--truth", small.capture / "semantic"),
        *("--json-file", small.scene / "nowhere" / "a.json"),
    )
    assert status == 2
    assert "a.json: expected a place in a folder that is there" in err


def test_ctrl_c_that_breaks_an_import_off_is_no_error(splatseg, monkeypatch) -> None:
    from splatseg import cli

    def fails(entry: object, name: str, words: list[str]) -> int:
        try:
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(5)
        except KeyboardInterrupt:
            raise ImportError("cannot load module more than once per process") from None
        return 0

    monkeypatch.setattr(cli, "_run", fails)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        assert splatseg("info", "x")[::2] == (1, "interrupted\n")
    finally:
        signal.signal(signal.SIGINT, before)
    monkeypatch.setattr(cli, "_run", lambda *_: 1 // 0)
    assert "ZeroDivisionError" in splatseg("info", "x")[2]
