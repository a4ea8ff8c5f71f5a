"""A reconstruction of pycolmap: judged, freed of what is doubtful, and scaled to photographs.

Part of the process that works with pycolmap; see `splatseg.pose._worker`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pycolmap

# A photograph that sees fewer of the points than this has no pose worth keeping.
_MIN_POINTS = 12
# Where the lens model folds over within this factor of the corner, it is given up.
_FOLD_MARGIN = 1.1
# Extent of the cameras (10th to 90th percentile) in the world that is written.
_EXTENT = 10.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Model:
    """What one mapper made: its largest model, and the smaller ones."""

    mapper: str
    reconstructions: tuple[Any, ...]
    """The largest first."""

    registered: int
    error: float
    """Mean reprojection error of the largest, pixels of the working copies."""

    seconds: float

    @staticmethod
    def of(mapper: str, found: Sequence[Any], seconds: float) -> "Model":
        """The result of a mapper, without photographs that see too few points."""
        for reconstruction in found:
            _drop_doubtful(reconstruction)
        kept = [r for r in found if r.num_reg_images() >= 2 and r.num_points3D() > 0]
        kept.sort(key=lambda r: (-r.num_reg_images(), r.compute_mean_reprojection_error()))
        if not kept:
            return Model(
                mapper=mapper, reconstructions=(), registered=0, error=0.0, seconds=seconds
            )
        return Model(
            mapper=mapper,
            reconstructions=tuple(kept),
            registered=int(kept[0].num_reg_images()),
            error=float(kept[0].compute_mean_reprojection_error()),
            seconds=seconds,
        )

    def facts(self) -> dict[str, Any]:
        """In values that JSON holds."""
        return {
            "mapper": self.mapper,
            "registered": self.registered,
            "error": self.error,
            "points": int(self.reconstructions[0].num_points3D()) if self.registered else 0,
            "models": [int(r.num_reg_images()) for r in self.reconstructions],
            "seconds": self.seconds,
        }


def model_facts(reconstruction: Any) -> dict[str, Any]:
    """Points, errors and lenses, before the model is scaled to the photographs."""
    return {
        "points": int(reconstruction.num_points3D()),
        "error": float(reconstruction.compute_mean_reprojection_error()),
        "track_length": float(reconstruction.compute_mean_track_length()),
        "observations": {
            reconstruction.image(id).name: int(reconstruction.image(id).num_points3D)
            for id in reconstruction.reg_image_ids()
        },
    }


def finish_model(
    reconstruction: Any, lenses: Sequence[Mapping[str, Any]], *, threads: int
) -> list[int]:
    """Scale a model to the photographs' own pixels and names, and the world to a usual size.

    Each axis is scaled by its own ratio, which makes OPENCV of SIMPLE_RADIAL. Pixel centres are
    at halves in COLMAP as in splatseg, so nothing is shifted.

    Returns:
        Indices, in `lenses`, of those whose distortion was given up since it folded over.
    """
    of_image = {name: i for i, lens in enumerate(lenses) for name in lens["images"]}
    ids = list(reconstruction.reg_image_ids())
    lens_of = {
        reconstruction.image(id).camera_id: of_image[reconstruction.image(id).name] for id in ids
    }
    without_distortion = [id for id in lens_of if _folds(reconstruction.camera(id))]
    if without_distortion:
        _remove_distortion(reconstruction, without_distortion, threads)
    reconstruction.normalize(extent=_EXTENT)
    for id in ids:
        image = reconstruction.image(id)
        lens = lenses[of_image[image.name]]
        scale = np.array([lens["full_width"] / lens["width"], lens["full_height"] / lens["height"]])
        for point in image.points2D:
            point.xy = point.xy * scale
        image.name = lens["images"][image.name]
    for camera_id, index in lens_of.items():
        _scale_camera(reconstruction.camera(camera_id), lenses[index])
    return sorted(lens_of[id] for id in without_distortion)


def _drop_doubtful(reconstruction: Any) -> None:
    """Take out photographs that see too few points."""
    for id in list(reconstruction.reg_image_ids()):
        image = reconstruction.image(id)
        if image.num_points3D < _MIN_POINTS:
            reconstruction.deregister_frame(image.frame_id)


def _scale_camera(camera: Any, lens: Mapping[str, Any]) -> None:
    focal, cx, cy, k1 = (float(v) for v in camera.params)
    sx = lens["full_width"] / lens["width"]
    sy = lens["full_height"] / lens["height"]
    camera.model = pycolmap.CameraModelId.OPENCV
    camera.width, camera.height = lens["full_width"], lens["full_height"]
    camera.params = [focal * sx, focal * sy, cx * sx, cy * sy, k1, 0.0, 0.0, 0.0]


def _folds(camera: Any) -> bool:
    r"""Whether r (1 + k r^2) has its maximum inside the image, so that it has no inverse.

    The maximum lies at r = 1 / sqrt(-3 k) and is 2/3 of that.
    """
    focal, cx, cy, k1 = (float(v) for v in camera.params)
    if k1 >= 0:
        return False
    corner = np.hypot(max(cx, camera.width - cx), max(cy, camera.height - cy)) / focal
    return bool(2.0 / 3.0 / np.sqrt(-3.0 * k1) < _FOLD_MARGIN * corner)


def _remove_distortion(reconstruction: Any, camera_ids: Sequence[int], threads: int) -> None:
    """Give up the distortion of lenses and fit everything else to that."""
    for id in camera_ids:
        camera = reconstruction.camera(id)
        camera.params = [*(float(v) for v in camera.params[:3]), 0.0]
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_extra_params = False
    options.ceres.solver_options.num_threads = threads
    pycolmap.bundle_adjustment(reconstruction, options)
