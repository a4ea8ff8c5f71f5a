"""Training photographs, their masks, and scores within masks."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from splatseg.core import Camera, View
from splatseg.errors import FileFormatError, InputError
from splatseg.evaluate import evaluate_photographs
from splatseg.fit import FitOptions, fit, reduction_note
from splatseg.fit._photographs import TrainingPhotographs
from splatseg.io.images import load_alpha, load_image, save_png
from splatseg.lift import GaussianField
from splatseg.render import render


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


# Masks and alpha: what has no loss, and what is transparent.


def _array_view(folder: Path, pixels: np.ndarray, **lens: object) -> View:
    Image.fromarray(pixels).save(folder / "photograph.png")
    height, width = pixels.shape[:2]
    camera = Camera(
        width=width,
        height=height,
        fx=10.0,
        fy=10.0,
        cx=width / 2,
        cy=height / 2,
        cam_from_world=torch.eye(4),
        **lens,
    )
    return View(name="photograph", camera=camera, image=folder / "photograph.png")


def _masked(view: View, mask: np.ndarray) -> View:
    path = view.image.with_name("mask.png")
    Image.fromarray(mask).save(path)
    return replace(view, mask=path)


def test_alpha_of_masks_and_photographs(tmp_path: Path) -> None:
    opaque = np.array([[0, 128], [255, 1]], np.uint8)
    colour = np.full((2, 2, 3), 90, np.uint8)
    plain = _array_view(tmp_path, colour)
    assert load_alpha(plain) is None
    assert load_alpha(_masked(plain, opaque)).tolist() == opaque.tolist()
    # A mask of zeros and ones means 0 and 255, and so does one of 1 bit a pixel.
    ones = (opaque > 100).astype(np.uint8)
    assert load_alpha(_masked(plain, ones)).tolist() == (255 * ones).tolist()
    assert load_alpha(_masked(plain, ones.astype(bool))).tolist() == (255 * ones).tolist()
    own = _array_view(tmp_path, np.concatenate((colour, opaque[..., None]), axis=2))
    assert load_alpha(own).tolist() == opaque.tolist()
    assert load_alpha(own, longest=1).tolist() == [[96]]
    # The mask is what somebody made of the photograph: it wins.
    assert load_alpha(_masked(own, ones)).tolist() == (255 * ones).tolist()
    with pytest.raises(FileFormatError, match=r"expected 2x2 pixels .* got 2x1"):
        load_alpha(_masked(own, ones[:1]))


@pytest.mark.parametrize("mode", ["own alpha", "mask"])
def test_examples_hold_colour_times_alpha(tmp_path: Path, mode: str) -> None:
    """Colour 200 with alpha 0, 51 (a fifth), 255: 0, 40, 200, whatever the white gave."""
    opaque = np.array([[0, 51, 255, 255]] * 2, np.uint8)
    colour = np.full((2, 4, 3), 200, np.uint8)
    if mode == "mask":
        view = _masked(_array_view(tmp_path, colour), opaque)
    else:
        view = _array_view(tmp_path, np.concatenate((colour, opaque[..., None]), axis=2))
    photographs = TrainingPhotographs([view], longest=100, masks="alpha")
    example = photographs.example(0)
    assert example.mask is None
    assert torch.allclose(example.alpha * 255, torch.tensor([[0.0, 51, 255, 255]] * 2))
    expected = torch.tensor([[0.0, 40, 200, 200]] * 2)[..., None].expand(2, 4, 3)
    assert torch.allclose(example.photograph * 255, expected, atol=1.01)
    half = photographs.example(0, reduction=2)
    assert torch.allclose(half.alpha * 255, torch.tensor([[25.5, 255.0]]))
    assert torch.allclose(half.photograph[..., 0] * 255, torch.tensor([[20.0, 200.0]]), atol=1.01)


def test_what_masks_mean_is_an_option(tmp_path: Path) -> None:
    mask = np.array([[0, 255]], np.uint8)
    view = _masked(_array_view(tmp_path, np.full((1, 2, 3), 200, np.uint8)), mask)
    ignored = TrainingPhotographs([view], longest=100, masks="ignore").example(0)
    assert ignored.mask.tolist() == [[False, True]]
    assert ignored.alpha is None
    plain = TrainingPhotographs([view], longest=100, masks="off").example(0)
    assert plain.mask is None
    assert plain.alpha is None
    assert torch.allclose(plain.photograph * 255, torch.tensor(200.0))
    with pytest.raises(InputError, match="masks: expected one of"):
        FitOptions(masks="cut")  # type: ignore[arg-type]


def test_alpha_behind_a_lens_goes_where_the_pixels_go(tmp_path: Path) -> None:
    opaque = np.zeros((20, 24), np.uint8)
    opaque[5:15, 8:16] = 255
    view = _array_view(
        tmp_path, np.full((20, 24, 3), 100, np.uint8), model="opencv", distortion=(0.2, 0.05)
    )
    example = TrainingPhotographs([_masked(view, opaque)], longest=100, masks="alpha").example(0)
    assert example.mask is not None
    assert not bool(example.mask.all()), "the pinhole image is larger than the photograph"
    assert torch.allclose(
        example.photograph, example.alpha[..., None] * (100 / 255), atol=2.5 / 255
    )
    assert float(example.alpha.max()) == 1
    assert float(example.alpha[0].max()) == 0


@pytest.fixture
def before_a_wall(photograph, scene_photographed):
    """The tiny scene, as opaque as it is, before a wall of yellow; masks are its alpha."""
    capture = photograph()
    views = []
    for view in capture.views:
        with torch.no_grad():
            drawn = render(scene_photographed, view.camera)
        wall = torch.tensor([1.0, 0.9, 0.2])
        image = drawn.image.clamp(0, 1) + (1 - drawn.alpha)[..., None] * wall
        save_png(image.clamp(0, 1), view.image)
        mask = view.image.with_name(f"{view.name}_mask.png")
        save_png(drawn.alpha.clamp(0, 1), mask)
        views.append(replace(view, mask=mask))
    return replace(capture, views=tuple(views))


def test_a_thing_is_cut_out_of_its_surroundings(before_a_wall, scene_photographed) -> None:
    capture = before_a_wall
    options = FitOptions(minutes=None, steps=400, max_gaussians=200)
    cut = fit(capture, options=replace(options, masks="alpha")).gaussians
    errors, outside = [], []
    for view in capture.test_views:
        with torch.no_grad():
            drawn, true = render(cut, view.camera), render(scene_photographed, view.camera)
        errors.append(float((drawn.alpha - true.alpha).abs().mean()))
        outside.append(float(drawn.alpha[true.alpha < 0.01].mean()))
    assert max(outside) < 0.06, outside
    assert max(errors) < 0.05, errors
    # With alpha, the renders match the photographs; without, the wall is missing.
    as_cut = evaluate_photographs(GaussianField(cut), capture.test_views, masks="alpha")
    as_they_are = evaluate_photographs(GaussianField(cut), capture.test_views)
    assert as_cut.psnr > 20
    assert as_they_are.psnr < as_cut.psnr - 5


def test_pixels_without_loss_teach_nothing(photograph) -> None:
    """A splotch on every photograph, masked out: the fit is bit for bit that of other splotches."""
    capture = photograph(count=6)
    results = []
    for splotch in (0, 255):
        views = []
        for view in capture.views:
            pixels = np.asarray(Image.open(view.image)).copy()
            mask = np.full(pixels.shape[:2], 255, np.uint8)
            pixels[10:30, 20:40], mask[10:30, 20:40] = splotch, 0
            image = view.image.with_name(f"{view.name}_{splotch}.png")
            path = view.image.with_name(f"{view.name}_mask.png")
            Image.fromarray(pixels).save(image)
            Image.fromarray(mask).save(path)
            views.append(replace(view, image=image, mask=path))
        marked = replace(capture, views=tuple(views))
        results.append(fit(marked, options=FitOptions(minutes=None, steps=30)).gaussians)
    assert torch.equal(results[0].means, results[1].means)
    assert torch.equal(results[0].sh, results[1].sh)


# Held-out views are scored where their masks keep them.


@pytest.fixture
def spoilt(scene_photographed, photograph, tmp_path):
    """Views whose left third is black in the photograph and masked out, and one masked whole."""
    capture = photograph()
    views = []
    for number, view in enumerate(capture.views[:3]):
        pixels = load_image(view)
        third = pixels.shape[1] // 3
        pixels[:, :third] = 0
        image, mask = tmp_path / f"{view.name}.png", tmp_path / f"{view.name}_mask.png"
        keep = torch.ones(pixels.shape[:2])
        keep[:, : third if number else None] = 0
        save_png(pixels, image)
        save_png(keep, mask)
        views.append(replace(view, image=image, mask=mask))
    return views


def test_views_are_scored_where_their_masks_keep_them(spoilt, scene_photographed) -> None:
    as_they_are = evaluate_photographs(GaussianField(scene_photographed), spoilt)
    kept = evaluate_photographs(GaussianField(scene_photographed), spoilt, masks="ignore")
    assert len(as_they_are.views) == 3
    assert kept.views == tuple(view.name for view in spoilt[1:])
    assert kept.psnr_min > as_they_are.psnr + 3
    assert kept.ssim > as_they_are.ssim + 0.2
    with pytest.raises(InputError, match="masks keep none of 1"):
        evaluate_photographs(GaussianField(scene_photographed), spoilt[:1], masks="ignore")


def test_time_that_is_up_ends_the_scoring_after_one_view(spoilt, scene_photographed) -> None:
    assert (
        len(evaluate_photographs(GaussianField(scene_photographed), spoilt, seconds=0.0).views) == 1
    )
