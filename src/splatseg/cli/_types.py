"""Flags that several commands share: one type, one help, one meaning each."""

from pathlib import Path
from typing import Annotated, Any, TypeAlias

import tyro

from splatseg.io.splats import Values
from splatseg.render import BackendName


def _named(metavar: str | None, help: str, *aliases: str) -> Any:
    return tyro.conf.arg(metavar=metavar, help=help, aliases=aliases or None)


SceneFolder: TypeAlias = Annotated[Path, tyro.conf.Positional, _named("SCENE", "The scene folder.")]

Output: TypeAlias = Annotated[Path, _named("PATH", "Where to write.", "-o")]

NewScene: TypeAlias = Annotated[
    Path, _named("NEW", "The scene folder to write. It must not be there yet.", "-o")
]

MadeSceneFolder: TypeAlias = Annotated[
    Path,
    _named(
        "SCENE",
        "The scene folder to write. A scene that is there is replaced unless it has layers.",
        "-o",
    ),
]

Data: TypeAlias = Annotated[
    Path | None,
    _named(
        "CAPTURE",
        "Folder of the capture, where it was moved. Only what reads photographs or evidence of "
        "the capture needs it.",
    ),
]

Backend: TypeAlias = Annotated[
    BackendName,
    _named(
        None,
        "Who renders: cpu, the C++ kernels; cuda; reference, slow and plain. auto: cuda for "
        "Gaussians on a GPU, cpu otherwise.",
    ),
]

Field: TypeAlias = Annotated[
    str | None,
    _named(
        "NAME",
        "A field of the scene that street made, instead of the Gaussians and their layers.",
    ),
]

Seed: TypeAlias = Annotated[int, _named("N", "Seed of everything that is drawn at random.")]

Format: TypeAlias = Annotated[
    str,
    _named(
        "NAME",
        "How the capture is read: auto, nerfstudio, blender, colmap, llff, idr, replica, scannet, "
        "scannetpp, kitti360 or waymo. auto takes the first of these that is there.",
    ),
]

Strict: TypeAlias = Annotated[
    bool,
    _named(
        None,
        "Refuse a splat file with Gaussians that cannot be rendered (NaN, infinite), and a capture "
        "with photographs that are not there, cannot be opened, are of another shape than their "
        "intrinsics or mask or have an impossible pose, or with start points that are not finite. "
        "Without it they are left out and counted or named, as long as a Gaussian and half of the "
        "photographs are left.",
    ),
]

Linear: TypeAlias = Annotated[
    tuple[Values, ...],
    _named(
        "VALUES",
        "Which of scales and opacities a PLY file has as they are, where 3DGS has logs and logits.",
    ),
]

Overwrite: TypeAlias = Annotated[
    bool,
    _named(None, "Replace what an earlier run left under the same name."),
]

Split: TypeAlias = Annotated[
    str, _named("SPLIT", "Which views: test, train, another split of the scene, or all.")
]

SplitOrPath: TypeAlias = Annotated[
    str,
    _named(
        "SPLIT",
        "Which views: test, train, another split of the scene, all, or path: a smooth path near "
        "the training cameras.",
    ),
]

SelectLevel: TypeAlias = Annotated[
    str,
    _named(
        "LEVEL",
        "How much a click means: group, object, part, or a number from 0 (groups) by 0.5 (objects) "
        "to 1 (the finest parts). auto lets the source choose.",
    ),
]

Frames: TypeAlias = Annotated[int, _named("N", "Views of a path.")]

Json: TypeAlias = Annotated[
    bool,
    _named(None, "Print one JSON object of what was made or found, and nothing else, to stdout."),
]

Quiet: TypeAlias = Annotated[
    bool,
    _named(None, "Show no progress and no notes; results and errors are still printed."),
]
