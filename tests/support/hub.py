"""A Hugging Face hub of one machine: what the real library asks of the real one, over HTTP."""

import hashlib
import importlib
import json
import threading
from collections.abc import Generator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest

REVISION = "0123456789abcdef0123456789abcdef01234567"


@contextmanager
def local_hub(repositories: dict[str, Path], *, gated: tuple[str, ...] = ()) -> Generator[Any]:
    """Serve folders by id; gives an object with the `url` and the paths that were `asked` for."""
    asked: list[str] = []

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def log_message(self, *words: object) -> None:
            """Nothing on the terminal."""

        def do_HEAD(self) -> None:
            self._answer(body=False)

        def do_GET(self) -> None:
            self._answer(body=True)

        def _answer(self, *, body: bool) -> None:
            path = urlsplit(self.path).path.strip("/")
            asked.append(path)
            id = next((name for name in (*repositories, *gated) if name in path), None)
            headers = {"X-Repo-Commit": REVISION}
            if id in gated:
                return self._send(403, b"{}", {"X-Error-Code": "GatedRepo"}, body=body)
            if id is None:
                return self._send(404, b"{}", {"X-Error-Code": "RepoNotFound"}, body=body)
            folder = repositories[id]
            if path.startswith("api/models/"):
                about = _tree(folder) if "/tree/" in path else _about(id, folder)
                return self._send(200, json.dumps(about).encode(), headers, body=body)
            file = folder / path.rpartition("/")[2]
            if "/resolve/" not in path or not file.is_file():
                return self._send(404, b"", {"X-Error-Code": "EntryNotFound"}, body=body)
            data = file.read_bytes()
            headers["ETag"] = f'"{hashlib.sha256(data).hexdigest()}"'
            return self._send(200, data, headers, body=body)

        def _send(self, status: int, data: bytes, headers: dict[str, str], *, body: bool) -> None:
            self.send_response(status)
            for name, value in (headers | {"Content-Length": str(len(data))}).items():
                self.send_header(name, value)
            self.end_headers()
            if body:
                self.wfile.write(data)

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield type("Hub", (), {"url": f"http://127.0.0.1:{server.server_port}", "asked": asked})
    finally:
        server.shutdown()
        server.server_close()


@contextmanager
def in_place_of_the_real(hub: Any, home: Path) -> Generator[None]:
    """The library of this process asks a hub of `local_hub`, and keeps what it gets below a folder.

    As HF_ENDPOINT, HF_HOME and others would do, which it reads once, when it is imported.
    """
    settings = {
        "ENDPOINT": hub.url,
        "HUGGINGFACE_CO_URL_TEMPLATE": hub.url + "/{repo_id}/resolve/{revision}/{filename}",
        "HF_HUB_CACHE": str(home / "hub"),
        "HF_XET_CACHE": str(home / "xet"),
        "HF_TOKEN_PATH": str(home / "token"),
        "HF_HUB_OFFLINE": False,
        "HF_HUB_DISABLE_XET": True,
        "HF_HUB_DISABLE_TELEMETRY": True,
    }
    with pytest.MonkeyPatch.context() as patch:
        for name, value in settings.items():
            patch.setattr(f"huggingface_hub.constants.{name}", value)
        try:
            yield
        finally:
            importlib.import_module("huggingface_hub").close_session()


def _tree(folder: Path) -> list[dict[str, Any]]:
    return [
        {"type": "file", "path": file["rfilename"], "size": file["size"], "oid": "0" * 40}
        for file in _about("", folder)["siblings"]
    ]


def _about(id: str, folder: Path) -> dict[str, Any]:
    files = sorted(path for path in folder.iterdir() if path.is_file())
    return {
        "_id": "1",
        "id": id,
        "modelId": id,
        "sha": REVISION,
        "private": False,
        "tags": [],
        "downloads": 0,
        "likes": 0,
        "cardData": {"license": "apache-2.0"},
        "siblings": [{"rfilename": file.name, "size": file.stat().st_size} for file in files],
    }
