"""What pyproject.toml lists is imported, what is imported is listed, with one minimum each."""

import ast
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
CONFIGURATION = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
PROJECT = CONFIGURATION["project"]
OURS = {"splatseg", "splatseg-bench"}
EXTRAS: dict[str, list[str]] = PROJECT["optional-dependencies"]
TOOLS = {  # of dev: programs, and what a test runs in a process of its own
    "import-linter", "pytest-xdist", "ruff", "pyright",
    "scikit-build-core", "nanobind", "cmake", "ninja",
    "sphinx", "myst-nb", "furo", "sphinx-copybutton",
}  # fmt: skip
ELSEWHERE = {ROOT / "tests/golden/make_annotations.py"}
"""Run in an environment of its own, beside the tools whose files it makes."""

BY_NAME = re.compile(r"(?:import_module|import_package|find_spec|importorskip)\(\"([\w.]+)\"")
EXTRA_NAMED = re.compile(r"splatseg\[([\w,]+)\]|import_package\([^)]*, \"(\w+)\"\)")


def imported(folder: Path) -> set[str]:
    """Top-level modules of others that the Python files of a folder import, at once or later."""
    files = [path for path in folder.rglob("*.py") if path.is_file() and path not in ELSEWHERE]
    own = {path.stem for path in files} | {path.parent.name for path in files}
    names: set[str] = set()
    for path in files:
        text = path.read_text(encoding="utf-8")
        names |= set(BY_NAME.findall(text))
        for node in statements(ast.parse(text)):
            if isinstance(node, ast.Import):
                names |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                names.add(node.module)
    return {name.partition(".")[0] for name in names} - sys.stdlib_module_names - own


def statements(node: ast.AST) -> Iterator[ast.AST]:
    """Every statement under a node. Expressions, ten times as many, hold no imports."""
    for name in ("body", "orelse", "finalbody", "handlers", "cases"):
        for child in getattr(node, name, ()) if not isinstance(node, ast.expr) else ():
            yield child
            yield from statements(child)


def distributions(modules: set[str]) -> set[str]:
    """The packages that bring modules; a module that none brings stands for itself."""
    known = packages_distributions()
    return {normal(known[m][0] if m in known else m) for m in modules} - {
        "splatseg",
        "splatseg-bench",
    }


def normal(requirement: str) -> str:
    """The name in a requirement, in lower case and with hyphens."""
    found = re.match(r"[\w.-]+", requirement)
    assert found is not None, requirement
    return found[0].lower().replace("_", "-")


def listed(*extras: str) -> set[str]:
    """Names that the package, or extras of it, depend on."""
    lines = [line for extra in extras for line in EXTRAS[extra]]
    return {normal(line) for line in (*PROJECT["dependencies"], *lines)} - {"splatseg"}


def test_the_package_lists_what_it_imports_and_nothing_else() -> None:
    optional = [extra for extra in EXTRAS if extra != "dev"]
    assert distributions(imported(ROOT / "src")) == listed(*optional)


def test_benchmarks_import_what_splatseg_brings() -> None:
    own = tomllib.loads((ROOT / "bench" / "pyproject.toml").read_text(encoding="utf-8"))
    brought = {normal(line) for line in own["project"]["dependencies"]}
    assert distributions(imported(ROOT / "bench")) <= listed() | brought
    for line in own["project"]["dependencies"]:  # one minimum of a package, wherever it is listed
        assert normal(line) == "splatseg" or any(line in lines for lines in EXTRAS.values())


def test_dev_lists_what_the_tests_import_and_nothing_else() -> None:
    folders = ("tests", "examples", "src")
    found = {name for folder in folders for name in distributions(imported(ROOT / folder))}
    assert found | TOOLS == listed(*EXTRAS)


@pytest.mark.parametrize(
    "line",
    ["import sklearn.metrics", "def f():\n    from sklearn import metrics",
     'import importlib\nimportlib.import_module("sklearn.metrics")'],
)  # fmt: skip
def test_an_import_is_found_wherever_it_stands(tmp_path: Path, line: str) -> None:
    (tmp_path / "guilty.py").write_text(f"import json\nfrom guilty import x\n{line}\n")
    assert distributions(imported(tmp_path)) == {"scikit-learn"}


def test_extras_that_are_named_exist() -> None:
    """In messages, docs and the Makefile: ``pip install 'splatseg[sfm,video]'``."""
    files = [ROOT / "README.md", ROOT / "Makefile"]
    files += [*(ROOT / "src").rglob("*.py"), *(ROOT / "docs").rglob("*.md")]
    files = [file for file in files if file.parent.name != "reference"]  # made of the others
    named = {
        extra
        for path in files
        for pair in EXTRA_NAMED.findall(path.read_text(encoding="utf-8"))
        for found in pair
        if found
        for extra in found.split(",")
    }
    assert named == set(EXTRAS) - {"dev"}


def test_every_requirement_has_one_minimum_that_scripts_oldest_installs() -> None:
    done = subprocess.run(
        [sys.executable, ROOT / "scripts" / "oldest", "--list"],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    pins = done.stdout.split()
    names = [normal(pin) for pin in pins]
    assert len(names) == len(set(names)), "two minimums of one package"
    assert all("==" in pin for pin in pins), pins
    assert set(names) == listed(
        "sfm", "video", "las", "mesh", "street", "waymo", "viewer", "models", "ray", "hed", "dev"
    ) - {
        "torch",
        "ruff",
        "pyright",
    }


def test_the_build_has_the_same_minimums_everywhere() -> None:
    tools = [line for line in EXTRAS["dev"] if normal(line) in {"cmake", "ninja"}]
    tools += CONFIGURATION["build-system"]["requires"]
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    assert [line for line in tools if f"'{line}'" not in makefile] == []
    assert set(CONFIGURATION["build-system"]["requires"]) <= set(EXTRAS["dev"])


def test_readme_says_what_to_install_before_the_first_command() -> None:
    before, _, _ = (ROOT / "README.md").read_text(encoding="utf-8").partition("```console")
    assert "--torch-backend cpu torch" in before
    assert "pip install '.[sfm,viewer]'" in before, "what `fit PHOTOS` and `view` need"
