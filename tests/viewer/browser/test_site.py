"""The site of the documentation: built from the clone without a warning, and usable by anybody."""

import subprocess
import sys
from pathlib import Path

import pytest
from playwright.sync_api import Browser

from support.once import made_once

ROOT = Path(__file__).resolve().parents[3]
PAGES = (
    "index",
    "tutorial",
    "gallery",
    "gallery/saga",
    "scale",
    "reference/lift",
    "decisions/fitting",
)


def build(folder: Path) -> None:
    """As `make site` does, but for the notebooks, which tests of their own run."""
    words = ["-q", "-W", "--keep-going", "-b", "html", "-c", "docs", "-D", "nb_execution_mode=off"]
    done = subprocess.run(
        [sys.executable, "-m", "sphinx", *words, "-d", folder / "trees", ".", folder / "html"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert done.returncode == 0, done.stderr


@pytest.fixture(scope="session")
def site(tmp_path_factory: pytest.TempPathFactory, worker_id: str) -> Path:
    """The folder of a web server."""
    return made_once(tmp_path_factory, worker_id, "site", build) / "html"


def test_every_page_is_there(site: Path) -> None:
    for page in (ROOT / "docs").rglob("*.md"):
        assert (site / page.relative_to(ROOT)).with_suffix(".html").is_file(), page
    assert (site / "docs" / "index.html").is_file()
    assert "docs/index.html" in (site / "index.html").read_text(encoding="utf-8")
    commands = (site / "docs/reference/commands.html").read_text(encoding="utf-8")
    assert "splatseg fit" in commands
    assert "uplift" in (site / "docs/reference/lift.html").read_text(encoding="utf-8")


@pytest.mark.parametrize("width", [1280, 420])
def test_axe_finds_nothing_serious_on_the_site(
    site: Path, browser: Browser, axe: str, width: int
) -> None:
    faults: list[str] = []
    with browser.new_context(viewport={"width": width, "height": 900}, bypass_csp=True) as context:
        page = context.new_page()
        for name in PAGES:
            page.goto((site / f"docs/{name}.html").as_uri())
            wide = "document.documentElement.scrollWidth > document.documentElement.clientWidth"
            assert not page.evaluate(wide), f"{name} is wider than {width} pixels"
            page.evaluate(f"{axe};0")
            found = page.evaluate("axe.run(document, {resultTypes: ['violations']})")
            faults += [
                f"{name}: {one['id']}: {one['help']}: {[n['html'][:120] for n in one['nodes'][:3]]}"
                for one in found["violations"]
                if one["impact"] in ("serious", "critical")
            ]
    assert not faults, "\n".join(faults)
