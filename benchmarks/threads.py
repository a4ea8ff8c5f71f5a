"""What more threads bring: wall time with one and with more, alternated, least of the repeats.

    python benchmarks/threads.py --repeats 15
    python benchmarks/threads.py --threads 1 2 4 8 16

On a shared machine the second core is seldom free: run it in a quiet moment. The results are
compared as well; they must be the same to the bit, whatever the number.
"""

import argparse
import time
from collections.abc import Callable

import torch
from memory import camera, room

from splatseg.render import RenderOptions
from splatseg.render.cpu import CpuView, isa, set_threads


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--gaussians", type=int, default=1_000_000)
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    args = parser.parse_args()
    counts: list[int] = args.threads
    scene, view_camera = room(args.gaussians, 0), camera()
    options = RenderOptions()
    size = (view_camera.height, view_camera.width)
    signal, wide = torch.randn(len(scene), 64), torch.randn(*size, 64)
    image, planes = torch.empty(*size, 64), tuple(torch.empty(size) for _ in range(3))
    image3, v_image = torch.empty(*size, 3), torch.randn(*size, 3)
    sums, weights = torch.zeros(len(scene), 64), torch.zeros(len(scene))
    quiet = (False,)

    def prepared() -> CpuView:
        view = CpuView(scene, view_camera, options)
        view._kernels(scene.sh)
        return view

    view = prepared()
    view.draw(record=True)
    forward = view._forward

    def adjoint() -> torch.Tensor:
        sums.zero_()
        view._view.adjoint(wide, 64, sums, weights)
        return sums

    def backward() -> torch.Tensor:
        view._view.backward_colour(3, *forward, v_image, None, None)
        return torch.zeros(())

    def rgb() -> torch.Tensor:
        view._view.forward_colour(3, image3, *planes, *quiet)
        return image3

    def features() -> torch.Tensor:
        view._view.forward_features(signal, 64, image, *planes, *quiet)
        return image

    def prepare() -> torch.Tensor:
        prepared().close()
        return torch.zeros(())

    stages: dict[str, Callable[[], torch.Tensor]] = {
        "prepare": prepare,
        "rgb+depth": rgb,
        "D=64": features,
        "adjoint D=64": adjoint,
        "backward 2D": backward,
    }
    print(f"{args.gaussians} Gaussians, {size[1]}x{size[0]}, {isa()}; wall milliseconds")
    print(f"{'threads':14}" + "".join(f"{count:8}" for count in counts))
    for name, call in stages.items():
        best = {count: float("inf") for count in counts}
        found: dict[int, torch.Tensor] = {}
        for _ in range(args.repeats):
            for count in counts:
                set_threads(count)
                if name == "backward 2D":
                    view.draw(record=True)
                    forward = view._forward
                begin = time.perf_counter()
                result = call()
                best[count] = min(best[count], (time.perf_counter() - begin) * 1e3)
                found[count] = result.clone()
        same = all(torch.equal(found[counts[0]], other) for other in found.values())
        times = "".join(f"{best[count]:8.1f}" for count in counts)
        gain = best[counts[0]] / best[counts[-1]]
        print(f"{name:14}{times}   {gain:.2f}x   {'same bits' if same else 'BITS DIFFER'}")


if __name__ == "__main__":
    main()
