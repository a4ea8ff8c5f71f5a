"""Objects and files, as a person makes them in the page."""

import csv
import json
import zipfile
from pathlib import Path

import numpy as np
import pytest

from splatseg.core import Labels
from splatseg.io.scene import load_scene, load_scene_layer
from splatseg.io.splats import read_splats
from support.browser import BLUE, GREEN, RED
from support.viewer import EACH

pytestmark = pytest.mark.browser

MORE = "More for the picked objects"
EDIT = "More for the selection"


def only(tab) -> dict:
    """The one object, as someone who comes now sees it."""
    (found,) = tab.serving.objects()
    return found


def counts(tab) -> dict[str, int]:
    """Gaussians of each object, by name."""
    return {one["name"]: one["count"] for one in tab.serving.objects()}


def test_keep(tab) -> None:
    tab.click(RED)
    tab.page.locator("#keep-name").fill("mug")
    tab.after(tab.button("Keep").click)
    tab.row("mug").wait_for()
    assert counts(tab) == {"mug": pytest.approx(EACH, abs=15)}
    assert tab.selection is None
    tab.click(BLUE)
    tab.after(lambda: tab.key("Enter"))
    assert set(counts(tab)) == {"mug", "Object 2"}


def test_rename(tab) -> None:
    tab.keep(RED, "mug")
    tab.key("F2")
    tab.page.locator("#objects .rename").fill("cup")
    tab.after(lambda: tab.key("Enter"))
    assert only(tab)["name"] == "cup"
    tab.menu(MORE, "Rename")
    tab.page.locator("#objects .rename").fill("not taken")
    tab.key("Escape")
    tab.row("cup").wait_for()
    tab.name_of("cup").dblclick()
    tab.page.locator("#objects .rename").fill('<img src=x onerror="alert(1)">')
    tab.after(lambda: tab.key("Enter"))
    tab.row("<img src=x").wait_for()
    assert tab.page.locator("#objects img").count() == 0


def test_class(tab) -> None:
    tab.keep(RED, "mug")
    tab.button("Class").click()
    tab.page.locator("#class-name").fill("cup")
    tab.after(tab.button("Set").click)
    assert only(tab)["class"] == "cup"
    assert tab.row("mug").locator(".class").inner_text() == "cup"


def test_colour(tab) -> None:
    tab.keep(RED, "mug")
    swatch = tab.row("mug").locator("input[type=color]")
    tab.after(lambda: swatch.fill("#123456"))
    assert only(tab)["colour"] == [0x12, 0x34, 0x56]
    tab.menu(MORE, "Colour…")
    hidden = tab.page.locator("#objects > input[type=color]")
    tab.after(lambda: hidden.fill("#654321", force=True))
    assert only(tab)["colour"] == [0x65, 0x43, 0x21]


def test_search_and_sort(tab) -> None:
    tab.keep(RED, "zebra")
    tab.keep(BLUE, "ant")
    page = tab.page
    names = page.locator("#objects .row .name")
    assert names.all_inner_texts() == ["zebra", "ant"]
    page.locator("#object-sort").select_option("name")
    assert names.all_inner_texts() == ["ant", "zebra"]
    page.locator("#object-search").fill("zeb")
    assert names.all_inner_texts() == ["zebra"]
    page.locator("#object-search").fill("nothing")
    assert page.locator("#objects .empty").is_visible()


def test_hide(tab) -> None:
    tab.keep(RED, "mug")
    everything = tab.page.locator("#objects").get_by_role("button", name="Show all objects")
    tab.after(tab.row("mug").locator(".eye").click)
    assert not only(tab)["visible"]
    tab.until(lambda: reddest(tab) < 100, "the ball is gone from the picture")
    tab.after(everything.click)
    assert only(tab)["visible"]
    tab.until(lambda: reddest(tab) > 150, "the ball is back")
    tab.pick("mug")
    tab.after(lambda: tab.key("h"))
    assert not only(tab)["visible"]
    tab.after(lambda: tab.menu(MORE, "Show"))
    assert only(tab)["visible"]
    tab.after(lambda: tab.menu(MORE, "Hide"))
    assert not only(tab)["visible"]


def reddest(tab) -> int:
    """Red less blue in the middle of the red ball, of the picture."""
    x, y = tab.at(RED)
    box = tab.page.locator("#picture").bounding_box()
    red, _, blue = tab.page.evaluate(
        """([x, y]) => {
            const one = new OffscreenCanvas(1, 1);
            const g = one.getContext('2d', { willReadFrequently: true });
            const picture = document.querySelector('#picture');
            g.drawImage(picture, -Math.round(x * picture.width), -Math.round(y * picture.height));
            return [...g.getImageData(0, 0, 1, 1).data.slice(0, 3)];
        }""",
        [(x - box["x"]) / box["width"], (y - box["y"]) / box["height"]],
    )
    return red - blue


def test_show_alone_and_hide_all_others(tab) -> None:
    tab.keep(RED, "mug")
    tab.keep(BLUE, "bowl")
    tab.button("Show alone").click()
    tab.until(lambda: reddest(tab) < 100)
    tab.button("Show with the others").click()
    tab.until(lambda: reddest(tab) > 150)
    tab.after(lambda: tab.menu(MORE, "Hide all others"))
    tab.until(lambda: reddest(tab) < 100)
    assert tab.row("mug").get_attribute("data-hidden") is not None
    tab.after(lambda: tab.key("Shift+H"))
    tab.until(lambda: reddest(tab) > 150)
    before = tab.page.url
    tab.menu(MORE, "Frame")
    tab.until(lambda: tab.page.url != before)


def test_lock(tab) -> None:
    tab.keep(RED, "mug")
    tab.after(tab.row("mug").locator(".lock").click)
    assert only(tab)["locked"]
    assert tab.button("Delete from the list").is_disabled()
    tab.menu(MORE, "Unlock")
    tab.until(lambda: not only(tab)["locked"])
    tab.after(lambda: tab.menu(MORE, "Lock"))
    tab.key("F2")
    tab.page.locator("#objects .rename").fill("cup")
    tab.after(lambda: tab.key("Enter"), "error")
    assert tab.page.locator(".toast.bad").is_visible()
    assert only(tab)["name"] == "mug"


def test_join_and_split(tab) -> None:
    tab.keep(RED, "mug")
    tab.keep(BLUE, "bowl")
    tab.pick("mug", "bowl")
    assert tab.page.locator(".picked-count").inner_text() == "2 picked"
    tab.after(tab.button("Join").click)
    assert counts(tab) == {"mug": pytest.approx(2 * EACH, abs=30)}
    tab.pick("mug")
    tab.after(lambda: tab.menu("Split", "Connected parts"))
    assert sorted(counts(tab).values()) == [pytest.approx(EACH, abs=15)] * 2
    tab.after(lambda: tab.key("Control+z"))
    tab.pick("mug")
    tab.after(lambda: tab.menu("Split", "Left and right of the pivot"))
    left, right = sorted(one["centre"][0] for one in tab.serving.objects())
    assert left < -0.5
    assert right > 0.5
    tab.after(lambda: tab.key("Control+z"))
    tab.pick("mug")
    tab.after(lambda: tab.menu("Split", "Above and below the pivot"))
    heights = [one["centre"][2] for one in tab.serving.objects()]
    assert min(heights) < 0 < max(heights)
    tab.after(lambda: tab.key("Control+z"))
    tab.pick("mug")
    tab.after(lambda: tab.menu("Split", "Parts of the tree"), "error")
    assert "tree" in tab.page.locator(".toast.bad").inner_text()


def test_subtract_replace_and_delete(tab) -> None:
    tab.keep(RED, "mug")
    tab.keep(BLUE, "bowl")
    tab.pick("mug", "bowl")
    tab.after(tab.button("Join").click)
    tab.pick("mug")
    tab.click(BLUE)
    tab.after(tab.button("Subtract the selection").click)
    assert only(tab)["count"] == pytest.approx(EACH, abs=15)
    assert only(tab)["centre"][0] < -0.8
    tab.click(GREEN)
    tab.after(tab.button("Replace by the selection").click)
    assert only(tab)["centre"][1] > 2.5
    tab.after(tab.button("Delete from the list").click)
    assert tab.serving.objects() == []


def test_suggestions(tab) -> None:
    page = tab.page
    tab.menu("Suggest from a layer…", "things")
    rows = page.locator("#suggestions .row")
    tab.until(lambda: rows.count() == 3)
    selection = tab.after(rows.first.locator(".name").click)["selection"]
    assert selection["count"] == EACH
    tab.after(rows.first.get_by_role("button", name="Accept").click)
    tab.until(lambda: rows.count() == 2)
    tab.after(rows.first.get_by_role("button", name="Reject").click)
    tab.until(lambda: rows.count() == 1)
    assert len(tab.serving.objects()) == 1
    tab.after(tab.button("Accept all").click)
    assert len(tab.serving.objects()) == 2
    tab.after(lambda: tab.menu("Suggest from a layer…", "things"))
    tab.until(lambda: rows.count() == 3)
    grid = page.locator("#suggestions [role=grid]")
    grid.press("ArrowDown")
    tab.after(lambda: grid.press("Space"))
    assert tab.last("command")["name"] == "select_suggestion"
    tab.after(lambda: grid.press("x"))
    tab.until(lambda: rows.count() == 2)
    page.locator("#overlay").focus()
    tab.key("n")
    tab.after(lambda: tab.key("y"))
    tab.until(lambda: rows.count() == 1)
    tab.after(lambda: tab.key("Control+z"))
    tab.menu("Suggest from a layer", "things", "#suggestions .panel-head")
    tab.until(lambda: len(tab.of("finished")) == 3)
    tab.after(tab.button("Reject all").click)
    tab.until(lambda: rows.count() == 0)
    assert len(tab.serving.objects()) == 2


def edits(tab) -> list[str]:
    return [edit["kind"] for edit in tab.serving.state()["document"]["edits"]]


def test_edits(tab) -> None:
    tab.click(RED)
    tab.after(lambda: tab.menu(EDIT, "Duplicate"))
    assert edits(tab) == ["duplicate"]
    tab.menu(EDIT, "Recolour…")
    tab.after(lambda: tab.page.locator("#bar input[type=color]").fill("#0000ff", force=True))
    assert edits(tab) == ["duplicate", "recolour"]
    tab.key("Escape")  # the browser's own dialog of colours
    tab.page.locator("#overlay").focus()
    tab.after(lambda: tab.key("Control+Shift+A"), "selected", stage="final")
    tab.click(RED)
    tab.after(tab.button("Remove from the scene").click)
    assert edits(tab)[-1] == "remove"
    tab.after(lambda: tab.key("Control+z"))
    tab.keep(BLUE, "bowl")
    tab.after(lambda: tab.menu(MORE, "Duplicate in the scene"))
    tab.after(lambda: tab.menu(MORE, "Remove from the scene"))
    assert edits(tab)[-2:] == ["duplicate", "remove"]


def test_move(tab) -> None:
    tab.click(RED)
    tab.menu(EDIT, "Move")
    assert tab.button("Move").get_attribute("aria-pressed") == "true"
    tab.page.locator("#overlay").focus()
    tab.after(lambda: tab.key("ArrowRight"))
    assert edits(tab) == ["move"]
    for name in ("Rotate", "Scale", "Move"):
        tab.button(name).click()
        tab.page.locator("#overlay").focus()
        tab.after(lambda: tab.key("ArrowUp"))
        assert tab.last("command")["name"] == "move"
    moves = [m["arguments"] for m in tab.sent if m["type"] == "command"]
    assert moves[0]["translation"][0] > 0
    assert moves[1]["rotation"][0] < 1
    assert moves[2]["scale"] != 1
    before = tab.page.url
    tab.button("Frame the selection").click()
    tab.until(lambda: tab.page.url != before)


def exported(tab, kind: str, name: str, *, format: str | None = None) -> Path:
    """What a kind of export makes, as it is downloaded."""
    page = tab.page
    tab.button("Export").click()
    page.locator(f"label[for=kind-{kind}]").click()
    if format is not None:
        page.locator("#export-format").select_option(format)
    page.locator("#export-name").fill(name)
    link = page.locator(".toast .link")
    tab.after(page.locator("#export button[type=submit]").click, "finished")
    tab.until(lambda: link.count() > 0)
    with page.expect_download() as download:
        link.last.click()
    page.locator(".toast").last.get_by_role("button", name="Dismiss").click()
    path = Path(download.value.path())
    return path.rename(path.with_name(download.value.suggested_filename))


def test_export_and_look_at_the_file(tab) -> None:
    tab.keep(RED, "mug")
    tab.button("Export").click()
    tab.page.locator("#export-which").select_option("picked")
    tab.button("Cancel", "#export").click()
    path = exported(tab, "splat", "one", format="ply")
    assert path.name == "one.ply"
    read = read_splats(path)
    assert len(read) == only(tab)["count"]
    scene = load_scene(tab.serving.scene).gaussians.means.numpy()
    of_red = scene[:EACH]
    distance = np.abs(read.means.numpy()[:, None] - of_red[None]).sum(2).min(1)
    assert distance.max() < 1e-6
    tab.pick("mug")
    tab.menu(MORE, "Export…")
    assert tab.page.locator("#kind-objects").is_checked()
    tab.button("Close", "#export").click()
    assert not tab.page.locator("#export").is_visible()


def test_exports_of_every_kind(tab) -> None:
    tab.keep(RED, "mug")
    tab.keep(BLUE, "bowl")
    tab.key("Control+Shift+A")
    with zipfile.ZipFile(exported(tab, "objects", "each")) as archive:
        assert sum(name.endswith(".ply") for name in archive.namelist()) in (1, 2)
    points = exported(tab, "points", "cloud", format="ply")
    assert points.read_bytes().startswith(b"ply")
    with exported(tab, "table", "list").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert {row["name"] for row in rows} <= {"mug", "bowl"}
    with zipfile.ZipFile(exported(tab, "coco", "panoptic")) as archive:
        (listing,) = (name for name in archive.namelist() if name.endswith(".json"))
        assert {"images", "annotations"} <= set(json.loads(archive.read(listing)))
    picture = exported(tab, "picture", "look")
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_save_layer(tab) -> None:
    tab.keep(RED, "mug")
    tab.button("Export").click()
    tab.page.locator("label[for=kind-save_layer]").click()
    name, save = tab.page.locator("#export-name"), tab.page.locator("#export [type=submit]")
    name.fill("by hand")
    assert not name.evaluate("field => field.checkValidity()"), "as the server, no spaces"
    save.click()
    assert tab.page.locator("#export").is_visible()
    name.fill("by-hand")
    tab.after(save.click, "finished")
    layer = load_scene_layer(tab.serving.scene, "by-hand")
    assert isinstance(layer, Labels)
    assert list(layer.info.names.values()) == ["mug"]
    assert int((layer.ids >= 0).sum()) == only(tab)["count"]
    for file in Path(tab.serving.scene).glob("**/by-hand*"):
        file.unlink()


def test_a_film_is_cancelled(tab) -> None:
    tab.button("Export").click()
    tab.page.locator("label[for=kind-film]").click()
    tab.page.locator("#export-frames").select_option("360")
    tab.page.locator("#export-name").fill("turn")
    tab.page.locator("#export button[type=submit]").click()
    cancel = tab.page.locator("#jobs").get_by_role("button", name="Cancel")
    cancel.click()
    tab.page.locator(".toast", has_text="cancelled").wait_for()
    assert not list(Path(tab.serving.scene).glob("exports/turn*"))
    assert tab.page.locator(".job").count() == 0
