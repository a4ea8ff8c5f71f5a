"""scripts/changelog, on a copy of the project's layout."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

PREFACE = "# Changelog\n\nWhat a user notices.\n"


@pytest.fixture
def project(tmp_path: Path, project_root: Path) -> Path:
    for folder in ("scripts", "changelog.d"):
        (tmp_path / folder).mkdir()
    shutil.copy(project_root / "scripts" / "changelog", tmp_path / "scripts")
    (tmp_path / "changelog.d" / "README.md").write_text("How.")
    (tmp_path / "CHANGELOG.md").write_text(PREFACE)
    return tmp_path


def run(project: Path, *words: str) -> subprocess.CompletedProcess[str]:
    script = str(project / "scripts" / "changelog")
    return subprocess.run(
        [sys.executable, script, *words], capture_output=True, text=True, check=False
    )


def test_releases_gather_by_kind_newest_first(project: Path) -> None:
    fragments = project / "changelog.d"
    (fragments / "b.fixed.md").write_text("B is mended.\n")
    (fragments / "a.added.md").write_text("A is there,\nand long.\n")
    assert run(project, "--check").returncode == 0
    assert run(project, "--release", "0.1.0", "--date", "2026-12-01").returncode == 0
    first = (
        "## 0.1.0 (2026-12-01)\n\n"
        "### Added\n\n- A is there,\n  and long.\n\n"
        "### Fixed\n\n- B is mended.\n"
    )
    assert (project / "CHANGELOG.md").read_text() == f"{PREFACE}\n{first}"
    assert [path.name for path in fragments.iterdir()] == ["README.md"]

    (fragments / "c.removed.md").write_text("C is gone.")
    assert run(project, "--release", "0.2.0", "--date", "2027-01-01").returncode == 0
    second = "## 0.2.0 (2027-01-01)\n\n### Removed\n\n- C is gone.\n"
    assert (project / "CHANGELOG.md").read_text() == f"{PREFACE}\n{second}\n{first}"


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("new_thing.added.md", "It is there."),
        ("thing.md", "It is there."),
        ("thing.improved.md", "It is there."),
        ("thing.added.md", "- no sentence"),
        ("thing.added.md", ""),
    ],
)
def test_bad_fragments_are_named_and_stop_a_release(project: Path, name: str, text: str) -> None:
    (project / "changelog.d" / name).write_text(text)
    for words in (["--check"], ["--release", "0.1.0", "--date", "2026-12-01"]):
        done = run(project, *words)
        assert done.returncode == 1
        assert done.stderr.startswith(f"changelog.d/{name}: ")
    assert (project / "CHANGELOG.md").read_text() == PREFACE


@pytest.mark.parametrize("words", [[], ["--release", "1"], ["--check", "--release", "1"]])
def test_words_that_make_no_sense_are_refused(project: Path, words: list[str]) -> None:
    assert run(project, *words).returncode == 2
