"""A page and its long work, as the worker knows them."""

from collections.abc import Callable
from typing import Any

from splatseg.viewer import _messages as messages


class Cancelled(Exception):
    """A job was cancelled, or the server ends."""


class Client:
    """A page: where answers go, and what it asked for last.

    Args:
        id: Its number.
        post: Sends it a message.
        stage: Who draws what it shows while the camera moves.
    """

    def __init__(
        self, id: int, post: Callable[[str | bytes], None], stage: messages.Drawing = "server"
    ) -> None:
        self.id = id
        self._post = post
        self.stage: messages.Drawing = stage
        self.waiting_camera: messages.DrawRequest | None = None
        """The newest camera that was not drawn yet."""

        self.camera: messages.DrawRequest | None = None
        """The last one that was drawn."""

        self.busy = False
        """A picture is on its way to the page."""

        self.welcomed = False
        """The page has the whole state; what changes is worth telling it."""

        self.data: dict[str, Any] = {}
        """What the answers remember of the page."""

    @property
    def author(self) -> str:
        """Who did it, in the history."""
        return str(self.id)

    def send(self, message: messages.Outgoing) -> None:
        """Send a message."""
        self.send_text(messages.form(message))

    def send_text(self, text: str) -> None:
        """Send a message that was formed before."""
        self._post(text)

    def send_picture(self, data: bytes) -> None:
        """Send a picture; no further one is drawn until it has gone out."""
        self.busy = True
        self._post(data)

    def send_bytes(self, data: bytes) -> None:
        """Send what belongs to a picture."""
        self._post(data)


class Job:
    """Long work of a page; `step` is called between its parts.

    Args:
        client: The page.
        request: What it asked for.
        breathe: Answers what is asked meanwhile; gives whether the work goes on.
    """

    def __init__(
        self, client: Client, request: messages.JobRequest, breathe: Callable[[], bool]
    ) -> None:
        self.client = client
        self.request = request
        self.cancelled = False
        self._breathe = breathe
        self._breathing = False

    @property
    def id(self) -> int:
        """The page's number of the job."""
        return self.request.id

    def step(self, done: int, total: int, text: str = "") -> None:
        """Say how far the work is, and let the worker answer what is asked meanwhile.

        Raises:
            Cancelled: If the job was cancelled.
        """
        if self._breathing:  # what is answered meanwhile has steps, too
            return
        self.client.send(messages.Progress(id=self.id, done=done, total=total, text=text))
        self._breathing = True
        try:
            goes_on = self._breathe()
        finally:
            self._breathing = False
        if self.cancelled or not goes_on:
            raise Cancelled
