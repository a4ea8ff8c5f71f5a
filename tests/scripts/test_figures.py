"""scripts/figures, on a copy of the project's layout."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

PAGE = """# A page

<!-- figures mIoU: one two -->
| old |
<!-- end of figures -->

between

<!-- figures of all -->
<!-- end of figures -->
"""
HERE = {"commit": "abc", "day": "2026-11-28", "processor": "P", "python": "3.11", "torch": "2.13"}


@pytest.fixture
def project(tmp_path: Path, project_root: Path) -> Path:
    for folder in ("scripts", "docs", "benchmarks/results"):
        (tmp_path / folder).mkdir(parents=True)
    shutil.copy(project_root / "scripts" / "figures", tmp_path / "scripts")
    (tmp_path / "README.md").write_text("Without tables.\n")
    (tmp_path / "docs" / "page.md").write_text(PAGE)
    runs = {
        f"seed {seed}": {"mIoU": value, "cpu_seconds": 30 + seed, **HERE}
        for seed, value in ((1, 0.25), (2, 0.75), (3, 0.5))
    }
    figures = {
        "one": {"title": "`one`", "commands": ["splatseg a", "splatseg b"], "office": runs},
        "two": {"title": "two", "commands": ["splatseg c"], "toys": {"seed 1": runs["seed 1"]}},
    }
    (tmp_path / "benchmarks/results/figures.json").write_text(json.dumps(figures))
    return tmp_path


def run(project: Path, *words: str) -> subprocess.CompletedProcess[str]:
    script = str(project / "scripts" / "figures")
    return subprocess.run(
        [sys.executable, script, *words], capture_output=True, text=True, check=False
    )


def test_tables_are_medians_with_their_spread(project: Path) -> None:
    stale = run(project, "--check")
    assert (stale.returncode, stale.stdout) == (1, "")
    assert "docs/page.md: tables are not those of benchmarks/results/figures.json" in stale.stderr
    assert (project / "docs/page.md").read_text() == PAGE, "--check writes nothing"
    assert run(project).returncode == 0
    assert run(project, "--check").returncode == 0
    text = (project / "docs/page.md").read_text()
    assert "| mIoU | `office` | `toys` |\n| --- | --- | --- |\n" in text
    assert "| `one` | 0.500 (0.250 to 0.750) |  |\n| two |  | 0.250 |\n" in text
    assert "| old |" not in text
    assert "\n\nbetween\n\n" in text
    assert "| `two` | mIoU |  | 0.250 |  / 31 | abc |" in text
    assert "Measured on 2026-11-28: P, Python 3.11, torch 2.13." in text
    assert (project / "README.md").read_text() == "Without tables.\n"


def test_a_row_that_was_not_measured_is_named(project: Path) -> None:
    page = project / "docs" / "page.md"
    page.write_text(PAGE.replace("one two", "one three"))
    done = run(project)
    assert done.returncode == 1
    assert "docs/page.md asks for the row 'three', which benchmarks/run" in done.stderr
