"""A splat file of any tool becomes a scene, with its photographs or with virtual cameras."""

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from msgspec import Meta

from splatseg.core import Capture, Gaussians, Scene
from splatseg.core.boundary import boundary
from splatseg.core.options import Count
from splatseg.core.options import options as options_class
from splatseg.errors import InputError
from splatseg.importing import Alignment, VirtualViews, align, place_cameras
from splatseg.io.atomic import check_utf8
from splatseg.io.captures import read_capture
from splatseg.io.scene import save_scene
from splatseg.io.splats import SplatWarning, Values, read_splats, splat_format
from splatseg.render import BackendName
from splatseg.tasks.work import (
    SILENT,
    Observer,
    check_replaceable_scene,
    scene_of_capture,
    versions,
)

UpAxis = Literal["auto", "+x", "-x", "+y", "-y", "+z", "-z"]
"""An axis of the file's frame; auto is what its format usually has."""


@options_class(removed={"height": "virtual views are three quarters as high as wide"})
class ImportOptions:
    """Photographs of a splat file, or its virtual cameras."""

    data: Path | None = None
    """The capture that the splats were made from: photographs with poses. None places virtual
    cameras."""

    format: str = "auto"
    """Layout of the capture: auto, nerfstudio, blender, colmap, llff, idr, replica, scannet,
    scannetpp, kitti360 or waymo. auto takes the first of these that is found."""

    as_is: bool = False
    """Do not compare the file with the photographs, and do not move it."""

    strict: bool = False
    """Refuse a splat file with Gaussians that cannot be rendered (NaN, infinite), and a capture
    with photographs that cannot be used. Without it they are left out and counted or named, as long
    as a Gaussian and half of the photographs remain."""

    linear: tuple[Values, ...] = ()
    """Values of a PLY file that are stored as they are, where 3DGS stores logs and logits: scales,
    opacities."""

    up: UpAxis = "auto"
    """Up axis, where there is no capture. auto: +y for glTF, -y for all other formats, as most
    tools write them."""

    max_views: Count | None = None
    """Largest number of virtual cameras. None takes 40 around an object and 96 within a room. Every
    eighth is a test view."""

    width: Annotated[int, Meta(ge=16)] = 800
    """Width of the virtual views, pixels; they are three quarters as high."""

    kind: Literal["auto", "object", "room"] = "auto"
    """Placement of virtual cameras: around the scene (object) or within it (room). auto: within,
    where the scene surrounds them."""

    def __post_init__(self) -> None:
        if self.as_is and self.data is None:
            raise InputError("as_is: goes with `data`, which says what the file is compared with.")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ImportedScene:
    """A scene folder made of a splat file."""

    scene: Scene
    alignment: Alignment | None
    """How the file lay to the photographs; None where they were not compared."""

    placed: VirtualViews | None
    """Virtual cameras; None with a capture."""


@boundary
def import_scene(
    file: Path,
    folder: Path,
    *,
    options: ImportOptions | None = None,
    backend: BackendName = "auto",
    observer: Observer = SILENT,
) -> ImportedScene:
    """Make a scene folder of a splat file.

    With a capture, a few views are drawn and compared with the photographs; a file in another
    frame (axes, nerfstudio's transforms, another scale) is moved. Without, cameras are placed
    so that they cover what is visible.

    Args:
        file: PLY, compressed PLY, .splat, .ksplat, SPZ, SOG or glTF.
        folder: The scene folder to write. A scene that is there is replaced unless it has
            layers.
        options: The capture, or how cameras are placed.
        backend: Rendering backend.
        observer: Is told of the progress and of what was found.

    Raises:
        InputError: If something is in the way, the file holds no Gaussians, or it fits the
            photographs in no frame.
        FileFormatError: If the file is broken.
    """
    options = options or ImportOptions()
    check_replaceable_scene(folder)
    check_utf8(file)
    gaussians = read_with_notes(file, observer, strict=options.strict, linear=options.linear)
    if not len(gaussians):
        raise InputError(f"{file}: expected Gaussians, got a file of none.")
    provenance: dict[str, Any] = {
        "command": "import",
        "file": file.name,
        "format": splat_format(file),
        "backend": backend,
        "versions": versions("splatseg", "torch"),
    }
    if options.data is None:
        scene, placed = _with_cameras(
            file, gaussians, options, provenance=provenance, backend=backend, observer=observer
        )
        return ImportedScene(scene=save_scene(scene, folder), alignment=None, placed=placed)
    capture = read_capture(options.data, format=options.format, strict=options.strict)
    for note in capture.notes:
        observer.note(note)
    alignment = None
    if not options.as_is:
        alignment = align(gaussians, capture, splats=file, backend=backend)
        observer.info(_aligned(alignment))
        if alignment.moved:
            gaussians = gaussians.transformed(alignment.capture_from_file)
    provenance |= _alignment_facts(alignment, capture)
    scene = scene_of_capture(capture, gaussians, provenance=provenance)
    return ImportedScene(scene=save_scene(scene, folder), alignment=alignment, placed=None)


def _with_cameras(
    file: Path,
    gaussians: Gaussians,
    options: ImportOptions,
    *,
    provenance: Mapping[str, Any],
    backend: BackendName,
    observer: Observer,
) -> tuple[Scene, VirtualViews]:
    """The scene with virtual cameras."""
    # Nothing in a file says which axis is up in it.
    usual = "+y" if splat_format(file) == "gltf" else "-y"
    axis = usual if options.up == "auto" else options.up
    sign = 1.0 if axis[0] == "+" else -1.0
    x, y, z = (sign if letter == axis[1] else 0.0 for letter in "xyz")
    with observer.stage("placing cameras") as step:
        placed = place_cameras(
            gaussians,
            up=(x, y, z),
            count=options.max_views,
            width=options.width,
            height=options.width * 3 // 4,
            kind=None if options.kind == "auto" else options.kind,
            backend=backend,
            progress=step,
        )
    where = "around an object" if placed.kind == "object" else "within a room"
    observer.info(
        f"{len(placed.views)} virtual cameras {where}; they show "
        f"{100 * placed.coverage:.0f} % of what is visible"
    )
    if options.up == "auto":
        observer.info(
            f"up is {axis}, as is usual in such files; where the views lie on their side, "
            "say which axis is, such as --up +z"
        )
    facts = {"kind": placed.kind, "coverage": round(placed.coverage, 4), "up": [x, y, z]}
    scene = Scene(
        gaussians=gaussians,
        views=placed.views,
        up=(x, y, z),
        provenance={**provenance, "virtual_views": facts},
    )
    return scene, placed


def read_with_notes(
    file: Path, observer: Observer, *, strict: bool, linear: tuple[Values, ...]
) -> Gaussians:
    """The Gaussians of a splat file, see `read_splats`; what is odd goes to the observer."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", SplatWarning)
        gaussians = read_splats(file, strict=strict, linear=linear)
    for warning in caught:
        observer.note(str(warning.message))
    return gaussians


def _aligned(found: Alignment) -> str:
    quality = f"correlation {found.correlation:.2f}, {found.psnr:.1f} dB at a small size"
    if not found.moved:
        return f"the splats fit the photographs ({quality})"
    return (
        f"the splats were in another frame (correlation {found.correlation_as_is:.2f}) and were "
        f"moved: {found.what} ({quality})"
    )


def _alignment_facts(found: Alignment | None, capture: Capture) -> dict[str, Any]:
    if found is None:
        return {"alignment": "taken as it is"}
    return {
        "alignment": {
            "capture": capture.path.name,
            "moved": found.what or None,
            "capture_from_file": found.capture_from_file.matrix.tolist(),
            "correlation": round(found.correlation, 4),
            "correlation_as_is": round(found.correlation_as_is, 4),
        }
    }
