"""Packages of other people, as the documentation writes them: installed by pip, and run."""

import os
import re
import subprocess
import sys
from pathlib import Path


def blocks(page: Path, language: str) -> list[str]:
    """The code of a page in a language, block by block."""
    text = page.read_text(encoding="utf-8")
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.MULTILINE | re.DOTALL)


def install(folder: Path, *, module: str, code: str, project: str) -> Path:
    """Install a package of one module with pip and without a network; gives where it lies now."""
    source, target = folder / "source", folder / "site"
    source.mkdir()
    (source / f"{module}.py").write_text(code)
    (source / "pyproject.toml").write_text(project)
    pip = [sys.executable, "-m", "pip", "install", "-q", "--no-index", "--no-deps"]
    subprocess.run(
        [*pip, "--no-build-isolation", "--target", str(target), str(source)],
        check=True,
        capture_output=True,
    )
    return target


def run(site: Path, *words: object) -> subprocess.CompletedProcess[str]:
    """Run splatseg in a process of its own that finds what is installed there."""
    return subprocess.run(
        [sys.executable, "-m", "splatseg", *map(str, words)],
        env={**os.environ, "PYTHONPATH": str(site)},
        capture_output=True,
        text=True,
        check=False,
    )
