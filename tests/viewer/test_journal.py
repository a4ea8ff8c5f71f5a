"""The journal: what is done is there again, however the process ended; damage is said."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from splatseg.errors import FileFormatError, InputError, OutputError
from splatseg.viewer import _journal
from splatseg.viewer._journal import Journal, command_from_json, masks_of
from splatseg.viewer._state import Command, Document, History
from splatseg.viewer.commands import Delete, Edit, Join, Keep, Rename, Select, Subtract, Suggestion
from support.viewing import COUNT, done, put, steps, stored


class Written:
    """A journal with the documents of its history, written as a session does."""

    def __init__(self, folder: Path, *, gaussians: int = COUNT, digest: str = "d") -> None:
        self.journal = Journal(folder, gaussians=gaussians, digest=digest)
        self.masks = self.journal.masks
        self.history: History = self.journal.history

    def do(self, command: Command) -> None:
        entry = self.history.checked(command, self.masks, "anna")
        self.journal.write(command, author="anna", after=entry.after)
        self.history.do(entry)

    def undo(self) -> None:
        after = self.history.numbered(self.history.next_undo.before)
        self.journal.write(None, author="", after=after)
        self.history.undo()

    def redo(self) -> None:
        after = self.history.numbered(self.history.next_redo.after)
        self.journal.write(None, author="", after=after, redo=True)
        self.history.redo()

    def take(self, given) -> list[Document]:
        """The documents after each step that could be taken, the first before them."""
        stored(self.masks)
        seen = [self.history.document]
        seen.extend(self.history.document for step in given if done(step, self.do, self))
        return seen


def named(masks, count: int) -> list[Command]:
    """A mug, and then names of it."""
    return [Select(put(masks, 1)), Keep("mug"), *(Rename(1, f"mug {i}") for i in range(count - 2))]


def write(folder: Path, count: int) -> list[Document]:
    written = Written(folder)
    seen = written.take(named(written.masks, count))
    assert len(seen) == count + 1
    written.journal.close()
    return seen


def reopen(folder: Path, **other) -> tuple[Document, tuple[str, ...]]:
    written = Written(folder, **other)
    written.journal.close()
    return written.history.document, written.journal.notes


def lines(folder: Path) -> list[bytes]:
    return (folder / "journal.jsonl").read_bytes().splitlines(keepends=True)


@settings(max_examples=20)
@given(st.lists(steps, max_size=20), st.integers(0, 10**9))
def test_a_journal_killed_at_any_byte_restores_to_a_prefix(tmp_path_factory, given, at) -> None:
    folder = tmp_path_factory.mktemp("view")
    written = Written(folder)
    seen = written.take(given)
    entries, label = written.history.entries, written.history.redo_label
    written.journal.close()
    whole = Written(folder)
    whole.journal.close()
    assert whole.journal.notes == ()
    assert whole.history.document == seen[-1]
    assert whole.history.entries == entries
    assert whole.history.redo_label == label
    raw = (folder / "journal.jsonl").read_bytes()
    cut = at % (len(raw) + 1)
    (folder / "journal.jsonl").write_bytes(raw[:cut])
    found, notes = reopen(folder)
    complete = max(raw[:cut].count(b"\n") - 1, 0)
    assert found == seen[complete]
    torn = cut > 0 and raw[cut - 1 : cut] != b"\n"
    assert len(notes) == torn
    assert all("torn" in note for note in notes)
    again, none = reopen(folder)
    assert (again, none) == (found, ())


def test_what_follows_a_torn_line_stands_on_a_line_of_its_own(tmp_path) -> None:
    seen = write(tmp_path / "a", 4)
    raw = (tmp_path / "a" / "journal.jsonl").read_bytes()
    ends = [0, *(i + 1 for i, byte in enumerate(raw) if byte == 10)]
    cuts = {end + step for end in ends for step in (-2, -1, 0, 1, 2)} | set(range(0, len(raw), 71))
    for cut in sorted(cut for cut in cuts if 0 <= cut <= len(raw)):
        folder = tmp_path / str(cut)
        shutil.copytree(tmp_path / "a", folder)
        (folder / "journal.jsonl").write_bytes(raw[:cut])
        written = Written(folder)
        complete = max(raw[:cut].count(b"\n") - 1, 0)
        assert written.history.document == seen[complete]
        written.take([Select(put(written.masks, 3))])
        written.journal.close()
        assert reopen(folder) == (written.history.document, ())
        shutil.rmtree(folder)


def test_a_line_has_what_was_done_by_whom_and_when(tmp_path) -> None:
    write(tmp_path, 2)
    header, first, second = (json.loads(line) for line in lines(tmp_path))
    assert header == {"format": "splatseg view", "version": 1, "gaussians": COUNT, "digest": "d"}
    assert (first["n"], first["author"], first["do"]) == (1, "anna", "select")
    assert first["arguments"]["mask"]["count"] == 1
    assert second["arguments"] == {"name": "mug", "class_name": "", "colour": None}
    assert 1.7e9 < first["time"] <= second["time"]


def test_masks_are_written_before_the_line_that_names_them(tmp_path, monkeypatch) -> None:
    written = Written(tmp_path)
    seen: list[bool] = []
    append = written.journal._append

    def watched(content) -> None:
        names = [path.stem for path in (tmp_path / "masks").glob("*.z")]
        said = content.get("arguments", {}).get("mask")
        seen.append(said is None or said["id"] in names)
        append(content)

    monkeypatch.setattr(written.journal, "_append", watched)
    written.take(named(written.masks, 4))
    assert seen == [True] * 4
    joined = [Select(put(written.masks, 2)), Keep("other"), Join((1, 2))]
    written.take(joined)
    assert put(written.masks, 1, 2) == written.history.document.objects[0].mask
    written.journal.close()
    names = {path.stem for path in (tmp_path / "masks").glob("*.z")}
    assert {mask.id for mask in masks_of(written.history.document)} <= names


def test_a_mask_that_a_command_alone_names_is_written(tmp_path) -> None:
    written = Written(tmp_path)
    first = [Select(put(written.masks, 1, 2)), Keep("mug")]
    written.take([*first, Subtract(1, put(written.masks, 2))])
    written.journal.close()
    assert reopen(tmp_path) == (written.history.document, ())


def test_a_line_lasts_before_it_counts(tmp_path, monkeypatch) -> None:
    written = Written(tmp_path)
    mask = put(written.masks, 1)
    written.masks.persist([mask])
    lasting: list[bytes] = []
    monkeypatch.setattr(
        _journal.os, "fsync", lambda _: lasting.append((tmp_path / "journal.jsonl").read_bytes())
    )
    written.do(Select(mask))
    written.journal.close()
    assert lasting == [(tmp_path / "journal.jsonl").read_bytes()]


def test_what_a_killed_process_was_writing_is_cleared(tmp_path) -> None:
    left = tmp_path / ".splatseg-999999999-abc"
    left.mkdir()
    os.utime(left, (1, 1))
    reopen(tmp_path)
    assert not left.exists()


def test_what_was_only_tried_leaves_no_file(tmp_path) -> None:
    written = Written(tmp_path)
    written.take([Rename(9, "a"), Delete((9,))])
    stored(written.masks)
    written.journal.close()
    assert not (tmp_path / "masks").exists()
    assert len(lines(tmp_path)) == 1


def test_a_second_process_is_refused_in_a_sentence(tmp_path) -> None:
    written = Written(tmp_path)
    code = (
        "from pathlib import Path\n"
        "from splatseg.errors import InputError\n"
        "from splatseg.viewer._journal import Journal\n"
        "try:\n"
        f"    Journal(Path({str(tmp_path)!r}), gaussians={COUNT}, digest='d')\n"
        "except InputError as error:\n"
        "    print(error)\n"
    )
    ran = [sys.executable, "-c", code]
    refused = subprocess.run(ran, capture_output=True, text=True, check=True).stdout
    assert "another splatseg works on this scene (view, process" in refused
    with pytest.raises(InputError, match="open already in this process"):
        Written(tmp_path)
    written.journal.close()
    assert subprocess.run(ran, capture_output=True, text=True, check=True).stdout == ""
    reopen(tmp_path)


def test_a_killed_process_bars_nobody_and_nothing_is_lost(tmp_path) -> None:
    code = (
        "import os, signal, numpy as np\n"
        "from pathlib import Path\n"
        "from splatseg.viewer._journal import Journal\n"
        "from splatseg.viewer.commands import Select\n"
        f"journal = Journal(Path({str(tmp_path)!r}), gaussians=3, digest='d')\n"
        "mask = journal.masks.put(np.array([0, 255, 0], np.uint8))\n"
        "entry = journal.history.checked(Select(mask), journal.masks)\n"
        "journal.write(entry.command, author='', after=entry.after)\n"
        "os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == -9
    written = Written(tmp_path, gaussians=3)
    written.journal.close()
    assert written.journal.notes == ()
    assert written.history.document.selection is not None
    assert written.masks.get(written.history.document.selection).tolist() == [0, 255, 0]


@pytest.mark.parametrize(
    ("other", "said"),
    [({"gaussians": 5}, "of 12 Gaussians"), ({"digest": "e"}, "of other Gaussians")],
)
def test_the_journal_of_another_scene_is_put_aside(tmp_path, other, said) -> None:
    seen = write(tmp_path, 5)
    found, notes = reopen(tmp_path, **other)
    assert found == Document()
    (note,) = notes
    assert said in note
    assert "other_scene-1" in note
    reopen(tmp_path)  # the first scene comes back: its journal is not taken up by itself
    assert (tmp_path / "other_scene-2").is_dir()
    shutil.rmtree(tmp_path / "other_scene-2")
    (tmp_path / "journal.jsonl").unlink()
    for path in (tmp_path / "other_scene-1").iterdir():
        shutil.move(path, tmp_path / path.name)
    assert reopen(tmp_path) == (seen[-1], ())


def test_a_later_version_is_refused_and_left_alone(tmp_path) -> None:
    write(tmp_path, 2)
    raw = (tmp_path / "journal.jsonl").read_bytes().replace(b'"version": 1', b'"version": 2')
    (tmp_path / "journal.jsonl").write_bytes(raw)
    with pytest.raises(FileFormatError, match="version 1 or less, got 2; a later"):
        reopen(tmp_path)
    assert (tmp_path / "journal.jsonl").read_bytes() == raw
    with pytest.raises(FileFormatError):
        reopen(tmp_path)


def test_something_else_of_that_name_is_kept(tmp_path) -> None:
    (tmp_path / "journal.jsonl").write_bytes(b"dear diary\nnothing\n")
    found, (note,) = reopen(tmp_path)
    assert found == Document()
    assert "had no header; it is kept as damaged-1.jsonl" in note
    assert (tmp_path / "damaged-1.jsonl").read_bytes() == b"dear diary\nnothing\n"


@pytest.mark.parametrize(
    "damage",
    [
        lambda line: b"\0" * (len(line) - 1) + b"\n",
        lambda line: line.replace(b"rename", b"reneme"),
        lambda line: line.replace(b'"id": 1', b'"id": 9'),
        lambda line: line.replace(b'"n": 3', b'"n": 4'),
        lambda line: line.replace(b'"name"', b'"nome"'),
        lambda line: b"[" * 100_000 + b"\n",
        lambda line: b"",
    ],
)
def test_a_damaged_line_ends_the_journal_and_is_said(tmp_path, damage) -> None:
    seen = write(tmp_path, 6)
    given = lines(tmp_path)
    given[3] = damage(given[3])
    raw = b"".join(given)
    (tmp_path / "journal.jsonl").write_bytes(raw)
    found, (note,) = reopen(tmp_path)
    assert found == seen[2]
    assert "damaged from line 3 on" in note
    assert "kept as damaged-1.jsonl" in note
    assert (tmp_path / "damaged-1.jsonl").read_bytes() == raw
    assert reopen(tmp_path) == (seen[2], ())


def test_a_last_line_of_nothing_is_torn(tmp_path) -> None:
    seen = write(tmp_path, 4)
    given = lines(tmp_path)
    (tmp_path / "journal.jsonl").write_bytes(b"".join(given[:-1]) + b"\0\0\0\n\0\0\n")
    assert reopen(tmp_path) == (seen[3], ("the last line of the journal was torn, and dropped",))
    assert lines(tmp_path) == given[:-1]


# Snapshots.


@pytest.fixture
def short(monkeypatch) -> None:
    """Snapshots after few lines."""
    monkeypatch.setattr(_journal, "SNAPSHOT_LINES", 4)


def snapshots(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.glob("snapshot-*"))


def test_a_snapshot_each_hundred_lines() -> None:
    assert _journal.SNAPSHOT_LINES == 100


def test_the_newest_two_snapshots_are_kept(tmp_path, short) -> None:
    write(tmp_path, 14)
    assert snapshots(tmp_path) == ["snapshot-00000008.json", "snapshot-00000012.json"]


def broken(folder: Path, n: int) -> None:
    """Damage a line of the journal."""
    given = lines(folder)
    given[n] = b"x" * (len(given[n]) - 1) + b"\n"
    (folder / "journal.jsonl").write_bytes(b"".join(given))


def test_a_snapshot_restores_what_lies_behind_a_damaged_line(tmp_path, short) -> None:
    seen = write(tmp_path, 14)
    broken(tmp_path, 3)
    written = Written(tmp_path)
    (note,) = written.journal.notes
    assert "line 3 of the journal is damaged" in note
    assert "from line 12 on" in note
    assert written.history.document == seen[14]
    assert len(written.history.entries) == 2
    written.undo()
    written.undo()
    with pytest.raises(InputError, match="nothing to undo"):
        written.undo()
    written.take([Rename(1, "last")])
    last = written.history.document
    written.journal.close()
    assert len(lines(tmp_path)) == 18
    found, (note,) = reopen(tmp_path)
    assert found == last
    assert "from line 16 on" in note


def _without_masks(folder: Path) -> None:
    shutil.rmtree(folder / "masks")


def _edited(change):
    def edit(folder: Path) -> None:
        path = folder / "snapshot-00000012.json"
        content = json.loads(path.read_text())
        change(content)
        path.write_text(json.dumps(content))

    return edit


@pytest.mark.parametrize(
    "spoil",
    [
        lambda folder: (folder / "snapshot-00000012.json").unlink(),
        lambda folder: (folder / "snapshot-00000012.json").write_bytes(b"{"),
        _edited(lambda content: content.pop("document")),
        _edited(lambda content: content["document"]["objects"][0].update(name="other")),
        _edited(lambda content: content["document"].update(revision=3)),
        _edited(lambda content: content.update(lines=11)),
        _edited(lambda content: content.update(last="0" * 32)),
        _edited(lambda content: content["header"].update(digest="e")),
    ],
)
def test_an_unsound_snapshot_is_passed_over(tmp_path, short, spoil) -> None:
    seen = write(tmp_path, 14)
    broken(tmp_path, 3)
    spoil(tmp_path)
    found, (note,) = reopen(tmp_path)
    assert found == seen[14]
    assert "from line 8 on" in note


def test_a_snapshot_before_the_damage_or_without_its_masks_is_none(tmp_path, short) -> None:
    seen = write(tmp_path / "a", 14)
    broken(tmp_path / "a", 13)
    found, (note,) = reopen(tmp_path / "a")
    assert found == seen[12]
    assert "damaged from line 13 on; 2 of its lines were dropped" in note
    write(tmp_path / "b", 14)
    broken(tmp_path / "b", 3)
    _without_masks(tmp_path / "b")
    found, (note,) = reopen(tmp_path / "b")
    assert found == Document()
    assert "damaged from line 1 on; 14 of its lines were dropped" in note


def test_an_undo_from_before_a_snapshot_cannot_be_replayed_from_it(tmp_path, short) -> None:
    written = Written(tmp_path)
    written.take(named(written.masks, 8))
    before = written.history.document
    written.undo()
    written.journal.close()
    broken(tmp_path, 3)
    found, notes = reopen(tmp_path)
    assert found == before
    assert len(notes) == 2
    assert "damaged from line 9 on; 1 of its lines" in notes[1]


def test_snapshots_of_lines_that_are_no_more_are_removed(tmp_path, short) -> None:
    seen = write(tmp_path, 14)
    (tmp_path / "journal.jsonl").write_bytes(b"".join(lines(tmp_path)[:11]))
    assert reopen(tmp_path) == (seen[10], ())
    assert snapshots(tmp_path) == ["snapshot-00000008.json"]
    (tmp_path / "journal.jsonl").unlink()
    assert reopen(tmp_path) == (Document(), ())
    assert snapshots(tmp_path) == []


# Failures.


def test_a_line_that_cannot_be_written_changes_nothing(tmp_path, monkeypatch) -> None:
    written = Written(tmp_path)
    seen = written.take(named(written.masks, 3))
    before = (tmp_path / "journal.jsonl").read_bytes()
    real = _journal.os.write

    def half(handle: int, data) -> int:
        if len(data) > 20:
            return real(handle, bytes(data[:20]))
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(_journal.os, "write", half)
    with pytest.raises(OutputError, match="the disk is full"):
        written.do(Rename(1, "x" * 61))
    monkeypatch.undo()
    assert (tmp_path / "journal.jsonl").read_bytes() == before
    assert written.history.document == seen[-1]
    written.do(Rename(1, "after"))
    written.journal.close()
    assert reopen(tmp_path) == (written.history.document, ())


def test_a_link_in_the_place_of_the_journal_is_not_followed(tmp_path) -> None:
    (tmp_path / "view").mkdir()
    (tmp_path / "elsewhere").write_bytes(b"")
    (tmp_path / "view" / "journal.jsonl").symlink_to(tmp_path / "elsewhere")
    written = Written(tmp_path / "view")
    written.take([Select(put(written.masks, 1))])
    written.journal.close()
    assert (tmp_path / "elsewhere").read_bytes() == b""


def test_a_folder_that_cannot_be_made_is_said(tmp_path) -> None:
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(OutputError, match="cannot be written"):
        Written(tmp_path / "file" / "view")


@pytest.mark.parametrize(
    ("name", "arguments", "said"),
    [
        ("remove", {}, "command: expected one of select, keep"),
        ("rename", {"id": 1}, "rename: expected a field name"),
        ("rename", {"id": 1, "name": 3}, "name: expected text"),
        ("rename", {"id": 1.5, "name": "a"}, "id: expected a whole number"),
        ("rename", {"id": 1, "name": "a", "names": []}, "rename: expected id, name, got 'names'"),
        ("set_colour", {"ids": [1], "colour": [0, 0, 256]}, "at most 255"),
        ("set_visible", {"ids": 1, "visible": True}, "ids: expected a list"),
        (
            "select",
            {"mask": {"id": "a", "count": -1}},
            "count: expected a whole number of at least",
        ),
        ("apply", {"edit": {"kind": "explode", "mask": {"id": "a", "count": 1}}}, "kind"),
    ],
)
def test_arguments_that_are_none_are_refused(name, arguments, said) -> None:
    with pytest.raises(InputError, match=said):
        command_from_json(name, arguments)


def test_masks_of_a_document_are_all_that_it_names(tmp_path) -> None:
    written = Written(tmp_path)
    masks = [put(written.masks, i) for i in range(3)]
    document = Document(
        selection=masks[0],
        suggestions=(Suggestion(id=0, name="a", mask=masks[1], score=1),),
        edits=(Edit(kind="remove", mask=masks[2]),),
    )
    written.journal.close()
    assert set(masks_of(document)) == set(masks)
