"""Photographs, masks and depth maps."""

from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from splatseg.io.depths import load_depth
from splatseg.io.images import image_size, load_alpha, load_image, load_mask
from support.fuzz.targets.base import HEIGHT, WIDTH, Target, label_png, target, view_of


def _picture(name: str, mode: str, **options: Any) -> None:
    @target(name)
    def make(folder: Path) -> Target:
        file = folder / f"a.{name.split('-')[0]}"
        exif = Image.Exif()
        exif[0x0112] = 3
        picture = Image.linear_gradient("L").resize((WIDTH, HEIGHT)).convert(mode)
        picture.save(file, **({"exif": exif} | options))
        view = view_of(file, mask=file, depth=file, depth_unit=0.001)

        def read() -> None:
            image_size(file)
            for load in (load_image, load_alpha, load_mask):
                load(view)

        return Target(file=file, read=read)


_picture("png", "RGBA")
_picture("png-palette", "P", transparency=0)
_picture("jpg", "RGB")
_picture("tiff", "RGB")
_picture("tiff-deflate", "RGB", compression="tiff_adobe_deflate")
_picture("webp", "RGB")
_picture("bmp", "RGB")


@target("depth.png")
def depth_png(folder: Path) -> Target:
    """A depth map of 16 bits."""
    file = label_png(folder, 16)
    view = view_of(file, depth=file, depth_unit=0.001)
    return Target(file=file, read=lambda: load_depth(view))


@target("depth.npy")
def depth_npy(folder: Path) -> Target:
    """A depth map of real numbers."""
    np.save(folder / "a.npy", np.ones((HEIGHT, WIDTH), np.float32))
    view = view_of(folder / "a.png", depth=folder / "a.npy", depth_unit=1.0)
    return Target(file=folder / "a.npy", read=lambda: load_depth(view))
