"""Mesh fields of drives: points, depth, photographs and label maps become primitives."""

import time
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from jaxtyping import Bool, Float
from torch import Tensor

from splatseg.core import ScanSource, Scene, View
from splatseg.core.boundary import boundary
from splatseg.errors import InputError
from splatseg.io.captures import read_capture
from splatseg.io.evidence import Evidence
from splatseg.io.scene import load_scene, save_scene
from splatseg.io.scene_fields import new_field_file, remove_field_folder
from splatseg.io.scene_folder import is_scene, scene_lock
from splatseg.render import BackendName
from splatseg.street.build import (
    PUBLISHED,
    DnmpOptions,
    MeshFieldFit,
    MeshFieldInputs,
    build_mesh_field,
)
from splatseg.street.field import MeshField
from splatseg.street.files import save_mesh_field
from splatseg.tasks.moving import LeftOut
from splatseg.tasks.street_inputs import (
    DriveInputs,
    StreetOptions,
    capture_points,
    drive_inputs,
    drive_sources,
)
from splatseg.tasks.work import (
    SILENT,
    Observer,
    Work,
    check_new_folder,
    layer_versions,
    scene_of_capture,
    view_spec,
)

_CELLS = 5
"""Points are thinned to so many cells along the side of the finest voxel."""


class FieldBuilder:
    """Builds fields from what all blocks of a drive have in common.

    Args:
        work: The scene.
        inputs: What is learned from.
        options: What the fields are called, and made from.
        field_options: How; None is the default, or the published setting where `options` ask
            for it.
    """

    def __init__(
        self,
        work: Work,
        inputs: DriveInputs,
        options: StreetOptions,
        field_options: DnmpOptions | None,
    ) -> None:
        self.work, self.inputs, self.options = work, inputs, options
        self.chosen = selected_options(options, field_options)
        self.layer = options.layer or inputs.name
        self.timings: dict[str, float] = {}

    def build(
        self,
        views: Sequence[View],
        *,
        scans: ScanSource | None,
        points: Float[Tensor, "n 3"] | None,
        near: Callable[[Float[Tensor, "n 3"]], Bool[Tensor, "n"]] | None = None,
        details: Mapping[str, Any] | None = None,
    ) -> tuple[MeshField, MeshFieldFit, str]:
        """Build the field of some views: it with its record, how, and whence in words.

        Args:
            views: To learn from.
            scans: In the world of the scene.
            points: Of the capture, world, scene units.
            near: Says which points there may be primitives at; None allows all.
            details: More for the record of the field.

        Raises:
            InputError: If there are no points or no depth, or they cannot be used.
        """
        began = time.monotonic()
        inputs, observer = self.inputs, self.work.observer
        observer.info("points and depth are gathered")
        cloud, depths, said = drive_sources(
            self.work,
            views,
            depth=self.options.depth,
            scans=scans,
            points=points,
            cell=min(self.chosen.voxels) / inputs.metres / _CELLS,
        )
        observer.info(f"from {said}")
        cloud = cloud if near is None else cloud[near(cloud)]
        self._took("points", time.monotonic() - began)
        with _stages(observer, self._took) as told:
            made = build_mesh_field(
                MeshFieldInputs(
                    points=cloud,
                    depths=depths(),
                    views=views,
                    evidence=inputs.evidence,
                    classes=inputs.evidence.classes or self.work.scene.classes,
                    metres_per_unit=inputs.metres,
                ),
                options=self.chosen,
                layer=self.layer,
                seed=self.options.seed,
                progress=told,
            )
        left_out = {} if inputs.moving is None else {"moving": inputs.moving.record}
        more = {"sources": said, **left_out, **(details or {})}
        info = replace(
            made.field.info,
            evidence=inputs.name,
            views_asked=view_spec(self.options.views),
            versions=layer_versions(),
            details={**made.field.info.details, **more},
        )
        return made.field.with_layer(info=info), made, said

    def _took(self, stage: str, seconds: float) -> None:
        self.timings[stage] = self.timings.get(stage, 0.0) + seconds


def selected_options(options: StreetOptions, given: DnmpOptions | None) -> DnmpOptions:
    """How fields are made: as given, in the published setting where the field is to be that."""
    if given is None:
        return PUBLISHED if options.published else DnmpOptions()
    return replace(given, setting="published") if options.published else given


@contextmanager
def _stages(
    observer: Observer, took: Callable[[str, float], None]
) -> Generator[Callable[[str, int, int], None]]:
    """Tells an observer of the stages of a build, and how long they took."""
    stack, name, began = ExitStack(), "", time.monotonic()
    step: Callable[[int, int], None] | None = None

    def close() -> None:
        nonlocal began
        stack.close()
        now = time.monotonic()
        if name:
            took(name, now - began)
            began = now

    def told(stage: str, done: int, total: int) -> None:
        nonlocal name, step
        if stage != name:
            close()
            name, step = stage, stack.enter_context(observer.stage(stage))
        if step is not None:
            step(done, total)

    try:
        yield told
    finally:
        close()


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
        if len(there.gaussians) or there.source is None or there.source.resolve() != path.resolve():
            raise InputError(
                f"{new_scene}: expected a new folder or a scene without Gaussians of {path}, got "
                "another scene; give that scene instead of the capture."
            )
        return there
    check_new_folder(new_scene)
    save_scene(scene_of_capture(capture, provenance={"command": "street"}), new_scene)
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
        backend: Rendering backend of Gaussians, for their depth.
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
    work = Work(scene=scene, backend=backend, observer=observer)
    with drive_inputs(work, options) as inputs:
        builder = FieldBuilder(work, inputs, options, field_options)
        field, fit, said = builder.build(
            inputs.views,
            scans=inputs.scans,
            points=capture_points(inputs.capture) if points is None else points,
        )
    return StreetField(
        field=field,
        name=options.field,
        layer=field.layer_names[0],
        fit=fit,
        # As the scene has them: masks without moving things were there for the training alone.
        views=tuple(scene.view(view.name) for view in inputs.views),
        evidence=inputs.evidence,
        sources=said,
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
