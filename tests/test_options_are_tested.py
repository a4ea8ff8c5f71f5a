"""Every option of the library and of the commands is named by a test.

To be named is not to be tested, but what no test names, no test can miss: such options could be
ignored and all would pass.
"""

import ast
import dataclasses
import importlib
import pkgutil
import re
from collections.abc import Iterator
from pathlib import Path

import splatseg

_WORD = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_FLAG = re.compile(r"--(?:no-)?([a-z][a-z0-9-]*)")


def option_classes() -> Iterator[type]:
    """Every public ``...Options`` dataclass, and the dataclass of every command."""
    for module in pkgutil.walk_packages(splatseg.__path__, "splatseg."):
        if module.name.endswith("__main__"):
            continue
        for name, value in vars(importlib.import_module(module.name)).items():
            if not (isinstance(value, type) and dataclasses.is_dataclass(value)):
                continue
            public = name.endswith("Options") and not name.startswith("_")
            command = name == "Command" and module.name.startswith("splatseg.cli.")
            if value.__module__ == module.name and (public or command):
                yield value


def words_of(source: str) -> set[str]:
    """Names, keyword arguments, words and flags of a module, but not of its docstrings."""
    words: set[str] = set()
    tree = ast.parse(source)
    prose = {
        id(statement.value)
        for node in ast.walk(tree)
        if isinstance(node, ast.Module | ast.FunctionDef | ast.ClassDef)
        for statement in node.body[:1]
        if isinstance(statement, ast.Expr)
    }
    for node in ast.walk(tree):
        match node:
            case ast.keyword(arg=str(name)) | ast.Name(id=name) | ast.Attribute(attr=name):
                words.add(name)
            case ast.Constant(value=str(text)) if id(node) not in prose:
                words |= set(_WORD.findall(text))
                words |= {flag.replace("-", "_") for flag in _FLAG.findall(text)}
            case _:
                pass
    return words


def test_every_option_is_named_by_a_test() -> None:
    here = Path(__file__)
    named: set[str] = set()
    for path in sorted(here.parent.rglob("*.py")):
        if path != here:
            named |= words_of(path.read_text())
    classes = list(option_classes())
    assert len(classes) > 20
    unnamed = [
        f"{cls.__module__}.{cls.__qualname__}.{field.name}"
        for cls in classes
        for field in dataclasses.fields(cls)
        # A group of options is no option: each of its own is.
        if field.name not in named and not dataclasses.is_dataclass(field.default_factory)
    ]
    assert not unnamed, f"options that no test names: {', '.join(unnamed)}"


def test_prose_names_no_option() -> None:
    words = words_of('''"""about shy_option"""
def test_it():
    """and other_option"""
    run(one_option=1, **{"two_option": 2}, words=["--no-three-option", "x"])
''')
    assert {"one_option", "two_option", "three_option"} <= words
    assert not {"shy_option", "other_option"} & words
