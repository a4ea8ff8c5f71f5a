"""Photographs, read upright and made smaller where asked; pictures and films, written.

A photograph is read as a person sees it: its EXIF orientation is applied, and a camera refers
to the pixels after that (see ``docs/conventions.md``). Films need the extra ``video``.
"""

import contextlib
import math
import os
import subprocess
from collections.abc import Iterable, Sequence
from itertools import chain
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO, Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from numpy.typing import NDArray
from PIL import Image, ImageOps
from torch import Tensor

from splatseg._check import check_shape
from splatseg.core import Camera, View
from splatseg.core.boundary import boundary
from splatseg.errors import (
    BackendError,
    FileFormatError,
    InputError,
    MissingFileError,
    RangeError,
    ShapeError,
    import_package,
)
from splatseg.io.atomic import atomic_file
from splatseg.io.foreign import expect, is_file, reading
from splatseg.io.limits import FREE, OPTION, check_unpacked

DEFAULT_LONGEST = 1600
"""Longest side, in pixels, that commands which read photographs work at unless told otherwise."""

IMAGE_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".bmp"})
"""Suffixes, in lower case, of the files that are taken for photographs."""

_EXIF_ORIENTATION = 0x0112
_BYTES_OF_PIXEL = 4
"""What Pillow takes for a colour, and we for a depth; grey and palettes become one of these."""

# Of the eight EXIF orientations, these four exchange rows and columns.
_TURNED = frozenset({5, 6, 7, 8})


@boundary
def find_images(folder: Path) -> tuple[Path, ...]:
    """Image files directly inside a folder, sorted by name; empty where there is no folder."""
    if not folder.is_dir():
        return ()
    return tuple(
        sorted(p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and p.is_file())
    )


@boundary
def image_size(path: Path) -> tuple[int, int]:
    """Width and height in pixels after the EXIF orientation, from the header alone.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it is not an image.
    """
    with open_image(path) as image:
        if image.format == "TIFF":
            # Some versions of Pillow turn TIFF files by themselves, others do not.
            return _upright(image, path).size
        width, height = image.size
        return (height, width) if _orientation(image, path) in _TURNED else (width, height)


@boundary
def reduced_size(width: int, height: int, longest: int | None) -> tuple[int, int]:
    """Width and height once the longest side is at most `longest`; never enlarged.

    Example:
        >>> reduced_size(4000, 3000, 1600)
        (1600, 1200)
        >>> reduced_size(512, 384, 1600)
        (512, 384)
    """
    if longest is None or max(width, height) <= longest:
        return width, height
    if longest < 1:
        raise InputError(f"longest: expected at least 1 pixel, got {longest}.")
    scale = longest / max(width, height)
    return max(1, math.floor(width * scale + 0.5)), max(1, math.floor(height * scale + 0.5))


@boundary
def same_shape(width: int, height: int, other_width: int, other_height: int) -> bool:
    """Whether a uniform scale leads from one size to another, up to one pixel of the other.

    Example:
        >>> same_shape(4032, 3024, 1600, 1200), same_shape(640, 480, 480, 640)
        (True, False)
    """
    return abs(other_width * height - other_height * width) <= max(width, height)


@boundary
def load_image(view: View, *, longest: int | None = None) -> UInt8[Tensor, "height width 3"]:
    """The photograph of a view, upright, 8 bit sRGB.

    Transparent pixels are blended over white, as the NeRF-synthetic scenes are by custom.

    Args:
        view: The view whose photograph to read.
        longest: Longest side in pixels; a larger photograph is reduced to it (area-weighted).
            None keeps every pixel. `image_camera` gives the camera of the result.

    Raises:
        InputError: If the view has no photograph.
        MissingFileError: If the photograph is not where it was.
        FileFormatError: If it cannot be decoded, or its size is not the camera's.
    """
    path = _photograph(view)
    with open_image(path) as image:
        pixels = _decode(image, path)
    _check_size(path, view, pixels.size)
    return torch.from_numpy(np.array(_reduced(pixels, *pixels.size, longest), dtype=np.uint8))


@boundary
def load_mask(view: View, *, longest: int | None = None) -> UInt8[Tensor, "height width"] | None:
    """The mask of a view as 0 (ignore) and 1 (use); None where the view has none.

    It may be of the photograph's size or a uniform scale of it, and is reduced with the
    photograph: a pixel that mixes both is one to ignore.

    Raises:
        MissingFileError: If the mask is not where it was.
        FileFormatError: If it cannot be decoded, or its shape is not the photograph's.
    """
    if view.mask is None:
        return None
    width, height = view.camera.width, view.camera.height
    grey = _grey(view.mask)
    what = f"{width}x{height} pixels as the photograph of view {view.name!r} has, or a uniform "
    what += f"scale of it, got {grey.shape[1]}x{grey.shape[0]}"
    expect(same_shape(width, height, grey.shape[1], grey.shape[0]), view.mask, what)
    used = Image.fromarray(np.where(grey > 0, 255, 0).astype(np.uint8))
    used = _reduced(used, width, height, longest)
    return torch.from_numpy((np.asarray(used) == 255).astype(np.uint8))


@boundary
def left_out_pixels(view: View, height: int, width: int) -> Bool[Tensor, "height width"] | None:
    """Which pixels of a map of a view its mask leaves out; None where the view has no mask.

    A pixel of the map takes the pixel of the mask that its centre falls into.

    Args:
        view: The view.
        height: Of the map, in any size.
        width: Likewise.

    Raises:
        MissingFileError: If the mask is not where it was.
        FileFormatError: If it cannot be decoded, or its shape is not the photograph's.
    """
    used = load_mask(view)
    if used is None:
        return None
    rows = ((torch.arange(height) + 0.5) * used.shape[0] / height).long()
    columns = ((torch.arange(width) + 0.5) * used.shape[1] / width).long()
    return used[rows][:, columns] == 0


@boundary
def load_alpha(view: View, *, longest: int | None = None) -> UInt8[Tensor, "height width"] | None:
    """How opaque each pixel of a view is, 0 to 255; None where the view does not say.

    The view's mask says it if there is one (a mask of zeros and ones counts as 0 and 255), else
    the alpha channel of its photograph. It is reduced with the photograph (area-weighted).

    Raises:
        InputError: If the view has no photograph.
        MissingFileError: If a file is not where it was.
        FileFormatError: If a file cannot be decoded, or its size is not the camera's.
    """
    if view.mask is not None:
        path = view.mask
        grey = _grey(path)
        if grey.dtype != np.uint8 or grey.max(initial=0) <= 1:
            grey = np.where(grey > 0, 255, 0).astype(np.uint8)
    else:
        path = _photograph(view)
        with open_image(path) as image:
            upright = _upright(image, path)
        if not _is_transparent(upright):
            return None
        with reading(path, "an image"):
            grey = np.asarray(upright.convert("RGBA"))[..., -1]
    _check_size(path, view, (grey.shape[1], grey.shape[0]))
    opaque = _reduced(Image.fromarray(grey), grey.shape[1], grey.shape[0], longest)
    return torch.from_numpy(np.array(opaque, dtype=np.uint8))


def _check_size(path: Path, view: View, size: tuple[int, int]) -> None:
    """Refuse an image of another size than the photograph of a view has."""
    camera = view.camera
    what = f"{camera.width}x{camera.height} pixels as the camera of view {view.name!r} has, got "
    what += f"{size[0]}x{size[1]}"
    expect(size == (camera.width, camera.height), path, what)


def _grey(path: Path) -> NDArray[Any]:
    """The pixels of a mask: its alpha, or the largest of its channels."""
    with open_image(path) as image:
        upright = _upright(image, path)
    with reading(path, "an image"):
        grey = np.asarray(upright)
    if upright.mode in ("RGBA", "LA"):
        grey = grey[..., -1]
    return grey.max(axis=2) if grey.ndim == 3 else grey


def _reduced(image: Image.Image, width: int, height: int, longest: int | None) -> Image.Image:
    """An image in the size that one of width x height is reduced to, area-weighted."""
    target = reduced_size(width, height, longest)
    return image if target == image.size else image.resize(target, Image.Resampling.BOX)


@boundary
def image_camera(view: View, longest: int | None = None) -> Camera:
    """The camera of the pixels that `load_image` returns for the same `longest`."""
    camera = view.camera
    target = reduced_size(camera.width, camera.height, longest)
    return camera if target == (camera.width, camera.height) else camera.resized(*target)


@boundary
def save_png(
    image: Int[Tensor, "height width *channels"]
    | UInt8[Tensor, "height width *channels"]
    | Float[Tensor, "height width *channels"],
    path: Path,
) -> None:
    """Write a picture: (H, W) grey, (H, W, 3) RGB or (H, W, 4) RGBA; atomic.

    Floats are taken as [0, 1], clamped and rounded to 8 bit; int32 and uint16 single-channel
    images are written with 16 bit and must fit.

    Raises:
        ShapeError: If the shape is none of these.
        InputError: If a value is NaN, or does not fit.
    """
    array = image.detach().cpu().numpy()
    if array.ndim == 3 and array.shape[2] == 1:
        array = array[..., 0]
    if not (array.ndim == 2 or (array.ndim == 3 and array.shape[2] in (3, 4))):
        raise ShapeError(f"image: expected (H, W), (H, W, 3) or (H, W, 4), got {array.shape}.")
    if array.size == 0:
        raise ShapeError(f"image: expected at least one pixel, got {array.shape}.")
    write_png(_to_integers(array), path)


@boundary
def write_png(array: NDArray[np.uint8] | NDArray[np.uint16], path: Path) -> None:
    """Write an 8 bit picture or a 16 bit single-channel one as it stands; atomic."""
    if array.ndim not in (2, 3) or not array.size:
        raise ShapeError(f"array: expected an image of at least a pixel, got {array.shape}.")
    with atomic_file(path) as temporary:
        Image.fromarray(array).save(temporary, format="PNG")


@boundary
def open_image(path: Path) -> Image.Image:
    """Open an image for reading, its pixels undecoded; the caller closes it.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it is not an image that Pillow reads, or far too large for its file.
    """
    try:
        with reading(path, "an image"):
            image = Image.open(path)
            size = path.stat().st_size
    except MissingFileError as error:
        raise MissingFileError(f"{path}: there is no such image.") from error
    except Image.DecompressionBombError as error:
        most = Image.MAX_IMAGE_PIXELS or 0
        raise FileFormatError(
            f"{path}: expected a picture of at most {2 * most} pixels, got more; if you trust it, "
            f"{OPTION} with a larger size than {FREE} bytes reads it."
        ) from error
    width, height = image.size
    what = f"a picture of {width}x{height} pixels"
    try:
        check_unpacked(path, width * height * _BYTES_OF_PIXEL, packed=size, what=what)
    except FileFormatError:
        image.close()
        raise
    return image


def _photograph(view: View) -> Path:
    if view.image is None:
        raise InputError(f"view {view.name!r}: expected a view with a photograph, got one without.")
    if not is_file(view.image):
        raise MissingFileError(
            f"{view.image}: the photograph of view {view.name!r} is not there; if the photographs "
            "moved, name their new folder with --data (data= in Python)."
        )
    return view.image


def _orientation(image: Image.Image, path: Path) -> int:
    # Image.getexif of a PNG decodes the whole picture unless the tag came before the pixels.
    if image.format == "PNG" and "exif" not in image.info:
        return 1
    with reading(path, "an image"):
        turned: object = image.getexif().get(_EXIF_ORIENTATION, 1)
    return turned if isinstance(turned, int) else 1


def _upright(image: Image.Image, path: Path) -> Image.Image:
    with reading(path, "an image"):
        return ImageOps.exif_transpose(image)


def _is_transparent(image: Image.Image) -> bool:
    return image.mode in ("RGBA", "LA", "PA") or "transparency" in image.info


def _decode(image: Image.Image, path: Path) -> Image.Image:
    upright = _upright(image, path)
    deep = upright.mode.startswith(("I", "F"))
    expect(not deep, path, f"a photograph of 8 bits a channel, got mode {upright.mode}")
    with reading(path, "an image"):
        if _is_transparent(upright):
            upright = upright.convert("RGBA")
            white = Image.new("RGBA", upright.size, (255, 255, 255, 255))
            return Image.alpha_composite(white, upright).convert("RGB")
        return upright.convert("RGB")


def _to_integers(array: NDArray[np.generic]) -> NDArray[np.uint8] | NDArray[np.uint16]:
    if np.issubdtype(array.dtype, np.floating):
        if np.isnan(array).any():
            raise InputError("image: expected values in [0, 1], got NaN.")
        return np.floor(np.clip(array, 0, 1).astype(np.float64) * 255 + 0.5).astype(np.uint8)
    if array.dtype == np.bool_:
        return np.where(array, 255, 0).astype(np.uint8)
    if array.dtype == np.uint8:
        return array.astype(np.uint8)
    if array.ndim != 2:
        raise InputError(f"image: expected uint8 or floats for colours, got {array.dtype}.")
    low, high = int(array.min()), int(array.max())
    if low < 0 or high > 65535:
        raise InputError(f"image: expected values in [0, 65535], got [{low}, {high}].")
    return array.astype(np.uint16)


# Constant rate factor: 18 is hardly told from the original.
_CRF = 18


@boundary
def write_video(
    frames: Iterable[UInt8[Tensor, "height width 3"]],
    path: str | os.PathLike[str],
    *,
    fps: float = 24.0,
) -> int:
    """Write pictures as an H.264 film that browsers play; gives the number of frames.

    The encoder halves the colours' resolution, so width and height must be even: an odd last
    row or column is left out. The file appears when the film is complete.

    Args:
        frames: sRGB pictures of one size. They are taken one by one and not kept.
        path: The file, ``.mp4``.
        fps: Frames a second.

    Raises:
        InputError: If there are no frames, or the name does not end in ``.mp4``.
        ShapeError: If sizes differ.
        RangeError: If `fps` is not positive, or a picture has less than two rows or columns.
        MissingPackageError: If imageio-ffmpeg is not installed.
    """
    if not str(path).lower().endswith(".mp4"):
        raise InputError(f"{path}: expected a name that ends in .mp4.")
    encoder = check_encoder(fps)
    rest = iter(frames)
    first = next(rest, None)
    if first is None:
        raise InputError("frames: expected at least one picture, got none.")
    check_shape("frames", first, (None, None, 3))
    height, width = first.shape[0] // 2 * 2, first.shape[1] // 2 * 2
    if not height or not width:
        raise RangeError(
            f"frames: expected at least 2x2 pixels, got {first.shape[1]}x{first.shape[0]}."
        )
    command = _command(encoder.get_ffmpeg_exe(), width, height, fps)
    with atomic_file(path) as temporary, TemporaryFile() as complaints:
        frame_bytes = (_bytes(frame, first.shape, height, width) for frame in chain((first,), rest))
        count = _fed([*command, str(temporary)], frame_bytes, complaints, path)
    return count


def _command(program: str, width: int, height: int, fps: float) -> list[str]:
    """The encoder's words, without the file: raw RGB comes in on the standard input."""
    source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", str(fps)]
    film = ["-c:v", "libx264", "-crf", str(_CRF), "-pix_fmt", "yuv420p"]
    # The table of contents comes first, so that a browser plays before it has everything.
    film += ["-movflags", "+faststart"]
    return [program, "-v", "error", "-y", *source, "-i", "-", *film]


def _fed(
    command: Sequence[str],
    frame_bytes: Iterable[bytes],
    complaints: IO[bytes],
    path: str | os.PathLike[str],
) -> int:
    """Run the encoder on pictures; gives their number.

    Raises:
        BackendError: If the encoder fails; the message has its last words.
    """
    count = 0
    # The words are ours, the program is that of the package, and there is no shell.
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stderr=complaints)  # noqa: S603
    try:
        pipe = process.stdin or contextlib.nullcontext()
        # An encoder that ended early says why by its status and words.
        with contextlib.suppress(BrokenPipeError), pipe as into:
            for one_frame in frame_bytes:
                if into is not None:
                    into.write(one_frame)
                count += 1
        process.wait()
    except BaseException:
        process.kill()
        process.wait()
        raise
    if process.returncode:
        complaints.seek(0)
        words = complaints.read().decode(errors="replace").strip().splitlines()
        reason = words[-1] if words else f"status {process.returncode}"
        raise BackendError(f"{path}: the video encoder failed: {reason}.")
    return count


def _bytes(frame: Tensor, shape: tuple[int, ...], height: int, width: int) -> bytes:
    check_shape("frames", frame, shape)
    return frame[:height, :width].contiguous().cpu().numpy().tobytes()


@boundary
def check_encoder(fps: float) -> Any:
    """The module that encodes, after a check that it can: for commands that film at their end.

    Raises:
        RangeError: If `fps` is not in (0, 1000).
        MissingPackageError: If imageio-ffmpeg is not installed.
    """
    if not 0 < fps < 1000:
        raise RangeError(f"fps: expected a number in (0, 1000), got {fps}.")
    return import_package("imageio_ffmpeg", "a film", "video")
