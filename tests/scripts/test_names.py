"""Benchmarks and scripts are run by hand: what they take from the package is there all the same."""

import ast
import importlib
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[2]


def python_files() -> list[Path]:
    scripts = (path for path in (ROOT / "scripts").iterdir() if path.is_file())
    python = [path for path in scripts if path.read_text().startswith("#!/usr/bin/env python")]
    return sorted([*(ROOT / "benchmarks").glob("*.py"), *python])


def missing_names(tree: ast.AST) -> list[str]:
    """Modules of splatseg, and names in them, that are imported or read and do not exist."""
    missing: list[str] = []
    modules: dict[str, ModuleType] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("splatseg"):
            for alias in node.names:
                found = member(node.module or "", alias.name)
                if found is None:
                    missing.append(f"{node.module}.{alias.name}")
                elif isinstance(found, ModuleType):
                    modules[alias.asname or alias.name] = found
        elif isinstance(node, ast.Import):
            names = [alias.name for alias in node.names if alias.name.startswith("splatseg")]
            missing += [name for name in names if member(name, "__name__") is None]
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            module = modules.get(node.value.id)
            reads = isinstance(node.ctx, ast.Load)
            if reads and module is not None and not hasattr(module, node.attr):
                missing.append(f"{module.__name__}.{node.attr}")
    return missing


def member(module: str, name: str) -> object | None:
    try:
        found = importlib.import_module(module)
        return getattr(found, name, None) or importlib.import_module(f"{module}.{name}")
    except ModuleNotFoundError:
        return None


@pytest.mark.parametrize("path", python_files(), ids=lambda path: path.name)
def test_names_of_the_package_exist(path: Path) -> None:
    assert missing_names(ast.parse(path.read_text())) == []


@pytest.mark.parametrize(
    ("line", "name"),
    [
        ("from splatseg.fit import fitted", "splatseg.fit.fitted"),
        ("import splatseg.cli.sharpened", "splatseg.cli.sharpened"),
        ("from splatseg.fit import _run; _run.one_thread()", "splatseg.fit._run.one_thread"),
    ],
)
def test_a_name_that_went_is_found(line: str, name: str) -> None:
    assert missing_names(ast.parse(line)) == [name]
