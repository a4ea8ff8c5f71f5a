"""The page as a whole: reloads, crashes, others, narrow, dark, by the keyboard, for everybody."""

import shutil
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from splatseg.io.scene import load_scene
from splatseg.io.splats import write_splats
from splatseg.tasks import ImportOptions, import_scene
from support.browser import BLUE, GREEN, RED, Serving, Tab
from support.browser_handles import TOUCHES

pytestmark = pytest.mark.browser

NARROW = {"width": 380, "height": 800}


@pytest.fixture
def serve(chromium_path, tmp_path) -> Iterator[Callable[..., Serving]]:
    """Start further servers."""
    with ExitStack() as stack:

        def start(scene: Path, **options: int) -> Serving:
            server = Serving(scene, tmp_path / "server.log", **options)
            stack.callback(server.close)
            return server

        yield start


def rows(tab: Tab) -> int:
    return tab.page.locator("#objects .row").count()


def notice(tab: Tab, part: str) -> None:
    tab.until(lambda: part in tab.page.locator("#notice").inner_text(), part)


def test_reload_and_restore(tab) -> None:
    tab.keep(RED, "mug")
    tab.click(BLUE)
    before = tab.page.url
    tab.page.reload()
    tab.until(lambda: tab.quiet() and rows(tab) == 1)
    assert tab.page.url == before
    assert tab.page.locator(".bar-count").inner_text().startswith("150")
    tab.after(lambda: tab.page.locator("#history button").first.click())
    tab.after(lambda: tab.key("Control+z"))
    tab.until(lambda: rows(tab) == 0)


def test_kill_and_restore(new_tab, serve, browser_scene, tmp_path) -> None:
    scene = shutil.copytree(
        browser_scene, tmp_path / "balls", ignore=shutil.ignore_patterns("view", "exports")
    )
    first = serve(scene)
    tab = new_tab(first)
    tab.open()
    tab.keep(RED, "mug")
    tab.keep(BLUE, "bowl")
    tab.after(lambda: tab.key("Control+z"))
    first.kill()
    notice(tab, "The server is away")
    second = serve(scene, port=first.port)
    tab.button("Try now").click()
    notice(tab, "Open the address that the command printed")
    tab.page.evaluate(f"location.hash = '#{second.token}'")
    tab.until(lambda: tab.quiet() and rows(tab) == 1, "the page is let in again")
    assert [one["name"] for one in second.objects()] == ["mug"]
    assert tab.row("mug").is_visible()
    tab.after(lambda: tab.key("Control+Shift+Z"))
    assert [one["name"] for one in second.objects()] == ["mug", "bowl"]
    other = new_tab(second)
    other.open()
    assert rows(other) == 2
    tab.problems.console.clear()  # of the socket that broke
    tab.check("test_kill_and_restore")


def test_two_clients(tab, new_tab) -> None:
    other = new_tab()
    other.open()
    people = tab.page.locator("#status span", has_text="2 people")
    tab.until(people.is_visible)
    tab.keep(RED, "mug")
    other.row("mug").wait_for()
    other.pick("mug")
    other.key("F2")
    other.page.locator("#objects .rename").fill("cup")
    other.after(lambda: other.key("Enter"))
    tab.row("cup").wait_for()
    tab.after(lambda: tab.key("Control+z"))
    other.row("mug").wait_for()
    assert other.problems.console == []
    other.close()
    tab.until(people.is_hidden)


def test_wrong_token(new_tab, serving) -> None:
    tab = new_tab()
    tab.page.goto(f"{serving.base}/#wrong")
    notice(tab, "This page is not let in")
    assert "wrong" not in tab.page.url
    assert tab.pictures == 0
    assert tab.heard == []
    assert rows(tab) == 0


def test_nothing_comes_from_elsewhere(tab) -> None:
    tab.keep(RED, "mug")
    tab.page.locator(".thumb").first.click()
    tab.button("Compare with the photograph").click()
    tab.until(tab.page.locator("#photograph").is_visible)
    paths = {url.partition(tab.serving.base.partition("//")[2])[2] for url in tab.problems.requests}
    assert {"/login", "/socket", "/static/main.js", "/static/app.css"} <= paths
    assert any(path.startswith("/photographs/") for path in paths)
    assert tab.problems.outside() == []
    loaded = tab.page.evaluate("performance.getEntriesByType('resource').map((e) => e.name)")
    assert {url.split("/")[2] for url in loaded} == {f"127.0.0.1:{tab.serving.port}"}


def test_a_splat_file_without_photographs(new_tab, serve, browser_scene, tmp_path) -> None:
    path = tmp_path / "things.ply"
    write_splats(load_scene(browser_scene).gaussians, path)
    tab = new_tab(serve(path))
    tab.open()
    page = tab.page
    assert page.locator("#scene-name").inner_text() == "things"
    assert not tab.button("Compare with the photograph").is_visible()
    assert "no masks yet" in page.locator("#suggestions .offer").inner_text()
    tab.keep(RED, "mug")
    found = tab.serving.objects()[0]
    assert found["count"] > 100
    assert found["centre"][0] < -0.7
    tab.button("Make masks").click()
    page.locator("#jobs").get_by_role("button", name="Cancel").click()
    page.locator(".toast", has_text="cancelled").wait_for()
    tab.check("test_a_splat_file_without_photographs")


def test_masks_are_made_and_answer_clicks(new_tab, serve, browser_scene, tmp_path) -> None:
    path, folder = tmp_path / "things.ply", tmp_path / "things"
    write_splats(load_scene(browser_scene).gaussians, path)
    # Few small views: the page would wait a minute for those of `splatseg view FILE`.
    import_scene(path, folder, options=ImportOptions(up="+z", max_views=20, width=144))
    tab = new_tab(serve(folder))
    tab.open()
    tab.until(lambda: thumbnail(tab) > 0, "a camera is drawn")
    tab.button("Make masks").click()
    # Masks, the objects that they are joined to, and these as suggestions.
    suggested = tab.page.locator("#suggestions .row")
    suggested.first.wait_for(timeout=120_000)  # two processes are started one after the other
    assert suggested.count() >= 3
    tab.until(lambda: tab.quiet() and tab.page.locator("#status", has_text="Warming").count() == 0)
    state = tab.serving.state()
    assert state["source"] == "layer masks"
    tab.keep(RED, "mug")
    found = tab.serving.objects()[0]
    assert 100 < found["count"] < 160, "of 150; some inside it no view shows"
    assert found["source"] == "layer masks"
    tab.check("test_masks_are_made_and_answer_clicks")


def thumbnail(tab: Tab) -> int:
    """Width of the first picture of the strip."""
    return tab.page.evaluate("document.querySelector('.thumb img').naturalWidth")


def test_narrow(new_tab, serving) -> None:
    tab = new_tab(viewport=NARROW, has_touch=True, is_mobile=True, device_scale_factor=2)
    tab.open()
    page = tab.page
    assert page.evaluate("document.documentElement.scrollWidth") <= NARROW["width"]
    tab.selecting(lambda: page.touchscreen.tap(*tab.at(RED, aside=(8, 0))))
    assert tab.selection is not None
    tab.after(tab.button("Keep").tap)
    for name, panel in (("Objects", "objects"), ("Photographs", "views")):
        page.get_by_role("tab", name=name).tap()
        assert page.locator(f"#{panel}").is_visible()
    page.get_by_role("tab", name="Suggested").tap()
    assert page.locator("#suggestions").is_visible()
    page.get_by_role("tab", name="Objects").tap()
    assert rows(tab) == 1
    page.get_by_role("tab", name="Objects").tap()
    assert not page.locator("#objects").is_visible()
    small = page.evaluate("""() => [...document.querySelectorAll('button')].filter((e) => {
        const r = e.getBoundingClientRect();
        return e.checkVisibility() && r.width && (r.width < 24 || r.height < 24);
    }).map((e) => e.outerHTML.slice(0, 90))""")
    assert small == [], "WCAG 2.5.8: at least 24 x 24 pixels to press"
    serving.clean()
    tab.check("test_narrow")


def test_dark(tab) -> None:
    page = tab.page

    def paper() -> int:
        """Lightness of the page, of 765."""
        colour = page.evaluate("getComputedStyle(document.querySelector('#top')).backgroundColor")
        return sum(int(part) for part in colour.strip("rgba() ").split(",")[:3])

    light = paper()
    assert light > 600
    page.emulate_media(color_scheme="dark")
    assert paper() < 200
    tab.menu("Settings", "Light")
    assert paper() == light
    tab.menu("Settings", "Dark")
    page.emulate_media(color_scheme="light")
    page.reload()
    tab.until(tab.quiet)
    assert paper() < 200
    tab.menu("Settings", "As the system")
    assert paper() == light


def focused(tab: Tab) -> str:
    return tab.page.evaluate(
        "document.activeElement.id || document.activeElement.getAttribute('aria-label') || "
        "document.activeElement.textContent.trim() || document.activeElement.tagName"
    )


def walk_to(tab: Tab, wanted: str, key: str = "Tab") -> None:
    """Press Tab until something has the focus."""
    for _ in range(90):
        if focused(tab) == wanted:
            return
        tab.key(key)
    raise AssertionError(f"Tab does not come to {wanted}")


def test_keyboard_alone(tab) -> None:
    page = tab.page
    seen: list[str] = []
    for _ in range(90):
        tab.key("Tab")
        name, outlined = page.evaluate("""() => {
            const e = document.activeElement;
            const shown = [e, e.labels?.[0], e.nextElementSibling].filter(Boolean);
            const ring = shown.some((s) => getComputedStyle(s).outlineStyle !== 'none');
            return [e.id || e.getAttribute('aria-label') || e.textContent.trim() || e.tagName,
                    ring || e.id === 'overlay' || e === document.body];
        }""")
        assert outlined, f"{name} has the focus, and it is not seen"
        if seen and name in ("BODY", seen[0]):
            break
        seen.append(name)
    assert {"overlay", "Settings", "Export", "Click", "Lasso"} <= set(seen)
    walk_to(tab, "overlay")
    before = page.url
    tab.key("ArrowLeft")
    tab.key("Shift+ArrowRight")
    tab.key("+")
    tab.until(lambda: page.url != before)
    page.evaluate("location.hash = '#view=1,0,0,-1,0,0,1,-4,0,-1,0,0,4,0.9'")
    tab.pause(200)
    assert tab.selecting(lambda: tab.key("Space"))["count"] == pytest.approx(150, abs=15)
    tab.key("Shift+Enter")
    page.keyboard.type("mug")
    tab.after(lambda: tab.key("Enter"))
    assert focused(tab) == "overlay"
    walk_to(tab, "Objects")
    tab.after(lambda: tab.key("Enter"))
    tab.key("F2")
    page.keyboard.type("cup")
    tab.after(lambda: tab.key("Enter"))
    tab.after(lambda: tab.key("h"))
    tab.after(lambda: tab.key("k"))
    (found,) = tab.serving.objects()
    assert (found["name"], found["visible"], found["locked"]) == ("cup", False, True)
    tab.after(lambda: tab.key("k"))
    tab.after(lambda: tab.key("Delete"))
    assert tab.serving.objects() == []
    walk_to(tab, "Settings", "Shift+Tab")
    tab.key("Enter")
    assert page.locator("[role=menu]").is_visible()
    tab.key("ArrowDown")
    tab.key("Escape")
    assert focused(tab) == "Settings"


def test_help_and_keys_of_one_letter(tab) -> None:
    page = tab.page
    tab.button("Keys and mouse").click()
    help = page.locator("#help")
    assert "Lasso" in help.inner_text()
    page.locator(".help-body").press("PageDown")
    page.locator("#letters").uncheck()
    tab.button("Close", "#help").click()
    page.locator("#overlay").focus()
    tab.key("l")
    assert tab.button("Lasso").get_attribute("aria-pressed") == "false"
    tab.menu("Settings", "Keys of one letter")
    page.locator("#overlay").focus()
    tab.key("l")
    assert tab.button("Lasso").get_attribute("aria-pressed") == "true"
    tab.key("?")
    assert help.is_visible()
    tab.key("Escape")
    tab.button("Click").click()
    assert tab.button("Click").get_attribute("aria-pressed") == "true"


@pytest.mark.parametrize(
    ("scheme", "size"), [("light", (1200, 760)), ("dark", (380, 800))], ids=["light", "dark-380"]
)
def test_axe_finds_nothing_serious(new_tab, serving, axe, scheme, size) -> None:
    viewport = {"width": size[0], "height": size[1]}
    tab = new_tab(viewport=viewport, color_scheme=scheme, bypass_csp=True)
    tab.open()
    page = tab.page
    page.evaluate(f"{axe};0")
    faults: list[str] = []

    def look(state: str) -> None:
        found = page.evaluate("axe.run(document, {resultTypes: ['violations']})")
        faults.extend(
            f"{state}: {fault['id']}: {fault['help']}: {[n['html'][:120] for n in fault['nodes']]}"
            for fault in found["violations"]
            if fault["impact"] in ("serious", "critical")
        )

    try:
        look("start")
        tab.click(RED, aside=(8, 0))
        look("selected")
        page.keyboard.press("Enter")
        tab.until(lambda: rows(tab) == 1)
        if size[0] < 500:
            page.get_by_role("tab", name="Objects").click()
        look("picked")
        tab.button("Export").click()
        look("export")
        tab.key("Escape")
        tab.button("Keys and mouse").click()
        look("help")
        tab.key("Escape")
        tab.button("Settings").click()
        look("menu")
    finally:
        serving.clean()
    assert faults == []


def test_each_visible_control_is_reached_by_a_test(tab) -> None:
    page = tab.page
    seen: set[str] = set()

    def look() -> None:
        seen.update(tab.visible_handles())

    def menu(name: str, within: str = "body") -> None:
        tab.button(name, within).click()
        look()
        tab.key("Escape")

    look()
    for name in ("Box", "Stroke", "Lasso", "Polygon", "Sphere", "Move", "Click"):
        tab.button(name).click()
        look()
    menu("Settings")
    tab.keep(RED, "mug")
    tab.after(tab.row("mug").locator(".eye").click)
    look()
    tab.keep(BLUE, "bowl")
    tab.click(GREEN)  # the red ball is hidden
    tab.pick("bowl")
    look()
    menu("Split")
    menu("More for the picked objects")
    menu("More for the selection")
    menu("Class")
    tab.key("F2")
    look()
    tab.key("Escape")
    menu("Suggest from a layer…")
    tab.after(lambda: tab.menu("Suggest from a layer…", "things"), "finished")
    look()
    menu("Suggest from a layer", "#suggestions .panel-head")
    tab.page.locator(".thumb").first.click()
    tab.button("Compare with the photograph").click()
    tab.until(page.locator("#divider").is_visible)
    look()
    tab.button("Export").click()
    for label in page.locator("#export .kinds label").all():
        label.click()
        look()
    tab.after(page.locator("#export [type=submit]").click, "progress")
    look()
    tab.key("?")
    look()
    tab.key("Escape")
    page.set_viewport_size(NARROW)  # type: ignore[arg-type]
    tab.pause(100)
    look()
    page.locator("#jobs").get_by_role("button", name="Cancel").click()
    page.locator(".job").wait_for(state="detached")
    reached = {handle for handles in TOUCHES.values() for handle in handles}
    assert len(seen) > 90
    assert seen <= reached
