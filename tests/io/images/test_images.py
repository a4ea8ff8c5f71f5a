"""Photographs: upright, reduced, and refused where they cannot be; images written."""

import re
import subprocess
import sys
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
import torch
from PIL import Image

from splatseg.core import Camera, View
from splatseg.errors import (
    BackendError,
    FileFormatError,
    InputError,
    MissingFileError,
    MissingPackageError,
    RangeError,
    ShapeError,
)
from splatseg.io.images import (
    image_camera,
    image_size,
    load_image,
    load_mask,
    reduced_size,
    save_png,
    write_video,
)

WIDTH, HEIGHT = 6, 4


def view_of(path, width=WIDTH, height=HEIGHT, **more) -> View:
    camera = Camera(
        width=width,
        height=height,
        fx=10,
        fy=11,
        cx=width / 2,
        cy=height / 2,
        cam_from_world=torch.eye(4, dtype=torch.float64),
    )
    return View(name="v", camera=camera, image=path, **more)


@pytest.fixture
def pixels(rng) -> np.ndarray:
    return rng.integers(0, 256, (HEIGHT, WIDTH, 3)).astype(np.uint8)


# What a person does to the stored image to see it upright, by EXIF orientation.
UPRIGHT = {
    1: lambda a: a,
    2: lambda a: a[:, ::-1],
    3: lambda a: a[::-1, ::-1],
    4: lambda a: a[::-1],
    5: lambda a: a.transpose(1, 0, 2),
    6: lambda a: np.rot90(a, -1),
    7: lambda a: a[::-1, ::-1].transpose(1, 0, 2),
    8: lambda a: np.rot90(a, 1),
}


@pytest.mark.parametrize("orientation", UPRIGHT)
@pytest.mark.parametrize("suffix", ["png", "tif"])
def test_exif_orientation_is_applied(tmp_path, pixels, orientation, suffix) -> None:
    path = tmp_path / f"a.{suffix}"
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(pixels).save(path, exif=exif)
    expected = UPRIGHT[orientation](pixels)
    height, width = expected.shape[:2]
    assert image_size(path) == (width, height)
    image = load_image(view_of(path, width, height))
    np.testing.assert_array_equal(image, expected)


def test_a_camera_of_the_unturned_pixels_is_refused(tmp_path, pixels) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(pixels).save(tmp_path / "a.png", exif=exif)
    with pytest.raises(FileFormatError, match=r"expected 6x4 pixels .* got 4x6"):
        load_image(view_of(tmp_path / "a.png"))


@pytest.mark.parametrize(
    ("size", "longest", "expected"),
    [
        ((4000, 3000), 1600, (1600, 1200)),
        ((3000, 4000), 1600, (1200, 1600)),
        ((1600, 900), 1600, (1600, 900)),
        ((1601, 900), 1600, (1600, 899)),
        ((512, 384), 1600, (512, 384)),
        ((4000, 3000), None, (4000, 3000)),
        ((5000, 1), 100, (100, 1)),
    ],
)
def test_reduced_size(size, longest, expected) -> None:
    assert reduced_size(*size, longest) == expected


def test_a_reduced_photograph_is_the_mean_of_its_pixels_and_has_its_camera(tmp_path) -> None:
    pixels = np.arange(8 * 8, dtype=np.uint8).reshape(8, 8)
    Image.fromarray(np.stack([pixels] * 3, axis=2)).save(tmp_path / "a.png")
    view = view_of(tmp_path / "a.png", 8, 8)
    image = load_image(view, longest=4)
    means = pixels.reshape(4, 2, 4, 2).mean(axis=(1, 3))
    np.testing.assert_allclose(image[..., 0], means, atol=0.5)
    camera = image_camera(view, 4)
    assert (camera.width, camera.height, camera.fx, camera.cx) == (4, 4, 5, 2)
    assert image_camera(view, 8) is view.camera


def test_the_longest_side_must_be_a_pixel(tmp_path, pixels) -> None:
    with pytest.raises(InputError, match="longest: expected at least 1"):
        reduced_size(10, 10, 0)


def test_transparency_is_white_and_grey_is_grey(tmp_path) -> None:
    pixels = np.array([[[10, 20, 30, 255], [10, 20, 30, 0], [200, 0, 0, 51]]], np.uint8)
    Image.fromarray(pixels).save(tmp_path / "a.png")
    image = load_image(view_of(tmp_path / "a.png", 3, 1))
    assert image.tolist() == [[[10, 20, 30], [255, 255, 255], [244, 204, 204]]]
    Image.fromarray(np.array([[7, 9]], np.uint8)).save(tmp_path / "g.png")
    assert load_image(view_of(tmp_path / "g.png", 2, 1)).tolist() == [[[7] * 3, [9] * 3]]


def test_photographs_that_cannot_be_read(tmp_path, pixels) -> None:
    with pytest.raises(InputError, match="view 'v': expected a view with a photograph"):
        load_image(view_of(None))
    with pytest.raises(MissingFileError, match=r"gone.png: the photograph .* --data"):
        load_image(view_of(tmp_path / "gone.png"))
    (tmp_path / "t.png").write_text("no picture")
    with pytest.raises(FileFormatError, match=r"t.png: expected an image"):
        load_image(view_of(tmp_path / "t.png"))
    Image.fromarray(pixels).save(tmp_path / "a.png")
    whole = (tmp_path / "a.png").read_bytes()
    (tmp_path / "a.png").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(FileFormatError, match=r"a.png: "):
        load_image(view_of(tmp_path / "a.png"))
    Image.fromarray(np.zeros((HEIGHT, WIDTH), np.uint16)).save(tmp_path / "d.png")
    with pytest.raises(FileFormatError, match="8 bits a channel"):
        load_image(view_of(tmp_path / "d.png"))


def test_a_reduced_mask_keeps_only_whole_pixels(tmp_path, pixels) -> None:
    mask = np.full((8, 8), 9, np.uint8)
    mask[0, 0] = 0
    Image.fromarray(mask).save(tmp_path / "m.png")
    view = view_of(tmp_path / "a.png", 8, 8, mask=tmp_path / "m.png")
    assert load_mask(view).sum() == 63
    reduced = load_mask(view, longest=4)
    assert reduced.shape == (4, 4)
    assert (reduced == 0).nonzero().tolist() == [[0, 0]]


def test_the_alpha_of_a_mask_is_the_mask(tmp_path) -> None:
    mask = np.array([[[255, 255, 255, 0], [0, 0, 0, 255]]], np.uint8)
    Image.fromarray(mask).save(tmp_path / "m.png")
    assert load_mask(view_of(None, 2, 1, mask=tmp_path / "m.png")).tolist() == [[0, 1]]


def test_a_mask_of_another_shape_is_refused(tmp_path) -> None:
    Image.fromarray(np.zeros((6, 4), np.uint8)).save(tmp_path / "m.png")
    with pytest.raises(FileFormatError, match=r"m.png: expected 6x4 pixels .* got 4x6"):
        load_mask(view_of(None, mask=tmp_path / "m.png"))


@pytest.mark.parametrize("scale", [0.5, 2, 3])
@pytest.mark.parametrize("longest", [None, 16])
def test_a_mask_of_a_uniform_scale_covers_the_photograph(tmp_path, scale, longest) -> None:
    """Its left half leaves out the photograph's, at whatever size it is worked on."""
    mask = np.full((int(24 * scale), int(32 * scale)), 255, np.uint8)
    mask[:, : int(16 * scale)] = 0
    Image.fromarray(mask).save(tmp_path / "m.png")
    found = load_mask(view_of(None, 32, 24, mask=tmp_path / "m.png"), longest=longest)
    width = longest or 32
    assert found.shape == (width * 3 // 4, width)
    assert (found == (torch.arange(width) >= width // 2)).all()


@pytest.mark.parametrize("channels", [None, 1, 3, 4])
def test_pictures_round_trip(tmp_path, rng, channels) -> None:
    shape = (5, 7) if channels is None else (5, 7, channels)
    image = torch.from_numpy(rng.integers(0, 256, shape).astype(np.uint8))
    for value in (image, image.float() / 255, image.double() / 255):
        save_png(value, tmp_path / "p.png")
        with Image.open(tmp_path / "p.png") as file:
            np.testing.assert_array_equal(
                np.asarray(file), image.squeeze(-1) if channels == 1 else image
            )


def test_floats_are_clamped_and_rounded(tmp_path) -> None:
    save_png(torch.tensor([[-1.0, 0.5, 2.0, 0.1]]), tmp_path / "p.png")
    with Image.open(tmp_path / "p.png") as file:
        assert np.asarray(file).tolist() == [[0, 128, 255, 26]]


def test_wide_integers_are_16_bit(tmp_path) -> None:
    save_png(torch.tensor([[0, 65535, 300]], dtype=torch.int32), tmp_path / "p.png")
    with Image.open(tmp_path / "p.png") as file:
        assert np.asarray(file).tolist() == [[0, 65535, 300]]
    save_png(torch.tensor([[True, False]]), tmp_path / "b.png")
    with Image.open(tmp_path / "b.png") as file:
        assert np.asarray(file).tolist() == [[255, 0]]


@pytest.mark.parametrize(
    ("image", "error", "message"),
    [
        (torch.zeros(2, 2, 2), ShapeError, r"expected \(H, W\)"),
        (torch.zeros(0, 2), ShapeError, "at least one pixel"),
        (torch.tensor([[float("nan")]]), InputError, "got NaN"),
        (torch.tensor([[-1]]), InputError, r"got \[-1, -1\]"),
        (torch.tensor([[70000]]), InputError, r"got \[70000, 70000\]"),
        (torch.zeros(1, 1, 3, dtype=torch.int32), InputError, "uint8 or floats"),
    ],
)
def test_pictures_that_cannot_be_written(tmp_path, image, error, message) -> None:
    with pytest.raises(error, match=message):
        save_png(image, tmp_path / "p.png")
    assert not list(tmp_path.iterdir())


# Films: the file plays back as what went in, and nothing half-written stays.


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
