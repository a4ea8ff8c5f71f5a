"""One method in one scene under a protocol: its evidence, words, and selections by its layer."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Literal, Self

from splatseg.core import (
    Features,
    InstanceTree,
    Labels,
    Layer,
    Model,
    Scene,
    Selection,
    VoxelFeatures,
)
from splatseg.core.models import GroundedMasks, TextFeatures
from splatseg.errors import InputError
from splatseg.io.evidence import FeatureEvidence, open_evidence
from splatseg.lift import GaussianField
from splatseg.lift.affinity import KIND
from splatseg.lift.vocabulary import Vocabulary, vocabulary_of
from splatseg.lift.words import WordIndex
from splatseg.methods import Method
from splatseg.methods.voxels.words import VoxelWords
from splatseg.prompting.prompts import ViewPrompt
from splatseg.render import BackendName
from splatseg.tasks.segment import SegmentOptions, segment
from splatseg.tasks.select import SelectionSession, open_selector
from splatseg.tasks.sources import SelectOptions
from splatseg.tasks.work import Observer
from splatseg_bench.evidence import Seen, companion_for, kinds_wanted, seen_for
from splatseg_bench.options import BenchOptions
from splatseg_bench.protocols import Protocol, TargetSwitches
from splatseg_bench.scene import BenchmarkScene


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Job:
    """A method, a fitted scene, and what is asked of it."""

    protocol: Protocol
    bench: BenchmarkScene
    scene: Scene
    method: Method
    root: Path
    """Folder of the run."""

    prompter: Model | None
    grounder: GroundedMasks | None
    """Who finds words in pictures, if one was named."""

    options: BenchOptions
    backend: BackendName
    observer: Observer

    rule: str | None = None
    """By which rule points take labels, where the protocol has several."""

    @property
    def row(self) -> str:
        """What its row of the table is called."""
        return self.method.name if self.rule is None else f"{self.method.name}-{self.rule}"

    def seen(self, *, words: bool = False) -> Seen:
        """Evidence for the method, of the first model that gives what it takes."""
        return seen_for(
            self.method,
            self.scene,
            self.bench,
            words=words,
            kinds=kinds_wanted(self.protocol, self.method),
            options=self.options,
            backend=self.backend,
            observer=self.observer,
        )

    def layer(
        self,
        evidence: str,
        *,
        views: tuple[str, ...] = ("train",),
        source: Path | None = None,
        asked: Mapping[str, object] | None = None,
    ) -> Layer:
        """The method's layer of evidence, with what each Gaussian reads of its voxels.

        Args:
            evidence: Its name, in the scene's folder, or in `source`.
            views: Which views it may learn from.
            source: A folder of evidence besides the scene's.
            asked: Options of the method that say what is asked for, such as words.
        """
        layer = self.whole_layer(evidence, views=views, source=source, asked=asked)
        return layer.features() if isinstance(layer, VoxelFeatures) else layer

    def whole_layer(
        self,
        evidence: str,
        *,
        views: tuple[str, ...] = ("train",),
        source: Path | None = None,
        asked: Mapping[str, object] | None = None,
    ) -> Layer:
        """The same with voxels as they are, to be asked for words."""
        scene = self.scene if source is None else replace(self.scene, source=source)
        given = replace(self.options.options_of(self.method), **self._beside(), **(asked or {}))
        made = segment(
            scene,
            self.method,
            method_options=given,
            options=SegmentOptions(
                evidence=evidence,
                views=views,
                published=self.options.published,
                seed=self.options.seed,
            ),
            backend=self.backend,
            observer=self.observer,
        )
        return made.layer

    @property
    def words(self) -> Literal["cosines", "span"]:
        """How the method's features are asked for words."""
        published = self.method.published_words if self.options.published else None
        return published or self.method.words

    def _beside(self) -> dict[str, str]:
        """Names of what the method takes besides, by its options."""
        method = self.method
        if not (method.companions and self.options.companions):
            return {}
        named: dict[str, str] = {}
        for option, kinds in method.companions.items():
            seen = companion_for(
                self.scene,
                self.bench,
                option,
                kinds,
                options=self.options,
                backend=self.backend,
                observer=self.observer,
            )
            if seen is not None:
                named[option] = seen.name
        if not named:
            wanted = sorted({kind for kinds in method.companions.values() for kind in kinds})
            raise InputError(
                f"companions: expected a model that gives {' or '.join(wanted)}, got "
                f"{', '.join(self.options.companions)}."
            )
        return named


# Words for the features of a scene under test: who encodes them, and what answers.


_SURE = 0.5


def words_of(scene: Scene, seen: Seen) -> Vocabulary:
    """The words of a model, or those that were recorded with its features.

    Raises:
        InputError: If the evidence is of no words.
    """
    if scene.root is None:
        raise InputError("scene: expected one that was read from its folder, got one without.")
    folder = scene.root / "evidence" / seen.name
    evidence = open_evidence(folder)
    if not isinstance(evidence, FeatureEvidence):
        raise InputError(f"{folder}: expected features, got {evidence.kind}.")
    return vocabulary_of(evidence, seen.made if isinstance(seen.made, TextFeatures) else None)


def word_index(layer: Features | VoxelFeatures, vocabulary: Vocabulary) -> WordIndex | VoxelWords:
    """Who answers words in the span of a layer's features, as `query` answers."""
    if isinstance(layer, VoxelFeatures):
        return VoxelWords(layer, vocabulary)
    return WordIndex(layer, vocabulary)


class SpokenLayer:
    """A method's features and the words for them, made when they are first asked for.

    Args:
        job: The method and the scene.
    """

    def __init__(self, job: Job) -> None:
        self._job = job

    @cached_property
    def layer(self) -> Features | VoxelFeatures:
        """The features.

        Raises:
            InputError: If the method gives others than features.
        """
        layer = self._job.whole_layer(self._seen.name)
        if not isinstance(layer, Features | VoxelFeatures):
            raise InputError(
                f"method {self._job.method.name}: expected one that gives features, as words are "
                f"asked for by features, got {self._job.method.returns}."
            )
        return layer

    @cached_property
    def vocabulary(self) -> Vocabulary:
        """The words."""
        return words_of(self._job.scene, self._seen)

    def selection(self, words: str) -> Selection:
        """What likelier is the thing than anything else, as `query` answers.

        Args:
            words: What is asked for.
        """
        index = self._index
        sure = index.of_gaussians(index.ask([words]).probabilities)[:, 0].clamp(0, 1)
        return Selection(mask=sure >= _SURE, confidence=sure)

    @cached_property
    def _seen(self) -> Seen:
        return self._job.seen(words=True)

    @cached_property
    def _index(self) -> WordIndex | VoxelWords:
        return word_index(self.layer, self.vocabulary)


def asks_for_all(words: str) -> bool:
    """Whether words ask for everything that they mean, such as "all of the flowers"."""
    return words.lower().split()[:1] == ["all"]


# Prompts of a protocol answered by `select`, from the layer that a method made.


_LAYER = "layer"


class LayerSelector:
    """Selects by one layer, again and again; a context that releases what it holds.

    Args:
        job: The method, the scene, and the protocol, which says the granularity.
    """

    def __init__(self, job: Job) -> None:
        self._job = job
        self._session: SelectionSession | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._session is not None:
            self._session.close()
            self._session = None

    def select(self, layer: Layer, prompt: ViewPrompt) -> Selection:
        """The Gaussians that a prompt means.

        Args:
            layer: The method's layer, the same in each call.
            prompt: What the protocol gives.

        Raises:
            InputError: If the prompt shows nothing that the layer knows.
        """
        if self._session is None:
            self._session = self._opened(layer)
        return self._session.select(prompt, advise=False).selection

    def _opened(self, layer: Layer) -> SelectionSession:
        switches = self._job.protocol.switches
        if not isinstance(switches, TargetSwitches):
            raise InputError("protocol: expected one of things asked for, got one of maps.")
        affinity = isinstance(layer, Features) and is_affinity(layer)
        if not affinity and not isinstance(layer, Labels | InstanceTree):
            # The labels that features with a classifier give to Gaussians.
            field = GaussianField(self._job.scene.gaussians, {_LAYER: layer})
            layer = field.labels(_LAYER)
        options = SelectOptions(
            source="features" if affinity else "layer",
            from_layer=_LAYER,
            granularity=switches.granularity,
            seed=self._job.options.seed,
        )
        return open_selector(
            self._job.scene,
            options=options,
            layers={_LAYER: layer},
            backend=self._job.backend,
            observer=self._job.observer,
        )


def is_affinity(layer: Features) -> bool:
    """Whether features were trained to be compared with each other (`lift.affinity`)."""
    return (layer.info.head or {}).get("kind") == KIND
