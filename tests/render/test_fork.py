"""A forked child has none of its parent's threads: it must neither hang nor draw otherwise."""

import subprocess
import sys

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
