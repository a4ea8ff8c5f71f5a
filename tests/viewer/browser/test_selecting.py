"""Looking and selecting, as a person does it in the page."""

import math
from collections.abc import Iterator

import pytest

from support.browser import BLUE, GREEN, RED, Serving, Tab, write_worded_scene
from support.viewer import EACH

pytestmark = pytest.mark.browser

EMPTY = (0.0, 0.0, -1.0)
"""A place where nothing is."""


def near(selection, *points) -> None:
    """Whether a selection is the balls at the points, whole."""
    assert selection is not None
    assert selection["count"] == pytest.approx(EACH * len(points), abs=15)
    middle = [sum(point[k] for point in points) / len(points) for k in range(3)]
    assert math.dist(selection["centre"], middle) < 0.25


def shown(tab) -> str:
    return tab.page.locator("#bar .bar-count").inner_text()


def test_load(tab) -> None:
    page = tab.page
    assert page.title() == "balls – splatseg"
    assert page.locator("#scene-name").inner_text() == "balls"
    assert tab.serving.token not in page.url
    assert tab.pictures >= 1
    assert "450 Gaussians" in page.locator("#status").inner_text()
    assert page.locator("#objects .empty").is_visible()
    assert shown(tab) == "Nothing selected"
    pixels = page.evaluate("""() => {
        const canvas = document.querySelector('#picture');
        const g = canvas.getContext('2d');
        const row = g.getImageData(0, canvas.height / 2, canvas.width, 1).data;
        const at = (x) => [...row.slice(4 * Math.round(x), 4 * Math.round(x) + 3)];
        const step = 0.225 * Math.max(canvas.width, canvas.height);
        return [at(canvas.width / 2 - step), at(canvas.width / 2 + step)];
    }""")
    red, blue = pixels
    assert red[0] > 2 * max(red[1:3])
    assert blue[2] > 2 * max(blue[:2])


def test_looking_around(tab) -> None:
    page = tab.page

    def moves(act) -> list[float]:
        """The camera in the address after something moved it."""
        before = page.url
        pictures = tab.pictures
        act()
        tab.until(lambda: page.url != before and tab.pictures > pictures)
        return [float(part) for part in page.url.partition("view=")[2].split(",")]

    def position(camera) -> list[float]:
        return [camera[3], camera[7], camera[11]]

    middle = tab.at((0, 0, 0))
    aside = (middle[0] + 80, middle[1] + 20)
    orbited = moves(lambda: tab.drag(middle, aside))
    assert math.dist(position(orbited), (0, 0, 0)) == pytest.approx(4, rel=1e-3)
    assert position(orbited)[0] < -0.3
    moves(lambda: tab.drag(middle, aside, button="right"))
    closer = moves(lambda: page.mouse.wheel(0, -200))
    assert closer[12] < 4
    moves(lambda: tab.button("Frame everything").click())
    moves(lambda: page.evaluate("location.hash = '#view=1,0,0,0,0,0,1,-4,0,-1,0,0,4,0.9'"))
    turned = moves(lambda: page.mouse.dblclick(*tab.at(RED)))
    assert turned[12] == pytest.approx(math.dist((0, -4, 0), RED), abs=0.5)
    tab.until(lambda: shown(tab) == "Nothing selected", "the selection is taken back")
    tab.button("Fly").click()
    page.locator("#overlay").focus()

    def fly() -> None:
        page.keyboard.down("w")
        tab.pause(200)
        page.keyboard.up("w")

    moves(fly)
    tab.menu("Settings", "Orbit")
    tab.menu("Settings", "Fly")
    assert tab.button("Fly").get_attribute("aria-pressed") == "true"
    tab.menu("Settings", "Orbit")
    up = moves(lambda: tab.menu("Settings", "+X up"))
    assert [up[1], up[5], up[9]] != [0, 0, -1]
    for entry in ("−X up", "+Y up", "−Y up", "−Z up", "As the scene says"):
        moves(lambda entry=entry: tab.menu("Settings", entry))
    tab.button("Copy a link to this view").click()
    tab.page.locator(".toast").wait_for()
    assert page.evaluate("navigator.clipboard.readText()") == page.url
    tab.button("Dismiss").click()
    assert page.locator(".toast").count() == 0


def test_hover_sends_nothing(tab) -> None:
    tab.keep(RED, "cup")
    tab.page.mouse.move(*tab.at(BLUE))
    tab.until(tab.quiet)
    tab.pause(300)
    sent = len(tab.sent)
    label = tab.page.locator("#hover-label")
    tab.page.mouse.move(*tab.at(RED))
    tab.until(label.is_visible)
    assert label.inner_text().startswith("cup")
    tab.page.mouse.move(*tab.at(EMPTY))
    tab.until(label.is_hidden)
    assert [message["type"] for message in tab.sent[sent:]] in ([], ["hint"])


def test_click(tab) -> None:
    near(tab.click(RED), RED)
    tab.until(lambda: shown(tab).startswith("1"))
    near(tab.click(BLUE), BLUE)
    near(tab.click(RED, "Shift"), RED, BLUE)
    near(tab.click(BLUE, "Control"), RED)
    near(tab.click(GREEN), GREEN)


def test_how_clicks_join(tab) -> None:
    choose = tab.page.locator
    near(tab.click(RED), RED)
    choose("label[for=selmode-add]").click()
    near(tab.click(BLUE), RED, BLUE)
    choose("label[for=selmode-intersect]").click()
    near(tab.click(BLUE, aside=(20, 0)), BLUE)
    choose("label[for=selmode-add]").click()
    near(tab.click(RED), RED, BLUE)
    choose("label[for=selmode-remove]").click()
    near(tab.click(RED, aside=(20, 0)), BLUE)
    choose("label[for=selmode-set]").click()
    near(tab.click(RED, aside=(0, 20)), RED)


def test_negative_click(tab) -> None:
    choose = tab.page.locator

    def sent() -> tuple[int, int, int]:
        message = tab.last("select")
        return message["gesture"], len(message["points"]), len(message.get("negative", ()))

    near(tab.click(RED), RED)
    near(tab.click(BLUE, "Alt", "Shift"), RED, BLUE)
    assert sent() == (1, 2, 0)
    tab.after(lambda: tab.press_at(GREEN, "Alt"), "selected", stage="final")
    assert sent() == (1, 2, 1)
    near(tab.selection, RED, BLUE)
    near(tab.click(RED, aside=(20, 0)), RED)
    assert sent() == (2, 1, 0)
    choose("label[for=points-more]").click()
    near(tab.click(GREEN, aside=(20, 0)), RED, GREEN)
    choose("label[for=points-less]").click()
    tab.after(lambda: tab.press_at(BLUE), "selected", stage="final")
    assert sent() == (2, 2, 1)
    choose("label[for=points-new]").click()
    near(tab.click(BLUE, aside=(20, 0)), BLUE)
    assert sent() == (3, 1, 0)
    # A layer that knows balls cannot divide one: this is said, and nothing is lost.
    tab.after(lambda: tab.press_at(BLUE, "Alt", aside=(0, 40)), "error")
    assert "a finer layer may tell them apart" in tab.page.locator(".toast.bad").inner_text()
    near(tab.selection, BLUE)


def test_level_is_sent_with_the_same_prompt(tab) -> None:
    near(tab.click(RED), RED)
    tab.after(lambda: tab.page.locator("#level").fill("1"), "selected", stage="final")
    message = tab.last("select")
    assert (message["level"], message["gesture"]) == (1, 1)


def test_stroke(tab) -> None:
    tab.button("Stroke").click()
    brush = tab.page.locator("#brush")
    brush.fill("30")
    red = tab.at(RED)
    selection = tab.selecting(
        lambda: tab.drag((red[0] - 40, red[1] - 10), red, (red[0] + 40, red[1] + 10))
    )
    near(selection, RED)
    message = tab.last("select")
    assert message["kind"] == "stroke"
    assert message["width"] == 30
    assert len(message["points"]) > 3


def outline(tab, point, size=150) -> list[tuple[float, float]]:
    x, y = tab.at(point)
    return [(x + size * dx, y + size * dy) for dx, dy in ((-1, -1), (1, -1), (1, 1), (-1, 1))]


def test_lasso(tab) -> None:
    tab.button("Lasso").click()
    near(tab.selecting(lambda: tab.drag(*outline(tab, BLUE))), BLUE)
    assert tab.last("select")["kind"] == "lasso"
    assert len(tab.last("select")["points"]) > 6


def test_polygon(tab) -> None:
    tab.button("Polygon").click()
    for corner in outline(tab, RED):
        tab.page.mouse.click(*corner)
    near(tab.selecting(lambda: tab.button("Close the polygon").click()), RED)
    assert len(tab.last("select")["points"]) == 4
    *corners, last = outline(tab, BLUE)
    for corner in corners:
        tab.page.mouse.click(*corner)
    tab.page.mouse.click(last[0] - 30, last[1])
    tab.key("Backspace")
    tab.page.mouse.click(*last)
    near(tab.selecting(lambda: tab.key("Enter")), BLUE)
    assert len(tab.last("select")["points"]) == 4


def test_box(tab) -> None:
    tab.button("Box").click()
    first, _, last, _ = outline(tab, BLUE)
    near(tab.selecting(lambda: tab.drag(first, last)), BLUE)
    assert tab.last("select")["kind"] == "box"


def test_sphere(tab) -> None:
    tab.button("Sphere").click()
    tab.page.locator("#ball").fill("200")
    selection = tab.selecting(lambda: tab.page.mouse.click(*tab.at(RED)))
    assert selection is not None
    assert 0.9 * EACH <= selection["count"] <= EACH
    message = tab.last("select")
    assert message["kind"] == "sphere"
    assert message["radius"] > 0.5
    assert len(message["points"]) == 1
    tab.page.locator("#ball").fill("60")
    (x, y), (left, _) = tab.at(BLUE), tab.at(RED)
    part = tab.selecting(lambda: tab.page.mouse.click(x, y))
    assert part is not None
    assert 1 <= part["count"] < 0.9 * EACH
    assert part["centre"][0] > 0.5
    painted = tab.selecting(lambda: tab.drag((x, y - 70), (x, y), (x, y + 70)))
    assert painted is not None
    assert part["count"] < painted["count"] <= EACH
    message = tab.last("select")
    assert len(message["points"]) > 3, "a ball at each place of the way"
    assert message["radius"] < 0.5
    both = tab.selecting(lambda: tab.drag((x, y), (left, y)))
    assert both is not None
    assert abs(both["centre"][0]) < 0.9, "where nothing is, the brush leaves nothing"
    assert len(tab.last("select")["points"]) > 10


def test_no_words_here(tab) -> None:
    find = tab.page.locator("#find")
    assert find.is_disabled()
    assert find.get_attribute("placeholder") == "No word search in this scene"
    assert "splatseg see" in (find.get_attribute("title") or "")
    tab.page.locator("#overlay").focus()
    tab.key("/")
    assert not [message for message in tab.sent if message["type"] == "select"]


def test_shapes_of_the_selection(tab) -> None:
    assert not tab.button("Grow").is_visible()
    tab.button("Sphere").click()
    tab.page.locator("#ball").fill("120")
    part = tab.selecting(lambda: tab.page.mouse.click(*tab.at(RED)))
    assert part is not None
    grown = tab.selecting(lambda: tab.button("Grow").click())
    assert grown is not None
    assert grown["count"] > part["count"]
    shrunk = tab.selecting(lambda: tab.button("Shrink").click())
    assert shrunk is not None
    assert shrunk["count"] < grown["count"]
    tab.after(lambda: tab.button("Fill holes").click(), "selected", stage="final")


def test_more_like_this_where_nothing_is_known_of_it(tab) -> None:
    near(tab.click(RED), RED)
    near(tab.selecting(lambda: tab.button("More like this").click()), RED)
    assert tab.last("select")["kind"] == "similar"


@pytest.fixture(scope="module")
def worded_serving(chromium_path, tmp_path_factory) -> Iterator[Serving]:
    """A server of balls that words find, two of which are alike."""
    folder = tmp_path_factory.mktemp("words")
    server = Serving(write_worded_scene(folder / "words"), folder / "server.log")
    yield server
    server.close()


@pytest.fixture
def worded(new_tab, worded_serving, request) -> Iterator[Tab]:
    """A page of it."""
    found = new_tab(worded_serving)
    found.open()
    yield found
    worded_serving.clean()
    found.check(request.node.originalname)


def test_words(worded) -> None:
    find = worded.page.locator("#find")
    assert find.get_attribute("placeholder") == "Find: red mug"
    worded.page.locator("#overlay").focus()
    worded.key("/")
    assert find.evaluate("field => field === document.activeElement")

    def say(words: str, key: str = "Enter") -> dict | None:
        find.fill(words)
        return worded.selecting(lambda: find.press(key))

    near(say("mug"), RED, BLUE)
    near(say("plant"), GREEN)
    assert say("mug", "Shift+Enter")["count"] == 3 * EACH
    near(say("mug", "Control+Enter"), GREEN)
    worded.after(lambda: find.fill("zebra") or find.press("Enter"), "error")
    assert "zebra" in worded.page.locator(".toast.bad").inner_text()
    near(worded.selection, GREEN)
    say("mug")
    worded.page.locator("label[for=mode-similarity]").click()
    legend = worded.page.locator("#legend")
    worded.until(legend.is_visible)
    assert legend.get_attribute("aria-label").startswith("Similarity: from ")
    worded.until(lambda: worded.colour(BLUE)[1] > worded.colour(GREEN)[1] + 30, "it is yellow")


def test_more_like_this(worded) -> None:
    near(worded.click(RED), RED)
    near(worded.selecting(lambda: worded.button("More like this").click()), RED, BLUE)
    near(worded.click(GREEN), GREEN)
    near(worded.selecting(lambda: worded.button("More like this").click()), GREEN)


def test_next_click(worded) -> None:
    button = worded.button("Next click")
    near(worded.click(RED), RED)
    worded.until(lambda: worded.of("hint"), "a sure selection was looked at")
    assert not button.is_visible()
    near(worded.click(BLUE), BLUE)
    worded.until(button.is_visible, "where the unsure one would be clicked next")
    hint = worded.of("hint")[-1]
    assert hint["view"] in ("first", "second")
    before = worded.page.url
    button.click()
    worded.until(lambda: worded.page.url != before, "the camera goes to that photograph")
    worded.page.locator("#overlay").press("Space")
    worded.until(lambda: not button.is_visible(), "a click is made, the hint is over")


def test_legends(tab) -> None:
    legend = tab.page.locator("#legend")
    assert not legend.is_visible()

    def shown(mode: str) -> str:
        tab.page.locator(f"label[for=mode-{mode}]").click()
        tab.until(legend.is_visible)
        return legend.get_attribute("aria-label")

    assert shown("confidence") == "Confidence: from 0 % to 100 %"
    assert (
        legend.locator(".legend-bar")
        .evaluate("bar => bar.style.backgroundImage")
        .startswith("linear-gradient(to right, rgb(68, 1, 84),")
    )
    tab.page.locator("label[for=mode-objects]").click()
    assert not legend.is_visible()
    tab.page.locator("label[for=mode-depth]").click()
    tab.until(lambda: (legend.get_attribute("aria-label") or "").startswith("Depth"))
    label = legend.get_attribute("aria-label")
    assert label.startswith("Depth, scene units: from 3.")
    assert (
        legend.locator(".legend-bar")
        .evaluate("bar => bar.style.backgroundImage")
        .startswith("linear-gradient(to right, rgb(253, 231, 37),")
    )
    # Nearer, the values are others.
    middle = tab.at((0, 0, 0))
    tab.page.mouse.move(*middle)
    tab.page.mouse.wheel(0, -400)
    tab.until(lambda: legend.get_attribute("aria-label") != label, "the ends follow the picture")
    tab.page.locator("label[for=mode-colour]").click()
    tab.until(legend.is_hidden)


def test_all_none_invert_and_a_layer(tab) -> None:
    more = "More for the selection"
    near(tab.click(RED), RED)
    inverse = tab.selecting(lambda: tab.menu(more, "Invert"))
    near(inverse, BLUE, GREEN)
    assert tab.selecting(lambda: tab.menu(more, "Select all"))["count"] == 3 * EACH
    assert tab.selecting(lambda: tab.menu(more, "Select none")) is None
    assert shown(tab) == "Nothing selected"
    assert tab.selecting(lambda: tab.menu(more, "things"))["count"] == 3 * EACH


def test_undo_and_redo_of_selections(tab) -> None:
    near(tab.click(RED), RED)
    near(tab.click(BLUE), BLUE)
    history = tab.page.locator("#history button")
    near(tab.after(history.first.click)["selection"], RED)
    tab.after(history.first.click)
    assert tab.selection is None
    assert history.first.is_disabled()
    near(tab.after(history.last.click)["selection"], RED)
    near(tab.after(lambda: tab.key("Control+Shift+Z"))["selection"], BLUE)
    assert history.last.is_disabled()


def test_modes(tab) -> None:
    tab.keep(RED, "cup")
    modes = tab.of("state")[0]["modes"]
    assert {"colour", "objects", "blend", "confidence", "depth"} <= set(modes)
    seen = set()
    for mode in [*modes[1:], "colour"]:
        pictures = tab.pictures
        tab.page.locator(f"label[for=mode-{mode}]").click()
        tab.until(lambda pictures=pictures: tab.pictures > pictures)
        assert tab.last("camera")["mode"] == mode
        tab.pause(100)
        seen.add(tab.page.evaluate("document.querySelector('#picture').toDataURL()"))
    assert len(seen) >= 5
    tab.page.mouse.click(*tab.at(EMPTY))
    tab.pause(100)
    tab.key("Tab")
    tab.until(lambda: tab.last("camera")["mode"] != "colour")


def test_photographs(tab) -> None:
    page = tab.page
    thumbs = page.locator(".thumb")
    assert thumbs.count() == 2
    tab.until(lambda: page.evaluate("document.querySelector('.thumb img').naturalWidth > 0"))
    thumbs.nth(1).click()
    tab.until(lambda: "0.5," in page.url)
    tab.button("Photograph before").click()
    tab.until(lambda: "0.5," not in page.url)
    tab.button("Next photograph").click()
    tab.until(lambda: "0.5," in page.url)
    tab.button("Photograph before").click()
    tab.until(lambda: "0.5," not in page.url)
    compare = tab.button("Compare with the photograph")
    compare.click()
    divider = page.locator("#divider")
    tab.until(divider.is_visible)
    divider.press("End")
    assert divider.get_attribute("aria-valuenow") == "100"
    box = divider.bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    tab.drag((x - 1, y), (x - 200, y))
    assert int(divider.get_attribute("aria-valuenow")) < 95
    picture = page.locator("#photograph").bounding_box()
    scale = picture["width"] / 96
    near(
        tab.selecting(
            lambda: page.mouse.click(picture["x"] + 26 * scale, picture["y"] + 36 * scale)
        ),
        RED,
    )
    assert tab.last("select")["view"] == "first"
    compare.click()
    assert divider.is_hidden()
