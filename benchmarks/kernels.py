"""Our CPU kernels against the measured prototype, in one run, A and B alternated.

    python benchmarks/kernels.py --scenes garden room200k_640 room1M_1296 --repeats 20

The prototype (../shared/prototype/kernels) is compiled beside with `-O3 -march=native`. One
thread, process CPU time, minimum over the repeats; the ratio is ours / prototype's, so less is
better. Each side does the same work on the same arrays: one view, fp32.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from splatseg.core import Camera, Gaussians
from splatseg.render import RenderOptions
from splatseg.render.cpu import CpuView, isa, padded_channels, set_threads

PROTOTYPE = Path(__file__).resolve().parents[2] / "shared" / "prototype" / "kernels"
DATA = PROTOTYPE.parents[1] / "data"


def load_prototype(folder: Path) -> tuple[Any, Any]:
    """Compile and import the prototype; its garden scene reads ../../data."""
    root = folder / "prototype" / "kernels"
    shutil.copytree(PROTOTYPE, root)
    (folder / "data").symlink_to(DATA)
    for path in root.iterdir():
        path.chmod(0o644)
    subprocess.run(
        "g++ -O3 -march=native -fopenmp -shared -fPIC rs.cpp -o librs.so",
        shell=True, cwd=root, check=True,
    )  # fmt: skip
    os.environ["SCENES_CACHE"] = str(folder / "scenes")
    sys.path.insert(0, str(root))
    import rs  # pyright: ignore[reportMissingImports]
    import scenes  # pyright: ignore[reportMissingImports]

    return rs, scenes


def sgemm_gflops() -> float:
    """Single-thread fp32 matrix product, best of 5."""
    torch.set_num_threads(1)
    a, b = torch.randn(1536, 1536), torch.randn(1536, 1536)
    best = 0.0
    for _ in range(5):
        begin = time.process_time()
        a @ b
        best = max(best, 2 * 1536**3 / (time.process_time() - begin) * 1e-9)
    return best


def alternate(
    ours: Callable[[], object], theirs: Callable[[], object] | None, repeats: int
) -> tuple[float, float]:
    """Least CPU milliseconds of each side."""
    best = [float("inf"), float("inf")]
    for _ in range(repeats):
        for side, call in enumerate((ours, theirs)):
            if call is None:
                continue
            begin = time.process_time()
            call()
            best[side] = min(best[side], (time.process_time() - begin) * 1e3)
    return best[0], best[1]


def measure(name: str, rs: Any, scenes: Any, repeats: int) -> dict[str, Any]:
    """All rows of one scene."""
    scene = scenes.get(name)
    n, height, width = len(scene["means"]), scene["H"], scene["W"]
    prototype = rs.RS(threads=1)
    intrinsics = scene["Ks"][0]
    camera = Camera(
        width=width, height=height, fx=float(intrinsics[0, 0]), fy=float(intrinsics[1, 1]),
        cx=float(intrinsics[0, 2]), cy=float(intrinsics[1, 2]),
        cam_from_world=torch.eye(4, dtype=torch.float64),
    )  # fmt: skip
    pose = torch.from_numpy(scene["viewmats"][0])
    # The scene's poses are float32 and not quite rigid; the kernels take them as they are.
    object.__setattr__(camera, "cam_from_world", pose.double())
    harmonics = torch.zeros(n, 16, 3)
    names = {"means": "means", "rotations": "quats", "scales": "scales", "opacities": "opac"}
    cloud = Gaussians(
        **{name: torch.from_numpy(scene[key]) for name, key in names.items()}, sh=harmonics
    )
    colours = torch.from_numpy(scene["colors"])
    options = RenderOptions()
    rng = np.random.default_rng(0)

    def prepare() -> CpuView:
        view = CpuView(cloud, camera, options)
        view._kernels(signal=colours)
        return view

    rows: dict[str, tuple[float, float]] = {}
    rows["prepare"] = alternate(
        lambda: prepare().close(), lambda: prototype.prepare(scene, 0), repeats
    )
    prototype.prepare(scene, 0)
    view = prepare()
    # Both sides write into memory that is there: fresh pages would cost as much as blending.
    spare = tuple(torch.empty(height, width) for _ in range(3))
    quiet = (False,)  # record nothing for a backward pass
    image3 = torch.empty(height, width, 3)
    rows["rgb+depth"] = alternate(
        lambda: view._view.forward_colour(3, image3, *spare, *quiet),
        lambda: prototype.rgb(scene["colors"]),
        repeats,
    )
    view.draw(colours)
    statistics = view.statistics
    out, left = prototype.rgb(scene["colors"])
    v_image = rng.standard_normal((height, width, 4)).astype(np.float32)
    v_left = rng.standard_normal((height, width)).astype(np.float32)
    view.draw(colours, record=True)
    mine = torch.from_numpy(v_image[..., :3].copy())
    planes = (
        *view._forward, mine, torch.from_numpy(v_left), torch.from_numpy(v_image[..., 3].copy())
    )  # fmt: skip
    rows["backward 2D"] = alternate(
        lambda: view._view.backward_colour(3, *planes),
        lambda: prototype.backward(scene["colors"], scene["opac"], out, left, v_image, v_left),
        repeats,
    )
    everything = frozenset(("means", "rotations", "scales", "opacities", "sh"))
    with_sh = CpuView(cloud, camera, options)
    with_sh.draw(record=True)
    rows["backward 3D (degree 3)"] = alternate(
        lambda: with_sh.backward(mine, v_alpha=planes[4], v_depth_sum=planes[5], wanted=everything),
        None,
        repeats,
    )
    with_sh.close()
    for channels in (16, 64, 256, 512):
        if channels > 64 and n > 500_000:
            continue
        signal = torch.from_numpy(rng.standard_normal((n, channels)).astype(np.float32))
        image = torch.from_numpy(rng.standard_normal((height, width, channels)).astype(np.float32))
        result = np.empty((height, width, channels), np.float32)
        few = repeats if channels <= 64 else 5
        rows[f"D={channels}"] = alternate(
            lambda s=signal, r=result, c=channels: view._view.forward_features(
                s, c, torch.from_numpy(r), *spare, *quiet
            ),
            (lambda s=signal, r=result: prototype.feat(s.numpy(), r)) if channels <= 64 else None,
            few,
        )
        sums, weights = torch.zeros(n, channels), torch.zeros(n)
        given = np.zeros((n, channels), np.float32)
        rows[f"adjoint D={channels}"] = alternate(
            lambda i=image, c=channels, s=sums, w=weights: view._view.adjoint(i, c, s, w),
            (lambda i=image, g=given: prototype.adjoint(i.numpy(), g)) if channels <= 64 else None,
            few,
        )
        if channels == 64:
            slot = view.block_matrix()  # both sides build into memory of an earlier view
            rows["blocks build"] = alternate(
                lambda m=slot: m.build(view._view), lambda: prototype.bsr(), repeats
            )
            prototype.bsr()
            matrix = view.block_matrix()
            flat = torch.empty(height * width, channels)
            padded = torch.zeros(n, padded_channels(channels))
            rows["blocks render D=64"] = alternate(
                lambda s=signal, f=flat, m=matrix: m.render(s, 64, f),
                lambda s=signal, r=result: prototype.bsr_render(s.numpy(), r),
                repeats,
            )
            rows["blocks unproject D=64"] = alternate(
                lambda i=image, p=padded, w=weights, m=matrix: m.back_project(i, 64, p, w),
                lambda i=image, g=given: prototype.bsr_unproject(i.numpy(), g),
                repeats,
            )
    return {"gaussians": n, "size": [width, height], **statistics, "rows": rows}


def report(name: str, found: dict[str, Any], sgemm: float) -> None:
    """Print one scene's table."""
    pairs = found["pixel_pairs"]
    print(
        f"\n{name}: {found['gaussians']} Gaussians, {found['size'][0]}x{found['size'][1]}, "
        f"{found['visible']} in view, {found['tile_pairs']} tile pairs, {pairs / 1e6:.1f} M "
        f"pixel pairs evaluated; sgemm {sgemm:.0f} GFLOP/s"
    )
    print(f"{'':26}{'ours ms':>10}{'prototype':>11}{'ratio':>8}{'Mpairs/s':>10}{'of sgemm':>10}")
    for row, (ours, theirs) in found["rows"].items():
        ratio = f"{ours / theirs:8.2f}" if theirs < float("inf") else " " * 8
        share = ""
        if "D=" in row:
            flops = pairs * (2 * int(row.split("=")[1]) + 30)
            share = f"{flops / ours * 1e-6 / sgemm:9.0%}"
        other = f"{theirs:11.1f}" if theirs < float("inf") else " " * 11
        print(f"{row:26}{ours:10.1f}{other}{ratio}{pairs / ours * 1e-3:10.0f}{share:>10}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", nargs="+", default=["garden", "room200k_640", "room1M_1296"])
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    set_threads(1)
    sgemm = sgemm_gflops()
    print(f"kernels: {isa()}, torch {torch.__version__}")
    found = {}
    with tempfile.TemporaryDirectory() as folder:
        rs, scenes = load_prototype(Path(folder))
        for name in args.scenes:
            found[name] = measure(name, rs, scenes, args.repeats)
            report(name, found[name], sgemm)
    if args.json:
        args.json.write_text(json.dumps({"isa": isa(), "sgemm": sgemm, "scenes": found}, indent=1))


if __name__ == "__main__":
    main()
