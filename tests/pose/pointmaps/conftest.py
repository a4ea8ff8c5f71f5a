"""A room that the tests of pointmaps share."""

import pytest

from support.pointmaps import PhotographedRoom


@pytest.fixture(scope="session")
def photographed() -> PhotographedRoom:
    """Eight small photographs of a generated room."""
    return PhotographedRoom.of(8)
