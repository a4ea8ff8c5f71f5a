"""Evidence of a scene's views, written view by view: what ``splatseg see`` does.

A folder of evidence is begun, gone on with, replaced or finished here; writers fill it.
"""

import importlib.metadata
import shutil
import time
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

from jaxtyping import Float
from torch import Tensor

from splatseg.core import LOCAL, Executor, View
from splatseg.core.boundary import boundary
from splatseg.core.checkpoints import ABSENT, OptionDifference, option_differences
from splatseg.core.executor import ThreadExecutor
from splatseg.core.models import (
    DepthAwareMasks,
    Image,
    MaskTracker,
    Model,
    ModelWithDefaults,
)
from splatseg.errors import FileFormatError, InputError
from splatseg.io.atomic import (
    TEMPORARY,
    hidden_folder,
    is_vacant,
    named_write_failures,
    replace_folder,
    sweep,
)
from splatseg.io.evidence import (
    Evidence,
    EvidenceKind,
    FeatureEvidence,
    create_evidence,
    evidence_header,
    open_evidence,
    read_id_map,
    view_files,
)
from splatseg.io.json_files import json_text, parse_object
from splatseg.models._tracked import TrackingEvidence, TrackingOptions
from splatseg.models._weights import What
from splatseg.models._written import (
    Answer,
    ComputedEvidence,
    CopiedEvidence,
    EvidenceWriter,
    Look,
    ability,
    answers_of,
    batch_of,
    some,
    threads_for,
)
from splatseg.models.recorded import RecordedModel

_SAME = ("model", "settings", "what")
_OF_TRACKS = "tracking"
"""What must be as it was for interrupted work to go on, and how seeds were followed."""

_DEFAULTS = "default_settings"
"""What a setting counts as that was not recorded, where the model says so."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EvidenceRequest:
    """What a model is asked for, and how it is written."""

    what: What | Sequence[What] | None = None
    """Masks, labels, panoptic, features, text, depth or tracked; None takes what the model has,
    masks before the others. Of several the first goes to the folder, each further one beside it
    to NAME.WHAT; a network that gives them together passes each image once."""

    view_spec: str = "train"
    """Which views were requested, in words; recorded."""

    overwrite: bool = False
    """Replace evidence of the same name, once the new one is complete."""

    allow_missing: bool = False
    """Take the views that recorded evidence has, where some are missing."""

    seeds: Evidence | None = None
    """Objects that a tracker follows: evidence of masks, panoptic segments, labels or tracks.
    Tracks are asked for alone, and are written whole or not at all."""

    tracking: TrackingOptions | None = None
    """Which of the seeds count, and the order of the views."""

    image_of: Callable[[View], Image] | None = None
    """Gives the picture of a view that the model is to see, in the pixels of its camera. That of a
    view without a photograph is kept beside the evidence. None takes photographs."""

    depth_of: Callable[[View], Float[Tensor, "height width"]] | None = None
    """Gives the z-depth of a view, 0 where there is nothing, to a model whose masks go by it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DescribedEvidence:
    """What was written."""

    folder: Path
    model: str
    """Name of the model."""

    kind: EvidenceKind
    views: int
    """Views with evidence, those that were there before included."""

    kept: int
    """Views that were there before."""

    masks: int | None
    """Masks of the views written now; None where the kind has none."""

    drawn: int
    """Views written now that have no photograph, and whose renders were kept."""

    seconds: float
    """Wall time of the views written now."""

    bytes: int
    """Size of the folder."""

    notes: tuple[str, ...]
    """What the user should know of the evidence, a sentence each."""

    further: tuple["DescribedEvidence", ...] = ()
    """What was written beside it, where several kinds were asked for."""


@boundary
def record_evidence(
    model: Model,
    views: Sequence[View],
    folder: Path | str,
    request: EvidenceRequest = EvidenceRequest(),
    *,
    executor: Executor = LOCAL,
    progress: Callable[[int, int], None] | None = None,
) -> DescribedEvidence:
    """Write what a model sees in views, one view at a time; a second call does what is left.

    A recorded model's evidence is checked and copied; no photograph is read for it. If it fails,
    or before the first view is there, no folder is left.

    Args:
        model: The model, or a recorded one.
        views: The views to look at.
        folder: Where to write, usually SCENE/evidence/NAME. Its parent must exist.
        request: What the model is asked for, and how it is written.
        executor: Where a model looks at views; the files do not depend on it. Recorded evidence is
            copied, and a tracker runs, in this process.
        progress: Called with the number of views done and of all.

    Raises:
        InputError: If the model has no such thing, the folder holds something else or was made
            with other settings, or recorded evidence lacks views.
        FileFormatError: If recorded evidence is broken or has not the photograph's size.
        BackendError: If an image does not fit the memory of the device.
        OutputError: If the disk is full, or there is no permission.
    """
    if not views:
        raise InputError("views: expected at least one view, got none.")
    questions = _distinct(request.what)
    if request.depth_of is not None and not isinstance(model, DepthAwareMasks):
        raise InputError(
            f"depth_from_scene: expected a model that takes depth, got {model.name!r}."
        )
    writers = _writers(model, views, questions, request)
    folder = Path(folder)
    folders = [folder, *(folder.with_name(f"{folder.name}.{one}") for one in questions[1:])]
    for writer, target in zip(writers, folders, strict=True):
        _check_apart(target, writer.reads)
    available = frozenset.intersection(
        *(frozenset(view.name for view in writer.views) for writer in writers)
    )
    wanted = [view for view in writers[0].views if view.name in available]
    started = time.monotonic()
    with ExitStack() as stack:
        targets = [
            stack.enter_context(_open_target(model, writer, target, wanted, request))
            for writer, target in zip(writers, folders, strict=True)
        ]
        done = frozenset.intersection(*(target.done for target in targets))
        todo = [view for view in wanted if view.name not in done]
        batches = [todo[i : i + batch_of(model)] for i in range(0, len(todo), batch_of(model))]
        answers = stack.enter_context(
            closing(_answers(model, targets, batches, request, executor=executor))
        )
        written = len(done)
        for together in batches:
            if progress is not None:
                progress(written, len(wanted))
            for view in together:
                for target in targets:
                    target.write(view, answers)
            written += len(together)
        if progress is not None:
            progress(len(wanted), len(wanted))
        seconds = time.monotonic() - started
        for target in targets:
            target.finish()
    drawn = sum(view.image is None for view in todo)
    seen = [target.seen(model.name, seconds, drawn=drawn) for target in targets]
    return replace(seen[0], further=tuple(seen[1:]))


def _distinct(what: What | Sequence[What] | None) -> list[What | None]:
    if what is None or isinstance(what, str):
        return [what]
    if len(set(what)) != len(what):
        raise InputError(f"what: expected different kinds, got {', '.join(what)}.")
    return list(what) or [None]


def _writers(
    model: Model,
    views: Sequence[View],
    questions: Sequence[What | None],
    request: EvidenceRequest,
) -> Sequence[EvidenceWriter]:
    """What writes the answers to each question; a tracker goes through all views."""
    if not isinstance(model, RecordedModel) and "tracked" in [
        ability(model, one) for one in questions
    ]:
        if len(questions) > 1:
            raise InputError("what: expected tracked alone, since views come in its order.")
        options = request.tracking or TrackingOptions()
        tracker = cast(MaskTracker, model)
        return [
            TrackingEvidence(
                tracker, views, seeds=request.seeds, options=options, image_of=request.image_of
            )
        ]
    if request.seeds is not None or request.tracking is not None:
        raise InputError(f"seeds: expected with a tracker, got model {model.name!r}.")
    if isinstance(model, RecordedModel):
        missing = request.allow_missing
        return [CopiedEvidence(model, views, one, allow_missing=missing) for one in questions]
    with_depth = request.depth_of is not None
    return [ComputedEvidence(model, views, one, with_depth=with_depth) for one in questions]


def _answers(
    model: Model,
    targets: Sequence["_Target"],
    batches: Sequence[Sequence[View]],
    request: EvidenceRequest,
    *,
    executor: Executor,
) -> Generator[Answer]:
    """What the model says, in the order in which it is written; nothing where it is not run."""
    if not all(isinstance(target.writer, ComputedEvidence) for target in targets):
        return
    look = Look(
        model=model,
        what=tuple(target.writer.what for target in targets),
        image_of=request.image_of,
        depth_of=request.depth_of,
    )
    threads = threads_for(model, look.what, sum(map(len, batches)))
    if executor is LOCAL and threads > 1:
        executor = ThreadExecutor(threads)
    asked = [
        [(view, [i for i, one in enumerate(targets) if one.lacks(view)]) for view in together]
        for together in batches
    ]
    with closing(executor.map(answers_of, asked, shared=look)) as found:
        yield from found


def _check_apart(target: Path, reads: Path | None) -> None:
    if reads is None:
        return
    source, resolved = reads.resolve(), target.resolve()
    if source == resolved or resolved in source.parents or source in resolved.parents:
        raise InputError(
            f"{target}: expected another folder than that of the evidence that is read, {reads}."
        )


@dataclass(slots=True, kw_only=True, eq=False)
class _Target:
    """One folder of evidence while it is being written."""

    writer: EvidenceWriter
    target: Path
    folder: Path
    """Where views are written now."""

    metadata: Mapping[str, Any]
    wanted: int
    done: frozenset[str]
    masks: int = 0

    def lacks(self, view: View) -> bool:
        """Whether the view is to be written now."""
        return view.name not in self.done

    def write(self, view: View, answers: Iterator[Answer]) -> None:
        if self.lacks(view):
            self.masks += self.writer.write(self.folder, view, answers)

    def finish(self) -> None:
        self.writer.finish(self.folder)
        _write_header(self.folder, self.writer, {**self.metadata, "complete": True})

    def seen(self, model: str, seconds: float, *, drawn: int) -> DescribedEvidence:
        files = (path for path in self.target.rglob("*") if path.is_file())
        return DescribedEvidence(
            folder=self.target,
            model=model,
            kind=self.writer.kind,
            views=self.wanted,
            kept=len(self.done),
            masks=self.masks if self.writer.kind == "masks" else None,
            drawn=drawn,
            seconds=seconds,
            bytes=sum(path.stat().st_size for path in files),
            notes=self.writer.notes(),
        )


@contextmanager
def _open_target(
    model: Model,
    writer: EvidenceWriter,
    target: Path,
    wanted: Sequence[View],
    request: EvidenceRequest,
) -> Generator[_Target]:
    """A folder to write evidence to, with what was done in it before."""
    metadata = _metadata(model, writer, request.view_spec)
    with _work_folder(target, writer, overwrite=request.overwrite) as folder:
        done = _begin(folder, writer, wanted, metadata)
        writer.start(folder, wanted)
        yield _Target(
            writer=writer, target=target, folder=folder, metadata=metadata,
            wanted=len(wanted), done=done,
        )  # fmt: skip


def _metadata(model: Model, writer: EvidenceWriter, view_spec: str) -> dict[str, Any]:
    metadata = {
        "model": model.name,
        "settings": {**model.settings, **writer.settings},
        _DEFAULTS: dict(model.default_settings) if isinstance(model, ModelWithDefaults) else {},
        "what": writer.what,
        "note": model.note,
        "views_asked": view_spec,
        "versions": {"splatseg": importlib.metadata.version("splatseg")},
        "complete": False,
        **writer.details,
    }
    # As it will be read back, so that the two can be compared.
    return parse_object(json_text("metadata", metadata), where="metadata")


@contextmanager
def _work_folder(target: Path, writer: EvidenceWriter, *, overwrite: bool) -> Generator[Path]:
    """Where views are written: the folder itself, or one beside evidence that is replaced.

    The one beside stays if the block is interrupted, and the next call goes on in it. What holds
    nothing worth going on with is removed.
    """
    if target.exists() and not target.is_dir():
        raise InputError(f"{target}: expected a folder to write evidence to, got a file.")
    if not target.parent.is_dir():
        raise InputError(f"{target}: expected a folder of evidence in a folder that is there.")
    header = evidence_header(target) if target.is_dir() else None
    if target.is_dir() and header is None and not is_vacant(target):
        raise InputError(
            f"{target}: expected a new folder or evidence that splatseg wrote, got other files."
        )
    sweep(target)
    beside = target.with_name(f"{TEMPORARY}see-{target.name}")
    folder = beside if header is not None and overwrite else target
    had_views = folder.is_dir() and _holds_views(folder)
    try:
        yield folder
    except BaseException as error:
        worthless = not (had_views or writer.keep_partial) and (
            isinstance(error, Exception) or not writer.resumable
        )
        if folder.is_dir() and (worthless or not _holds_views(folder)):
            shutil.rmtree(folder, ignore_errors=True)
        raise
    if folder == beside:
        with hidden_folder(target) as holder, named_write_failures(target):
            beside.replace(holder / target.name)
            replace_folder(holder / target.name, target, holder / "previous")
    shutil.rmtree(beside, ignore_errors=True)


def _holds_views(folder: Path) -> bool:
    return any(view_files(folder, suffix) for suffix in (".png", ".json", ".npz"))


def _begin(
    folder: Path, writer: EvidenceWriter, wanted: Sequence[View], metadata: Mapping[str, Any]
) -> frozenset[str]:
    """Make the folder, or see what of the work is done there; gives the views to skip."""
    header = evidence_header(folder) if folder.is_dir() else None
    if header is not None and _may_be_lost(folder, header, writer, metadata):
        shutil.rmtree(folder)
        header = None
    if header is None:
        _write_header(folder, writer, metadata)
        return frozenset()
    _check_same(folder, header, writer, metadata)
    if not writer.resumable and _is_unfinished(header):
        shutil.rmtree(folder)
        _write_header(folder, writer, metadata)
        return frozenset()
    there = _views_done(folder, writer.kind)
    extra = sorted(there - {view.name for view in wanted})
    if extra:
        raise InputError(
            f"{folder}: holds {len(extra)} views that are not asked for now ({some(extra)}); ask "
            "for them too, overwrite it, or choose another name."
        )
    if not writer.resumable and len(there) < len(wanted):
        raise InputError(
            f"{folder}: holds {len(there)} of {len(wanted)} views, and the others cannot be added; "
            "overwrite it or choose another name."
        )
    if _lacks_blocks(header, writer):
        raise InputError(
            f"{folder}: an earlier splatseg began this evidence, which wrote the deepest features "
            "alone; overwrite it or choose another name."
        )
    _write_header(folder, writer, metadata)
    return there


def _lacks_blocks(header: Mapping[str, Any], writer: EvidenceWriter) -> bool:
    """Whether views that are there are of a version that had one block, and others are to come."""
    recorded = header.get("metadata")
    before = cast("Mapping[str, Any]", recorded) if isinstance(recorded, Mapping) else {}
    old = header.get("version") == 1 and before.get("complete") is False
    return old and writer.kind == "features" and writer.what == "features"


def _may_be_lost(
    folder: Path, header: Mapping[str, Any], writer: EvidenceWriter, metadata: Mapping[str, Any]
) -> bool:
    """Whether a folder holds nothing to go on with: no view, or new evidence of other settings."""
    if not _holds_views(folder):
        return _is_unfinished(header)
    if not folder.name.startswith(TEMPORARY):
        return False
    try:
        _check_same(folder, header, writer, metadata)
    except InputError:
        return True
    return False


def _is_unfinished(header: Mapping[str, Any] | None) -> bool:
    recorded = None if header is None else header.get("metadata")
    return isinstance(recorded, Mapping) and recorded.get("complete") is False  # pyright: ignore[reportUnknownMemberType]


def _check_same(
    folder: Path, header: Mapping[str, Any], writer: EvidenceWriter, metadata: Mapping[str, Any]
) -> None:
    recorded = header.get("metadata")
    before = cast("Mapping[str, Any]", recorded) if isinstance(recorded, Mapping) else {}
    same = (*_SAME, *(key for key in (_OF_TRACKS,) if key in metadata))
    if any(key not in before for key in same):
        raise InputError(
            f"{folder}: this evidence cannot be gone on with, as it does not say how it was made; "
            "overwrite it or choose another name."
        )
    differences = option_differences(
        {key: before[key] for key in same},
        {key: metadata[key] for key in same},
        defaults={"settings": metadata[_DEFAULTS]},
        recorded_defaults={"settings": before.get(_DEFAULTS, {})},
    )
    if header.get("kind") != writer.kind or differences:
        changed = ", ".join(map(_in_words, differences))
        raise InputError(
            f"{folder}: holds evidence made in another way "
            f"({changed or 'kind ' + str(header.get('kind'))}); overwrite it or choose another "
            "name."
        )


def _in_words(one: OptionDifference) -> str:
    there = "not known" if one.recorded is ABSENT else f"{one.recorded!r:.60}"
    now = "not known" if one.wanted is ABSENT else f"{one.wanted!r:.60}"
    return f"{one.name} {there} there, {now} now"


def _write_header(folder: Path, writer: EvidenceWriter, metadata: Mapping[str, Any]) -> None:
    create_evidence(
        folder,
        kind=writer.kind,
        classes=writer.classes,
        source_ids=writer.source_ids(),
        metadata=metadata,
    )


def _views_done(folder: Path, kind: EvidenceKind) -> frozenset[str]:
    """Views whose evidence in a folder, perhaps an unfinished one, can be read whole."""
    if kind in ("labels", "panoptic", "tracked"):
        # Panoptic evidence has no table before it is finished; its label maps tell.
        readable = [name for name, path in view_files(folder, ".png").items() if _is_map(path)]
        return frozenset(readable)
    evidence = open_evidence(folder, unfinished="allow")
    return frozenset(name for name in evidence.view_names if _is_readable(evidence, name))


def _is_map(path: Path) -> bool:
    try:
        read_id_map(path)
    except FileFormatError:
        return False
    return True


def _is_readable(evidence: Evidence, name: str) -> bool:
    asked = {"masks": evidence.masks, "depth": evidence.depth_map}
    try:
        if isinstance(evidence, FeatureEvidence):
            evidence.deep_features(name)
        else:
            asked.get(evidence.kind, evidence.features)(name)
    except FileFormatError:
        return False
    return True
