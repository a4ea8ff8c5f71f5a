"""Starts the workers, restarts them past what killed them, and counts."""

import gc
import json
import os
import signal
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch

from support.fuzz.targets import TARGETS
from support.fuzz.worker import Sound, work

_START = 30
"""Seconds that a process may take to start."""

_GRACE = 30
"""Times the seconds of a case, by the clock, until a process is killed that waits for something or
that its own alarm does not reach."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Limits:
    """What reading one file may take."""

    memory: int = 1536
    """MiB beyond what the process holds before."""

    seconds: float = 10.0
    """Of the processor: what else a machine does is no fault of a reader."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Fault:
    """A damaged file that was not read as documented."""

    format: str
    case: int
    family: str
    fault: str


@dataclass(slots=True, kw_only=True)
class Outcome:
    """What came of the cases of one format."""

    format: str
    tries: Counter[str] = field(default_factory=Counter[str])
    """By family."""

    faults: list[Fault] = field(default_factory=list[Fault])
    peak: int = 0
    """MiB, the most that a worker took beyond its start."""

    def counted(self) -> dict[str, Any]:
        """The numbers of its row in the table."""
        hangs = sum(fault.fault == "hang" for fault in self.faults)
        return {
            "format": self.format,
            "tries": sum(self.tries.values()),
            "undocumented": len(self.faults) - hangs,
            "hangs": hangs,
            "peak_mib": self.peak,
        }


def fuzz(
    formats: Sequence[str],
    *,
    tries: int,
    seed: int,
    limits: Limits = Limits(),
    jobs: int = 1,
    first: int = 0,
    report: Callable[[Outcome], None] = lambda outcome: None,
) -> list[Outcome]:
    """Damage and read files of each format, each in a process of its own that is forked from here.

    Args:
        formats: Names of `targets.TARGETS`.
        tries: Cases a format.
        seed: Another one gives other cases.
        limits: Memory and time of a case.
        jobs: Processes at once.
        first: Number of the first case.
        report: Told each format's outcome.
    """
    waiting, done = list(formats), list[Outcome]()
    active: list[_Run] = []
    with tempfile.TemporaryDirectory(prefix="fuzz-") as holder:
        sound = _read_once(formats, Path(holder))
        while waiting or active:
            while waiting and len(active) < jobs:
                name, cases = waiting.pop(0), range(first, first + tries)
                active.append(_Run(name, sound[name], cases, seed, limits, Path(holder)))
            time.sleep(0.02)
            for run in [run for run in active if run.poll()]:
                active.remove(run)
                done.append(run.outcome)
                report(run.outcome)
    return sorted(done, key=lambda outcome: formats.index(outcome.format))


def _read_once(formats: Sequence[str], holder: Path) -> dict[str, Sound]:
    """Each sound file, read once before forking: what that imports is imported once, not once a
    process, which took most of the time of a short run."""
    torch.set_num_threads(1)  # a pool of threads would not survive the fork
    found: dict[str, Sound] = {}
    for number, name in enumerate(formats):
        folder = holder / f"files-{number}"
        folder.mkdir()
        target = TARGETS[name](folder)
        found[name] = Sound(folder=folder, target=target, content=target.file.read_bytes())
        target.read()
    gc.collect()
    gc.freeze()  # else each process copies what its collector looks at
    return found


class _Run:
    """The processes of one format, one after another: each begins past what ended the last."""

    def __init__(
        self, name: str, sound: Sound, cases: range, seed: int, limits: Limits, holder: Path
    ) -> None:
        self.outcome = Outcome(format=name)
        self._sound = sound
        self._said = holder / f"{name}.said"
        self._progress = holder / f"{name}.progress"
        self._job: dict[str, Any] = {"name": name, "seed": seed, **asdict(limits)}
        self._job |= {"begin": cases.start, "end": cases.stop}
        self._job |= {"said": str(self._said), "progress": str(self._progress)}
        self._start()

    def poll(self) -> bool:
        """Look after the process; whether the format is done."""
        ended, status = os.waitpid(self._pid, os.WNOHANG)
        if not ended:
            now = self._progress.read_bytes()
            if now != self._seen:
                self._seen, self._since = now, time.monotonic()
            elif time.monotonic() - self._since > _GRACE * self._job["seconds"] + _START:
                os.kill(self._pid, signal.SIGKILL)  # not even its alarm was heard
            return False
        if self._take_lines():
            return True
        hung = os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGKILL
        why = "hang" if hung else f"the process ended with status {status}"
        at = int(self._progress.read_bytes() or self._job["begin"])
        fault = Fault(format=self.outcome.format, case=at, family="?", fault=why)
        self.outcome.faults.append(fault)
        self.outcome.tries["?"] += at + 1 - self._job["begin"]
        self._job["begin"] = at + 1
        if at + 1 >= self._job["end"]:
            return True
        self._start()
        return False

    def _start(self) -> None:
        self._progress.write_bytes(b"")
        self._seen, self._since = b"", time.monotonic()
        self._pid = os.fork()
        if self._pid == 0:
            status = 1
            try:
                work(self._job, self._sound)
                status = 0
            except BaseException:
                traceback.print_exc()
                raise
            finally:
                os._exit(status)

    def _take_lines(self) -> bool:
        """Add what the process said; whether it came to its end."""
        for text in self._said.read_text().splitlines():
            line = json.loads(text)
            if "fault" not in line:
                self.outcome.tries.update(line["tries"])
                self.outcome.peak = max(self.outcome.peak, line["peak"])
                return True
            self.outcome.faults.append(Fault(format=self.outcome.format, **line))
        return False
