"""Fixtures and settings that every test shares."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, settings

PROJECT_ROOT = Path(__file__).resolve().parent.parent

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


@pytest.fixture(scope="session")
def project_root() -> Path:
    """The folder that holds pyproject.toml."""
    return PROJECT_ROOT


@pytest.fixture
def rng() -> np.random.Generator:
    """A generator with the same seed in every test."""
    return np.random.default_rng(20240817)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real and rendered test input, beside the project's own folder.

    It never skips: a run that could not see its data must not look green.
    """
    folder = PROJECT_ROOT.parent / "shared" / "data"
    if not (folder / "README.md").is_file():
        pytest.fail(
            "this test needs the test data in the folder shared/data beside the project's "
            "folder (../shared/data/README.md), which is missing",
            pytrace=False,
        )
    return folder
