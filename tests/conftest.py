"""Fixtures and settings that every test shares."""

import os
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, settings

from splatseg.methods import _method
from splatseg.render.cpu import set_threads, threads
from support import shared
from support.drive import write_drive
from support.once import made_once
from support.products import reorder_all_products, reordered
from support.room import write_room
from support.scorer import SCORERS, Score
from support.summary import SummaryAfterInternalError

PROJECT_ROOT = Path(__file__).resolve().parent.parent
SHARED = shared.SharedData.find(os.environ, PROJECT_ROOT)

# The same examples in every run (a red run can be repeated), and no deadline: the
# machines that run this are shared, and a slow moment is not a defect.
settings.register_profile(
    "splatseg",
    derandomize=True,
    deadline=None,
    database=None,
    max_examples=30,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)
settings.load_profile("splatseg")
# Hypothesis tries constants of whatever modules are loaded by then, too, which depends on the tests
# that the worker ran before: then one run in twenty meets an example that no other has.
# The oldest Hypothesis that is allowed has no such module, and does not.
with suppress(ImportError):
    from hypothesis.internal.conjecture import providers

    if hasattr(providers, "_get_local_constants"):
        providers._get_local_constants = lambda: providers._local_constants


def pytest_configure(config: pytest.Config) -> None:
    """Tests marked `data` run where the folder of large scenes is, and are told of elsewhere."""
    config.pluginmanager.register(shared.DataTests(SHARED), "splatseg-data-tests")
    config.pluginmanager.register(SummaryAfterInternalError(), "splatseg-summary")
    if reordered():
        reorder_all_products()


@pytest.fixture(scope="session")
def project_root() -> Path:
    """The folder that holds pyproject.toml."""
    return PROJECT_ROOT


@pytest.fixture(autouse=True)
def _draws_begin_anew() -> None:
    """Torch draws the same numbers in a test, whatever ran before it.

    Of the processor: `torch.manual_seed` formats the stack of calls each time, for a GPU to come.
    """
    torch.default_generator.manual_seed(20240817)
    if torch.cuda.is_initialized():
        torch.cuda.manual_seed_all(20240817)


@pytest.fixture(autouse=True)
def _methods_as_before() -> Iterator[None]:
    """What a test or a notebook registers is a method of its own: pages of help know no other."""
    before = dict(_method._REGISTERED)
    yield
    _method._REGISTERED.clear()
    _method._REGISTERED.update(before)


@pytest.fixture
def rng() -> np.random.Generator:
    """A generator with the same seed in every test."""
    return np.random.default_rng(20240817)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of large scenes. Every test that takes it is marked `data`."""
    return SHARED.folder


@pytest.fixture(scope="session")
def generated_room(tmp_path_factory: pytest.TempPathFactory, worker_id: str) -> Path:
    """A generated capture with evidence of every kind, see `support.room`; not to be changed.

    The workers of pytest-xdist share one: photographing it takes ten seconds.
    """
    return made_once(tmp_path_factory, worker_id, "room", write_room)


@pytest.fixture(scope="session")
def generated_drive(tmp_path_factory: pytest.TempPathFactory, worker_id: str) -> Path:
    """A generated street that was driven, with scans, see `support.drive`; not to be changed."""
    return made_once(tmp_path_factory, worker_id, "drive", write_drive)


@pytest.fixture(scope="session")
def fitted_room(
    tmp_path_factory: pytest.TempPathFactory, worker_id: str, generated_room: Path
) -> Path:
    """A scene fitted to `generated_room` by the command; not to be changed."""
    from splatseg.cli import main

    def fit(folder: Path) -> None:
        words = ("fit", generated_room, "-o", folder, "--steps", 200, "--max-gaussians", 4000)
        assert main([str(word) for word in words]) == 0

    return made_once(tmp_path_factory, worker_id, "scene", fit)


@pytest.fixture
def rich_capture(request: pytest.FixtureRequest) -> Path:
    """A capture with evidence of every kind: `support.shared.generated_and` says which."""
    if request.param == shared.GENERATED:
        return request.getfixturevalue("generated_room")
    return SHARED.folder / request.param


@pytest.fixture(
    params=[
        "reference",
        pytest.param("score.py", marks=pytest.mark.data),
    ]
)
def score(request: pytest.FixtureRequest) -> Callable[..., Score]:
    """A scorer that knows nothing of this project: ours of a few loops, and the shared one."""
    return SCORERS[request.param](SHARED)


@pytest.fixture
def same_threads_afterwards() -> Iterator[None]:
    """Puts the number of threads back."""
    before = threads()
    yield
    set_threads(before)
