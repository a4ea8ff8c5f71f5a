"""New photographs of a scene that was fitted: posed in it, and learnt without starting again."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg.core import Capture, Edited, Layer, Scene, View, apply_rows
from splatseg.edit import merge
from splatseg.errors import InputError
from splatseg.fit import (
    FitOptions,
    FitResult,
    Refinement,
    added_gaussians,
    recorded_exposures,
    refinement_options,
)
from splatseg.io.captures import bare_photographs, find_formats, read_capture
from splatseg.io.scene import load_scene, load_scene_layer, save_scene, scene_layer_names
from splatseg.lift import GaussianField
from splatseg.pose.resection import Resection, resect
from splatseg.render import BackendName
from splatseg.tasks.work import EVIDENCE_FOLDER, Observer, check_new_folder, photographed, versions

STEPS_PER_VIEW = 5
"""Steps for each training view, known and new, where none are asked for."""

_START = 0.4
"""Progress of a fit whose learning rates the first step has."""

_SAME_POSE = 1e-3
"""Difference of poses, in distances of cameras, up to which two captures have one world."""

_SEEN_THROUGH = 0.5
"""Share of a pixel's light that is stopped where there is a depth."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Addition:
    """A scene with more photographs, and how they were added."""

    scene: Scene
    """Written; views that are new come last."""

    result: FitResult
    added: tuple[str, ...]
    """Names of the new views."""

    resection: Resection | None
    """How their poses were found; None where they came with them."""

    gaussians: int
    """Gaussians that are new; they are the last rows."""

    layers: tuple[str, ...]
    """Layers that came along; new Gaussians have no label in them yet."""


def add_photographs(
    data: Path,
    base: Path,
    folder: Path,
    *,
    options: FitOptions,
    format: str = "auto",
    strict: bool = False,
    backend: BackendName = "auto",
    observer: Observer,
) -> Addition:
    """Add photographs to a fitted scene, and write it as a new one.

    Photographs without poses are placed by `pose.resection.resect`; those of a capture are taken
    as they are where views that both have show that the worlds are one. What new photographs show
    and the scene does not have gets new Gaussians, behind the old ones; then all are optimised for
    some steps, old photographs included. Every Gaussian keeps its row, so layers come along, and so
    does the scene's own evidence.

    Args:
        data: Folder of photographs, or a capture with some of the scene's own views.
        base: The scene folder; it stays as it is.
        folder: The new scene folder.
        options: Number of steps, `STEPS_PER_VIEW` for each view where they say minutes; seed. The
            comparison with photographs is that of the scene's own fit.
        format: Layout of the capture.
        strict: Whether faulty photographs of the capture are an error.
        backend: Rendering backend.
        observer: Is told of the progress.

    Raises:
        InputError: If the scene has no photographs, nothing is new, no new photograph has a pose,
            or the worlds differ.
        KeyboardInterrupt: If it was interrupted; nothing is written.
    """
    check_new_folder(folder)
    began = time.monotonic()
    scene = load_scene(base)
    known = photographed(scene.train_views)
    if not known:
        raise InputError(f"{base}: expected a scene with photographs at hand, got none.")
    if format != "auto" or not _is_bare(data):
        new, resection = _posed_views(read_capture(data, format=format, strict=strict), scene), None
    else:
        resection = _resected(data, scene, known, backend=backend, observer=observer)
        new = tuple(one.view for one in resection.found)
    comparison = refinement_options(scene.provenance)
    comparison = replace(comparison, seed=options.seed)
    fresh = added_gaussians(scene.gaussians, known, new, options=comparison, backend=backend)
    edited = merge(scene.gaussians, fresh)
    observer.info(f"{len(new)} new views, {len(fresh)} new Gaussians where the scene had none")
    views = (*known, *new)
    steps = options.steps or STEPS_PER_VIEW * len(views)
    run = Refinement(
        edited.gaussians,
        views,
        steps=steps,
        start=_START,
        options=comparison,
        exposures=recorded_exposures(scene.provenance),
        backend=backend,
    )
    with observer.stage("fit") as step:
        for done in range(steps):
            run.step()
            step(done + 1, steps)
    gaussians = run.gaussians()
    layers = _carried(scene, replace(edited, gaussians=gaussians))
    known_steps = scene.provenance.get("steps")
    record = {
        "scene": base.resolve().as_posix(),
        "views": [view.name for view in new],
        "gaussians": len(fresh),
        "steps": steps,
        "versions": versions("splatseg", "torch"),
    }
    made = save_scene(
        replace(
            scene,
            gaussians=gaussians,
            views=(*scene.views, *new),
            root=None,
            provenance=_provenance(scene.provenance, record),
        ),
        folder,
        layers=layers,
        evidence=_own_evidence(scene),
    )
    return Addition(
        scene=made,
        result=FitResult(
            gaussians=gaussians,
            steps=steps + (known_steps if isinstance(known_steps, int) else 0),
            seconds=time.monotonic() - began,
            history=(),
            interrupted=False,
        ),
        added=tuple(view.name for view in new),
        resection=resection,
        gaussians=len(fresh),
        layers=tuple(layers),
    )


def _posed_views(capture: Capture, scene: Scene) -> tuple[View, ...]:
    """The views of a capture that the scene does not have."""
    _check_world(capture, scene)
    names = {view.name for view in scene.views}
    new = tuple(
        replace(view, split="train")
        for view in photographed(capture.views)
        if view.name not in names
    )
    if not new:
        raise InputError(f"{capture.path}: expected a view that the scene does not have, got none.")
    return new


def _resected(
    data: Path, scene: Scene, known: Sequence[View], *, backend: BackendName, observer: Observer
) -> Resection:
    """Poses of the photographs that the scene does not have; at least one."""
    names = {Path(view.name).name for view in scene.views}
    files = [path for path in bare_photographs(data) if path.stem not in names]
    if not files:
        raise InputError(
            f"{data}: expected a photograph whose name no view of the scene has, got none."
        )
    field = GaussianField(scene.gaussians, backend=backend)

    def depth_of(view: View) -> Float[Tensor, "height width"]:
        with field.view(view.camera) as prepared:
            signals = prepared.signals(colour=False)
        # With the mean depth, which `see` has, errors of poses are a quarter larger.
        depth = signals.depth if signals.median_depth is None else signals.median_depth
        return torch.where(signals.alpha > _SEEN_THROUGH, depth, 0).nan_to_num(0.0).cpu()

    with observer.stage("poses") as step:
        found = resect(files, known, depth_of, progress=step)
    for left in found.left_out:
        observer.note(f"left out {left.name}: {left.why}")
    if not found.found:
        raise InputError(
            f"{data}: expected photographs of the scene, none of {len(files)} shows enough of it "
            "to be placed."
        )
    errors = sorted(one.error for one in found.found)
    observer.info(
        f"{data}: {len(found.found)} of {len(files)} photographs placed, median error "
        f"{errors[len(errors) // 2]:.2f} px"
    )
    return found


def _is_bare(data: Path) -> bool:
    """Whether a folder holds photographs and no capture."""
    return data.is_dir() and not find_formats(data) and bool(bare_photographs(data))


def _check_world(capture: Capture, scene: Scene) -> None:
    """Refuse poses of another world than the scene's."""
    own = {view.name: view.camera for view in scene.views}
    both = [view for view in capture.views if view.name in own]
    hint = "; a folder of the new photographs alone has their poses found"
    if not both:
        raise InputError(
            f"{capture.path}: expected some of the scene's own views among its, which say that "
            f"their worlds are one, got none{hint}."
        )
    centres = torch.stack([own[view.name].centre for view in both]).double()
    size = float((centres - centres.mean(dim=0)).norm(dim=1).max().clamp_min(1e-6))
    for view in both:
        one, other = own[view.name].cam_from_world, view.camera.cam_from_world
        turned = float((one[:3, :3] - other[:3, :3]).abs().max())
        shifted = float((own[view.name].centre - view.camera.centre).norm()) / size
        if max(turned, shifted) > _SAME_POSE:
            raise InputError(
                f"{capture.path}: expected view {view.name} where the scene has it, got another "
                f"pose{hint}."
            )


def _carried(scene: Scene, edited: Edited) -> dict[str, Layer]:
    """The layers of a scene for its Gaussians and the new ones."""
    if scene.root is None:
        return {}
    root = scene.root
    return {
        name: apply_rows(load_scene_layer(root, name), edited) for name in scene_layer_names(root)
    }


def _own_evidence(scene: Scene) -> tuple[Path, ...]:
    """Evidence that lies in the scene's own folder."""
    folder = None if scene.root is None else scene.root / EVIDENCE_FOLDER
    if folder is None or not folder.is_dir():
        return ()
    return tuple(sorted(path for path in folder.iterdir() if path.is_dir()))


def _provenance(before: Mapping[str, Any], record: Mapping[str, Any]) -> dict[str, Any]:
    """What the scene was, and each addition to it."""
    return {**before, "added": [*before.get("added", []), dict(record)]}
