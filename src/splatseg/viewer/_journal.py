"""The journal of a scene's document: every command on a line of its own, and back again.

    FOLDER/journal.jsonl            a header, then a line for each command, undo and redo
    FOLDER/masks/ID.z               masks that lines name, written before the lines
    FOLDER/snapshot-00000100.json   the document after so many lines, each hundred; the newest two

A line counts when the disk has it. Opening replays all of them, so that undo goes back to the
first; a snapshot is for what a damaged disk left of a journal. A line that was torn by a kill is
dropped. The journal of another scene is put aside.
"""

import contextlib
import hashlib
import json
import os
import shutil
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import msgspec

from splatseg.errors import FileFormatError, InputError, quoted
from splatseg.io.atomic import atomic_file, named_write_failures, sweep
from splatseg.io.json_files import json_text, parse_object
from splatseg.io.scene_folder import scene_lock
from splatseg.io.schema import structured
from splatseg.viewer._masks import MaskStore
from splatseg.viewer._state import COMMANDS, Command, Document, History, Mask, checked_name

JOURNAL_FILE = "journal.jsonl"
MASKS_FOLDER = "masks"
SNAPSHOT_LINES = 100
"""A snapshot is taken each so many lines."""

_FORMAT, _VERSION = "splatseg view", 1
_KEPT_SNAPSHOTS = 2
_UNDO, _REDO = "undo", "redo"
_NAMES = {kind: name for name, kind in COMMANDS.items()}

_open: set[Path] = set()
"""Folders that this process has open; the lock of the system does not tell these apart."""


def command_to_json(command: Command) -> tuple[str, dict[str, Any]]:
    """The name of a command and its arguments as JSON holds them. Inverse of `command_from_json`.

    Example:
        >>> from splatseg.viewer.commands import Rename
        >>> command_to_json(Rename(3, "mug"))
        ('rename', {'id': 3, 'name': 'mug'})
    """
    return _NAMES[type(command)], cast("dict[str, Any]", msgspec.to_builtins(command))


def command_from_json(name: str, arguments: Mapping[str, Any]) -> Command:
    """A command by its name and arguments.

    Raises:
        InputError: If there is none of that name, or an argument is missing, unknown, or not what
            it should be.
    """
    kind = COMMANDS.get(name)
    if kind is None:
        raise InputError(f"command: expected one of {', '.join(COMMANDS)}, got {quoted(name)}.")
    unknown = sorted(set(arguments) - set(kind.__dataclass_fields__))
    if unknown:
        known = ", ".join(kind.__dataclass_fields__)
        raise InputError(f"{name}: expected {known}, got {quoted(unknown[0])}.")
    return cast("Command", structured(dict(arguments), kind, where=name))


@dataclass(frozen=True, slots=True)
class _Header:
    format: str
    version: int
    gaussians: int
    digest: str


@dataclass(frozen=True, slots=True)
class _Line:
    n: int
    time: float
    author: str
    do: str
    arguments: dict[str, Any] | None = None


@dataclass(frozen=True, slots=True)
class _Snapshot:
    header: _Header
    lines: int
    last: str
    """Digest of the last line before it."""

    check: str
    """Digest of the document's text."""

    document: Document


class Journal:
    """An open journal. It holds the lock of its folder until it is closed.

    Args:
        folder: Where it lies; made where it is not there.
        gaussians: Gaussians of the scene.
        digest: Tells its Gaussians from others.

    Raises:
        InputError: If another process, or another session of this one, has it open.
        OutputError: If it cannot be written.
    """

    def __init__(self, folder: Path, *, gaussians: int, digest: str) -> None:
        self._folder = folder
        self._path = folder / JOURNAL_FILE
        self._header = _Header(_FORMAT, _VERSION, gaussians, digest)
        self._notes: list[str] = []
        self._stack = ExitStack()
        with named_write_failures(folder):
            folder.mkdir(parents=True, exist_ok=True)
        key = folder.resolve()
        if key in _open:
            raise InputError(f"{folder}: this scene is open already in this process; close it.")
        with self._stack as stack:
            stack.enter_context(scene_lock(folder, "view"))
            _open.add(key)
            stack.callback(_open.discard, key)
            with named_write_failures(folder):
                sweep(folder)
                self._restore()
            self._stack = stack.pop_all()

    def close(self) -> None:
        """Give the lock back."""
        self._stack.close()

    @property
    def masks(self) -> MaskStore:
        """The masks of its folder."""
        return self._masks

    @property
    def history(self) -> History:
        """What was done, as the journal gives it back. Who changes it writes the line first."""
        return self._history

    @property
    def notes(self) -> tuple[str, ...]:
        """What should be known of how it was opened, in sentences without a full stop."""
        return tuple(self._notes)

    def write(
        self,
        command: Command | None,
        *,
        author: str,
        after: Document,
        redo: bool = False,
    ) -> None:
        """Write a line, and wait until the disk has it.

        Args:
            command: What is done; None for undo, and for redo with `redo`.
            author: Who does it.
            after: The document after it; its masks are written first.
            redo: Whether what was undone is done again.

        Raises:
            OutputError: If it cannot be written; the journal is as it was.
        """
        name, arguments = (_REDO if redo else _UNDO), None
        masks = list(masks_of(after))
        if command is not None:
            name, arguments = command_to_json(command)
            masks += _masks_in(command)
        self._masks.persist(masks)
        content: dict[str, Any] = {
            "n": self._lines + 1,
            "time": round(time.time(), 3),
            "author": author,
            "do": name,
        }
        if arguments is not None:
            content["arguments"] = arguments
        self._append(content)
        self._lines += 1
        if self._lines % SNAPSHOT_LINES == 0:
            self._write_snapshot(after)

    def _append(self, content: Mapping[str, Any]) -> None:
        line = (json_text(JOURNAL_FILE, content) + "\n").encode()
        with named_write_failures(self._path):
            handle = os.open(self._path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_NOFOLLOW)
            try:
                size = os.fstat(handle).st_size
                try:
                    left = memoryview(line)
                    while left:
                        left = left[os.write(handle, left) :]
                    os.fsync(handle)
                except OSError:
                    with contextlib.suppress(OSError):
                        os.ftruncate(handle, size)
                    raise
            finally:
                os.close(handle)
        self._last = _digest(line[:-1])

    # Opening.

    def _restore(self) -> None:
        raw = self._path.read_bytes() if self._path.is_file() else b""
        first, newline, _ = raw.partition(b"\n")
        header = _header_of(first) if newline else None
        if header is not None and header != self._header:
            self._put_aside(header)
            raw = b""
        elif header is None and raw:
            self._note_of_header(raw)
            raw = b""
        self._masks = MaskStore(self._header.gaussians, self._folder / MASKS_FOLDER)
        self._history, self._lines, self._last = History(), 0, ""
        if not raw:
            self._path.unlink(missing_ok=True)
            self._drop_snapshots(after=-1)
            self._append(msgspec.to_builtins(self._header))
            return
        *pieces, torn = raw.split(b"\n")
        lines = [_line_of(piece) for piece in pieces[1:]]
        self._replay_all(pieces, lines)
        self._last = _digest(pieces[self._lines])
        if self._lines < len(lines) or torn:
            self._drop_rest(pieces, lines)
        self._drop_snapshots(after=self._lines)

    def _replay_all(self, pieces: Sequence[bytes], lines: Sequence[_Line | None]) -> None:
        done = _replay(self._history, lines, self._masks, after=0)
        if any(lines[done:]):
            snapshot, bad = self._newest_snapshot(pieces, after=done), done + 1
            if snapshot is not None:
                history = History(snapshot.document)
                done = _replay(history, lines, self._masks, after=snapshot.lines)
                self._history = history
                self._notes.append(
                    f"line {bad} of the journal is damaged; what was done is restored from "
                    f"line {snapshot.lines} on, and can be undone to there"
                )
        self._lines = done

    def _drop_rest(self, pieces: Sequence[bytes], lines: Sequence[_Line | None]) -> None:
        """Cut off what cannot be replayed; whole lines among it are copied aside first."""
        rest = lines[self._lines :]
        if any(rest):
            copy = _free_path(self._folder, "damaged", ".jsonl")
            shutil.copyfile(self._path, copy)
            self._notes.append(
                f"the journal is damaged from line {self._lines + 1} on; {len(rest)} of its lines "
                f"were dropped, and the whole of it is kept as {copy.name}"
            )
        else:
            self._notes.append("the last line of the journal was torn, and dropped")
        size = sum(len(piece) + 1 for piece in pieces[: self._lines + 1])
        handle = os.open(self._path, os.O_WRONLY | os.O_NOFOLLOW)
        try:
            os.ftruncate(handle, size)
            os.fsync(handle)
        finally:
            os.close(handle)

    def _note_of_header(self, raw: bytes) -> None:
        """A journal whose beginning says nothing: torn when it was made, or no journal."""
        if b"\n" not in raw:
            self._notes.append("the journal was torn when it was made, and begins anew")
            return
        copy = _free_path(self._folder, "damaged", ".jsonl")
        self._path.rename(copy)
        self._notes.append(f"the journal had no header; it is kept as {copy.name}, and a new begun")

    def _put_aside(self, other: _Header) -> None:
        aside = _free_path(self._folder, "other_scene", "")
        aside.mkdir()
        for path in (self._path, self._folder / MASKS_FOLDER, *self._snapshots()):
            if path.exists():
                path.rename(aside / path.name)
        what = (
            f"of {other.gaussians} Gaussians"
            if other.gaussians != self._header.gaussians
            else "of other Gaussians"
        )
        self._notes.append(
            f"the journal here was {what}, the scene has {self._header.gaussians}; it is kept as "
            f"{aside.name}, and a new one begun"
        )

    # Snapshots.

    def _snapshots(self) -> list[Path]:
        """The newest first."""
        return sorted(self._folder.glob("snapshot-*.json"), reverse=True)

    def _write_snapshot(self, document: Document) -> None:
        content = cast("dict[str, Any]", msgspec.to_builtins(document))
        record = {
            "header": msgspec.to_builtins(self._header),
            "lines": self._lines,
            "last": self._last,
            "check": _check_of(content),
            "document": content,
        }
        path = self._folder / f"snapshot-{self._lines:08d}.json"
        with atomic_file(path, durable=True) as temporary:
            temporary.write_text(json_text(path.name, record), encoding="utf-8", newline="\n")
        for old in self._snapshots()[_KEPT_SNAPSHOTS:]:
            old.unlink(missing_ok=True)

    def _newest_snapshot(self, pieces: Sequence[bytes], *, after: int) -> _Snapshot | None:
        """The newest sound one behind a line that is damaged."""
        for path in self._snapshots():
            try:
                content = parse_object(path.read_bytes(), where=path.name)
                found = structured(content, _Snapshot, where=path.name)
                fits = after < found.lines < len(pieces) and found.header == self._header
                if (
                    fits
                    and _digest(pieces[found.lines]) == found.last
                    and _check_of(content["document"]) == found.check
                    and all(mask in self._masks for mask in masks_of(found.document))
                ):
                    for one in found.document.objects:
                        checked_name(one.name)
                    return found
            except (InputError, OSError):
                continue
        return None

    def _drop_snapshots(self, *, after: int) -> None:
        """Remove those of lines that are no more."""
        for path in self._snapshots():
            number = path.stem.partition("-")[2]
            if not number.isdigit() or int(number) > after:
                path.unlink(missing_ok=True)


def masks_of(document: Document) -> list[Mask]:
    """The masks that a document names, each once."""
    found = [one.mask for one in (*document.objects, *document.suggestions, *document.edits)]
    if document.selection is not None:
        found.append(document.selection)
    return list(dict.fromkeys(found))


def _masks_in(value: object) -> list[Mask]:
    """The masks that a command carries."""
    if isinstance(value, Mask):
        return [value]
    if isinstance(value, tuple):
        return [mask for one in cast("tuple[object, ...]", value) for mask in _masks_in(one)]
    names = getattr(type(value), "__dataclass_fields__", ())
    return [mask for name in names for mask in _masks_in(getattr(value, name))]


def _replay(
    history: History, lines: Sequence[_Line | None], masks: MaskStore, *, after: int
) -> int:
    """Do the lines behind so many again, up to the first that cannot be; how many are done."""
    for done, line in enumerate(lines[after:], start=after):
        if line is None or line.n != done + 1:
            return done
        try:
            if line.do == _UNDO:
                history.undo()
            elif line.do == _REDO:
                history.redo()
            else:
                command = command_from_json(line.do, line.arguments or {})
                history.do(history.checked(command, masks, line.author))
        except InputError:
            return done
    return len(lines)


def _line_of(piece: bytes) -> _Line | None:
    """A line of a journal; None where it is none."""
    try:
        return structured(parse_object(piece, where=JOURNAL_FILE), _Line, where=JOURNAL_FILE)
    except FileFormatError:
        return None


def _header_of(piece: bytes) -> _Header | None:
    try:
        found = structured(parse_object(piece, where=JOURNAL_FILE), _Header, where=JOURNAL_FILE)
    except FileFormatError:
        return None
    if found.format == _FORMAT and found.version > _VERSION:
        raise FileFormatError(
            f"{JOURNAL_FILE}: expected version {_VERSION} or less, got {found.version}; a later "
            "splatseg wrote it."
        )
    return found if found.format == _FORMAT else None


def _digest(text: bytes) -> str:
    return hashlib.blake2b(text, digest_size=16).hexdigest()


def _check_of(document: Mapping[str, Any]) -> str:
    """Digest of a document's JSON, however it is laid out."""
    return _digest(json.dumps(document, sort_keys=True, separators=(",", ":")).encode())


def _free_path(folder: Path, stem: str, suffix: str) -> Path:
    number = 1
    while (path := folder / f"{stem}-{number}{suffix}").exists():
        number += 1
    return path
