"""Our CPU backend against gsplat's PyTorch reference on the whole garden scene.

    python benchmarks/gsplat_torch.py

gsplat 1.5.3's own torch code projects, lists the tiles and adds up (`_rasterize_to_pixels` does
the last by listing every pixel-Gaussian pair and compositing the list). Two of its steps exist in
CUDA only and stand in torch here: the listing (tests/render/gsplat_in_torch.py) and nerfacc's
weights along rays. One thread each, process CPU time; the reference once, ours the least of 20.
"""

import sys
import time
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from gsplat.cuda import _torch_impl
from torch import Tensor

from splatseg.core import Camera, Gaussians
from splatseg.render import RenderOptions
from splatseg.render.cpu import CpuView, isa, set_threads

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests" / "render"))
import gsplat_in_torch as library  # noqa: E402

GARDEN = ROOT.parent / "shared" / "data" / "test_garden.npz"
OPTIONS = RenderOptions(alpha_max=0.999)


def garden() -> dict[str, np.ndarray]:
    """gsplat's test scene with the sizes, turns and opacities its own tests draw."""
    with np.load(GARDEN, allow_pickle=False) as file:
        stored = {name: file[name] for name in file.files}
    inside = (np.abs(stored["means3d"]) <= 2).all(axis=1)
    rng = np.random.default_rng(42)
    n = int(inside.sum())
    stored["means"] = stored["means3d"][inside].astype(np.float32)
    stored["rgb"] = (stored["colors"][inside] / 255).astype(np.float32)
    stored["scales"] = rng.uniform(1e-4, 0.02, (n, 3)).astype(np.float32)
    quaternions = rng.standard_normal((n, 4)).astype(np.float32)
    stored["quats"] = quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)
    stored["opacities"] = rng.random(n).astype(np.float32)
    return stored


def add_up(
    centres: Tensor, conics: Tensor, opacities: Tensor, colours: Tensor, ids: Tensor,
    pixels: Tensor, width: int, height: int,
) -> Tensor:  # fmt: skip
    """gsplat's `accumulate` with the weights along rays in torch: pairs in, image out."""
    points = torch.stack((pixels % width, pixels // width), dim=-1) + 0.5
    offset = points - centres[ids]
    conic = conics[ids]
    sigma = (
        0.5 * (conic[:, 0] * offset[:, 0] ** 2 + conic[:, 2] * offset[:, 1] ** 2)
        + conic[:, 1] * offset[:, 0] * offset[:, 1]
    )
    alphas = (opacities[ids] * torch.exp(-sigma)).clamp_max(0.999)
    # Transmittance before each pair: the running product, restarted at every pixel.
    passed = torch.log1p(-alphas.double()).cumsum(0)
    before = torch.cat((passed.new_zeros(1), passed[:-1]))
    starts = torch.cat((pixels.new_tensor([True]).bool(), pixels[1:] != pixels[:-1]))
    row = starts.cumsum(0) - 1
    weights = alphas * torch.exp(before - before[starts][row]).float()
    image = torch.zeros(height * width, colours.shape[1])
    return image.index_add_(0, pixels, weights[:, None] * colours[ids])


def reference(scene: dict[str, np.ndarray], width: int, height: int) -> tuple[Tensor, list[float]]:
    """gsplat's torch pipeline; seconds of projection, tile lists, pair lists, sums."""
    tensors = [torch.from_numpy(scene[k]) for k in ("means", "quats", "scales", "opacities")]
    means, quaternions, scales, opacities = tensors
    pose = torch.from_numpy(scene["viewmats"][:1]).float()
    intrinsics = torch.from_numpy(scene["Ks"][:1]).float()
    colours = torch.from_numpy(scene["rgb"])
    marks = [time.process_time()]
    covariances, _ = _torch_impl._quat_scale_to_covar_preci(
        quaternions, scales, compute_preci=False
    )
    radii, centres, depths, conics, _ = _torch_impl._fully_fused_projection(
        means, covariances, pose, intrinsics, width, height, eps2d=0.3, near_plane=0.01
    )
    marks.append(time.process_time())
    across, down = -(-width // 16), -(-height // 16)
    _, keys, ids = _torch_impl._isect_tiles(centres, radii, depths, 16, across, down)
    starts = _torch_impl._isect_offset_encode(keys, 1, across, down)
    marks.append(time.process_time())
    gaussians, pixels, _ = library.rasterize_to_indices_in_range(
        0, 1 << 30, torch.ones(1, height, width), centres, conics, opacities[None], width, height,
        16, starts, ids,
    )  # fmt: skip
    marks.append(time.process_time())
    image = add_up(centres[0], conics[0], opacities, colours, gaussians, pixels, width, height)
    marks.append(time.process_time())
    return image.reshape(height, width, 3), [b - a for a, b in pairwise(marks)]


def main() -> None:
    torch.set_num_threads(1)
    set_threads(1)
    scene = garden()
    width, height = int(scene["width"]), int(scene["height"])
    image, seconds = reference(scene, width, height)
    intrinsics = scene["Ks"][0]
    camera = Camera(
        width=width, height=height, fx=float(intrinsics[0, 0]), fy=float(intrinsics[1, 1]),
        cx=float(intrinsics[0, 2]), cy=float(intrinsics[1, 2]),
        cam_from_world=torch.eye(4, dtype=torch.float64),
    )  # fmt: skip
    # The poses are float32 and not quite rigid; gsplat takes them as they are, and so do we here.
    object.__setattr__(camera, "cam_from_world", torch.from_numpy(scene["viewmats"][0]).double())
    names = {"means": "means", "rotations": "quats", "scales": "scales", "opacities": "opacities"}
    columns = {name: torch.from_numpy(scene[key]) for name, key in names.items()}
    cloud = Gaussians(**columns, sh=torch.zeros(len(columns["means"]), 1, 3))
    colours = torch.from_numpy(scene["rgb"])
    best = float("inf")
    ours = image
    for _ in range(20):
        begin = time.process_time()
        with CpuView(cloud, camera, OPTIONS) as view:
            ours = view.draw(colours)[0]
        best = min(best, time.process_time() - begin)
    error = (ours - image).abs()
    total = sum(seconds)
    names = ("projection", "tile lists", "pair lists", "sums")
    print(", ".join(f"{name} {s:.2f} s" for name, s in zip(names, seconds, strict=True)))
    print(
        f"garden, {len(cloud)} Gaussians, {width}x{height}, one thread: gsplat's PyTorch "
        f"reference {total:.2f} s, ours ({isa()}) {best * 1e3:.1f} ms, ratio {total / best:.0f}; "
        f"largest difference {float(error.max()):.1e}, mean {float(error.mean()):.1e}"
    )


if __name__ == "__main__":
    main()
