"""Draws pixels of views and keeps their rows of W, cut into batches."""

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

import numpy as np
import torch
from jaxtyping import Float, Int64
from numpy.typing import NDArray
from torch import Tensor

from splatseg._check import check_choice, check_range
from splatseg.core import Camera, Gaussians, View, camera_of_map
from splatseg.core.boundary import boundary, convert_fields
from splatseg.errors import InputError, RangeError
from splatseg.lift.mass.adjoint import voting_views
from splatseg.lift.training._batches import BatchGroup, batch_groups
from splatseg.lift.training._pixels import (
    Sampling,
    draw_by_group,
    draw_by_strata,
    draw_uniformly,
)
from splatseg.lift.training._store import DrawnView, RowStore
from splatseg.lift.training._targets import Ragged, Target, Targets, TargetSource
from splatseg.render import (
    CompactRows,
    RenderOptions,
    SparseWeights,
    get_backend,
    options_for,
    weights,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class SamplingOptions:
    """Which pixels are drawn and what is kept of them."""

    pixels: int = 4000
    """Pixels of each view in one draw; all there are where a view has fewer."""

    sampling: Sampling = "uniform"
    """uniform: all pixels that have something to learn alike. groups: equally many of each id
    of a label map, or of each mask. strata: one of each of as many equal parts of the picture."""

    min_weight: float = 0.0
    """Blending weight in [0, 1] below which an entry of a row is left out and the row's others
    are scaled to the same sum; 0 keeps all. Half of the entries carry 2 % of the light."""

    views_per_batch: int | None = None
    """Views that a batch has pixels of. None takes some of every view; losses of pairs of pixels
    want many pixels of few views."""

    memory: int = 1 << 30
    """Bytes of drawn rows that are kept in memory; more go to files."""

    folder: Path | None = None
    """Where those files go; None is the system's folder for temporary files."""

    @boundary
    def __post_init__(self) -> None:
        convert_fields(self)
        if self.pixels < 1:
            raise RangeError(f"pixels: expected at least 1, got {self.pixels}.")
        check_choice("sampling", self.sampling, get_args(Sampling))
        if not 0 <= self.min_weight <= 1:
            raise RangeError(f"min_weight: expected 0 to 1, got {self.min_weight}.")
        if self.views_per_batch is not None and self.views_per_batch < 1:
            raise RangeError(f"views_per_batch: expected at least 1, got {self.views_per_batch}.")
        if self.memory < 0:
            raise RangeError(f"memory: expected 0 or more bytes, got {self.memory}.")
        if self.folder is not None and not self.folder.is_dir():
            raise InputError(f"folder: expected an existing folder, got {self.folder}.")


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
    def __init__(self, store: RowStore, groups: Sequence[BatchGroup]) -> None:
        self._store = store
        self._groups = groups
        self._batches = [(group, index) for group in groups for index in range(group.count)]

    def __enter__(self) -> "DrawnRows":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __len__(self) -> int:
        """How many batches there are."""
        return len(self._batches)

    @property
    def pixels(self) -> int:
        """How many pixels were drawn."""
        return sum(len(self._store[i]) for i in range(len(self._store)))

    @property
    def entries(self) -> int:
        """How many entries of W their rows have."""
        return sum(len(self._store[i].rows.ids) for i in range(len(self._store)))

    @property
    def nbytes(self) -> int:
        """Bytes of all rows and targets, in memory and in files."""
        return sum(self._store[i].nbytes for i in range(len(self._store)))

    @property
    def spilled(self) -> int:
        """Bytes of them that are in files."""
        return self._store.spilled

    def batch(self, index: int) -> Batch:
        """One batch, ready for products."""
        if not 0 <= index < len(self):
            raise InputError(f"index: expected a batch below {len(self)}, got {index}.")
        group, position = self._batches[index]
        parts, views = [], []
        for view, offset in zip(group.views, group.offsets, strict=True):
            drawn = self._store[view]
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
        for view in range(len(self._store)):
            drawn = self._store[view]
            each = torch.repeat_interleave(drawn.stands_for, torch.diff(drawn.rows.indptr))
            total.index_add_(0, drawn.rows.ids.int(), drawn.rows.weights.float() * each)
        return total

    def close(self) -> None:
        """Forget the rows and remove the files."""
        self._store.close()


class RowSampler:
    """Draws pixels of views and keeps their rows of W.

    Args:
        gaussians: The Gaussians of the scene; their geometry stays as it is.
        views: Those to learn from.
        source: What there is to learn.
        options: Which pixels are drawn.
        render_options: Switches of the blending model.
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
        render_options: RenderOptions | None = None,
        backend: str = "auto",
    ) -> None:
        self._views = voting_views(views, source, "targets")
        gaussians.check_values()
        self._gaussians = gaussians
        self._source = source
        self._options = options or SamplingOptions()
        self._render_options = render_options or options_for(gaussians, backend)
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
            options=self._options,
            render_options=self._render_options,
            backend=self._backend,
        )

    @property
    def options(self) -> SamplingOptions:
        """Which pixels are drawn."""
        return self._options

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
            RangeError: If `batch` is less than 1.
            InputError: If no view has anything to learn.
            SplatsegError: If rows beyond the memory budget cannot be written.
        """
        if batch < 1:
            raise RangeError(f"batch: expected at least 1, got {batch}.")
        store = RowStore(memory=self._options.memory, folder=self._options.folder)
        try:
            for view in self._views:
                store.append(self._drawn(view, rng, pixels or self._options.pixels))
        except BaseException:
            store.close()
            raise
        sizes = [len(store[i]) for i in range(len(store))]
        if not sum(sizes):
            raise InputError(f"views: expected something to learn in {len(store)}, found none.")
        return DrawnRows(store, batch_groups(sizes, batch, self._options.views_per_batch, rng))

    def _drawn(self, view: View, rng: np.random.Generator, count: int) -> DrawnView:
        source, options = self._source, self._options
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
                self._gaussians,
                camera,
                asked,
                options=self._render_options,
                backend=self._backend,
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
