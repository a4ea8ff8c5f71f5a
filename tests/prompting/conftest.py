"""A wall of four fields to select on, and every instruction set that this machine has."""

from collections.abc import Iterator

import pytest
import torch

from splatseg import _native
from splatseg.core import Gaussians, InstanceTree, Labels, Scene, TreeNode, View
from support.wall import camera, field_ids, wall


@pytest.fixture
def gaussians() -> Gaussians:
    return wall()


@pytest.fixture
def view() -> View:
    return View(name="front", camera=camera())


@pytest.fixture
def side() -> View:
    return View(name="side", camera=camera(0.5))


@pytest.fixture
def labels(gaussians) -> Labels:
    ids = field_ids(gaussians)
    return Labels(ids=ids, confidence=(ids > 0).float())


@pytest.fixture
def tree(gaussians) -> InstanceTree:
    """Group 10 of objects 5 (the left half, whose parts are 1 and 3) and 6 (whose part is 2)."""
    nodes = (
        TreeNode(id=10, level="group"),
        TreeNode(id=5, parent=10, class_id=7),
        TreeNode(id=6, parent=10, class_id=7),
        TreeNode(id=1, parent=5, level="part"),
        TreeNode(id=3, parent=5, level="part"),
        TreeNode(id=2, parent=6, level="part"),
    )
    ids = field_ids(gaussians)
    ids = torch.where(ids == 4, 6, ids)
    return InstanceTree(nodes=nodes, labels=Labels(ids=ids, confidence=(ids > 0).float()))


@pytest.fixture
def scene(gaussians, view, side) -> Scene:
    return Scene(gaussians=gaussians, views=(view, side))


@pytest.fixture(params=["avx512", "avx2", "portable"])
def every_isa(request: pytest.FixtureRequest) -> Iterator[str]:
    """Each test that asks for it runs on every instruction set."""
    before = _native.isa()
    if not _native.set_isa(request.param):
        pytest.skip(f"no {request.param} here")
    yield request.param
    _native.set_isa(before)
