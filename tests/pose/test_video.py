"""Frames of videos: the sharpest of each interval."""

import subprocess
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from splatseg.errors import FileFormatError, InputError, MissingFileError, MissingPackageError
from splatseg.io.images import write_video
from splatseg.pose import PoseOptions, _video, is_video, recover_poses
from splatseg.pose._video import interval_of, sharpness, take_frames

SHARP = {2, 9, 10, 19}


@pytest.fixture(scope="module")
def film(room: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twenty frames; those named in SHARP are sharp, the others moved while they were taken."""
    path = tmp_path_factory.mktemp("film") / "film.MP4"
    pictures = []
    for i in range(20):
        picture = np.ascontiguousarray(room.pictures[i % 7][::2, ::2])
        if i not in SHARP:
            picture = cv2.GaussianBlur(picture, (0, 0), 3)
        pictures.append(torch.from_numpy(picture))
    write_video(pictures, path, fps=10)
    return path


def taken(film: Path, folder: Path, wanted: int) -> list[str]:
    told: list[tuple[int, int]] = []
    files = take_frames(film, folder, wanted=wanted, progress=lambda *now: told.append(now))
    assert told[-1] == (20, 20)
    assert list(files) == sorted(folder.iterdir())
    return [path.name for path in files]


def test_the_sharpest_frame_of_each_interval_is_taken(film: Path, tmp_path: Path) -> None:
    # Intervals of five: 0-4, 5-9, 10-14, 15-19.
    assert taken(film, tmp_path / "frames", 4) == [f"frame_{i:06d}.jpg" for i in sorted(SHARP)]
    with Image.open(tmp_path / "frames" / "frame_000009.jpg") as frame:
        assert frame.size == (240, 180)


def test_a_short_film_gives_all_its_frames(film: Path, tmp_path: Path) -> None:
    assert len(taken(film, tmp_path / "frames", 500)) == 20


def test_intervals_cover_all_frames_evenly() -> None:
    counts = np.bincount([interval_of(i, frames=103, wanted=10) for i in range(103)])
    assert len(counts) == 10
    assert counts.min() == 10
    assert counts.max() == 11


def test_sharpness_falls_with_blur_not_with_size(room: Any) -> None:
    picture = room.pictures[0]
    blurred = cv2.GaussianBlur(picture, (0, 0), 2)
    assert sharpness(picture) > 3 * sharpness(blurred) > 0
    doubled = cv2.resize(picture, None, fx=2, fy=2, interpolation=cv2.INTER_LINEAR)
    assert sharpness(doubled) == pytest.approx(sharpness(picture), rel=0.5)


def test_a_film_held_upright_gives_upright_frames(film: Path, tmp_path: Path) -> None:
    """Phones store what their sensor saw and how to turn it."""
    import imageio_ffmpeg

    turned = tmp_path / "turned.mp4"
    words = ["-v", "error", "-display_rotation", "90", "-i", str(film), "-c", "copy", str(turned)]
    subprocess.run([imageio_ffmpeg.get_ffmpeg_exe(), *words], check=True)
    files = take_frames(turned, tmp_path / "frames", wanted=4, progress=lambda *_: None)
    upright = take_frames(film, tmp_path / "flat", wanted=4, progress=lambda *_: None)
    with Image.open(files[0]) as frame, Image.open(upright[0]) as flat:
        assert frame.size == (180, 240)
        picture, other = np.asarray(frame, float), np.asarray(flat, float)
    assert min(np.abs(np.rot90(picture, k) - other).mean() for k in (1, 3)) < 3


def test_poses_of_a_film(room: Any, tmp_path: Path) -> None:
    film, kept = tmp_path / "walk.mp4", tmp_path / "capture"
    pictures = [torch.from_numpy(p) for p in room.pictures]
    blurred = [torch.from_numpy(cv2.GaussianBlur(p, (0, 0), 4)) for p in room.pictures]
    write_video([f for pair in zip(pictures, blurred, strict=True) for f in pair], film)
    options = PoseOptions(longest=480, frames=7, threads=1)
    with pytest.raises(InputError, match="expected a folder for the frames"):
        recover_poses(film, options=options)
    result = recover_poses(film, folder=kept, options=options)
    names = [f"frame_{2 * i:06d}" for i in range(7)]
    assert [view.name for view in result.capture.views] == names
    assert result.capture.path == kept
    room.check(result.capture, list(range(7)))
    (kept / "frames" / "mark.txt").write_text("kept")
    (kept / "frames" / "mark.txt").unlink()
    before = (kept / "frames" / f"{names[0]}.jpg").stat().st_mtime_ns
    assert recover_poses(film, folder=kept, options=options).reused
    assert (kept / "frames" / f"{names[0]}.jpg").stat().st_mtime_ns == before


def test_what_is_no_film_is_refused(
    tmp_path: Path, film: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert is_video(Path("a.MOV"))
    assert not is_video(Path("a.jpg"))
    broken = tmp_path / "broken.mp4"
    broken.write_bytes(b"no film" * 100)
    with pytest.raises(FileFormatError, match=r"broken\.mp4: cannot be read as a video"):
        recover_poses(broken, folder=tmp_path / "capture")
    assert not (tmp_path / "capture" / "frames").exists()
    with pytest.raises(MissingFileError, match="there is no such video"):
        recover_poses(tmp_path / "none.mp4", folder=tmp_path / "capture")
    monkeypatch.setattr(_video.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(MissingPackageError, match=r"pip install 'splatseg\[video\]'"):
        take_frames(film, tmp_path / "frames", wanted=3, progress=lambda *_: None)
