"""Evidence for the methods of a run, from the models that were named."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, cast

from splatseg.core import Model, Scene
from splatseg.errors import InputError
from splatseg.io.evidence import TEXT_FILE, EvidenceKind, evidence_header, open_evidence
from splatseg.methods import Method
from splatseg.models import What, find_family, model_names
from splatseg.render import BackendName
from splatseg.tasks.see import SeeOptions, model_of, name_of, see
from splatseg.tasks.work import Observer
from splatseg_bench.options import BenchOptions
from splatseg_bench.protocols import Protocol, RoomSwitches, StreetSwitches, TargetSwitches
from splatseg_bench.scene import BenchmarkScene

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


def bench_model(named: str, options: BenchOptions, observer: Observer) -> Model:
    """A model of a run, see `model_of`."""
    return model_of(named, download=options.download, device=options.device, report=observer.note)


def seen_for(
    method: Method,
    scene: Scene,
    bench: BenchmarkScene,
    *,
    words: bool = False,
    kinds: tuple[EvidenceKind, ...] | None = None,
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
        kinds: The kinds that will do, of those that the method takes; None takes any.
        options: Models.
        backend: Who draws views without photographs.
        observer: Is told of the progress.

    Raises:
        InputError: If no model gives it.
    """
    choice = chosen_model(method, bench, words=words, kinds=kinds, options=options)
    return _seen(choice, scene, options=options, backend=backend, observer=observer)


def companion_for(
    scene: Scene,
    bench: BenchmarkScene,
    option: str,
    kinds: tuple[EvidenceKind, ...],
    *,
    options: BenchOptions,
    backend: BackendName,
    observer: Observer,
) -> Seen | None:
    """What a method takes besides its evidence, of the first model of `companions` that gives it.

    Args:
        scene: The fitted scene.
        bench: The benchmark's scene.
        option: The method's option that names it.
        kinds: What it may be.
        options: Who sees.
        backend: Who draws views without photographs.
        observer: Is told of the progress.

    Returns:
        What was seen; None where no model gives it.
    """
    found = (_choice(named, bench, kinds, words=False) for named in options.companions)
    choice = next((one for one in found if one is not None), None)
    if choice is None:
        observer.note(f"{option}: no model of `companions` gives {' or '.join(kinds)}")
        return None
    return _seen(choice, scene, options=options, backend=backend, observer=observer)


def _seen(
    choice: "Choice",
    scene: Scene,
    *,
    options: BenchOptions,
    backend: BackendName,
    observer: Observer,
) -> Seen:
    """What a model sees of a scene, written down."""
    model = None if choice.folder is not None else bench_model(choice.named, options, observer)
    recorded = choice.folder is not None
    seen = see(
        scene,
        str(choice.folder) if model is None else model,
        _evidence_name(choice, scene),
        options=SeeOptions(
            what=() if recorded else (cast(What, choice.what),), allow_missing=recorded
        ),
        backend=backend,
        observer=observer,
    )
    return Seen(
        name=seen.folder.name, model=choice.named, kind=choice.kind, what=choice.what, made=model
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Choice:
    """A model that gives what a method takes."""

    named: str
    folder: Path | None
    """Where it is recorded evidence."""

    kind: EvidenceKind
    what: str


def chosen_model(
    method: Method,
    bench: BenchmarkScene,
    *,
    words: bool,
    kinds: tuple[EvidenceKind, ...] | None = None,
    options: BenchOptions,
) -> Choice:
    """The first model that gives what a method takes, and of a kind that will do; none is loaded.

    Raises:
        InputError: If none does.
        MissingFileError: If recorded evidence is not there.
    """
    own = method.evidence
    taken: tuple[EvidenceKind, ...] = tuple(k for k in own if kinds is None or k in kinds)
    if kinds is not None and not taken:
        raise InputError(
            f"method {method.name}: expected one that takes {' or '.join(kinds)}, got one that "
            f"takes {' or '.join(method.evidence)}."
        )
    for named in options.models:
        choice = _choice(named, bench, taken, words=words)
        if choice is not None:
            return choice
    wanted = "features of words" if words else " or ".join(taken)
    raise InputError(
        f"method {method.name}: expected a model that gives {wanted}, got "
        f"{', '.join(options.models) or 'no model'}; name one with `models`."
    )


def _choice(
    named: str, bench: BenchmarkScene, taken: tuple[EvidenceKind, ...], *, words: bool
) -> Choice | None:
    """A model, or recorded evidence, if it gives one of some kinds."""
    path = Path(named.replace("{scene}", bench.name))
    recorded = name_of(named) not in model_names()
    found = (
        _of_folder(path, taken, words=words) if recorded else _of_model(named, taken, words=words)
    )
    if found is None:
        return None
    kind, what = found
    return Choice(named=named, folder=path if recorded else None, kind=kind, what=what)


def evidence_wanted(
    protocol: Protocol, method: Method, options: BenchOptions
) -> Literal["prompts", "words", "any"]:
    """What a method is given: prompts alone, features of words, or any that it takes."""
    switches = protocol.switches
    if not isinstance(switches, TargetSwitches):
        return "words" if method.evidence == ("features",) else "any"
    if switches.prompt == "words" and options.grounder is None:
        return "words"
    return "prompts" if "labels" in method.evidence else "any"


def kinds_wanted(protocol: Protocol, method: Method) -> tuple[EvidenceKind, ...] | None:
    """Kinds of evidence that will do; None where any will that the method takes.

    In rooms every pixel needs a class: label maps of classes, or segments whose class is known,
    which tell things apart as well. Along streets classes are all that counts.
    """
    switches = protocol.switches
    if isinstance(switches, StreetSwitches):
        return ("features",) if method.evidence == ("features",) else ("labels",)
    if not isinstance(switches, RoomSwitches):
        return None
    if switches.task == "panoptic":
        return ("panoptic", "tracked")
    if "labels" in method.evidence:
        return ("labels",)
    return ("features",) if method.evidence == ("features",) else ("panoptic", "tracked")


def _of_folder(
    path: Path, taken: tuple[EvidenceKind, ...], *, words: bool
) -> tuple[EvidenceKind, str] | None:
    kind = open_evidence(path).kind
    beside = path.absolute().parent / TEXT_FILE
    if words and not ((path / TEXT_FILE).is_file() or beside.is_file()):
        return None
    return (kind, kind) if kind in taken else None


def _of_model(
    named: str, taken: tuple[EvidenceKind, ...], *, words: bool
) -> tuple[EvidenceKind, str] | None:
    family = find_family(name_of(named))
    gives: tuple[What, ...] = () if family is None else family.gives
    for what in gives:
        kind = _KIND_OF.get(what)
        if kind in taken and (not words or what == "text"):
            return kind, what
    return None


def _evidence_name(choice: Choice, scene: Scene) -> str:
    """What the evidence is called: as its model, and what else was asked of it behind a point."""
    name = _slug(choice.folder.name if choice.folder is not None else name_of(choice.named))
    if choice.folder is not None or scene.root is None:
        return name
    there = scene.root / "evidence" / name
    header = evidence_header(there) if there.is_dir() else None
    known = None if header is None else header.get("metadata")
    asked = cast("Mapping[str, Any]", known).get("what") if isinstance(known, Mapping) else None
    return name if asked in (None, choice.what) else f"{name}.{choice.what}"


def _slug(name: str) -> str:
    return "".join(c if c.isalnum() or c in "-_." else "-" for c in name)
