"""A real server on a small scene, and pages that speak to it as ours does."""

import io
import json
import re
import shutil
import sys
import threading
import time
import zipfile
from dataclasses import replace
from typing import Any

import httpx
import numpy as np
import pytest
import torch
from websockets.exceptions import ConnectionClosed

from splatseg.errors import InputError
from splatseg.io.scene import load_scene, save_scene, save_scene_layer
from splatseg.viewer._job_process import main
from splatseg.viewer._server import ViewServer
from support.viewer import (
    BLUE_PIXEL,
    EACH,
    HEIGHT,
    MATRIX,
    NOTHING,
    RED_PIXEL,
    WIDTH,
    json_camera,
    opened,
)


def near(colour: tuple[int, int, int], red: int, green: int, blue: int) -> bool:
    return max(abs(a - b) for a, b in zip(colour, (red, green, blue), strict=True)) < 60


def test_hello_is_answered_with_all_that_is_to_be_shown(page) -> None:
    state = page.heard[0]
    assert state["version"] == 1
    scene = state["scene"]
    assert (scene["name"], scene["count"], scene["up"]) == ("scene", 3 * EACH, [0, 0, 1])
    assert scene["home"]["matrix"] == pytest.approx(MATRIX.ravel().tolist())
    assert scene["home"]["focal"] / scene["home"]["width"] == pytest.approx(90 / 96)
    (view,) = state["views"]
    assert (view["name"], view["width"], view["height"]) == ("first", WIDTH, HEIGHT)
    assert (view["fx"], view["cx"], view["split"], view["photograph"]) == (90, 48, "train", True)
    assert state["layers"] == ["things"]
    assert state["document"]["objects"] == []
    assert state["document"]["selection"] is None
    assert (state["undo"], state["redo"], state["clients"], state["me"]) == (None, None, 1, 1)
    assert state["fitting"] is None
    assert "colour" in state["modes"]
    assert "pca" not in state["modes"], "there is no layer of features"


def test_the_page_is_told_when_the_first_click_is_quick(server) -> None:
    with opened(server, hello=False) as page:
        page.send("hello", version=1)
        state = page.next("state")
        if not state["ready"]:
            page.next("ready")
    with opened(server) as second:
        assert second.heard[0]["ready"]


def test_pictures_are_those_of_the_camera(page) -> None:
    frame = page.still(5)
    assert frame.size == (WIDTH, HEIGHT)
    assert frame.rest
    assert frame.scale == 1
    assert near(frame.rgb(*RED_PIXEL), 230, 26, 26)
    assert near(frame.rgb(*BLUE_PIXEL), 26, 26, 230)
    assert near(frame.rgb(*NOTHING), 0, 0, 0)
    matrix = MATRIX.copy()
    matrix[0, 3] = 2.0  # to the right: the blue ball is left of the middle
    moved = page.still(6, matrix=matrix.ravel().tolist())
    assert near(moved.rgb(48 - 22.5, 36), 26, 26, 230)


def test_while_it_moves_pictures_are_smaller_but_not_below_their_floor(page) -> None:
    page.draw(1, width=960, height=720, focal=900)
    frame = page.frame(1)
    assert not frame.rest
    assert 0.4 <= frame.scale <= 1
    assert frame.size[0] == pytest.approx(960 * frame.scale, abs=1)


def test_of_many_cameras_the_newest_is_drawn_and_none_waits(page) -> None:
    for id in range(1, 60):
        page.draw(id, width=640, height=480)
    drawn = [page.frame().camera]
    while drawn[-1] != 59:
        drawn.append(page.frame().camera)
    assert drawn == sorted(set(drawn)), "none twice, none late"
    assert len(drawn) < 40, "those between were dropped"


def test_modes_and_one_object_alone(page) -> None:
    page.select(1, points=[RED_PIXEL])
    patch = page.command("keep", name="red", colour=[0, 255, 0])
    red = patch["objects"][0]["id"]
    assert near(page.still(1, mode="objects").rgb(*RED_PIXEL), 0, 255, 0)
    alone = page.still(2, only=red)
    assert near(alone.rgb(*RED_PIXEL), 230, 26, 26)
    assert near(alone.rgb(*BLUE_PIXEL), 0, 0, 0)
    for id, mode in enumerate(("blend", "confidence", "depth"), start=3):
        assert page.still(id, mode=mode).size == (WIDTH, HEIGHT)
    page.draw(9, only=77)
    assert "77" in page.next("error")["text"]


def test_pictures_of_values_have_a_legend_once_while_it_is_the_same(page) -> None:
    ramp = page.heard[0]["ramp"]
    assert (ramp[0], ramp[-1]) == ("#440154", "#fde725")
    start = len(page.heard)
    for id, mode in enumerate(("colour", "confidence", "confidence", "depth", "colour"), start=1):
        page.still(id, mode=mode)
    page.draw(9, mode="depth")  # in motion nothing is said
    page.frame(9)
    page.send("hint")
    page.next("hint")
    said = [one for one in page.heard[start:] if isinstance(one, dict) and one["type"] == "legend"]
    assert [one["mode"] for one in said] == ["colour", "confidence", "depth", "colour"]
    assert [one["ends"] for one in said[::3]] == [None, None]
    assert said[1]["ends"] == [0, 1]
    far, near = said[2]["ends"]
    assert 3 < near < 4 < far < 8


def test_a_move_under_way_is_drawn_and_nothing_is_changed(page) -> None:
    page.select(1, points=[RED_PIXEL])
    plain = page.still(1)
    there = (26, 20)
    assert plain.rgb(*RED_PIXEL)[0] > 100 > plain.rgb(*there)[0]
    preview = {"ids": None, "translation": [0, 0, 0.8]}
    moved = page.still(2, preview=preview)
    assert moved.rgb(*there)[0] > 100
    assert moved.rgb(*RED_PIXEL)[0] < 60
    assert np.array_equal(page.still(3).bgr, plain.bgr)
    page.command("keep", name="mug")
    moved = page.still(4, preview=preview | {"ids": [1]})
    assert moved.rgb(*there)[0] > 100
    for gone in (preview, preview | {"ids": [7]}):
        assert page.still(5, preview=gone).rgb(*RED_PIXEL)[0] > 100, "there is nothing to move"
    page.command("select_object", id=1)
    patch = page.command("move", translation=[0, 0, 0.8])
    assert patch["selection"]["centre"][2] == pytest.approx(0.8, abs=0.1)
    assert patch["objects"][0]["centre"] == patch["selection"]["centre"]
    assert page.select(2, points=[there])["count"] == pytest.approx(EACH, abs=15)
    page.send("undo")
    assert page.next("patch")["objects"] == []
    page.send("undo")
    back = page.next("patch")["objects"][0]["centre"]
    assert back[2] == pytest.approx(0, abs=0.1)


def test_the_id_map_names_what_is_under_each_pixel(page) -> None:
    page.draw(1, rest=True, ids=True)
    things = page.ids()
    assert things[2, 2] == 0
    assert things[36, 26] >= 49152, "what a click would select has an outline before"
    assert things[36, 70] >= 49152
    assert things[36, 26] != things[36, 70]
    page.select(1, points=[RED_PIXEL])
    red = page.command("keep", name="red")["objects"][0]["id"]
    page.send("job", id=1, name="suggest", arguments={"layer": "things"})
    suggestions = page.next("patch")["suggestions"]
    page.next("finished", id=1)
    page.draw(2, rest=True, ids=True)
    page.frame(2)
    ids = page.ids()
    assert ids.shape == (HEIGHT, WIDTH)
    assert ids[36, 26] == red + 1
    blue = next(one["id"] for one in suggestions if one["centre"][0] > 0.5)
    assert ids[36, 70] == 32768 + blue
    assert ids[2, 2] == 0


def test_a_click_is_answered_twice_and_drawn(page) -> None:
    before = page.still(1)
    page.send("select", gesture=4, kind="click", camera=json_camera(), points=[RED_PIXEL])
    draft = page.next("selected")
    final = page.next("selected")
    assert [(one["gesture"], one["stage"]) for one in (draft, final)] == [
        (4, "draft"), (4, "final"),
    ]  # fmt: skip
    assert final["count"] == pytest.approx(EACH, abs=15)
    assert 0.5 <= final["confidence"] <= 1
    assert final["milliseconds"] >= draft["milliseconds"] > 0
    assert "draft" in final["stages"]
    kinds = [
        one["stage"] if isinstance(one, dict) else one[:1]
        for one in page.heard
        if isinstance(one, bytes) or one["type"] == "selected"
    ]
    assert kinds[-3:] == ["draft", b"F", "final"], "the draft is drawn before the rest is done"
    patch = next(one for one in page.heard if isinstance(one, dict) and one["type"] == "patch")
    assert patch["selection"]["count"] == final["count"]
    np.testing.assert_allclose(patch["selection"]["centre"], [-1, 0, 0], atol=0.2)
    assert (patch["from"], patch["to"]) == (0, 1)
    assert patch["undo"]
    assert patch["redo"] is None
    # The document changed: the last camera is drawn again, with the tint.
    tinted = page.still(2)
    assert tinted.rgb(*RED_PIXEL) != before.rgb(*RED_PIXEL)
    assert near(tinted.rgb(*BLUE_PIXEL), *before.rgb(*BLUE_PIXEL))


def test_a_change_is_drawn_without_being_asked_for(page) -> None:
    page.still(7)
    page.select(1, points=[BLUE_PIXEL])
    assert page.frame(7).rest


def test_a_refined_gesture_starts_from_what_was_selected_before_it(page) -> None:
    red = page.select(1, points=[RED_PIXEL])["count"]
    both = page.select(2, points=[BLUE_PIXEL], mode="add")["count"]
    assert both == pytest.approx(2 * EACH, abs=30)
    # The same gesture with another point: blue is no longer meant, red still is there.
    again = page.select(2, points=[RED_PIXEL], mode="add")["count"]
    assert again == red
    less = page.select(3, points=[RED_PIXEL], mode="remove")["count"]
    assert less == 0


@pytest.mark.parametrize(
    ("kind", "fields", "expected"),
    [
        ("box", {"box": [10, 20, 42, 52]}, EACH),
        ("stroke", {"points": [[20, 36], [32, 36]], "width": 6}, EACH),
        ("lasso", {"points": [[5, 15], [46, 15], [46, 57], [5, 57]]}, EACH),
        ("polygon", {"points": [[5, 15], [46, 15], [46, 57], [5, 57]]}, EACH),
        ("sphere", {"points": [RED_PIXEL], "radius": 1.0}, EACH),
        ("all", {}, 3 * EACH),
        ("invert", {}, 3 * EACH),
        ("none", {}, 0),
        ("click", {"points": [RED_PIXEL], "camera": None, "view": "first"}, EACH),
    ],
)
def test_what_is_shown_is_selected(page, kind, fields, expected) -> None:
    found = page.select(1, kind, **fields)
    assert found["count"] == pytest.approx(expected, abs=30)


def test_a_selection_grows_shrinks_and_turns_round(page) -> None:
    first = page.select(1, "sphere", points=[RED_PIXEL], radius=0.4)["count"]
    assert 0 < first < EACH
    smaller = page.select(2, "shrink")["count"]
    assert 0 < smaller < first
    assert page.select(3, "grow")["count"] > smaller
    filled = page.select(4, "fill")["count"]
    assert page.select(5, "invert")["count"] == 3 * EACH - filled


def test_more_of_the_same_is_what_the_layer_says_is_alike(page) -> None:
    page.select(1, points=[RED_PIXEL])
    assert page.select(2, "similar")["count"] == pytest.approx(EACH, abs=15)


@pytest.mark.parametrize(
    ("kind", "fields", "words"),
    [
        ("click", {"points": [], "negative": []}, "got none"),
        ("click", {"points": [[500, 5]]}, "500"),
        ("click", {"points": [RED_PIXEL], "camera": None}, "camera or a view"),
        ("click", {"points": [RED_PIXEL], "view": "../first"}, "view"),
        ("sphere", {"points": [NOTHING], "radius": 1}, "nothing of the scene"),
        ("sphere", {"points": [RED_PIXEL]}, "radius"),
        ("lasso", {"points": [[1, 1], [2, 2]]}, "corners"),
        ("grow", {}, "selection"),
        ("similar", {}, "selection"),
        ("layer", {"text": "../things"}, "layer"),
        ("box", {"box": [5, 5, 5, 5]}, "x0 < x1"),
        ("stroke", {"points": [[-50, -50], [-60, -60]]}, "got none"),
        ("words", {"text": "mug"}, ""),
        ("click", {"points": [RED_PIXEL], "mode": "intersect"}, "select something first"),
    ],
)
def test_what_shows_nothing_is_said_with_its_gesture(page, kind, fields, words) -> None:
    page.send("select", **{"gesture": 8, "kind": kind, "camera": json_camera(), **fields})
    error = page.next("error")
    assert error["gesture"] == 8
    assert words in f"{error['text']} {error['fix']}"
    assert page.select(9, points=[RED_PIXEL])["count"], "the server goes on"


def test_what_labels_hold_is_selected(page) -> None:
    assert page.select(1, "layer", text="things")["count"] == 3 * EACH


def test_commands_change_the_document_of_all(server, page) -> None:
    with opened(server) as other:
        assert page.next("clients")["n"] == 2
        assert other.heard[0]["clients"] == 2
        page.select(1, points=[RED_PIXEL])
        kept = page.command("keep", name="mug", class_name="cup")
        heard = other.next("patch", to=kept["to"])
        assert heard["objects"] == kept["objects"]
        assert heard["author"] == "1"
        (mug,) = kept["objects"]
        assert (mug["name"], mug["class"], mug["visible"], mug["locked"]) == (
            "mug", "cup", True, False,
        )  # fmt: skip
        np.testing.assert_allclose(mug["centre"], [-1, 0, 0], atol=0.2)
        assert 0.2 < mug["radius"] < 0.6
        assert kept["selection"] is None
        assert kept["undo"] == "Keep mug"
        other.send("command", name="rename", arguments={"id": mug["id"], "name": "jug"})
        renamed = page.next("patch", to=kept["to"] + 1)
        assert renamed["objects"][0]["name"] == "jug"
        assert renamed["author"] == "2"
        assert renamed["gone"] == []
        assert renamed["order"] is None
        undone = page_undo(page)
        assert undone["objects"][0]["name"] == "mug"
        assert undone["redo"] == "Rename mug"
        other.next("patch", to=undone["to"])
        other.send("redo")
        assert page.next("patch")["objects"][0]["name"] == "jug"
    assert page.next("clients")["n"] == 1


def page_undo(page) -> dict:
    page.send("undo")
    return page.next("patch")


def test_undo_goes_back_over_selections_to_the_start(page) -> None:
    page.select(1, points=[RED_PIXEL])
    page.select(2, points=[BLUE_PIXEL])
    assert page_undo(page)["selection"]["centre"][0] == pytest.approx(-1, abs=0.2)
    patch = page_undo(page)
    assert patch["selection"] is None
    assert patch["undo"] is None
    page.send("undo")
    assert "undo" in page.next("error")["text"]


def test_what_another_changed_is_not_overwritten_unseen(server, page) -> None:
    page.select(1, points=[RED_PIXEL])
    kept = page.command("keep", name="mug")
    id = kept["objects"][0]["id"]
    with opened(server) as other:
        other.command("rename", id=id, name="jug")
        page.next("patch")
        page.send(
            "command", name="rename", arguments={"id": id, "name": "pot"}, revision=kept["to"]
        )
        error = page.next("error", command="rename")
        assert "changed since you saw it" in error["text"]


def test_objects_are_organised(page) -> None:
    page.select(1, points=[RED_PIXEL])
    red = page.command("keep", name="red")["objects"][0]["id"]
    page.select(2, points=[BLUE_PIXEL])
    blue = page.command("keep", name="blue")["objects"][0]["id"]
    assert page.command("set_colour", ids=[red], colour=[9, 8, 7])["objects"][0]["colour"] == [
        9, 8, 7,
    ]  # fmt: skip
    page.command("set_visible", ids=[red], visible=False)
    assert near(page.still(1).rgb(*RED_PIXEL), 0, 0, 0)
    page.command("set_visible", ids=[red], visible=True)
    assert page.command("isolate", ids=[red])["isolated"] == [red]
    assert near(page.still(2).rgb(*BLUE_PIXEL), 0, 0, 0)
    assert page.command("isolate", ids=[])["isolated"] == []
    page.command("set_locked", ids=[red], locked=True)
    assert "locked" in page.refused("delete", ids=[red])["text"]
    page.command("set_locked", ids=[red], locked=False)
    joined = page.command("join", ids=[red, blue], name="pair")
    assert joined["gone"] == [blue]
    assert joined["objects"][0]["count"] > EACH * 1.5
    split = page.command("split", id=red, by="parts")
    assert len(split["objects"]) == 2
    assert split["order"] is not None
    selected = page.command("select_object", id=red)
    assert selected["selection"]["count"] == pytest.approx(EACH, abs=20)
    page.command("select_object", ids=[one["id"] for one in split["objects"]], mode="remove")
    gone = page.command("delete", ids=[one["id"] for one in split["objects"]])
    assert sorted(gone["gone"]) == sorted(one["id"] for one in split["objects"])


def test_objects_give_to_and_take_from_the_selection(page) -> None:
    page.select(1, points=[RED_PIXEL])
    red = page.command("keep", name="red")["objects"][0]
    page.select(2, "all")
    assert page.command("refine", id=red["id"])["objects"][0]["count"] == 3 * EACH
    page.select(3, points=[RED_PIXEL])
    taken = page.command("subtract", id=red["id"])["objects"][0]
    assert taken["count"] == pytest.approx(2 * EACH, abs=20)
    page.select(4, "none")
    for name in ("subtract", "refine"):
        assert "click first" in page.refused(name, id=red["id"])["fix"]


def test_edits_are_shown_and_kept_apart_from_the_scene(page, things) -> None:
    page.select(1, points=[RED_PIXEL])
    removed = page.command("remove")
    assert [one["kind"] for one in removed["edits"]] == ["remove"]
    assert near(page.still(1).rgb(*RED_PIXEL), 0, 0, 0)
    page.select(2, points=[BLUE_PIXEL])
    page.command("recolour", colour=[255, 255, 0])
    page.command("duplicate", translation=[0, 0, 1])
    assert [one["kind"] for one in page.command("move", scale=2)["edits"]][-1] == "move"
    assert len(load_scene(things).gaussians) == 3 * EACH


def test_suggestions_are_accepted_and_rejected(serving) -> None:
    with opened(serving(layer="things")) as page:
        suggestions = page.heard[0]["document"]["suggestions"]
        assert sorted(one["count"] for one in suggestions) == [EACH] * 3
        first, second, third = (one["id"] for one in suggestions)
        taken = page.command("accept", ids=[first])
        assert len(taken["objects"]) == 1
        assert len(taken["suggestions"]) == 2
        assert page.command("select_suggestion", id=second)["selection"]["count"] == EACH
        assert [one["id"] for one in page.command("reject", ids=[second])["suggestions"]] == [third]
        assert "expected one of those" in page.refused("select_suggestion", id=second)["text"]


def test_depth_is_the_point_under_the_pixel(page) -> None:
    page.send("depth", gesture=1, camera=json_camera(), x=RED_PIXEL[0], y=RED_PIXEL[1])
    point = page.next("point", gesture=1)["point"]
    assert np.linalg.norm(np.array(point) - [-1, 0, 0]) < 0.7
    assert point[1] < 0
    page.send("depth", gesture=2, camera=json_camera(), x=NOTHING[0], y=NOTHING[1])
    assert page.next("point", gesture=2)["point"] is None
    page.send("depth", gesture=3, camera=json_camera(), x=-5, y=1e6)
    assert page.next("point", gesture=3)["point"] is None


def test_a_hint_comes_when_there_is_time(page) -> None:
    page.send("hint")
    answer = page.next("hint")
    assert (answer["x"], answer["y"], answer["view"]) == (None, None, None)
    page.select(1, points=[RED_PIXEL])
    page.send("hint")
    answer = page.next("hint")
    assert answer["view"] in (None, "first")


def test_a_new_page_has_what_another_made_and_so_has_a_new_server(serving, things) -> None:
    server = serving()
    with opened(server) as page:
        page.select(1, points=[RED_PIXEL])
        page.command("keep", name="mug")
        page.select(2, points=[BLUE_PIXEL])
    with opened(server) as again:
        document = again.heard[0]["document"]
    server.close()
    with opened(serving()) as later:
        state = later.heard[0]
        assert state["document"] == document
        assert [one["name"] for one in document["objects"]] == ["mug"]
        assert document["selection"]["count"] > 0
        assert page_undo(later)["selection"] is None


def test_a_second_server_of_the_scene_is_refused(server, serving) -> None:
    with pytest.raises(InputError, match=r"(?i)another|open"):
        serving()
    with opened(server) as page:
        assert page.still(1).rest, "the first goes on"


def test_photographs_are_sent_as_jpeg(client) -> None:
    answer = client.get("/photographs/first", params={"width": 48})
    assert answer.status_code == 200
    assert answer.headers["content-type"] == "image/jpeg"
    import cv2

    image = cv2.imdecode(np.frombuffer(answer.content, dtype=np.uint8), cv2.IMREAD_COLOR)
    assert image.shape == (36, 48, 3)
    assert near(tuple(image[10, 10, ::-1].tolist()), 200, 100, 50)


def finished(page, id: int) -> dict:
    """The end of a job; an error shows itself."""
    return page.until(
        lambda message: (
            isinstance(message, dict)
            and message["type"] in ("finished", "error")
            and message["id"] == id
        )
    )


def test_what_is_exported_can_be_fetched(client, page) -> None:
    page.select(1, points=[RED_PIXEL])
    red = page.command("keep", name="red")["objects"][0]
    given = {"what": "splat", "name": "red", "ids": [red["id"]]}
    page.send("job", id=1, name="export", arguments=given)
    file = finished(page, 1)["result"]["file"]
    answer = client.get(f"/exports/{file}")
    assert answer.status_code == 200
    assert answer.content.startswith(b"ply")
    assert f"element vertex {red['count']}".encode() in answer.content[:200]
    assert "attachment" in answer.headers["content-disposition"]
    page.send("job", id=2, name="export", arguments={"what": "objects", "name": "all"})
    file = finished(page, 2)["result"]["file"]
    assert file == "all.zip"
    with zipfile.ZipFile(io.BytesIO(client.get(f"/exports/{file}").content)) as archive:
        assert "all/objects.json" in archive.namelist()
        assert any(name.endswith(".ply") for name in archive.namelist())
    given = {"what": "objects", "name": "small", "format": "spz"}
    page.send("job", id=3, name="export", arguments=given)
    content = client.get(f"/exports/{finished(page, 3)['result']['file']}").content
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        assert any(name.endswith(".spz") for name in archive.namelist())
    page.send("job", id=4, name="export", arguments={"what": "splat", "name": "all.spz"})
    assert finished(page, 4)["result"]["file"] == "all.spz"


def test_a_layer_is_saved_and_listed(page, things) -> None:
    page.select(1, points=[RED_PIXEL])
    page.command("keep", name="red")
    page.send("job", id=1, name="save_layer", arguments={"name": "mine"})
    assert page.next("state")["layers"] == ["mine", "things"]
    finished(page, 1)
    layer = load_scene(things).layers["mine"]
    assert int((layer.ids >= 0).sum()) == pytest.approx(EACH, abs=15)
    page.send("job", id=2, name="save_layer", arguments={"name": "things"})
    assert "choose another name" in f"{finished(page, 2)}"


def test_pictures_and_films_are_files(client, page) -> None:
    page.send("job", id=1, name="picture", arguments={"camera": json_camera(), "name": "front"})
    assert finished(page, 1)["result"]["file"] == "front.png"
    page.send("job", id=2, name="picture", arguments={"camera": json_camera(), "name": "front"})
    assert finished(page, 2)["result"]["file"] == "front-2.png"
    assert client.get("/exports/front.png").content[1:4] == b"PNG"
    page.send("job", id=3, name="film", arguments={"camera": json_camera(), "frames": 4})
    assert finished(page, 3)["result"]["file"] == "turntable.mp4"
    assert client.get("/exports/turntable.mp4").content[4:8] == b"ftyp"
    steps = [one for one in page.heard if isinstance(one, dict) and one["type"] == "progress"]
    assert [(one["done"], one["total"]) for one in steps if one["id"] == 3] == [
        (i, 4) for i in range(4)
    ]


def test_pages_are_answered_while_a_job_goes_on_and_it_can_be_cancelled(page, things) -> None:
    given = {"camera": json_camera(), "frames": 1000}
    page.send("job", id=1, name="film", arguments=given)
    page.next("progress", id=1)
    page.still(1)
    assert page.select(1, points=[RED_PIXEL])["count"]
    assert not any(
        isinstance(one, dict) and one["type"] in ("finished", "error") for one in page.heard
    )
    page.send("cancel", id=1)
    assert finished(page, 1)["text"] == "cancelled"
    assert not list((things / "exports").glob("*.mp4"))


def test_masks_are_made_beside_the_drawing(page, things) -> None:
    page.send("job", id=1, name="see", arguments={"model": "classical"})
    page.next("progress", id=1)
    assert page.still(1).size == (WIDTH, HEIGHT)
    assert finished(page, 1)["type"] == "finished"
    assert list((things / "evidence" / "masks").glob("first*"))
    assert any(isinstance(one, dict) and one["type"] == "state" for one in page.heard[1:])


def test_the_process_of_a_job_says_how_far_it_is_and_how_it_ends(things) -> None:
    def said(name: str, **given: str) -> tuple[int, list[dict]]:
        out = io.StringIO()
        status = main([name, str(things), "cpu"], io.StringIO(json.dumps(given)), out)
        return status, [json.loads(line) for line in out.getvalue().splitlines()]

    status, lines = said("see", model="classical")
    assert status == 0
    assert all(set(line) == {"done", "total", "text"} for line in lines[:-1])
    assert (lines[-2]["done"], lines[-2]["total"]) == (1, 1)
    assert lines[-1] == {"text": "masks of 1 view by classical"}
    assert said("see")[1] == [{"text": "masks are at hand"}]
    assert re.fullmatch(r"\d+ objects? in layer masks", said("associate")[1][-1]["text"])
    assert set(load_scene(things).layers) == {"masks", "things"}
    # What was made in another way is not replaced, what was associated is.
    save_scene_layer(load_scene(things).layers["things"], things, "masks")
    assert said("associate")[1][-1]["text"].endswith(" in layer masks_2")
    assert said("associate")[1][-1]["text"].endswith(" in layer masks_2")
    status, lines = said("see", model="../masks")
    assert status == 2
    assert "expected one of" in lines[-1]["error"]


def test_what_is_at_hand_makes_masks(things, monkeypatch) -> None:
    from splatseg import models
    from splatseg.errors import MissingFileError
    from splatseg.viewer import _job_process

    asked: list[str] = []

    def find(name: str) -> str:
        asked.append(name)
        if name == "sam":
            return "the model"
        raise MissingFileError("weights: not on this machine.")

    monkeypatch.setattr(models, "find_model", find)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert _job_process._model_at_hand() == "regions"
    assert asked == []
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert _job_process._model_at_hand() == "the model"
    assert asked == ["sam2", "sam-hq", "sam"]


def test_masks_at_hand_cover_all_views_those_of_sam_first(things) -> None:
    from splatseg.tasks.work import Work
    from splatseg.viewer._job_process import masks_at_hand

    def at_hand() -> str | None:
        return masks_at_hand(Work(scene=load_scene(things)))

    assert at_hand() is None
    main(["see", str(things), "cpu"], io.StringIO("{}"), io.StringIO())
    assert at_hand() == "masks"
    shutil.copytree(things / "evidence" / "masks", things / "evidence" / "big_sam")
    assert at_hand() == "big_sam"
    for path in (things / "evidence" / "big_sam").glob("first*"):
        path.unlink()
    assert at_hand() == "masks"


def test_masks_that_were_stopped_are_gone_on_with(things, monkeypatch) -> None:
    from splatseg.models.regions import Regions

    views = load_scene(things)
    second = replace(views.views[0], name="second")
    save_scene(replace(views, views=(*views.views, second)), things)
    masks, seen = Regions.masks_with_depth, []

    def stopped(self, image, *depth):
        seen.append(image)
        if len(seen) == 2:
            raise KeyboardInterrupt
        return masks(self, image, *depth)

    with monkeypatch.context() as patch:
        patch.setattr(Regions, "masks_with_depth", stopped)
        with pytest.raises(KeyboardInterrupt):
            main(["see", str(things), "cpu"], io.StringIO("{}"), io.StringIO())
    out = io.StringIO()
    assert main(["see", str(things), "cpu"], io.StringIO("{}"), out) == 0
    assert "masks of 2 views by regions" in out.getvalue()


def test_a_job_ends_with_the_server(serving, things, monkeypatch) -> None:
    from splatseg.viewer import _jobs

    started: list[Any] = []
    popen = _jobs.subprocess.Popen

    def start(command, **options):
        started.append(popen([sys.executable, "-c", "import time; time.sleep(600)"], **options))
        return started[0]

    monkeypatch.setattr(_jobs.subprocess, "Popen", start)
    server = serving()
    with opened(server) as page:
        page.send("job", id=1, name="see")
        page.still(1)
        while not started:
            time.sleep(0.01)
        began = time.monotonic()
        server.close()
    assert time.monotonic() - began < 5
    assert started[0].poll() is not None, "it does not outlive the server"


def test_after_a_layer_was_made_the_first_click_is_prepared(page, monkeypatch) -> None:
    from splatseg.viewer import _jobs
    from splatseg.viewer import _messages as messages
    from splatseg.viewer._session import Session

    prepared: list[int] = []
    monkeypatch.setattr(Session, "prepare", lambda self: prepared.append(1))

    def begin(job, root, backend, given, done):
        thread = threading.Thread(target=lambda: done(endings.pop()))
        thread.start()
        return thread

    endings: list[Any] = [
        messages.Finished(id=2, result={}),
        messages.Error(text="cancelled", id=1),
    ]
    monkeypatch.setattr(_jobs, "start_process", begin)
    page.send("job", id=1, name="associate")
    assert finished(page, 1)["type"] == "error"
    page.still(1)
    assert prepared == []
    page.send("job", id=2, name="associate")
    assert finished(page, 2)["type"] == "finished"
    page.still(2)
    assert prepared == [1]


def test_an_error_in_an_answer_leaves_the_server_running(page, monkeypatch, caplog) -> None:
    from splatseg.viewer._draw import Drawer

    def fail(*_: object, **__: object) -> None:
        raise ZeroDivisionError("secret /home/someone/path")

    with monkeypatch.context() as patch:
        patch.setattr(Drawer, "picture", fail)
        page.draw(1, rest=True)
        error = page.next("error")
    assert "secret" not in error["text"]
    assert "something is wrong" in error["text"]
    assert page.still(2).size == (WIDTH, HEIGHT)


def test_an_idle_server_costs_no_cpu(server, page) -> None:
    page.still(1)
    while not page.heard[0]["ready"] and page.next("ready"):
        break
    time.sleep(0.3)
    began = time.process_time()
    time.sleep(2)
    assert time.process_time() - began < 0.1


def test_nothing_is_left_when_it_ends(serving) -> None:
    before = threading.active_count()
    server = serving()
    with opened(server) as page:
        page.still(1)
        server.close()
        with pytest.raises(ConnectionClosed):
            page.until(lambda _: False)
    assert threading.active_count() <= before + 1
    with pytest.raises(httpx.ConnectError):
        httpx.get(f"http://127.0.0.1:{server.access.port}/")


def test_a_port_that_is_taken_is_said(server, made_things) -> None:
    with pytest.raises(InputError, match=r"^port: expected a free port of 127.0.0.1"):
        ViewServer(server.worker, port=server.access.port)
    with pytest.raises(InputError, match=r"^host: expected an address of this machine"):
        ViewServer(server.worker, host="no such name.invalid")
