"""What is taken for a photograph, how it is turned, and which lens took it."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from splatseg.errors import InputError, MissingFileError, MissingPackageError
from splatseg.pose import PoseOptions, _recover, holds_photographs, recover_poses
from splatseg.pose._photographs import (
    WorkingLens,
    find_photographs,
    lens_facts,
    read_headers,
    write_working_copies,
)

OPTIONS = PoseOptions(longest=100, threads=1)


def photographs(folder: Path, *names: str, size: tuple[int, int] = (160, 120)) -> Path:
    folder.mkdir(exist_ok=True)
    for name in names:
        Image.new("RGB", size, (10, 20, 30)).save(folder / name)
    return folder


def with_lens(size: tuple[int, int], **tags: Any) -> Image.Image:
    """An opened image with EXIF data."""
    codes = {
        "make": 0x010F, "model": 0x0110, "focal": 0x920A, "film": 0xA405,
        "width": 0xA002, "height": 0xA003, "density": 0xA20E, "unit": 0xA210,
    }  # fmt: skip
    image = Image.new("RGB", size)
    exif = image.getexif()
    for name, value in tags.items():
        if name in ("make", "model"):
            exif[codes[name]] = value
        else:
            exif.get_ifd(0x8769)[codes[name]] = value
    return image


def lenses(folder: Path, work: Path, options: PoseOptions = OPTIONS) -> list[WorkingLens]:
    good, bad = read_headers(find_photographs(folder))
    assert not bad
    found, broken = write_working_copies(
        good, work, options=options, threads=1, progress=lambda done, total: None
    )
    assert not broken
    return found


# -- EXIF data --------------------------------------------------------------------------------


def test_the_focal_length_of_film_is_in_terms_of_its_diagonal() -> None:
    # 3600x2400 has the shape of the film: 100 pixels a millimetre.
    assert lens_facts(with_lens((3600, 2400), film=24)).focal == pytest.approx(2400)
    # 4:3: the diagonals are what is equal.
    assert lens_facts(with_lens((4000, 3000), film=26)).focal == pytest.approx(
        26 * 5000 / np.hypot(36, 24)
    )


def test_the_density_of_the_sensor_serves_where_film_is_not_named() -> None:
    tags = {"focal": 50.0, "width": 6000, "height": 4000, "density": 4233.33, "unit": 2}
    # 4233.33 pixels an inch are 166.67 a millimetre; the image was made half as large since.
    assert lens_facts(with_lens((3000, 2000), **tags)).focal == pytest.approx(4166.7, rel=1e-3)
    centimetres = lens_facts(with_lens((3000, 2000), **(tags | {"unit": 3}))).focal
    assert centimetres == pytest.approx(10583, rel=1e-3)
    assert lens_facts(with_lens((3000, 2000), **(tags | {"unit": 4}))).focal is None


def test_a_cropped_picture_has_no_known_focal_length() -> None:
    assert lens_facts(with_lens((2000, 2000), film=24, width=3600, height=2400)).focal is None
    assert lens_facts(with_lens((2400, 3600), film=24, width=3600, height=2400)).focal is not None


@pytest.mark.parametrize("film", [0, 1, 60000])
def test_nonsense_is_not_believed(film: int) -> None:
    assert lens_facts(with_lens((3600, 2400), film=film)).focal is None
    assert lens_facts(with_lens((3600, 2400))).focal is None


def test_a_real_camera(shared_data: Path) -> None:
    with Image.open(shared_data / "real" / "banana" / "dsc_0423.jpg") as image:
        facts = lens_facts(image)
    assert facts.identity[:2] == ("NIKON CORPORATION", "NIKON D3200")
    # 60 mm in terms of film; calibration finds 2604 pixels.
    assert facts.focal == pytest.approx(60 * np.hypot(1504, 1000) / np.hypot(36, 24), rel=1e-6)
    assert facts.focal == pytest.approx(2604, rel=0.06)


# -- lenses -----------------------------------------------------------------------------------


def test_photographs_of_one_camera_share_a_lens_and_others_do_not(tmp_path: Path) -> None:
    folder = photographs(tmp_path / "in", "a.png", "b.png")
    photographs(folder, "c.png", size=(120, 160))
    for name, model in (("d.jpg", "X1"), ("e.jpg", "X1"), ("f.jpg", "X2")):
        exif = Image.Exif()
        exif[0x0110] = model
        exif.get_ifd(0x8769)[0xA405] = 28
        Image.new("RGB", (160, 120)).save(folder / name, exif=exif)
    found = lenses(folder, tmp_path / "work")
    grouped = [sorted(lens.images.values()) for lens in found]
    assert grouped == [["a.png", "b.png"], ["c.png"], ["d.jpg", "e.jpg"], ["f.jpg"]]
    assert [lens.prior for lens in found] == [False, False, True, True]
    assert (found[1].full_width, found[1].width, found[1].height) == (120, 75, 100)
    assert found[0].focal == pytest.approx(120)  # 1.2 times the longest side of the copy
    assert found[2].focal == pytest.approx(28 * 200 / np.hypot(36, 24) * 100 / 160)
    apart = lenses(folder, tmp_path / "work", replace(OPTIONS, cameras="per-image"))
    assert [len(lens.images) for lens in apart] == [1] * 6
    with pytest.raises(InputError, match=r"one size to share a lens, got 5 of 160x120, 1 of 120x1"):
        lenses(folder, tmp_path / "work", replace(OPTIONS, cameras="shared"))
    (folder / "c.png").unlink()
    assert len(lenses(folder, tmp_path / "other", replace(OPTIONS, cameras="shared"))) == 1


def test_copies_are_upright_and_small(room: Any, tmp_path: Path) -> None:
    for i, orientation in enumerate((1, 6, 3)):
        room.save(0, tmp_path / "in" / f"{i}.png", orientation=orientation)
    (lens,) = lenses(tmp_path / "in", tmp_path / "work")
    pictures = [np.asarray(Image.open(tmp_path / "work" / name)) for name in sorted(lens.images)]
    assert pictures[0].shape == (75, 100, 3)
    assert np.array_equal(pictures[1], pictures[0])
    assert np.array_equal(pictures[2], pictures[0])


# -- what is refused --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("c.HEIC", "got a HEIC file; convert them first: `heif-convert"),
        ("c.nef", "got a RAW file; convert them first: `darktable-cli"),
        ("c.DNG", "got a RAW file"),
    ],
)
def test_heic_and_raw_are_refused_with_the_way_to_convert_them(
    tmp_path: Path, name: str, words: str
) -> None:
    folder = photographs(tmp_path / "in", "a.png", "b.png", "d.png")
    (folder / name).write_bytes(b"raw")
    with pytest.raises(InputError) as caught:
        recover_poses(folder)
    assert str(caught.value).startswith(str(folder / name))
    assert words in str(caught.value)
    Image.new("RGB", (4, 4)).save(folder / "c.jpg")
    assert len(find_photographs(folder)) == 4


def test_a_folder_of_nothing_but_raw_holds_photographs(tmp_path: Path) -> None:
    (tmp_path / "a.cr2").write_bytes(b"raw")
    assert holds_photographs(tmp_path)
    with pytest.raises(InputError, match="RAW"):
        recover_poses(tmp_path)
    (tmp_path / "a.cr2").unlink()
    (tmp_path / "a.txt").write_text("no")
    assert not holds_photographs(tmp_path)


def test_two_photographs_are_too_few(tmp_path: Path) -> None:
    folder = photographs(tmp_path / "in", "a.png", "b.png")
    with pytest.raises(InputError, match=r"at least 3 photographs, got 2; photograph the scene"):
        recover_poses(folder)


def test_broken_ones_do_not_count(tmp_path: Path) -> None:
    folder = photographs(tmp_path / "in", "a.png", "b.png")
    (folder / "c.png").write_bytes((folder / "a.png").read_bytes()[:60])
    (folder / "d.jpg").write_bytes(b"no")
    with pytest.raises(InputError, match=r"that can be read, got 2 \(.*d\.jpg: expected an image"):
        recover_poses(folder, options=OPTIONS)


def test_no_such_folder(tmp_path: Path) -> None:
    with pytest.raises(MissingFileError, match="there is no such folder of photographs"):
        recover_poses(tmp_path / "none")


def test_without_pycolmap_the_message_says_how_to_get_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_recover.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(MissingPackageError, match=r"pip install 'splatseg\[sfm\]'"):
        recover_poses(tmp_path)


def test_options_are_checked() -> None:
    for name, value in (("longest", 10), ("frames", 2), ("threads", 0)):
        with pytest.raises(InputError, match=f"{name}: expected at least"):
            PoseOptions(**{name: value})
    with pytest.raises(InputError, match="mapper"):
        PoseOptions(mapper="other")  # pyright: ignore[reportArgumentType]
