"""Steps per second of a fit against the same model trained through plain PyTorch.

    python benchmarks/fit_torch.py ../shared/data/office --gaussians 40000 --steps 3

The other one is written here as one would write it in PyTorch: project all Gaussians (EWA), sort
them by depth, list those whose ellipse's box touches each tile of 16 x 16 pixels, blend each tile
with a cumulative product, chunk by chunk until nothing shines through, compare by L1 + D-SSIM, let
autograd do the rest, and step with `torch.optim.Adam`. Constants are splatseg's, and so is the
outcome: the difference of images and gradients at equal parameters is printed first.

Both start from the same Gaussians after some steps of ours, see the same photographs at full size
and use the same number of threads. Times are of the process's CPU divided by the threads, which
is what a quiet machine would show, and of the wall.
"""

import argparse
import platform
import time
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from splatseg.core import Camera
from splatseg.core.rigid import rotation_from_quaternion
from splatseg.core.sh import evaluate_sh
from splatseg.core.threads import one_torch_thread
from splatseg.fit import FitOptions
from splatseg.fit._options import COLOUR_RATE, OPACITY_RATE, RATES, ROTATION_RATE
from splatseg.fit._parameters import Parameters
from splatseg.fit._photographs import TrainingPhotographs
from splatseg.fit._run import FitRun
from splatseg.fit._step import l1_dssim
from splatseg.io.captures import read_capture
from splatseg.render import default_options, get_backend, render
from splatseg.render.cpu import isa, set_threads

TILE, CHUNK = 16, 256
NEAR, ALPHA_MAX, ALPHA_MIN, STOP, MARGIN = 0.01, 0.99, 1 / 255, 1e-4, 0.3
C1, C2 = 0.01**2, 0.03**2


class Clock:
    """Seconds by the name of the stage: of the CPU over threads, and of the wall."""

    def __init__(self, threads: int) -> None:
        self._threads = threads
        self.cpu: dict[str, float] = {}
        self.wall: dict[str, float] = {}
        self._since = (0.0, 0.0)
        self.start()

    def start(self) -> None:
        self._since = (time.process_time(), time.perf_counter())

    def lap(self, name: str) -> None:
        """What went by since the last lap belongs to `name`."""
        cpu, wall = self._since
        self.start()
        self.cpu[name] = self.cpu.get(name, 0.0) + (self._since[0] - cpu) / self._threads
        self.wall[name] = self.wall.get(name, 0.0) + self._since[1] - wall


class Slow:
    """The fit in plain PyTorch."""

    def __init__(self, start: Parameters, extent: float, options: FitOptions) -> None:
        self.leaves = {
            name: tensor.detach().clone().requires_grad_() for name, tensor in start.tensors()
        }
        mean, rest = self.leaves["sh"][:, :3], self.leaves["sh"][:, 3:]
        self.leaves["mean_colour"] = mean.detach().clone().requires_grad_()
        self.leaves["harmonics"] = rest.detach().clone().requires_grad_()
        del self.leaves["sh"]
        rates = {
            "means": RATES["fast"].position * extent,
            "log_scales": RATES["fast"].scale,
            "rotations": ROTATION_RATE,
            "logits": OPACITY_RATE,
            "mean_colour": COLOUR_RATE,
            "harmonics": COLOUR_RATE / 20,
        }
        groups = [{"params": [self.leaves[name]], "lr": rate} for name, rate in rates.items()]
        self.optimiser = torch.optim.Adam(groups, eps=1e-15)
        self._options = options

    def project(self, camera: Camera) -> tuple[Tensor, ...]:
        """Centres, inverse covariances, opacities, colours and boxes, front to back."""
        pose = camera.cam_from_world.float()
        means = self.leaves["means"] @ pose[:3, :3].T + pose[:3, 3]
        opacities = self.leaves["logits"].sigmoid()[:, 0]
        seen = ((means[:, 2] > NEAR) & (opacities >= ALPHA_MIN)).nonzero()[:, 0]
        seen = seen[means[seen, 2].detach().argsort(stable=True)]
        x, y, z = means[seen].unbind(1)
        zero = torch.zeros_like(z)
        slopes = [
            (value / z).clamp(-(c + MARGIN * size / 2) / f, (size - c + MARGIN * size / 2) / f)
            for value, f, c, size in (
                (x, camera.fx, camera.cx, camera.width),
                (y, camera.fy, camera.cy, camera.height),
            )
        ]  # fmt: skip
        jacobian = torch.stack(
            (
                torch.stack((camera.fx / z, zero, -camera.fx * slopes[0] / z), 1),
                torch.stack((zero, camera.fy / z, -camera.fy * slopes[1] / z), 1),
            ),
            1,
        )
        axes = pose[:3, :3] @ rotation_from_quaternion(self.leaves["rotations"][seen])
        half = jacobian @ (axes * self.leaves["log_scales"][seen].exp()[:, None, :])
        covariance = half @ half.transpose(1, 2) + self._options.low_pass_drawn * torch.eye(2)
        a, b, c = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
        determinant = a * c - b * b
        opacities = opacities[seen]
        if self._options.antialiased:
            sharp = torch.linalg.cross(half[:, 0], half[:, 1]).square().sum(1)
            opacities = opacities * (sharp / determinant).sqrt()
        conics = torch.stack((c, -b, a), 1) / determinant[:, None]
        centres = torch.stack((camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy), 1)
        sh = torch.cat((self.leaves["mean_colour"], self.leaves["harmonics"]), 1)[seen]
        way = self.leaves["means"][seen] - camera.centre.float()
        colours = evaluate_sh(sh.view(len(sh), -1, 3), way / way.norm(dim=1, keepdim=True))
        with torch.no_grad():
            reach = 2 * (opacities * 255).log().clamp_min(0)
            radius = (reach[:, None] * torch.stack((a, c), 1)).sqrt()
            boxes = torch.cat((centres - radius, centres + radius), 1)
        return centres, conics, opacities, colours, boxes

    def picture(self, projected: tuple[Tensor, ...], camera: Camera) -> Tensor:
        """All tiles, one after another."""
        centres, conics, opacities, colours, boxes = projected
        rows = []
        for top in range(0, camera.height, TILE):
            bottom = min(top + TILE, camera.height)
            in_row = ((boxes[:, 3] >= top) & (boxes[:, 1] <= bottom)).nonzero()[:, 0]
            tiles = []
            for left in range(0, camera.width, TILE):
                right = min(left + TILE, camera.width)
                touching = (boxes[in_row, 2] >= left) & (boxes[in_row, 0] <= right)
                ids = in_row[touching]
                v, u = torch.meshgrid(
                    torch.arange(top, bottom) + 0.5, torch.arange(left, right) + 0.5, indexing="ij"
                )
                pixels = torch.stack((u, v), -1).reshape(-1, 2)
                tile = blended(pixels, centres[ids], conics[ids], opacities[ids], colours[ids])
                tiles.append(tile.view(bottom - top, right - left, 3))
            rows.append(torch.cat(tiles, 1))
        return torch.cat(rows, 0)

    def penalties(self) -> Tensor:
        """Mean opacity and mean scale, weighted."""
        opacity, scale = (
            self.leaves["logits"].sigmoid().mean(),
            self.leaves["log_scales"].exp().mean(),
        )
        return self._options.opacity_penalty * opacity + self._options.scale_penalty * scale

    def step(self, camera: Camera, photograph: Tensor, clock: Clock) -> float:
        """One step on one view."""
        clock.start()
        projected = self.project(camera)
        clock.lap("project")
        picture = self.picture(projected, camera)
        clock.lap("render")
        loss = l1_dssim_plain(picture, photograph, self._options.dssim_weight)
        total = loss + self.penalties()
        clock.lap("loss")
        self.optimiser.zero_grad(set_to_none=True)
        total.backward()
        clock.lap("backward")
        self.optimiser.step()
        clock.lap("update")
        return float(loss.detach())


def blended(
    pixels: Tensor, centres: Tensor, conics: Tensor, opacities: Tensor, colours: Tensor
) -> Tensor:
    """Front to back, (pixels, 3)."""
    image = pixels.new_zeros(len(pixels), 3)
    passed = pixels.new_ones(len(pixels), 1)
    for begin in range(0, len(centres), CHUNK):
        part = slice(begin, begin + CHUNK)
        offset = pixels[:, None] - centres[part]
        conic = conics[part]
        power = (conic[:, 0] * offset[..., 0] ** 2 + conic[:, 2] * offset[..., 1] ** 2) / 2 + conic[
            :, 1
        ] * offset[..., 0] * offset[..., 1]
        alphas = (opacities[part] * torch.exp(-power)).clamp_max(ALPHA_MAX)
        alphas = torch.where(alphas >= ALPHA_MIN, alphas, 0.0)
        after = passed * torch.cumprod(1 - alphas, 1)
        before = torch.cat((passed, after[:, :-1]), 1)
        image = image + torch.where(after > STOP, alphas * before, 0.0) @ colours[part]
        passed = after[:, -1:]
        if not bool((passed > STOP).any()):
            break
    return image


def l1_dssim_plain(image: Tensor, photograph: Tensor, weight: float) -> Tensor:
    """The loss with two convolutions for each of five windows, as usual."""
    taps = torch.exp(-((torch.arange(11) - 5.0) ** 2) / (2 * 1.5**2))
    taps = (taps / taps.sum()).expand(3, 1, -1)

    def blur(x: Tensor) -> Tensor:
        x = torch.nn.functional.conv2d(x, taps[:, :, :, None], padding=(5, 0), groups=3)
        return torch.nn.functional.conv2d(x, taps[:, :, None], padding=(0, 5), groups=3)

    x, y = image.movedim(-1, 0)[None], photograph.movedim(-1, 0)[None]
    mean_x, mean_y = blur(x), blur(y)
    spread_x, spread_y = blur(x * x) - mean_x**2, blur(y * y) - mean_y**2
    both = blur(x * y) - mean_x * mean_y
    ssim = (2 * mean_x * mean_y + C1) * (2 * both + C2)
    ssim = ssim / ((mean_x**2 + mean_y**2 + C1) * (spread_x + spread_y + C2))
    return (1 - weight) * (x - y).abs().mean() + weight * (1 - ssim.mean())


def agreement(slow: Slow, run: FitRun, camera: Camera, photograph: Tensor) -> str:
    """How far images, loss and gradients in the centres are apart at equal parameters."""
    weight = FitOptions().dssim_weight
    gaussians = run._state[0].gaussians()
    gaussians = gaussians.replace(
        antialiased=FitOptions().antialiased, low_pass=FitOptions().low_pass_drawn
    )
    means = gaussians.means.clone().requires_grad_()
    drawn = render(gaussians.replace(means=means), camera, backend="cpu").image
    ours = l1_dssim(drawn, photograph, dssim_weight=weight)
    drawn.backward(ours.gradient)
    picture = slow.picture(slow.project(camera), camera)
    theirs = l1_dssim_plain(picture, photograph, weight)
    theirs.backward()
    one, other = means.grad, slow.leaves["means"].grad
    assert one is not None
    assert other is not None
    apart = (one - other).norm() / one.norm()
    off = (drawn.detach() - picture.detach()).abs()
    return (
        f"at equal parameters: images apart by {float(off.mean()):.1e} (largest "
        f"{float(off.max()):.1e}), loss {ours.value:.5f} and {float(theirs.detach()):.5f}, "
        f"gradients in the centres by {float(apart):.1e} of their size"
    )


def main() -> None:
    """Run both and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("--gaussians", type=int, default=40_000)
    parser.add_argument("--before", type=int, default=300, help="our steps before both are timed")
    parser.add_argument("--steps", type=int, default=3, help="steps of the slow one")
    parser.add_argument("--our-steps", type=int, default=40)
    parser.add_argument("--threads", type=int, default=2)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    set_threads(arguments.threads)

    capture = read_capture(arguments.data)
    options = FitOptions(
        minutes=None, steps=10 * (arguments.before + arguments.our_steps),
        max_gaussians=arguments.gaussians, background="black", noise=0.0,
    )  # fmt: skip
    # All at once: full size, all harmonics.
    RATES["fast"] = replace(
        RATES["fast"], quarter_until=0.0, half_until=0.0, sh_degree_interval=1e-9
    )
    photographs = TrainingPhotographs(capture.train_views, longest=options.longest)
    run = FitRun(capture, options, get_backend("cpu"), photographs)
    with one_torch_thread():
        for _ in range(arguments.before):
            run.step()
    parameters = run._state[0]
    slow = Slow(parameters, run._extent, options)
    example = photographs.example(0)
    print(
        f"{platform.processor() or platform.machine()}, {isa()}, {arguments.threads} threads, "
        f"torch {torch.__version__}; {capture.path.name}, {len(parameters)} Gaussians, "
        f"{example.camera.width}x{example.camera.height}, "
        f"degree {default_options('cpu').sh_degree or options.sh_degree}"
    )
    print(agreement(slow, run, example.camera, example.photograph))

    before = dict(run.stages)
    cpu, wall = time.process_time(), time.perf_counter()
    with one_torch_thread():
        for _ in range(arguments.our_steps):
            run.step()
    our_cpu = (time.process_time() - cpu) / arguments.threads / arguments.our_steps
    our_wall = (time.perf_counter() - wall) / arguments.our_steps
    parts = {
        name: (spent - before.get(name, 0.0)) / arguments.our_steps
        for name, spent in run.stages.items()
    }
    told = ", ".join(f"{name} {1e3 * spent:.1f}" for name, spent in parts.items() if spent > 5e-5)
    print(f"ours, ms a step: {1e3 * our_cpu:.1f} CPU, {1e3 * our_wall:.1f} wall ({told} wall)")

    clock = Clock(arguments.threads)
    for i in range(arguments.steps):
        example = photographs.example(i * 7 % len(photographs))
        slow.step(example.camera, example.photograph, clock)
    their_cpu, their_wall = (sum(t.values()) / arguments.steps for t in (clock.cpu, clock.wall))
    told = ", ".join(f"{k} {1e3 * v / arguments.steps:.0f}" for k, v in clock.cpu.items())
    print(
        f"plain PyTorch, ms a step: {1e3 * their_cpu:.0f} CPU, {1e3 * their_wall:.0f} wall "
        f"({told} CPU)"
    )
    print(f"ratio: {their_cpu / our_cpu:.0f} by CPU, {their_wall / our_wall:.0f} by wall")


if __name__ == "__main__":
    main()
