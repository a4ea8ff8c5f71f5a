"""Work that takes all cores for minutes, in a process of its own: masks of views, and their layer.

``python -m splatseg.viewer._job_process NAME SCENE BACKEND`` reads its arguments as JSON from the
standard input and writes lines of JSON: ``{"done", "total", "text"}``, and at the end ``{"text"}``
or ``{"error"}``. A process that is ended has written whole views.
"""

import contextlib
import itertools
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

import msgspec
from typing_extensions import override

from splatseg.errors import InputError, MissingFileError, MissingPackageError, SplatsegError
from splatseg.render import BackendName
from splatseg.report.words import counted
from splatseg.tasks.work import Observer, Work

if TYPE_CHECKING:
    from splatseg.core.models import Model

_SECONDS = 0.2
"""Between two lines of one stage."""

EVIDENCE = "masks"
"""Name of the evidence that is written."""

_WITH_WEIGHTS = ("sam2", "sam-hq", "sam")
"""Models of masks that are taken where there is a GPU and their weights are on this machine, the
best first; on a CPU each view would take minutes."""

_METHOD = "associate"


class _Lines(Observer):
    """Writes the progress as lines of JSON."""

    def __init__(self, out: TextIO) -> None:
        self._out = out
        self._last = 0.0

    @override
    def started(self, stage: str) -> None:
        self._write(0, 0, stage)

    @override
    def progress(self, stage: str, done: int, total: int) -> None:
        now = time.monotonic()
        if now - self._last >= _SECONDS or done == total:
            self._last = now
            self._write(done, total, stage)

    def _write(self, done: int, total: int, text: str) -> None:
        _say(self._out, {"done": done, "total": total, "text": text})


def _say(out: TextIO, value: dict[str, Any]) -> None:
    """One line of JSON, at once."""
    out.write(msgspec.json.encode(value).decode() + "\n")
    out.flush()


def masks_at_hand(work: Work) -> str | None:
    """The evidence of masks that covers all views to learn from; of several, one of SAM first."""
    wanted = {view.name for view in work.scene.train_views or work.scene.views}
    names: list[str] = []
    for name in work.evidence_names:
        # What a `see` that was stopped has left cannot be opened; the same `see` goes on with it.
        with contextlib.suppress(InputError):
            evidence = work.evidence(name)
            if evidence.kind == "masks" and wanted <= set(evidence.view_names):
                names.append(name)
    return min(names, key=lambda name: ("sam" not in name, name), default=None)


def _model_at_hand() -> "Model | str":
    import torch

    from splatseg.models import find_model

    if torch.cuda.is_available():
        for name in _WITH_WEIGHTS:
            with contextlib.suppress(MissingFileError, MissingPackageError):
                return find_model(name)
    return "regions"


def _see(root: Path, given: dict[str, Any], backend: BackendName, observer: Observer) -> str:
    from splatseg.io.scene import load_scene
    from splatseg.models import model_names
    from splatseg.tasks import SeeOptions, see

    scene, model = load_scene(root), given.get("model")
    if model is None:
        there = masks_at_hand(Work(scene=scene, backend=backend))
        if there is not None:
            return f"{there} are at hand"
        model = _model_at_hand()
    elif model not in model_names():
        raise InputError(f"model: expected one of {', '.join(model_names())}, got {model!r:.60}.")
    views = ("train",) if scene.train_views else ("all",)
    seen = see(
        scene,
        model,
        EVIDENCE,
        options=SeeOptions(views=views),
        backend=backend,
        observer=observer,
    )
    return f"{seen.kind} of {counted(seen.views, 'view')} by {seen.model}"


def _associate(root: Path, given: dict[str, Any], backend: BackendName, observer: Observer) -> str:
    from splatseg.core import UNLABELLED, InstanceTree, Labels
    from splatseg.io.scene import load_scene
    from splatseg.io.scene_folder import work_on_scene
    from splatseg.tasks import SegmentOptions, save_segmentation, segment

    with work_on_scene(root, "segment", writes=("layers",)):
        scene = load_scene(root)
        work = Work(scene=scene, backend=backend)
        evidence = masks_at_hand(work) or EVIDENCE
        found = segment(
            scene,
            _METHOD,
            options=SegmentOptions(
                evidence=evidence,
                layer=_free_name(work, evidence),
                views=("train",) if scene.train_views else ("all",),
            ),
            backend=backend,
            observer=observer,
        )
        save_segmentation(found, root)
    layer = found.layer.cut() if isinstance(found.layer, InstanceTree) else found.layer
    ids = set(layer.ids.tolist()) if isinstance(layer, Labels) else set[int]()
    return f"{counted(len(ids - {UNLABELLED}), 'object')} in layer {found.name}"


def _free_name(work: Work, name: str) -> str:
    """A name for the layer that replaces none but one that was associated, too."""
    taken = {one for one in work.layer_names if work.facts(one).info.method != _METHOD}
    numbered = (f"{name}_{number}" for number in itertools.count(2))
    return next(one for one in itertools.chain((name,), numbered) if one not in taken)


_WORK: dict[str, Callable[[Path, dict[str, Any], BackendName, Observer], str]] = {
    "see": _see,
    "associate": _associate,
}


def main(words: list[str], given: TextIO, out: TextIO) -> int:
    """Do one job; gives the exit status."""
    name, root, backend = words
    try:
        arguments = msgspec.json.decode(given.read(), type=dict[str, Any])
        text = _WORK[name](Path(root), arguments, backend, _Lines(out))  # pyright: ignore[reportArgumentType]
    except SplatsegError as error:
        _say(out, {"error": str(error)})
        return 2
    _say(out, {"text": text})
    return 0


if __name__ == "__main__":
    # What libraries print must not be taken for a line of ours.
    protocol, sys.stdout = sys.stdout, sys.stderr
    sys.exit(main(sys.argv[1:], sys.stdin, protocol))
