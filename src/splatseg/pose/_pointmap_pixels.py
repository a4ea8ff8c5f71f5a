"""What is read of pointmaps of pairs: few pixels to align from, and all for the cloud."""

import hashlib
import json
import math
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, Protocol

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int64
from msgspec import Meta
from numpy.typing import NDArray
from torch import Tensor

from splatseg.core.json_values import plain_json
from splatseg.core.models import Image, Pointmap, PointmapModel
from splatseg.core.options import Count, Natural, options
from splatseg.errors import InputError, quoted
from splatseg.io.pointmaps import RecordedPointmaps, create_pointmaps
from splatseg.pose._pairs import connected_groups, likeness, selected_pairs
from splatseg.pose._photographs import Photograph, read_reduced

PairGraph = Literal["auto", "complete", "window", "reference", "retrieval"]
"""Which photographs are paired."""

"""How pairs become one world."""

# Photographs up to which "auto" asks a network about every pair; else each with so many that look
# most like it.
_COMPLETE_UP_TO, _NEIGHBOURS = 16, 6


@options(
    removed={
        "complete_up_to": "`pairs` chooses for any number of photographs",
        "neighbours": "each photograph is paired with the 6 that look most like it",
        "symmetric": "a network is asked about each pair in both orders, as DUSt3R does",
        "samples": "cameras are found from 768 pixels of each photograph",
        "alignment": "DUSt3R's knows no outliers, and was measured to be worse",
        "iterations": "alignments end by themselves, after 60 steps at most",
        "block": "50 photographs are aligned together",
        "keep": "the cloud is taken from the surest four fifths of the pixels",
    }
)
class PointmapOptions:
    """How cameras are found from pointmaps."""

    pairs: PairGraph = "auto"
    """complete: every photograph with every other. window: with those that follow it by name.
    reference: with the first one by name alone. retrieval: with those that look most like it, and
    with the next by name. auto: all that a folder of pointmaps holds; of a network complete up to
    16 photographs, retrieval beyond."""

    window: Count = 4
    """With window: each photograph is paired with so many that follow it."""

    longest: Annotated[int, Meta(ge=64)] = 512
    """Longest side of the images that a network gets, pixels."""

    refine: bool = True
    """End with all cameras, focal lengths, depths and scales at once, with the points of
    each pair in its first camera's frame, and with errors along rays and across them divided by how
    large they are."""

    shared_focal: bool = True
    """Photographs of one size share a focal length; else each has its own."""

    max_points: Count = 500_000
    """Most points of the cloud; it is thinned evenly."""

    seed: Natural = 0
    """Seed of everything that is drawn."""


_LONGEST = 640
_FEATURES = 1000


def wanted_pairs(
    photographs: Sequence[Photograph],
    options: PointmapOptions,
    *,
    there: Sequence[tuple[int, int]] | None,
) -> list[tuple[int, int]]:
    """Pairs of photographs to align, sorted; the first is the one in whose frame points are.

    Args:
        photographs: Sorted by name.
        options: How pairs are chosen.
        there: Pairs that a folder of pointmaps holds; None where any can be asked for.

    Raises:
        InputError: If a photograph is in no pair, or the pairs do not hang together.
    """
    kind: PairGraph = options.pairs
    if kind == "auto" and there is None:
        kind = "complete" if len(photographs) <= _COMPLETE_UP_TO else "retrieval"
    if kind == "auto":
        pairs = sorted(there or ())
    else:
        pairs = _graph(photographs, kind, options)
        pairs = sorted({*pairs, *((j, i) for i, j in pairs)})
        if there is not None:
            held = set(there)
            pairs = [pair for pair in pairs if pair in held]
    check_connected([one.path.name for one in photographs], pairs)
    return pairs


def check_connected(names: Sequence[str], pairs: Sequence[tuple[int, int]]) -> None:
    """Refuse pairs that leave a photograph out, or fall into parts.

    Raises:
        InputError: If they do; the message names one.
    """
    paired = {i for pair in pairs for i in pair}
    alone = [name for i, name in enumerate(names) if i not in paired]
    if alone:
        more = f" and {len(alone) - 1} more" if len(alone) > 1 else ""
        raise InputError(
            f"pointmaps: expected each of {len(names)} photographs in a pair, got none with "
            f"{quoted(alone[0])}{more}."
        )
    groups = connected_groups(len(names), pairs)
    apart = [i for i in range(len(names)) if groups[i] != groups[0]]
    if apart:
        raise InputError(
            f"pointmaps: expected pairs that connect all {len(names)} photographs, got "
            f"{len(set(groups))} parts without a pair between them, such as {quoted(names[0])} "
            f"and {quoted(names[apart[0]])}."
        )


def _graph(
    photographs: Sequence[Photograph], kind: PairGraph, options: PointmapOptions
) -> list[tuple[int, int]]:
    count = len(photographs)
    if kind == "complete":
        return [(i, j) for i in range(count) for j in range(i + 1, count)]
    if kind == "window":
        return [
            (i, j) for i in range(count) for j in range(i + 1, min(i + 1 + options.window, count))
        ]
    if kind == "reference":
        return [(0, j) for j in range(1, count)]
    alike = likeness([_descriptors(one) for one in photographs], seed=options.seed)
    return selected_pairs(alike, overlap=1, neighbours=_NEIGHBOURS)


def _descriptors(photograph: Photograph) -> NDArray[np.uint8]:
    """SIFT descriptors of a photograph at a modest size, (n, 128)."""
    pixels = read_reduced(photograph, longest=_LONGEST).numpy()
    sift: Any = cv2.SIFT_create(nfeatures=_FEATURES)  # pyright: ignore[reportAttributeAccessIssue]
    found = sift.detectAndCompute(cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY), None)[1]
    return np.zeros((0, 128), np.uint8) if found is None else found.astype(np.uint8)


# Who answers for pairs of photographs: a folder, or a network whose answers go to one.


_IMAGES_KEPT = 64
"""Images that stay in memory: at 512 pixels they take half a megabyte each."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NetworkPairs:
    """A network, asked once for each pair; what it says goes to a folder and is read from there."""

    model: PointmapModel
    photographs: Sequence[Photograph]
    longest: int
    kept: RecordedPointmaps
    _images: OrderedDict[str, Image] = field(default_factory=OrderedDict[str, Image], repr=False)

    def pointmaps(self, first: str, second: str) -> tuple[Pointmap, Pointmap]:
        """Points of both photographs in the frame of the first one's camera.

        Raises:
            InputError: If the model answers something else.
        """
        if not self.kept.holds(first, second):
            answer: Any = self.model.pointmaps(self._image(first), self._image(second))
            if not (
                isinstance(answer, tuple)
                and len(answer) == 2  # pyright: ignore[reportUnknownArgumentType]
                and all(isinstance(one, Pointmap) for one in answer)  # pyright: ignore[reportUnknownVariableType]
            ):
                raise InputError(
                    f"model {self.model.name}: expected two Pointmaps for two images, got "
                    f"{type(answer).__name__}."  # pyright: ignore[reportUnknownArgumentType]
                )
            self.kept.save(first, second, (answer[0], answer[1]))
        # As it was written, so that a run that goes on gives what one in one piece gives.
        return self.kept.pointmaps(first, second)

    def _image(self, name: str) -> Image:
        if name not in self._images:
            photograph = next(one for one in self.photographs if one.path.name == name)
            self._images[name] = read_reduced(photograph, longest=self.longest)
        self._images.move_to_end(name)
        while len(self._images) > _IMAGES_KEPT:
            self._images.popitem(last=False)
        return self._images[name]


def network_pairs(
    model: PointmapModel, photographs: Sequence[Photograph], folder: Path, *, longest: int
) -> NetworkPairs:
    """A network whose answers are kept in a folder; those that are there are not asked again.

    Raises:
        InputError: If the folder holds answers of another model, or about other photographs.
    """
    kept = create_pointmaps(
        folder,
        photographs=[one.path.name for one in photographs],
        metadata={
            "model": model.name,
            "settings": plain_json("settings", dict(model.settings)),
            "longest": longest,
        },
    )
    return NetworkPairs(model=model, photographs=photographs, longest=longest, kept=kept)


def source_digest(source: PointmapModel | RecordedPointmaps) -> str:
    """What the answers of a source depend on: the model and its settings, or the files there."""
    if isinstance(source, RecordedPointmaps):
        files = [(p.name, p.stat().st_size) for p in sorted(source.folder.iterdir())]
        what: Any = [str(source.folder.absolute()), files]
    else:
        what = [source.name, plain_json("settings", dict(source.settings))]
    return hashlib.sha256(json.dumps(what, sort_keys=True).encode()).hexdigest()


# Each pair of pointmaps, read once and reduced to the same few pixels of each photograph.


MIN_WEIGHT = 1e-3
"""Weight of a pixel of confidence 1, which says nothing: where all are such, all count alike."""


class PairSource(Protocol):
    """Who answers for pairs of photographs, by their file names."""

    def pointmaps(self, first: str, second: str) -> tuple[Pointmap, Pointmap]:
        """Points of both photographs in the frame of the first one's camera."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class PhotographSize:
    """A photograph as this package knows it."""

    name: str
    """File name."""

    width: int
    """Upright, pixels."""

    height: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PairSamples:
    """Pixels of pairs. E pairs, N photographs, S pixels of each."""

    first: Int64[Tensor, "pairs"]
    """Index of the photograph in whose camera's frame the points are."""

    second: Int64[Tensor, "pairs"]
    points: Float[Tensor, "pairs 2 samples 3"]
    """Of the first photograph and of the second; float32, in the unit of the pair."""

    weights: Float[Tensor, "pairs 2 samples"]
    """log of the confidence, as DUSt3R takes it, at least `MIN_WEIGHT`; float32."""

    offsets: Float[Tensor, "views samples 2"]
    """Right and down from the middle of the photograph, its pixels; float64."""

    lenses: Int64[Tensor, "views"]
    """A number for each photograph; those with the same one share a focal length."""

    sizes: tuple[tuple[int, int], ...]
    """Rows and columns of each photograph's pointmaps."""

    def __len__(self) -> int:
        return len(self.first)

    @property
    def views(self) -> Int64[Tensor, "pairs 2"]:
        """Photographs of each pair."""
        return torch.stack((self.first, self.second), dim=1)


def read_samples(
    photographs: Sequence[PhotographSize],
    pairs: Sequence[tuple[int, int]],
    source: PairSource,
    *,
    count: int,
    shared_focal: bool,
    seed: int,
    progress: Callable[[int, int], None],
) -> PairSamples:
    """Ask about each pair once and keep `count` pixels of each map, about evenly spread.

    Memory is 32 bytes a pixel that is kept, times pairs.

    Raises:
        InputError: If maps of one photograph differ in size, or one is a single point.
    """
    rng = np.random.default_rng([seed, 31])
    sizes: dict[int, tuple[int, int]] = {}
    chosen: dict[int, tuple[Tensor, Tensor]] = {}
    points = torch.empty(len(pairs), 2, count, 3)
    weights = torch.empty(len(pairs), 2, count)
    for e, pair in enumerate(pairs):
        names = [photographs[i].name for i in pair]
        for slot, (i, one) in enumerate(zip(pair, source.pointmaps(*names), strict=True)):
            size = (int(one.points.shape[0]), int(one.points.shape[1]))
            if i not in sizes:
                sizes[i] = size
                chosen[i] = _spread(size, count, rng)
            if size != sizes[i]:
                raise InputError(
                    f"pointmaps: expected all of {quoted(names[slot])} of {sizes[i][1]}x"
                    f"{sizes[i][0]} points, got {size[1]}x{size[0]} in the pair "
                    f"{quoted(names[0])}, {quoted(names[1])}."
                )
            rows, columns = chosen[i]
            points[e, slot] = one.points[rows, columns].cpu().float()
            if bool((points[e, slot] == points[e, slot, 0]).all()):
                raise InputError(
                    f"pointmaps: expected points of {quoted(names[slot])} that differ, got one "
                    f"point for all its pixels in the pair {quoted(names[0])}, {quoted(names[1])}."
                )
            sure = one.confidence[rows, columns].cpu().float()
            weights[e, slot] = sure.log().clamp_min(MIN_WEIGHT)
        progress(e + 1, len(pairs))
    return PairSamples(
        first=torch.tensor([i for i, _ in pairs]),
        second=torch.tensor([j for _, j in pairs]),
        points=points,
        weights=weights,
        offsets=torch.stack(
            [pixel_offsets(one, sizes[i], *chosen[i]) for i, one in enumerate(photographs)]
        ),
        lenses=_lenses(photographs, shared=shared_focal),
        sizes=tuple(sizes[i] for i in range(len(photographs))),
    )


def pixel_offsets(
    photograph: PhotographSize, size: tuple[int, int], rows: Tensor, columns: Tensor
) -> Float[Tensor, "*n 2"]:
    """Where points of a map lie, right and down from the middle of the photograph, its pixels.

    Rows and columns divide the photograph evenly; eq. 4 takes these for i' and j'.
    """
    u = (columns.double() + 0.5) / size[1] - 0.5
    v = (rows.double() + 0.5) / size[0] - 0.5
    return torch.stack((u * photograph.width, v * photograph.height), dim=-1)


def _lenses(photographs: Sequence[PhotographSize], *, shared: bool) -> Tensor:
    if not shared:
        return torch.arange(len(photographs))
    kinds = [(one.width, one.height) for one in photographs]
    return torch.tensor([kinds.index(kind) for kind in kinds])


def _spread(size: tuple[int, int], count: int, rng: np.random.Generator) -> tuple[Tensor, Tensor]:
    """Rows and columns of `count` pixels: one drawn in each cell of a grid, the rest anywhere."""
    rows, columns = size
    down = max(1, min(count, round(math.sqrt(count * rows / columns))))
    across = max(1, count // down)
    grid = rng.uniform(size=(down, across, 2))
    grid += np.stack(np.meshgrid(np.arange(down), np.arange(across), indexing="ij"), axis=-1)
    grid /= (down, across)
    anywhere = rng.uniform(size=(count - down * across, 2))
    places = np.concatenate((grid.reshape(-1, 2), anywhere)) * size
    found = torch.from_numpy(np.minimum(places.astype(np.int64), np.array(size) - 1))
    return found[:, 0], found[:, 1]
