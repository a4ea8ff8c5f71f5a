"""Blocks of a drive as one field, of which few are in memory."""

import tempfile
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from splatseg._check import check_shape
from splatseg.core import (
    Camera,
    PointLabels,
    Renderable,
    RenderableLayer,
    RenderableView,
    ScanSource,
)
from splatseg.core.boundary import boundary
from splatseg.errors import InputError, RangeError
from splatseg.street.blocks.cut import Drive, DriveBlock
from splatseg.street.blocks.join import WeightedLabels, joined
from splatseg.street.blocks.parts import DriveScans


@runtime_checkable
class ScanLabeller(Protocol):
    """A field that labels many scans better or faster than one cloud after the other."""

    def labels_of_scans(self, scans: ScanSource, layer: str) -> Iterator[tuple[str, PointLabels]]:
        """Labels of the points of every scan, by its name, in the order of the source."""
        ...


class DriveField:
    """A drive in blocks, a `splatseg.core.Renderable`.

    A view is that of the block that counts most at its camera. A point takes the id with the
    largest sum of confidences over blocks, each times what the block counts there
    (`Drive.shares`). What a drive of one block says is what the block says.

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
        drive: Drive,
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
        self, scans: ScanSource, layer: str, *, work: Path | None = None
    ) -> Iterator[tuple[str, PointLabels]]:
        """Labels of the points of every scan, by its name, in the order of the source.

        Blocks are opened one after the other and label all their scans, as `ScanLabeller` where
        they are one. What they say waits in files until all blocks of a scan have spoken, so
        that no more than a scan is in memory.

        Args:
            scans: Scans in the world of the drive; `DriveScans` are not looked at again.
            layer: Address of a layer with labels.
            work: Folder for these files, which are gone in the end; None is the system's.

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
                    for name, labels in _labels_of(self._field(block.index), own, layer):
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


def _labels_of(
    field: Renderable, scans: ScanSource, layer: str
) -> Iterator[tuple[str, PointLabels]]:
    if isinstance(field, ScanLabeller):
        yield from field.labels_of_scans(scans, layer)
        return
    for name in scans.scan_names:
        yield name, field.labels_at(scans.scan(name).points, layer)


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
