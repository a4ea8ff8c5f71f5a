"""Which features of a scene answer to words."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from splatseg.core import Features, Layer, Scene, VoxelFeatures
from splatseg.core.models import TextFeatures
from splatseg.errors import InputError
from splatseg.io.evidence import (
    TEXT_FILE,
    FeatureEvidence,
    evidence_names,
    find_evidence,
    open_evidence,
)
from splatseg.io.scene import scene_layer_names
from splatseg.lift.vocabulary import Vocabulary, vocabulary_of
from splatseg.methods import find_method
from splatseg.methods.voxels.words import LastLayers
from splatseg.render import BackendName
from splatseg.tasks._last_layers import in_word_space, last_layers
from splatseg.tasks._observer import Observer
from splatseg.tasks.query_options import QueryOptions
from splatseg.tasks.scene_parts import whole_layer
from splatseg.tasks.segment import segment
from splatseg.tasks.segment_options import SegmentOptions

_ANSWERING = ("objects", "voxels", "features")
"""Methods whose layers answer, the best first."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WordSource:
    """Features that answer, and the words for them."""

    features: Features | VoxelFeatures
    layer: str
    vocabulary: Vocabulary
    last_layers: LastLayers | None = None
    """What leads from features of voxels to the space of words; None where they lie in it."""
    made_layers: Mapping[str, Layer] = field(default_factory=dict[str, Layer])
    """Layers that were made, by the names to keep them under."""


def word_source(
    scene: Scene,
    options: QueryOptions,
    *,
    encoder: TextFeatures | None,
    words: Sequence[str],
    layers: Mapping[str, Layer] | None,
    backend: BackendName,
    observer: Observer,
) -> WordSource:
    """The layer that answers: the one asked for, one of objects, one made now, or another.

    Raises:
        InputError: If there is nothing that answers, or not what is asked for.
    """
    name = options.from_layer
    if name is None:
        name = _layer_at_hand(scene, options, layers, ("objects",))
    made: dict[str, Layer] = {}
    if name is None and (masks := mask_name(scene, options.masks)) is not None:
        evidence = feature_evidence(scene, options.features, encoder)
        last_layers(evidence, encoder)
        if words:
            vocabulary_of(evidence, encoder).vectors(words)
        observer.note(f"finding objects by {masks} and their features by {evidence.folder.name}")
        name, layer = _made(scene, evidence.folder.name, masks, backend, observer)
        made[name] = layer
    if name is None:
        name = _layer_at_hand(scene, options, layers, _ANSWERING)
    if name is None:
        raise InputError(
            "query: expected masks to find objects by, or a layer of features; make masks with "
            "`splatseg see`, or a layer with `splatseg segment --method features`."
        )
    layer = made.get(name) or whole_layer(scene, name, layers, option="from_layer")
    if not isinstance(layer, Features | VoxelFeatures):
        raise InputError(f"from_layer: expected features, {name!r} has none.")
    evidence = feature_evidence(scene, options.features or layer.info.evidence, encoder)
    later = last_layers(evidence, encoder)
    if later is not None and isinstance(layer, Features):
        layer = in_word_space(layer, later)
    return WordSource(
        features=layer,
        layer=name,
        vocabulary=vocabulary_of(evidence, encoder),
        last_layers=later,
        made_layers=made,
    )


def _layer_at_hand(
    scene: Scene,
    options: QueryOptions,
    layers: Mapping[str, Layer] | None,
    methods: tuple[str, ...],
) -> str | None:
    """The first layer by the first of some methods, of the features and masks asked for."""
    names = set(layers or ())
    if scene.root is not None:
        names |= set(scene_layer_names(scene.root))
    found: dict[str, str] = {}
    for name in sorted(names):
        layer = whole_layer(scene, name, layers)
        if not isinstance(layer, Features | VoxelFeatures) or layer.info.method not in (
            *methods,
            "uplift_features",
        ):
            continue
        if options.features is not None and layer.info.evidence != options.features:
            continue
        if options.masks is not None and layer.info.options.get("masks") != options.masks:
            continue
        found.setdefault(layer.info.method, name)
    return next((found[method] for method in methods if method in found), None)


def mask_name(scene: Scene, asked: str | None, *, option: str = "masks") -> str | None:
    """Masks to find objects by: those asked for, or the only ones; `option` is who asks."""
    folders = scene.evidence_folders
    if asked is not None:
        if asked not in (known := evidence_names(folders)):
            raise InputError(
                f"{option}: expected one of those at hand ({', '.join(known)}), got {asked!r}."
            )
        return asked
    names = [
        name
        for name in evidence_names(folders)
        if open_evidence(find_evidence(folders, name)).kind == "masks"
    ]
    if len(names) > 1:
        raise InputError(
            f"{option}: expected the name of one of {', '.join(names)}, got none (see --{option})."
        )
    return names[0] if names else None


def _made(
    scene: Scene, features: str, masks: str, backend: BackendName, observer: Observer
) -> tuple[str, Layer]:
    """A layer of objects, and what to call it."""
    taken = () if scene.root is None else scene_layer_names(scene.root)
    name = "objects" if "objects" not in taken else f"objects_{masks}"
    found = segment(
        scene,
        "objects",
        options=SegmentOptions(evidence=features, layer=name),
        method_options=replace(find_method("objects").options(), masks=masks),
        backend=backend,
        observer=observer,
    )
    return name, found.layer


def feature_evidence(
    scene: Scene, name: str | None, encoder: TextFeatures | None
) -> FeatureEvidence:
    """The evidence of features in the space of words: of this name, or the only one."""
    folders = scene.evidence_folders
    if name is not None:
        evidence = open_evidence(find_evidence(folders, name))
        if not isinstance(evidence, FeatureEvidence):
            raise InputError(f"features: expected features, {name!r} has {evidence.kind}.")
        return evidence
    found: list[FeatureEvidence] = []
    for each in evidence_names(folders):
        evidence = open_evidence(find_evidence(folders, each))
        if isinstance(evidence, FeatureEvidence) and _has_words(evidence, encoder):
            found.append(evidence)
    if len(found) == 1:
        return found[0]
    names = ", ".join(each.folder.name for each in found)
    raise InputError(
        f"features: expected the name of one of {names}, got none (see --features)."
        if found
        else "features: expected evidence of features in the space of words, got none; `splatseg "
        "see --model clip --what text` makes some."
    )


def _has_words(evidence: FeatureEvidence, encoder: TextFeatures | None) -> bool:
    """Whether words can be compared: features of a basis into their space, or beside a file."""
    inside = (evidence.folder / TEXT_FILE).is_file()
    beside = (evidence.folder.parent / TEXT_FILE).is_file() and evidence.basis is not None
    return inside or beside or (encoder is not None and evidence.basis is None)
