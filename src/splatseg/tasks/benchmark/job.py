"""One method in one scene under a protocol: what the parts of a run share."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from splatseg.core import Layer, Model, Scene, VoxelFeatures
from splatseg.core.benchmark import BenchmarkScene
from splatseg.core.models import GroundedMasks
from splatseg.errors import InputError
from splatseg.evaluate.protocols import Protocol
from splatseg.methods import Method
from splatseg.render import BackendName
from splatseg.tasks.benchmark.options import BenchOptions
from splatseg.tasks.benchmark.sight import Seen, companion_for, kinds_wanted, seen_for
from splatseg.tasks.segment import SegmentOptions, segment
from splatseg.tasks.work import Observer


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
