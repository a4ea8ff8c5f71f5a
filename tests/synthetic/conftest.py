"""One small room, photographed once for all tests of this folder."""

from collections.abc import Mapping

import pytest

from splatseg.core import View
from splatseg.synthetic import SyntheticScene, Truth, cameras, render_truth, room


@pytest.fixture(scope="session")
def small_room() -> SyntheticScene:
    return room(seed=0)


@pytest.fixture(scope="session")
def small_views(small_room: SyntheticScene) -> tuple[View, ...]:
    return cameras(small_room, train=18, test=4, width=96, height=72)


@pytest.fixture(scope="session")
def small_truths(small_room: SyntheticScene, small_views: tuple[View, ...]) -> Mapping[str, Truth]:
    return {view.name: render_truth(small_room, view.camera) for view in small_views}
