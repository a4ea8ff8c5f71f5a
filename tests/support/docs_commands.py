"""The commands that pages show, and a reader who runs them in a folder, one after the other."""

import hashlib
import json
import re
import shlex
import shutil
import signal
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import httpx
import pytest

from splatseg import cli
from splatseg.io.scene import load_scene
from splatseg.io.splats import SplatWarning, read_splats, write_splats
from splatseg.tasks import executors
from splatseg.viewer._server import ViewServer
from support.elsewhere import Elsewhere
from support.once import make_whole

_BLOCK = re.compile(r"^(```|~~~).*?$\n(.*?)^\1", re.MULTILINE | re.DOTALL)
_LINE = re.compile(r"^ *(?:\$ )?(splatseg .*)$", re.MULTILINE)
_INDENTED = re.compile(r"^ {4,}(splatseg .*)$", re.MULTILINE)
_INLINE = re.compile(r"`(splatseg [^`]+)`")

_PAGE_WIDTH = 320
"""Pixels of a row of the photographs that pages speak of."""

_NEW = ("fit", "import", "edit", "sharpen", "chunks", "attach")
"""Commands that want a new folder under ``-o``."""


@dataclass(frozen=True, kw_only=True)
class Shown:
    """A command line as a page shows it."""

    line: str
    step: bool
    """Of a block, whose commands a reader runs one after the other. Else it stands in a sentence or
    in a table, and is one of several things to do."""

    @property
    def words(self) -> list[str]:
        """What the shell would make of it, without ``splatseg`` and dots."""
        words = shlex.split(self.line, comments=True)[1:]
        return [word for word in words if word != "..."]

    @property
    def mention(self) -> bool:
        """Whether it only speaks of a command or of a flag: a name and flags, without a scene."""
        words = self.words
        if self.step or {"--help", "--version"} & set(words):
            return False
        return len(words) < 2 or words[1].startswith("-")


def commands_of(page: Path) -> list[Shown]:
    """Commands of blocks and of indented lines in their order, then those between backquotes."""
    # Lines that go on are one.
    text = re.sub(r"\s*\\\n\s*", " ", page.read_text(encoding="utf-8"))
    steps = [
        (block.start(2) + line.start(), line.group(1))
        for block in _BLOCK.finditer(text)
        for line in _LINE.finditer(block.group(2))
    ]
    rest = _BLOCK.sub(lambda block: " " * len(block.group()), text)
    # What a command does follows it after two blanks.
    steps += [(line.start(), line.group(1).partition("  ")[0]) for line in _INDENTED.finditer(rest)]
    between = [" ".join(line.split()) for line in _INLINE.findall(rest)]
    return [Shown(line=line, step=True) for _, line in sorted(steps)] + [
        Shown(line=line, step=False) for line in between
    ]


class Reader:
    """Runs the commands of one page, in the folder that is the working directory.

    What a command would refuse to write over is set aside first, as somebody does who tries the
    second way that a page shows. After a step the new one is what the next step works on; after a
    command of a table the old one is put back.

    A server is asked for its page, and ended as by Ctrl-C. Workers of Ray are this process, which
    sends itself what they would get.
    """

    def __init__(
        self,
        monkeypatch: pytest.MonkeyPatch,
        capsys: pytest.CaptureFixture[str],
        *,
        kept: Path,
    ) -> None:
        """Begin a page.

        Args:
            monkeypatch: Of the test.
            capsys: Of the test.
            kept: Folder that all pages share, for what several of them make of the same files.
        """
        self._capsys, self._kept = capsys, kept
        self._wrote: dict[Path, Sequence[str]] = {}
        monkeypatch.setattr(ViewServer, "wait", _answered_and_interrupted)
        monkeypatch.setattr(executors, "RayExecutor", _WorkersHere)
        monkeypatch.setattr(executors, "_check_answers", lambda address: None)
        # Virtual cameras are chosen from a third of the usual candidates.
        monkeypatch.setattr("splatseg.importing._virtual._POSITIONS", 8)
        monkeypatch.setenv("OMP_NUM_THREADS", "1")  # on several, poses of photographs differ
        for name in ("DISPLAY", "WAYLAND_DISPLAY"):  # no browser is opened
            monkeypatch.delenv(name, raising=False)

    def run(self, words: Sequence[str], *, step: bool) -> str:
        """Run a command; why it failed, nothing when it ended with status 0."""
        aside = {
            path: path.with_name(f"{path.stem}-before{path.suffix}")
            for path in self._in_the_way(words)
        }
        for path, before in aside.items():
            path.rename(before)
        _edit_elsewhere(words)
        words = _at_places(words)
        self._capsys.readouterr()
        made = self._made_once(words)
        for path, kept in made.items():
            if kept.is_dir() and not path.exists():  # the command finds this work done
                shutil.copytree(kept, path)
        status = cli.main(words)
        for path, kept in made.items():
            if status == 0:
                make_whole(kept, partial(shutil.copytree, path))
        errors = self._capsys.readouterr().err
        self._wrote |= dict.fromkeys(_results(words), tuple(words))
        for path, before in aside.items():
            if step and status == 0:
                _remove(before)
            else:
                _remove(path)
                before.rename(path)
        return "" if status == 0 else f"status {status}, {errors}"

    def _in_the_way(self, words: Sequence[str]) -> list[Path]:
        """What exists of the results of a command, but for evidence that it goes on with."""
        there = [path for path in _results(words) if path.exists()]
        if words[0] != "see":
            return there
        return [path for path in there if not self._goes_on(path, words)]

    def _goes_on(self, evidence: Path, words: Sequence[str]) -> bool:
        """Whether `see` made this evidence by the same words, or before this page by the model."""
        if evidence in self._wrote:
            return self._wrote[evidence] == tuple(words)
        record = json.loads((evidence / "evidence.json").read_text())
        return record["metadata"]["model"] == _after(words, "--model")

    def _made_once(self, words: Sequence[str]) -> dict[Path, Path]:
        """What takes longest: a folder that a command makes, and where all pages keep the same.

        Cameras of photographs, and masks of `regions`, by what they are made of and the words.
        """
        if words[0] == "fit" and words[1] == "PHOTOS":
            digest = hashlib.sha256(b"".join(one.read_bytes() for one in _photographs(words[1])))
            return {Path(_after(words, "-o"), "capture"): self._kept / digest.hexdigest()}
        if words[0] == "see" and "regions" in words and "--help" not in words:
            scene = load_scene(words[1])
            digest = hashlib.sha256(" ".join(words[2:]).encode())
            for view in scene.train_views:
                digest.update(view.name.encode() + (view.image.read_bytes() if view.image else b""))
            digest.update(Path(words[1], "gaussians.ply").read_bytes())
            return {_results(words)[0]: self._kept / digest.hexdigest()}
        return {}


def _photographs(folder: str) -> list[Path]:
    return sorted(path for path in Path(folder).iterdir() if path.is_file())


class _WorkersHere(Elsewhere):
    """In place of Ray's executor: works here on what its workers would get."""

    summary = "worked on here"

    def __init__(self, *_: Any) -> None:
        super().__init__()

    def __enter__(self) -> "_WorkersHere":
        return self

    def __exit__(self, *_: object) -> None:
        """Nothing was started."""


def _results(words: Sequence[str]) -> list[Path]:
    """What a command makes and does not write over."""
    if "--resume" in words or "--help" in words:
        return []
    if words[0] == "see":
        return [Path(words[1], "evidence", _after(words, "--evidence"))]
    if "--new-scene" in words:
        return [Path(_after(words, "--new-scene"))]
    if words[0] == "street" and "--label-scans" not in words:
        fields = Path(words[1], "fields")
        return [fields / "street", fields / "street.safetensors"]
    if words[0] == "attach" and "-o" not in words:
        return [Path(words[2])]
    return [Path(_after(words, "-o"))] if words[0] in _NEW else []


def _after(words: Sequence[str], flag: str) -> str:
    return words[words.index(flag) + 1]


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def _edit_elsewhere(words: Sequence[str]) -> None:
    """What `attach` gets: splats of its source without the last tenth, as an editor saves them.

    A file that is called edited, or the scene that was imported of it.
    """
    if words[0] != "attach" or "--help" in words or not Path(words[1]).exists():
        return
    source, target = Path(words[1]), Path(words[2])
    gaussians = read_splats(source) if source.is_file() else load_scene(source).gaussians
    file = target if target.suffix else Path("edited.ply")
    with warnings.catch_warnings():  # formats that have no place for all that we note
        warnings.simplefilter("ignore", SplatWarning)
        write_splats(gaussians[: 9 * len(gaussians) // 10], file)
    if file != target:
        few = ("--max-views", "6", "--width", "64", "--quiet")
        assert cli.main(["import", str(file), "-o", str(target), *few]) == 0


def _at_places(words: Sequence[str]) -> list[str]:
    """VIEW is the first view of the scene; pixels are as far along as in a page's photographs."""
    found = list(words)
    if words[0] != "select" or not {"--point", "--box"} & set(words):
        return found
    view = load_scene(words[1]).train_views[0]
    scale = view.camera.width / _PAGE_WIDTH
    for i, flag in enumerate(words[:-1]):
        if flag == "--view" and words[i + 1] == "VIEW":
            found[i + 1] = view.name
        elif flag in ("--point", "--negative", "--box"):
            name, colon, numbers = words[i + 1].rpartition(":")
            pixels = ",".join(f"{float(n) * scale:.1f}" for n in numbers.split(","))
            found[i + 1] = f"{name}{colon}{pixels}"
    return found


def _answered_and_interrupted(server: ViewServer) -> None:
    """Instead of waiting for Ctrl-C: ask the server for its page, then press Ctrl-C."""
    with httpx.Client(verify=False) as client:  # no certificates to be read
        answer = client.get(server.url.partition("#")[0])
    assert answer.status_code == 200, answer.text
    assert "<html" in answer.text
    signal.raise_signal(signal.SIGINT)
