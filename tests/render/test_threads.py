"""The same bits whatever the number of threads, and from one call to the next."""

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
    blocks = bench.image_weights(scene, camera)
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
        "blocks render": blocks.product(signal),
        "blocks back": blocks.adjoint(image.reshape(-1, 21)),
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
