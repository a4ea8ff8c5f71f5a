"""What may import what: private modules stay in their package; contracts notice breaches."""

import ast
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SOURCE = ROOT / "src" / "splatseg"

# import-linter over the package in the current folder, and not over an editable installation.
LINT_COPY = """
import sys
sys.path.insert(0, ".")
sys.meta_path[:] = [f for f in sys.meta_path if not type(f).__module__.startswith("_editable")]
from importlinter.cli import lint_imports_command
lint_imports_command(["--no-cache"])
"""


def imported_modules(path: Path) -> list[str]:
    """Modules that a file imports, ``from M import _m`` as ``M._m``."""
    found: list[str] = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            found += [f"{node.module}.{alias.name}" for alias in node.names]
    return found


def foreign_private(path: Path, root: Path) -> list[str]:
    """Private modules of other packages of splatseg that a file imports.

    ``splatseg._check`` and ``splatseg._native`` lie beside the packages and are everybody's.
    """
    own = path.relative_to(root).parts[0]
    found: list[str] = []
    for name in imported_modules(path):
        parts = name.split(".")
        if parts[0] != "splatseg" or len(parts) < 3 or parts[1].startswith("_") or parts[1] == own:
            continue
        module = root.joinpath(*parts[1:])
        modules = [parts[i] for i in range(2, len(parts)) if i < len(parts) - 1]
        if module.with_suffix(".py").is_file() or module.is_dir():
            modules.append(parts[-1])
        if any(part.startswith("_") for part in modules):
            found.append(name)
    return found


def test_no_package_imports_another_ones_private_module() -> None:
    found = {
        str(path.relative_to(SOURCE)): names
        for path in sorted(SOURCE.rglob("*.py"))
        if (names := foreign_private(path, SOURCE))
    }
    assert found == {}


def test_a_private_import_is_found(tmp_path) -> None:
    (tmp_path / "lift").mkdir()
    (tmp_path / "render").mkdir()
    (tmp_path / "render" / "_public.py").write_text("")
    guilty = tmp_path / "lift" / "guilty.py"
    for line, found in (
        ("from splatseg.render._public import render", ["splatseg.render._public.render"]),
        ("from splatseg.render import _public", ["splatseg.render._public"]),
        ("import splatseg.render._public", ["splatseg.render._public"]),
        ("from splatseg.lift._own import x", []),
        ("from splatseg._check import check_shape", []),
        ("from splatseg.render import render", []),
    ):
        guilty.write_text(line)
        assert foreign_private(guilty, tmp_path) == found, line


@pytest.mark.parametrize(
    ("module", "line", "contract"),
    [
        ("lift/label_maps.py", "import splatseg.models", "take evidence, never a model"),
        ("methods/vote.py", "import splatseg.models", "take evidence, never a model"),
        ("core/sh.py", "import scipy", "The core needs torch and numpy"),
        ("core/sh.py", "import splatseg.io.images", "Packages import downwards only"),
        ("io/arrays.py", "import splatseg.io.layers", "does not know what they are of"),
        ("evaluate/metrics.py", "import splatseg.report", "Packages import downwards only"),
        ("tasks/segment.py", "import splatseg.cli", "Packages import downwards only"),
        ("tasks/segment.py", "import splatseg_bench", "Benchmarks are another distribution"),
        ("render/paths.py", "import splatseg.models", "Packages import downwards only"),
    ],
)
def test_a_broken_contract_is_noticed(tmp_path, module, line, contract) -> None:
    """The contracts, run over a copy of the sources with one forbidden import in it."""
    shutil.copytree(
        SOURCE, tmp_path / "splatseg", ignore=shutil.ignore_patterns("__pycache__", "*.so")
    )
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    target = tmp_path / "splatseg" / module
    target.write_text(target.read_text(encoding="utf-8") + f"\n{line}\n", encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "-c", LINT_COPY],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1, done.stdout
    broken = [row for row in done.stdout.splitlines() if " BROKEN" in row]
    assert any(contract in row for row in broken), done.stdout
