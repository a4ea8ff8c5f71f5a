"""What a 2D model or a person is shown of a view: its photograph, or a render if there is none."""

from collections.abc import Sequence
from pathlib import Path

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from splatseg.core import Renderable, Scene, View
from splatseg.core.models import Image
from splatseg.errors import InputError
from splatseg.io.evidence import save_render
from splatseg.io.images import image_camera, load_image
from splatseg.lift import GaussianField
from splatseg.render import BackendName, PreparedView

_GREYS = (0.0, 1.0, 0.5)
# A scene that fills its views has no background to speak of, and it stays black.
_EMPTY = 0.05
_ALIKE = 0.15
_SOLID = 0.9
_LOOKED_AT = 12
_SMALL = 128


class ViewImages:
    """Gives the picture of a view, and keeps those that it drew beside the evidence.

    Models see images only; that some of them are renders is this task's business. What nothing
    covers is of the grey (black, white, half) that the scene itself has least of, so that a dark
    thing has an outline.

    Args:
        scene: Whose Gaussians are drawn.
        backend: Who renders.
    """

    def __init__(self, scene: Scene, *, backend: BackendName = "auto") -> None:
        self._field = GaussianField(scene.gaussians, backend=backend)
        self._views = tuple(view for view in scene.views if view.image is None)
        self._background: float | None = None
        self.drawn = 0
        """Views drawn so far."""

    def __call__(self, view: View, folder: Path) -> Image:
        """The photograph of a view, uint8 (H, W, 3); its render where it has none.

        Args:
            view: The view.
            folder: The evidence as it is being written; renders are kept in its ``_renders``.

        Raises:
            MissingFileError: If the view has a photograph that is not where it was.
            FileFormatError: If it cannot be decoded, or its size is not the camera's.
        """
        if view.image is not None:
            return load_image(view)
        if self._background is None:
            self._background = background_of(self._field, self._views)
        colour, alpha = _drawn(self._field, view)
        over = (colour + (1 - alpha)[..., None] * self._background).clamp(0, 1)
        image = (over * 255 + 0.5).to(torch.uint8)
        save_render(image, folder, view.name)
        self.drawn += 1
        return image


def shown_image(view: View, prepared: PreparedView) -> UInt8[Tensor, "height width 3"]:
    """The photograph of a view, or the render of it."""
    if view.image is not None:
        return load_image(view)
    with torch.no_grad():
        colour = prepared.render().image
    return (colour.cpu().clamp(0, 1) * 255 + 0.5).to(torch.uint8)


def background_of(field: Renderable, views: Sequence[View]) -> float:
    """The grey, 0 to 1, that fewest solid pixels of some views resemble; black if none is empty.

    It depends on the field and on all views, not on which of them are asked for, so that work
    that was stopped goes on over the same.
    """
    step = max(1, len(views) // _LOOKED_AT)
    drawn = [_drawn(field, view, longest=_SMALL) for view in views[::step][:_LOOKED_AT]]
    alpha = torch.cat([alpha.flatten() for _, alpha in drawn])
    if float((1 - alpha).mean()) < _EMPTY:
        return _GREYS[0]
    colours = torch.cat([colour.flatten(0, 1) for colour, _ in drawn])[alpha > _SOLID]
    alike = [int(((colours - grey).abs() < _ALIKE).all(dim=1).sum()) for grey in _GREYS]
    return _GREYS[alike.index(min(alike))]


def _drawn(
    field: Renderable, view: View, *, longest: int | None = None
) -> tuple[Float[Tensor, "height width 3"], Float[Tensor, "height width"]]:
    """Colour over black, and alpha."""
    camera = view.camera if longest is None else image_camera(view, longest)
    with field.view(camera) as looked_at:
        signals = looked_at.signals()
    if signals.colour is None:
        raise InputError("field: expected one with colours, got one without.")
    return signals.colour, signals.alpha
