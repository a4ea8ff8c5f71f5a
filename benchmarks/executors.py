"""What an executor of workers costs and gives: layers of a scene by one process and by Ray.

    benchmarks/executors.py SCENE --workers 2 [--task-cpus 1] [--views N] [--kill] [--json FILE]

For `uplift` (hard and soft), `features` and `associate`, with the first evidence of the scene that
each takes: wall time, CPU time of this process and of the workers, bytes through the store, and
whether the layers are equal byte for byte. --kill ends one worker by SIGKILL in the middle of each.
The time that Ray takes to start is told apart.
"""

import argparse
import json
import os
import platform
import resource
import signal
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from splatseg.core import LOCAL
from splatseg.io.layers import save_layer
from splatseg.io.scene import load_scene
from splatseg.lift.segments import EvidenceSegments
from splatseg.lift.voting.features import uplift_features
from splatseg.lift.voting.uplift import UpliftOptions, uplift
from splatseg.methods.associate import associate
from splatseg.tasks import ExecutorOptions, open_executor
from splatseg.tasks.work import Work

Make = Callable[..., Any]


def works(work: Work, longest_views: int | None) -> Iterator[tuple[str, Make]]:
    """What is measured, by name."""
    for title, kinds, make in (
        ("uplift", ("labels", "tracked"), uplift),
        ("uplift soft", ("labels", "tracked"), _soft),
        ("features", ("features",), uplift_features),
        ("associate", ("masks", "panoptic"), _associate),
    ):
        name = next((name for kind in kinds for name in work.evidence_of(kind)), None)
        if name is None:
            continue
        evidence = work.evidence(name)
        known = set(evidence.view_names)
        views = [view for view in work.scene.train_views if view.name in known][:longest_views]

        def made(make=make, views=views, evidence=evidence, **given) -> Any:
            return make(work.gaussians, views, evidence, **given)

        yield f"{title} of {name}, {len(views)} views", made


def _soft(*args, **given) -> Any:
    return uplift(*args, options=UpliftOptions(candidates=8), **given)


def _associate(gaussians, views, evidence, **given) -> Any:
    return associate(gaussians, views, EvidenceSegments(evidence=evidence), **given)


def layer_bytes(layer: Any) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "layer.npz"
        save_layer(layer, path)
        return path.read_bytes()


def measured(make: Make, **given) -> tuple[Any, float, float]:
    """The layer, wall seconds, and CPU seconds of this process."""
    wall, cpu = time.monotonic(), time.process_time()
    layer = make(**given)
    return layer, time.monotonic() - wall, time.process_time() - cpu


class Killer:
    """Kills a worker of Ray that works, once, after some results have come."""

    def __init__(self, after: int) -> None:
        self._after, self.killed = after, 0
        self._lock = threading.Lock()

    def __call__(self, done: int, _total: int) -> None:
        with self._lock:
            if self.killed or done < self._after:
                return
            listed = subprocess.run(
                ["ps", "-eo", "pid,ppid,args"], capture_output=True, text=True, check=True
            ).stdout
            rows = [line.split(None, 2) for line in listed.splitlines()[1:]]
            parents = {int(pid): int(parent) for pid, parent, _ in rows}
            working = [
                int(pid)
                for pid, _, words in rows
                if words.startswith("ray::_run") and _is_ours(int(pid), parents)
            ]
            if working:
                os.kill(working[0], signal.SIGKILL)
                self.killed = working[0]


def _is_ours(pid: int, parents: dict[int, int]) -> bool:
    while pid in parents and pid != os.getpid():
        pid = parents[pid]
    return pid == os.getpid()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path)
    parser.add_argument("--data", type=Path)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--task-cpus", type=int, default=1)
    parser.add_argument("--views", type=int, help="first so many views of each evidence")
    parser.add_argument("--kill", action="store_true")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    work = Work(scene=load_scene(arguments.scene, data=arguments.data))
    print(f"{platform.node()}, {os.cpu_count()} CPUs, {len(work.gaussians)} Gaussians")
    rows: list[dict[str, Any]] = []
    options = ExecutorOptions(
        executor="ray", workers=arguments.workers, task_cpus=arguments.task_cpus
    )
    began = time.monotonic()
    with open_executor(options) as executor:
        list(executor.map(_started, range(arguments.workers), shared=0))
        start = time.monotonic() - began
        print(f"ray started, workers imported: {start:.1f} s")
        for title, make in works(work, arguments.views):
            one, wall, cpu = measured(make, executor=LOCAL)
            before = (executor.cpu_seconds, executor.bytes_put, executor.bytes_back)
            killer = Killer(after=2)
            given = {"progress": killer} if arguments.kill else {}
            other, ray_wall, driver = measured(make, executor=executor, **given)
            after = (executor.cpu_seconds, executor.bytes_put, executor.bytes_back)
            used, put, back = (b - a for a, b in zip(before, after, strict=True))
            row = {
                "work": title,
                "local_seconds": round(wall, 2),
                "local_cpu_seconds": round(cpu, 2),
                "ray_seconds": round(ray_wall, 2),
                "driver_cpu_seconds": round(driver, 2),
                "workers_cpu_seconds": round(used, 2),
                "megabytes_put": round(put / 1e6, 1),
                "megabytes_back": round(back / 1e6, 1),
                "worker_killed": killer.killed > 0,
                "equal": layer_bytes(one) == layer_bytes(other),
            }
            rows.append(row)
            print(", ".join(f"{key} {value}" for key, value in row.items()), flush=True)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"peak memory of this process {peak:.0f} MB")
    if arguments.json:
        content = {"workers": arguments.workers, "start_seconds": round(start, 1), "rows": rows}
        arguments.json.write_text(json.dumps(content, indent=2) + "\n")


def _started(shared: int, item: int) -> Iterator[int]:
    yield shared + item


if __name__ == "__main__":
    main()
