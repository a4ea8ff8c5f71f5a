"""Torch's threads inside the library and outside of it."""

import threading
import time
from collections.abc import Iterator

import pytest
import torch

from splatseg.core.boundary import boundary
from splatseg.core.threads import (
    all_torch_threads,
    caller_threads,
    in_threads,
    network_inference,
    one_torch_thread,
)


@pytest.fixture(autouse=True)
def three_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    yield
    torch.set_num_threads(before)


@boundary
def _public(calls: int = 0) -> tuple[int, int]:
    return _public(calls - 1) if calls else (torch.get_num_threads(), caller_threads())


@boundary
def _network() -> tuple[int, int, int]:
    with all_torch_threads():
        inside = torch.get_num_threads()
        nested = _public()[0]
        return inside, nested, torch.get_num_threads()


def test_a_public_function_has_one_thread_and_gives_back_the_callers() -> None:
    assert _public(2) == (1, 3)
    assert torch.get_num_threads() == caller_threads() == 3


def test_an_error_gives_back_the_threads() -> None:
    @boundary
    def fails() -> None:
        raise ValueError("no")

    with pytest.raises(ValueError, match="no"):
        fails()
    assert torch.get_num_threads() == 3


def test_networks_have_the_callers_threads() -> None:
    assert _network() == (3, 1, 3)
    assert torch.get_num_threads() == 3
    with one_torch_thread():
        assert _network() == (3, 1, 3)
        assert torch.get_num_threads() == 1


@boundary
def _answers() -> tuple[int, bool]:
    @network_inference()
    def forward() -> tuple[int, bool]:
        return torch.get_num_threads(), torch.is_inference_mode_enabled()

    return forward()


def test_inference_has_all_threads_and_no_gradients() -> None:
    assert _answers() == (3, True)
    assert not torch.is_inference_mode_enabled()


@pytest.mark.parametrize("threads", [1, 3])
def test_results_of_threads_come_in_order(threads: int) -> None:
    def slow_at_first(i: int) -> tuple[int, int]:
        time.sleep(0.02 if i == 0 else 0)
        return i, torch.get_num_threads()

    with one_torch_thread():
        assert list(in_threads(slow_at_first, range(5), threads)) == [(i, 1) for i in range(5)]


def test_calls_run_at_the_same_time() -> None:
    together = threading.Barrier(2)
    assert len(list(in_threads(lambda _: together.wait(timeout=10), range(2), 2))) == 2


def test_no_call_begins_after_an_error() -> None:
    begun: list[int] = []

    def fails_at_once(i: int) -> None:
        begun.append(i)
        if i == 0:
            raise ValueError("no")
        time.sleep(0.05)

    with pytest.raises(ValueError, match="no"):
        list(in_threads(fails_at_once, range(100), 2))
    assert len(begun) < 10
