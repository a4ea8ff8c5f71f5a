"""A new scene for Gaussians that learnt along with a layer."""

from dataclasses import replace
from pathlib import Path
from typing import Any

from splatseg.core import Layer, Scene
from splatseg.edit import Document, save_document
from splatseg.edit.document import BASE, HISTORY
from splatseg.errors import InputError
from splatseg.io.evidence import Evidence
from splatseg.methods import Method
from splatseg.tasks.checkpoint_options import CheckpointOptions
from splatseg.tasks.new_scene import check_new_folder


def refined_folder(
    method: Method, options: Any, checkpoints: CheckpointOptions | None
) -> Path | None:
    """The folder of the new scene that the method's options name, if they name one.

    Raises:
        InputError: If something is there, or such a training is to go on.
    """
    folder: Path | None = None if method.refines is None else getattr(options, method.refines)
    if folder is None:
        return None
    if checkpoints is not None and checkpoints.resume:
        raise InputError(
            f"resume: a training with {method.refines} keeps nothing to go on from; leave one out."
        )
    check_new_folder(folder)
    return folder


def save_refined(
    scene: Scene, layer: Layer, folder: Path, name: str, *, evidence: Evidence
) -> Path:
    """Write the scene with the layer, whole or not at all; evidence of its own comes along.

    Returns:
        The file of the layer.

    Raises:
        InputError: If something is there already.
    """
    provenance = {
        key: value for key, value in scene.provenance.items() if key not in (HISTORY, BASE)
    }
    provenance["refined"] = {
        "scene": None if scene.root is None else scene.root.resolve().as_posix(),
        "layer": name,
        "method": layer.info.method,
    }
    document = Document(scene=replace(scene, provenance=provenance), layers={name: layer})
    save_document(document, folder, evidence=own_evidence(evidence, scene))
    return folder / "layers" / f"{name}.npz"


def own_evidence(evidence: Evidence, scene: Scene) -> tuple[Path, ...]:
    """Evidence that lies in the scene's own folder, which the new one could not find."""
    if scene.root is None:
        return ()
    inside = evidence.folder.resolve().parent == (scene.root / "evidence").resolve()
    return (evidence.folder,) if inside else ()
