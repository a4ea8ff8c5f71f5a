"""Who may speak to the server: host, origin, token and cookie; how much; what a page may load.

A server on 127.0.0.1 is reached by every program of the machine, and by every page of a browser
through names that resolve to it. So the token of the link is asked for on the machine itself, too;
the host that a browser believes to speak to is checked (DNS rebinding), and the page that speaks.
"""

import hmac
import ipaddress
import re
import secrets
import socket
import time
from collections.abc import Awaitable, Callable, Iterable, MutableMapping
from dataclasses import dataclass, field
from http.cookies import CookieError, SimpleCookie
from typing import Any

MAX_CLIENTS = 8
"""Most pages at a time."""

MAX_MESSAGE = 1 << 20
"""Most bytes of a message, of any kind; the connection ends with a larger one."""

MAX_BODY = 1024
"""Most bytes of a request: the token."""

CAMERAS_A_SECOND = 120
SELECTIONS_A_SECOND = 20
COMMANDS_A_SECOND = 20
MAX_REFUSED = 200
"""So many messages that are refused in a minute end the connection."""

LOGINS_A_MINUTE = 30
GAUSSIANS_A_MINUTE = 60
"""Most files of Gaussians that all pages together fetch; each may have hundreds of MB."""

_LOOPBACK = ("127.0.0.1", "localhost", "[::1]")
_OPEN = ("/", "/login")
"""Paths that need no cookie; those below `_STATIC` besides."""

_STATIC = "/static/"
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; "
    "connect-src 'self'; worker-src 'self' blob:; base-uri 'none'; form-action 'none'; "
    "frame-ancestors {ancestors}"
)
_NOTEBOOKS = "'self' http://localhost:* http://127.0.0.1:* https://localhost:* https://127.0.0.1:*"
"""Pages that may show this one: notebooks are served from another port."""

_HOST = re.compile(r"(\[[0-9a-f:.]{2,45}\]|[^:/@\[\]\s]{1,255})(?::([0-9]{1,5}))?")

Scope = MutableMapping[str, Any]
Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]


@dataclass(frozen=True, kw_only=True)
class Access:
    """What is asked of who speaks to the server.

    Args:
        host: The address that the server listens at.
        port: Its port.
        embedded: Whether pages of notebooks may show it. Browsers send no cookies there, so that
            the token itself may come instead.
    """

    host: str
    port: int
    embedded: bool = False
    token: str = field(default_factory=lambda: secrets.token_urlsafe(32), repr=False)

    @property
    def url(self) -> str:
        """The link, with the token in its fragment, which no browser sends."""
        shown = f"[{self.host}]" if ":" in self.host else self.host
        if self._everywhere:
            shown = _LOOPBACK[0]
        return f"http://{shown}:{self.port}/{'?embed' if self.embedded else ''}#{self.token}"

    @property
    def cookie(self) -> str:
        """Name of the cookie; browsers give those of one host to all its ports."""
        return f"splatseg-{self.port}"

    @property
    def policy(self) -> str:
        """The Content-Security-Policy."""
        return _POLICY.format(ancestors=_NOTEBOOKS if self.embedded else "'none'")

    def knows_host(self, host: str) -> bool:
        """Whether a Host header means this server.

        Names that resolve to this machine only because another one says so are refused; a number
        is nobody's name, and passes where the server listens to more than the machine itself.
        """
        found = _HOST.fullmatch(host.lower())
        if found is None or int(found[2] or 80) != self.port:
            return False
        name = found[1]
        if name in _LOOPBACK or name in (self.host.lower(), f"[{self.host.lower()}]"):
            return True
        if self._local:
            return False
        return _is_address(name.strip("[]")) or name == socket.gethostname().lower()

    def knows_origin(self, origin: str | None, host: str) -> bool:
        """Whether what speaks is this server's own page."""
        return origin is not None and origin.lower() == f"http://{host.lower()}"

    def knows_token(self, token: str | None) -> bool:
        """Whether it is the token, compared in constant time."""
        return token is not None and hmac.compare_digest(
            token.encode(errors="replace"), self.token.encode()
        )

    def admits(self, scope: Scope) -> bool:
        """Whether a request has the cookie, or the token in its head."""
        sent = header(scope, b"authorization") or ""
        kind, _, token = sent.partition(" ")
        if kind.lower() == "bearer" and self.knows_token(token.strip()):
            return True
        return self.knows_token(_cookie(header(scope, b"cookie"), self.cookie))

    @property
    def _everywhere(self) -> bool:
        return self.host in ("0.0.0.0", "::", "")  # noqa: S104  (compared, not listened at)

    @property
    def _local(self) -> bool:
        if self.host == "localhost":
            return True
        return _is_address(self.host) and ipaddress.ip_address(self.host).is_loopback


def header(scope: Scope, name: bytes) -> str | None:
    """A header of a request; None where it is missing, or there several times."""
    found = [value for key, value in scope.get("headers", ()) if key == name]
    return found[0].decode("latin-1") if len(found) == 1 else None


def _cookie(text: str | None, name: str) -> str | None:
    if text is None:
        return None
    try:
        found = SimpleCookie(text).get(name)
    except CookieError:
        return None
    return None if found is None else found.value


def _is_address(text: str) -> bool:
    try:
        ipaddress.ip_address(text)
    except ValueError:
        return False
    return True


class Guard:
    """Stands before the application: nothing that is refused reaches it."""

    def __init__(self, app: App, access: Access) -> None:
        self._app = app
        self._access = access

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, or refuse it."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        status, text = self._refusal(scope)
        if status:
            await (
                _refuse_socket(send)
                if scope["type"] == "websocket"
                else self._refuse(send, status, text)
            )
            return
        await self._app(scope, receive, self._with_headers(send))

    def _refusal(self, scope: Scope) -> tuple[int, str]:
        access = self._access
        host = header(scope, b"host") or ""
        if not access.knows_host(host):
            return 421, "unknown host"
        path, origin = scope["path"], header(scope, b"origin")
        if scope["type"] == "websocket":
            if not access.knows_origin(origin, host):
                return 403, "unknown origin"
            # In a notebook the first message has the token.
            return (0, "") if access.embedded or access.admits(scope) else (403, "no access")
        if scope["method"] not in ("GET", "HEAD", "POST"):
            return 405, "unknown method"
        if scope["method"] == "POST" and not access.knows_origin(origin, host):
            return 403, "unknown origin"
        if path in _OPEN or path.startswith(_STATIC) or access.admits(scope):
            return 0, ""
        return 403, "no access: open the link that splatseg printed"

    async def _refuse(self, send: Send, status: int, text: str) -> None:
        body = f"{text}\n".encode()
        send = self._with_headers(send)
        head = [(b"content-type", b"text/plain; charset=utf-8")]
        head.append((b"content-length", str(len(body)).encode()))
        await send({"type": "http.response.start", "status": status, "headers": head})
        await send({"type": "http.response.body", "body": body})

    def _with_headers(self, send: Send) -> Send:
        added: Iterable[tuple[bytes, bytes]] = (
            (b"content-security-policy", self._access.policy.encode()),
            (b"x-content-type-options", b"nosniff"),
            (b"referrer-policy", b"no-referrer"),
            (b"cross-origin-opener-policy", b"same-origin"),
            (b"cross-origin-resource-policy", b"same-origin"),
        )

        async def sent(message: Message) -> None:
            if message["type"] == "http.response.start":
                message["headers"] = [*message.get("headers", ()), *added]
            await send(message)

        return sent


async def _refuse_socket(send: Send) -> None:
    """Before it is accepted: the browser gets 403."""
    await send({"type": "websocket.close", "code": 1008})


class Rate:
    """At most so many in a time, and as many at once.

    Args:
        most: How many.
        seconds: In what time.
        clock: Gives seconds.
    """

    def __init__(
        self, most: int, *, seconds: float = 1.0, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._most = most
        self._speed = most / seconds
        self._clock = clock
        self._left = float(most)
        self._last = clock()

    def allows(self) -> bool:
        """Whether one more is within the rate; it is counted."""
        now = self._clock()
        self._left = min(self._most, self._left + (now - self._last) * self._speed)
        self._last = now
        if self._left < 1:
            return False
        self._left -= 1
        return True
