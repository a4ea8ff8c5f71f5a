"""The site: pages of docs/ and of measured figures, the help of every command, and the API.

`make site` builds it into build/site. The reference of the commands is their ``--help``, that of
the API the docstrings of what packages offer: pages of both are written into docs/reference when
the build begins. Notebooks are run. Links to files of the repository that are no pages offer the
file.
"""

import importlib
import inspect
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx

ROOT = Path(__file__).parents[1]
REFERENCE = ROOT / "docs" / "reference"

project = "splatseg"
author = "the splatseg developers"
copyright = "the splatseg developers, Apache-2.0"
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_copybutton"]
root_doc = "docs/index"
include_patterns = [
    "docs/**.md",
    "examples/*.ipynb",
    "benchmarks/results/*.md",
    "CONTRIBUTING.md",
    "CHANGELOG.md",
]
exclude_patterns = [".venv", "build", "src", "tests", "bench", "native"]
suppress_warnings = ["ref.python"]  # an attribute `labels` is one of many, none is meant

myst_enable_extensions = ["dollarmath", "attrs_inline"]
myst_heading_anchors = 4
nb_execution_mode = "force"
nb_execution_in_temp = True
nb_execution_timeout = 300
nb_execution_raise_on_error = True

autodoc_member_order = "bysource"
autodoc_typehints = "none"  # shapes and types are in the docstrings, for people
autodoc_preserve_defaults = True

html_theme = "furo"
html_title = "splatseg"
html_static_path = ["_static"]
html_js_files = ["keyboard.js"]
html_extra_path = ["site"]  # the page at the root leads to docs/

_PACKAGES = (
    "core", "io", "render", "lift", "fit", "methods", "selection", "prompting", "edit", "evaluate",
    "models", "pose", "mesh", "street", "synthetic", "neighbours", "importing", "viewer", "report",
    "tasks",
)  # fmt: skip


def _commands() -> str:
    """The help of every command."""
    lines = ["# Commands", "", "What `splatseg COMMAND --help` says.", ""]
    for page in sorted((ROOT / "src/splatseg/cli/pages").glob("*.txt")):
        command, _, of = page.stem.partition("-")
        flag = {"segment": " --method ", "see": " --model "}.get(command, "-") if of else ""
        lines += [f"## splatseg {command}{flag}{of}", "", "```text", page.read_text().rstrip()]
        lines += ["```", ""]
    return "\n".join(lines)


def _public(package: str) -> list[tuple[str, str]]:
    """What a package offers, in the order of its file: kinds for autodoc, and names."""
    module = importlib.import_module(package)
    found = []
    for name in getattr(module, "__all__", None) or list(vars(module)):
        value = getattr(module, name)
        own = str(getattr(value, "__module__", "")).startswith("splatseg")
        if name.startswith("_") or not own:
            continue
        if inspect.isclass(value):
            found.append(("class", name))
        elif inspect.isfunction(value):
            found.append(("function", name))
    return found


def _api() -> dict[str, str]:
    """By name a page a package, and one that lists them."""
    pages: dict[str, str] = {}
    index = [
        "# API",
        "",
        "Commands as functions are `splatseg.NAME`, packages offer the rest.",
        "",
        "```{toctree}",
        ":maxdepth: 1",
        "",
    ]
    for short in _PACKAGES:
        package = f"splatseg.{short}"
        lines = [f"# {package}", "", "```{eval-rst}", f".. automodule:: {package}", ""]
        for kind, name in _public(package):
            lines.append(f".. auto{kind}:: {package}.{name}")
            lines += ["   :members:", ""] if kind == "class" else [""]
        lines += ["```", ""]
        pages[short] = "\n".join(lines)
        index.append(short)
    return {"api": "\n".join([*index, "```", ""]), **pages}


def _write_reference() -> None:
    """Pages that changed: Sphinx reads no other again, and tests may read them meanwhile."""
    REFERENCE.mkdir(exist_ok=True)
    pages = {"commands": _commands(), **_api()}
    for path in REFERENCE.glob("*.md"):
        if path.stem not in pages:
            path.unlink()
    for name, text in pages.items():
        path = REFERENCE / f"{name}.md"
        if not path.is_file() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


def _attribute(app: Sphinx, what: str, *rest: Any) -> None:
    """Keep napoleon from taking what stands before a colon for the type of an attribute."""
    if what in ("attribute", "property"):
        rest[-1].insert(0, "")  # the lines of the docstring


def setup(app: Sphinx) -> None:
    """Called by Sphinx; napoleon has the priority 500."""
    app.connect("autodoc-process-docstring", _attribute, priority=400)


_write_reference()
