"""Processes of splatseg, forked from one that has imported it: the import takes two seconds each.

For tests that kill, stop or watch a real process, and are not about how one starts. Its environment
is that of pytest when the first was started.
"""

import atexit
import functools
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from types import TracebackType
from typing import Any

_SERVER = """
import atexit, gc, importlib, json, os, signal, socket, sys, traceback

asked = socket.socket(fileno=int(sys.argv[1]))
for name in (
    "splatseg.cli.fit", "splatseg.cli.view", "splatseg.tasks", "splatseg.fit", "splatseg.viewer",
    "splatseg.io.scene", "splatseg.render", "uvicorn", "starlette.routing", "websockets.server",
):
    importlib.import_module(name)
from splatseg.cli import main
gc.collect()
gc.freeze()  # else each process copies what its collector looks at

def answer(**fields):
    asked.sendall(json.dumps(fields).encode() + b"\\n")

def run(words, out, err):
    asked.close()
    null = os.open(os.devnull, os.O_RDONLY)
    for ours, theirs in ((null, 0), (out, 1), (err, 2)):
        os.dup2(ours, theirs)
        os.close(ours)
    sys.stdin, sys.stdout = open(0, closefd=False), open(1, "w", closefd=False)
    sys.stderr = open(2, "w", buffering=1, errors="backslashreplace", closefd=False)
    sys.argv = ["splatseg", *words]
    # What a shell starts in the background ignores Ctrl-C, and tests may run there.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    status = 1
    try:
        status = main()
        sys.stdout.flush()
        atexit._run_exitfuncs()
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stderr.flush()
        os._exit(status)

while True:
    message, given, _, _ = socket.recv_fds(asked, 1 << 16, 2)
    if not message:
        break
    job = json.loads(message)
    if "words" in job:
        pid = os.fork()
        if pid == 0:
            run(job["words"], *given)
        for one in given:
            os.close(one)
        answer(pid=pid)
    else:
        ended, status = os.waitpid(job["pid"], os.WNOHANG)
        answer(status=os.waitstatus_to_exitcode(status) if ended else None)
"""


class _Server:
    """The process that has imported everything."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._socket, theirs = socket.socketpair()
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-c", _SERVER, str(theirs.fileno())],
                pass_fds=[theirs.fileno()], stdin=subprocess.DEVNULL,
                env=os.environ | {"OMP_NUM_THREADS": "1", "SPLATSEG_THREADS": "1"},
            )  # fmt: skip
        self._answers = self._socket.makefile("r")

    def ask(self, fds: tuple[int, ...] = (), **fields: Any) -> dict[str, Any]:
        with self._lock:
            socket.send_fds(self._socket, [json.dumps(fields).encode()], fds)
            return json.loads(self._answers.readline())

    def close(self) -> None:
        self._answers.close()
        self._socket.close()
        self._process.wait()


@functools.cache
def _server() -> _Server:
    """One a process of pytest, which ends with it."""
    server = _Server()
    atexit.register(server.close)
    return server


class Forked:
    """``splatseg WORDS`` in a process of its own; as much of `subprocess.Popen` as tests need."""

    def __init__(self, *words: object, log: Path | None = None) -> None:
        """Start it; what it writes on the standard error stream is put at the end of `log`."""
        self._errors = tempfile.TemporaryFile("w+") if log is None else log.open("a+")  # noqa: SIM115
        reading, writing = os.pipe()
        self.stdout = open(reading)  # noqa: SIM115, PTH123
        self.returncode: int | None = None
        try:
            fds = (writing, self._errors.fileno())
            self.pid: int = _server().ask(fds, words=[str(word) for word in words])["pid"]
        finally:
            os.close(writing)

    def __enter__(self) -> "Forked":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:  # fmt: skip
        self.wait()
        self.close()

    def close(self) -> None:
        """What it was read by, once it has ended."""
        self.stdout.close()
        self._errors.close()

    def poll(self) -> int | None:
        if self.returncode is None:
            self.returncode = _server().ask(pid=self.pid)["status"]
        return self.returncode

    def wait(self, timeout: float = 300) -> int:
        end = time.monotonic() + timeout
        while (status := self.poll()) is None:
            if time.monotonic() > end:
                raise subprocess.TimeoutExpired(f"process {self.pid}", timeout)
            time.sleep(0.005)
        return status

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            os.kill(self.pid, number)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)

    def communicate(self, timeout: float = 300) -> tuple[str, str]:
        """All that it writes until it ends; it is killed when it takes longer."""
        killer = threading.Timer(timeout, self.kill)
        killer.start()
        try:
            out = self.stdout.read()
        finally:
            killer.cancel()
        self.wait(timeout)
        return out, self.errors()

    def errors(self) -> str:
        """What it wrote on the standard error stream so far."""
        self._errors.seek(0)
        return self._errors.read()
