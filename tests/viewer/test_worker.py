"""In which order the worker does what pages ask for; with answers that only note it down."""

import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
import torch

from splatseg.errors import InputError
from splatseg.viewer import _guard as guard
from splatseg.viewer import _messages as messages
from splatseg.viewer._client import Client, Job
from splatseg.viewer._worker import Worker
from support.viewer import json_camera


class Noted:
    """Answers that note what they were asked; `gate` holds the worker while it is closed."""

    def __init__(self) -> None:
        self.done: list[Any] = []
        self.gate = threading.Event()
        self.gate.set()
        self.job_gate = threading.Event()
        self.job_gate.set()
        self.waiting = threading.Event()

    @property
    def exports(self) -> Path | None:
        return None

    def prepare(self) -> None:
        self.done.append("prepare")

    def join(self, client: Client) -> None:
        self.done.append(("join", client.id))

    def draw(self, client: Client, request: messages.DrawRequest) -> None:
        self.done.append(("draw", client.id, request.id))

    def answer(self, client: Client, message: messages.Incoming) -> None:
        if isinstance(message, messages.Undo):
            self.waiting.set()
            assert self.gate.wait(10)
            return
        if isinstance(message, messages.SelectRequest):
            self.done.append(("select", client.id, message.gesture, message.level))
            return
        self.done.append((type(message).__name__, client.id))

    def hint(self, client: Client) -> None:
        self.done.append(("hint", client.id))

    def run(self, job: Job) -> None:
        for i in range(3):
            self.done.append(("step", job.id, i))
            self.waiting.set()
            assert self.job_gate.wait(10)
            job.step(i, 3)
        self.done.append(("job", job.id))

    def photograph(self, name: str, width: int) -> bytes:
        return b""

    def close(self) -> None:
        self.done.append("close")


@pytest.fixture
def noted() -> Noted:
    return Noted()


@pytest.fixture
def worker(noted) -> Iterator[Worker]:
    made = Worker(lambda _: noted)
    made.start()
    yield made
    noted.gate.set()
    noted.job_gate.set()
    made.close()


def joined(worker: Worker) -> Client:
    client = worker.join(lambda _: None)
    assert client is not None
    return client


def settled(worker: Worker, noted: Noted) -> list[Any]:
    """What was done since the last time, when nothing is left to do."""
    noted.gate.set()
    ended = threading.Event()
    original = noted.hint

    def look(client: Client) -> None:
        if client.id:
            original(client)
        else:
            ended.set()

    noted.hint = look
    # A hint is looked for when there is nothing else.
    for _ in range(500):
        with worker._changed:  # input makes it forgotten
            worker._hint = worker._hint or Client(0, lambda _: None)
            worker._changed.notify()
        if ended.wait(0.02):
            break
    assert ended.is_set()
    noted.hint = original
    found, noted.done = noted.done, []
    return found


def held(worker: Worker, noted: Noted, client: Client) -> None:
    """Keep the worker busy until the gate opens."""
    settled(worker, noted)
    noted.gate.clear()
    noted.waiting.clear()
    worker.give(client, messages.Undo())
    assert noted.waiting.wait(10)


def camera(id: int) -> messages.DrawRequest:
    return messages.DrawRequest(id=id, **json_camera())


def select(gesture: int, level: float = 0.5) -> messages.SelectRequest:
    return messages.SelectRequest(gesture=gesture, kind="none", level=level)


def test_the_newest_camera_of_each_page_is_drawn_page_by_page(worker, noted) -> None:
    first, second = joined(worker), joined(worker)
    held(worker, noted, first)
    for id in range(5):
        worker.give(first, camera(id))
        worker.give(second, camera(10 + id))
    assert settled(worker, noted) == [("draw", 1, 4), ("draw", 2, 14)]


def test_a_change_is_drawn_first_for_who_made_it(worker, noted) -> None:
    pages = [joined(worker) for _ in range(3)]
    settled(worker, noted)
    for page in pages[:2]:
        worker.give(page, camera(page.id))
    assert len(settled(worker, noted)) == 2
    worker.call(lambda _: worker.redraw("2")).result(10)
    assert settled(worker, noted) == [("draw", 2, 2), ("draw", 1, 1)]
    assert pages[0].camera is not None
    assert pages[0].camera.rest


def test_a_move_that_was_made_is_not_drawn_as_under_way(worker, noted) -> None:
    first, second = joined(worker), joined(worker)
    asked: list[messages.DrawRequest] = []
    noted.draw = lambda client, request: asked.append(request)
    under_way = messages.Move(translation=(1.0, 0.0, 0.0))
    moving = msgspec.structs.replace(camera(1), preview=under_way)
    worker.give(first, moving)
    settled(worker, noted)
    assert asked.pop().preview == under_way
    worker.call(lambda _: worker.redraw("1")).result(10)
    settled(worker, noted)
    assert asked.pop().preview is None, "the last camera again, at rest"
    for author, expected in (("1", None), ("2", under_way)):
        held(worker, noted, second)
        first.busy = True
        worker.give(first, moving)
        worker.redraw(author)
        first.busy = False
        settled(worker, noted)
        assert asked.pop().preview == expected
    assert not asked


def test_between_two_rounds_of_cameras_one_message_is_answered(worker, noted) -> None:
    first, second = joined(worker), joined(worker)
    held(worker, noted, first)
    worker.give(first, select(1))
    worker.give(first, select(2))
    worker.give(second, camera(1))
    draw = noted.draw

    def draw_and_ask_again(client: Client, request: messages.DrawRequest) -> None:
        draw(client, request)
        if request.id < 4:
            worker.give(client, camera(request.id + 1))

    noted.draw = draw_and_ask_again
    done = settled(worker, noted)
    assert done[:4] == [
        ("draw", 2, 1), ("select", 1, 1, 0.5), ("draw", 2, 2), ("select", 1, 2, 0.5),
    ]  # fmt: skip
    assert done[4:] == [("draw", 2, 3), ("draw", 2, 4)]


def test_messages_of_a_page_keep_their_order(worker, noted) -> None:
    client = joined(worker)
    held(worker, noted, client)
    worker.give(client, select(1))
    worker.give(client, messages.CommandRequest(name="keep"))
    worker.give(client, select(2))
    assert settled(worker, noted) == [
        ("select", 1, 1, 0.5), ("CommandRequest", 1), ("select", 1, 2, 0.5),
    ]  # fmt: skip


def test_a_gesture_that_goes_on_replaces_what_still_waits(worker, noted) -> None:
    first, second = joined(worker), joined(worker)
    held(worker, noted, first)
    worker.give(first, select(1, 0.1))
    worker.give(second, select(1, 0.2))
    worker.give(first, select(2, 0.3))
    worker.give(first, select(1, 0.4))
    assert settled(worker, noted) == [
        ("select", 2, 1, 0.2), ("select", 1, 2, 0.3), ("select", 1, 1, 0.4),
    ]  # fmt: skip


def test_one_picture_is_on_its_way_to_a_page_at_a_time(worker, noted) -> None:
    client = joined(worker)
    settled(worker, noted)
    client.send_picture(b"F")
    worker.give(client, camera(1))
    assert settled(worker, noted) == []
    worker.sent(client)
    assert settled(worker, noted) == [("draw", 1, 1)]


@pytest.mark.parametrize("message", [camera(1), select(1), messages.Redo()])
def test_a_hint_comes_last_and_is_forgotten_at_the_next_input(worker, noted, message) -> None:
    client = joined(worker)
    held(worker, noted, client)
    worker.give(client, messages.HintRequest())
    worker.give(client, message)
    assert len(settled(worker, noted)) == 1
    held(worker, noted, client)
    worker.give(client, messages.HintRequest())
    noted.gate.set()
    while ("hint", client.id) not in noted.done:
        pass
    assert settled(worker, noted) == [("hint", client.id)]


def test_a_job_waits_for_all_else_and_lets_others_in_between_its_steps(worker, noted) -> None:
    client = joined(worker)
    held(worker, noted, client)
    worker.give(client, messages.JobRequest(id=7, name="film"))
    worker.give(client, select(1))
    noted.job_gate.clear()
    noted.waiting.clear()
    noted.gate.set()
    assert noted.waiting.wait(10)
    draw = noted.draw

    def draw_and_ask_again(client: Client, request: messages.DrawRequest) -> None:
        draw(client, request)
        if request.id < 3:
            worker.give(client, camera(request.id + 1))

    noted.draw = draw_and_ask_again
    worker.give(client, camera(1))
    worker.give(client, select(2))
    noted.job_gate.set()
    done = settled(worker, noted)
    assert done[0] == ("select", 1, 1, 0.5)
    assert done.index(("step", 7, 0)) < done.index(("draw", 1, 1)) < done.index(("job", 7))
    assert done.index(("select", 1, 2, 0.5)) < done.index(("job", 7))
    assert done.index(("draw", 1, 3)) < done.index(("job", 7)), "one at each step at least"


def test_a_job_that_is_cancelled_ends_at_its_next_step(worker, noted) -> None:
    said: list[Any] = []
    client = worker.join(said.append)
    assert client is not None
    settled(worker, noted)
    noted.job_gate.clear()
    noted.waiting.clear()
    worker.give(client, messages.JobRequest(id=7, name="film"))
    assert noted.waiting.wait(10)
    worker.give(client, messages.Cancel(id=7))
    worker.give(client, messages.Cancel(id=99))
    noted.job_gate.set()
    assert ("job", 7) not in settled(worker, noted)
    assert any('"cancelled"' in one for one in said)
    worker.give(client, messages.JobRequest(id=7, name="film"))
    assert ("job", 7) in settled(worker, noted), "the number is free again"


def test_what_a_page_asked_is_forgotten_when_it_goes(worker, noted) -> None:
    first, second = joined(worker), joined(worker)
    held(worker, noted, second)
    worker.give(first, camera(1))
    worker.give(first, select(1))
    worker.give(second, select(2))
    worker.leave(first)
    assert settled(worker, noted) == [("select", 2, 2, 0.5)]
    assert worker.clients == (second,)


def test_no_page_may_let_too_much_wait(worker, noted) -> None:
    first, second = joined(worker), joined(worker)
    held(worker, noted, first)
    for gesture in range(64):
        worker.give(first, select(gesture))
    with pytest.raises(InputError, match="wait for an answer"):
        worker.give(first, select(64))
    worker.give(second, select(1))
    assert len(settled(worker, noted)) == 65


def test_what_is_called_is_given_back_or_raised(worker) -> None:
    assert worker.call(lambda answers: type(answers).__name__).result(10) == "Noted"

    def fail(_: object) -> None:
        raise InputError("no.")

    with pytest.raises(InputError, match="no"):
        worker.call(fail).result(10)
    worker.close()
    assert worker.call(lambda _: 1).cancelled()
    assert worker.join(lambda _: None) is None


def test_a_worker_that_cannot_open_says_so_where_it_was_started() -> None:
    def fail(_: Worker) -> Noted:
        raise InputError("no such scene.")

    worker = Worker(fail)
    with pytest.raises(InputError, match="no such scene"):
        worker.start()
    worker.close()


def test_the_scene_is_closed_at_the_end(noted) -> None:
    worker = Worker(lambda _: noted)
    worker.start()
    worker.close()
    assert noted.done[-1] == "close"


def test_there_is_room_for_so_many(worker) -> None:
    pages = [joined(worker) for _ in range(guard.MAX_CLIENTS)]
    assert worker.join(lambda _: None) is None
    worker.leave(pages[0])
    assert joined(worker).id == guard.MAX_CLIENTS + 1, "numbers are not used twice"


@pytest.mark.parametrize(
    ("said", "text", "fix"),
    [
        ("/home/me/a b/scene/layers/x.npz: expected a layer, got text.",
         "b/scene/layers/x.npz: expected a layer, got text", ""),
        ("/home/me/scene/x.npz: broken; save it again.", "x.npz: broken", "save it again"),
        ("C:\\Users\\me\\x.npz: broken.", "x.npz: broken", ""),
        ("view: expected left/0001, got 1/2.", "view: expected left/0001, got 1/2", ""),
    ],
)  # fmt: skip
def test_an_error_has_no_path_and_says_what_to_do(said: str, text: str, fix: str) -> None:
    error = messages.error_message(InputError(said), gesture=4)
    assert (error.fix, error.gesture) == (fix, 4)
    if "a b" not in said:
        assert error.text == text
    assert "/home" not in error.text
    assert "Users" not in error.text


def test_steps_of_what_is_answered_meanwhile_are_not_the_jobs(worker, noted) -> None:
    said: list[Any] = []
    client = worker.join(said.append)
    assert client is not None
    running: list[Job] = []
    run = noted.run

    def run_and_remember(job: Job) -> None:
        running.append(job)
        run(job)

    noted.run = run_and_remember
    noted.answer = lambda client, message: running[0].step(99, 100)
    settled(worker, noted)
    noted.job_gate.clear()
    noted.waiting.clear()
    worker.give(client, messages.JobRequest(id=7, name="export"))
    assert noted.waiting.wait(10)
    worker.give(client, select(1))
    noted.job_gate.set()
    assert ("job", 7) in settled(worker, noted)
    assert [one for one in said if '"progress"' in one and '"done":99' in one] == []
    assert sum('"progress"' in one for one in said) == 3


def test_what_is_done_in_idle_is_told_of_what_waits(worker, noted) -> None:
    client = joined(worker)
    held(worker, noted, client)
    assert not worker.is_asked
    worker.give(client, camera(1))
    assert worker.is_asked
    client.busy = True  # the picture before it has not gone out
    assert not worker.is_asked
    worker.give(client, select(1))
    assert worker.is_asked
    client.busy = False
    settled(worker, noted)
    assert not worker.is_asked


def test_torch_has_one_thread_in_the_worker(worker) -> None:
    assert worker.call(lambda _: torch.get_num_threads()).result(10) == 1
