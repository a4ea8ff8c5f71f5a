"""Runs the tests of a folder on every backend of the CPU, the name of which is their `BACKEND`.

A conftest.py imports both functions. A test module has `BACKEND`, the name that its tests and
helpers pass on; tests that reach it are run once a backend. What results are held to is computed
elsewhere, from matrices spelt out.
"""

import types
from collections.abc import Callable

import pytest

BACKENDS = ("cpu", "reference")
_NAME = "BACKEND"


def _names(code: types.CodeType) -> set[str]:
    """Names that a function's code looks up, those of functions inside it too."""
    inner = [part for part in code.co_consts if isinstance(part, types.CodeType)]
    return set(code.co_names).union(*map(_names, inner))


def reaches_backend(function: Callable, seen: frozenset[str] = frozenset()) -> bool:
    """Whether a function, or one of its module that it calls, looks up `BACKEND`."""
    module = getattr(function, "__globals__", {})
    names = _names(function.__code__)
    if _NAME in names:
        return True
    helpers = {
        name: module[name]
        for name in names - seen
        if isinstance(module.get(name), types.FunctionType) and module[name].__globals__ is module
    }
    return any(reaches_backend(f, seen | helpers.keys()) for f in helpers.values())


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    if hasattr(metafunc.module, _NAME) and reaches_backend(metafunc.function):
        metafunc.parametrize("each_backend", BACKENDS, indirect=True)


@pytest.fixture(autouse=True)
def each_backend(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the module's `BACKEND` be the one of this run."""
    if hasattr(request, "param"):
        monkeypatch.setattr(request.module, _NAME, request.param)
