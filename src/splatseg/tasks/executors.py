"""Where independent items of a task are worked on: in this process, or by workers of Ray.

What a worker is sent is pickled by Ray's own means, from process to process and never from a file.
Tensors and arrays travel beside the pickle and lie in the store of each machine once, where workers
read them without a copy.
"""

import os
import shutil
import signal
import socket
import tempfile
import threading
import time
import warnings
from collections import deque
from collections.abc import Callable, Generator, Iterable, Mapping
from contextlib import ExitStack, contextmanager
from functools import partial
from io import BytesIO
from typing import Annotated, Any, TypeVar

import numpy as np
import torch
from msgspec import Meta
from numpy.typing import NDArray
from torch import Tensor

from splatseg.core import LOCAL, Executor
from splatseg.core.checkpoints import interrupt_requested
from splatseg.core.options import Count, NonNegative, options
from splatseg.errors import BackendError, InputError, import_package, reason
from splatseg.render.cpu import set_threads
from splatseg.tasks.work import SILENT, Observer

S = TypeVar("S")
T = TypeVar("T")
R = TypeVar("R")

_RAY = "ray"
_SCHEME = f"{_RAY}://"

_RETRIES = 3
"""How often an item is tried again whose worker died."""

_AHEAD = 2
"""Items for each worker that are begun or done and not yet asked for."""

_SECONDS = 5.0
"""In which a cluster must answer."""

_INTERRUPTED = 0.5
"""Seconds after which who waits for a worker looks whether it was asked to stop."""

_CANCELS, _CANCELLED = 5, 1.0
"""How often what goes on is cancelled, and the seconds that it has each time to end."""

_SETTINGS = bytes((0, 0, 0, 4, 0, 0, 0, 0, 0))
"""The frame by which either side of HTTP/2 begins: of length 0 and type 4."""

_HELLO = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + _SETTINGS

_GIGABYTE = 1 << 30

_OWN_CLUSTER = {
    "RAY_AUTH_MODE": "disabled",
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_worker_niceness": "0",
}
"""Of a cluster on this machine, which ends with the command: nothing is written at home, nobody is
told. Ray's workers give way to all other processes: where the machine has others they hardly run,
and took minutes to import this."""


@options
class ExecutorOptions:
    """Where independent items, such as views, are worked on. The result does not depend on it."""

    executor: str = "local"
    """local: in this process. ray: by worker processes on this machine. ray://HOST:PORT: by those
    of a running Ray cluster, of which this machine is a node and which reads the scene and its
    capture under the same paths. Needs splatseg[ray]."""

    workers: Count | None = None
    """With ray: items worked on at a time. None: as many as there are CPUs and GPUs for."""

    task_cpus: Count = 1
    """With ray: CPUs of a worker, which are the threads of its kernels."""

    task_gpus: NonNegative = 0.0
    """With ray: GPUs of a worker; 0.5 lets two share one."""

    task_memory: Annotated[float, Meta(gt=0)] | None = None
    """With ray: memory that a worker reserves, GB. None reserves none."""

    def __post_init__(self) -> None:
        if self.executor not in ("local", _RAY) and not self.address:
            raise InputError(
                f"executor: expected local, ray or ray://HOST:PORT, got {self.executor!r:.80}."
            )
        given = (self.workers, self.task_cpus, self.task_gpus, self.task_memory)
        if self.executor == "local" and given != (None, 1, 0.0, None):
            raise InputError(
                "workers, task_cpus, task_gpus, task_memory: go with executor ray, got local."
            )

    @property
    def address(self) -> tuple[str, int] | None:
        """Host and port of the cluster; None where there is none."""
        host, colon, port = self.executor.removeprefix(_SCHEME).rpartition(":")
        known = self.executor.startswith(_SCHEME) and host and colon and port.isdecimal()
        return (host, int(port)) if known and int(port) < 1 << 16 else None


@contextmanager
def open_executor(
    options: ExecutorOptions | None = None, *, observer: Observer = SILENT
) -> Generator[Executor]:
    """What tasks take as their executor; workers end with the block.

    Ray is started, or its cluster joined, when the first work comes; where the process has joined
    one already, that one is used.

    Args:
        options: Which, and how many workers.
        observer: Is told at the end what went to the workers and came from them.

    Raises:
        MissingPackageError: If Ray is asked for and not installed.
        InputError: If no cluster answers at the address within seconds.

    Example:
        >>> with open_executor(ExecutorOptions()) as executor:
        ...     list(executor.map(lambda shared, item: [shared + item], [1, 2], shared=10))
        [11, 12]
    """
    options = options or ExecutorOptions()
    if options.executor == "local":
        yield LOCAL
        return
    ray = import_package("ray", f"executor {options.executor}", "ray")
    if options.address is not None:
        _check_answers(options.address)
    with RayExecutor(ray, options) as executor:
        yield executor
        if executor.items:
            observer.info(executor.summary)
        else:
            observer.note("executor: none of this work went to workers; it is done in one process")


def _check_answers(address: tuple[str, int]) -> None:
    """Refuse an address where nothing speaks HTTP/2, for which Ray itself waits for minutes."""
    try:
        with socket.create_connection(address, timeout=_SECONDS) as connection:
            if os.environ.get("RAY_USE_TLS", "0") != "0":
                return
            connection.sendall(_HELLO)
            if connection.recv(4)[3:] == _SETTINGS[3:4]:
                return
            why = "it speaks something else"
    except OSError as error:
        why = reason(error)
    raise InputError(
        f"executor: expected a Ray cluster at {address[0]}:{address[1]}, but none answers there "
        f"({why}); `ray start --head` on a machine begins one."
    )


class RayExecutor:
    """Items as tasks of Ray, a context that ends what it has started.

    Args:
        ray: The package.
        options: How many workers, and what each has.
    """

    def __init__(self, ray: Any, options: ExecutorOptions) -> None:
        self._ray, self._options = ray, options
        self._stack = ExitStack()
        self._task: Any = None
        self._begun = 0.0
        self._workers = self._most_unfinished = 0
        self.items = 0
        """Items whose results have come."""

        self.cpu_seconds = 0.0
        """CPU time of the workers on them."""

        self.bytes_put = 0
        """Of shared values, put into the store."""

        self.bytes_back = 0
        """Of results."""

    def __enter__(self) -> "RayExecutor":
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    @property
    def summary(self) -> str:
        """What was done, in a line."""
        seconds = time.monotonic() - self._begun
        return (
            f"ray: {self.items} items by {self._workers} workers in {seconds:.1f} s, "
            f"{self.cpu_seconds:.1f} s of their CPU; {self.bytes_put / 1e6:.1f} MB put, "
            f"{self.bytes_back / 1e6:.1f} MB came back"
        )

    def map(
        self, function: Callable[[S, T], Iterable[R]], items: Iterable[T], *, shared: S
    ) -> Generator[R]:
        """See `Executor.map`; an item whose worker died is tried again.

        Raises:
            BackendError: If the workers of an item died again and again.
        """
        self._task = run = self._task or self._started()
        packed = _packed(shared)
        self.bytes_put += _size(packed)
        # In a list, or it would be fetched anew for each item.
        put = [self._ray.put(packed)]
        del packed
        pending: deque[Any] = deque()
        left = iter(items)
        more = True
        try:
            while more or pending:
                unfinished = self._unfinished(pending)
                room = len(pending) < _AHEAD * self._workers
                if more and room and len(unfinished) < self._most_unfinished:
                    try:
                        item = next(left)
                    except StopIteration:
                        more = False
                        continue
                    pending.append(run.remote(function, put, item, self._options.task_cpus))
                elif more and room and pending[0] in unfinished:
                    self._ray.wait(unfinished, num_returns=1)
                else:
                    # While it is fetched it counts as pending, so that it is cancelled too.
                    results = self._results(pending[0])
                    pending.popleft()
                    yield from results
        finally:
            self._end(pending)

    def _end(self, tasks: Iterable[Any]) -> None:
        """Cancel what runs, and what waits for a worker."""
        left = list(tasks)
        for _ in range(_CANCELS):
            if not left:
                return
            for task in left:
                self._ray.cancel(task)
            # What Ray interrupts can miss it: an exception in a destructor, say, is dropped.
            left = self._ray.wait(left, num_returns=len(left), timeout=_CANCELLED)[1]

    def _unfinished(self, pending: Iterable[Any]) -> list[Any]:
        tasks = list(pending)
        return self._ray.wait(tasks, num_returns=len(tasks), timeout=0)[1] if tasks else []

    def _results(self, task: Any) -> list[Any]:
        """What an item yielded."""
        exceptions = self._ray.exceptions
        while not self._ray.wait([task], timeout=_INTERRUPTED)[0]:
            if interrupt_requested():
                raise KeyboardInterrupt
        try:
            parts = self._ray.get(task)
        except exceptions.RayTaskError as error:
            # Of the function, as it would come here; the worker's traceback is its cause.
            raise error.cause from error
        except exceptions.RayError as error:
            raise BackendError(
                f"executor: an item was given up, as its workers died {_RETRIES + 1} times "
                f"({reason(error)})."
            ) from error
        self.bytes_back += _size(parts)
        self.items += 1
        # Copies, which may be written to; the store is free of them.
        results, seconds = _unpacked([bytearray(part) for part in parts])
        self.cpu_seconds += seconds
        return results

    def _started(self) -> Any:
        """What calls a function in a worker: the cluster is joined, and has room for workers."""
        self._begun = time.monotonic()
        ray, options = self._ray, self._options
        joined = ray.is_initialized()
        if not joined:
            with _handlers_kept():
                self._join()
        resources = {
            "CPU": float(options.task_cpus),
            "GPU": options.task_gpus,
            "memory": (options.task_memory or 0.0) * _GIGABYTE,
        }
        nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
        fitting = sum(_fitting(node, resources) for node in nodes)
        if not fitting:
            raise InputError(
                "task_cpus, task_gpus, task_memory: expected what one machine has "
                f"({'; '.join(map(_in_words, nodes))}), got {_in_words(resources)}."
            )
        self._workers = options.workers or fitting
        own = not joined and options.address is None
        # A cluster of our own has no more CPUs; it may have the next items waiting.
        self._most_unfinished = self._workers * (_AHEAD if own else 1)
        return ray.remote(_run).options(
            num_cpus=options.task_cpus,
            num_gpus=options.task_gpus,
            memory=resources["memory"] or None,
            max_retries=_RETRIES,
        )

    def _join(self) -> None:
        ray, options = self._ray, self._options
        _print_on_stderr(ray)
        told = {"log_to_driver": False, "logging_level": "ERROR"}
        if options.address is None:
            cores = os.cpu_count() or 1
            workers = options.workers or max(1, cores // options.task_cpus)
            # Short: names of sockets below it have at most 107 bytes.
            folder = tempfile.mkdtemp(prefix="splatseg-ray-")
            self._stack.callback(shutil.rmtree, folder, ignore_errors=True)
            self._stack.callback(ray.shutdown)
            with _environment(_OWN_CLUSTER):
                ray.init(
                    "local",
                    num_cpus=workers * options.task_cpus,
                    include_dashboard=False,
                    _temp_dir=folder,
                    **told,
                )
            return
        host, port = options.address
        self._stack.callback(ray.shutdown)
        try:
            ray.init(f"{host}:{port}", **told)
        except (ConnectionError, RuntimeError, ValueError) as error:
            raise InputError(
                f"executor: {host}:{port} is no Ray cluster of which this machine is a node "
                f"({reason(error)}); `ray start --address {host}:{port}` makes it one."
            ) from error


def _fitting(node: Mapping[str, float], resources: Mapping[str, float]) -> int:
    """How many workers a machine has room for."""
    return min(int(node.get(name, 0.0) / needed) for name, needed in resources.items() if needed)


def _in_words(resources: Mapping[str, float]) -> str:
    cpus, gpus, memory = (resources.get(name, 0.0) for name in ("CPU", "GPU", "memory"))
    return f"{cpus:g} CPUs, {gpus:g} GPUs, {memory / _GIGABYTE:.1f} GB"


def _print_on_stderr(ray: Any) -> None:
    """Have what Ray tells of its processes on stderr: on stdout are results, which programs read.

    Such as that a worker died. Ray has no switch for it.
    """
    module = ray._private.worker
    printed = getattr(module, "print_to_stdstream", None)
    if printed is not None and not isinstance(printed, partial):
        module.print_to_stdstream = partial(_printed_as_error, printed)


def _printed_as_error(
    printed: Callable[..., None], data: Mapping[str, Any], *args: Any, **kwargs: Any
) -> None:
    printed({**data, "is_err": True}, *args, **kwargs)


@contextmanager
def _environment(values: Mapping[str, str]) -> Generator[None]:
    """Variables that processes started in the block inherit, where they are not set otherwise."""
    added = [name for name in values if name not in os.environ]
    os.environ.update({name: values[name] for name in added})
    try:
        yield
    finally:
        for name in added:
            del os.environ[name]


@contextmanager
def _handlers_kept() -> Generator[None]:
    """Who answers SIGTERM is as before the block: Ray would end the process at once."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.getsignal(signal.SIGTERM)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


# In a worker.


_held: dict[str, Any] = {}
"""The shared value of the last items, by its name in the store."""


def _run(
    function: Callable[[Any, Any], Iterable[Any]], put: list[Any], item: Any, cpus: int
) -> list[Any]:
    """What a function yields of an item, and the CPU time it took, packed."""
    began = time.process_time()
    _hear_interrupts()
    torch.set_num_threads(1)
    set_threads(cpus)
    name = put[0].hex()
    if name not in _held:
        _held.clear()
        _held[name] = _unpacked(import_package("ray", "executor", "ray").get(put[0]))
    results = list(function(_held[name], item))
    return _packed((results, time.process_time() - began))


def _hear_interrupts() -> None:
    """Let Ray cancel what runs.

    What a shell starts in the background ignores SIGINT, and so do all processes that come of it.
    """
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


# Values on their way.


def _packed(value: Any) -> list[Any]:
    """A pickle, and arrays that it refers to, which are not copied."""
    cloudpickle: Any = import_package("ray.cloudpickle", "executor", "ray")

    class Pickler(cloudpickle.CloudPickler):
        def reducer_override(self, obj: Any) -> Any:
            # Torch's own way would copy it into the pickle.
            if type(obj) is Tensor and obj.layout == torch.strided and not obj.requires_grad:
                flat = obj.cpu().contiguous().reshape(-1).view(torch.uint8).numpy()
                return _tensor, (flat, obj.dtype, tuple(obj.shape), str(obj.device))
            return super().reducer_override(obj)

    arrays: list[Any] = []
    file = BytesIO()
    Pickler(file, protocol=5, buffer_callback=arrays.append).dump(value)
    return [
        np.frombuffer(file.getbuffer(), np.uint8),
        *(np.asarray(array.raw()) for array in arrays),
    ]


def _unpacked(parts: list[Any]) -> Any:
    cloudpickle: Any = import_package("ray.cloudpickle", "executor", "ray")
    return cloudpickle.loads(parts[0], buffers=parts[1:])


def _tensor(
    flat: NDArray[np.uint8], dtype: torch.dtype, shape: tuple[int, ...], device: str
) -> Tensor:
    with warnings.catch_warnings():
        # What is shared lies in the store and may not be written to; nobody does.
        warnings.filterwarnings("ignore", message="The given NumPy array is not writable")
        found = torch.from_numpy(flat)
    return found.view(dtype).reshape(shape).to(device)


def _size(parts: list[Any]) -> int:
    return sum(part.nbytes for part in parts)
