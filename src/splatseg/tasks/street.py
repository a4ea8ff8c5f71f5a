"""A mesh field of a drive: deformable neural mesh primitives with semantics."""

import importlib.metadata
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg.core import Scene, View
from splatseg.core.boundary import boundary, convert_fields
from splatseg.errors import InputError
from splatseg.io.captures import read_capture
from splatseg.io.evidence import Evidence, check_map_sizes, find_evidence, open_evidence
from splatseg.io.lock import scene_lock
from splatseg.io.scans import read_scans
from splatseg.io.scene import check_name, load_scene, save_scene
from splatseg.io.scene_fields import new_field_file
from splatseg.io.scene_folder import is_scene
from splatseg.render import BackendName
from splatseg.street.build import MeshFieldFit, build_mesh_field
from splatseg.street.field import MeshField
from splatseg.street.files import save_mesh_field
from splatseg.street.options import PUBLISHED, DnmpOptions
from splatseg.tasks._observer import SILENT, Observer
from splatseg.tasks._street_sources import capture_points, drive_sources
from splatseg.tasks.new_scene import check_new_folder
from splatseg.tasks.render_truth import scene_of_views
from splatseg.tasks.scene_parts import views_asked, views_recorded

_CELLS = 5
"""Points are thinned to so many cells along the side of the finest voxel."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StreetOptions:
    """What a mesh field is made from, and what it is called."""

    field: str = "street"
    """Name of the field: it becomes SCENE/fields/NAME.safetensors."""

    evidence: str | None = None
    """Name of the evidence: a folder of the scene's or of its capture, such as labels_semantic.
    None takes the only one there is."""

    layer: str | None = None
    """Name of the field's layer. None names it like the evidence."""

    zero_is_class: bool = False
    """The id 0 of the evidence's files is a class and not void: ids grow by 1."""

    void: int | None = None
    """A further id of the evidence's files that means none, such as 255."""

    views: tuple[str, ...] = ("train",)
    """Which views are learned from: train, all, or names by comma or by space."""

    scans: Path | None = None
    """Scans of lasers in the world of the scene: where primitives are, and their depth. None uses
    none."""

    depth: str = "auto"
    """Where depth comes from: scans, scans+gaussians (what Gaussians show where no laser looked),
    maps of the capture, gaussians, points, or the name of evidence of depth. auto takes the most
    that is there, scans before maps before gaussians before points."""

    published: bool = False
    """The setting of the papers: networks, rates, 5 000 and 50 000 iterations."""

    seed: int = 0
    """Seed of random choices, recorded in the field."""

    def __post_init__(self) -> None:
        convert_fields(self)
        check_name("field", self.field)
        if self.layer is not None:
            check_name("layer", self.layer)


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
    return save_scene(replace(scene_of_views(capture), provenance={"command": "street"}), new_scene)


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
        MissingPackageError: If embreex is not installed.
    """
    began = time.monotonic()
    options = options or StreetOptions()
    chosen = field_options or (PUBLISHED if options.published else DnmpOptions())
    if options.published and field_options is not None and field_options.setting != "published":
        chosen = replace(field_options, setting="published")
    evidence_name, evidence = _evidence(scene, options)
    views = _views(scene, evidence, options, observer)
    metres = scene.metres_per_unit or 1.0
    if scene.metres_per_unit is None:
        observer.note("the scene does not say how long its unit is; a metre is assumed")
    observer.info("points and depth are gathered")
    sources = drive_sources(
        scene,
        views,
        depth=options.depth,
        scans=None if options.scans is None else read_scans(options.scans),
        points=capture_points(scene.source) if points is None else points,
        cell=min(chosen.voxels) / metres / _CELLS,
        backend=backend,
    )
    observer.info(f"from {sources.said}")
    timings = {"points": time.monotonic() - began}
    with _Stages(observer, timings) as stages:
        made = build_mesh_field(
            sources.points,
            sources.depths(),
            views,
            evidence,
            options=chosen,
            layer=options.layer or evidence_name,
            classes=evidence.classes or scene.classes,
            metres_per_unit=metres,
            seed=options.seed,
            progress=stages.told,
        )
    field = MeshField(
        made.field.mesh,
        made.field.model,
        layer=made.field.layer_names[0],
        info=replace(
            made.field.info,
            evidence=evidence_name,
            views_asked=views_recorded(options.views),
            versions={
                "splatseg": importlib.metadata.version("splatseg"),
                "torch": str(torch.__version__),
            },
            details={**made.field.info.details, "sources": sources.said},
        ),
        radius=made.field.radius,
    )
    return StreetField(
        field=field,
        name=options.field,
        layer=field.layer_names[0],
        fit=made,
        views=views,
        evidence=evidence,
        sources=sources.said,
        timings=timings,
    )


@boundary
def save_street_field(made: StreetField, root: Path) -> Path:
    """Write the field into the scene's folder; one of the same name is replaced.

    Returns:
        The file.

    Raises:
        InputError: If another process works on the scene.
        OutputError: If it cannot be written.
    """
    with scene_lock(root, "saving"):
        path = new_field_file(root, made.name)
        save_mesh_field(made.field, path)
    return path


class _Stages:
    """Stages of a build as an observer hears of them, and how long they took."""

    def __init__(self, observer: Observer, timings: dict[str, float]) -> None:
        self._observer, self._timings = observer, timings
        self._open: Any = None
        self._step: Callable[[int, int], None] | None = None
        self._name = ""
        self._began = 0.0

    def __enter__(self) -> "_Stages":
        self._began = time.monotonic()
        return self

    def __exit__(self, *_: object) -> None:
        self._close()

    def told(self, stage: str, done: int, total: int) -> None:
        """A stage has come so far."""
        if stage != self._name:
            self._close()
            self._name = stage
            self._open = self._observer.stage(stage)
            self._step = self._open.__enter__()
        if self._step is not None:
            self._step(done, total)

    def _close(self) -> None:
        if self._open is not None:
            self._open.__exit__(None, None, None)
            now = time.monotonic()
            self._timings[self._name] = now - self._began
            self._began = now
        self._open, self._step = None, None


def _evidence(scene: Scene, options: StreetOptions) -> tuple[str, Evidence]:
    folders = [folder for folder in (scene.root, scene.source) if folder is not None]
    folder = find_evidence(folders, options.evidence)
    found = open_evidence(folder, zero_is_class=options.zero_is_class, void=options.void)
    if found.kind != "labels":
        raise InputError(f"{folder}: expected evidence of labels, got {found.kind}.")
    return folder.name, found


def _views(
    scene: Scene, evidence: Evidence, options: StreetOptions, observer: Observer
) -> tuple[View, ...]:
    """Views that are asked for, with photographs; those without label maps teach colours alone."""
    asked = views_asked(scene, options.views)
    check_map_sizes(evidence, asked)
    views = tuple(view for view in asked if view.image is not None)
    if not views:
        raise InputError(f"views: expected photographs of the {len(asked)} views, got none.")
    known = set(evidence.view_names)
    lacking = sum(view.name not in known for view in views)
    if lacking == len(views):
        raise InputError(
            f"evidence: expected label maps of at least one of the {len(views)} views, got none."
        )
    if lacking:
        observer.note(f"{lacking} of {len(views)} views have no label map and teach colours alone")
    return views


def _same(one: Path, other: Path) -> bool:
    return one.resolve() == other.resolve()
