"""A mesh field of a drive: deformable neural mesh primitives with semantics."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from jaxtyping import Float
from torch import Tensor

from splatseg.core import Scene, View
from splatseg.core.boundary import boundary
from splatseg.errors import InputError
from splatseg.io.captures import read_capture
from splatseg.io.evidence import Evidence
from splatseg.io.scene import load_scene, new_field_file, remove_field_folder, save_scene
from splatseg.io.scene_folder import is_scene, scene_lock
from splatseg.render import BackendName
from splatseg.street.build import DnmpOptions, MeshFieldFit
from splatseg.street.field import MeshField
from splatseg.street.files import save_mesh_field
from splatseg.tasks._moving import LeftOut
from splatseg.tasks._observer import SILENT, Observer
from splatseg.tasks.new_scene import check_new_folder
from splatseg.tasks.render_truth import scene_of_views
from splatseg.tasks.street._build import FieldBuilder
from splatseg.tasks.street._depths import DepthSample
from splatseg.tasks.street._inputs import drive_inputs
from splatseg.tasks.street._sources import capture_points
from splatseg.tasks.street.options import StreetOptions


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StreetField:
    """A mesh field, and what it was made from."""

    field: MeshField
    name: str
    """What the field is to be called."""

    layer: str
    fit: MeshFieldFit
    views: tuple[View, ...]
    evidence: Evidence
    sources: str
    """Where points and depth came from, in words."""

    depths: tuple[DepthSample, ...] = ()
    """Depth of a few of the views, to measure shapes by."""

    moving: LeftOut | None = None
    """What was left out with moving things; None where nothing was to be."""

    timings: Mapping[str, float]
    """Seconds by stage."""

    @property
    def facts(self) -> dict[str, Any]:
        """Figures in values that JSON holds."""
        mesh = self.field.mesh
        records = self.fit.geometry.records
        last = self.fit.radiance.records[-1]
        return {
            "field": self.name,
            "layer": self.layer,
            "primitives": len(mesh),
            "primitives_by_level": [
                int((mesh.levels == level).sum()) for level in range(len(mesh.sizes))
            ],
            "classes": len(self.field.model.ids),
            "views": len(self.views),
            "rays": self.fit.radiance.rays,
            "hits": self.fit.radiance.hits,
            "depth_rays": self.fit.geometry.rays,
            "depth_loss": None if not records else round(records[-1].loss, 6),
            "removed_around_cameras": self.fit.geometry.enclosing,
            "removed_before_surfaces": self.fit.geometry.carved,
            "iterations": last.iterations,
            "colour_loss": round(last.colour_loss, 6),
            "semantic_loss": round(last.semantic_loss, 6),
            "radius": self.field.radius,
            "sources": self.sources,
            **({} if self.moving is None else {"moving": self.moving.record}),
            "stage_seconds": {name: round(value, 3) for name, value in self.timings.items()},
        }


@boundary
def open_drive(path: Path, *, new_scene: Path | None = None, data: Path | None = None) -> Scene:
    """The scene of a drive: one that is there, or a new one without Gaussians of a capture.

    Args:
        path: A scene folder, or that of a capture.
        new_scene: With a capture, the scene folder to write; one without Gaussians that an earlier
            call wrote of it is opened.
        data: With a scene, the capture's folder, where it was moved.

    Raises:
        InputError: If it is neither, or the new scene's place is taken.
        MissingFileError: If there is nothing at the path.
    """
    if is_scene(path):
        if new_scene is not None:
            raise InputError(
                f"new_scene: expected none with {path}, which is a scene, got {new_scene}."
            )
        return load_scene(path, data=data)
    capture = read_capture(path)
    if new_scene is None:
        raise InputError(
            f"new_scene: expected a scene folder to write the field of {path} to, a capture, "
            "got none."
        )
    if is_scene(new_scene):
        there = load_scene(new_scene)
        if len(there.gaussians) or there.source is None or not _same(there.source, path):
            raise InputError(
                f"{new_scene}: expected a new folder or a scene without Gaussians of {path}, got "
                "another scene; give that scene instead of the capture."
            )
        return there
    check_new_folder(new_scene)
    save_scene(replace(scene_of_views(capture), provenance={"command": "street"}), new_scene)
    # As later calls see it: matrices of a file are those of the capture but for the last bits.
    return load_scene(new_scene)


@boundary
def street_field(
    scene: Scene,
    *,
    options: StreetOptions | None = None,
    field_options: DnmpOptions | None = None,
    points: Float[Tensor, "n 3"] | None = None,
    backend: BackendName = "auto",
    observer: Observer = SILENT,
) -> StreetField:
    """Make the mesh field of a drive: primitives at its surfaces, with colours and classes.

    Args:
        scene: The scene; it stays as it is. `save_street_field` writes the field into it. It may
            have no Gaussians.
        options: What the field is made from.
        field_options: How; None is the default, or the published setting where `options` ask
            for it.
        points: On surfaces, world, scene units, to put primitives at; None takes those of the
            capture and of scans, where there are any.
        backend: Who renders Gaussians for their depth.
        observer: Is told of the progress.

    Raises:
        InputError: If evidence, photographs, points or depth are not there, or do not fit together.
    """
    options = options or StreetOptions()
    if options.block_length is not None:
        raise InputError(
            f"block_length: expected none of one field, got {options.block_length:g} m; "
            "`make_street_field` makes drives in blocks."
        )
    with drive_inputs(scene, options, observer) as inputs:
        builder = FieldBuilder(
            scene,
            inputs,
            options=options,
            field_options=field_options,
            backend=backend,
            observer=observer,
        )
        made = builder.build(
            inputs.views,
            scans=inputs.scans,
            points=capture_points(inputs.capture) if points is None else points,
        )
    return StreetField(
        field=made.field,
        name=options.field,
        layer=made.field.layer_names[0],
        fit=made.fit,
        # As the scene has them: masks without moving things were there for the training alone.
        views=tuple(scene.view(view.name) for view in inputs.views),
        evidence=inputs.evidence,
        sources=made.sources,
        depths=made.depths,
        moving=inputs.moving,
        timings=builder.timings,
    )


@boundary
def save_street_field(made: StreetField, root: Path) -> Path:
    """Write the field into the scene's folder; one of the same name in any form is replaced.

    Returns:
        The file.

    Raises:
        InputError: If another process works on the scene.
        OutputError: If it cannot be written.
    """
    with scene_lock(root, "saving"):
        path = new_field_file(root, made.name)
        save_mesh_field(made.field, path)
        remove_field_folder(root, made.name)
    return path


def _same(one: Path, other: Path) -> bool:
    return one.resolve() == other.resolve()
