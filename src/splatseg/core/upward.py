"""What values do by packages above the core, when a person asks them to.

`View.read_image`, `Scene.layers` and the previews of notebooks start from a value, and need files
and pictures. These are the core's only imports of packages above it, each in a function; the
contracts in pyproject.toml name them. Nothing that the core computes goes through here.
"""

from pathlib import Path
from typing import TYPE_CHECKING

from torch import Tensor

if TYPE_CHECKING:
    from splatseg.core.instance_tree import Layer
    from splatseg.core.scene import View


class Previewed:
    """A value that notebooks show as a picture."""

    __slots__ = ()

    def _repr_html_(self) -> str:
        from splatseg.report.notebook import preview_html

        return preview_html(self)


def load_image(view: "View", *, longest: int | None) -> Tensor:
    """The photograph of a view."""
    from splatseg.io.images import load_image

    return load_image(view, longest=longest)


def scene_layer_names(root: Path) -> tuple[str, ...]:
    """Names of the layers of a scene folder."""
    from splatseg.io.scene import scene_layer_names

    return scene_layer_names(root)


def load_scene_layer(root: Path, name: str) -> "Layer":
    """A layer of a scene folder."""
    from splatseg.io.scene import load_scene_layer

    return load_scene_layer(root, name)
