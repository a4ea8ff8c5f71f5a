"""What is written of a selection beside its layer: splats of it alone, and pictures."""

from collections.abc import Sequence
from pathlib import Path

import torch
from jaxtyping import UInt8
from torch import Tensor

from splatseg.core import Scene, Selection
from splatseg.core.boundary import boundary
from splatseg.errors import InputError, MissingFileError
from splatseg.io.images import save_png
from splatseg.io.paths import path_inside
from splatseg.io.splats import write_splats
from splatseg.lift.field import selection_labels
from splatseg.lift.label_maps import view_label_map
from splatseg.prompting.prompts import Lasso, SelectionPrompt, ViewPrompt
from splatseg.render import BackendName, prepare
from splatseg.report.selection_picture import selection_picture
from splatseg.tasks._view_images import shown_image

_SELECTED = 1


@boundary
def check_selection_file(path: Path, name: str) -> Path:
    """The file that the splats of a selection are written to; before long work.

    Args:
        path: A file by its suffix, or a folder, in which it becomes NAME.ply.
        name: Name of the layer.

    Raises:
        MissingFileError: If the folder of a file does not exist.
        InputError: If a folder is to be where a file is.
    """
    if path.suffix and not path.is_dir():
        if not path.parent.is_dir():
            raise MissingFileError(f"{path}: expected a folder that exists, got {path.parent}.")
        return path
    if path.is_file():
        raise InputError(f"{path}: expected a folder or a name with a suffix, got a file.")
    return path / f"{name}.ply"


@boundary
def save_selected_splats(selection: Selection, scene: Scene, path: Path) -> None:
    """Write the selected Gaussians alone; the format is that of the suffix.

    Args:
        selection: What is selected, at least one.
        scene: Its scene.
        path: The file; its folder is made.

    Raises:
        InputError: If nothing is selected, or the suffix is of no format that is written.
    """
    if not selection.count:
        raise InputError("selection: expected Gaussians to write, got none.")
    path.parent.mkdir(parents=True, exist_ok=True)
    write_splats(scene.gaussians[selection.ids], path)


@boundary
def draw_selection(
    selection: Selection,
    scene: Scene,
    prompts: Sequence[SelectionPrompt],
    folder: Path,
    *,
    backend: BackendName = "auto",
) -> tuple[Path, ...]:
    """Write a picture of each view in which something was shown, and give the files.

    The selection is bright and outlined in the photograph, or in the render of a view that has
    none, with the prompts on top.

    Args:
        selection: What was selected.
        scene: Its scene.
        prompts: What it was selected by.
        folder: Where FOLDER/VIEW.png goes; it is made.
        backend: Who renders.
    """
    shown = [prompt for prompt in prompts if isinstance(prompt, ViewPrompt | Lasso)]
    views = {prompt.view.name: prompt.view for prompt in shown}
    folder.mkdir(parents=True, exist_ok=True)
    files: list[Path] = []
    for name, view in views.items():
        with prepare(scene.gaussians, view.camera, backend=backend) as prepared:
            mask = view_label_map(prepared, selection_labels(selection)).ids.cpu() == _SELECTED
            image = shown_image(view, prepared)
        picture = _picture(image, mask, [p for p in shown if p.view.name == name])
        path = path_inside(folder, f"{name}.png")
        save_png(picture, path)
        files.append(path)
    return tuple(files)


def _picture(
    image: Tensor, mask: Tensor, prompts: Sequence[ViewPrompt | Lasso]
) -> UInt8[Tensor, "height width 3"]:
    """All prompts of one view on its picture."""
    polygons = [prompt.polygon for prompt in prompts if isinstance(prompt, Lasso)]
    in_view = [prompt for prompt in prompts if isinstance(prompt, ViewPrompt)]
    for prompt in in_view:
        if prompt.box is not None:
            x0, y0, x1, y1 = prompt.box.tolist()
            polygons.append(torch.tensor([[x0, y0], [x1, y0], [x1, y1], [x0, y1]]))
    return selection_picture(
        image,
        mask,
        points=torch.cat([torch.zeros(0, 2), *(prompt.points for prompt in in_view)]),
        positive=torch.cat([torch.zeros(0).bool(), *(prompt.signs for prompt in in_view)]),
        polygons=tuple(polygons),
        strokes=_together([prompt.scribble for prompt in in_view]),
        negative_strokes=_together([prompt.negative_scribble for prompt in in_view]),
    )


def _together(strokes: Sequence[Tensor | None]) -> Tensor | None:
    given = [pixels for pixels in strokes if pixels is not None]
    return torch.stack(given).any(dim=0) if given else None
