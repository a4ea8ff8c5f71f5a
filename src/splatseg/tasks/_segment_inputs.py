"""What the options of a method name besides its evidence."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from splatseg.core import Features, Layer, Scene
from splatseg.core.instance_tree import layer_kind
from splatseg.errors import InputError
from splatseg.io.evidence import Evidence, evidence_names, find_evidence, open_evidence
from splatseg.methods import ANY_COMPANION, Method
from splatseg.tasks._observer import Observer
from splatseg.tasks.named_models import model_of
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


def named_models(
    method: Method, options: Any, *, report: Callable[[str], None]
) -> dict[str, object]:
    """The models that the method's options name, by option.

    Raises:
        InputError: If there is no such model, or it answers something else.
    """
    found: dict[str, object] = {}
    for option, protocol in method.models.items():
        named = getattr(options, option)
        if named is None:
            continue
        model = model_of(named, report=report)
        if not isinstance(model, protocol):
            raise InputError(
                f"{option}: expected a model that is a {protocol.__name__}, got {model.name}."
            )
        found[option] = model
    return found


def with_companions(scene: Scene, method: Method, options: Any, observer: Observer) -> Any:
    """The options, those that take any companion with the name of one that is at hand.

    Of several, one whose name has ``sam`` in it comes first, then the first by name.

    Raises:
        InputError: If an option takes any and there is none.
    """
    folders = scene.evidence_folders
    for option, kinds in method.companions.items():
        if getattr(options, option) != ANY_COMPANION:
            continue
        names = [
            name
            for name in evidence_names(folders)
            if open_evidence(find_evidence(folders, name)).kind in kinds
        ]
        if not names:
            wanted = " or ".join(kinds)
            raise InputError(
                f"{option}: expected evidence of {wanted} at hand, got none; make some with "
                f"`splatseg see SCENE --model ...` (docs/models.md says which models give "
                f"{wanted}), or do without by --{option.replace('_', '-')} None."
            )
        name = min(names, key=lambda name: ("sam" not in name, name))
        observer.note(f"{option}: {name}, of {len(names)} at hand")
        options = replace(options, **{option: name})
    return options


def named_companions(scene: Scene, method: Method, options: Any) -> dict[str, Evidence]:
    """The evidence that the method's options name besides, by option."""
    folders = scene.evidence_folders
    found: dict[str, Evidence] = {}
    for option, kinds in method.companions.items():
        asked = getattr(options, option)
        if asked is None:
            continue
        names = evidence_names(folders)
        if asked not in names:
            known = ", ".join(names) or "there is none; `splatseg see` makes some"
            raise InputError(f"{option}: expected one of those at hand ({known}), got {asked!r}.")
        evidence = open_evidence(find_evidence(folders, asked))
        if evidence.kind not in kinds:
            raise InputError(
                f"{option}: expected evidence of {' or '.join(kinds)}, got {asked!r} of "
                f"{evidence.kind}."
            )
        found[option] = evidence
    return found
