"""What a page that draws is told: Gaussians by version, objects and selection of each."""

import struct
import tempfile
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from numpy.typing import NDArray

from splatseg.io.scene import load_scene
from splatseg.io.splats import read_splats
from splatseg.viewer import _guard as guard
from splatseg.viewer._streams import LEFT_OUT
from support.viewer import (
    BLUE_PIXEL,
    EACH,
    RED_PIXEL,
    Page,
    base_url,
    json_camera,
    logged_in,
    opened,
)

COUNT = 3 * EACH
RED, BLUE = slice(0, EACH), slice(EACH, 2 * EACH)


@pytest.fixture
def drawing(server) -> Any:
    """A page that draws, once it has the state."""
    with opened(server, stage="gpu") as page:
        yield page


def told(page: Page) -> None:
    """Wait until all that was asked has been answered."""
    page.send("depth", gesture=99, camera=json_camera(), x=1, y=1)
    page.next("point")


def stream(page: Page, kind: bytes) -> tuple[int, NDArray[Any]]:
    """The last stream of a kind: its version, and a value of each Gaussian."""
    told(page)
    data = [one for one in page.heard if isinstance(one, bytes) and one[:1] == kind][-1]
    version, count = struct.unpack_from("<II", data, 1)
    plain = np.frombuffer(zlib.decompress(data[9:]), dtype="<u2" if kind == b"O" else np.uint8)
    values = plain if kind == b"O" else np.unpackbits(plain)[:count].astype(bool)
    assert len(values) == count
    return version, values


def streams_heard(page: Page) -> list[bytes]:
    return [one[:1] for one in page.heard if isinstance(one, bytes) and one[:1] in (b"O", b"S")]


def test_a_page_that_draws_is_told_all_at_the_start(drawing) -> None:
    state = drawing.heard[0]
    assert state["stage"] == "server"
    assert (state["scene"]["low_pass"], state["scene"]["antialiased"]) == (0.3, False)
    version, codes = stream(drawing, b"O")
    again, members = stream(drawing, b"S")
    assert again == version
    assert codes.tolist() == [0] * COUNT
    assert not members.any()
    assert len(members) == COUNT


def test_other_pages_are_told_nothing(page) -> None:
    page.select(1, points=[RED_PIXEL])
    page.command("keep", name="mug")
    told(page)
    assert streams_heard(page) == []


def test_a_page_says_later_who_draws(page) -> None:
    page.select(1, points=[RED_PIXEL])
    page.send("stage", stage="gpu")
    version, _ = stream(page, b"O")
    assert stream(page, b"S")[1].nonzero()[0].tolist() == list(range(EACH))
    page.send("stage", stage="server")
    page.select(2, points=[BLUE_PIXEL])
    told(page)
    assert streams_heard(page) == [b"O", b"S"]
    page.send("stage", stage="gpu")
    assert stream(page, b"O")[0] == version
    assert stream(page, b"S")[1].nonzero()[0].tolist() == list(range(EACH, 2 * EACH))


def test_bits_are_the_selection_and_codes_the_objects(drawing) -> None:
    drawing.select(1, points=[RED_PIXEL])
    assert stream(drawing, b"S")[1].nonzero()[0].tolist() == list(range(EACH))
    mug = drawing.command("keep", name="mug")["objects"][0]["id"]
    _, codes = stream(drawing, b"O")
    assert set(codes[RED]) == {mug + 1}
    assert set(codes[EACH:]) == {0}
    assert not stream(drawing, b"S")[1].any()
    drawing.select(2, points=[BLUE_PIXEL])
    bowl = drawing.command("keep", name="bowl")["objects"][0]["id"]
    assert set(stream(drawing, b"O")[1][BLUE]) == {bowl + 1}
    before = streams_heard(drawing)
    drawing.command("rename", id=mug, name="cup")
    drawing.command("set_visible", ids=[mug], visible=False)
    told(drawing)
    assert streams_heard(drawing) == before, "hiding is the palette's"


def test_what_is_removed_is_left_out(drawing) -> None:
    version, _ = stream(drawing, b"O")
    drawing.select(1, points=[RED_PIXEL])
    drawing.command("remove")
    again, codes = stream(drawing, b"O")
    assert again == version
    assert set(codes[RED]) == {LEFT_OUT}
    assert set(codes[EACH:]) == {0}
    drawing.send("undo")
    assert stream(drawing, b"O")[1].tolist() == [0] * COUNT


def test_edits_that_move_make_another_version(server, drawing, things) -> None:
    own, _ = stream(drawing, b"O")
    drawing.select(1, points=[RED_PIXEL])
    mug = drawing.command("keep", name="mug")["objects"][0]["id"]
    drawing.command("duplicate", ids=[mug], translation=[0, 0, 2])
    moved, codes = stream(drawing, b"O")
    _, members = stream(drawing, b"S")
    assert moved != own
    assert len(codes) == len(members) == COUNT + EACH
    assert (codes > 0).sum() == 2 * EACH
    with logged_in(server) as client:
        assert client.get(f"/gaussians?version={own}").status_code == 404
        answer = client.get(f"/gaussians?version={moved}")
        path = things.parent / "moved.ply"
        path.write_bytes(answer.content)
        means = read_splats(path).means.numpy()
        assert len(means) == COUNT + EACH
        plain = load_scene(things).gaussians.means.numpy()
        copies = means[codes > 0]
        assert np.isclose(copies[:, 2].max(), plain[RED, 2].max() + 2, atol=1e-5)
        drawing.send("undo")
        back, codes = stream(drawing, b"O")
        assert (back, len(codes)) == (own, COUNT)
        assert client.get(f"/gaussians?version={own}").status_code == 200
        drawing.command("recolour", ids=[mug], colour=[0, 255, 0])
        other, codes = stream(drawing, b"O")
        assert other not in (own, moved)
        assert len(codes) == COUNT


def test_the_file_is_the_scenes_own(server, drawing, things) -> None:
    version, _ = stream(drawing, b"O")
    with logged_in(server) as client:
        answer = client.get(f"/gaussians?version={version}")
        assert answer.status_code == 200
        assert answer.content == (things / "gaussians.ply").read_bytes()
        assert answer.headers["cache-control"] == "no-store"


def test_a_scene_in_memory_is_written_once(serving, things, tmp_path) -> None:
    scene = replace(load_scene(things), root=None)
    server = serving(scene)
    with opened(server, stage="gpu") as page, logged_in(server) as client:
        version, _ = stream(page, b"O")
        answer = client.get(f"/gaussians?version={version}")
    path = tmp_path / "memory.ply"
    path.write_bytes(answer.content)
    assert np.array_equal(read_splats(path).means.numpy(), scene.gaussians.means.numpy())


@pytest.mark.parametrize(
    "query", ["", "version=", "version=-1", "version=1e3", "version=../../etc/passwd",
              "version=99999999999", "version=²"],
)  # fmt: skip
def test_versions_are_numbers(client, query) -> None:
    assert client.get(f"/gaussians?{query}").status_code == 400


def test_gaussians_are_behind_the_guard(server, drawing) -> None:
    version, _ = stream(drawing, b"O")
    address = f"{base_url(server)}/gaussians?version={version}"
    assert httpx.get(address).status_code == 403
    cookie = {"cookie": f"{server.access.cookie}=wrong"}
    assert httpx.get(address, headers=cookie).status_code == 403
    right = {"cookie": f"{server.access.cookie}={server.access.token}"}
    assert httpx.get(address, headers=right | {"host": "evil.example"}).status_code == 421
    assert httpx.get(address, headers=right).status_code == 200


def test_loads_are_limited(server, client, monkeypatch) -> None:
    monkeypatch.setattr(server, "_loads", guard.Rate(2, seconds=60))
    found = [client.get("/gaussians?version=1").status_code for _ in range(3)]
    assert found == [404, 404, 429]


def test_nothing_stays_in_the_temporary_folder(serving, things, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    server = serving(replace(load_scene(things), root=None))
    with opened(server, stage="gpu") as page, logged_in(server) as client:
        version, _ = stream(page, b"O")
        assert client.get(f"/gaussians?version={version}").status_code == 200
    assert list(tmp_path.glob("splatseg-view-*/*.ply")) != []
    server.close()
    assert list(tmp_path.glob("splatseg-view-*")) == []


def test_the_server_may_choose_the_stage(serving) -> None:
    with opened(serving(stage="gpu")) as page:
        assert page.heard[0]["stage"] == "gpu"


def test_path_of_the_scene_is_never_in_an_answer(server, drawing, things: Path) -> None:
    version, _ = stream(drawing, b"O")
    with logged_in(server) as client:
        answer = client.get(f"/gaussians?version={version}")
    assert str(things.parent) not in str(answer.headers)
