"""Photographs from a video: the sharpest frame of each of equal intervals."""

import importlib.util
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from splatseg.errors import FileFormatError, MissingFileError, MissingPackageError
from splatseg.io._atomic import atomic_folder

VIDEO_SUFFIXES = frozenset({".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v"})
"""Suffixes, in lower case, of the files that are taken for videos."""

# Sharpness is judged on pictures no larger than this: noise and the blocks of compression,
# which look sharp to a Laplacian, are finer.
_JUDGED = 480
_QUALITY = 95


def is_video(path: Path) -> bool:
    """Whether a path has the suffix of a video."""
    return path.suffix.lower() in VIDEO_SUFFIXES


def check_video(path: Path) -> None:
    """Raise unless there is such a file and the package that reads it.

    Raises:
        MissingFileError: If there is no such file.
        MissingPackageError: If imageio-ffmpeg is not installed.
    """
    if not path.is_file():
        raise MissingFileError(f"{path}: there is no such video.")
    if importlib.util.find_spec("imageio_ffmpeg") is None:
        raise MissingPackageError(
            "videos need a package that is not installed (imageio-ffmpeg); try: "
            "pip install 'splatseg[video]'."
        )


def sharpness(picture: NDArray[np.uint8]) -> float:
    """Variance of the Laplacian of a picture's grey values: large where edges are sharp.

    References:
        Pech-Pacheco et al., Diatom autofocusing in brightfield microscopy, ICPR 2000.
    """
    import cv2

    grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
    scale = _JUDGED / max(grey.shape)
    if scale < 1:
        size = (max(1, round(grey.shape[1] * scale)), max(1, round(grey.shape[0] * scale)))
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    return float(cv2.Laplacian(grey, cv2.CV_64F).var())


def interval_of(index: int, *, frames: int, wanted: int) -> int:
    """Which of `wanted` equal intervals of `frames` frames a frame lies in.

    Example:
        >>> [interval_of(i, frames=5, wanted=2) for i in range(5)]
        [0, 0, 0, 1, 1]
    """
    return index * min(wanted, frames) // frames


def take_frames(
    video: Path, folder: Path, *, wanted: int, progress: Callable[[int, int], None]
) -> tuple[Path, ...]:
    """Write the sharpest frame of each interval as ``frame_NNNNNN.jpg``; all or none.

    Frames are upright, as a player shows them.

    Args:
        video: The file.
        folder: Where the frames go; replaced.
        wanted: How many intervals; a video of fewer frames gives all of them.
        progress: Told how many frames were looked at, and how many there are.

    Raises:
        MissingPackageError: If imageio and its ffmpeg are not installed.
        MissingFileError: If there is no such file.
        FileFormatError: If it is not a video that ffmpeg reads.
    """
    check_video(video)
    count = _count(video)
    folder.parent.mkdir(parents=True, exist_ok=True)
    with atomic_folder(folder) as temporary:
        best: tuple[float, int, NDArray[np.uint8]] | None = None
        current = 0
        for i, picture in enumerate(_frames(video)):
            # The count comes from the packets; a decoder may give a frame more or less.
            interval = interval_of(min(i, count - 1), frames=count, wanted=wanted)
            if interval != current and best is not None:
                _save(best, temporary)
                best = None
            current = interval
            score = sharpness(picture)
            if best is None or score > best[0]:
                best = (score, i, picture)
            progress(min(i + 1, count), count)
        if best is None:
            raise FileFormatError(f"{video}: expected a video, got one without frames.")
        _save(best, temporary)
    return tuple(sorted(folder.iterdir()))


def _save(best: tuple[float, int, NDArray[np.uint8]], folder: Path) -> None:
    _, index, picture = best
    Image.fromarray(picture).save(
        folder / f"frame_{index:06d}.jpg", quality=_QUALITY, subsampling=0
    )


def _count(video: Path) -> int:
    import imageio_ffmpeg

    try:
        count, _ = imageio_ffmpeg.count_frames_and_secs(str(video))
    except (RuntimeError, OSError) as error:
        raise FileFormatError(f"{video}: cannot be read as a video ({_first(error)}).") from error
    if not count:
        raise FileFormatError(f"{video}: expected a video, got a file without frames.")
    return int(count)


def _frames(video: Path) -> Iterator[NDArray[np.uint8]]:
    """Frames as (height, width, 3), in order."""
    import imageio_ffmpeg

    reader = cast("Any", imageio_ffmpeg.read_frames(str(video)))
    try:
        about = next(reader)
        width, height = about["size"]
        for data in reader:
            yield np.frombuffer(data, np.uint8).reshape(height, width, 3)
    except (RuntimeError, OSError, ValueError, StopIteration) as error:
        raise FileFormatError(f"{video}: cannot be read as a video ({_first(error)}).") from error
    finally:
        reader.close()


def _first(error: Exception) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[-1] if lines else type(error).__name__
