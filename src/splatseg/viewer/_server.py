"""The server of a scene: the page's files, the socket, photographs, what was exported.

It runs in a thread of its own, beside the worker's, so that it serves a command line, a notebook
and a test alike. Nothing of the scene is read here: the worker answers, and the socket passes on.
"""

import asyncio
import contextlib
import socket
import threading
from collections import deque
from concurrent.futures import CancelledError
from pathlib import Path
from typing import Any, Self

import msgspec

from splatseg.core import Scene
from splatseg.errors import InputError, SplatsegError, import_package
from splatseg.io.atomic import path_inside
from splatseg.render import BackendName
from splatseg.viewer import _guard as guard
from splatseg.viewer import _messages as messages
from splatseg.viewer._client import Client
from splatseg.viewer._worker import Worker, about

STATIC = Path(__file__).parent / "static"
"""The page."""

_HELLO_SECONDS = 10.0
_MAX_WAITING = 4000
"""Most messages that wait for one page; one that reads no more is let go."""

_MIN_WIDTH, _MAX_WIDTH = 16, 4096
_UNSUPPORTED, _POLICY, _TOO_BIG, _LATER = 1003, 1008, 1009, 1013


class ViewServer:
    """Serves one scene to browsers, until it is closed; a context.

    Args:
        worker: What owns the scene. It is started and closed with the server.
        host: Address to listen at.
        port: Port to listen at; 0 takes a free one.
        embedded: Whether pages of notebooks may show the page.

    Raises:
        MissingPackageError: If starlette, uvicorn or websockets is not installed.
        InputError: If the port is taken, or the address is none of this machine's.
    """

    def __init__(
        self,
        worker: Worker,
        *,
        host: str = "127.0.0.1",
        port: int = 0,
        embedded: bool = False,
    ) -> None:
        import_package("starlette", "the viewer", "viewer")
        import_package("uvicorn", "the viewer", "viewer")
        import_package("websockets", "the viewer", "viewer")
        self.worker = worker
        self._listening = _listen(host, port)
        self.access = guard.Access(
            host=host, port=self._listening.getsockname()[1], embedded=embedded
        )
        self._logins = guard.Rate(guard.LOGINS_A_MINUTE, seconds=60)
        self._loads = guard.Rate(guard.GAUSSIANS_A_MINUTE, seconds=60)
        self._server: Any = None
        self._thread: threading.Thread | None = None
        self._ended = threading.Event()

    @property
    def url(self) -> str:
        """The link to open, with the token."""
        return self.access.url

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def start(self) -> str:
        """Open the scene and begin to serve it; gives the link.

        Raises:
            SplatsegError: If the scene cannot be opened.
        """
        import uvicorn

        try:
            self.worker.start()
        except BaseException:
            self._listening.close()
            raise
        self._server = uvicorn.Server(
            uvicorn.Config(
                guard.Guard(self._application(), self.access),
                log_config=None,
                access_log=False,
                server_header=False,
                proxy_headers=False,
                lifespan="off",
                limit_concurrency=8 * guard.MAX_CLIENTS,
                timeout_graceful_shutdown=1,
                ws="websockets-sansio",  # what "auto" is in later versions of uvicorn
                ws_max_size=guard.MAX_MESSAGE,
                ws_per_message_deflate=False,
            )
        )
        self._thread = threading.Thread(
            target=self._serve,
            name="splatseg view: server",
            daemon=True,
        )
        self._thread.start()
        return self.url

    def close(self) -> None:
        """Let all pages go, save what is to be saved, and end."""
        if self._server is not None:
            self._server.should_exit = True
        if self._thread is not None:
            self._thread.join()
        self._listening.close()
        self.worker.close()

    def wait(self) -> None:
        """Until it ends, or is interrupted."""
        # Not by `join`: in Python 3.11, one that Ctrl-C interrupts takes the thread for ended.
        while self._thread is not None and not self._ended.wait(timeout=3600):
            pass

    def _serve(self) -> None:
        if self._server is not None:
            try:
                asyncio.run(self._server.serve(sockets=[self._listening]))
            finally:
                self._ended.set()

    def _application(self) -> Any:
        from starlette.applications import Starlette
        from starlette.routing import Mount, Route, WebSocketRoute
        from starlette.staticfiles import StaticFiles

        return Starlette(
            routes=[
                Route("/", self._page),
                Route("/login", self._login, methods=["POST"]),
                Route("/photographs/{name:path}", self._photograph),
                Route("/exports/{name}", self._exported),
                Route("/gaussians", self._gaussians),
                WebSocketRoute("/socket", self._socket),
                Mount("/static", StaticFiles(directory=STATIC, check_dir=False)),
            ]
        )

    async def _page(self, request: Any) -> Any:
        from starlette.responses import FileResponse, PlainTextResponse

        page = STATIC / "index.html"
        if not page.is_file():
            return PlainTextResponse("the page is not installed\n", status_code=404)
        return FileResponse(page, headers={"cache-control": "no-store"})

    async def _login(self, request: Any) -> Any:
        """The token of the link for a cookie."""
        from starlette.responses import PlainTextResponse, Response

        if not self._logins.allows():
            return PlainTextResponse("too many tries; wait a minute\n", status_code=429)
        body = b""
        async for chunk in request.stream():
            body += chunk
            if len(body) > guard.MAX_BODY:
                return PlainTextResponse("too large\n", status_code=413)
        try:
            token = msgspec.json.decode(body, type=_Login).token
        except msgspec.DecodeError:
            return PlainTextResponse('expected {"token": "..."}\n', status_code=400)
        if not self.access.knows_token(token):
            return PlainTextResponse("wrong token\n", status_code=403)
        response = Response(status_code=204)
        response.set_cookie(
            self.access.cookie, self.access.token, httponly=True, samesite="strict", path="/"
        )
        return response

    async def _photograph(self, request: Any) -> Any:
        from starlette.responses import PlainTextResponse, Response

        name, width = request.path_params["name"], request.query_params.get("width", "1024")
        if not (width.isascii() and width.isdigit() and len(width) < 6):
            return PlainTextResponse("width: expected a number of pixels\n", status_code=400)
        pixels = min(max(int(width), _MIN_WIDTH), _MAX_WIDTH)
        try:
            data = await asyncio.wrap_future(
                self.worker.call(lambda answers: answers.photograph(name, pixels))
            )
        except SplatsegError:
            return PlainTextResponse("no such photograph\n", status_code=404)
        except CancelledError:
            return PlainTextResponse("busy\n", status_code=503)
        return Response(
            data, media_type="image/jpeg", headers={"cache-control": "private, max-age=3600"}
        )

    async def _exported(self, request: Any) -> Any:
        from starlette.responses import FileResponse, PlainTextResponse

        name, folder = request.path_params["name"], self.worker.exports
        try:
            path = None if folder is None else path_inside(folder, name, make=False)
        except InputError:
            path = None
        if path is None or name.startswith(".") or not path.is_file():
            return PlainTextResponse("no such file\n", status_code=404)
        return FileResponse(path, filename=name, headers={"cache-control": "no-store"})

    async def _gaussians(self, request: Any) -> Any:
        """The Gaussians that a page draws, by the version that it was told."""
        from starlette.responses import FileResponse, PlainTextResponse

        version = request.query_params.get("version", "")
        if not (version.isascii() and version.isdigit() and len(version) < 11):
            return PlainTextResponse("version: expected a number\n", status_code=400)
        if not self._loads.allows():
            return PlainTextResponse("too many; wait a minute\n", status_code=429)
        try:
            path = await asyncio.wrap_future(
                self.worker.call(lambda answers: answers.gaussians(int(version)))
            )
        except SplatsegError:
            return PlainTextResponse("there are none of this version\n", status_code=404)
        except CancelledError:
            return PlainTextResponse("busy\n", status_code=503)
        return FileResponse(
            path, media_type="application/octet-stream", headers={"cache-control": "no-store"}
        )

    async def _socket(self, websocket: Any) -> None:
        """One page, from its hello to its end."""
        from starlette.websockets import WebSocketDisconnect

        await websocket.accept()
        # Any way in which a connection ends while it is written to.
        with contextlib.suppress(WebSocketDisconnect, RuntimeError, OSError):
            hello = await self._welcome(websocket)
            if hello is None:
                return
            page = _Page(websocket, self.worker)
            client = self.worker.join(page.post, hello.stage)
            if client is None:
                text = f"{guard.MAX_CLIENTS} pages are open, which is the most"
                await page.say(messages.Error(text=text, fix="close another one"))
                await websocket.close(_LATER)
                return
            work = (page.send_all(client), page.receive_all(client), page.full.wait())
            tasks = [asyncio.create_task(one) for one in work]
            try:
                await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            finally:
                self.worker.leave(client)
                for task in tasks:
                    task.cancel()
                await asyncio.gather(*tasks, return_exceptions=True)

    async def _welcome(self, websocket: Any) -> messages.Hello | None:
        """The first message, if it is a hello of our version, from who has access."""
        try:
            first = await asyncio.wait_for(websocket.receive(), _HELLO_SECONDS)
            hello = messages.parse(first.get("text") or "")
        except (TimeoutError, InputError):
            await websocket.close(_POLICY)
            return None
        if not isinstance(hello, messages.Hello):
            await websocket.close(_POLICY)
            return None
        if not (self.access.admits(websocket.scope) or self.access.knows_token(hello.token)):
            await websocket.close(_POLICY)
            return None
        if hello.version != messages.VERSION:
            error = messages.Error(
                text="the page is of another version than the server", fix="load the page again"
            )
            await websocket.send_text(messages.form(error))
            await websocket.close(_POLICY)
            return None
        return hello


class _Login(msgspec.Struct, forbid_unknown_fields=True):
    token: str


class _Page:
    """The socket of one page: what waits to be sent, and what it may send."""

    def __init__(self, websocket: Any, worker: Worker) -> None:
        self._websocket = websocket
        self._worker = worker
        self._loop = asyncio.get_running_loop()
        self._waiting: deque[str | bytes] = deque()
        self._wake = asyncio.Event()
        self.full = asyncio.Event()
        """Set when too much waits: the page reads no more."""
        self._refused = guard.Rate(guard.MAX_REFUSED, seconds=60)
        self._cameras = guard.Rate(guard.CAMERAS_A_SECOND)
        self._selections = guard.Rate(guard.SELECTIONS_A_SECOND)
        self._commands = guard.Rate(guard.COMMANDS_A_SECOND)

    def post(self, message: str | bytes) -> None:
        """Send a message, from any thread; what comes when the server has ended is dropped."""
        with contextlib.suppress(RuntimeError):
            self._loop.call_soon_threadsafe(self._put, message)

    def _put(self, message: str | bytes) -> None:
        if len(self._waiting) >= _MAX_WAITING:
            self.full.set()
            return
        self._waiting.append(message)
        self._wake.set()

    async def send_all(self, client: Client) -> None:
        """Send what waits, in order."""
        while True:
            await self._wake.wait()
            self._wake.clear()
            while self._waiting:
                message = self._waiting.popleft()
                if isinstance(message, str):
                    await self._websocket.send_text(message)
                    continue
                await self._websocket.send_bytes(message)
                if message[:1] == b"F":
                    self._worker.sent(client)

    async def receive_all(self, client: Client) -> None:
        """Pass on what comes, until the page leaves or sends what no page of ours sends."""
        while True:
            event = await self._websocket.receive()
            if event["type"] == "websocket.disconnect":
                return
            text = event.get("text")
            if text is None:
                await self._websocket.close(_UNSUPPORTED)
                return
            if len(text) > messages.MAX_LONG_TEXT:
                await self._websocket.close(_TOO_BIG)
                return
            refusal = self._refusal(client, text)
            if refusal is None:
                continue
            await self.say(refusal)
            if not self._refused.allows():
                await self._websocket.close(_POLICY)
                return

    def _refusal(self, client: Client, text: str) -> messages.Error | None:
        """Pass a message on; what is wrong with it otherwise."""
        try:
            message = messages.parse(text)
        except InputError as error:
            return messages.error_message(error)
        try:
            self._check_rate(message)
            self._worker.give(client, message)
        except InputError as error:
            return messages.error_message(error, **about(message))
        return None

    def _check_rate(self, message: messages.Incoming) -> None:
        match message:
            case messages.DrawRequest():
                rate, what = self._cameras, "cameras"
            case messages.SelectRequest():
                rate, what = self._selections, "selections"
            case messages.Cancel():
                return
            case _:
                rate, what = self._commands, "commands"
        if not rate.allows():
            raise InputError(f"too many {what} in a second; wait a moment.")

    async def say(self, error: messages.Error) -> None:
        """Say what is wrong."""
        await self._websocket.send_text(messages.form(error))


def _listen(host: str, port: int) -> socket.socket:
    """A socket that listens."""
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        listening = socket.socket(family, socket.SOCK_STREAM)
    except (OSError, UnicodeError) as error:
        raise InputError(f"host: expected an address of this machine, got {host!r}.") from error
    try:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listening.bind((host, port))
        listening.listen(128)
    except (OSError, OverflowError) as error:
        listening.close()
        raise InputError(
            f"port: expected a free port of {host}, got {port} ({error}); 0 takes a free one."
        ) from error
    listening.settimeout(0)
    return listening


def serve(
    scene: Scene | Path,
    *,
    host: str = "127.0.0.1",
    port: int = 0,
    embedded: bool = False,
    layer: str | None = None,
    backend: BackendName = "auto",
    stage: messages.Drawing = "server",
) -> ViewServer:
    """A server of a scene that has been started; close it.

    Args:
        scene: The scene, or its folder.
        host: Address to listen at.
        port: Port to listen at; 0 takes a free one.
        embedded: Whether pages of notebooks may show the page.
        layer: A layer whose objects are suggested at once.
        backend: Rendering backend.
        stage: Who draws while the camera moves, unless a page chooses otherwise.
    """
    from splatseg.viewer._answers import opener

    server = ViewServer(
        Worker(opener(scene, layer=layer, backend=backend, stage=stage)),
        host=host,
        port=port,
        embedded=embedded,
    )
    server.start()
    return server
