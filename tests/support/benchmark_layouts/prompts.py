"""Layouts whose prompt is a picture: NVOS's strokes, SPIn-NeRF's first mask."""

from pathlib import Path

import numpy as np
from PIL import Image
from scipy import ndimage

from splatseg.core import View
from splatseg_bench.layouts.spin_nerf import WORDS_FILE
from support.benchmark_layouts.source import Mask, Source, Thing, link, save_mask
from support.benchmark_layouts.sparse import write_sparse

SCALE = 4
"""How much smaller strokes are than photographs."""

TASKS = 3


def write_nvos(source: Source, folder: Path) -> None:
    """Strokes in a training view and the mask in a held-out one, of the clearest things.

    The scene lies in ``llff/NAME``; its ``sparse/0/test.txt`` names the held-out views.
    """
    names = _photographs(source, folder / "llff" / source.name, "images")
    tests = [names[view.name] for view in source.capture.test_views]
    (folder / "llff" / source.name / "sparse/0/test.txt").write_text("\n".join(tests) + "\n")
    for thing in _whole_things(source)[:TASKS]:
        task = thing.name.replace(" ", "_")
        reference = _clearest(source, thing, source.capture.train_views)
        target = max(source.capture.test_views, key=lambda view: source.pixels(thing, view))
        picture = names[reference.name]
        link(reference.image, folder / "reference_image" / task / picture)
        on, off = strokes(source.mask(thing, reference)[SCALE // 2 :: SCALE, SCALE // 2 :: SCALE])
        save_mask(on, folder / "scribbles" / task / f"pos_0_{source.name}.png")
        save_mask(off, folder / "scribbles" / task / f"neg_0_{source.name}.png")
        stem = Path(names[target.name]).stem
        link(target.image, folder / "masks" / task / names[target.name])
        save_mask(source.mask(thing, target), folder / "masks" / task / f"{stem}_mask.png")


def write_spin_nerf(source: Source, folder: Path) -> None:
    """The clearest thing in all views that show it; values 0 and 1, as its labels have.

    Its name is what asks for it in words.
    """
    scene = folder / source.name
    names = _photographs(source, scene, "images")
    thing = _whole_things(source)[0]
    (scene / "masks").mkdir()
    (scene / WORDS_FILE).write_text(f"{thing.name}\n", encoding="utf-8")
    for view in source.views:
        mask = source.mask(thing, view)
        if mask.any():
            path = scene / "masks" / f"{Path(names[view.name]).stem}.png"
            Image.fromarray(mask.astype(np.uint8)).save(path)


def strokes(mask: Mask) -> tuple[Mask, Mask]:
    """Lines in the middle of a mask, and in the middle of what it is not."""
    from skimage.morphology import skeletonize

    outside = ~ndimage.binary_dilation(mask, iterations=2)
    # The border of the picture is a border of what is outside, or lines would run along it.
    outside[[0, -1]] = outside[:, [0, -1]] = False
    lines = [skeletonize(region) for region in (mask, outside)]
    return lines[0] & mask, lines[1] & ~mask


def _photographs(source: Source, scene: Path, folder: str) -> dict[str, str]:
    """Photographs as LLFF calls them, with a sparse model; names by view."""
    views = sorted(source.views, key=lambda view: view.name)
    names = {view.name: f"IMG_{4000 + i:04d}.JPG" for i, view in enumerate(views)}
    for view in views:
        link(view.image, scene / folder / names[view.name])
    write_sparse(scene / "sparse/0", views, [names[v.name] for v in views], source.capture.points)
    return names


def _whole_things(source: Source) -> list[Thing]:
    """Things seen whole in a training view and seen in a test view, the largest first."""
    size = source.views[0].camera.width * source.views[0].camera.height
    sizes = {
        thing: max(source.pixels(thing, view, whole=True) for view in source.capture.train_views)
        for thing in source.things
        if any(source.pixels(thing, view) > 0.002 * size for view in source.capture.test_views)
    }
    found = [thing for thing, most in sizes.items() if most > 0.004 * size]
    if not found:
        raise ValueError(f"{source.folder}: no thing is seen whole")
    return sorted(found, key=lambda thing: -sizes[thing])


def _clearest(source: Source, thing: Thing, views: tuple[View, ...]) -> View:
    return max(views, key=lambda view: source.pixels(thing, view, whole=True))
