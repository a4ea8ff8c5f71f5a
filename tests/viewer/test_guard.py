"""Section 9 of the design, point by point, from outside: plain HTTP and a WebSocket client."""

import json
import shutil
import socket
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from http.client import HTTPConnection
from pathlib import Path

import httpx
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus

from splatseg.io.scene import load_scene
from splatseg.viewer import _guard as guard
from splatseg.viewer import _messages as messages
from splatseg.viewer import _server
from splatseg.viewer._guard import Access, Rate
from splatseg.viewer._server import ViewServer, serve
from support.viewer import EACH, RED_PIXEL, Page, base_url, json_camera, opened


@pytest.fixture(scope="module")
def things(made_things, tmp_path_factory) -> Path:
    """One scene for all tests here."""
    folder = tmp_path_factory.mktemp("guard")
    shutil.copytree(made_things.parent / "photographs", folder / "photographs")
    return shutil.copytree(made_things, folder / "scene")


@pytest.fixture(scope="module")
def static(tmp_path_factory) -> Iterator[Path]:
    """One page for all tests here."""
    folder = tmp_path_factory.mktemp("page")
    (folder / "index.html").write_text("<!doctype html><title>splatseg</title>")
    (folder / "app.js").write_text("export {};\n")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_server, "STATIC", folder)
        yield folder


@pytest.fixture(scope="module")
def server(things, static) -> Iterator[ViewServer]:
    """One server for all tests here: whatever they do, the next one finds it at work."""
    with closing(serve(things, backend="cpu")) as found:
        # Each test logs in.
        found._logins = Rate(10_000)
        yield found


def socket_url(server) -> str:
    return f"{base_url(server).replace('http', 'ws')}/socket"


def cookie(server, token: str | None = None) -> dict[str, str]:
    return {"Cookie": f"{server.access.cookie}={token or server.access.token}"}


def raw(server, path: str, *, host: str | None = None, method: str = "GET", **head: str) -> int:
    """The status of a request whose path and head are sent as they stand."""
    connection = HTTPConnection("127.0.0.1", server.access.port, timeout=10)
    try:
        connection.putrequest(method, path, skip_host=True, skip_accept_encoding=True)
        connection.putheader("Host", host or f"127.0.0.1:{server.access.port}")
        for name, value in head.items():
            connection.putheader(name, value)
        connection.endheaders()
        return connection.getresponse().status
    finally:
        connection.close()


# Who is let in.


def test_the_link_holds_a_long_secret_where_no_request_shows_it(server) -> None:
    address, _, token = server.url.partition("#")
    assert address == f"http://127.0.0.1:{server.access.port}/"
    assert len(token) >= 43
    assert token == server.access.token
    assert token not in repr(server.access)
    assert Access(host="127.0.0.1", port=1).token != token


def test_the_page_gives_nobody_a_cookie_and_holds_no_secret(server) -> None:
    answer = httpx.get(base_url(server))
    assert answer.status_code == 200
    assert "set-cookie" not in answer.headers
    assert server.access.token not in answer.text


def test_the_cookie_comes_for_the_token_alone(server) -> None:
    base = base_url(server)
    for token in ("", "x", server.access.token[:-1], server.access.token + "x", "\u2603"):
        answer = httpx.post(f"{base}/login", json={"token": token}, headers={"origin": base})
        assert answer.status_code == 403
        assert "set-cookie" not in answer.headers
    answer = httpx.post(
        f"{base}/login", json={"token": server.access.token}, headers={"origin": base}
    )
    assert answer.status_code == 204
    made = answer.headers["set-cookie"].lower()
    assert made.startswith(f"splatseg-{server.access.port}=")
    assert "httponly" in made
    assert "samesite=strict" in made
    assert "path=/" in made


@pytest.mark.parametrize(
    ("body", "status"),
    [(b"", 400), (b"{", 400), (b"[]", 400), (b'{"token": 5}', 400), (b"x" * 1025, 413),
     (b'{"token": "a", "more": 1}', 400), (b"\xff\xfe", 400)],
)  # fmt: skip
def test_a_login_of_another_form_is_refused(server, body: bytes, status: int) -> None:
    base = base_url(server)
    assert httpx.post(f"{base}/login", content=body, headers={"origin": base}).status_code == status


def test_logins_are_limited(server, monkeypatch) -> None:
    monkeypatch.setattr(server, "_logins", Rate(guard.LOGINS_A_MINUTE, seconds=60))
    base = base_url(server)
    with httpx.Client(base_url=base, headers={"origin": base}) as client:
        found = [
            client.post("/login", json={"token": "x"}).status_code
            for _ in range(guard.LOGINS_A_MINUTE + 5)
        ]
    assert found[0] == 403
    assert found[-1] == 429


@pytest.mark.parametrize("origin", [None, "http://evil.example", "null", "https://127.0.0.1"])
def test_a_login_of_another_page_is_refused(server, origin: str | None) -> None:
    answer = httpx.post(
        f"{base_url(server)}/login",
        json={"token": server.access.token},
        headers={} if origin is None else {"origin": origin},
    )
    assert answer.status_code == 403
    assert "set-cookie" not in answer.headers


@pytest.mark.parametrize(
    "path", ["/photographs/first", "/exports/a.ply", "/socket", "/scene.json", "/docs", "/login/x"]
)
def test_without_a_cookie_only_the_page_is_sent(server, client, path: str) -> None:
    assert httpx.get(f"{base_url(server)}{path}").status_code == 403
    wrong = {"Cookie": f"{server.access.cookie}=wrong"}
    assert httpx.get(f"{base_url(server)}{path}", headers=wrong).status_code == 403
    assert client.get(path).status_code in (200, 404, 405)


def test_static_files_need_none(server) -> None:
    assert httpx.get(f"{base_url(server)}/static/app.js").status_code == 200


def test_the_token_may_come_in_the_head_instead(server) -> None:
    url = f"{base_url(server)}/photographs/first"
    token = server.access.token
    assert httpx.get(url, headers={"Authorization": f"Bearer {token}"}).status_code == 200
    for wrong in ("Bearer x", f"Basic {token}", token, "Bearer"):
        assert httpx.get(url, headers={"Authorization": wrong}).status_code == 403


@pytest.mark.parametrize(
    "cookies",
    [None, "other=1", "splatseg-1={token}", "{name}=", "{name}=wrong", "{name}={token}x",
     "\xff\xfe", "{name}=a; {name}"],
)  # fmt: skip
def test_a_socket_without_the_cookie_is_refused(server, cookies: str | None) -> None:
    head = {}
    if cookies is not None:
        names = {"name": server.access.cookie, "token": server.access.token}
        head["Cookie"] = cookies.format(**names)
    with pytest.raises(InvalidStatus) as refused:
        Page(uri=socket_url(server), origin=base_url(server), additional_headers=head)
    assert refused.value.response.status_code == 403


@pytest.mark.parametrize(
    "origin",
    [None, "null", "http://evil.example", "https://{host}", "http://{host}.evil.example",
     "http://127.0.0.1:1", "http://localhost:{port}", "http://{host}/"],
)  # fmt: skip
def test_a_socket_of_another_page_is_refused(server, origin: str | None) -> None:
    host = f"127.0.0.1:{server.access.port}"
    if origin is not None:
        origin = origin.format(host=host, port=server.access.port)
    with pytest.raises(InvalidStatus) as refused:
        Page(uri=socket_url(server), origin=origin, additional_headers=cookie(server))
    assert refused.value.response.status_code == 403


@pytest.mark.parametrize(
    "host",
    ["evil.example", "evil.example:{port}", "127.0.0.1", "127.0.0.1:1", "127.0.0.1:{port}x",
     "127.0.0.1.evil.example:{port}", "192.168.1.5:{port}", "evil@127.0.0.1:{port}", "x",
     "localhost:{port}:{port}", "0.0.0.0:{port}"],
)  # fmt: skip
@pytest.mark.parametrize("path", ["/", "/static/app.js", "/photographs/first"])
def test_another_host_is_refused(server, host: str, path: str) -> None:
    named = host.format(port=server.access.port)
    assert raw(server, path, host=named, **cookie(server)) == 421


def test_a_socket_of_another_host_is_refused(server) -> None:
    with pytest.raises(InvalidStatus):
        Page(
            uri=f"ws://evil.example:{server.access.port}/socket",
            origin=f"http://evil.example:{server.access.port}",
            additional_headers=cookie(server),
            sock=socket.create_connection(("127.0.0.1", server.access.port)),
        )


def test_names_of_the_machine_itself_pass(server) -> None:
    for name in ("127.0.0.1", "localhost", "LOCALHOST", "[::1]"):
        assert raw(server, "/", host=f"{name}:{server.access.port}") == 200


def test_two_hosts_or_two_cookies_are_none(server) -> None:
    lines = (
        f"GET /photographs/first HTTP/1.1\r\nHost: 127.0.0.1:{server.access.port}\r\n"
        f"Host: evil.example\r\nCookie: {cookie(server)['Cookie']}\r\nConnection: close\r\n\r\n"
    )
    with socket.create_connection(("127.0.0.1", server.access.port), timeout=10) as connection:
        connection.sendall(lines.encode())
        status = int(connection.recv(4096).split(b" ")[1])
    assert status in (400, 421)


def test_a_head_that_is_there_twice_is_as_if_missing() -> None:
    scope = {"headers": [(b"origin", b"a"), (b"cookie", b"x"), (b"origin", b"b")]}
    assert guard.header(scope, b"origin") is None
    assert guard.header(scope, b"host") is None
    assert guard.header(scope, b"cookie") == "x"


@pytest.mark.parametrize("method", ["PUT", "DELETE", "PATCH", "OPTIONS", "TRACE"])
def test_other_methods_are_refused(server, method: str) -> None:
    assert raw(server, "/", method=method, **cookie(server)) == 405


def test_only_what_listens_to_the_network_knows_addresses_of_it() -> None:
    local = Access(host="127.0.0.1", port=80)
    wide = Access(host="0.0.0.0", port=8080)
    assert local.knows_host("localhost")
    assert local.knows_host("127.0.0.1:80")
    assert not local.knows_host("10.0.0.5:80")
    assert wide.knows_host("10.0.0.5:8080")
    assert wide.knows_host("[fe80::1]:8080")
    assert wide.knows_host(f"{socket.gethostname()}:8080")
    assert not wide.knows_host("evil.example:8080")
    assert not wide.knows_host("10.0.0.5:80")
    named = Access(host="lab.example", port=8080)
    assert named.knows_host("lab.example:8080")
    assert not named.knows_host("x.example:8080")
    assert wide.url.startswith("http://127.0.0.1:8080/#")
    assert Access(host="::1", port=5).url.startswith("http://[::1]:5/#")


# What it sends.


@pytest.mark.parametrize(
    "path", ["/", "/static/app.js", "/login", "/nothing", "/photographs/first"]
)
def test_every_answer_says_what_a_page_may_do(server, client, path: str) -> None:
    for answer in (client.get(path), httpx.get(f"{base_url(server)}{path}")):
        policy = answer.headers["content-security-policy"]
        wanted = [
            "default-src 'none'", "script-src 'self'", "style-src 'self'", "img-src 'self' blob:",
            "connect-src 'self'", "worker-src 'self' blob:", "base-uri 'none'",
            "form-action 'none'", "frame-ancestors 'none'",
        ]  # fmt: skip
        assert policy.split("; ") == wanted
        assert answer.headers["x-content-type-options"] == "nosniff"
        assert answer.headers["referrer-policy"] == "no-referrer"
        assert answer.headers["cross-origin-opener-policy"] == "same-origin"
        assert "server" not in answer.headers
        assert "access-control-allow-origin" not in answer.headers


def test_a_notebook_may_show_it_and_needs_the_token_in_its_hello(serving, things) -> None:
    server = serving(replace(load_scene(things), root=None), embedded=True)
    assert "/?embed#" in server.url
    policy = httpx.get(base_url(server)).headers["content-security-policy"]
    assert "frame-ancestors 'self' http://localhost:* http://127.0.0.1:*" in policy
    with Page(uri=socket_url(server), origin=base_url(server)) as page:
        page.send("hello", version=1, token=server.access.token)
        assert page.next("state")["me"]
    for token in (None, "wrong"):
        with Page(uri=socket_url(server), origin=base_url(server)) as page:
            page.send("hello", version=1, token=token)
            with pytest.raises(ConnectionClosed) as closed:
                page.receive()
            assert closed.value.rcvd.code == 1008


TRAVERSALS = [
    "/../pyproject.toml", "/static/../_guard.py", "/static/..%2f_guard.py",
    "/static/%2e%2e/_guard.py", "/static/....//_guard.py", "/static//etc/passwd",
    "/static/..\\_guard.py", "/exports/../scene.json", "/exports/..%2fscene.json",
    "/exports/%2e%2e%2fscene.json", "/exports/%2fetc%2fpasswd", "/exports/.hidden",
    "/exports/a%00.ply", "/exports/", "/exports/folder", "/exports/link.ply",
    "/photographs/../scene.json", "/photographs/..%2f..%2fetc%2fpasswd",
    "/photographs/%2fetc%2fpasswd", "/photographs/first%00", "/photographs/", "/view/journal.jsonl",
    "/static/link.js", "/static/", "/gaussians.ply", "//etc/passwd",
]  # fmt: skip


@pytest.mark.parametrize("path", TRAVERSALS)
def test_no_path_leads_out_of_its_folder(server, things, static, path: str) -> None:
    exports = things / "exports"
    (exports / "folder").mkdir(parents=True, exist_ok=True)
    (exports / ".hidden").write_text("secret")
    for link in (exports / "link.ply", static / "link.js"):
        link.unlink(missing_ok=True)
        link.symlink_to(things / "scene.json")
    assert raw(server, path, **cookie(server)) in (400, 404)


def test_an_export_is_a_download_and_no_page(server, client, things) -> None:
    (things / "exports").mkdir(exist_ok=True)
    (things / "exports" / "a.html").write_text("<script>alert(1)</script>")
    answer = client.get("/exports/a.html")
    assert answer.status_code == 200
    assert answer.headers["content-disposition"].startswith("attachment")


@pytest.mark.parametrize("width", ["-5", "1e9", "x", "", "999999", "5 5", "\u0665"])
def test_a_width_is_a_small_number(client, width: str) -> None:
    assert client.get("/photographs/first", params={"width": width}).status_code == 400


def test_a_large_width_is_no_larger_than_the_photograph(client) -> None:
    answer = client.get("/photographs/first", params={"width": "99999"})
    assert answer.status_code == 200
    assert len(answer.content) < 10_000


# What it is sent.


def closed_with(page: Page) -> int:
    """The code that the connection is closed with."""
    with pytest.raises(ConnectionClosed) as closed:
        page.until(lambda _: False)
    return closed.value.rcvd.code


@pytest.mark.parametrize(
    "first",
    ['{"type": "undo"}', "", "x", '{"type": "hello"}', '{"type": "hello", "version": 1, "x": 1}'],
)
def test_the_first_message_is_a_hello(server, first: str) -> None:
    with opened(server, hello=False) as page:
        page.socket.send(first)
        assert closed_with(page) == 1008
        assert page.heard == []


def test_a_page_of_another_version_is_told_so(server) -> None:
    with opened(server, hello=False) as page:
        page.send("hello", version=2)
        assert "another version" in page.next("error")["text"]
        assert closed_with(page) == 1008


def test_a_connection_that_says_nothing_ends(server, monkeypatch) -> None:
    from splatseg.viewer import _server

    monkeypatch.setattr(_server, "_HELLO_SECONDS", 0.2)
    with opened(server, hello=False) as page:
        assert closed_with(page) == 1008


@pytest.mark.parametrize(
    ("message", "code"),
    [("x" * (messages.MAX_LONG_TEXT + 1), 1009), ("x" * ((1 << 20) + 1), 1009), (b"bytes", 1003)],
    ids=["long", "huge", "binary"],
)
def test_what_is_too_large_or_binary_ends_the_connection(server, message, code: int) -> None:
    with opened(server) as other, opened(server) as page:
        page.socket.send(message)
        assert closed_with(page) == code
        assert other.still(1).rest, "others are not disturbed"


@pytest.mark.parametrize(
    "text",
    ["", "{", "null", "[]", '{"type": "eval"}', "[" * 4000, '{"type": "camera"}', "NaN",
     '{"type": "undo", "__proto__": {}}', '{"type": "hello", "version": 1}',
     '{"type": "undo"' + " " * 5000 + "}"],
)  # fmt: skip
def test_what_is_malformed_is_refused_and_the_page_stays(page, text: str) -> None:
    page.socket.send(text)
    error = page.next("error")
    assert error["text"]
    assert "Traceback" not in error["text"]
    assert page.still(1).rest


def test_a_flood_of_bad_messages_ends_the_connection(server, page) -> None:
    for _ in range(guard.MAX_REFUSED + 1):
        page.socket.send("{")
        page.next("error")
    assert closed_with(page) == 1008
    with opened(server) as again:
        assert again.heard


@pytest.mark.parametrize(
    ("message", "most", "what"),
    [
        ({"type": "camera", "id": 1, **json_camera()}, guard.CAMERAS_A_SECOND, "cameras"),
        ({"type": "select", "gesture": 1, "kind": "none"}, guard.SELECTIONS_A_SECOND,
         "selections"),
        ({"type": "command", "name": "rename", "arguments": {"id": 9, "name": "x"}},
         guard.COMMANDS_A_SECOND, "commands"),
        ({"type": "undo"}, guard.COMMANDS_A_SECOND, "commands"),
        ({"type": "job", "id": 1, "name": "none"}, guard.COMMANDS_A_SECOND, "commands"),
    ],
)  # fmt: skip
def test_so_many_of_a_kind_in_a_second(page, message, most: int, what: str) -> None:
    for _ in range(most + 60):
        page.socket.send(json.dumps(message))
    error = page.until(
        lambda one: isinstance(one, dict) and one["type"] == "error" and "too many" in one["text"]
    )
    assert what in error["text"]
    time.sleep(1.1)
    assert page.still(2).rest, "a moment later it is answered again"


def test_a_rate_lets_through_so_many_and_recovers() -> None:
    now = [0.0]
    rate = Rate(10, seconds=2, clock=lambda: now[0])
    assert [rate.allows() for _ in range(12)] == [True] * 10 + [False] * 2
    now[0] = 0.2
    assert [rate.allows() for _ in range(2)] == [True, False]
    now[0] = 100.0
    assert [rate.allows() for _ in range(11)] == [True] * 10 + [False]


def test_there_are_so_many_pages_at_a_time(server) -> None:
    while server.worker.clients:  # those of the test before
        time.sleep(0.01)
    pages = [opened(server) for _ in range(guard.MAX_CLIENTS)]
    try:
        with opened(server, hello=False) as ninth:
            ninth.send("hello", version=1)
            error = ninth.next("error")
            assert "8 pages are open" in error["text"]
            assert error["fix"]
            assert closed_with(ninth) == 1013
        pages.pop().__exit__()
        pages[0].next("clients", n=guard.MAX_CLIENTS - 1)
        pages.append(opened(server))
        assert pages[-1].heard[0]["clients"] == guard.MAX_CLIENTS
    finally:
        for page in pages:
            page.__exit__()


def test_a_page_that_reads_no_more_is_let_go(server, monkeypatch) -> None:
    monkeypatch.setattr(_server, "_MAX_WAITING", 15)  # who reads may be late on a busy machine
    with opened(server), opened(server) as other:
        before = len(server.worker.clients)
        told = messages.Error(text="x" * 1_000_000)
        # In the worker's thread, as all is: so both pages are welcomed by then. What buffers of the
        # system and of the library for clients hold, up to some 30 messages, does not wait.
        for _ in range(80):
            server.worker.call(lambda _: server.worker.broadcast(told)).result()
            other.next("error")
        while len(server.worker.clients) == before:
            time.sleep(0.01)
        assert other.still(1).rest, "who reads stays"


def test_jobs_are_so_many_at_a_time(page) -> None:
    given = {"camera": json_camera(), "frames": 1000}
    for id in range(6):
        page.send("job", id=id, name="film", arguments=given)
    for id in (4, 5):
        assert "at most 4 at a time" in page.next("error", id=id)["text"]
    page.send("job", id=0, name="film", arguments=given)
    assert "new number" in page.next("error", id=0)["text"]
    for id in range(6):
        page.send("cancel", id=id)
    page.next("error", id=0)


# Names, ids and sizes.


HOSTILE = [
    "../../etc/passwd", "a/b", "a\\b", "..", "a\0b", "a\nb", "\x1b[31mred", "\u202egnp.exe",
    " ", "a" * 81, "\ud800", "\u200b",
]  # fmt: skip


@pytest.mark.parametrize("name", HOSTILE, ids=range(len(HOSTILE)))
def test_hostile_names_of_objects_are_refused(page, name: str) -> None:
    page.select(1, points=[RED_PIXEL])
    red = page.command("keep", name="red")["objects"][0]["id"]
    page.send("command", name="rename", arguments={"id": red, "name": name})
    assert page.next("error")["text"]
    assert page.still(1).rest


@pytest.mark.parametrize(
    "name", ["<script>alert(1)<b>", "'; DROP TABLE", "${7*7}", "{{7*7}}", "%2e%2e", "CON",
             "__proto__", "=cmd|' calc'!A0", "&amp;", "-rf"],
)  # fmt: skip
def test_names_that_are_only_text_stay_text(page, things, client, name: str) -> None:
    page.select(1, points=[RED_PIXEL])
    kept = page.command("keep", name=name)["objects"][0]
    assert kept["name"] == name
    given = {"what": "objects", "name": "things", "ids": [kept["id"]]}
    page.send("job", id=1, name="export", arguments=given)
    ended = page.until(
        lambda one: (
            isinstance(one, dict) and one["type"] in ("finished", "error") and one["id"] == 1
        )
    )
    assert ended["type"] == "finished"
    assert {path.name for path in things.parent.iterdir()} == {"scene", "photographs"}
    assert list((things / "exports" / "things").glob("*.ply"))


@pytest.mark.parametrize(
    ("command", "given"),
    [
        ("rename", {"id": 2**31 - 1, "name": "a"}),
        ("rename", {"id": 0, "name": "a"}),
        ("set_visible", {"ids": [99], "visible": True}),
        ("accept", {"ids": [0]}),
        ("split", {"id": 1, "by": "tree"}),
        ("split", {"id": 1, "by": "plane", "plane": [0, 0, 0, 0]}),
        ("join", {"ids": [1]}),
        ("move", {"ids": [12345]}),
        ("keep", {"name": "a"}),
    ],
)
def test_ids_of_nothing_are_refused_in_a_sentence(page, command: str, given) -> None:
    error = page.refused(command, **given)
    assert error["text"]
    assert "something is wrong" not in error["text"]


def test_errors_name_no_path(page, things) -> None:
    page.send("job", id=1, name="suggest", arguments={"layer": "missing"})
    error = page.next("error", id=1)
    assert str(things.parent) not in json.dumps(error)
    assert "missing" in error["text"]
    (things / "layers" / "broken.npz").write_bytes(b"broken")
    page.send("job", id=2, name="suggest", arguments={"layer": "broken"})
    error = page.next("error", id=2)
    assert str(things.parent) not in json.dumps(error)
    assert "/" not in error["text"]


def test_an_export_may_not_be_named_out_of_its_folder(page, things) -> None:
    before = set((things / "exports").rglob("*"))
    for name in ("../x", "/tmp/x", "a/b", ".x", "x\n", "scene.json/../../x"):
        page.send("job", id=1, name="export", arguments={"name": name})
        assert page.next("error", id=1)["text"].startswith("export")
    assert set((things / "exports").rglob("*")) == before


def test_nothing_of_the_scene_is_lost_by_it(server, page, things) -> None:
    before = (things / "gaussians.ply").read_bytes()
    page.select(1, "all")
    page.refused("remove")
    page.select(2, points=[RED_PIXEL])
    page.command("remove")
    assert (things / "gaussians.ply").read_bytes() == before
    assert page.heard[0]["scene"]["count"] == 3 * EACH
