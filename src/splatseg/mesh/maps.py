"""What views show, as maps on disk: depth, ids and colour of each view, rendered once."""

import tempfile
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int32, UInt8
from torch import Tensor

from splatseg._check import check_shape
from splatseg.core import Camera, Gaussians, Labels, View
from splatseg.core.boundary import boundary
from splatseg.errors import InputError
from splatseg.io.arrays import read_npy
from splatseg.lift.label_maps import view_label_map
from splatseg.render import prepare
from splatseg.render.warp import undistorted_camera

_LONGEST = 1280
"""Longest side of the maps, pixels: at a resolution of 128 voxels more is not seen in the mesh."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ViewMaps:
    """What a view shows in each pixel."""

    camera: Camera
    """Of the maps' pixels, without distortion."""

    depth: Float[Tensor, "height width"]
    """z-depth of the surface, scene units, float32; 0 where there is none."""

    ids: Int32[Tensor, "height width"]
    """The object that is seen, -1 for none."""

    colour: UInt8[Tensor, "height width 3"]
    """sRGB as it is rendered."""

    def __post_init__(self) -> None:
        if not self.camera.is_pinhole:
            raise InputError("camera: expected one without distortion.")
        size = (self.camera.height, self.camera.width)
        check_shape("depth", self.depth, size)
        check_shape("ids", self.ids, size)
        check_shape("colour", self.colour, (*size, 3))

    @property
    def counts(self) -> dict[int, int]:
        """Pixels that show each object."""
        ids, counts = torch.unique(self.ids[self.ids >= 0], return_counts=True)
        return dict(zip(ids.tolist(), counts.tolist(), strict=True))


@boundary
def render_maps(
    gaussians: Gaussians, labels: Labels, view: View, *, backend: str = "auto"
) -> ViewMaps:
    """Render what a view shows: the median depth, the label map and the colour.

    The camera is the view's without its lens; where the longest side is above 1280 pixels, the
    maps are reduced to that.

    Args:
        gaussians: The Gaussians of the scene.
        labels: Their objects.
        view: The view.
        backend: Name of the rendering backend.
    """
    camera = undistorted_camera(view.camera)
    share = min(1.0, _LONGEST / max(camera.width, camera.height))
    if share < 1:
        size = (max(1, round(side * share)) for side in (camera.width, camera.height))
        camera = camera.resized(*size)
    with prepare(gaussians, camera, backend=backend) as prepared, torch.no_grad():
        rendered = prepared.render()
        ids = view_label_map(prepared, labels).ids
    return ViewMaps(
        camera=camera,
        depth=rendered.median_depth.float().cpu(),
        ids=ids.to(torch.int32).cpu(),
        colour=(rendered.image.cpu().clamp(0, 1) * 255).round().to(torch.uint8),
    )


class MapStore:
    """Maps of many views in a temporary file, of which only what is read lies in memory.

    `map_store` makes it; the file goes when the context ends.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._cameras: list[Camera] = []
        self._counts: list[dict[int, int]] = []

    def __len__(self) -> int:
        return len(self._cameras)

    def add(self, maps: ViewMaps) -> None:
        """Keep the maps of one more view."""
        for name, dtype in _DTYPES.items():
            values = getattr(maps, name).numpy().astype(dtype, copy=False)
            np.save(self._path(len(self), name), np.ascontiguousarray(values))
        self._counts.append(maps.counts)
        self._cameras.append(maps.camera)

    def __getitem__(self, index: int) -> ViewMaps:
        camera = self._cameras[index]
        maps: dict[str, Tensor] = {
            name: torch.from_numpy(read_npy(self._path(index, name), mapped=True))
            for name in _DTYPES
        }
        return ViewMaps(camera=camera, **maps)

    def pixels_of(self, id: int) -> Sequence[int]:
        """How many pixels of each view show an object."""
        return [counts.get(id, 0) for counts in self._counts]

    @property
    def cameras(self) -> Sequence[Camera]:
        """Those of the maps."""
        return tuple(self._cameras)

    def _path(self, index: int, name: str) -> Path:
        return self._folder / f"{index}.{name}.npy"


_DTYPES = {"depth": np.float32, "ids": np.int32, "colour": np.uint8}


@contextmanager
def map_store() -> Generator[MapStore]:
    """An empty store, whose files lie in the folder for temporary files and go with it."""
    with tempfile.TemporaryDirectory(prefix="splatseg-maps-") as folder:
        yield MapStore(Path(folder))
