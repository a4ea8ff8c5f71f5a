"""Which pixels of a view are drawn, and how many each of them stands for."""

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int64
from numpy.typing import NDArray
from torch import Tensor

from splatseg._check import check_range
from splatseg.core import Camera, Gaussians, View, camera_of_map
from splatseg.core.boundary import boundary
from splatseg.errors import InputError
from splatseg.lift.training._options import SamplingOptions
from splatseg.lift.training._targets import (
    DrawnView,
    Ragged,
    Target,
    Targets,
    TargetSource,
    TensorBudget,
)
from splatseg.lift.voting.uplift import voting_views
from splatseg.render import (
    CompactRows,
    SparseWeights,
    get_backend,
    options_for,
    weights,
)

_GOLDEN = (5**0.5 - 1) / 2


def draw_uniformly(
    pixels: Int64[Tensor, "m"], count: int, rng: np.random.Generator
) -> tuple[Int64[Tensor, "p"], Float[Tensor, "p"]]:
    """Some pixels in random order, and how many each stands for: m / p.

    Every pixel is as likely as every other.
    """
    total = len(pixels)
    taken = min(count, total)
    drawn = rng.choice(total, taken, replace=False, shuffle=True)
    return pixels[torch.from_numpy(drawn)], torch.full((taken,), total / max(taken, 1))


def draw_by_strata(
    pixels: Int64[Tensor, "m"], width: int, count: int, rng: np.random.Generator
) -> tuple[Int64[Tensor, "p"], Float[Tensor, "p"]]:
    r"""One pixel of each of p parts of the picture that hold equally many pixels, give or take one.

    Parts are runs of the pixels in Morton order (bits of row and column in turn), so each is a
    patch or a few that touch. They come in the order of the fractions of :math:`u + i \phi`, with
    :math:`\phi` the golden ratio: any so many pixels one after the other lie evenly over the
    picture, too, and are a stratified draw by themselves.

    Args:
        pixels: Those that may be drawn, numbered row by row.
        width: Of the picture.
        count: How many at most.
        rng: Draws them.
    """
    total = len(pixels)
    taken = min(count, total)
    if not taken:
        return pixels, torch.zeros(0)
    flat = pixels.numpy()
    ordered = flat[np.argsort(_morton(flat // width, flat % width), kind="stable")]
    starts = np.arange(taken + 1) * total // taken
    sizes = np.diff(starts)
    drawn = ordered[starts[:-1] + rng.integers(sizes)]
    rank = np.argsort(np.argsort((rng.random() + np.arange(taken) * _GOLDEN) % 1.0))
    return torch.from_numpy(drawn[rank]), torch.from_numpy(sizes[rank].astype(np.float32))


def _morton(rows: NDArray[np.int64], columns: NDArray[np.int64]) -> NDArray[np.int64]:
    """Bits of row and column in turn."""
    code = np.zeros_like(rows)
    for bit in range(31):
        code |= ((columns >> bit) & 1) << (2 * bit) | ((rows >> bit) & 1) << (2 * bit + 1)
    return code


def draw_by_group(
    groups: Ragged, size: int, count: int, rng: np.random.Generator
) -> tuple[Int64[Tensor, "p"], Float[Tensor, "p"]]:
    r"""Distinct pixels in random order, equally many of each group, and what each stands for.

    A pixel that is in the groups g of sizes :math:`m_g`, of which :math:`d_g` are drawn, stands
    for one over its probability to be drawn,

    .. math:: 1 \Big/ \Bigl(1 - \prod_g (1 - d_g / m_g)\Bigr),

    so that sums over drawn pixels, weighted so, estimate sums over all pixels of the groups
    (Horvitz and Thompson 1952).

    Args:
        groups: Pixels of each group.
        size: Pixels of the view.
        count: How many at most. Overlapping groups may draw a pixel twice; it comes once.
        rng: Draws them.
    """
    shares = equal_shares(torch.diff(groups.starts).tolist(), count, rng)
    parts = [groups.values[:0]]
    missed = torch.ones(size, dtype=torch.float64)
    for index, share in enumerate(shares):
        members = groups.row(index)
        drawn = rng.choice(len(members), share, replace=False)
        parts.append(members[torch.from_numpy(drawn)])
        missed[members] *= 1.0 - share / len(members)
    pixels = torch.unique(torch.cat(parts))
    pixels = pixels[torch.from_numpy(rng.permutation(len(pixels)))]
    return pixels, (1.0 / (1.0 - missed[pixels])).float()


def equal_shares(sizes: list[int], count: int, rng: np.random.Generator) -> list[int]:
    """How many of `count` each group gives: equally many, or all it has.

    What does not divide goes to groups drawn by chance.
    """
    shares = [0] * len(sizes)
    left, open_groups = min(count, sum(sizes)), list(range(len(sizes)))
    while left > 0:
        each = left // len(open_groups)
        if each == 0:
            for position in rng.permutation(len(open_groups))[:left].tolist():
                shares[open_groups[position]] += 1
            break
        for group in open_groups:
            more = min(each, sizes[group] - shares[group])
            shares[group] += more
            left -= more
        open_groups = [group for group in open_groups if shares[group] < sizes[group]]
    return shares


@dataclass(frozen=True, slots=True, kw_only=True)
class BatchGroup:
    """Views whose drawn pixels are cut into batches together."""

    views: Sequence[int]
    """Indices of the views, ascending."""

    offsets: Sequence[int]
    """By view, which batch gets the first of what does not divide."""

    count: int
    """How many batches."""

    def span(self, pixels: int, offset: int, index: int) -> tuple[int, int]:
        """Which of a view's drawn pixels a batch takes.

        They are in random order, and each batch takes an equal part. What does not divide goes
        to other batches in each view, by the view's offset.
        """
        turned = (index + offset) % self.count
        return pixels * turned // self.count, pixels * (turned + 1) // self.count


def batch_groups(
    sizes: Sequence[int], batch: int, views_per_batch: int | None, rng: np.random.Generator
) -> list[BatchGroup]:
    """Groups of views that are cut into batches together: all, or some drawn by chance."""
    if views_per_batch is None:
        return [_group(sizes, range(len(sizes)), batch, rng)]
    order = rng.permutation([view for view, size in enumerate(sizes) if size])
    # As even as can be: what does not divide makes several groups smaller by one.
    parts = np.array_split(order, math.ceil(len(order) / views_per_batch))
    return [_group(sizes, sorted(part.tolist()), batch, rng) for part in parts]


def _group(
    sizes: Sequence[int], views: Sequence[int], batch: int, rng: np.random.Generator
) -> BatchGroup:
    total = sum(sizes[view] for view in views)
    count = max(1, min(total, math.ceil(total / batch)))
    # A view with fewer pixels than there are batches is in some of them only.
    offsets = rng.integers(count, size=len(views)).tolist()
    return BatchGroup(views=tuple(views), offsets=tuple(offsets), count=count)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Batch:
    """Pixels of many views: their rows of W and what they are trained towards."""

    weights: CompactRows
    """Rows of W over the Gaussians that the pixels show, ``weights.touched``."""

    views: Int64[Tensor, "pixels"]
    """Index of each pixel's view among the sampler's."""

    pixels: Int64[Tensor, "pixels"]
    """Each pixel's number in its view, row by row of the map."""

    stands_for: Float[Tensor, "pixels"]
    """How many pixels of its view each stands for."""

    targets: Targets
    """What they are trained towards, see the source of targets."""

    def __len__(self) -> int:
        return len(self.views)

    def target(self, name: str) -> Tensor:
        """A target that has one value or vector a pixel.

        Raises:
            InputError: If there is none of that name, or any number of them a pixel.
        """
        found = self.targets.get(name)
        if not isinstance(found, Tensor):
            raise InputError(f"targets: expected one {name!r} a pixel, got {type(found).__name__}.")
        return found

    def ragged_target(self, name: str) -> Ragged:
        """A target that a pixel has any number of.

        Raises:
            InputError: If there is none of that name, or exactly one a pixel.
        """
        found = self.targets.get(name)
        if not isinstance(found, Ragged):
            raise InputError(
                f"targets: expected any number of {name!r} a pixel, got {type(found).__name__}."
            )
        return found


class DrawnRows:
    """One draw: pixels of all views, cut into batches that each hold some of every view.

    With groups of views, a batch holds some of every view of its group.

    Close it when it is done with, or use it in a ``with`` block: rows beyond the memory budget
    lie in files.
    """

    @boundary
    def __init__(
        self, views: Sequence[DrawnView], budget: TensorBudget, groups: Sequence[BatchGroup]
    ) -> None:
        self._views = views
        self._budget = budget
        self._groups = groups
        self._batches = [(group, index) for group in groups for index in range(group.count)]

    def __enter__(self) -> "DrawnRows":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __len__(self) -> int:
        """How many batches there are."""
        return len(self._batches)

    def batch(self, index: int) -> Batch:
        """One batch, ready for products."""
        group, position = self._batches[index]
        parts, views = [], []
        for view, offset in zip(group.views, group.offsets, strict=True):
            drawn = self._views[view]
            begin, end = group.span(len(drawn), offset, position)
            if end > begin:
                parts.append(drawn.slice(begin, end))
                views.append(torch.full((end - begin,), view))
        return Batch(
            weights=SparseWeights.concatenate([part.rows for part in parts]).compact(),
            views=torch.cat(views),
            pixels=torch.cat([part.pixels for part in parts]),
            stands_for=torch.cat([part.stands_for for part in parts]),
            targets={
                name: _concatenated([part.targets[name] for part in parts])
                for name in parts[0].targets
            },
        )

    def order(self, rng: np.random.Generator, *, in_rounds: bool) -> NDArray[np.int64]:
        """A random order of the batches.

        In rounds, a batch of each group comes before the next of any, so that batches one after
        the other are of different views.
        """
        order = rng.permutation(len(self))
        if not in_rounds:
            return order
        groups = np.repeat(np.arange(len(self._groups)), [group.count for group in self._groups])[
            order
        ]
        rounds = np.zeros(len(self), dtype=np.int64)
        for group in range(len(self._groups)):
            own = groups == group
            rounds[own] = np.arange(int(own.sum()))
        return order[np.argsort(rounds, kind="stable")]

    def visibility(self, count: int) -> Float[Tensor, "n"]:
        """Blending weight of each of `count` Gaussians in all pixels that may be drawn, estimated.

        Each drawn pixel counts as many as it stands for.
        """
        total = torch.zeros(count)
        for drawn in self._views:
            each = torch.repeat_interleave(drawn.stands_for, torch.diff(drawn.rows.indptr))
            total.index_add_(0, drawn.rows.ids.int(), drawn.rows.weights.float() * each)
        return total

    def close(self) -> None:
        """Forget the rows and remove the files."""
        self._views = ()
        self._budget.close()


class RowSampler:
    """Draws pixels of views and keeps their rows of W.

    Args:
        gaussians: The Gaussians of the scene; their geometry stays as it is.
        views: Those to learn from.
        source: What there is to learn.
        options: Which pixels are drawn.
        backend: Name of the rendering backend.

    Raises:
        InputError: If there are no views, one comes twice, or one has nothing to learn.
    """

    @boundary
    def __init__(
        self,
        gaussians: Gaussians,
        views: Sequence[View],
        source: TargetSource,
        *,
        options: SamplingOptions | None = None,
        backend: str = "auto",
    ) -> None:
        self._views = voting_views(views, source, "targets")
        gaussians.check_values()
        self._gaussians = gaussians
        self._source = source
        self.options: SamplingOptions = options or SamplingOptions()
        """Which pixels are drawn."""
        self._render_options = options_for(gaussians, backend)
        self._backend = backend

    @property
    def views(self) -> Sequence[View]:
        """The views, in the order of their names."""
        return tuple(self._views)

    @property
    def count(self) -> int:
        """How many Gaussians there are."""
        return len(self._gaussians)

    def of_views(self, views: Sequence[View]) -> "RowSampler":
        """The same with other views."""
        return RowSampler(
            self._gaussians,
            views,
            self._source,
            options=self.options,
            backend=self._backend,
        )

    @property
    def backend(self) -> str:
        """Name of the backend that renders, ``auto`` no more."""
        return get_backend(self._backend, like=self._gaussians.means).name

    @property
    def fingerprints(self) -> dict[str, str]:
        """Digests of all data that draws depend on, by what it is."""
        gaussians, cameras = hashlib.sha256(), hashlib.sha256()
        for name in ("means", "rotations", "scales", "opacities"):
            gaussians.update(getattr(self._gaussians, name).detach().cpu().numpy().tobytes())
        for view in self._views:
            camera = view.camera
            numbers = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
            cameras.update(repr((view.name, numbers, camera.model, camera.distortion)).encode())
            cameras.update(camera.cam_from_world.detach().cpu().numpy().tobytes())
        cameras.update(repr(self._render_options).encode())
        return {
            "Gaussians": gaussians.hexdigest(),
            "views": cameras.hexdigest(),
            "evidence": self._source.fingerprint,
        }

    def draw(self, rng: np.random.Generator, *, batch: int, pixels: int | None = None) -> DrawnRows:
        """Draw pixels of all views.

        Views that have nothing to learn give no pixels.

        Args:
            rng: Draws them.
            batch: Pixels of a batch, about: all batches have as many, give or take a pixel a
                view.
            pixels: Pixels of a view, if not as many as the options say.

        Raises:
            InputError: If no view has anything to learn.
            SplatsegError: If rows beyond the memory budget cannot be written.
        """
        budget = TensorBudget(self.options.memory)
        found: list[DrawnView] = []
        try:
            for view in self._views:
                drawn = self._drawn(view, rng, pixels or self.options.pixels)
                found.append(drawn.with_tensors(budget.kept(drawn.tensors())))
        except BaseException:
            found.clear()
            budget.close()
            raise
        sizes = [len(drawn) for drawn in found]
        if not sum(sizes):
            raise InputError(f"views: expected something to learn in {len(found)}, found none.")
        groups = batch_groups(sizes, batch, self.options.views_per_batch, rng)
        return DrawnRows(found, budget, groups)

    def _drawn(self, view: View, rng: np.random.Generator, count: int) -> DrawnView:
        source, options = self._source, self.options
        choice = source.choice(view.name)
        if choice.grid:
            camera = view.camera.resized(choice.width, choice.height)
        else:
            camera = camera_of_map(view, choice.height, choice.width)
        if options.sampling == "uniform":
            pixels, stands_for = draw_uniformly(choice.pixels, count, rng)
        elif options.sampling == "strata":
            pixels, stands_for = draw_by_strata(choice.pixels, choice.width, count, rng)
        else:
            size = choice.height * choice.width
            pixels, stands_for = draw_by_group(source.groups(view.name), size, count, rng)
        rows = self._rows(camera, pixels)
        if options.min_weight > 0:
            rows = rows.truncated(min_weight=options.min_weight)
        return DrawnView(
            rows=rows,
            pixels=pixels,
            stands_for=stands_for,
            targets=source.targets(view.name, pixels),
        )

    def _rows(self, camera: Camera, flat: Int64[Tensor, "p"]) -> SparseWeights:
        asked = torch.stack((flat % camera.width, flat // camera.width), dim=-1)
        with torch.no_grad():
            found = weights(
                self._gaussians, camera, asked, options=self._render_options, backend=self._backend
            )
        return found.to("cpu", dtype=torch.float16)


@boundary
def held_out_views(views: Sequence[View], share: float) -> tuple[list[View], list[View]]:
    """Training views, and those of them that are held out: evenly spaced by name.

    Of n views ``round(share * n)`` are held out, at most n - 1.

    Raises:
        RangeError: If the share is not in [0, 1].
    """
    check_range("share", share, 0.0, 1.0)
    ordered = sorted(views, key=lambda view: view.name)
    count = min(math.floor(share * len(ordered) + 0.5), len(ordered) - 1)
    chosen = {(2 * k + 1) * len(ordered) // (2 * count) for k in range(count)}
    kept = [view for i, view in enumerate(ordered) if i not in chosen]
    return kept, [view for i, view in enumerate(ordered) if i in chosen]


def _concatenated(parts: Sequence[Target]) -> Target:
    ragged = [part for part in parts if isinstance(part, Ragged)]
    if ragged:
        return Ragged.concatenate(ragged)
    return torch.cat([part for part in parts if isinstance(part, Tensor)])
