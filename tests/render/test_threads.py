"""Renders in threads and in forked processes."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from render_scenes import float32, random_camera, random_gaussians

from splatseg import render as splat
from splatseg.errors import InputError, RangeError
from splatseg.render.cpu import isa, set_isa, set_threads, threads

THREADS = [1, 2, 3, 7]


def _everything(bench, rng) -> dict[str, torch.Tensor]:
    """All that can be computed of one view."""
    camera = random_camera(rng, width=131, height=90)
    scene = random_gaussians(rng, 3000)
    image = float32(rng.normal(size=(90, 131, 21)))
    signal = float32(rng.normal(size=(3000, 70)))
    leaves = {
        name: getattr(scene, name).clone().requires_grad_()
        for name in ("means", "rotations", "scales", "opacities", "sh")
    }
    pose = camera.cam_from_world.clone().requires_grad_()
    drawn = bench.render(scene.replace(**leaves), replace(camera, cam_from_world=pose))
    (drawn.image.square().sum() + drawn.depth.sum()).backward()
    wide_leaf = signal.clone().requires_grad_()
    wide = bench.render(scene, camera, wide_leaf)
    wide.image.square().sum().backward()
    back = bench.back_project(scene, camera, image)
    csr = bench.weights(scene, camera)
    pixels = torch.stack((torch.arange(90), torch.arange(90)), dim=1)
    rows = bench.contributors(scene, camera, pixels, 5)
    return {
        "image": drawn.image,
        "alpha": drawn.alpha,
        "depth": drawn.depth,
        "median": drawn.median_depth,
        **{f"d {name}": leaf.grad for name, leaf in leaves.items()},
        "d pose": pose.grad,
        "wide": wide.image,
        "d signal": wide_leaf.grad,
        "sums": back.sums,
        "weights": back.weights,
        "csr": torch.cat((csr.indptr.double(), csr.ids.double(), csr.weights.double())),
        "csr render": csr.product(signal),
        "csr back": csr.adjoint(image.reshape(-1, 21)),
        "ids": rows.ids,
        "row weights": rows.weights,
    }


@pytest.mark.bits
def test_results_do_not_depend_on_threads(fast_backend, same_threads_afterwards):
    if fast_backend.name == "cuda":
        pytest.skip("threads are the CPU's; gsplat sums in whatever order the GPU takes")
    expected: dict[str, torch.Tensor] = {}
    for count in THREADS:
        set_threads(count)
        assert threads() == count
        found = _everything(fast_backend, np.random.default_rng(5))
        if not expected:
            expected = found
            assert expected["alpha"].mean() > 0.5
            continue
        for name, value in expected.items():
            assert torch.equal(found[name], value), f"{name} with {count} threads"


def test_a_second_call_gives_the_same(backend, rng):
    camera = random_camera(rng)
    scene = random_gaussians(rng, 300)
    first, second = (backend.render(scene, camera).image for _ in range(2))
    assert torch.equal(first, second)


def test_threads_and_instructions_are_checked():
    with pytest.raises(RangeError, match="threads"):
        set_threads(0)
    with pytest.raises(InputError, match="isa"):
        set_isa("mmx")


def test_the_portable_path_is_always_there(rng):
    before = isa()
    set_isa("portable")
    try:
        assert isa() == "portable"
        camera, scene = random_camera(rng), random_gaussians(rng, 50)
        assert splat.render(scene, camera, backend="cpu").alpha.any()
    finally:
        set_isa(before)


# A forked child has none of its parent's threads: it must neither hang nor draw otherwise.


# In a process of its own: no fork survives the threads that torch has started for other tests.
FORKING = """
import os, signal, warnings
import torch
from splatseg.core import Camera, Gaussians
from splatseg.render import render
from splatseg.render.cpu import set_threads

warnings.simplefilter("ignore", DeprecationWarning)
torch.set_num_threads(1)
g = torch.Generator().manual_seed(3)
n = 500
scene = Gaussians(
    means=torch.randn(n, 3, generator=g) + torch.tensor([0.0, 0.0, 4.0]),
    rotations=torch.randn(n, 4, generator=g),
    scales=torch.rand(n, 3, generator=g) * 0.2,
    opacities=torch.rand(n, generator=g),
    sh=torch.randn(n, 4, 3, generator=g),
)
camera = Camera(width=150, height=100, fx=120, fy=120, cx=75, cy=50, cam_from_world=torch.eye(4))
set_threads(3)
parent = render(scene, camera).image
child = os.fork()
if child == 0:
    signal.alarm(30)  # a hang ends the child with a signal, which the parent sees
    os._exit(0 if torch.equal(render(scene, camera).image, parent) else 3)
print("child", os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
print("parent", torch.equal(render(scene, camera).image, parent), float(parent.max()) > 0)
"""


def test_a_forked_child_draws_the_same_picture() -> None:
    done = subprocess.run(
        [sys.executable, "-c", FORKING], check=False, capture_output=True, text=True, timeout=120
    )
    assert done.stdout.split("\n")[:2] == ["child 0", "parent True True"], done.stderr
