"""A folder of evidence while it is being written: begun, gone on with, replaced, finished."""

import importlib.metadata
import shutil
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

from splatseg.core import View
from splatseg.core.checkpoints import ABSENT, OptionDifference, option_differences
from splatseg.core.models import Model, ModelWithDefaults
from splatseg.errors import InputError
from splatseg.io.atomic import (
    TEMPORARY,
    hidden_folder,
    is_vacant,
    named_write_failures,
    replace_folder,
    sweep,
)
from splatseg.io.evidence import (
    EvidenceKind,
    create_evidence,
    evidence_header,
    view_files,
)
from splatseg.io.json_files import json_text, parse_object
from splatseg.models._sources import Source, some, views_done

_SAME = ("model", "settings", "what")
_OF_TRACKS = "tracking"
"""What must be as it was for interrupted work to go on, and how seeds were followed."""

_DEFAULTS = "default_settings"
"""What a setting counts as that was not recorded, where the model says so."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SeenEvidence:
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

    seconds: float
    """Wall time of the views written now."""

    bytes: int
    """Size of the folder."""

    notes: tuple[str, ...]
    """What the user should know of the evidence, a sentence each."""

    further: tuple["SeenEvidence", ...] = ()
    """What was written beside it, where several kinds were asked for."""


@dataclass(slots=True, kw_only=True, eq=False)
class Target:
    """One folder of evidence while it is being written."""

    source: Source
    target: Path
    folder: Path
    """Where views are written now."""

    metadata: Mapping[str, Any]
    wanted: int
    done: frozenset[str]
    masks: int = 0

    def write(self, view: View) -> None:
        if view.name not in self.done:
            self.masks += self.source.write(self.folder, view)

    def finish(self) -> None:
        self.source.finish(self.folder)
        _write_header(self.folder, self.source, {**self.metadata, "complete": True})

    def seen(self, model: str, seconds: float) -> SeenEvidence:
        files = (path for path in self.target.rglob("*") if path.is_file())
        return SeenEvidence(
            folder=self.target,
            model=model,
            kind=self.source.kind,
            views=self.wanted,
            kept=len(self.done),
            masks=self.masks if self.source.kind == "masks" else None,
            seconds=seconds,
            bytes=sum(path.stat().st_size for path in files),
            notes=self.source.notes(),
        )


@contextmanager
def open_target(
    model: Model,
    source: Source,
    target: Path,
    wanted: Sequence[View],
    *,
    asked: str,
    overwrite: bool,
) -> Generator[Target]:
    """A folder to write evidence to, with what was done in it before."""
    metadata = _metadata(model, source, asked)
    with _work_folder(target, source, overwrite=overwrite) as folder:
        done = _begin(folder, source, wanted, metadata)
        source.start(folder, wanted)
        yield Target(
            source=source, target=target, folder=folder, metadata=metadata,
            wanted=len(wanted), done=done,
        )  # fmt: skip


def _metadata(model: Model, source: Source, asked: str) -> dict[str, Any]:
    metadata = {
        "model": model.name,
        "settings": dict(model.settings),
        _DEFAULTS: dict(model.default_settings) if isinstance(model, ModelWithDefaults) else {},
        "what": source.what,
        "note": model.note,
        "views_asked": asked,
        "versions": {"splatseg": importlib.metadata.version("splatseg")},
        "complete": False,
        **source.details(),
    }
    # As it will be read back, so that the two can be compared.
    return parse_object(json_text("metadata", metadata), where="metadata")


@contextmanager
def _work_folder(target: Path, source: Source, *, overwrite: bool) -> Generator[Path]:
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
        worthless = not (had_views or source.is_costly) and (
            isinstance(error, Exception) or not source.goes_on
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
    folder: Path, source: Source, wanted: Sequence[View], metadata: Mapping[str, Any]
) -> frozenset[str]:
    """Make the folder, or see what of the work is done there; gives the views to skip."""
    header = evidence_header(folder) if folder.is_dir() else None
    if header is not None and _may_be_lost(folder, header, source, metadata):
        shutil.rmtree(folder)
        header = None
    if header is None:
        _write_header(folder, source, metadata)
        return frozenset()
    _check_same(folder, header, source, metadata)
    if not source.goes_on and _is_unfinished(header):
        shutil.rmtree(folder)
        _write_header(folder, source, metadata)
        return frozenset()
    there = views_done(folder, source.kind)
    extra = sorted(there - {view.name for view in wanted})
    if extra:
        raise InputError(
            f"{folder}: holds {len(extra)} views that are not asked for now ({some(extra)}); ask "
            "for them too, overwrite it, or choose another name."
        )
    if not source.goes_on and len(there) < len(wanted):
        raise InputError(
            f"{folder}: holds {len(there)} of {len(wanted)} views, and the others cannot be added; "
            "overwrite it or choose another name."
        )
    if _lacks_blocks(header, source):
        raise InputError(
            f"{folder}: an earlier splatseg began this evidence, which wrote the deepest features "
            "alone; overwrite it or choose another name."
        )
    _write_header(folder, source, metadata)
    return there


def _lacks_blocks(header: Mapping[str, Any], source: Source) -> bool:
    """Whether views that are there are of a version that had one block, and others are to come."""
    recorded = header.get("metadata")
    before = cast("Mapping[str, Any]", recorded) if isinstance(recorded, Mapping) else {}
    old = header.get("version") == 1 and before.get("complete") is False
    return old and source.kind == "features" and source.what == "features"


def _may_be_lost(
    folder: Path, header: Mapping[str, Any], source: Source, metadata: Mapping[str, Any]
) -> bool:
    """Whether a folder holds nothing to go on with: no view, or new evidence of other settings."""
    if not _holds_views(folder):
        return _is_unfinished(header)
    if not folder.name.startswith(TEMPORARY):
        return False
    try:
        _check_same(folder, header, source, metadata)
    except InputError:
        return True
    return False


def _is_unfinished(header: Mapping[str, Any] | None) -> bool:
    recorded = None if header is None else header.get("metadata")
    return isinstance(recorded, Mapping) and recorded.get("complete") is False  # pyright: ignore[reportUnknownMemberType]


def _check_same(
    folder: Path, header: Mapping[str, Any], source: Source, metadata: Mapping[str, Any]
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
    if header.get("kind") != source.kind or differences:
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


def _write_header(folder: Path, source: Source, metadata: Mapping[str, Any]) -> None:
    create_evidence(
        folder,
        kind=source.kind,
        classes=source.classes(),
        source_ids=source.source_ids(),
        metadata=metadata,
    )
