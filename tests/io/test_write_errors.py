"""What cannot be written is named, with what to do; what was there stays."""

import errno
import os
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest
import torch

from splatseg.core import Labels
from splatseg.errors import InputError, OutputError
from splatseg.io.arrays import unfinished, write_checkpoint_file
from splatseg.io.atomic import atomic_file, atomic_folder, failure_to_write, sync
from splatseg.io.layers import load_layer, save_layer

SMALL_FILES = """
import resource
import signal
import sys
from pathlib import Path

import numpy as np
import torch

from splatseg.core import Labels
from splatseg.errors import OutputError
from splatseg.io.layers import load_layer, save_layer
from splatseg.io.arrays import write_checkpoint_file

path = Path(sys.argv[1])
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))
"""


def with_small_files(code: str, path: Path) -> str:
    """What that code printed in a process where no file may be larger than 4096 bytes.

    That is what a full disk looks like to a writer. The limit is on all files of a process, logs
    and the notes of pytest among them: that of the tests must not have it.
    """
    command = [sys.executable, "-c", SMALL_FILES + textwrap.dedent(code), str(path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("number", [28, 122, 13, 30, 36])
def test_each_reason_says_what_to_do(number: int) -> None:
    sentence = failure_to_write("a.ply", OSError(number, os.strerror(number)))
    assert sentence.startswith("a.ply: cannot be written: ")
    assert any(word in sentence for word in ("free some space", "choose a"))


def test_a_full_disk_leaves_the_old_layer(tmp_path: Path) -> None:
    path = tmp_path / "classes.npz"
    out = with_small_files(
        """
        save_layer(Labels(ids=torch.ones(9, dtype=torch.int64), confidence=torch.ones(9)), path)
        new = Labels(ids=torch.ones(9000, dtype=torch.int64), confidence=torch.ones(9000))
        try:
            save_layer(new, path)
        except OutputError as error:
            print(error)
        """,
        path,
    )
    assert "classes.npz: cannot be written: the file would be" in out
    assert len(load_layer(path)) == 9
    assert [entry.name for entry in tmp_path.iterdir()] == ["classes.npz"]


def test_a_full_disk_leaves_the_old_checkpoint(tmp_path: Path) -> None:
    path = tmp_path / "fit" / "checkpoint.npz"
    write_checkpoint_file({"steps": 1}, {"a": np.zeros(3)}, path)
    before = path.read_bytes()
    out = with_small_files(
        """
        try:
            write_checkpoint_file({"steps": 2}, {"a": np.zeros(9000)}, path)
        except OutputError as error:
            print(error)
        """,
        path,
    )
    assert "checkpoint.npz: cannot be written" in out
    assert path.read_bytes() == before
    assert not unfinished(path).exists(), "a full disk needs the space"


def test_errors_that_are_not_of_writing_go_through(tmp_path: Path) -> None:
    missing = tmp_path / "photograph.png"
    with pytest.raises(FileNotFoundError) as caught, atomic_file(tmp_path / "a"):
        missing.read_bytes()
    assert not isinstance(caught.value, OutputError)
    with pytest.raises(BrokenPipeError), atomic_folder(tmp_path / "b"):
        raise BrokenPipeError(32, "Broken pipe")
    with pytest.raises(InputError), atomic_folder(tmp_path / "b"):
        raise InputError("b: expected something else.")
    with (
        pytest.raises(OutputError, match="b: cannot be written: 20 requested and 8 written"),
        atomic_folder(tmp_path / "b"),
    ):
        raise OSError("20 requested and 8 written")  # as NumPy's tofile says it
    assert not list(tmp_path.iterdir())


def test_scenes_layers_and_checkpoints_wait_for_the_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The disk has the content before the name is given to it, and then the name."""
    done: list[str] = []
    fsync, replace = os.fsync, os.replace

    def watched_fsync(handle: int) -> None:
        done.append(f"sync {Path(f'/proc/self/fd/{handle}').readlink().name}")
        fsync(handle)

    def watched_replace(source: object, target: object) -> None:
        done.append(f"rename {Path(str(target)).name}")
        replace(source, target)  # type: ignore[arg-type]

    monkeypatch.setattr(os, "fsync", watched_fsync)
    monkeypatch.setattr(os, "replace", watched_replace)
    save_layer(
        Labels(ids=torch.ones(2, dtype=torch.int64), confidence=torch.ones(2)), tmp_path / "a.npz"
    )
    here = f"sync {tmp_path.name}"
    assert done == ["sync a.npz", "rename a.npz", here]
    done.clear()
    write_checkpoint_file({}, {}, tmp_path / "c.npz")
    assert done == ["sync c.npz.new", "rename c.npz", here]
    done.clear()
    with atomic_folder(tmp_path / "scene", durable=True) as temporary:
        (temporary / "scene.json").touch()
    assert done == ["sync scene.json", "sync scene", "rename scene", here]


def test_a_file_system_may_lack_syncing_of_folders_but_not_of_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(number: int) -> None:
        def fsync(handle: int) -> None:
            raise OSError(number, os.strerror(number))

        monkeypatch.setattr(os, "fsync", fsync)

    file = tmp_path / "a"
    file.touch()
    for number in (errno.EINVAL, errno.ENOTSUP):
        refused(number)
        sync(tmp_path)
        with pytest.raises(OSError, match=os.strerror(number)):
            sync(file)
    refused(errno.EIO)
    with pytest.raises(OSError, match=os.strerror(errno.EIO)):
        sync(tmp_path)
