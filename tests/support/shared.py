"""Tests on the large scenes, which lie beside the project's folder and not in it.

Their licences keep them out of the repository, so that a clone may have to do without.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import pytest

VARIABLE = "SPLATSEG_DATA"
MARK = "data"
GENERATED = "generated"


def generated_and(*scenes: str) -> pytest.MarkDecorator:
    """Run a test that takes `rich_capture` on the generated room, and on these shared scenes."""
    large = [pytest.param(name, marks=getattr(pytest.mark, MARK)) for name in scenes]
    return pytest.mark.parametrize("rich_capture", [GENERATED, *large], indirect=True)


@dataclass(frozen=True)
class SharedData:
    """Where the large scenes are, or why there are none."""

    folder: Path
    missing: str
    """Empty where they are there."""

    @property
    def scorer(self) -> Path:
        """score.py, which comes with them."""
        return self.folder.parent / "score" / "score.py"

    @classmethod
    def find(cls, environment: Mapping[str, str], project: Path) -> "SharedData":
        """The folder that SPLATSEG_DATA names, else shared/data beside the project's folder.

        Raises:
            pytest.UsageError: If the variable names a folder that is not it.
        """
        named = environment.get(VARIABLE)
        folder = Path(named).resolve() if named else project.parent / "shared" / "data"
        needed = (folder / "README.md", folder.parent / "score" / "score.py")
        lacking = [path for path in needed if not path.is_file()]
        if named and lacking:
            raise pytest.UsageError(f"{VARIABLE}={named}: there is no {lacking[0]}")
        told = "../shared/data" if not folder.is_dir() else str(lacking[0]) if lacking else ""
        reason = f"there is no {told} (the variable {VARIABLE} names another folder)"
        return cls(folder=folder, missing=reason if told else "")


@dataclass(eq=False)
class DataTests:
    """Skips tests marked `data` where there is none, and counts them before the summary.

    A test that takes the fixture `shared_data` is marked by that.
    """

    shared: SharedData
    not_run: set[str] = field(default_factory=set)
    run: set[str] = field(default_factory=set)

    @pytest.hookimpl(tryfirst=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        for item in items:
            if "shared_data" in getattr(item, "fixturenames", ()):
                item.add_marker(MARK)

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_setup(self, item: pytest.Item) -> None:
        if self.shared.missing and item.get_closest_marker(MARK) is not None:
            pytest.skip(self.shared.missing)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if MARK in report.keywords and (report.when == "call" or report.skipped):
            (self.not_run if report.skipped else self.run).add(report.nodeid)

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        if not self.run and not self.not_run:
            return
        line = f"tests marked {MARK}: {len(self.run)} run, {len(self.not_run)} not run"
        if self.not_run:
            line += f": {self.shared.missing or 'skipped, see below'}"
        terminalreporter.write_sep("-", "large scenes")
        terminalreporter.write_line(line, yellow=bool(self.not_run))
