"""What the options of a method name besides its evidence."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from splatseg.core import Features, Layer, Scene
from splatseg.core.instance_tree import layer_kind
from splatseg.errors import InputError
from splatseg.io.evidence import FeatureEvidence, find_evidence, open_evidence
from splatseg.methods import Method
from splatseg.tasks.scene_parts import layer_of


def trained_features(
    scene: Scene, method: Method, options: Any, layers: Mapping[str, Layer] | None
) -> Features | None:
    """The layer that the method's options name to be read again, if they name one."""
    name = None if method.trained is None else getattr(options, method.trained)
    if name is None:
        return None
    layer = layer_of(scene, name, layers)
    if not isinstance(layer, Features):
        raise InputError(
            f"{method.trained}: expected a layer of features, got {name!r} of {layer_kind(layer)}."
        )
    return layer


def guiding_features(scene: Scene, method: Method, options: Any) -> FeatureEvidence | None:
    """The evidence of features that the method's options name besides, if they name some."""
    asked = None if method.guidance is None else getattr(options, method.guidance)
    if asked is None:
        return None
    folders: list[Path] = [folder for folder in (scene.root, scene.source) if folder is not None]
    evidence = open_evidence(find_evidence(folders, asked))
    if not isinstance(evidence, FeatureEvidence):
        raise InputError(
            f"{method.guidance}: expected evidence of features, got {asked!r} of {evidence.kind}."
        )
    return evidence
