"""Builds mesh fields: of a whole drive, or of its blocks one after the other."""

import importlib.metadata
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatseg.core import ScanSource, Scene, View
from splatseg.render import BackendName
from splatseg.street.build import (
    PUBLISHED,
    DnmpOptions,
    MeshFieldFit,
    MeshFieldInputs,
    build_mesh_field,
)
from splatseg.street.field import MeshField
from splatseg.tasks._observer import Observer
from splatseg.tasks.scene_parts import views_recorded
from splatseg.tasks.street._depths import DepthSample, KeptDepths
from splatseg.tasks.street._inputs import DriveInputs
from splatseg.tasks.street._sources import drive_sources
from splatseg.tasks.street.options import StreetOptions

_CELLS = 5
"""Points are thinned to so many cells along the side of the finest voxel."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BuiltField:
    """A mesh field with its record, and how it came to be."""

    field: MeshField
    fit: MeshFieldFit
    sources: str
    """Where points and depth came from, in words."""

    depths: tuple[DepthSample, ...]
    """Depth of a few of the views."""


class FieldBuilder:
    """Builds fields from what all blocks of a drive have in common.

    Args:
        scene: The scene.
        inputs: What is learned from.
        options: What the fields are called, and made from.
        field_options: How; None is the default, or the published setting where `options` ask
            for it.
        backend: Who renders Gaussians for their depth.
        observer: Is told of the progress.
    """

    def __init__(
        self,
        scene: Scene,
        inputs: DriveInputs,
        *,
        options: StreetOptions,
        field_options: DnmpOptions | None,
        backend: BackendName,
        observer: Observer,
    ) -> None:
        self._scene, self._inputs, self._options = scene, inputs, options
        self._backend: BackendName = backend
        self._observer = observer
        self.chosen = chosen_options(options, field_options)
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
    ) -> BuiltField:
        """Build the field of some views.

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
        inputs, observer = self._inputs, self._observer
        observer.info("points and depth are gathered")
        sources = drive_sources(
            self._scene,
            views,
            depth=self._options.depth,
            scans=scans,
            points=points,
            cell=min(self.chosen.voxels) / inputs.metres / _CELLS,
            backend=self._backend,
        )
        observer.info(f"from {sources.said}")
        cloud = sources.points if near is None else sources.points[near(sources.points)]
        self._took("points", time.monotonic() - began)
        depths = KeptDepths(sources.depths(), views)
        with _Stages(observer, self._took) as stages:
            made = build_mesh_field(
                MeshFieldInputs(
                    points=cloud,
                    depths=depths,
                    views=views,
                    evidence=inputs.evidence,
                    classes=inputs.evidence.classes or self._scene.classes,
                    metres_per_unit=inputs.metres,
                ),
                options=self.chosen,
                layer=self.layer,
                seed=self._options.seed,
                progress=stages.told,
            )
        left_out = {} if inputs.moving is None else {"moving": inputs.moving.record}
        more = {"sources": sources.said, **left_out, **(details or {})}
        info = replace(
            made.field.info,
            evidence=inputs.name,
            views_asked=views_recorded(self._options.views),
            versions=versions(),
            details={**made.field.info.details, **more},
        )
        field = made.field.with_layer(info=info)
        return BuiltField(field=field, fit=made, sources=sources.said, depths=tuple(depths.samples))

    def _took(self, stage: str, seconds: float) -> None:
        self.timings[stage] = self.timings.get(stage, 0.0) + seconds


def versions() -> dict[str, str]:
    """What a field depends on besides its inputs."""
    return {
        "splatseg": importlib.metadata.version("splatseg"),
        "torch": str(torch.__version__),
    }


def chosen_options(options: StreetOptions, given: DnmpOptions | None) -> DnmpOptions:
    """How fields are made: as given, in the published setting where the field is to be that."""
    if given is None:
        return PUBLISHED if options.published else DnmpOptions()
    return replace(given, setting="published") if options.published else given


class _Stages:
    """Stages of a build as an observer hears of them, and how long they took."""

    def __init__(self, observer: Observer, took: Callable[[str, float], None]) -> None:
        self._observer, self._took = observer, took
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
            self._took(self._name, now - self._began)
            self._began = now
        self._open, self._step = None, None
