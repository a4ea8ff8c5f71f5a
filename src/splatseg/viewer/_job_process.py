"""Work that takes all cores for minutes, in a process of its own: masks of views, and their layer.

``python -m splatseg.viewer._job_process NAME SCENE BACKEND`` reads its arguments as JSON from the
standard input and writes lines of JSON: ``{"done", "total", "text"}``, and at the end ``{"text"}``
or ``{"error"}``. A process that is ended has written whole views.
"""

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TextIO

import msgspec
from typing_extensions import override

from splatseg.errors import InputError, SplatsegError
from splatseg.render import BackendName
from splatseg.tasks.work import Observer

_SECONDS = 0.2
"""Between two lines of one stage."""

EVIDENCE = "masks"
"""Name of the evidence that is written and read."""


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


def _see(root: Path, given: dict[str, Any], backend: BackendName, observer: Observer) -> str:
    from splatseg.io.scene import load_scene
    from splatseg.models import model_names
    from splatseg.tasks import SeeOptions, see

    model = given.get("model", "classical")
    if model not in model_names():
        raise InputError(f"model: expected one of {', '.join(model_names())}, got {model!r:.60}.")
    seen = see(
        load_scene(root), model, EVIDENCE, options=SeeOptions(), backend=backend, observer=observer
    )
    return f"{seen.kind} of {seen.views} views by {seen.model}"


def _associate(root: Path, given: dict[str, Any], backend: BackendName, observer: Observer) -> str:
    from splatseg.io.scene import load_scene
    from splatseg.io.scene_folder import work_on_scene
    from splatseg.tasks import SegmentOptions, save_segmentation, segment

    with work_on_scene(root, "segment", writes=("layers",)):
        found = segment(
            load_scene(root),
            "associate",
            options=SegmentOptions(evidence=EVIDENCE),
            backend=backend,
            observer=observer,
        )
        save_segmentation(found, root)
    return f"layer {found.name}"


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
