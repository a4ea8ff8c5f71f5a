"""True label maps of views, from a labelled mesh or labelled points."""

import re
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from splatseg.core import (
    Capture,
    Gaussians,
    LabelledMesh,
    LabelledPoints,
    LayerInfo,
    Scene,
)
from splatseg.core.boundary import boundary
from splatseg.evaluate import PointSurfaceOptions, SurfaceField
from splatseg.io.surfaces import read_surface
from splatseg.tasks.render import Rendering, RenderingOptions, render_views
from splatseg.tasks.work import SILENT, Observer, scene_of_capture

_NO_CLASSES = re.compile(r"instance|object|part|segment|track", re.IGNORECASE)
"""Names of labels that are no classes, so that the class table does not name them."""


@boundary
def render_truth(
    surface: LabelledMesh | LabelledPoints | Path,
    source: Scene | Capture,
    output: Path,
    *,
    options: RenderingOptions | None = None,
    points: PointSurfaceOptions | None = None,
    zero_is_class: bool = False,
    void: int | None = None,
    observer: Observer = SILENT,
) -> Rendering:
    """Draw what views see of a labelled surface, as `render_views` draws Gaussians.

    OUTPUT/<labels>/<view>.png has the ids, 16 bit, 0 where nothing is met or the label is void, in
    the photograph's own pixels: what `evaluate_scene` takes as truth.

    Args:
        surface: A mesh or points in the world of the views, or a file of them, see
            `splatseg.io.surfaces.read_surface`.
        source: Whose views are drawn; of a scene the Gaussians are not looked at.
        output: Folder to write to.
        options: Which views, and which labels of the surface (`what`), perhaps depth and alpha;
            nothing in `what` is all labels, and None those of the test views.
        points: How points become a surface.
        zero_is_class: Of a file: the id 0 is a class and not void, ids grow by 1.
        void: Of a file: a further id that means void.
        observer: Is told of the progress.

    Raises:
        InputError: If the surface has no such labels, there is no such split, or something else
            lies in the way.
        MissingPackageError: If embreex is not installed.
    """
    source_ids = isinstance(surface, Path) and zero_is_class
    if isinstance(surface, Path):
        surface = read_surface(surface, zero_is_class=zero_is_class, void=void)
    infos = {name: _info(name, ids, source_ids=source_ids) for name, ids in surface.labels.items()}
    field = SurfaceField(surface, points=points, infos=infos)
    options = options or RenderingOptions(what=())
    if not options.what:
        options = replace(options, what=tuple(surface.labels))
    scene = source if isinstance(source, Scene) else scene_of_views(source)
    return render_views(scene, output, options=options, field=field, observer=observer)


def _info(name: str, ids: Tensor, *, source_ids: bool) -> LayerInfo:
    present = [int(id) for id in ids.unique().tolist() if id >= 0]
    return LayerInfo(
        names={id: f"{name} {id}" for id in present} if _NO_CLASSES.search(name) else {},
        source_ids={id: id - 1 for id in present} if source_ids else None,
    )


def scene_of_views(capture: Capture) -> Scene:
    """The views of a capture, without Gaussians."""
    none = torch.zeros(0, 3)
    gaussians = Gaussians(
        means=none,
        rotations=torch.zeros(0, 4),
        scales=none,
        opacities=torch.zeros(0),
        sh=torch.zeros(0, 1, 3),
    )
    return scene_of_capture(capture, gaussians)
