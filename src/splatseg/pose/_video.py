"""Photographs from a video: the sharpest frame of each of equal intervals."""

import importlib.util
import subprocess
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO, cast

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from splatseg.core.boundary import boundary
from splatseg.errors import FileFormatError, MissingFileError, MissingPackageError
from splatseg.io.atomic import atomic_folder

VIDEO_SUFFIXES = frozenset({".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v"})
"""Suffixes, in lower case, of the files that are taken for videos."""

# Sharpness is judged on images no larger than this: noise and the blocks of compression,
# which look sharp to a Laplacian, are finer.
_JUDGED = 480
_QUALITY = 95


@boundary
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


def sharpness(frame: NDArray[np.uint8]) -> float:
    """Variance of the Laplacian of a image's grey values: large where edges are sharp.

    References:
        Pech-Pacheco et al., Diatom autofocusing in brightfield microscopy, ICPR 2000.
    """
    import cv2

    grey = cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY)
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
        for i, frame in enumerate(_frames(video)):
            # The count comes from the packets; a decoder may give a frame more or less.
            interval = interval_of(min(i, count - 1), frames=count, wanted=wanted)
            if interval != current and best is not None:
                _save(best, temporary)
                best = None
            current = interval
            score = sharpness(frame)
            if best is None or score > best[0]:
                best = (score, i, frame)
            progress(min(i + 1, count), count)
        if best is None:
            raise FileFormatError(f"{video}: expected a video, got one without frames.")
        _save(best, temporary)
    return tuple(sorted(folder.iterdir()))


def _save(best: tuple[float, int, NDArray[np.uint8]], folder: Path) -> None:
    _, index, frame = best
    Image.fromarray(frame).save(folder / f"frame_{index:06d}.jpg", quality=_QUALITY, subsampling=0)


def _count(video: Path) -> int:
    """Frames of a video, from its packets alone."""
    # A line a packet; -progress counts the frames of a copy in some versions of ffmpeg only.
    words = ["-map", "0:v:0", "-c", "copy", "-f", "framecrc", "-"]
    with _ffmpeg(video, words) as output:
        count = sum(not line.startswith(b"#") for line in output)
    if not count:
        raise FileFormatError(f"{video}: expected a video, got a file without frames.")
    return count


def _frames(video: Path) -> Iterator[NDArray[np.uint8]]:
    """Frames as (height, width, 3), in order, turned as the file asks."""
    words = ["-map", "0:v:0", "-fps_mode", "passthrough", "-f", "image2pipe", "-c:v", "ppm", "-"]
    with _ffmpeg(video, words) as stream:
        # Each is a PPM file: P6, width and height, 255, the pixels.
        while stream.readline() == b"P6\n":
            width, height = (int(word) for word in stream.readline().split())
            stream.readline()
            data = stream.read(width * height * 3)
            if len(data) < width * height * 3:
                return
            yield np.frombuffer(data, np.uint8).reshape(height, width, 3)


@contextmanager
def _ffmpeg(video: Path, words: Sequence[str]) -> Generator[IO[bytes]]:
    """What ffmpeg writes when it reads a video; it is ended when the block ends.

    Raises:
        FileFormatError: If ffmpeg fails; the message has its last words.
    """
    import imageio_ffmpeg

    program = imageio_ffmpeg.get_ffmpeg_exe()
    command = [program, "-v", "error", "-nostdin", "-i", str(video), *words]
    with TemporaryFile() as complaints:
        # The words are ours, the program is that of the package, and there is no shell.
        process = subprocess.Popen(  # noqa: S603
            command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=complaints
        )
        try:
            yield cast("IO[bytes]", process.stdout)
            status = process.wait()
        finally:
            process.kill()
            process.wait()
            if process.stdout is not None:
                process.stdout.close()
        if status:
            complaints.seek(0)
            output = complaints.read().decode(errors="replace").strip().splitlines()
            reason = output[-1].removeprefix(f"{video}: ") if output else f"status {status}"
            raise FileFormatError(f"{video}: cannot be read as a video ({reason}).")
