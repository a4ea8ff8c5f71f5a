"""Photographs as a fit sees them: downsampled, masked, undistorted."""

from dataclasses import replace
from pathlib import Path

import torch

from splatseg.core import Camera, View
from splatseg.fit import reduction_note
from splatseg.fit._photographs import TrainingPhotographs
from splatseg.io.images import save_png


def _view(folder: Path, pixels: torch.Tensor, **camera: object) -> View:
    height, width = pixels.shape[:2]
    save_png(pixels, folder / "photo.png")
    values = {"fx": 40.0, "fy": 44.0, "cx": width / 2 + 1, "cy": height / 2}
    shape = Camera(width=width, height=height, cam_from_world=torch.eye(4), **(values | camera))
    return View(name="photo", camera=shape, image=folder / "photo.png")


def _pixels(rng, height: int, width: int) -> torch.Tensor:
    return torch.from_numpy(rng.integers(0, 256, (height, width, 3), dtype="uint8"))


def test_full_size_is_the_photograph(tmp_path: Path, rng) -> None:
    pixels = _pixels(rng, 6, 9)
    view = _view(tmp_path, pixels)
    example = TrainingPhotographs([view], longest=1600).example(0)
    assert torch.equal(example.photograph, pixels.float() / 255)
    assert example.mask is None
    assert (example.camera.width, example.camera.height) == (9, 6)


def test_blocks_are_means_and_rays_stay(tmp_path: Path, rng) -> None:
    """A point seen at the centre of a block is seen at the centre of the pixel it becomes."""
    pixels = _pixels(rng, 13, 18)
    photographs = TrainingPhotographs([_view(tmp_path, pixels)], longest=1600)
    full, small = photographs.camera(0), photographs.example(0, reduction=4)
    assert small.photograph.shape == (3, 4, 3)
    expected = pixels[4:8, 8:12].float().mean(dim=(0, 1)) / 255
    torch.testing.assert_close(small.photograph[1, 2], expected)
    ray = full.unproject(torch.tensor([10.0, 6.0]), torch.tensor(2.0))
    at, _ = small.camera.project(ray)
    torch.testing.assert_close(at, torch.tensor([2.5, 1.5]).to(at))


def test_a_block_counts_if_all_its_pixels_do(tmp_path: Path, rng) -> None:
    view = _view(tmp_path, _pixels(rng, 8, 8))
    mask = torch.full((8, 8), 255, dtype=torch.uint8)
    mask[1, 6] = 0
    save_png(mask, tmp_path / "mask.png")
    photographs = TrainingPhotographs([replace(view, mask=tmp_path / "mask.png")], longest=1600)
    full, small = photographs.example(0), photographs.example(0, reduction=4)
    assert full.mask is not None
    assert small.mask is not None
    assert torch.equal(full.mask, mask == 255)
    assert not bool(full.photograph[1, 6].any())
    assert small.mask.tolist() == [[True, False], [True, True]]


def test_a_lens_is_undistorted_with_its_corners(tmp_path: Path, rng) -> None:
    """A grey photograph stays grey where it is real; outside it nothing counts."""
    pixels = torch.full((30, 40, 3), 120, dtype=torch.uint8)
    view = _view(tmp_path, pixels, model="opencv", distortion=(-0.2,))
    example = TrainingPhotographs([view], longest=1600).example(0)
    assert example.camera.is_pinhole
    assert example.camera.width > 40
    assert example.mask is not None
    assert 0.5 < float(example.mask.float().mean()) < 1
    assert bool((example.photograph[example.mask] == 120 / 255).all())
    assert not bool(example.photograph[~example.mask].any())


def test_undistorted_pixels_that_mix_masked_ones_do_not_count(tmp_path: Path) -> None:
    """White behind the mask never bleeds into the grey that is learnt from."""
    pixels = torch.full((30, 40, 3), 120, dtype=torch.uint8)
    pixels[:, 25:] = 255
    mask = torch.full((30, 40), 255, dtype=torch.uint8)
    mask[:, 25:] = 0
    view = _view(tmp_path, pixels, model="opencv", distortion=(-0.2,))
    save_png(mask, tmp_path / "mask.png")
    masked = replace(view, mask=tmp_path / "mask.png")
    example = TrainingPhotographs([masked], longest=1600).example(0)
    assert example.mask is not None
    assert 0.3 < float(example.mask.float().mean()) < 0.7
    assert bool((example.photograph[example.mask] == 120 / 255).all())


def test_large_photographs_are_reduced_and_it_is_said(tmp_path: Path, rng) -> None:
    view = _view(tmp_path, _pixels(rng, 60, 80))
    assert reduction_note([view], longest=80) is None
    note = reduction_note([view, view], longest=40)
    assert note is not None
    assert "2 of 2 photographs are reduced to a longest side of 40" in note
    assert "80x60 to 40x30" in note
    example = TrainingPhotographs([view], longest=40).example(0)
    assert example.photograph.shape == (30, 40, 3)
    assert example.camera.fx == 20


def test_every_pixel_is_read_once(tmp_path: Path, rng) -> None:
    view = _view(tmp_path, _pixels(rng, 6, 9))
    photographs = TrainingPhotographs([view], longest=1600)
    first = photographs.example(0)
    (tmp_path / "photo.png").unlink()
    assert torch.equal(photographs.example(0).photograph, first.photograph)
