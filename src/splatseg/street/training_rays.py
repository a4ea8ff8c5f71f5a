"""Pixels of photographs as rays to learn from: where they go, their colours and classes."""

import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Any

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from numpy.typing import NDArray
from torch import Tensor

from splatseg._check import check_shape, check_values
from splatseg.core import UNLABELLED, Camera, View
from splatseg.errors import InputError
from splatseg.io.atomic import named_write_failures
from splatseg.io.evidence import Evidence
from splatseg.io.images import DEFAULT_LONGEST, image_camera, load_image, load_mask
from splatseg.street.hits import MeshHits

Reader = Callable[[View], Tensor]
"""The photograph of a view as floats in [0, 1], (height, width, 3)."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrainingRays:
    """All pixels that are learnt from, view by view."""

    cameras: tuple[Camera, ...]
    """Of the views, for photographs as they were read."""

    view_starts: Int[Tensor, "v"]
    """Index of each view's first ray, int64; one more than there are views."""

    pixels: Int[Tensor, "n"]
    """Number of each ray's pixel in its photograph, row by row, int32."""

    colours: UInt8[Tensor, "n 3"]
    """sRGB."""

    columns: Int[Tensor, "n"]
    """Class of each ray as a column of the field's probabilities, int16, -1 none."""

    planes: Float[Tensor, "p 3"]
    """Unit directions of pixels in the axes of their camera, one lens after the other."""

    plane_starts: Int[Tensor, "v"]
    """Row of `planes` of each view's first pixel, int64."""

    rotations: Float[Tensor, "v 3 3"]
    """Of the axes of each view's camera into the world, float32."""

    def __len__(self) -> int:
        """How many rays there are."""
        return len(self.pixels)

    def directions(self, rays: Int[Tensor, "b"]) -> Float[Tensor, "b 3"]:
        """Unit world directions of some rays, float32."""
        views = torch.searchsorted(self.view_starts, rays, right=True) - 1
        rows = self.plane_starts[views] + self.pixels.index_select(0, rays)
        flat = self.planes.index_select(0, rows)
        return torch.einsum("bij,bj->bi", self.rotations[views], flat)

    def view_directions(self, view: int) -> Float[Tensor, "n 3"]:
        """Unit world directions of all rays of a view, float64."""
        camera = self.cameras[view]
        begin, end = self.view_starts[view : view + 2].tolist()
        numbers = self.pixels[begin:end].long()
        pixels = torch.stack((numbers % camera.width, numbers // camera.width), dim=1)
        return camera.rays(pixels.double() + 0.5)[1]


def training_rays(
    views: Sequence[View],
    evidence: Evidence | None,
    ids: Sequence[int],
    *,
    read: Reader | None = None,
) -> TrainingRays:
    """Read photographs, masks and label maps of views.

    Args:
        views: With photographs.
        evidence: Their label maps; views that it does not have teach colours alone.
        ids: Of the classes, in the order of the columns.
        read: Reads photographs; None takes those of the views.

    Raises:
        InputError: If there is no pixel to learn from, a label is not among the ids, or a
            photograph or label map is not what it should be.
    """
    parts = [_view_rays(view, evidence, ids, read=read) for view in views]
    cameras = tuple(image_camera(view, DEFAULT_LONGEST) for view in views)
    counts = torch.tensor([len(part.pixels) for part in parts])
    if not len(parts) or not int(counts.sum()):
        raise InputError(f"views: expected pixels to learn from, got none in {len(parts)} views.")
    planes, plane_starts = _planes(cameras)
    zero = torch.zeros(1, dtype=torch.int64)
    return TrainingRays(
        cameras=cameras,
        view_starts=torch.cat((zero, counts.cumsum(0))),
        pixels=torch.cat([part.pixels for part in parts]),
        colours=torch.cat([part.colours for part in parts]),
        columns=torch.cat([part.columns for part in parts]),
        planes=planes,
        plane_starts=plane_starts,
        rotations=torch.stack([camera.world_from_cam[:3, :3].float() for camera in cameras]),
    )


def label_ids(views: Sequence[View], evidence: Evidence) -> tuple[int, ...]:
    """Ids of classes of evidence, ascending: those of its table, else those in its maps."""
    if evidence.classes is not None:
        return tuple(sorted(row.id for row in evidence.classes.rows))
    found: set[int] = set()
    for view in views:
        if view.name in evidence.view_names:
            found |= set(torch.unique(evidence.label_map(view.name).ids).tolist())
    return tuple(sorted(found - {UNLABELLED}))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _ViewRays:
    pixels: Tensor
    colours: Tensor
    columns: Tensor


def _view_rays(
    view: View,
    evidence: Evidence | None,
    ids: Sequence[int],
    *,
    read: Reader | None,
) -> _ViewRays:
    photograph = _photograph(view, read)
    height, width = photograph.shape[:2]
    pixels = torch.arange(height * width, dtype=torch.int32)
    mask = load_mask(view, longest=DEFAULT_LONGEST)
    if mask is not None:
        pixels = pixels[mask.reshape(-1) > 0]
    columns = torch.full((len(pixels),), -1, dtype=torch.int16)
    if evidence is not None and view.name in evidence.view_names:
        columns = _columns(view, evidence, ids, height, width).reshape(-1)[pixels.long()]
    return _ViewRays(
        pixels=pixels,
        colours=photograph.reshape(-1, 3)[pixels.long()],
        columns=columns,
    )


def _photograph(view: View, read: Reader | None) -> UInt8[Tensor, "h w 3"]:
    if read is None:
        return load_image(view, longest=DEFAULT_LONGEST)
    given = read(view)
    camera = image_camera(view, DEFAULT_LONGEST)
    name = f"photograph of view {view.name!r}"
    check_shape(name, given, (camera.height, camera.width, 3))
    check_values(name, given, 0.0, 1.0)
    return (given.detach().cpu() * 255).round().to(torch.uint8)


def _columns(
    view: View, evidence: Evidence, ids: Sequence[int], height: int, width: int
) -> Int[Tensor, "h w"]:
    """Columns at the centres of pixels, from a label map of any size."""
    found = evidence.label_map(view.name).ids
    if tuple(found.shape) != (height, width):
        rows = ((torch.arange(height) + 0.5) * found.shape[0] / height).long()
        across = ((torch.arange(width) + 0.5) * found.shape[1] / width).long()
        found = found[rows[:, None], across]
    highest = max(max(ids), int(found.max()))
    table = torch.full((highest + 2,), -2, dtype=torch.int16)
    table[torch.tensor(list(ids))] = torch.arange(len(ids), dtype=torch.int16)
    table[-1] = -1
    columns = table[found.long()]
    unknown = found[columns == -2]
    if len(unknown):
        raise InputError(
            f"{evidence.folder}: expected ids of {tuple(ids)}, got {int(unknown[0])} in the label "
            f"map of view {view.name!r}."
        )
    return columns


def _planes(cameras: Sequence[Camera]) -> tuple[Tensor, Tensor]:
    """Directions of pixels of every distinct lens, and where those of each camera begin."""
    known: dict[object, int] = {}
    parts: list[Tensor] = []
    starts: list[int] = []
    size = 0
    for camera in cameras:
        numbers = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
        lens = (numbers, camera.model, camera.distortion)
        if lens not in known:
            known[lens] = size
            still = replace(camera, cam_from_world=torch.eye(4, dtype=torch.float64))
            parts.append(still.rays()[1].reshape(-1, 3).float())
            size += len(parts[-1])
        starts.append(known[lens])
    return torch.cat(parts), torch.tensor(starts)


def by_view(rays: TrainingRays) -> Iterator[tuple[Tensor, Tensor]]:
    """Origin and directions of the rays of each view in turn."""
    for view, camera in enumerate(rays.cameras):
        yield camera.centre, rays.view_directions(view)


_STEPS = 65535
_TYPES = {"counts": "u1", "faces": "<i4", "weights": "<u2"}
_SHAPES = {"counts": (), "faces": (), "weights": (2,)}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CachedHits:
    """Hits of all rays, one ray after the other: 8 bytes a hit, one a ray.

    A hit is the number of its triangle (int32) and two of its three weights (uint16, in steps of
    1/65535).
    """

    starts: Int[Tensor, "n"]
    """Index of each ray's first hit, int64; one more than there are rays."""

    faces: NDArray[np.int32]
    weights: NDArray[np.uint16]
    """(hits, 2)."""

    folder: Path | None = None
    """Temporary folder of the hits, if they are not in memory; `close` removes it."""

    @property
    def hits(self) -> int:
        """How many there are."""
        return len(self.faces)

    @property
    def nbytes(self) -> int:
        """Bytes of all hits."""
        return self.faces.nbytes + self.weights.nbytes

    def of(
        self, rays: Int[Tensor, "b"], width: int
    ) -> tuple[Int[Tensor, "s"], Int[Tensor, "s"], Float[Tensor, "s 3"]]:
        """The hits of some rays.

        Args:
            rays: Their numbers.
            width: The most hits that a ray has.

        Returns:
            Where each hit stands among ``len(rays) * width`` places, ray by ray; its triangle;
            its weights.
        """
        start, stop = self.starts[rays], self.starts[rays + 1]
        rank = torch.arange(width)
        places = ((start[:, None] + rank) < stop[:, None]).reshape(-1).nonzero()[:, 0]
        at = (start[places // width] + places % width).numpy()
        faces = torch.from_numpy(self.faces[at].astype(np.int64))
        two = torch.from_numpy(self.weights[at].astype(np.float32)) / _STEPS
        third = (1 - two[:, :1] - two[:, 1:]).clamp_min(0)
        return places, faces, torch.cat((two, third), dim=1)

    def close(self) -> None:
        """Remove the files."""
        if self.folder is not None:
            shutil.rmtree(self.folder, ignore_errors=True)


def cached_hits(parts: Iterable[MeshHits], *, memory: int) -> CachedHits:
    """Hits as they are found, in memory or, beyond `memory` bytes, in temporary files.

    Raises:
        OutputError: If the files cannot be written.
    """
    kept: dict[str, list[NDArray[Any]]] = {name: [] for name in _TYPES}
    size = 0
    with ExitStack() as stack:
        folder: Path | None = None
        files: dict[str, IO[bytes]] = {}
        for part in parts:
            packed = _packed(part)
            size += len(packed["counts"]) + 8 * len(packed["faces"])
            for name, array in packed.items():
                kept[name].append(array)
            if folder is None and size > memory:
                folder = Path(tempfile.mkdtemp(prefix="splatseg-hits-"))
                stack.callback(shutil.rmtree, folder, ignore_errors=True)
                stack.enter_context(named_write_failures(folder))
                files = {n: stack.enter_context((folder / n).open("wb")) for n in _TYPES}
            for name, file in files.items():
                for array in kept[name]:
                    file.write(array.tobytes())
                kept[name].clear()
        for file in files.values():
            file.close()
        found = {name: _whole(name, kept[name], folder) for name in _TYPES}
        stack.pop_all()
    starts = np.zeros(len(found["counts"]) + 1, dtype=np.int64)
    np.cumsum(found["counts"], out=starts[1:], dtype=np.int64)
    return CachedHits(
        starts=torch.from_numpy(starts),
        faces=found["faces"],
        weights=found["weights"],
        folder=folder,
    )


def _packed(hits: MeshHits) -> dict[str, NDArray[Any]]:
    valid = hits.valid
    two = (hits.weights[valid][:, :2].clamp(0, 1) * _STEPS).round()
    return {
        "counts": valid.sum(dim=1).numpy().astype(_TYPES["counts"]),
        "faces": hits.faces[valid].numpy().astype(_TYPES["faces"]),
        "weights": two.numpy().astype(_TYPES["weights"]),
    }


def _whole(name: str, parts: list[NDArray[Any]], folder: Path | None) -> NDArray[Any]:
    """One array of memory, or of a file whose pages are read when they are looked at."""
    empty = np.zeros((0, *_SHAPES[name]), _TYPES[name])
    if folder is None:
        return np.concatenate(parts) if parts else empty
    if not (folder / name).stat().st_size:
        return empty
    mapped = np.memmap(folder / name, dtype=_TYPES[name], mode="r")
    return mapped.reshape(-1, *_SHAPES[name])
