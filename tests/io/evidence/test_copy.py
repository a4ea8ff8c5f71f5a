"""Evidence of one scene for another."""

import pytest

from splatseg.errors import InputError, MissingFileError
from splatseg.io.evidence import copy_evidence


@pytest.fixture
def evidence(tmp_path):
    folder = tmp_path / "a" / "evidence" / "masks"
    (folder / "deeper").mkdir(parents=True)
    (folder / "evidence.json").write_text("{}")
    (folder / "deeper" / "v.png").write_bytes(b"123")
    return folder


def test_everything_is_copied_and_what_was_there_replaced(evidence, tmp_path) -> None:
    old = tmp_path / "b" / "evidence" / "masks"
    old.mkdir(parents=True)
    (old / "old.png").write_bytes(b"9")
    assert copy_evidence(evidence, tmp_path / "b") == old
    assert (old / "deeper" / "v.png").read_bytes() == b"123"
    assert sorted(path.name for path in old.iterdir()) == ["deeper", "evidence.json"]
    assert [path.name for path in old.parent.iterdir()] == ["masks"]


def test_refused(evidence, tmp_path) -> None:
    with pytest.raises(InputError, match="expected a folder of evidence"):
        copy_evidence(tmp_path / "none", tmp_path / "a")
    with pytest.raises(MissingFileError):
        copy_evidence(evidence, tmp_path / "no scene")


def test_what_stops_it_leaves_nothing(evidence, tmp_path, monkeypatch) -> None:
    import splatseg.io.evidence._write as module

    def stopped(*arguments, **options):
        raise KeyboardInterrupt

    (tmp_path / "b" / "evidence").mkdir(parents=True)
    monkeypatch.setattr(module.shutil, "copytree", stopped)
    with pytest.raises(KeyboardInterrupt):
        copy_evidence(evidence, tmp_path / "b")
    assert list((tmp_path / "b" / "evidence").iterdir()) == []
