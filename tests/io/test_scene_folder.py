"""One process on a scene; what a process that ended left does not bar the next."""

import fcntl
import json
import os
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from splatseg.errors import InputError
from splatseg.io.atomic import TEMPORARY, check_writable, sweep
from splatseg.io.scene_folder import LOCK_FILE, lock_owner, scene_lock, work_on_scene

HOLD = """
import sys, time
from pathlib import Path
from splatseg.io.scene_folder import scene_lock
with scene_lock(Path(sys.argv[1]), "fit"):
    print("held", flush=True)
    time.sleep(60)
"""


@pytest.fixture
def holder(tmp_path: Path):
    """Another process that works on `tmp_path`."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(tmp_path)], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "held\n"
    yield process
    process.kill()
    process.wait()
    process.stdout.close()


def test_a_second_process_is_refused_and_told_who_works(tmp_path: Path, holder) -> None:
    with (
        pytest.raises(InputError, match=rf"another splatseg works on .*fit, process {holder.pid}"),
        scene_lock(tmp_path, "see"),
    ):
        pass
    owner = lock_owner(tmp_path)
    assert owner is not None
    assert (owner.work, owner.process) == ("fit", holder.pid)
    holder.kill()
    holder.wait()
    assert (tmp_path / LOCK_FILE).is_file(), "a killed process leaves its file"
    assert lock_owner(tmp_path) is None, "which means nothing"
    with scene_lock(tmp_path, "see"):
        mine = lock_owner(tmp_path)
        assert mine is not None
        assert mine.process == os.getpid()
    assert not list(tmp_path.iterdir())


def test_blocks_of_one_process_lie_in_each_other(tmp_path: Path) -> None:
    with scene_lock(tmp_path, "segment"):
        with scene_lock(tmp_path / ".", "saving"):
            pass
        assert lock_owner(tmp_path) is not None, "the inner block does not give it back"
    assert lock_owner(tmp_path) is None


def test_without_locks_of_the_system_the_process_counts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def none(handle: int, operation: int) -> None:
        raise OSError(95, "Operation not supported")

    monkeypatch.setattr(fcntl, "flock", none)
    me = {"work": "fit", "process": os.getppid(), "host": os.uname().nodename, "since": 0.0}
    (tmp_path / LOCK_FILE).write_text(json.dumps(me))
    with pytest.raises(InputError, match="another splatseg"), scene_lock(tmp_path, "see"):
        pass
    (tmp_path / LOCK_FILE).write_text(json.dumps(me | {"process": _ended()}))
    with scene_lock(tmp_path, "see"):
        pass


def test_a_lock_file_of_another_kind_bars_nobody_and_leads_nowhere(tmp_path: Path) -> None:
    """What a scene from elsewhere may hold."""
    os.mkfifo(tmp_path / LOCK_FILE)
    assert lock_owner(tmp_path) is None
    (tmp_path / LOCK_FILE).unlink()
    precious = tmp_path / "precious"
    precious.write_text("content")
    (tmp_path / LOCK_FILE).symlink_to(precious)
    assert lock_owner(tmp_path) is None
    with pytest.raises(InputError, match="cannot be written"), scene_lock(tmp_path, "see"):
        pass
    assert precious.read_text() == "content"


def _ended() -> int:
    """Number of a process that has ended."""
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid


def test_sweeping_removes_what_ended_processes_left_and_nothing_else(tmp_path: Path) -> None:
    ended = _ended()
    left = tmp_path / f"{TEMPORARY}{ended}-abc"
    theirs = tmp_path / f"{TEMPORARY}{os.getppid()}-abc"
    held = tmp_path / f"{TEMPORARY}{ended}-def"
    for folder in (left, theirs, held, tmp_path / ".splatseg-see-masks", tmp_path / ".mine-1-a"):
        (folder / "x").mkdir(parents=True)
    handle = os.open(held, os.O_RDONLY)
    fcntl.flock(handle, fcntl.LOCK_EX)
    sweep(tmp_path)
    os.close(handle)
    assert not left.exists()
    assert theirs.exists(), "its process runs"
    assert held.exists(), "it is locked: the number is that of another container"
    assert (tmp_path / ".splatseg-see-masks").exists(), "work to go on with"
    assert (tmp_path / ".mine-1-a").exists()
    long_ago = time.time() - 7200
    os.utime(theirs, (long_ago, long_ago))
    sweep(tmp_path)
    assert not theirs.exists(), "nobody writes for two hours without a lock"


@pytest.mark.parametrize("aside", ["previous", "previous.old"])
def test_a_kill_between_the_two_renames_is_finished(tmp_path: Path, aside: str) -> None:
    name = "previous" if aside == "previous.old" else "rgb"
    holder = tmp_path / f"{TEMPORARY}{_ended()}-abc"
    (holder / name).mkdir(parents=True)
    (holder / name / "new").touch()
    (holder / aside).mkdir()
    sweep(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == [name]
    assert (tmp_path / name / "new").exists()


def test_a_lock_whose_file_its_owner_has_just_removed_is_taken_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Between opening and locking the file its owner may end: who locks it then locks nothing."""
    from splatseg.io import scene_folder as lock

    ends = [lambda: (tmp_path / LOCK_FILE).unlink()]

    def try_lock(handle: int, **more: bool) -> str:
        if ends:
            ends.pop()()
        return real(handle, **more)

    real = lock.try_lock
    monkeypatch.setattr(lock, "try_lock", try_lock)
    with scene_lock(tmp_path, "fit"):
        owner = lock_owner(tmp_path)
        assert owner is not None
        assert owner.process == os.getpid()


def test_what_a_longer_file_said_before_is_gone(tmp_path: Path) -> None:
    (tmp_path / LOCK_FILE).write_text(" " * 1000 + "{")
    with scene_lock(tmp_path, "fit"):
        owner = lock_owner(tmp_path)
        assert owner is not None
        assert (owner.work, owner.process) == ("fit", os.getpid())


def test_where_there_are_no_locks_the_number_of_the_process_has_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from splatseg.io import scene_folder as lock

    monkeypatch.setattr(lock, "try_lock", lambda handle, **more: "unknown")
    here, ended = socket.gethostname(), _ended()
    for process, host, works in [
        (os.getppid(), here, True),
        (ended, here, False),
        (ended, f"not-{here}", True),  # who knows
        (os.getpid(), here, False),
    ]:
        owner = {"work": "fit", "process": process, "host": host, "since": 0.0}
        (tmp_path / LOCK_FILE).write_text(json.dumps(owner))
        assert (lock_owner(tmp_path) is not None) == works, (process, host)
        if works:
            with pytest.raises(InputError, match="works on this"), scene_lock(tmp_path, "see"):
                pass
        else:
            with scene_lock(tmp_path, "see"):
                pass


def test_what_took_the_name_since_stays(tmp_path: Path) -> None:
    holder = tmp_path / f"{TEMPORARY}{_ended()}-abc"
    (holder / "previous").mkdir(parents=True)
    (holder / "rgb" / "new").mkdir(parents=True)
    (tmp_path / "rgb").mkdir()
    sweep(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["rgb"]
    assert not list((tmp_path / "rgb").iterdir())


def test_a_link_of_that_name_is_not_followed(tmp_path: Path) -> None:
    (tmp_path / "elsewhere" / "x").mkdir(parents=True)
    (tmp_path / "scene").mkdir()
    link = tmp_path / "scene" / f"{TEMPORARY}{_ended()}-abc"
    (tmp_path / "elsewhere" / "previous").mkdir()
    link.symlink_to(tmp_path / "elsewhere", target_is_directory=True)
    sweep(tmp_path / "scene")
    assert link.is_symlink()
    assert sorted(path.name for path in (tmp_path / "elsewhere").iterdir()) == ["previous", "x"]


def test_what_was_half_written_takes_no_place(tmp_path: Path) -> None:
    holder = tmp_path / f"{TEMPORARY}{_ended()}-abc"
    (holder / "rgb").mkdir(parents=True)
    sweep(tmp_path)
    assert not list(tmp_path.iterdir())


def test_a_folder_that_cannot_be_written_is_found_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    check_writable(tmp_path)
    assert not list(tmp_path.iterdir())

    def refused(*args: object, **more: object) -> str:
        raise PermissionError(13, "Permission denied", str(tmp_path))

    monkeypatch.setattr("tempfile.mkdtemp", refused)
    with pytest.raises(InputError, match=r"cannot be written: there is no permission .* change it"):
        check_writable(tmp_path)
    monkeypatch.setattr("os.open", refused)
    with pytest.raises(InputError, match="no permission"), work_on_scene(tmp_path, "see"):
        pass
