"""Training of the network of regions (`splatseg.models._region_network`) on generated pictures."""

import zlib
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import DataLoader, Dataset
from typing_extensions import override

from splatseg.models._region_network import BOX_SCALE, OUTPUTS, RegionNetwork
from splatseg_bench.region_pictures import Picture, read_picture

Array = NDArray[np.float32]
Ids = NDArray[np.int32]

_CONTOURS, _HED, _THING = slice(0, 2), 2, 3
_SIDE = 256
"""Pixels of a crop."""

_COARSE = 4
"""Pixels of the head's map to one of the coarse head's."""


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """What decides the weights, besides the pictures."""

    seed: int = 0
    steps: int = 6_500
    crops: int = 24
    """Of a step."""
    scales: tuple[float, float] = (0.5, 1.3)
    """Sizes that pictures are cut at, drawn evenly by their logarithm."""
    rate: float = 3e-3
    """Of AdamW; rises over 200 steps, then falls to 0 nearly linearly."""
    weight_decay: float = 1e-2
    coarse: float = 0.3
    """Weight of the coarse head's loss."""
    boxes: float = 0.5
    """Weight of the loss of boxes."""
    textured: float = 0.5
    """Share of crops whose parts get a random texture each."""
    printed: float = 0.06
    """Share of parts that show a piece of another picture, as posters, screens and plaids do."""


def train(
    pictures: list[Path],
    recipe: Recipe,
    checkpoint: Path,
    report: Callable[[str], None],
    *,
    device: str = "cpu",
    workers: int = 0,
) -> None:
    """Train, going on from the checkpoint if there is one: the same as if it had not stopped.

    Args:
        pictures: What `draw_pictures` wrote.
        recipe: What decides the weights.
        checkpoint: File that is written every 500 steps.
        report: Told the losses.
        device: Where the network is trained.
        workers: Processes that cut crops beside it; 0 cuts them here. Both give the same crops.
    """
    network: Any = RegionNetwork(normalised=True).to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
    torch.manual_seed(recipe.seed)
    for module in network.modules():
        if isinstance(module, torch.nn.Conv2d):
            module.reset_parameters()
    network = network.to(device)
    optimiser = torch.optim.AdamW(network.parameters(), weight_decay=recipe.weight_decay)
    step, mean = 0, None
    if checkpoint.exists():
        state = torch.load(checkpoint, weights_only=True, map_location=device)
        if state["recipe"] != _plain(recipe):
            raise ValueError(f"{checkpoint} is of another recipe: {state['recipe']}.")
        network.load_state_dict(state["network"])
        optimiser.load_state_dict(state["optimiser"])
        step = state["step"]
    batches: DataLoader[Batch] = DataLoader(
        Batches(pictures, recipe, step, preloaded=workers > 0),
        batch_size=None,
        num_workers=workers,
        pin_memory=device != "cpu",
        prefetch_factor=4 if workers else None,
    )
    for batch in batches:
        losses = _losses(network, [part.to(device, non_blocking=True) for part in batch], recipe)
        rate = recipe.rate * min(1, (step + 1) / 200) * (1 - step / recipe.steps) ** 0.9
        for group in optimiser.param_groups:
            group["lr"] = rate
        optimiser.zero_grad()
        losses.sum().backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 5.0)
        optimiser.step()
        step += 1
        now = losses.detach()
        mean = now if mean is None else 0.99 * mean + 0.01 * now
        if step % 100 == 0:
            report(f"step {step}: losses {' '.join(f'{v:.4f}' for v in mean.tolist())}")
        if step % 500 == 0 or step == recipe.steps:
            state = {"network": network.state_dict(), "optimiser": optimiser.state_dict()}
            part = checkpoint.with_suffix(".part")
            torch.save(state | {"step": step, "recipe": _plain(recipe)}, part)
            part.rename(checkpoint)


Batch = tuple[Tensor, Tensor, Tensor, Tensor]


class Batches(Dataset[Batch]):
    """What each step from one on is trained with; of the recipe and the step's number alone."""

    def __init__(self, pictures: list[Path], recipe: Recipe, start: int, *, preloaded: bool):
        self._pictures, self._recipe, self._start = pictures, recipe, start
        self._held = dict[Path, tuple[Picture, Array | None]]()
        if preloaded:  # before processes part, which then share them
            with ThreadPoolExecutor() as pool:
                self._held = dict(zip(pictures, pool.map(_read, pictures), strict=True))

    def __len__(self) -> int:
        """Steps that are left."""
        return self._recipe.steps - self._start

    @override
    def __getitem__(self, index: int) -> Batch:
        """Inputs, targets, weights of boxes (as `_crop`'s, one row a crop), whether with HED."""
        if index >= len(self):
            raise IndexError(index)
        rng = np.random.default_rng([self._recipe.seed, self._start + index])
        rows = [
            _crop(self._drawn(rng), rng, self._recipe, noises(self._recipe.seed), self._drawn)
            for _ in range(self._recipe.crops)
        ]
        inputs, targets, weights, with_hed = zip(*rows, strict=True)
        stacked = [torch.from_numpy(np.stack(part)) for part in (inputs, targets, weights)]
        return stacked[0], stacked[1], stacked[2], torch.tensor(with_hed).float()

    def _drawn(self, rng: np.random.Generator) -> tuple[Picture, Array | None]:
        path = self._pictures[rng.integers(len(self._pictures))]
        if path not in self._held:
            self._held[path] = _read(path)
        return self._held[path]


def _plain(recipe: Recipe) -> dict[str, Any]:
    return asdict(recipe) | {"scales": list(recipe.scales)}


def _read(path: Path) -> tuple[Picture, Array | None]:
    """A picture, and HED's contours of it where they were made."""
    hed = path.with_suffix(".hed.npy")
    contours = np.load(hed)[..., 0].astype(np.float32) / 255 if hed.exists() else None
    return read_picture(path), contours


def _losses(network: RegionNetwork, batch: Sequence[Tensor], recipe: Recipe) -> Tensor:
    """Of contours of things, parts and HED, of things, and of the boxes of things and parts."""
    pixels, targets, weights, with_hed = batch
    with torch.autocast(pixels.device.type, torch.bfloat16):
        found, coarse = network(pixels.contiguous(memory_format=torch.channels_last))
    if coarse is None:
        raise RuntimeError("the network has no coarse head: it is not to be trained.")
    fewer = torch.cat(
        (F.max_pool2d(targets[:, :3], _COARSE), F.avg_pool2d(targets[:, 3:], _COARSE)), dim=1
    )
    fine_loss = _loss(found.float(), targets, weights, with_hed, recipe)
    coarse_loss = _loss(coarse.float(), fewer, F.avg_pool2d(weights, _COARSE), with_hed, recipe)
    return fine_loss + recipe.coarse * coarse_loss


def _loss(
    found: Tensor, targets: Tensor, weights: Tensor, with_hed: Tensor, recipe: Recipe
) -> Tensor:
    pixel = torch.ones_like(targets[:, :4])
    pixel[:, _CONTOURS] = 1 + 3 * targets[:, _CONTOURS]
    pixel[:, _HED] *= with_hed[:, None, None]
    pixel[:, _THING] *= 0.5 * weights[:, 0].clamp(max=4)
    entropy = F.binary_cross_entropy_with_logits(found[:, :4], targets[:, :4], reduction="none")
    by_kind = (entropy * pixel).mean((0, 2, 3))
    sides = F.smooth_l1_loss(found[:, 4:], targets[:, 4:], beta=0.3, reduction="none")
    boxes = [(sides[:, 4 * k : 4 * k + 4] * weights[:, k : k + 1]).mean() for k in range(2)]
    return torch.cat((by_kind, recipe.boxes * torch.stack(boxes)))


def _crop(
    picture: tuple[Picture, Array | None],
    rng: np.random.Generator,
    recipe: Recipe,
    textures: Array,
    drawn: Callable[[np.random.Generator], tuple[Picture, Array | None]],
) -> tuple[Array, Array, Array, bool]:
    """A crop and what the network is to say of it; `drawn` gives the picture that is printed.

    Returns:
        Input (3, s, s), targets (12, s / 2, s / 2), weights of things' and of parts' pixels, and
        whether HED's contours are among the targets.
    """
    one, hed = picture
    height, width = one.part.shape
    side = _SIDE
    scale = float(np.exp(rng.uniform(*np.log(recipe.scales))))
    rows = min(int(side / scale), height)
    columns = min(int(rows * rng.uniform(1, 1.25)), width)
    y, x = rng.integers(height - rows + 1), rng.integers(width - columns + 1)
    place = np.s_[y : y + rows, x : x + columns]

    def cut(plane: NDArray[Any], how: int) -> NDArray[Any]:
        return np.asarray(cv2.resize(plane[place], (side, side), interpolation=how))

    smooth = cv2.INTER_AREA if rows > side else cv2.INTER_LINEAR
    planes: list[NDArray[Any]] = [
        cut(one.image, smooth),
        cut(one.instance, cv2.INTER_NEAREST),
        cut(one.part, cv2.INTER_NEAREST),
        cut(one.thing.astype(np.uint8), cv2.INTER_NEAREST),
        np.zeros((side, side), np.float32) if hed is None else cut(hed, cv2.INTER_LINEAR),
    ]
    if rng.random() < 0.5:
        planes = [plane[:, ::-1] for plane in planes]
    if rng.random() < 0.1:
        planes = [np.rot90(plane) for plane in planes]
    image, instance, part, thing, contours = (np.ascontiguousarray(plane) for plane in planes)
    boxes, weights = zip(*(_boxes(ids) for ids in (instance, part)), strict=True)
    targets = np.concatenate(
        (
            [_halved(_rims(ids)) for ids in (instance, part)],
            [contours.reshape(side // 2, 2, side // 2, 2).mean((1, 3))],
            [thing[::2, ::2].astype(np.float32)],
            *boxes,
        )
    )
    if recipe.printed:
        image = with_prints(image, part, drawn(rng)[0].image, rng, recipe.printed)
    pixels = photographed(image, part, rng, textures, recipe.textured)
    pixels = np.ascontiguousarray(((pixels - 0.45) / 0.25).transpose(2, 0, 1), np.float32)
    if len(targets) != OUTPUTS:
        raise RuntimeError(f"expected {OUTPUTS} targets, got {len(targets)}.")
    return pixels, targets.astype(np.float32), np.stack(weights), hed is not None


def dense(ids: Ids) -> tuple[Ids, int]:
    """Ids from 0 in the order of the ones given, and their number; np.unique would sort them."""
    there = np.bincount(ids.reshape(-1)) > 0
    return (np.cumsum(there, dtype=np.int32) - 1)[ids], int(there.sum())


def _rims(ids: Ids) -> Array:
    """1 in pixels beside one of another id."""
    found = np.zeros(ids.shape, np.float32)
    across, down = ids[:, 1:] != ids[:, :-1], ids[1:] != ids[:-1]
    for part, differ in (
        (np.s_[:, 1:], across), (np.s_[:, :-1], across), (np.s_[1:], down), (np.s_[:-1], down)
    ):  # fmt: skip
        found[part][differ] = 1
    return found


def _halved(plane: Array) -> Array:
    """Maxima of blocks of 2 x 2."""
    height, width = plane.shape
    return plane.reshape(height // 2, 2, width // 2, 2).max((1, 3))


def _boxes(ids: Ids) -> tuple[Array, Array]:
    """Boxes of regions at half the size.

    Returns:
        log(1 + d / 8) to the sides of the box of each pixel's region, and weights of mean 1 by
        which small regions count as large ones: one over the root of the area.
    """
    from scipy import ndimage

    labels, count = dense(ids)
    corners = np.array(
        [
            (columns.start, rows.start, columns.stop, rows.stop)
            for rows, columns in ndimage.find_objects(labels + 1, count)
        ],
        np.float32,
    )
    areas = np.bincount(labels.reshape(-1)).astype(np.float32)
    few = labels[::2, ::2]
    y, x = np.mgrid[: ids.shape[0] : 2, : ids.shape[1] : 2].astype(np.float32) + 0.5
    left, top, right, bottom = np.moveaxis(corners[few], -1, 0)
    distances = np.stack((x - left, y - top, right - x, bottom - y))
    weights = 1 / np.sqrt(areas[few] + 50)
    return np.log1p(distances.clip(0) / BOX_SCALE), weights / weights.mean()


@cache
def noises(seed: int, count: int = 24, side: int = 320) -> Array:
    """(count, side, side) noises of mean 0 and deviation 1 whose spectra fall by 1/f to 1/f^2."""
    rng = np.random.default_rng(seed)
    along = np.fft.fftfreq(side)
    frequency = np.hypot(along[:, None], along[None]) + 1 / side
    found: list[Array] = []
    for _ in range(count):
        bent = frequency * (1 + rng.uniform(0, 2) * np.abs(np.cos(
            np.arctan2(along[:, None], along[None]) + rng.uniform(0, np.pi)
        )))  # fmt: skip
        spectrum = np.fft.fft2(rng.normal(size=(side, side))) / bent ** rng.uniform(0.6, 2.0)
        noise = np.fft.ifft2(spectrum).real
        found.append(((noise - noise.mean()) / noise.std()).astype(np.float32))
    return np.stack(found)


def as_photograph(path: Path, other: Path) -> NDArray[np.uint8]:
    """A picture in other materials, with pieces of another one; the same each time."""
    rng = np.random.default_rng(zlib.crc32(path.name.encode()))
    picture = read_picture(path)
    image = with_prints(picture.image, picture.part, read_picture(other).image, rng, 0.12)
    pixels = photographed(image, picture.part, rng, noises(1), 0.6)
    return (255 * pixels).round().astype(np.uint8)


def with_prints(
    image: NDArray[np.uint8],
    part: Ids,
    other: NDArray[np.uint8],
    rng: np.random.Generator,
    share: float,
) -> NDArray[np.uint8]:
    """The picture with pieces of another one printed on some parts, shaded as these are."""
    labels, count = dense(part)
    printed = np.flatnonzero(rng.random(count) < share)
    if not len(printed):
        return image
    height, width = part.shape
    found = image.astype(np.float32)
    light = found.mean(2)
    y, x = np.mgrid[:height, :width].astype(np.float32)
    for k in printed.tolist():
        inside = labels == k
        scale, turn = float(np.exp(rng.uniform(-1.2, 0.7))), rng.uniform(0, 2 * np.pi)
        c, s = np.float32(scale * np.cos(turn)), np.float32(scale * np.sin(turn))
        shift = rng.uniform(0, 400, 2).astype(np.float32)
        shown = cv2.remap(
            other, c * x - s * y + shift[0], s * x + c * y + shift[1], cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REFLECT,
        )  # fmt: skip
        shade = light[inside] / max(float(light[inside].mean()), 1.0)
        found[inside] = np.asarray(shown, np.float32)[inside] * shade.clip(0.3, 2)[:, None]
    return found.clip(0, 255).astype(np.uint8)


def photographed(
    image: NDArray[np.uint8], part: Ids, rng: np.random.Generator, textures: Array, textured: float
) -> Array:
    """The picture in [0, 1] as other materials, light, lenses and cameras would have it."""
    x = image.astype(np.float32) / 255
    height, width = part.shape
    if rng.random() < textured:
        labels, count = dense(part)
        which = rng.integers(len(textures), size=count)
        strength = np.where(rng.random(count) < 0.6, rng.gamma(1.5, 0.06, count), 0)
        tint = 1 + 0.5 * rng.normal(size=(count, 3)) * rng.random((count, 1))
        # Noises go on where they end.
        dy, dx = rng.integers(textures.shape[1] - _SIDE + 1, size=2)
        rows, columns = np.mgrid[dy : dy + height, dx : dx + width] % textures.shape[1]
        noise = textures[which[labels], rows, columns]
        x = x * np.exp(np.clip(noise * strength[labels], -1.2, 1.2)[..., None] * tint[labels])
        x = x.astype(np.float32)
    if rng.random() < 0.7:
        x = x @ (np.eye(3) + rng.normal(0, 0.12, (3, 3))).T.astype(np.float32)
    if rng.random() < 0.3:
        x = x[..., rng.permutation(3)]
    if rng.random() < 0.12:
        x = x.mean(2, keepdims=True).repeat(3, 2)
    x = np.clip(x, 0, 1) ** float(np.exp(rng.normal(0, 0.35)))
    x = np.clip((x - 0.5) * rng.uniform(0.6, 1.3) + 0.5 + rng.normal(0, 0.08), 0, 1)
    if rng.random() < 0.35:
        x = np.asarray(cv2.GaussianBlur(x, (0, 0), float(rng.uniform(0.4, 1.6))))
    if rng.random() < 0.3:
        light = rng.normal(0, 0.25, (3, 3)).astype(np.float32)
        light = cv2.resize(light, (width, height), interpolation=cv2.INTER_CUBIC)
        x = x * np.exp(np.asarray(light))[..., None]
    if rng.random() < 0.6:
        x = x + rng.normal(0, rng.uniform(0.003, 0.05), x.shape)
    x = np.clip(x, 0, 1).astype(np.float32)
    if rng.random() < 0.5:
        quality = [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(40, 95))]
        packed = cv2.imencode(".jpg", (255 * x).astype(np.uint8), quality)[1]
        x = np.asarray(cv2.imdecode(packed, cv2.IMREAD_COLOR), np.float32) / 255
    return x.astype(np.float32)


def folded(network: RegionNetwork) -> dict[str, Tensor]:
    """Tensors of `RegionNetwork()` that do what a trained one does: norms are in the kernels."""
    state = network.state_dict()
    found: dict[str, Tensor] = {}
    for name, value in state.items():
        stem, _, kind = name.rpartition(".")
        if name.startswith("coarse_head") or kind == "num_batches_tracked":
            continue
        norm = f"{stem.removesuffix('.0')}.1"
        if stem.endswith(".0") and f"{norm}.running_var" in state:
            gain = state[f"{norm}.weight"] / torch.sqrt(state[f"{norm}.running_var"] + 1e-5)
            found[f"{stem}.weight"] = value * gain.reshape(-1, 1, 1, 1)
            found[f"{stem}.bias"] = state[f"{norm}.bias"] - state[f"{norm}.running_mean"] * gain
        elif f"{stem}.running_var" not in state:
            found[name] = value
    return found
