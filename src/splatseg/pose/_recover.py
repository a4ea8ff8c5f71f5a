"""Photographs or a video in, a capture with cameras and start points out."""

import importlib.util
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, cast

import splatseg
from splatseg.core import Capture
from splatseg.core.boundary import boundary
from splatseg.errors import (
    BackendError,
    FileFormatError,
    InputError,
    MissingPackageError,
)
from splatseg.io.json_files import parse_object, read_json
from splatseg.io.schema import structured
from splatseg.pose._photographs import (
    HOW_TO_PHOTOGRAPH,
    MIN_PHOTOGRAPHS,
    LeftOut,
    PoseOptions,
    WorkingLens,
    find_photographs,
    read_headers,
    write_working_copies,
)
from splatseg.pose._saved import (
    FILE,
    MODEL,
    Lens,
    MapperTry,
    PoseReport,
    fingerprint,
    load_capture,
    load_pose_report,
    save_poses,
)
from splatseg.pose._video import check_video, is_video, take_frames

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


_FEW_FEATURES = 100


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseProgress:
    """Where the work stands."""

    stage: str
    done: int
    total: int
    """0 where it is not known."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PoseResult:
    """Photographs with poses, and how they came by them."""

    capture: Capture
    """Views in the photographs' own pixels with the lens distortion found; start points."""

    report: PoseReport
    reused: bool
    """Whether all of it was there from an earlier run."""


@boundary
def recover_poses(
    photographs: Path | str,
    *,
    folder: Path | str | None = None,
    options: PoseOptions = PoseOptions(),  # noqa: B008  (frozen)
    progress: Callable[[PoseProgress], None] | None = None,
) -> PoseResult:
    """Cameras and start points of bare photographs, by structure from motion with pycolmap.

    Features (SIFT) of upright copies of at most `options.longest` pixels are matched, and a
    global or incremental mapper finds poses, points and lenses with one coefficient of radial
    distortion. The views of the capture are the photographs themselves: their own pixels after
    their EXIF orientation, intrinsics scaled up to them. The world has the cameras within about
    10 units; its scale means nothing. Every 8th photograph by name is a test view.

    pycolmap runs in a process of its own, so Ctrl-C ends it at once.

    Args:
        photographs: A folder of photographs (or with a folder ``images``), or a video.
        folder: Where the result is kept, so that a second call with the same photographs and
            options reads it, and a call after one that was stopped goes on from there. The
            frames of a video are written there. None keeps nothing.
        options: How.
        progress: Told now and then where the work stands.

    Returns:
        The capture and a report. On one thread the same to the bit in every run on the same
        machine; on several threads the adjustment adds in another order each time.

    Raises:
        MissingPackageError: If pycolmap, or for a video imageio-ffmpeg, is not installed.
        MissingFileError: If there are no such photographs.
        FileFormatError: If the video cannot be read.
        InputError: If there are fewer than 3 photographs, HEIC or RAW files, or fewer than 3
            photographs could be placed; the message says what to do.
        BackendError: If pycolmap failed.
    """
    source = Path(photographs)
    require_pycolmap()
    tell = teller(progress)
    if folder is None and is_video(source):
        raise InputError("folder: expected a folder for the frames of the video, got None.")
    with requested_or_temporary(folder) as kept:
        if is_video(source):
            root, files = kept, _frames(source, kept, options, tell)
        else:
            root, files = source, find_photographs(source)
        made_of = fingerprint(files, options)
        report = load_pose_report(kept, made_of=made_of)
        reused = report is not None
        if report is None:
            report = _recover(
                source, files, folder=kept, made_of=made_of, options=options, tell=tell
            )
        capture = load_capture(kept / MODEL, files, root=root)
    return PoseResult(
        capture=replace(capture, notes=(*capture.notes, *report.notes)),
        report=report,
        reused=reused,
    )


@contextmanager
def requested_or_temporary(folder: Path | str | None) -> Generator[Path]:
    """The folder, removed again if it is left empty; for None one that is deleted afterwards."""
    if folder is None:
        with tempfile.TemporaryDirectory(prefix="splatseg-") as temporary:
            yield Path(temporary)
        return
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    try:
        yield folder
    finally:
        with suppress(OSError):  # it is not empty
            folder.rmdir()


def _recover(
    source: Path,
    files: Sequence[Path],
    *,
    folder: Path,
    made_of: str,
    options: PoseOptions,
    tell: Callable[[str, int, int], None],
) -> PoseReport:
    work = _work_folder(folder, made_of)
    (folder / FILE).unlink(missing_ok=True)
    threads = usable_threads(options.threads)
    begin = time.monotonic()
    good, unreadable = read_headers(files)
    lenses, broken = write_working_copies(
        good,
        work / "images",
        options=options,
        threads=threads,
        progress=lambda done, total: tell("copies", done, total),
    )
    seconds = {"copies": time.monotonic() - begin}
    unusable = [*unreadable, *broken]
    count = sum(len(lens.images) for lens in lenses)
    if count < MIN_PHOTOGRAPHS:
        named = "; ".join(f"{left.name}: {left.why}" for left in unusable[:3])
        raise InputError(
            f"{source}: expected at least {MIN_PHOTOGRAPHS} photographs that can be read, "
            f"got {count} ({named})."
        )
    result = run_worker(_worker_job(work, lenses, options, threads), work, progress=tell)
    best = None if result["best"] is None else result["tries"][result["best"]]
    if best is None or best["registered"] < MIN_PHOTOGRAPHS:
        placed = 0 if best is None else best["registered"]
        # Nothing of this run is worth keeping: other photographs are needed.
        shutil.rmtree(work)
        raise InputError(
            f"{source}: expected photographs of one scene of which at least {MIN_PHOTOGRAPHS} "
            f"can be placed, got {placed} of {len(files)}; {HOW_TO_PHOTOGRAPH}."
        )
    capture = load_capture(work / "model", files, root=files[0].parent)
    report = _report(
        result,
        lenses,
        capture,
        photographs=len(files),
        unusable=unusable,
        seconds=seconds | result["seconds"],
        longest=options.longest,
    )
    save_poses(work / "model", folder, made_of=made_of, report=report)
    shutil.rmtree(work)
    return report


def _worker_job(
    work: Path, lenses: Sequence[WorkingLens], options: PoseOptions, threads: int
) -> dict[str, Any]:
    """What the process with pycolmap is told, in values that JSON holds."""
    return {
        "database": str(work / "features.db"),
        "images": str(work / "images"),
        "folder": str(work),
        "result": str(work / "result.json"),
        "lenses": [asdict(lens) for lens in lenses],
        "options": {
            "matching": options.matching,
            "mapper": options.mapper,
            "seed": options.seed,
            "threads": threads,
        },
    }


def _work_folder(folder: Path, made_of: str) -> Path:
    """The folder of what is not finished; emptied when it is of something else."""
    work = folder / "work"
    mark = work / "made_of.txt"
    if work.is_dir() and not (mark.is_file() and mark.read_text(encoding="utf-8") == made_of):
        shutil.rmtree(work)
    work.mkdir(parents=True, exist_ok=True)
    mark.write_text(made_of, encoding="utf-8")
    return work


def _frames(
    video: Path, folder: Path, options: PoseOptions, tell: Callable[[str, int, int], None]
) -> tuple[Path, ...]:
    """Frames of a video, taken unless they are there from an earlier run."""
    frames, mark = folder / "frames", folder / "frames.txt"
    check_video(video)
    made_of = fingerprint([video], PoseOptions(frames=options.frames))
    if not (mark.is_file() and mark.read_text(encoding="utf-8") == made_of and frames.is_dir()):
        take_frames(
            video,
            frames,
            wanted=options.frames,
            progress=lambda done, total: tell("frames", done, total),
        )
        mark.write_text(made_of, encoding="utf-8")
    files = tuple(sorted(frames.iterdir()))
    if len(files) < MIN_PHOTOGRAPHS:
        raise InputError(
            f"{video}: expected a video of at least {MIN_PHOTOGRAPHS} frames, got {len(files)}."
        )
    return files


def _report(
    result: Mapping[str, Any],
    lenses: Sequence[WorkingLens],
    capture: Capture,
    *,
    photographs: int,
    unusable: Sequence[LeftOut],
    seconds: Mapping[str, float],
    longest: int,
) -> PoseReport:
    own_name = {copy: own for lens in lenses for copy, own in lens.images.items()}
    members: list[list[str]] = result["models"]
    registered = set(members[0])
    left_out = [
        LeftOut(name=own_name[copy], why=_why(copy, result["photographs"].get(copy), members))
        for copy in sorted(own_name)
        if copy not in registered
    ]
    placed = {view.image.name: view.camera for view in capture.views if view.image is not None}
    without_distortion = set(result["model"]["without_distortion"])
    found: list[Lens] = []
    for lens in lenses:
        cameras = [placed[own] for own in lens.images.values() if own in placed]
        if cameras:
            first = cameras[0]
            found.append(
                Lens(
                    width=first.width,
                    height=first.height,
                    photographs=len(cameras),
                    focal=first.fx,
                    k1=first.distortion[0] if first.distortion else 0.0,
                    start="EXIF" if lens.prior else "guess",
                )
            )
    return PoseReport(
        photographs=photographs,
        registered=tuple(sorted(own_name[copy] for copy in registered)),
        left_out=tuple(sorted([*unusable, *left_out], key=lambda left: left.name)),
        mapper=result["tries"][result["best"]]["mapper"],
        tries=tuple(structured(attempt, MapperTry, where="result") for attempt in result["tries"]),
        error=result["model"]["error"],
        longest=longest,
        points=result["model"]["points"],
        track_length=result["model"]["track_length"],
        lenses=tuple(found),
        seconds=seconds,
        notes=tuple(
            f"no distortion was found that fits a lens of {lens.full_width}x{lens.full_height} "
            "pixels; it is taken for one without"
            for i, lens in enumerate(lenses)
            if i in without_distortion
        ),
    )


def _why(copy: str, facts: Mapping[str, int] | None, members: Sequence[Sequence[str]]) -> str:
    """Why a photograph has no pose."""
    if facts is None or facts["features"] < _FEW_FEATURES:
        count = 0 if facts is None else facts["features"]
        return f"it has only {count} features: too dark, blurred or plain"
    for model in members[1:]:
        if copy in model:
            return (
                f"it belongs to another part of {len(model)} photographs that shows nothing of "
                "the rest"
            )
    if not facts["pairs"]:
        return "it shows nothing that another photograph shows too"
    return (
        f"it shows something of {facts['pairs']} other photographs, but too little of what was "
        "found in 3D to say from where it was taken"
    )


def teller(progress: Callable[[PoseProgress], None] | None) -> Callable[[str, int, int], None]:
    """Progress as stage, done and total; None is told nothing."""

    def tell(stage: str, done: int, total: int) -> None:
        if progress is not None:
            progress(PoseProgress(stage=stage, done=done, total=total))

    return tell
