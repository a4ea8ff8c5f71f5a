"""Evidence for the methods of a run, from the models that were named."""

from dataclasses import dataclass
from pathlib import Path
from typing import cast

from splatseg.core import Model, Scene
from splatseg.core.benchmark import BenchmarkScene
from splatseg.core.models import TextFeatures
from splatseg.errors import InputError
from splatseg.io.evidence import TEXT_FILE, EvidenceKind, open_evidence
from splatseg.methods import Method
from splatseg.models import LoadOptions, find_family, find_model, model_names
from splatseg.render import BackendName
from splatseg.tasks._observer import Observer
from splatseg.tasks.benchmark.options import BenchOptions
from splatseg.tasks.see import SeeOptions, What, see

_KIND_OF: dict[What, EvidenceKind] = {
    "masks": "masks", "labels": "labels", "panoptic": "panoptic", "features": "features",
    "text": "features",
}  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Seen:
    """Evidence that a method of a run takes."""

    name: str
    """Of the evidence, in the scene's folder."""

    model: str
    """As it was named."""

    kind: EvidenceKind
    what: str
    """What the model was asked for; for recorded evidence its kind."""

    made: Model | None
    """The model, where it is one that runs."""


def model_of(name: str, options: BenchOptions, observer: Observer) -> Model:
    """The model of NAME, NAME=WEIGHTS, or a folder."""
    found, _, weights = name.partition("=")
    family = find_family(found) if found in model_names() else None
    loading = None
    if family is not None and family.needs_weights:
        loading = LoadOptions(
            weights=weights or None, download=options.download, device=options.device
        )
    elif weights:
        raise InputError(f"models: {found} has no weights, got {name!r}.")
    return find_model(found, loading=loading, report=observer.note)


def seen_for(
    method: Method,
    scene: Scene,
    bench: BenchmarkScene,
    *,
    words: bool = False,
    options: BenchOptions,
    backend: BackendName,
    observer: Observer,
) -> Seen:
    """Evidence of the first model that gives what a method takes.

    Args:
        method: The method.
        scene: The fitted scene.
        bench: The benchmark's scene.
        words: Whether features must lie in a space of words.
        options: Models.
        backend: Who draws views without photographs.
        observer: Is told of the progress.

    Raises:
        InputError: If no model gives it.
    """
    for named in options.models:
        path = Path(named.replace("{scene}", bench.name))
        recorded = named.partition("=")[0] not in model_names()
        found = (
            _of_folder(path, method, words=words)
            if recorded
            else _of_model(named, method, words=words)
        )
        if found is None:
            continue
        kind, what = found
        model = None if recorded else model_of(named, options, observer)
        name = _slug(path.name if recorded else named.partition("=")[0])
        seen = see(
            scene,
            str(path) if model is None else model,
            name,
            options=SeeOptions(
                what=() if recorded else (cast(What, what),), allow_missing=recorded
            ),
            backend=backend,
            observer=observer,
        )
        return Seen(name=seen.folder.name, model=named, kind=kind, what=what, made=model)
    wanted = "features of words" if words else " or ".join(method.evidence)
    raise InputError(
        f"method {method.name}: expected a model that gives {wanted}, got "
        f"{', '.join(options.models) or 'no model'}; name one with `models`."
    )


def speaks(model: Model | None) -> bool:
    """Whether a model encodes words."""
    return isinstance(model, TextFeatures)


def _of_folder(path: Path, method: Method, *, words: bool) -> tuple[EvidenceKind, str] | None:
    kind = open_evidence(path).kind
    beside = path.absolute().parent / TEXT_FILE
    if words and not ((path / TEXT_FILE).is_file() or beside.is_file()):
        return None
    return (kind, kind) if kind in method.evidence else None


def _of_model(named: str, method: Method, *, words: bool) -> tuple[EvidenceKind, str] | None:
    family = find_family(named.partition("=")[0])
    gives: tuple[What, ...] = () if family is None else family.gives
    for what in gives:
        if _KIND_OF[what] in method.evidence and (not words or what == "text"):
            return _KIND_OF[what], what
    return None


def _slug(name: str) -> str:
    return "".join(c if c.isalnum() or c in "-_." else "-" for c in name)
