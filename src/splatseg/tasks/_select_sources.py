"""What a scene offers to select by: the sources, each opened by name."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from splatseg.core import (
    FeatureMap,
    Features,
    InstanceTree,
    Labels,
    Layer,
    Scene,
    View,
    VoxelFeatures,
)
from splatseg.core.instance_tree import layer_kind
from splatseg.errors import InputError
from splatseg.io.evidence import evidence_names, find_evidence, open_evidence
from splatseg.io.scene import scene_layer_names
from splatseg.lift.affinity import KIND
from splatseg.methods.saga import trained_as_published
from splatseg.prompting.feature_source import (
    FeatureMembership,
    FeatureMembershipOptions,
    ThresholdRule,
)
from splatseg.prompting.layer_source import LayerSource
from splatseg.prompting.pipeline import MembershipSource
from splatseg.prompting.seen import ViewCache
from splatseg.render import BackendName
from splatseg.tasks._observer import Observer
from splatseg.tasks.scene_parts import whole_layer
from splatseg.tasks.segment import segment
from splatseg.tasks.segment_options import SegmentOptions
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

    rule: ThresholdRule | None = None
    """The threshold of features."""

    published: bool = False
    """Whether these are features that were trained as published."""

    made_layers: Mapping[str, Layer] = field(default_factory=dict[str, Layer])
    """Layers that were made to open it, by the names to keep them under."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Offer:
    """What an opener may take."""

    scene: Scene
    options: SelectOptions
    views: ViewCache
    layers: Mapping[str, Layer] | None
    """Layers at hand; others are in the scene's folder."""

    observer: Observer
    backend: BackendName = "auto"

    known: dict[str, "LayerFacts"] = field(default_factory=dict[str, "LayerFacts"])
    """What was learnt of layers so far: openers ask in turn, and each file is read once."""

    def facts(self, name: str) -> "LayerFacts":
        """What a layer is, without keeping it."""
        if name not in self.known:
            self.known[name] = LayerFacts.of(whole_layer(self.scene, name, self.layers))
        return self.known[name]


@dataclass(frozen=True, slots=True, kw_only=True)
class LayerFacts:
    """What a layer is chosen by."""

    rank: int | None
    """0 for trees, 1 for labels of instances, 2 for other labels; None for what has no ids."""

    is_affinity: bool
    """Whether it is of features that tell what belongs together."""

    evidence: str | None
    """Name of the evidence that it was made from."""

    @classmethod
    def of(cls, layer: Layer) -> "LayerFacts":
        """Those of a layer."""
        rank = None
        if isinstance(layer, InstanceTree):
            rank = 0
        elif isinstance(layer, Labels):
            rank = 1 if layer.info.instances else 2
        return cls(
            rank=rank,
            is_affinity=isinstance(layer, Features) and (layer.info.head or {}).get("kind") == KIND,
            evidence=layer.info.evidence,
        )


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
        openers: Sequence[Opener] = (OPENERS[options.source],)
    elif options.evidence is not None:
        openers = (_open_masks,)
    else:
        openers = AUTO
    for opener in openers:
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
    return _layer_source(offer, offer.options.from_layer or _best_layer(offer))


def _layer_source(offer: Offer, name: str | None) -> OpenedSource | None:
    if name is None:
        return None
    if offer.options.from_layer is None:
        offer.observer.note(f"selecting by layer {name} (see from_layer)")
    layer = whole_layer(offer.scene, name, offer.layers, option="from_layer")
    if not isinstance(layer, Labels | InstanceTree):
        if offer.options.source == "auto":
            return None
        kind = layer_kind(layer)
        raise InputError(f"from_layer: expected labels or a tree, {name!r} is of {kind}.")
    source = LayerSource(layer, offer.scene.gaussians, name=name, views=offer.views)
    return OpenedSource(source=source, name="layer", layer=name)


def _open_tree(offer: Offer) -> OpenedSource | None:
    """A tree of the scene, where no layer is named."""
    if offer.options.from_layer is not None:
        return None
    name = _best_layer(offer)
    is_tree = name is not None and offer.facts(name).rank == 0
    return _layer_source(offer, name if is_tree else None)


def _best_layer(offer: Offer) -> str | None:
    """A tree before labels of instances before other labels; of equals the first by name."""
    ranked = ((offer.facts(name).rank, name) for name in _layer_names(offer))
    return min(((rank, name) for rank, name in ranked if rank is not None), default=(0, None))[1]


def _layer_names(offer: Offer) -> list[str]:
    names = set(offer.layers or ())
    if offer.scene.root is not None:
        names |= set(scene_layer_names(offer.scene.root))
    return sorted(names)


def _open_features(offer: Offer) -> OpenedSource | None:
    """The layer of features that is named, or the first with affinity features."""
    name = offer.options.from_layer or _affinity_layer(offer)
    if name is None:
        return None
    layer = whole_layer(offer.scene, name, offer.layers, option="from_layer")
    if isinstance(layer, VoxelFeatures):
        layer = layer.features()
    if not isinstance(layer, Features):
        if offer.options.source == "auto":
            return None
        kind = layer_kind(layer)
        raise InputError(f"from_layer: expected features, {name!r} is of {kind}.")
    published = trained_as_published(layer.info)
    asked = offer.options.threshold
    rule = ("adaptive" if published else "fixed") if asked == "auto" else asked
    source = FeatureMembership(
        layer,
        offer.scene.gaussians,
        options=FeatureMembershipOptions(rule=rule, seed=offer.options.seed),
        guidance=_guidance(offer, layer),
    )
    offer.observer.note(f"selecting by features {name}, threshold {rule}")
    return OpenedSource(source=source, name="features", layer=name, rule=rule, published=published)


def _affinity_layer(offer: Offer) -> str | None:
    names = (name for name in _layer_names(offer) if offer.facts(name).is_affinity)
    return next(names, None)


def _guidance(offer: Offer, layer: Features) -> Callable[[View], FeatureMap | None] | None:
    """Feature maps that features were trained with, where they are still at hand."""
    name = layer.info.options.get("guidance")
    if not isinstance(name, str):
        return None
    try:
        evidence = open_evidence(find_evidence(offer.scene.evidence_folders, name))
    except InputError:
        return None
    known = set(evidence.view_names)

    def feature_map(view: View) -> FeatureMap | None:
        return evidence.features(view.name) if view.name in known else None

    return feature_map


def _open_masks(offer: Offer) -> OpenedSource | None:
    """The tree that masks associate to: one of the scene that was made of them, or made now."""
    if offer.options.from_layer is not None and offer.options.source == "auto":
        return None
    scene = offer.scene
    evidence = _masks(offer)
    if evidence is None:
        return None
    for name in _layer_names(offer):
        facts = offer.facts(name)
        if facts.rank == 0 and facts.evidence == evidence:
            layer = whole_layer(scene, name, offer.layers)
            source = LayerSource(layer, scene.gaussians, name=name, views=offer.views)
            offer.observer.note(f"selecting by masks {evidence}, associated in layer {name}")
            return OpenedSource(source=source, name="masks", layer=name, evidence=evidence)
    offer.observer.note(f"masks {evidence} are associated first; the next selection is immediate")
    made = segment(
        scene,
        "associate",
        options=SegmentOptions(evidence=evidence),
        backend=offer.backend,
        observer=offer.observer,
    )
    name = evidence if evidence not in _layer_names(offer) else f"{evidence}_tree"
    source = LayerSource(made.layer, scene.gaussians, name=name, views=offer.views)
    return OpenedSource(
        source=source,
        name="masks",
        layer=name,
        evidence=evidence,
        made_layers={name: made.layer},
    )


def _masks(offer: Offer) -> str | None:
    """Name of the masks of the scene or its capture: those asked for, or the only ones."""
    scene, wanted = offer.scene, offer.options.evidence
    folders = scene.evidence_folders
    if wanted is not None:
        found = open_evidence(find_evidence(folders, wanted))
        if found.kind != "masks":
            raise InputError(f"evidence: expected masks, {wanted!r} has {found.kind}.")
        return wanted
    names = [
        name
        for name in evidence_names(folders)
        if open_evidence(find_evidence(folders, name)).kind == "masks"
    ]
    # Labels may still answer where nothing was asked for by name.
    if len(names) > 1 and (offer.options.source == "masks" or _best_layer(offer) is None):
        raise InputError(
            f"evidence: expected the name of one of {', '.join(names)}, got none (see --evidence)."
        )
    return names[0] if len(names) == 1 else None


OPENERS: dict[str, Opener] = {
    "features": _open_features,
    "layer": _open_layer,
    "masks": _open_masks,
}
"""Sources by name."""

AUTO: Sequence[Opener] = (_open_tree, _open_features, _open_masks, _open_layer)
"""What ``auto`` tries: what answers best comes first, and what has to be made after what is there;
labels of classes know no things, and come last (decision 0031)."""
