"""Lens models that pycolmap knows and we do not, as the nearest lens that we have.

pycolmap maps pixels of a grid to rays, and a lens of the family ``thin_prism_fisheye`` that maps
the same rays to the same pixels is found by linear least squares. It runs in a process of its own:
loaded beside Pillow, its libraries corrupt memory.
"""

import importlib.util
import json
import subprocess
import sys

import numpy as np
from numpy.typing import NDArray

from splatseg.errors import InputError, MissingPackageError, quoted, reason
from splatseg.io.captures.raw_views import Intrinsics
from splatseg.io.foreign import expect
from splatseg.io.json_files import parse_object

WORST = 0.5
"""Pixels that the lens may be off anywhere in the picture."""

_ONE_FOCAL = ("SIMPLE_DIVISION",)
_GRID = 41
_SECONDS = 120
_PROGRAM = """
import json, sys
import numpy, pycolmap
told = json.load(sys.stdin)
camera = pycolmap.Camera(**told["camera"])
pixels = numpy.array(told["pixels"])
plane = numpy.array(camera.cam_from_img(pixels), float).reshape(-1, 2)
sound = numpy.isfinite(plane).all(axis=1)
rays = numpy.concatenate([numpy.where(sound[:, None], plane, 0), numpy.ones((len(plane), 1))], 1)
back = numpy.array(camera.img_from_cam(rays), float).reshape(-1, 2)
sound &= numpy.isfinite(back).all(axis=1) & (numpy.abs(back - pixels).max(axis=1) < 0.01)
plane[~sound] = 0
json.dump({"plane": plane.tolist(), "sound": sound.tolist()}, sys.stdout)
"""


def lens_by_pycolmap(
    model: str, width: int, height: int, parameters: tuple[float, ...], *, where: str
) -> Intrinsics:
    """The lens of a COLMAP camera of a model that is not ours.

    Raises:
        MissingPackageError: If pycolmap is not installed.
        InputError: If pycolmap does not know it either, or no lens of ours is within `WORST`
            pixels of it.
    """
    if importlib.util.find_spec("pycolmap") is None:
        raise MissingPackageError(
            f"{where}: a {quoted(model)} lens needs a package that is not installed (pycolmap): "
            "pip install 'splatseg[sfm]', or undistort the photographs with COLMAP."
        )
    x, y = np.meshgrid(np.linspace(0, width, _GRID), np.linspace(0, height, _GRID))
    pixels = np.stack([x.ravel(), y.ravel()], axis=1)
    plane = _plane(model, width, height, parameters, pixels, where=where)
    sound = np.isfinite(plane[:, 0])
    # Where a model has two focal lengths, they are its first two parameters.
    ratio = parameters[0] / parameters[1] if model not in _ONE_FOCAL and parameters[1] else 1.0
    ratio = ratio if 1e-3 < ratio < 1e3 else 1.0
    lens, error = _fitted(plane[sound], pixels[sound], (width, height), ratio=ratio)
    what = f"a lens that is within {WORST:g} pixels of one that can be undistorted, got "
    what += f"{quoted(model)}, which is {error:.3g} off or sees beyond 90 degrees from its axis; "
    what += "undistort the photographs with COLMAP"
    expect(sound.mean() > 0.5 and error <= WORST, where, what, error=InputError)
    return lens


def _plane(
    model: str,
    width: int,
    height: int,
    parameters: tuple[float, ...],
    pixels: NDArray[np.float64],
    *,
    where: str,
) -> NDArray[np.float64]:
    """Points of the normalised plane by pixel, by pycolmap; NaN where there is none."""
    camera = {"model": model, "width": width, "height": height, "params": list(parameters)}
    words = json.dumps({"camera": camera, "pixels": pixels.tolist()})
    try:
        run = subprocess.run(  # noqa: S603  (our own program and interpreter)
            [sys.executable, "-c", _PROGRAM],
            input=words,
            capture_output=True,
            text=True,
            check=True,
            timeout=_SECONDS,
        )
    except (subprocess.SubprocessError, OSError) as error:
        said = getattr(error, "stderr", None) or str(error)
        line = next((line for line in reversed(str(said).splitlines()) if line.strip()), "")
        raise InputError(
            f"{where}: pycolmap cannot undistort a {quoted(model)} lens "
            f"({reason(ValueError(line))})."
        ) from error
    told = parse_object(run.stdout, where=f"{where}: rays of pycolmap")
    plane = np.array(told["plane"], np.float64)
    plane[~np.array(told["sound"], bool)] = np.nan
    return plane


def _fitted(
    plane: NDArray[np.float64], pixels: NDArray[np.float64], size: tuple[int, int], *, ratio: float
) -> tuple[Intrinsics, float]:
    """The lens of `core.lenses` nearest to these pixels, and pixels it is off at most.

    With (u, v) the equidistant coordinates, the pixel is linear in f, f k, f p, f s and the
    principal point, where ``ratio`` = fx / fy is known and pixels down are multiplied by it.
    """
    radius = np.linalg.norm(plane, axis=1)
    factor = np.where(radius > 1e-12, np.arctan(radius) / np.maximum(radius, 1e-12), 1.0)
    u, v = plane[:, 0] * factor, plane[:, 1] * factor
    r2 = u * u + v * v
    zero, one = np.zeros_like(u), np.ones_like(u)
    powers = [r2**i for i in range(5)]
    across = [u * p for p in powers]
    down = [v * p for p in powers]
    of_x = np.stack([*across, 2 * u * v, r2 + 2 * u * u, r2, zero, one, zero], axis=1)
    of_y = np.stack([*down, r2 + 2 * v * v, 2 * u * v, zero, r2, zero, one], axis=1)
    system = np.concatenate([of_x, of_y])
    target = np.concatenate([pixels[:, 0], pixels[:, 1] * ratio])
    if len(target) < system.shape[1]:
        return Intrinsics(focal=(1, 1), centre=(0, 0), size=size), float("inf")
    # Columns of one length, so that high powers of small angles count.
    lengths = np.maximum(np.linalg.norm(system, axis=0), 1e-300)
    found = np.linalg.lstsq(system / lengths, target, rcond=1e-12)[0] / lengths
    off = np.abs(system @ found - target).reshape(2, -1) / [[1.0], [ratio]]
    error = float(off.max())
    focal = float(found[0])
    k1, k2, k3, k4, p1, p2, s1, s2 = (float(value) / focal for value in found[1:9])
    return Intrinsics(
        model="thin_prism_fisheye",
        focal=(focal, focal / ratio),
        centre=(float(found[9]), float(found[10]) / ratio),
        distortion=(k1, k2, p1, p2, k3, k4, s1, s2),
        size=size,
    ), error
