"""One method in one scene under a protocol: what the parts of a run share."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from splatseg.core import Layer, Model, Scene
from splatseg.core.benchmark import BenchmarkScene
from splatseg.core.models import GroundedMasks
from splatseg.evaluate.protocols import Protocol
from splatseg.methods import Method
from splatseg.render import BackendName
from splatseg.tasks._observer import Observer
from splatseg.tasks.benchmark.options import BenchOptions
from splatseg.tasks.benchmark.sight import Seen, guidance_for, kinds_wanted, seen_for
from splatseg.tasks.segment import SegmentOptions, segment


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
        self, evidence: str, *, views: tuple[str, ...] = ("train",), source: Path | None = None
    ) -> Layer:
        """The method's layer of evidence.

        Args:
            evidence: Its name, in the scene's folder, or in `source`.
            views: Which views it may learn from.
            source: A folder of evidence besides the scene's.
        """
        scene = self.scene if source is None else replace(self.scene, source=source)
        made = segment(
            scene,
            self.method,
            method_options=self._guided_options(),
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

    def _guided_options(self) -> Any:
        """Options of a method that takes features besides, if some are given; else None."""
        method = self.method
        if method.guidance is None or self.options.guidance is None:
            return None
        seen = guidance_for(
            self.scene,
            self.bench,
            options=self.options,
            backend=self.backend,
            observer=self.observer,
        )
        chosen = method.published_options if self.options.published else method.options()
        return replace(chosen, **{method.guidance: seen.name})
