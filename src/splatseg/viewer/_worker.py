"""One thread that owns the scene and the kernels, and in which order it does what pages ask for.

Of cameras the newest of each page counts, page by page in turn; between two rounds of cameras one
other message is answered (selections, commands, in the order in which they came), and where there
is none, a step of a long job is done. A hint is looked for only when nothing else is asked, and
forgotten at the next input. While nobody asks, the thread sleeps.
"""

import logging
import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any, Protocol, TypeAlias, TypeVar

import msgspec

from splatseg.core.threads import one_torch_thread
from splatseg.errors import InputError, SplatsegError
from splatseg.viewer import _guard as guard
from splatseg.viewer import _memory as memory
from splatseg.viewer import _messages as messages
from splatseg.viewer._client import Cancelled, Client, Job

T = TypeVar("T")

_MAX_WAITING = 64
"""Most messages of one page that wait for an answer."""

_MAX_JOBS = 4
"""Most jobs of one page, waiting or running."""

_log = logging.getLogger("splatseg.viewer")


class Answers(Protocol):
    """What is done in the worker's thread."""

    @property
    def exports(self) -> Path | None:
        """Folder of files that pages may fetch."""
        ...

    def prepare(self) -> None:
        """Whatever makes the first answers slow."""
        ...

    def join(self, client: Client) -> None:
        """Send a page all that it shows."""
        ...

    def draw(self, client: Client, request: messages.DrawRequest) -> None:
        """Send a picture."""
        ...

    def answer(self, client: Client, message: messages.Incoming) -> None:
        """Answer a message."""
        ...

    def hint(self, client: Client) -> None:
        """Say where the next click would help."""
        ...

    def run(self, job: Job) -> None:
        """Do a job; the end of it may come later, from another process."""
        ...

    def photograph(self, name: str, width: int) -> bytes:
        """A photograph as JPEG."""
        ...

    def gaussians(self, version: int) -> Path:
        """A PLY file of the Gaussians that are drawn."""
        ...

    def close(self) -> None:
        """Save and release."""
        ...


Work: TypeAlias = Callable[[], None]


class Worker:
    """Does what pages ask for, in one thread.

    Args:
        open_answers: Opens the scene; it is called in the thread, and given the worker.
    """

    def __init__(self, open_answers: "Callable[[Worker], Answers]") -> None:
        self._open = open_answers
        self._answers: Answers | None = None
        self._changed = threading.Condition()
        self._clients: dict[int, Client] = {}
        self._next_id = 1
        self._drawn: set[int] = set()
        self._tasks: deque[tuple[Client, messages.Incoming]] = deque()
        self._calls: deque[tuple[Callable[[Any], Any], Future[Any]]] = deque()
        self._jobs: deque[Job] = deque()
        self._running: dict[tuple[int, int], Job] = {}
        self._hint: Client | None = None
        self._answered = 0
        self.closing = False
        self._opened: Future[None] = Future()
        self._thread = threading.Thread(target=self._run, name="splatseg view: worker", daemon=True)

    # From any thread.

    @property
    def clients(self) -> tuple[Client, ...]:
        """The pages that are open."""
        with self._changed:
            return tuple(self._clients.values())

    @property
    def exports(self) -> Path | None:
        """Folder of files that pages may fetch; None where the scene has no folder."""
        return None if self._answers is None else self._answers.exports

    def start(self) -> None:
        """Open the scene.

        Raises:
            SplatsegError: If it cannot be opened.
        """
        self._thread.start()
        self._opened.result()

    def close(self) -> None:
        """Finish what is being done, save and end."""
        with self._changed:
            self.closing = True
            self._changed.notify()
        if self._thread.ident is not None:
            self._thread.join()

    def join(
        self, post: Callable[[str | bytes], None], stage: messages.Drawing = "server"
    ) -> Client | None:
        """A page that comes; None where there are too many.

        Args:
            post: Sends it a message, from any thread.
            stage: Who draws what it shows while the camera moves.
        """
        with self._changed:
            if len(self._clients) >= guard.MAX_CLIENTS or self.closing:
                return None
            client = Client(self._next_id, post, stage)
            self._next_id += 1
            self._clients[client.id] = client
            count = len(self._clients)
            self._calls.append((lambda answers: self._welcome(answers, client), Future()))
            self._changed.notify()
        self._tell_count(count)
        return client

    def leave(self, client: Client) -> None:
        """A page that went; its jobs go on, its questions are forgotten."""
        with self._changed:
            self._clients.pop(client.id, None)
            self._tasks = deque(task for task in self._tasks if task[0] is not client)
            self._hint = None if self._hint is client else self._hint
            count = len(self._clients)
        self._tell_count(count)

    def give(self, client: Client, message: messages.Incoming) -> None:
        """A message of a page.

        Raises:
            InputError: If too much of it waits already.
        """
        with self._changed:
            match message:
                case messages.DrawRequest():
                    client.waiting_camera = message
                case messages.Cancel():
                    self._cancel(client, message.id)
                case messages.HintRequest():
                    self._hint = client
                case messages.JobRequest():
                    self._add_job(client, message)
                case _:
                    self._add_task(client, message)
            if not isinstance(message, messages.HintRequest | messages.Cancel):
                self._hint = None
            self._changed.notify()

    def sent(self, client: Client) -> None:
        """The picture of a page has gone out."""
        with self._changed:
            client.busy = False
            self._changed.notify()

    def call(self, work: Callable[[Any], T]) -> "Future[T]":
        """Do something with the answers, in the thread; gives what it gives."""
        future: Future[T] = Future()
        with self._changed:
            if self.closing or len(self._calls) >= _MAX_WAITING:
                future.cancel()
                return future
            self._calls.append((work, future))
            self._changed.notify()
        return future

    def _add_task(self, client: Client, message: messages.Incoming) -> None:
        if isinstance(message, messages.SelectRequest):
            # The same gesture with more points: the earlier question is no longer asked.
            self._tasks = deque(
                (who, what)
                for who, what in self._tasks
                if not (
                    who is client
                    and isinstance(what, messages.SelectRequest)
                    and what.gesture == message.gesture
                )
            )
        if sum(who is client for who, _ in self._tasks) >= _MAX_WAITING:
            raise InputError("message: too many wait for an answer already; wait a moment.")
        self._tasks.append((client, message))

    def _add_job(self, client: Client, message: messages.JobRequest) -> None:
        key = (client.id, message.id)
        if key in self._running:
            raise InputError(f"job: expected a new number, got {message.id} again.")
        if sum(owner == client.id for owner, _ in self._running) >= _MAX_JOBS:
            raise InputError(f"job: at most {_MAX_JOBS} at a time; wait for one, or cancel it.")
        job = Job(client, message, self.breathe)
        self._running[key] = job
        self._jobs.append(job)

    def _cancel(self, client: Client, id: int) -> None:
        job = self._running.get((client.id, id))
        if job is not None:
            job.cancelled = True

    def _tell_count(self, count: int) -> None:
        self.broadcast(messages.Clients(n=count))

    def _welcome(self, answers: Answers, client: Client) -> None:
        def join() -> None:
            answers.join(client)
            client.welcomed = True

        self.attempt(join, client)

    # In the thread.

    @property
    def is_asked(self) -> bool:
        """Whether a picture, a call or an answer waits; what is done in idle ends for it."""
        with self._changed:
            drawing = any(
                client.waiting_camera is not None and not client.busy
                for client in self._clients.values()
            )
            return drawing or bool(self._calls or self._tasks or self._jobs) or self.closing

    def redraw(self, author: str = "") -> None:
        """Draw the last camera of every page again, at rest: the document changed.

        Args:
            author: The page that changed it; it is drawn for first.
        """
        with self._changed:
            order = sorted(self._clients.values(), key=lambda client: client.author != author)
            self._clients = {client.id: client for client in order}
            for client in self._clients.values():
                waiting = client.waiting_camera
                if client.camera is not None and waiting is None:
                    client.waiting_camera = _at_rest(client.camera)
                elif waiting is not None and client.author == author:
                    # A move that was looked at is made now, and not to be drawn twice.
                    client.waiting_camera = msgspec.structs.replace(waiting, preview=None)

    def broadcast(self, message: messages.Outgoing) -> None:
        """Send a message to every page."""
        text = messages.form(message)
        for client in self.clients:
            if client.welcomed:
                client.send_text(text)

    def replace(self, answers: Answers) -> None:
        """Answer with these from now on, such as those of a later state of a fit."""
        before, self._answers = self._answers, answers
        if before is not None:
            before.close()
        for client in self.clients:
            client.data.clear()
            if client.welcomed:
                answers.join(client)
        self.redraw()

    def breathe(self) -> bool:
        """Answer what was asked while a job goes on: at most a picture and a message a page.

        Returns:
            Whether the job goes on: the worker does not end.
        """
        self._drawn.clear()
        for _ in range(2 * len(self.clients) + 2):
            with self._changed:
                work = self._interactive()
            if work is None:
                break
            work()
        return not self.closing

    def end_job(self, job: Job, ending: messages.Finished | messages.Error) -> None:
        """Tell the page of the end of a job; from any thread."""
        with self._changed:
            self._running.pop((job.client.id, job.id), None)
        job.client.send(ending)

    def attempt(self, work: Work, client: Client, **about: int | str | None) -> None:
        """Do something for a page; an error becomes a message to it.

        Args:
            work: What is done.
            client: The page.
            about: The gesture, job or command that the message is about.
        """
        error = _tried(work, **about)
        if error is not None:
            client.send(error)

    def _run(self) -> None:
        # Torch's threads would spin on the cores that the kernels and the browser need.
        with one_torch_thread():
            self._work()

    def _work(self) -> None:
        try:
            self._answers = self._open(self)
        except BaseException as error:  # noqa: BLE001  (`start` raises it in its thread)
            self._opened.set_exception(error)
            return
        self._opened.set_result(None)
        self.call(lambda answers: answers.prepare())
        while True:
            with self._changed:
                work = self._pick()
                while work is None and not self.closing:
                    self._changed.wait()
                    work = self._pick()
                if self.closing:
                    break
            if work is not None:
                work()
        self._end()

    def _end(self) -> None:
        with self._changed:
            calls, self._calls = list(self._calls), deque()
            jobs = list(self._running.values())
        for _, future in calls:
            future.cancel()
        for job in jobs:
            job.cancelled = True
        if self._answers is not None:
            self._answers.close()

    def _pick(self) -> Work | None:
        """What is to be done next; the lock is held."""
        work = self._interactive()
        if work is not None:
            return work
        if self._jobs:
            self._drawn.clear()
            job = self._jobs.popleft()
            return lambda: self._do_job(job)
        if self._drawn:
            self._drawn.clear()
            return self._pick()
        if self._hint is not None:
            client, self._hint = self._hint, None
            return lambda: self.attempt(lambda: self._of_answers().hint(client), client)
        return None

    def _interactive(self) -> Work | None:
        """A picture, a call or an answer; the lock is held."""
        for client in self._clients.values():
            request = client.waiting_camera
            if request is None or client.busy or client.id in self._drawn:
                continue
            self._drawn.add(client.id)
            client.waiting_camera = None
            client.camera = request
            return self._drawing(client, request)
        if self._calls:
            self._drawn.clear()
            work, future = self._calls.popleft()
            return lambda: self._do_call(work, future)
        if self._tasks:
            self._drawn.clear()
            client, message = self._tasks.popleft()
            return lambda: self._do_task(client, message)
        return None

    def _drawing(self, client: Client, request: messages.DrawRequest) -> Work:
        def draw() -> None:
            self.attempt(lambda: self._of_answers().draw(client, request), client)

        return draw

    def _do_task(self, client: Client, message: messages.Incoming) -> None:
        work = self._of_answers().answer
        self.attempt(lambda: work(client, message), client, **about(message))
        self._answered += 1
        if self._answered % memory.EVERY == 0:
            memory.give_back()

    def _do_call(self, work: Callable[[Any], Any], future: "Future[Any]") -> None:
        if not future.set_running_or_notify_cancel():
            return
        try:
            future.set_result(work(self._answers))
        except Exception as error:  # noqa: BLE001  (whoever waits for it raises it)
            future.set_exception(error)

    def _do_job(self, job: Job) -> None:
        def run() -> None:
            if job.cancelled:
                raise Cancelled
            self._of_answers().run(job)

        error = _tried(run, id=job.id)
        if error is not None:
            self.end_job(job, error)
        memory.give_back()

    def _of_answers(self) -> Answers:
        if self._answers is None:
            raise InputError("scene: not open yet.")
        return self._answers


def _tried(work: Work, **about: int | str | None) -> messages.Error | None:
    """Do something; what is said of it where it fails."""
    try:
        work()
    except Cancelled:
        return messages.Error(text="cancelled", **about)  # pyright: ignore[reportArgumentType]
    except SplatsegError as error:
        return messages.error_message(error, **about)
    except Exception:  # noqa: BLE001  (other pages and the next message are not to suffer)
        _log.exception("an answer failed")
        text = "something is wrong in the server, which has written it to its output"
        return messages.Error(text=text, **about)  # pyright: ignore[reportArgumentType]
    return None


def _at_rest(request: messages.DrawRequest) -> messages.DrawRequest:
    """The same camera at rest, of the document as it is."""
    return msgspec.structs.replace(request, rest=True, preview=None)


def about(message: messages.Incoming) -> dict[str, int | str | None]:
    """The gesture, job or command that an error of a message is about."""
    match message:
        case messages.SelectRequest() | messages.DepthRequest():
            return {"gesture": message.gesture}
        case messages.JobRequest():
            return {"id": message.id}
        case messages.CommandRequest():
            return {"command": message.name if message.name in messages.COMMANDS else None}
        case _:
            return {}
