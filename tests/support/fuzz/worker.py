"""The process that damages and reads: one format, a range of cases, under limits.

It writes a line of JSON for each fault and one at its end into a file, and the number of the case
that it is at into another, so that the process above knows which one never ended.
"""

import json
import os
import resource
import signal
import time
import traceback
import warnings
import zlib
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from random import Random
from types import FrameType
from typing import IO, Any

import torch

from splatseg.errors import InputError
from support.fuzz.mutations import mutate
from support.fuzz.targets import Target

LONGEST = 400
"""Characters of a message beside the file's path."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Sound:
    """A format's file before it is damaged."""

    folder: Path
    """Where it and what it needs is."""

    target: Target
    content: bytes


class TooSlowError(BaseException):
    """A case that takes longer than it may."""


def case(name: str, seed: int, index: int, sound: bytes) -> tuple[str, bytes]:
    """Family and bytes of a case; the same for the same numbers."""
    random = Random((seed << 64) + (zlib.crc32(name.encode()) << 32) + index)
    return mutate(random, sound)


def fault_of(target: Target, folder: Path) -> str | None:
    """What is wrong with how a damaged file is read; None where all is as documented."""
    try:
        target.read()
    except InputError as error:
        message = str(error)
        if str(folder) not in message:
            return f"names no file: {type(error).__name__}: {message[:200]}"
        if len(message.replace(str(folder), "")) > LONGEST:
            return f"{len(message)} characters long: {message[:200]}"
        if not message.isprintable():
            return f"cannot be printed: {message[:200]!r}"
        return None
    except TooSlowError:
        return "hang"
    except Exception as error:  # noqa: BLE001  (this is what is looked for)
        place = traceback.extract_tb(error.__traceback__)
        ours = [frame for frame in place if "splatseg" in frame.filename] or list(place)
        where = f"{Path(ours[-1].filename).name}:{ours[-1].lineno}"
        return f"{type(error).__name__} at {where}: {str(error)[:120]}"
    return None


def work(job: dict[str, Any], sound: Sound) -> None:
    """Read cases: `job` has the format's name, seed, begin, end, limits and two files.

    Its process ends with it: the limits of memory are never taken back.
    """
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    os.dup2(2, 1)  # decoders print to the standard output, where the counts are JSON
    with Path(job["said"]).open("w") as said:
        before = _peak()
        size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (size + (job["memory"] << 20),) * 2)
        signal.signal(signal.SIGPROF, _too_slow)
        families = _cases(job, sound, said)
        _say(said, {"tries": families, "peak": max(0, _peak() - before)})


def _cases(job: dict[str, Any], sound: Sound, said: IO[str]) -> dict[str, int]:
    families: Counter[str] = Counter()
    with Path(job["progress"]).open("wb", buffering=0) as progress:
        for index in range(job["begin"], job["end"]):
            progress.seek(0)
            progress.write(f"{index:12d}".encode())
            family, damaged = case(job["name"], job["seed"], index, sound.content)
            families[family] += 1
            sound.target.file.write_bytes(damaged)
            began = time.process_time()
            signal.setitimer(signal.ITIMER_PROF, job["seconds"])
            try:
                fault = fault_of(sound.target, sound.folder)
            except TooSlowError:  # between the end of reading and that of the clock
                fault = "hang"
            signal.setitimer(signal.ITIMER_PROF, 0)
            if fault is None and time.process_time() - began > job["seconds"]:
                fault = "hang"
            if fault is not None:
                _say(said, {"case": index, "family": family, "fault": fault})
    return dict(families)


def _too_slow(number: int, frame: FrameType | None) -> None:
    raise TooSlowError


def _peak() -> int:
    """Most memory that the process ever held, in MiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024


def _say(said: IO[str], line: dict[str, Any]) -> None:
    said.write(json.dumps(line) + "\n")
    said.flush()
