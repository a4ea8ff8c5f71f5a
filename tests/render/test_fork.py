"""A forked child has none of its parent's threads: it must neither hang nor draw otherwise."""

import os
import signal

import pytest
import torch

from splatseg.core import Camera, Gaussians
from splatseg.render import render
from splatseg.render.cpu import set_threads, threads


@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")
def test_a_forked_child_draws_the_same_picture() -> None:
    g = torch.Generator().manual_seed(3)
    n = 500
    scene = Gaussians(
        means=torch.randn(n, 3, generator=g) + torch.tensor([0.0, 0.0, 4.0]),
        rotations=torch.randn(n, 4, generator=g),
        scales=torch.rand(n, 3, generator=g) * 0.2,
        opacities=torch.rand(n, generator=g),
        sh=torch.randn(n, 4, 3, generator=g),
    )
    camera = Camera(
        width=150, height=100, fx=120, fy=120, cx=75, cy=50, cam_from_world=torch.eye(4)
    )
    before = threads()
    set_threads(3)
    try:
        parent = render(scene, camera).image
        child = os.fork()
        if child == 0:  # pragma: no cover -- in the child
            signal.alarm(30)  # a hang ends the child with a signal, which the parent sees
            same = torch.equal(render(scene, camera).image, parent)
            os._exit(0 if same else 3)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
        assert torch.equal(render(scene, camera).image, parent)
    finally:
        set_threads(before)
