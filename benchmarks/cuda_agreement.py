"""Do the CPU and CUDA backends agree, and how fast is the GPU? Needs gsplat and an NVIDIA GPU.

    python benchmarks/cuda_agreement.py --gaussians 200000 --size 1296 840

One random room of balls and needles from three cameras. For each it prints, CPU against CUDA with
the same options (opacity cap 0.999, which gsplat has built in):

- RGB, 64-channel features, alpha, expected and median depth: largest and mean difference, and the
  share of pixels that differ by more than 1e-4 (flips at thresholds);
- the adjoint of a 64-channel image and the visibility: relative error;
- gradients of a random functional of colour, alpha and depth towards means, rotations, scales,
  opacities, harmonics and the pose: relative error;
- the adjoint identity <W f, g> == <f, W.T g> on each backend by itself.

Then frames per second on the GPU for RGB from harmonics, for 64 channels and for a 64-channel
adjoint, once as the backend gives them and once gsplat's product alone, without the median depth,
which needs a list of all pixel-Gaussian pairs. Exit status 1 if the backends disagree.
"""

import argparse
import platform
import sys
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from splatseg.core import Camera, Gaussians
from splatseg.core.rigid import rotation_from_quaternion
from splatseg.errors import SplatsegError
from splatseg.render import RenderOptions, get_backend
from splatseg.render.cuda import CudaBackend, CudaView, colours

OPTIONS = RenderOptions(alpha_max=0.999)
COLUMNS = ("means", "rotations", "scales", "opacities", "sh")
FLIP = 1e-4
"""A pixel that differs by more is counted as a flip at a threshold."""


def scene_of(count: int, rng: np.random.Generator) -> Gaussians:
    """Flat ellipses on the walls and inside of a room of 6 x 5 x 3."""
    points = rng.uniform((-3, -2.5, -1.5), (3, 2.5, 1.5), (count, 3))
    walls = np.array((3.0, 2.5, 1.5))
    on_wall = rng.random(count) < 0.7
    axis = rng.integers(0, 3, count)
    side = rng.choice((-1.0, 1.0), count)
    points[on_wall, axis[on_wall]] = (side * walls[axis])[on_wall]
    spacing = (90.0 / count) ** 0.5
    scales = spacing * np.exp(rng.normal(-0.3, 0.6, (count, 3)))
    return Gaussians(
        means=_float(points),
        rotations=_float(rng.normal(size=(count, 4))),
        scales=_float(scales),
        opacities=_float(1 / (1 + np.exp(-rng.normal(0, 2, count)))),
        sh=_float(rng.normal(0, 0.25, (count, 16, 3))),
    )


def cameras_of(width: int, height: int, rng: np.random.Generator) -> list[Camera]:
    """Three places inside the room, looking anywhere."""
    cameras: list[Camera] = []
    for _ in range(3):
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, :3] = rotation_from_quaternion(torch.from_numpy(rng.normal(size=4)))
        pose[:3, 3] = -pose[:3, :3] @ torch.from_numpy(rng.uniform(-1, 1, 3))
        cameras.append(
            Camera(
                width=width,
                height=height,
                fx=0.8 * width,
                fy=0.8 * width,
                cx=width / 2,
                cy=height / 2,
                cam_from_world=pose,
            )
        )
    return cameras


def _float(values: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, dtype=np.float32))


def image_line(name: str, a: Tensor, b: Tensor) -> tuple[str, float]:
    """One line of the table, and the share of flipped pixels."""
    error = (a.double().cpu() - b.double().cpu()).abs()
    per_pixel = error.reshape(*error.shape[:2], -1).amax(dim=-1)
    flips = float((per_pixel > FLIP).double().mean())
    line = f"  {name:<14} max {per_pixel.max():.2e}  mean {error.mean():.2e}  flips {flips:.2e}"
    return line, flips


def relative(a: Tensor, b: Tensor) -> float:
    """L2 distance over the length of b."""
    a, b = a.double().cpu(), b.double().cpu()
    return float(torch.linalg.vector_norm(a - b) / torch.linalg.vector_norm(b).clamp_min(1e-30))


def gradients(name: str, scene: Gaussians, camera: Camera, v_image: Tensor) -> dict[str, Tensor]:
    """Of a random functional of colour, alpha and depth, towards everything."""
    leaves = {c: getattr(scene, c).clone().requires_grad_() for c in COLUMNS}
    pose = camera.cam_from_world.clone().requires_grad_()
    moved = replace(camera, cam_from_world=pose)
    drawn = get_backend(name).render(scene.replace(**leaves), moved, None, options=OPTIONS)
    loss = (drawn.image * v_image[..., :3]).sum() + (drawn.alpha * v_image[..., 3]).sum()
    (loss + (drawn.depth * v_image[..., 4]).sum()).backward()
    return {c: leaf.grad for c, leaf in leaves.items()} | {"pose": pose.grad}


def agreement(scene: Gaussians, camera: Camera, rng: np.random.Generator) -> bool:
    """Print how well one view agrees; True if it does."""
    cpu, cuda = get_backend("cpu"), get_backend("cuda")
    size = (camera.height, camera.width)
    signal = _float(rng.normal(size=(len(scene), 64)))
    image = _float(rng.normal(size=(*size, 64)))
    good = True

    drawn = [b.render(scene, camera, None, options=OPTIONS) for b in (cpu, cuda)]
    wide = [b.render(scene, camera, signal, options=OPTIONS).image for b in (cpu, cuda)]
    rows = [(f, getattr(drawn[1], f), getattr(drawn[0], f)) for f in ("image", "alpha", "depth")]
    rows += [("64 channels", wide[1], wide[0])]
    rows += [("median depth", drawn[1].median_depth, drawn[0].median_depth)]
    for name, a, b in rows:
        line, flips = image_line(name, a, b)
        good &= flips < 0.02
        print(line)

    back = [b.back_project(scene, camera, image, options=OPTIONS) for b in (cpu, cuda)]
    adjoint, seen = relative(back[1].sums, back[0].sums), relative(back[1].weights, back[0].weights)
    good &= adjoint < 2e-3 and seen < 2e-3
    print(f"  adjoint        relative {adjoint:.2e}; visibility {seen:.2e}")
    for name, view, found in zip(("cpu", "cuda"), wide, back, strict=True):
        product = view.double().cpu() * image.double()
        right = (signal.double() * found.sums.double().cpu()).sum()
        gap = float((product.sum() - right).abs() / product.abs().sum())
        good &= gap < (1e-5 if name == "cpu" else 1e-3)
        print(f"  identity {name:<5} |<Wf,g> - <f,W'g>| / sum |Wf g| = {gap:.2e}")

    v_image = _float(rng.normal(size=(*size, 5)))
    both = [gradients(name, scene, camera, v_image) for name in ("cpu", "cuda")]
    for name, expected in both[0].items():
        error = relative(both[1][name], expected)
        good &= error < 5e-3
        print(f"  d {name:<12} relative {error:.2e}")
    return good


def frames_per_second(work: Callable[[], object], seconds: float = 3.0) -> float:
    """After a warm-up, as many as fit."""
    for _ in range(5):
        work()
    torch.cuda.synchronize()
    begin, count = time.perf_counter(), 0
    while time.perf_counter() - begin < seconds:
        work()
        count += 1
        torch.cuda.synchronize()
    return count / (time.perf_counter() - begin)


@torch.no_grad()
def speed(scene: Gaussians, camera: Camera) -> None:
    """Print frames per second with everything on the GPU."""
    cuda = get_backend("cuda")
    scene = scene.to(device="cuda")
    size = (camera.height, camera.width)
    signal = torch.randn(len(scene), 64, device="cuda")
    image = torch.randn(*size, 64, device="cuda")
    library = load_library(cuda)

    def product(channels: Tensor | None) -> Tensor:
        view = CudaView.of(scene, camera, options=OPTIONS, gsplat=library)
        shown = colours(view, scene, camera, None) if channels is None else channels
        return view.product(shown)[0]

    pairs = len(CudaView.of(scene, camera, options=OPTIONS, gsplat=library).entries().ids)
    print(f"  {pairs} blended pairs, {pairs / (size[0] * size[1]):.1f} a pixel")
    table: list[tuple[str, Callable[[], object]]] = [
        ("RGB with depths", lambda: cuda.render(scene, camera, None, options=OPTIONS)),
        ("RGB alone", lambda: product(None)),
        ("64 with depths", lambda: cuda.render(scene, camera, signal, options=OPTIONS)),
        ("64 alone", lambda: product(signal)),
        ("64, adjoint", lambda: cuda.back_project(scene, camera, image, options=OPTIONS)),
    ]
    for name, work in table:
        print(f"  {name:<16} {frames_per_second(work):8.1f} per second")


def load_library(backend: object) -> object:
    """The gsplat module the backend uses."""
    if not isinstance(backend, CudaBackend):
        raise TypeError("expected the cuda backend")
    return backend._gsplat  # pyright: ignore[reportPrivateUsage]


def main() -> int:
    """Run it all."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--gaussians", type=int, default=200_000)
    parser.add_argument("--size", type=int, nargs=2, default=(1296, 840), metavar=("W", "H"))
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    try:
        get_backend("cuda")
    except SplatsegError as error:
        print(f"cannot run: {error}", file=sys.stderr)
        return 1
    import gsplat

    rng = np.random.default_rng(arguments.seed)
    scene = scene_of(arguments.gaussians, rng)
    width, height = arguments.size
    print(
        f"{torch.cuda.get_device_name()}, torch {torch.__version__}, gsplat {gsplat.__version__}, "
        f"{platform.machine()}; {len(scene)} Gaussians at {width} x {height}"
    )
    good = True
    cameras = cameras_of(width, height, rng)
    for number, camera in enumerate(cameras):
        print(f"view {number}")
        good &= agreement(scene, camera, rng)
    for number, camera in enumerate(cameras):
        print(f"speed of view {number}")
        speed(scene, camera)
    print("the backends agree" if good else "THE BACKENDS DISAGREE")
    return 0 if good else 1


if __name__ == "__main__":
    raise SystemExit(main())
