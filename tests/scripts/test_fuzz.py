"""scripts/fuzz: a short run over every format, and a reader that is at fault is found."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from splatseg.errors import FileFormatError
from support.fuzz.mutations import FAMILIES, mutate
from support.fuzz.targets import TARGETS, Target
from support.fuzz.worker import case, fault_of


def test_a_short_run_of_every_format_is_clean(project_root: Path) -> None:
    words = [sys.executable, str(project_root / "scripts" / "fuzz"), "--json"]
    run = subprocess.run(
        [*words, "--tries", "4", "--seed", "3"], capture_output=True, text=True, check=False
    )
    found = json.loads(run.stdout)
    assert found["faults"] == []
    assert run.returncode == 0
    assert [row["format"] for row in found["formats"]] == list(TARGETS)
    assert {row["tries"] for row in found["formats"]} == {4}
    assert {name for row in found["formats"] for name in row["families"]} == set(FAMILIES)


def test_cases_depend_on_format_seed_and_number_alone() -> None:
    sound = b'{"a": [1, 2, 3], "b": "words"}' * 3
    assert case("x", 1, 2, sound) == case("x", 1, 2, sound)
    others = {case(*key, sound) for key in (("x", 1, 2), ("y", 1, 2), ("x", 2, 2), ("x", 1, 3))}
    assert len(others) > 2


def _raising(error: Exception, folder: Path) -> Target:
    def read() -> None:
        raise error

    return Target(file=folder / "a", read=read)


@pytest.mark.parametrize(
    ("error", "fault"),
    [
        (KeyError("x"), "KeyError at"),
        (MemoryError(), "MemoryError at"),
        (FileFormatError("something is wrong."), "names no file"),
        (FileFormatError("FOLDER/a: " + "x " * 300), "characters long"),
        (FileFormatError("FOLDER/a: \x1b[31m"), "cannot be printed"),
        (FileFormatError("FOLDER/a: expected something, got nothing."), None),
    ],
)
def test_what_counts_as_a_fault(tmp_path: Path, error: Exception, fault: str | None) -> None:
    if isinstance(error, FileFormatError):
        error = FileFormatError(str(error).replace("FOLDER", str(tmp_path)))
    found = fault_of(_raising(error, tmp_path), tmp_path)
    assert found is None if fault is None else fault in str(found)


def test_every_mutation_leaves_a_damaged_file(tmp_path: Path) -> None:
    sound = TARGETS["layer-labels"](tmp_path).file.read_bytes()
    import random

    generator = random.Random(5)
    for _ in range(50):
        family, damaged = mutate(generator, sound)
        assert family in FAMILIES
        assert isinstance(damaged, bytes)


def test_hangs_and_deaths_are_counted(project_root: Path, tmp_path: Path) -> None:
    """A reader that never ends, one that dies and one that takes memory, in a run of their own."""
    program = f"""
import os, sys
sys.path[:0] = [{str(project_root / "tests")!r}]
from support.fuzz import targets
from support.fuzz.run import Limits, fuzz
def spin():
    while True:
        pass
def bad(act):
    def make(folder):
        (folder / "a").write_bytes(b"sound")
        read = lambda: (folder / "a").read_bytes() == b"sound" or act()
        return targets.Target(file=folder / "a", read=read)
    return make
targets.TARGETS["slow"] = bad(spin)
targets.TARGETS["dead"] = bad(lambda: os._exit(7))
targets.TARGETS["large"] = bad(lambda: bytearray(1 << 32))
for outcome in fuzz(["slow", "dead", "large"], tries=2, seed=0, limits=Limits(seconds=0.05)):
    print(outcome.format, outcome.counted()["hangs"], *(f.fault[:13] for f in outcome.faults))
"""
    run = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True, cwd=tmp_path
    )
    assert run.stdout.splitlines() == [
        "slow 2 hang hang",
        "dead 0 the process e the process e",
        "large 0 MemoryError a MemoryError a",
    ]
