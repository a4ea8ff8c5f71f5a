"""Every public function and class of the packages, and arguments that they take."""

import ast
import importlib
import inspect
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

PACKAGES = (
    "core",
    "render",
    "io.captures",
    "io.evidence",
    "io.export",
    "io.splats",
    "io.layers",
    "io.scene",
    "io.images",
    "lift",
    "lift.training",
    "methods",
    "models",
    "neighbours",
    "raycast",
    "pose",
    "pose.doctor",
    "fit",
    "importing",
    "synthetic",
    "edit",
    "evaluate",
    "tasks",
    "splatseg_bench.layouts",
)


def imported(package: str) -> ModuleType:
    """A package of splatseg, or of the distribution of benchmarks."""
    whole = package if package.startswith("splatseg_bench") else f"splatseg.{package}"
    return importlib.import_module(whole)


def public_names(package: str) -> list[str]:
    """What an ``__init__`` re-exports as ``X as X``, or a module defines without underscore."""
    module = imported(package)
    file = Path(str(module.__file__))
    stub = file.with_suffix(".pyi")  # of packages whose names load at first use
    tree = ast.parse((stub if stub.is_file() else file).read_text(encoding="utf-8"))
    exported = [
        alias.name
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
        if alias.asname == alias.name
    ]
    own = [
        node.name
        for node in tree.body
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)) and not node.name.startswith("_")
    ]
    return [*exported, *own]


def public_callables() -> dict[str, Callable[..., Any]]:
    """Functions, and classes that are values, by ``package.name``; each once."""
    found: dict[str, Callable[..., Any]] = {}
    seen: set[int] = set()
    for package in PACKAGES:
        module = imported(package)
        for name in public_names(package):
            value = getattr(module, name)
            ours = getattr(value, "__module__", "").startswith("splatseg")
            if not callable(value) or not ours or id(value) in seen:
                continue
            if inspect.isclass(value) and (
                getattr(value, "_is_protocol", False) or issubclass(value, (Exception, Warning))
            ):
                continue
            seen.add(id(value))
            found[f"{package}.{name}"] = value
    return found
