"""``splatseg import``: a splat file of any tool becomes a scene folder."""

import sys
import warnings
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from splatseg.cli._progress import progress
from splatseg.core import Capture, Gaussians, Scene
from splatseg.errors import InputError
from splatseg.importing import Alignment, SceneKind, VirtualViews, align, place_cameras
from splatseg.io.captures import read_capture
from splatseg.io.scene import is_scene, save_scene, scene_layer_names
from splatseg.io.splats import SplatWarning, read_splats, splat_format
from splatseg.render import BackendName

UpAxis = Literal["auto", "+x", "-x", "+y", "-y", "+z", "-z"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Command:
    """Make a scene of a splat file, with its photographs or with virtual cameras.

    With --data, a few views are drawn and compared with the photographs; a file in another
    frame (axes, nerfstudio's transforms, another scale) is moved, and one that fits nowhere is
    refused. Without, cameras are placed so that they cover what is visible; their views have
    no photographs, and everything that needs none works on them.
    """

    file: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")]
    """The splat file: PLY, compressed PLY, .splat, SPZ, SOG or glTF."""

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="SCENE")]
    """The scene folder to write. A scene that is there is replaced unless it has layers."""

    data: Annotated[Path | None, tyro.conf.arg(metavar="CAPTURE")] = None
    """The capture that the splats were made from: photographs with poses."""

    as_is: bool = False
    """Take the file as it stands, without comparing it with the photographs."""

    up: UpAxis = "auto"
    """Which way is up, where there is no capture. auto: +y for glTF, -y for all else, which is
    what most tools write."""

    views: int = 40
    """Most virtual cameras to place. Every eighth is a test view."""

    width: int = 800
    """Width of the virtual views, pixels."""

    height: int = 600
    """Height of the virtual views, pixels."""

    kind: Literal["auto", "object", "room"] = "auto"
    """Whether virtual cameras stand around the scene or within it. auto: within, where the
    scene surrounds them."""

    format: str = "auto"
    """How CAPTURE is read: auto, nerfstudio, colmap, blender, llff or idr."""

    backend: BackendName = "auto"
    """Who renders. auto: the C++ kernels."""


def run(command: Command) -> None:
    """Import a splat file."""
    _check(command)
    gaussians = _read(command.file)
    if command.data is not None:
        scene = _with_photographs(command, gaussians, command.data)
    else:
        scene = _without(command, gaussians)
    save_scene(scene, command.output)
    train, test = len(scene.train_views), len(scene.test_views)
    sys.stdout.write(
        f"{command.output}: {len(scene.gaussians)} Gaussians, {train} training views, "
        f"{test} test views\n"
    )


def _check(command: Command) -> None:
    """Refuse before the work what could not be written after it."""
    root = command.output
    if root.exists() and not root.is_dir():
        raise InputError(f"{root}: expected a folder to write to, got a file.")
    if not root.resolve().parent.is_dir():
        raise InputError(f"{root}: expected a place in a folder that is there, got none.")
    if is_scene(root):
        layers = scene_layer_names(root)
        if layers:
            raise InputError(
                f"{root}: expected a new folder, got a scene with layers ({', '.join(layers)}), "
                "which belong to its Gaussians; remove it or choose another name."
            )
    elif root.is_dir() and any(root.iterdir()):
        raise InputError(f"{root}: expected an empty folder or a new one, got one with files.")
    if command.views < 1:
        raise InputError(f"--views: expected at least 1, got {command.views}.")
    if min(command.width, command.height) < 16:
        raise InputError(
            "--width, --height: expected at least 16 pixels, got "
            f"{command.width} and {command.height}."
        )
    if command.as_is and command.data is None:
        raise InputError("--as-is: goes with --data, which says what the file would be held to.")


def _read(path: Path) -> Gaussians:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", SplatWarning)
        gaussians = read_splats(path)
    for warning in caught:
        sys.stdout.write(f"note: {warning.message}\n")
    if not len(gaussians):
        raise InputError(f"{path}: expected Gaussians, got a file of none.")
    return gaussians


def _with_photographs(command: Command, gaussians: Gaussians, data: Path) -> Scene:
    capture = read_capture(data, format=command.format)
    for note in capture.notes:
        sys.stdout.write(f"note: {note}\n")
    found: Alignment | None = None
    if not command.as_is:
        found = align(gaussians, capture, splats=command.file, backend=command.backend)
        sys.stdout.write(_aligned(found))
        if found.moved:
            gaussians = gaussians.transformed(found.capture_from_file)
    return Scene(
        gaussians=gaussians,
        views=capture.views,
        classes=capture.classes,
        up=capture.up,
        metres_per_unit=capture.metres_per_unit,
        source=capture.path,
        provenance=_provenance(command) | _alignment_facts(found, capture),
    )


def _without(command: Command, gaussians: Gaussians) -> Scene:
    up = _up(command)
    kind: SceneKind | None = None if command.kind == "auto" else command.kind
    with progress("placing cameras") as step:
        placed = place_cameras(
            gaussians,
            up=up,
            count=command.views,
            width=command.width,
            height=command.height,
            kind=kind,
            backend=command.backend,
            progress=step,
        )
    sys.stdout.write(_placed(placed))
    return Scene(
        gaussians=gaussians,
        views=placed.views,
        up=up,
        provenance=_provenance(command)
        | {
            "virtual_views": {
                "kind": placed.kind,
                "coverage": round(placed.coverage, 4),
                "up": list(up),
            }
        },
    )


def _up(command: Command) -> tuple[float, float, float]:
    name = command.up
    if name == "auto":
        name = "+y" if splat_format(command.file) == "gltf" else "-y"
    sign = 1.0 if name[0] == "+" else -1.0
    x, y, z = (sign if axis == name[1] else 0.0 for axis in "xyz")
    return x, y, z


def _aligned(found: Alignment) -> str:
    quality = f"correlation {found.correlation:.2f}, {found.psnr:.1f} dB at a small size"
    if not found.moved:
        return f"the splats fit the photographs ({quality})\n"
    return (
        f"the splats were in another frame (correlation {found.correlation_as_is:.2f}) and were "
        f"moved: {found.what} ({quality})\n"
    )


def _placed(placed: VirtualViews) -> str:
    where = "around an object" if placed.kind == "object" else "within a room"
    return (
        f"{len(placed.views)} virtual cameras {where}; they show "
        f"{100 * placed.coverage:.0f} % of what is visible\n"
    )


def _provenance(command: Command) -> dict[str, Any]:
    return {
        "command": "import",
        "file": command.file.name,
        "format": splat_format(command.file),
        "backend": command.backend,
        "versions": {name: metadata.version(name) for name in ("splatseg", "torch")},
    }


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
