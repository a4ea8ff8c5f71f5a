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
    sent = len(tab.sent)
    tab.page.locator("#level").fill("1")
    tab.pause(250)
    assert "select" not in [one["type"] for one in tab.sent[sent:]], "what was kept is over"
    tab.page.locator("#level").fill("0.5")
    tab.click(BLUE)
    tab.page.locator("#overlay").focus()
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


def reddest(tab, point=RED) -> int:
    """Red less blue in the middle of the red ball, of the picture."""
    red, _, blue = tab.colour(point)
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


def grip(tab) -> tuple[float, float]:
    """The handle in the middle of what is selected, where the page was told that it is."""
    return tab.at(tab.selection["centre"])


def test_a_move_is_seen_while_a_handle_is_dragged(tab) -> None:
    tab.click(RED)
    tab.button("Move").click()
    mouse, revision = tab.page.mouse, tab.serving.state()["document"]["revision"]
    above = (RED[0], RED[1], 1.0)
    assert reddest(tab) > 100
    assert reddest(tab, above) < 50

    def lift() -> tuple[float, float]:
        (x, y), (_, up) = grip(tab), tab.at(above)
        mouse.move(x, y)
        mouse.down()
        mouse.move(x, y - 20)
        mouse.move(x, up, steps=3)
        tab.until(lambda: reddest(tab, above) > 100, "the ball is where the handle is")
        tab.until(lambda: reddest(tab) < 50, "and not where it was")
        return x, up

    lift()
    assert tab.serving.state()["document"]["revision"] == revision
    preview = tab.last("camera")["preview"]
    assert preview["ids"] is None
    assert preview["translation"][2] == pytest.approx(1.0, abs=0.2)
    assert edits(tab) == []
    tab.key("Escape")
    tab.until(lambda: reddest(tab) > 100 and reddest(tab, above) < 50, "it is back")
    assert "preview" not in tab.last("camera")
    mouse.up()
    assert edits(tab) == []
    lift()
    patch = tab.after(mouse.up)
    assert patch["edits"] == [{"kind": "move", "count": patch["selection"]["count"]}]
    assert patch["selection"]["centre"][2] == pytest.approx(1.0, abs=0.2)
    tab.until(tab.quiet)
    assert reddest(tab, above) > 100
    start = len(tab.sent)
    x, y = grip(tab)
    tab.drag((x, y), (x + 60, y))
    tab.until(lambda: edits(tab) == ["move", "move"], "the handles went with it")
    asked = [one for one in tab.sent[start:] if one["type"] == "camera"]
    assert all(one["preview"]["about"][2] > 0.7 for one in asked if "preview" in one)


def test_objects_are_moved_by_their_handles(tab) -> None:
    tab.keep(RED, "mug")
    tab.pick("mug")
    tab.after(lambda: tab.key("Control+Shift+A"), "selected", stage="final")
    tab.page.locator("#overlay").focus()
    tab.button("Scale").click()
    centre = only(tab)["centre"]
    x, y = tab.at(centre)
    start = len(tab.sent)
    tab.after(lambda: tab.drag((x + 78, y), (x + 100, y), (x + 156, y)))
    previews = [one["preview"] for one in tab.sent[start:] if "preview" in one]
    assert previews
    assert previews[-1]["scale"] > 1.2
    assert previews[-1]["ids"] == [only(tab)["id"]]
    assert edits(tab) == ["move"]
    assert only(tab)["radius"] > 0.5, "the list knows that it is larger"


def test_clicks_follow_what_was_moved(tab) -> None:
    tab.click(RED)
    tab.button("Move").click()
    x, y = grip(tab)
    up = tab.at((RED[0], RED[1], 1.0))[1]
    tab.after(lambda: tab.drag((x, y), (x, y - 20), (x, up)))
    tab.key("c")
    tab.after(lambda: tab.key("Control+Shift+A"), "selected", stage="final")
    found = tab.click((RED[0], RED[1], 1.0))
    assert found["count"] == pytest.approx(EACH, abs=15)
    assert found["centre"] == pytest.approx((-1, 0, 1), abs=0.25)
    tab.after(lambda: tab.press_at(RED), "error")
    tab.after(tab.button("Remove from the scene").click)
    tab.after(lambda: tab.press_at((RED[0], RED[1], 1.0), aside=(9, 0)), "error")
    assert "sky" in tab.page.locator(".toast.bad").last.inner_text()


def exported(tab, kind: str, name: str, *, format: str | None = None, which: str = "") -> Path:
    """What a kind of export makes, as it is downloaded."""
    page = tab.page
    tab.button("Export").click()
    page.locator(f"label[for=kind-{kind}]").click()
    if format is not None:
        page.locator("#export-format").select_option(format)
    if which:
        page.locator("#export-which").select_option(which)
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
    which, name = tab.page.locator("#export-which"), tab.page.locator("#export-name")
    tab.button("Export").click()
    assert which.input_value() == "all", "though what was kept last is picked"
    assert name.input_value() == "balls"
    which.select_option("picked")
    assert name.input_value() == "mug"
    tab.button("Cancel", "#export").click()
    assert len(read_splats(exported(tab, "splat", "whole", format="ply"))) == 3 * EACH
    path = exported(tab, "splat", "one", format="ply", which="picked")
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
    assert which.input_value() == "picked", "as the menu of these says"
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
