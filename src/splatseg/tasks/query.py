"""What a scene is asked for words by."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from splatseg.core import UNLABELLED, Labels, Layer, LayerInfo, Scene, Selection, VoxelFeatures
from splatseg.core.boundary import boundary
from splatseg.core.models import TextFeatures
from splatseg.errors import InputError
from splatseg.lift.phrases import ThingLooks, match_phrases, thing_looks
from splatseg.lift.referring import (
    NounPhrase,
    ObjectNames,
    Reference,
    Resolver,
    name_list,
    object_geometry,
    referring_readings,
    viewer_of,
)
from splatseg.lift.words import WordIndex, WordMatches
from splatseg.methods.voxels.words import VoxelWords
from splatseg.render import BackendName
from splatseg.selection import components
from splatseg.tasks.word_sources import QueryOptions, word_source
from splatseg.tasks.work import SILENT, Observer, Work, versions

# Words asked of a scene: which things answer to them, and how surely.


_THINGS = 20_000
"""Distinct vectors up to which each is a thing; with more, things are connected pieces."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Found:
    """A thing that answers to a word."""

    thing: int
    """Its number, for `QueryResult.of_thing`; the same in all answers of one session where objects
    answer."""

    probability: float
    """That the word means it, rather than another word of the context."""

    cosine: float
    """In the span of the scene's features."""

    gaussians: int
    """How many it has."""

    centre: tuple[float, float, float]
    """Median of their centres, world, scene units."""

    size: tuple[float, float, float]
    """Extent along x, y and z, between the 2nd and the 98th percentile of centres."""


@dataclass(frozen=True, kw_only=True, eq=False)
class QueryResult:
    """What a scene answers to words; of Gaussians it is worked out when it is asked for."""

    words: tuple[str, ...]

    found: Mapping[str, tuple[Found, ...]]
    """Things by word, the surest first, of those that are equal to a percent the larger; none where
    the word is unknown here, or a phrase is ambiguous."""

    surest: Mapping[str, float]
    """The largest probability of anything by word, also where that is not enough to answer."""

    vectors: WordMatches
    """What the distinct vectors of the layer answer."""

    index: WordIndex | VoxelWords
    """Whose vectors these are."""

    layer: str
    """Name of the layer that answered."""

    options: QueryOptions

    made_layers: Mapping[str, Layer] = field(default_factory=dict[str, Layer])
    """Layers that were made to answer, by the names to keep them under: with them the next query
    answers at once."""

    references: Mapping[str, Reference] = field(default_factory=dict[str, Reference])
    """Of phrases that refer by relations, orders or counts: what they mean and why, or between
    which candidates they do not decide."""

    pieces: Int64[Tensor, "n words"] | None = None
    """Connected pieces of Gaussians by word, -1 outside, where these are the things; None where
    each vector of a `WordIndex` is one."""

    @cached_property
    def probabilities(self) -> Float[Tensor, "n words"]:
        """Of each Gaussian."""
        return self.index.of_gaussians(self.vectors.probabilities)

    @cached_property
    def cosines(self) -> Float[Tensor, "n words"]:
        """Of each Gaussian, in the span of the scene's features; 0 where it has no feature."""
        return self.index.of_gaussians(self.vectors.cosines)

    @cached_property
    def things(self) -> Int64[Tensor, "n words"]:
        """The thing that each Gaussian is of, by word; -1 where it does not answer."""
        if self.pieces is not None:
            return self.pieces
        if isinstance(self.index, VoxelWords):
            raise InputError("pieces: expected those of Gaussians that read voxels, got none.")
        inside = self.probabilities >= self.options.min_probability
        rows = self.index.rows[:, None]
        for word, reference in self.references.items():
            meant = torch.tensor(reference.things, dtype=torch.int64)
            inside[:, self.words.index(word)] = torch.isin(self.index.rows, meant)
        return torch.where(inside & (rows >= 0), rows, UNLABELLED)

    @property
    def unknown(self) -> tuple[str, ...]:
        """Words that nothing answers to."""
        return tuple(
            word for word in self.words if not self.found[word] and word not in self.ambiguous
        )

    @property
    def ambiguous(self) -> tuple[str, ...]:
        """Phrases that several things may be meant by, see `references`."""
        return tuple(
            word for word, reference in self.references.items() if reference.status == "ambiguous"
        )

    @boundary
    def of_thing(self, word: str, thing: int) -> Selection:
        """The Gaussians of a thing.

        Raises:
            InputError: If it does not answer to the word.
        """
        if word not in self.words or thing not in {one.thing for one in self.found[word]}:
            raise InputError(f"thing: expected one that answers to {word!r}, got {thing}.")
        return Selection(mask=self.things[:, self.words.index(word)] == thing)

    def selection(self) -> Selection:
        """Everything that answers to the words, with the probability of the likeliest.

        Raises:
            InputError: If nothing does, or a phrase is ambiguous; the message has its candidates.
        """
        for word in self.ambiguous:
            raise InputError(f"words: {self.references[word].explanation}.")
        inside = (self.things >= 0).any(dim=1)
        if not bool(inside.any()):
            raise InputError(f"words: nothing in the scene answers to {', '.join(self.words)}.")
        sure = self.probabilities.amax(dim=1).clamp(0, 1)
        confidence = torch.where(inside, sure.clamp_min(0.5), sure.clamp_max(0.5))
        return Selection(mask=inside, confidence=confidence, info=self._info())

    def labels(self) -> Labels:
        """The likeliest word of each Gaussian: ids 1, 2, ... in the order of the words.

        Where nothing answers it is -1, unless `QueryOptions.every` asks for one everywhere.
        """
        if self.options.every:
            best = self.cosines.argmax(dim=1)
            known = self.cosines.abs().amax(dim=1) > 0
        else:
            answering = torch.where(self.things >= 0, self.probabilities, -1.0)
            best, known = answering.argmax(dim=1), answering.amax(dim=1) >= 0
        sure = self.probabilities.gather(1, best[:, None]).squeeze(1)
        return Labels(
            ids=torch.where(known, best + 1, UNLABELLED).int(),
            confidence=torch.where(known, sure, 0.0).clamp(0, 1),
            info=self._info(),
        )

    def _info(self) -> LayerInfo:
        return LayerInfo(
            method="query",
            options={**asdict(self.options), "from_layer": self.layer},
            names=dict(enumerate(self.words, start=1)),
            versions=versions("splatseg"),
            details=query_record(self),
        )


def query_record(answers: QueryResult) -> dict[str, Any]:
    """What was found, as values that JSON holds."""
    record: dict[str, Any] = {
        "words": list(answers.words),
        "found": {word: [asdict(one) for one in answers.found[word]] for word in answers.words},
        "surest": dict(answers.surest),
    }
    if answers.references:
        record["references"] = {
            word: reference_record(reference) for word, reference in answers.references.items()
        }
    return record


def reference_record(reference: Reference) -> dict[str, Any]:
    """What a phrase means, as values that JSON holds."""
    return {
        "status": reference.status,
        "explanation": reference.explanation,
        "candidates": [asdict(one) for one in reference.referents],
    }


class QuerySession:
    """Asks a scene for words again and again, each time in milliseconds.

    Args:
        scene: The scene; it must stay as it is.
        options: What answers, and from which probability.
        encoder: The model that features were made with, for any words; None takes words that were
            recorded with them.
        words: What will be asked for: nothing that takes long is done if one has no vector.
        layers: Layers at hand; others are read from the scene's folder.
        backend: Rendering backend.
        observer: Is told of what is opened.

    Raises:
        InputError: If the scene has nothing that answers, or not what the options ask for.
    """

    @boundary
    def __init__(
        self,
        scene: Scene,
        *,
        options: QueryOptions | None = None,
        encoder: TextFeatures | None = None,
        words: Sequence[str] = (),
        layers: Mapping[str, Layer] | None = None,
        backend: BackendName = "auto",
        observer: Observer = SILENT,
    ) -> None:
        self._scene = scene
        self._options = options or QueryOptions()
        work = Work(scene=scene, layers=layers, backend=backend, observer=observer)
        if self._options.view is not None:
            scene.view(self._options.view)  # a name that is none is told before anything is read
        self._source = word_source(work, self._options, encoder=encoder, words=words)
        if len(self._source.features) != len(scene.gaussians):
            raise InputError(
                f"from_layer: expected {len(scene.gaussians)} Gaussians, those of the scene, "
                f"{self._source.layer!r} has {len(self._source.features)}."
            )
        features, vocabulary = self._source.features, self._source.vocabulary
        components = self._options.components
        self._places: Mapping[int, dict[str, Any]] | None = None
        self._index: WordIndex | VoxelWords
        if isinstance(features, VoxelFeatures):
            self._index = VoxelWords(
                features,
                vocabulary,
                components=components,
                last_layers=self._source.last_layers,
            )
        else:
            self._index = WordIndex(features, vocabulary, components=components)
            # Of few vectors each is a thing, whose place does not depend on what is asked.
            if len(self._index) <= _THINGS:
                self._places = _places(scene, self._index.rows)

    @property
    def index(self) -> WordIndex | VoxelWords:
        """The vectors that answer."""
        return self._index

    @property
    def made_layers(self) -> Mapping[str, Layer]:
        """Layers that opening it made, by the names to keep them under."""
        return self._source.made_layers

    @boundary
    def ask(self, words: Sequence[str]) -> QueryResult:
        """Which things answer to words, and how surely.

        Args:
            words: Words or phrases; each is asked for by itself. Phrases that refer by relations,
                orders, counts or negation are resolved among the objects (`lift.referring`).

        Raises:
            InputError: If there are none, one is there twice, nothing is known of one, or a phrase
                refers and there are no objects.
        """
        readings = self._readings(words)
        plain = [word for word in words if word.strip() not in readings]
        references: dict[str, Reference] = {}
        if readings:
            asked, references = self._with_references(words, plain, readings)
        else:
            asked = self._in_parts(self._index.ask(words))
        for word in asked.words:
            if asked.words.count(word) > 1:
                raise InputError(f"words: expected distinct words, got {word!r} more than once.")
        pieces = None if self._places is not None else self._pieces(asked)
        return QueryResult(
            words=asked.words,
            found={
                word: self._found(asked, column, pieces, references.get(word))
                for column, word in enumerate(asked.words)
            },
            surest={
                word: round(float(asked.probabilities[:, column].max()), 6)
                for column, word in enumerate(asked.words)
            },
            vectors=asked,
            index=self._index,
            layer=self._source.layer,
            options=self._options,
            made_layers=self._source.made_layers,
            references=references,
            pieces=pieces,
        )

    def _readings(self, words: Sequence[str]) -> dict[str, tuple[NounPhrase, ...]]:
        """Phrases that refer, with what they can be read as."""
        if self._options.phrases == "whole":
            return {}
        found: dict[str, tuple[NounPhrase, ...]] = {}
        for word in words:
            readings = referring_readings(word, self._index.vocabulary)
            if readings is not None:
                found[word.strip()] = readings
        if not found:
            return found
        first = next(iter(found))
        if self._options.every:
            raise InputError(f"every: expected words, which classes have, got {first!r}.")
        if self._places is None or isinstance(self._index, VoxelWords):
            raise InputError(
                f"words: {first!r} refers to objects, and layer {self._source.layer!r} has none; "
                "expected one that `segment --method objects` makes, or --phrases whole."
            )
        return found

    def _with_references(
        self,
        words: Sequence[str],
        plain: Sequence[str],
        readings: Mapping[str, tuple[NounPhrase, ...]],
    ) -> tuple[WordMatches, dict[str, Reference]]:
        """What words answer, with a column for each phrase that refers: its things, and no more."""
        asked = self._in_parts(self._index.ask(plain)) if plain else None
        count = len(self._index)
        columns: list[tuple[Tensor, Tensor]] = []
        references: dict[str, Reference] = {}
        for word in words:
            said = word.strip()
            if asked is not None and said not in readings:
                column = asked.words.index(said)
                columns.append((asked.cosines[:, column], asked.probabilities[:, column]))
                continue
            reference = self._resolver.resolve(readings[said], said)
            references[said] = reference
            probabilities = torch.zeros(count)
            if reference.status == "found":
                for one in reference.referents:
                    probabilities[one.thing] = one.probability
            columns.append((torch.zeros(count), probabilities))
        return (
            WordMatches(
                words=tuple(word.strip() for word in words),
                cosines=torch.stack([cosines for cosines, _ in columns], dim=1),
                probabilities=torch.stack([sure for _, sure in columns], dim=1),
            ),
            references,
        )

    @cached_property
    def _resolver(self) -> Resolver:
        """Resolves phrases among the things; its geometry is worked out once."""
        index, scene, options = self._index, self._scene, self._options
        if isinstance(index, VoxelWords):
            raise InputError("words: expected things, got voxels.")
        names = ObjectNames(
            name_list(index.vocabulary),
            lambda name: index.ask([name]).probabilities[:, 0],
            lambda: self._looks.colours,
            min_probability=options.min_probability,
        )
        views = scene.train_views or scene.views
        view = scene.view(options.view) if options.view is not None else next(iter(views), None)
        return Resolver(
            object_geometry(scene.gaussians, index.rows, up=scene.up),
            names.match,
            colour=names.colour,
            viewer=None
            if view is None
            else viewer_of(view.name, view.camera.cam_from_world, up=scene.up),
        )

    def _in_parts(self, asked: WordMatches) -> WordMatches:
        """Phrases asked by their parts, where each vector is a thing."""
        index = self._index
        if (
            self._options.phrases == "whole"
            or self._places is None
            or isinstance(index, VoxelWords)
        ):
            return asked

        def of_word(word: str) -> Tensor:
            return index.ask([word]).probabilities[:, 0]

        _, probabilities = match_phrases(asked, lambda: self._looks, index.vocabulary, of_word)
        return replace(asked, probabilities=probabilities)

    @cached_property
    def _looks(self) -> ThingLooks:
        """How the things look, where each vector is one."""
        if isinstance(self._index, VoxelWords):
            raise InputError("phrases: expected things, got voxels.")
        rows = self._index.rows
        there = torch.nonzero(rows >= 0).squeeze(1)
        return thing_looks(
            self._scene.gaussians,
            rows[there],
            there,
            torch.ones(len(there)),
            count=len(self._index),
            up=self._scene.up,
        )

    def _pieces(self, asked: WordMatches) -> Int64[Tensor, "n words"]:
        """Connected pieces of the Gaussians that answer."""
        inside = self._index.of_gaussians(asked.probabilities) >= self._options.min_probability
        columns = [
            components(self._scene.gaussians, Selection(mask=inside[:, column]))
            for column in range(inside.shape[1])
        ]
        return torch.stack(columns, dim=1)

    def _found(
        self,
        asked: WordMatches,
        column: int,
        pieces: Tensor | None,
        reference: Reference | None,
    ) -> tuple[Found, ...]:
        """The things that answer to one word, in the order of `QueryResult.found`."""
        probabilities, cosines = asked.probabilities[:, column], asked.cosines[:, column]
        if pieces is None:
            places = self._places or {}
            answering = torch.nonzero(probabilities >= self._options.min_probability).flatten()
            meant = answering.tolist() if reference is None else reference.things
            rows = {row: torch.tensor([row]) for row in meant}
        else:
            probabilities, cosines = (
                self._index.of_gaussians(found[:, None])[:, 0] for found in (probabilities, cosines)
            )
            places = _places(self._scene, pieces[:, column])
            rows = {thing: torch.nonzero(pieces[:, column] == thing).flatten() for thing in places}
        found = [
            Found(
                thing=thing,
                probability=round(float(probabilities[which].double().mean()), 6),
                cosine=round(float(cosines[which].double().mean()), 6),
                **places[thing],
            )
            for thing, which in rows.items()
        ]
        return tuple(sorted(found, key=_rank))


def _places(scene: Scene, things: Int64[Tensor, "n"]) -> dict[int, dict[str, Any]]:
    """What `Found` says of where each thing is, by its number; -1 is none."""
    inside = torch.nonzero(things >= 0).squeeze(1)
    inside = inside[torch.argsort(things[inside], stable=True)]
    ids, counts = torch.unique_consecutive(things[inside], return_counts=True)
    means = scene.gaussians.means.detach().cpu()
    found: dict[int, dict[str, Any]] = {}
    for thing, rows in zip(ids.tolist(), inside.split(counts.tolist()), strict=True):
        at = means[rows].double()
        span = at.quantile(torch.tensor([0.02, 0.98]).double(), dim=0)
        centre, size = _triple(at.median(dim=0).values), _triple(span[1] - span[0])
        found[int(thing)] = {"gaussians": len(rows), "centre": centre, "size": size}
    return found


def _rank(found: Found) -> tuple[float, int, int]:
    """Least for what comes first."""
    return -round(found.probability, 2), -found.gaussians, found.thing


def _triple(values: Tensor) -> tuple[float, float, float]:
    x, y, z = (round(float(value), 6) for value in values)
    return x, y, z


@boundary
def query(
    scene: Scene,
    words: Sequence[str],
    *,
    options: QueryOptions | None = None,
    encoder: TextFeatures | None = None,
    layers: Mapping[str, Layer] | None = None,
    backend: BackendName = "auto",
    observer: Observer = SILENT,
) -> QueryResult:
    """Ask a scene for words once, see `QuerySession`.

    Args:
        scene: The scene.
        words: Words or phrases.
        options: What answers, and from which probability.
        encoder: The model that features were made with; None takes recorded words.
        layers: Layers at hand; others are read from the scene's folder.
        backend: Rendering backend.
        observer: Is told of what is opened.

    Raises:
        InputError: If the scene has nothing that answers, or nothing is known of a word.
    """
    session = QuerySession(
        scene,
        options=options,
        encoder=encoder,
        words=words,
        layers=layers,
        backend=backend,
        observer=observer,
    )
    return session.ask(words)
