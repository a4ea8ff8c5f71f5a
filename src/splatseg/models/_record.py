"""Evidence of a scene's views, written view by view: what ``splatseg see`` does."""

import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Literal, cast

from splatseg.core import View
from splatseg.core.boundary import boundary
from splatseg.core.models import Image, MaskTracker, Model
from splatseg.errors import InputError
from splatseg.io.evidence import (
    Evidence,
)
from splatseg.models._cache import ModelCache
from splatseg.models._computed import Pictures, ability, announce, batch_of, computed
from splatseg.models._copied import copied
from splatseg.models._seeds import TrackingOptions
from splatseg.models._sources import Source, What
from splatseg.models._target import SeenEvidence, open_target
from splatseg.models._tracked import tracked
from splatseg.models.recorded import AnyRecorded


@boundary
def record_evidence(
    model: Model,
    views: Sequence[View],
    folder: Path | str,
    *,
    what: What | Sequence[What] | None = None,
    asked: str = "train",
    overwrite: bool = False,
    missing: Literal["refuse", "skip"] = "refuse",
    cache: ModelCache | None = None,
    seeds: Evidence | None = None,
    tracking: TrackingOptions | None = None,
    image_of: Callable[[View, Path], Image] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> SeenEvidence:
    """Write what a model sees in views, one view at a time; a second call does what is left.

    A recorded model's evidence is checked and copied; no photograph is read for it. If it fails,
    or before the first view is there, no folder is left.

    Args:
        model: The model, or a recorded one.
        views: The views to look at.
        folder: Where to write, usually SCENE/evidence/NAME. Its parent must exist.
        what: Masks, labels, panoptic, features, text or tracked; None takes what the model has,
            masks before the others. Of several the first goes to `folder`, each further one beside
            it to NAME.WHAT; a network that gives them together passes each image once.
        asked: How the views were asked for; recorded, so that it can be seen later what the
            evidence may be used for.
        overwrite: Whether evidence of the same name is replaced, once the new one is complete.
        missing: Whether it is an error that recorded evidence lacks a view.
        cache: Where to look before the model is run.
        seeds: What a tracker is to follow: evidence of masks, panoptic segments, labels or tracks.
            Tracks are asked for alone, and are written whole or not at all.
        tracking: Which of the seeds count, and the order of the views.
        image_of: Gives the picture of a view that the model is to see, in the pixels of its
            camera, and may keep it in the folder where the evidence is being written, which it
            is given too. None takes photographs.
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
    asked_for = _distinct(what)
    pictures = Pictures(image_of)
    sources = (
        _sources_of_tracks(
            model, views, asked_for, cache=cache, seeds=seeds, tracking=tracking, pictures=pictures
        )
        if _is_followed(model, asked_for)
        else _sources_by_view(
            model, views, asked_for, cache=cache, missing=missing, pictures=pictures
        )
    )
    if (seeds is not None or tracking is not None) and sources[0].goes_on:
        raise InputError(f"seeds: expected with a tracker, got model {model.name!r}.")
    folders = evidence_folders(Path(folder), asked_for)
    for source, target in zip(sources, folders, strict=True):
        source.check_target(target)
    available = frozenset.intersection(*(source.available(views) for source in sources))
    wanted = [view for view in sources[0].sequence(views) if view.name in available]
    started = time.monotonic()
    with ExitStack() as stack:
        targets = [
            stack.enter_context(
                open_target(model, source, target, wanted, asked=asked, overwrite=overwrite)
            )
            for source, target in zip(sources, folders, strict=True)
        ]
        done = frozenset.intersection(*(target.done for target in targets))
        todo = [view for view in wanted if view.name not in done]
        for first in range(0, len(todo), batch_of(model)):
            together = todo[first : first + batch_of(model)]
            if progress is not None:
                progress(len(done) + first, len(wanted))
            pictures.forget()
            announce(model, [(target.source, target.folder) for target in targets], together)
            for view in together:
                for target in targets:
                    target.write(view)
        if progress is not None:
            progress(len(wanted), len(wanted))
        seconds = time.monotonic() - started
        for target in targets:
            target.finish()
    seen = [target.seen(model.name, seconds) for target in targets]
    return replace(seen[0], further=tuple(seen[1:]))


def _is_followed(model: Model, asked_for: Sequence[What | None]) -> bool:
    """Whether a tracker is asked for tracks."""
    if isinstance(model, AnyRecorded):
        return False
    return "tracked" in [ability(model, one) for one in asked_for]


def _sources_by_view(
    model: Model,
    views: Sequence[View],
    asked_for: Sequence[What | None],
    *,
    cache: ModelCache | None,
    missing: Literal["refuse", "skip"],
    pictures: Pictures,
) -> list[Source]:
    """Evidence of each view by itself, one a kind."""
    return [
        copied(model, views, what=one, missing=missing)
        if isinstance(model, AnyRecorded)
        else computed(model, what=one, cache=cache, pictures=pictures)
        for one in asked_for
    ]


def _sources_of_tracks(
    model: Model,
    views: Sequence[View],
    asked_for: Sequence[What | None],
    *,
    cache: ModelCache | None,
    seeds: Evidence | None,
    tracking: TrackingOptions | None,
    pictures: Pictures,
) -> list[Source]:
    """The evidence of a tracker, which goes through all views."""
    if len(asked_for) > 1:
        raise InputError("what: expected tracked alone, since views come in its order; got more.")
    if cache is not None:
        raise InputError("cache: keeps answers to single photographs, got a tracker's.")
    options = tracking or TrackingOptions()
    tracker = cast(MaskTracker, model)
    return [tracked(tracker, views, seeds=seeds, options=options, pictures=pictures)]


def evidence_folders(folder: Path, what: Sequence[What | None]) -> list[Path]:
    """Where each of several kinds of evidence goes: the first to the folder, others beside it."""
    return [folder, *(folder.with_name(f"{folder.name}.{one}") for one in what[1:])]


def _distinct(what: What | Sequence[What] | None) -> list[What | None]:
    if what is None or isinstance(what, str):
        return [what]
    if not what:
        return [None]
    if len(set(what)) != len(what):
        raise InputError(f"what: expected different kinds, got {', '.join(what)}.")
    return list(what)
