"""What a scene offers to select by: the sources, each opened by name."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from splatseg.core import InstanceTree, Labels, Layer, Scene
from splatseg.errors import InputError
from splatseg.io.scene import scene_layer_names
from splatseg.prompting.layer_source import LayerSource
from splatseg.prompting.sources import MembershipSource
from splatseg.prompting.view_cache import ViewCache
from splatseg.tasks._observer import Observer
from splatseg.tasks.scene_parts import whole_layer
from splatseg.tasks.select_options import SelectOptions


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OpenedSource:
    """A source, and what it is to be called."""

    source: MembershipSource
    name: str
    """Its kind: features, masks, layer, or the type of one that was given."""

    layer: str | None = None
    """The layer that it reads."""

    evidence: str | None = None
    """The evidence that it reads."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Offer:
    """What an opener may take."""

    scene: Scene
    options: SelectOptions
    views: ViewCache
    layers: Mapping[str, Layer] | None
    """Layers at hand; others are in the scene's folder."""

    observer: Observer


Opener = Callable[[Offer], OpenedSource | None]
"""Opens a source; None where the scene has nothing of its kind. What is named and is not there,
or does not fit, is an `InputError`."""


def open_source(offer: Offer) -> OpenedSource:
    """The source that the options ask for.

    Raises:
        InputError: If there is no such source, or the scene has nothing to select by.
    """
    options = offer.options
    if options.source != "auto":
        if options.source not in OPENERS:
            known = ", ".join(("auto", *OPENERS))
            raise InputError(f"source: expected one of {known}, got {options.source!r}.")
        openers = {options.source: OPENERS[options.source]}
    else:
        openers = OPENERS
    for opener in openers.values():
        opened = opener(offer)
        if opened is not None:
            return opened
    wanted = "masks, features or a layer" if options.source == "auto" else options.source
    raise InputError(
        f"source: expected something that says which Gaussians belong together ({wanted}), and "
        "the scene has none; make masks with `splatseg see` and a layer with `splatseg segment`."
    )


def _open_layer(offer: Offer) -> OpenedSource | None:
    """The layer that is named, or the one that says most of instances."""
    name = offer.options.from_layer or _best_layer(offer)
    if name is None:
        return None
    layer = whole_layer(offer.scene, name, offer.layers)
    if not isinstance(layer, Labels | InstanceTree):
        if offer.options.source == "auto":
            return None
        kind = type(layer).__name__.lower()
        raise InputError(f"from_layer: expected labels or a tree, {name!r} is of {kind}.")
    source = LayerSource(layer, offer.scene.gaussians, name=name, views=offer.views)
    return OpenedSource(source=source, name="layer", layer=name)


def _best_layer(offer: Offer) -> str | None:
    """A tree before labels of instances before other labels; of equals the first by name."""
    best: tuple[int, str] | None = None
    for name in _layer_names(offer):
        layer = whole_layer(offer.scene, name, offer.layers)
        if isinstance(layer, InstanceTree):
            rank = 0
        elif isinstance(layer, Labels):
            rank = 1 if layer.info.instances else 2
        else:
            continue
        if best is None or (rank, name) < best:
            best = (rank, name)
    if best is None:
        return None
    offer.observer.note(f"selecting by layer {best[1]} (see from_layer)")
    return best[1]


def _layer_names(offer: Offer) -> list[str]:
    names = set(offer.layers or ())
    if offer.scene.root is not None:
        names |= set(scene_layer_names(offer.scene.root))
    return sorted(names)


OPENERS: dict[str, Opener] = {"layer": _open_layer}
"""Sources by name, in the order that ``auto`` tries them."""
