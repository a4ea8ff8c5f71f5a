"""Films: the file plays back as what went in, and nothing half-written stays."""

import re
import subprocess
import sys
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
import torch

from splatseg.errors import BackendError, InputError, MissingPackageError, RangeError, ShapeError
from splatseg.io.images import write_video


def frame(level: int, height: int = 48, width: int = 64) -> torch.Tensor:
    """Grey above, red below; flat areas come through compression nearly unchanged."""
    out = torch.full((height, width, 3), level, dtype=torch.uint8)
    out[height // 2 :] = torch.tensor([200, 30, 30], dtype=torch.uint8)
    return out


def read(path: Path) -> tuple[str, np.ndarray]:
    """What ffmpeg says of a film, and its frames (n, height, width, 3)."""
    program = imageio_ffmpeg.get_ffmpeg_exe()
    about = subprocess.run([program, "-i", path], capture_output=True, text=True).stderr
    width, height = map(int, re.search(r"Video: .*?, (\d+)x(\d+)", about).groups())
    words = [program, "-v", "error", "-i", path, "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    raw = subprocess.run(words, capture_output=True, check=True).stdout
    return about, np.frombuffer(raw, np.uint8).reshape(-1, height, width, 3)


def test_what_goes_in_comes_out(tmp_path) -> None:
    levels = [20, 80, 140, 200, 250, 100, 60]
    assert write_video((frame(level) for level in levels), tmp_path / "a.mp4", fps=7) == 7
    about, back = read(tmp_path / "a.mp4")
    assert "7 fps" in about
    assert "h264" in about
    assert "yuv420p" in about
    assert len(back) == 7
    for level, picture in zip(levels, back, strict=True):
        assert np.abs(picture[:20].astype(int) - level).mean() < 4
        assert np.abs(picture[28:].astype(int) - [200, 30, 30]).mean() < 6
    assert [path.name for path in tmp_path.iterdir()] == ["a.mp4"]


def test_an_odd_row_and_column_are_left_out(tmp_path) -> None:
    write_video([frame(90, 49, 65)] * 3, tmp_path / "odd.mp4")
    about, back = read(tmp_path / "odd.mp4")
    assert back.shape == (3, 48, 64, 3)
    assert "24 fps" in about


def test_a_failure_leaves_nothing(tmp_path) -> None:
    def frames():
        yield frame(1)
        yield frame(1, 48, 66)

    with pytest.raises(ShapeError, match="frames"):
        write_video(frames(), tmp_path / "a.mp4")
    assert not list(tmp_path.iterdir())


def test_refusals(tmp_path, monkeypatch) -> None:
    with pytest.raises(InputError, match="at least one picture"):
        write_video([], tmp_path / "a.mp4")
    with pytest.raises(InputError, match="ends in .mp4"):
        write_video([frame(1)], tmp_path / "a.gif")
    with pytest.raises(RangeError, match="fps"):
        write_video([frame(1)], tmp_path / "a.mp4", fps=0)
    with pytest.raises(RangeError, match="2x2"):
        write_video([frame(1, 48, 1)], tmp_path / "a.mp4")
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(MissingPackageError, match=r"splatseg\[video\]"):
        write_video([frame(1)], tmp_path / "a.mp4")


def test_the_encoders_own_words(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("splatseg.io.images._CRF", "best")
    with pytest.raises(BackendError, match=r"a.mp4: the video encoder failed: .*"):
        write_video((frame(i % 200) for i in range(300)), tmp_path / "a.mp4")
    assert not list(tmp_path.iterdir())
