"""What a second thread brings: wall time with one and with two, alternated, least of the repeats.

    python benchmarks/threads.py --repeats 15

On a shared machine the second core is seldom free: run it in a quiet moment. The results of one
and two threads are compared as well; they must be the same to the bit.
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
    args = parser.parse_args()
    scene, view_camera = room(args.gaussians, 0), camera()
    cloud = (scene.means, scene.rotations, scene.scales, scene.opacities)
    options = RenderOptions()
    size = (view_camera.height, view_camera.width)
    signal, wide = torch.randn(len(scene), 64), torch.randn(*size, 64)
    image, planes = torch.empty(*size, 64), tuple(torch.empty(size) for _ in range(3))
    image3, v_image = torch.empty(*size, 3), torch.randn(*size, 3)
    sums, weights = torch.zeros(len(scene), 64), torch.zeros(len(scene))
    quiet = (False,)

    def prepared() -> CpuView:
        return CpuView(*cloud, camera=view_camera, options=options, sh=scene.sh)

    view = prepared()
    view.render(record=True)
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
    for name, call in stages.items():
        best, found = [float("inf")] * 2, [torch.zeros(())] * 2
        for _ in range(args.repeats):
            for count in (1, 2):
                set_threads(count)
                if name == "backward 2D":
                    view.render(record=True)
                    forward = view._forward
                begin = time.perf_counter()
                result = call()
                best[count - 1] = min(best[count - 1], (time.perf_counter() - begin) * 1e3)
                found[count - 1] = result.clone()
        same = torch.equal(*found)
        print(
            f"{name:14}{best[0]:8.1f}{best[1]:8.1f}   {best[0] / best[1]:.2f}x"
            f"   {'same bits' if same else 'BITS DIFFER'}"
        )


if __name__ == "__main__":
    main()
