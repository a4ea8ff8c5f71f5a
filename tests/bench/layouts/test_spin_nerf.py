"""SPIn-NeRF: masks of one object in many views."""

import numpy as np
import pytest
from PIL import Image

from splatseg.errors import FileFormatError, InputError, MissingFileError
from splatseg_bench.layouts import read_benchmark

NAMES = ("b.jpg", "a.jpg", "c d.jpg")


def test_a_generated_scene(converted, source) -> None:
    (scene,) = read_benchmark("spin-nerf", converted("spin-nerf"))
    (task,) = scene.tasks
    assert task.name == scene.name == source.name
    assert not scene.capture.test_views
    assert task.reference is task.truth[0]
    names = [mask.view for mask in task.truth]
    assert names == sorted(names)
    photographs = {view.image.read_bytes(): view for view in source.views}
    things = [
        thing
        for thing in source.things
        if all(
            (
                mask.read().numpy()
                == source.mask(thing, photographs[scene.capture.view(mask.view).image.read_bytes()])
            ).all()
            for mask in task.truth
        )
    ]
    (thing,) = things
    assert task.words == thing.name


def test_words_of_a_scene(tmp_path, tiny_capture, left_half) -> None:
    tiny_capture(tmp_path, NAMES)
    left_half(tmp_path / "masks" / "a.png", value=1)
    assert read_benchmark("spin-nerf", tmp_path)[0].tasks[0].words is None
    file = tmp_path / "words.txt"
    file.write_text("\n  the red cup\n\n")
    assert read_benchmark("spin-nerf", tmp_path)[0].tasks[0].words == "the red cup"
    for text, lines in (("", 0), ("cup\nfork\n", 2)):
        file.write_text(text)
        with pytest.raises(
            FileFormatError, match=rf"words\.txt: expected one line, .* got {lines}"
        ):
            read_benchmark("spin-nerf", tmp_path)


@pytest.mark.parametrize("place", ["masks", "label", "images/label"])
def test_masks_of_some_views(place, tmp_path, tiny_capture, left_half) -> None:
    tiny_capture(tmp_path / "fork", NAMES)
    left_half(tmp_path / "fork" / place / "c d.png", value=1)
    left_half(tmp_path / "fork" / place / "a_mask.png", (32, 24))
    (tmp_path / "README").write_text("")
    (scene,) = read_benchmark("spin-nerf", tmp_path)
    (task,) = scene.tasks
    assert [mask.view for mask in task.truth] == ["a", "c d"]
    assert task.reference.view == "a"
    assert [tuple(mask.read().shape) for mask in task.truth] == [(24, 32), (48, 64)]
    assert task.truth[1].read().float().mean() == 0.5


def test_masks_of_every_kind_of_picture(tmp_path, tiny_capture) -> None:
    """Grey, zeros and ones, colour with alpha, a palette, one bit, 16 bits: the same mask."""
    tiny_capture(tmp_path, ("a.jpg", "b.jpg", "c.jpg", "d.jpg", "e.jpg", "f.jpg"))
    half = np.zeros((48, 64), np.uint8)
    half[:, :32] = 1
    palette = Image.fromarray(half)
    palette.putpalette([0, 0, 0, 128, 0, 0])
    pictures = {
        "a": Image.fromarray(half * 255),
        "b": Image.fromarray(half),
        "c": Image.fromarray(np.dstack([half * 255] * 3 + [np.full_like(half, 255)])),
        "d": palette,
        "e": Image.fromarray(half * 255).convert("1"),
        "f": Image.fromarray(half.astype(np.uint16) * 65535),
    }
    (tmp_path / "masks").mkdir()
    for name, picture in pictures.items():
        picture.save(tmp_path / "masks" / f"{name}.png")
    (scene,) = read_benchmark("spin-nerf", tmp_path)
    for mask in scene.tasks[0].truth:
        np.testing.assert_array_equal(mask.read(), half > 0)


def test_grey_is_cut_in_the_middle(tmp_path, tiny_capture) -> None:
    tiny_capture(tmp_path, ("a.jpg",))
    (tmp_path / "masks").mkdir()
    ramp = np.tile(np.arange(126, 130, dtype=np.uint8).repeat(16), (48, 1))
    Image.fromarray(ramp).save(tmp_path / "masks/a.png")
    (scene,) = read_benchmark("spin-nerf", tmp_path)
    np.testing.assert_array_equal(scene.tasks[0].truth[0].read(), ramp >= 128)


def test_files_that_are_wrong(tmp_path, tiny_capture, left_half) -> None:
    tiny_capture(tmp_path, NAMES)
    with pytest.raises(MissingFileError, match="expected captures with masks in masks, label"):
        read_benchmark("spin-nerf", tmp_path)
    left_half(tmp_path / "masks/x.png")
    with pytest.raises(InputError, match=r"masks/x.png: expected the name of one of the 3 photogr"):
        read_benchmark("spin-nerf", tmp_path)
    left_half(tmp_path / "masks/x.png").rename(tmp_path / "masks/a.png")
    left_half(tmp_path / "masks/a_mask.png")
    with pytest.raises(InputError, match=r"a_mask.png: expected one mask of a view, got two of 'a"):
        read_benchmark("spin-nerf", tmp_path)
    (tmp_path / "masks/a_mask.png").unlink()
    (scene,) = read_benchmark("spin-nerf", tmp_path)
    (tmp_path / "masks/a.png").unlink()
    with pytest.raises(MissingFileError, match=r"masks/a.png: there is no such image"):
        scene.tasks[0].truth[0].read()
