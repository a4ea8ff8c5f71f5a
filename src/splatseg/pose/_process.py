"""Runs the process that works with pycolmap, and ends it with this one."""

import importlib.util
import json
import os
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, cast

import splatseg
from splatseg.errors import BackendError, FileFormatError, MissingPackageError
from splatseg.io.json_files import parse_object, read_json

_LOG_LINES = 3


def require_pycolmap() -> None:
    """Raise `MissingPackageError` where pycolmap is not installed; it is not imported here."""
    if importlib.util.find_spec("pycolmap") is None:
        raise MissingPackageError(
            "poses from bare photographs need a package that is not installed (pycolmap); try: "
            "pip install 'splatseg[sfm]'."
        )


def usable_threads(asked: int | None) -> int:
    """Threads to work with: what was asked for, OMP_NUM_THREADS, or the cores we may use."""
    if asked is not None:
        return asked
    setting = os.environ.get("OMP_NUM_THREADS", "")
    if setting.isdigit() and int(setting) > 0:
        return int(setting)
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def run_worker(
    job: Mapping[str, Any], folder: Path, *, progress: Callable[[str, int, int], None]
) -> dict[str, Any]:
    """Do a job in a process of its own, and give its result.

    Args:
        job: See `splatseg.pose._worker`.
        folder: Where job, log and result lie.
        progress: Told the stage, what is done of it, and how much there is (0: not known).

    Raises:
        BackendError: If the process ended without a result.
    """
    result = Path(job["result"])
    result.unlink(missing_ok=True)
    (folder / "job.json").write_text(json.dumps(job, indent=1), encoding="utf-8")
    log = folder / "log.txt"
    with log.open("w", encoding="utf-8") as errors:
        # A session of its own: Ctrl-C reaches this process, which ends that one. Should this
        # one be killed, its end of the pipe closes, and that one ends itself.
        process = subprocess.Popen(  # noqa: S603  (our own module, no shell)
            [sys.executable, "-P", "-m", "splatseg.pose._worker", str(folder / "job.json")],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=errors,
            env=_environment(cast(int, job["options"]["threads"])),
            start_new_session=True,
            text=True,
            encoding="utf-8",
        )
        try:
            for line in process.stdout or ():
                _pass_on(line, progress)
            status = process.wait()
        finally:
            if process.poll() is None:
                process.kill()
            process.wait()
            for pipe in (process.stdin, process.stdout):
                if pipe is not None:
                    pipe.close()
    if status != 0 or not result.is_file():
        raise BackendError(_failure(status, log))
    return read_json(result)


def _environment(threads: int) -> dict[str, str]:
    """Ours, with this very package first on the path and as many threads as were asked for."""
    home = str(Path(splatseg.__file__).parent.parent)
    path = os.pathsep.join(filter(None, (home, os.environ.get("PYTHONPATH", ""))))
    return {**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": str(threads)}


def _pass_on(line: str, progress: Callable[[str, int, int], None]) -> None:
    try:
        message = parse_object(line, where="progress")
        stage, done, total = message["stage"], message["done"], message["total"]
    except (FileFormatError, KeyError):
        return  # Something that a library printed.
    progress(str(stage), int(done), int(total))


def _failure(status: int, log: Path) -> str:
    lines = [
        line for line in log.read_text(encoding="utf-8", errors="replace").splitlines() if line
    ]
    last = "; ".join(lines[-_LOG_LINES:]) or "it said nothing"
    return f"structure from motion ended with status {status}: {last} (all of it is in {log})."
