"""Blocks of a drive as one field, of which few are in memory."""

import tempfile
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from typing_extensions import override

from splatseg._check import check_shape
from splatseg.core import (
    LOCAL,
    UNLABELLED,
    Camera,
    Executor,
    PointLabels,
    Renderable,
    RenderableLayer,
    RenderableView,
    ScanSource,
    View,
)
from splatseg.core.boundary import boundary
from splatseg.core.partition import BlockShare
from splatseg.core.scans import Scan
from splatseg.errors import InputError, RangeError
from splatseg.io.arrays import read_npy
from splatseg.io.atomic import named_write_failures
from splatseg.street.blocks import DriveBlock, DriveBlocks


@runtime_checkable
class ScanLabeller(Protocol):
    """A field that labels many scans better or faster than one cloud after the other."""

    def labels_of_scans(
        self, scans: ScanSource, layer: str, *, executor: Executor = LOCAL
    ) -> Iterator[tuple[str, PointLabels]]:
        """Labels of the points of every scan, by its name, in the order of the source."""
        ...


class DriveField:
    """A drive in blocks, a `splatseg.core.Renderable`.

    A view is that of the block that counts most at its camera. A point takes the id with the
    largest sum of confidences over blocks, each times what the block counts there
    (`DriveBlocks.shares`). What a drive of one block says is what the block says.

    Args:
        drive: How the drive was cut.
        open_block: Gives the field of a block: made, or read from a file. It is called again
            after the field was dropped, and must give the same.
        max_open: Fields that are held, at least 1; the one that was not used for longest is
            dropped before another is opened.
        layers: What all blocks together know of each layer; None opens each block once to ask.

    Raises:
        RangeError: If no field may be held.
    """

    @boundary
    def __init__(
        self,
        drive: DriveBlocks,
        open_block: Callable[[DriveBlock], Renderable],
        *,
        max_open: int = 2,
        layers: Mapping[str, RenderableLayer] | None = None,
    ) -> None:
        if max_open < 1:
            raise RangeError(f"max_open: expected at least 1, got {max_open}.")
        self._drive = drive
        self._open_block = open_block
        self._max_open = max_open
        self._open: OrderedDict[int, Renderable] = OrderedDict()
        self._layers = None if layers is None else dict(layers)

    @property
    def layer_names(self) -> Sequence[str]:
        """Names of all layers."""
        return tuple(self._known())

    def layer(self, layer: str) -> RenderableLayer:
        """What there is to know of a layer: ids, their names and views are those of all blocks.

        The rest of its record is the first block's.
        """
        known = self._known()
        if layer not in known:
            shown = ", ".join(known) or "none"
            raise InputError(f"layer: expected one of {shown}, got {layer!r:.80}.")
        return known[layer]

    def view(self, camera: Camera) -> RenderableView:
        """What the block at a camera shows through it."""
        return self._field(self._drive.block_of(camera.centre)).view(camera)

    def labels_at(self, points: Float[Tensor, "p 3"], layer: str) -> PointLabels:
        """Labels of points of the world; points of one call and one block are one cloud.

        Raises:
            InputError: If a block has no such layer, or it has no labels.
            ShapeError: If the points are not (p, 3).
            RangeError: If a point is not finite.
        """
        check_shape("points", points, (None, 3))
        parts = [
            WeightedLabels.of(
                self._field(share.block).labels_at(points[share.rows], layer),
                share.rows,
                share.weights,
            )
            for share in self._drive.shares(points)
        ]
        return joined(parts, len(points))

    def labels_of_scans(
        self,
        scans: ScanSource,
        layer: str,
        *,
        work: Path | None = None,
        executor: Executor = LOCAL,
    ) -> Iterator[tuple[str, PointLabels]]:
        """Labels of the points of every scan, by its name, in the order of the source.

        Blocks are opened one after the other and label all their scans, as `ScanLabeller` where
        they are one. What they say waits in files until all blocks of a scan have spoken, so
        that no more than a scan is in memory.

        Args:
            scans: Scans in the world of the drive; `DriveScans` are not looked at again.
            layer: Address of a layer with labels.
            work: Folder for these files, which are gone in the end; None is the system's.
            executor: Where the scans of a block are labelled.

        Raises:
            InputError: If a block has no such layer, it has no labels, or a scan is broken.
            OutputError: If the files cannot be written.
        """
        parts = scans if isinstance(scans, DriveScans) else DriveScans(scans, self._drive)
        names = list(parts.scan_names)
        numbers = {name: i for i, name in enumerate(names)}
        with tempfile.TemporaryDirectory(prefix="splatseg-scans-", dir=work) as held:
            folder = Path(held)
            following = 0
            for block in self._drive.blocks:
                own = parts.to_label(block)
                if own.scan_names:
                    # No name for the field: it is dropped before the next is opened.
                    for name, labels in labels_of_scans(
                        self._field(block.index), own, layer, executor=executor
                    ):
                        share = own.share(name)
                        said = WeightedLabels.of(labels, share.rows, share.weights)
                        said.save(folder / f"{numbers[name]}_{block.index}.npy")
                while following < len(names):
                    name = names[following]
                    if max(parts.labelled_by(name), default=-1) > block.index:
                        break
                    files = [folder / f"{following}_{b}.npy" for b in parts.labelled_by(name)]
                    yield name, joined([WeightedLabels.load(f) for f in files], parts.points(name))
                    for file in files:
                        file.unlink()
                    following += 1

    def _field(self, index: int) -> Renderable:
        """The field of a block, opened where it is not held."""
        if index in self._open:
            self._open.move_to_end(index)
            return self._open[index]
        while len(self._open) >= self._max_open:
            self._open.popitem(last=False)
        field = self._open_block(self._drive.blocks[index])
        self._open[index] = field
        return field

    def _known(self) -> Mapping[str, RenderableLayer]:
        if self._layers is None:
            fields = (self._field(block.index) for block in self._drive.blocks)
            self._layers = joined_layers(
                (name, field.layer(name)) for field in fields for name in field.layer_names
            )
        return self._layers


def joined_layers(layers: Iterable[tuple[str, RenderableLayer]]) -> dict[str, RenderableLayer]:
    """What blocks know of layers, as one: of each name the ids, their names and views of all.

    Args:
        layers: With their names, those of one block after those of another. What else a layer
            tells is that of the first.
    """
    found: dict[str, RenderableLayer] = {}
    for name, layer in layers:
        found[name] = _both(found.get(name), layer)
    return found


def labels_of_scans(
    field: Renderable, scans: ScanSource, layer: str, *, executor: Executor = LOCAL
) -> Iterator[tuple[str, PointLabels]]:
    """Labels of the points of every scan of any field, by its name, in the order of the source.

    Args:
        field: If no `ScanLabeller`, each scan is a cloud of its own.
        scans: Where they are read.
        layer: Address of a layer with labels.
        executor: Where they are worked on.
    """
    if isinstance(field, ScanLabeller):
        yield from field.labels_of_scans(scans, layer, executor=executor)
        return
    clouds = _Clouds(field=field, scans=scans, layer=layer)
    with closing(executor.map(_Clouds.labels, scans.scan_names, shared=clouds)) as labelled:
        yield from labelled


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Clouds:
    """Scans that are labelled one by one."""

    field: Renderable
    scans: ScanSource
    layer: str

    def labels(self, name: str) -> Iterator[tuple[str, PointLabels]]:
        """Of one of them."""
        yield name, self.field.labels_at(self.scans.scan(name).points, self.layer)


def _both(first: RenderableLayer | None, second: RenderableLayer) -> RenderableLayer:
    if first is None:
        return second
    one, other = first.info, second.info
    views = None
    if one.views is not None and other.views is not None:
        views = tuple(dict.fromkeys((*one.views, *other.views)))
    return RenderableLayer(
        kind=first.kind,
        ids=tuple(sorted({*first.ids, *second.ids})),
        background=first.background,
        info=replace(one, views=views, names={**other.names, **one.names}),
    )


# Labels that several blocks give to the same points, as one.


_LAST = np.iinfo(np.int64).max


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WeightedLabels:
    """What one block says of some points."""

    rows: Int[Tensor, "n"]
    """Which points, int64, each once."""

    ids: Int[Tensor, "n"]
    """int32, -1 none."""

    shares: Float[Tensor, "n"]
    """The confidence times what the block counts there, float64."""

    @classmethod
    def of(
        cls, labels: PointLabels, rows: Int[Tensor, "n"], weights: Float[Tensor, "n"]
    ) -> "WeightedLabels":
        """Labels of the points of some rows, by a block that counts so much at them."""
        return cls(
            rows=rows,
            ids=labels.ids.detach().cpu().int(),
            shares=weights * labels.confidence.detach().cpu().double(),
        )

    def save(self, path: Path) -> None:
        """Keep them in a file of this run: one array of float64, which holds all of it exactly.

        Raises:
            OutputError: If it cannot be written.
        """
        table = torch.stack((self.rows.double(), self.ids.double(), self.shares))
        with named_write_failures(path):
            np.save(path, table.numpy(), allow_pickle=False)

    @classmethod
    def load(cls, path: Path) -> "WeightedLabels":
        """Read what `save` kept."""
        rows, ids, shares = torch.from_numpy(read_npy(path))
        return cls(rows=rows.long(), ids=ids.int(), shares=shares)


def joined(parts: list[WeightedLabels], count: int) -> PointLabels:
    r"""The id with the largest sum of shares at each point.

    .. math:: v_c(x) = \sum_b w_b(x)\, p_b(x)\, [k_b(x) = c], \qquad
              \mathrm{id}(x) = \arg\max_c v_c(x)

    with k the id and p the confidence that block b gives. No label competes as one more id. Equal
    sums go to the smaller id, and no label loses them.

    Args:
        parts: What the blocks say, in their order, which is that of the sums.
        count: Number of points.

    Returns:
        Ids, and as confidence the winner's sum; -1 and 0 where no block says anything.
    """
    ids = torch.full((count,), UNLABELLED, dtype=torch.int32)
    confidence = torch.zeros(count)
    if not sum(len(part.rows) for part in parts):
        return PointLabels(ids=ids, confidence=confidence)
    rows = np.concatenate([part.rows.numpy() for part in parts]).astype(np.int64)
    named = np.concatenate([part.ids.numpy() for part in parts]).astype(np.int64)
    shares = np.concatenate([part.shares.numpy() for part in parts])
    pairs, inverse = np.unique(np.stack((rows, named), axis=1), axis=0, return_inverse=True)
    sums = np.bincount(inverse.reshape(-1), weights=shares, minlength=len(pairs))
    order_of_id = np.where(pairs[:, 1] == UNLABELLED, _LAST, pairs[:, 1])
    order = np.lexsort((order_of_id, -sums, pairs[:, 0]))
    first = order[np.unique(pairs[order, 0], return_index=True)[1]]
    at = torch.from_numpy(pairs[first, 0])
    ids[at] = torch.from_numpy(pairs[first, 1].astype(np.int32))
    confidence[at] = torch.from_numpy(sums[first]).float().clamp(0, 1)
    return PointLabels(ids=ids, confidence=confidence)


# What of a capture and of its scans is a block's: views, start points and scans near it.


_KEPT_SHARES = 64
"""Scans of which it is kept what a block counts there: more than a window of scans with those
around it."""


@boundary
def block_views(views: Sequence[View], drive: DriveBlocks, block: DriveBlock) -> tuple[View, ...]:
    """The views at whose place a block counts, in their order.

    Raises:
        InputError: If no training view is among them.
    """
    centres = [view.camera.centre for view in views]
    at = torch.stack(centres) if centres else torch.zeros(0, 3)
    of_block = drive.counts(block, at).tolist()
    found = tuple(view for view, own in zip(views, of_block, strict=True) if own)
    if not any(view.split == "train" for view in found):
        raise InputError(
            f"blocks: expected training views in every block, block {block.index} of {len(drive)} "
            "has none; longer blocks bridge a gap of the drive."
        )
    return found


class DriveScans:
    """Scans of a drive by blocks; a `core.ScanSource` itself.

    Every scan is read once to see where it is, and again when it is asked for.

    Args:
        scans: Scans of the whole drive, in its world.
        drive: How it was cut.

    Raises:
        InputError: If a scan is broken.
    """

    @boundary
    def __init__(self, scans: ScanSource, drive: DriveBlocks) -> None:
        self._scans, self._drive = scans, drive
        self._facts = {name: _facts(scans.scan(name), drive) for name in scans.scan_names}
        self._built_from: dict[int, list[str]] = {}
        self._to_label: dict[int, list[str]] = {}
        for name, facts in self._facts.items():
            for block in facts.makes:
                self._built_from.setdefault(block, []).append(name)
            for block in facts.labelled_by:
                self._to_label.setdefault(block, []).append(name)

    @property
    def scan_names(self) -> Sequence[str]:
        """All scans in the order of the source."""
        return tuple(self._facts)

    def scan(self, name: str) -> Scan:
        """One of them, whole."""
        return self._scans.scan(name)

    def points(self, name: str) -> int:
        """How many points a scan has."""
        return self._facts[name].points

    def labelled_by(self, name: str) -> tuple[int, ...]:
        """Blocks that count at points of a scan, ascending."""
        return self._facts[name].labelled_by

    def of(self, block: DriveBlock) -> ScanSource:
        """Scans that a block is made from: those measured where it counts.

        Of each come the points in reach of the block. Clouds that were put together have no such
        place; they are of every block that has a point of them.
        """
        return _NearScans(self._scans, self._built_from.get(block.index, []), self._drive, block)

    def to_label(self, block: DriveBlock) -> "ScansToLabel":
        """Scans with points at which a block counts, and nothing but these points of them."""
        return ScansToLabel(self._scans, self._to_label.get(block.index, []), self._drive, block)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Facts:
    """Where a scan is."""

    points: int
    labelled_by: tuple[int, ...]
    makes: tuple[int, ...]


def _facts(scan: Scan, drive: DriveBlocks) -> _Facts:
    if scan.origin is not None:
        at = drive.shares(scan.origin.unsqueeze(0))
        makes = tuple(share.block for share in at)
    else:
        near = (block for block in drive.blocks if bool(drive.near(block, scan.points).any()))
        makes = tuple(block.index for block in near)
    labelled_by = tuple(share.block for share in drive.shares(scan.points))
    return _Facts(points=len(scan), labelled_by=labelled_by, makes=makes)


class _NearScans:
    """Some scans of a source, and their points in reach of a block; a `core.ScanSource`."""

    def __init__(
        self, scans: ScanSource, names: Sequence[str], drive: DriveBlocks, block: DriveBlock
    ) -> None:
        self._scans, self._names = scans, tuple(names)
        self._drive, self._block = drive, block

    @property
    def scan_names(self) -> Sequence[str]:
        """Scans in the order of the source."""
        return self._names

    def scan(self, name: str) -> Scan:
        """One of them, its other points left out."""
        if name not in self._names:
            raise InputError(f"scan: there is no {name!r:.80} in this block of the drive.")
        scan = self._scans.scan(name)
        return scan.take(self._kept(name, scan))

    def _kept(self, name: str, scan: Scan) -> Int[Tensor, "n"]:
        return torch.nonzero(self._drive.near(self._block, scan.points)).squeeze(1)


class ScansToLabel(_NearScans):
    """Some scans of a source, and their points at which a block counts; a `core.ScanSource`."""

    def __init__(
        self, scans: ScanSource, names: Sequence[str], drive: DriveBlocks, block: DriveBlock
    ) -> None:
        """Take what `DriveScans.to_label` knows."""
        super().__init__(scans, names, drive, block)
        self._read: OrderedDict[str, BlockShare] = OrderedDict()

    @override
    def _kept(self, name: str, scan: Scan) -> Int[Tensor, "n"]:
        share = next(s for s in self._drive.shares(scan.points) if s.block == self._block.index)
        self._read[name] = share
        self._read.move_to_end(name)
        if len(self._read) > _KEPT_SHARES:
            self._read.popitem(last=False)
        return share.rows

    def share(self, name: str) -> BlockShare:
        """What the block counts at these points of a scan, known still if it was read lately."""
        if name not in self._read:
            self.scan(name)
        return self._read.pop(name)
