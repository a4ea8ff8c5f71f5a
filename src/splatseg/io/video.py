"""Films: pictures one after another as an mp4 file. Needs the extra ``video``."""

import contextlib
import os
import subprocess
from collections.abc import Iterable, Sequence
from itertools import chain
from tempfile import TemporaryFile
from typing import IO, Any

from jaxtyping import UInt8
from torch import Tensor

from splatseg._check import check_shape
from splatseg.core.boundary import boundary
from splatseg.errors import BackendError, InputError, MissingPackageError, RangeError
from splatseg.io.atomic import atomic_file

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
    try:
        import imageio_ffmpeg
    except ImportError as error:
        raise MissingPackageError(
            "a film needs a package that is not installed (imageio-ffmpeg). "
            "Try: pip install 'splatseg[video]'."
        ) from error
    return imageio_ffmpeg
