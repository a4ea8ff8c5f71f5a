"""Executors: one contract, held by all; what Ray's workers make has the bits of one process."""

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch

from splatseg.cli import main
from splatseg.core import LOCAL, Executor
from splatseg.core.executor import ThreadExecutor
from splatseg.errors import (
    BackendError,
    InputError,
    MissingFileError,
    MissingPackageError,
    RangeError,
)
from splatseg.io.layers import save_layer
from splatseg.io.scene import load_scene
from splatseg.lift.segments import EvidenceSegments
from splatseg.lift.voting.features import uplift_features
from splatseg.lift.voting.uplift import UpliftOptions, uplift
from splatseg.methods.associate import associate
from splatseg.tasks import (
    ExecutorOptions,
    Observer,
    RenderingOptions,
    SeeOptions,
    SegmentOptions,
    executors,
    open_executor,
    render_views,
    see,
    segment,
)
from splatseg.tasks.executors import _hear_interrupts, _packed, _unpacked
from splatseg.tasks.work import Work
from support import executed

WORKERS = 2


class Heard(Observer):
    def __init__(self) -> None:
        self.lines: list[str] = []

    def info(self, message: str) -> None:
        self.lines.append(message)

    def note(self, message: str) -> None:
        self.lines.append(message)


@pytest.fixture(scope="module")
def ray() -> Iterator[ModuleType]:
    """A cluster of two workers on this machine, begun once for this file."""
    package = pytest.importorskip("ray", reason="the extra ray is not installed")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(Path(executed.__file__).parents[1]))
        with open_executor(ExecutorOptions(executor="ray", workers=WORKERS)) as executor:
            assert list(executor.map(executed.twice, [5], shared=1)) == [6, 5]
            yield package
    assert not package.is_initialized(), "what was begun ends with the block"


@pytest.fixture
def workers(ray: ModuleType) -> Iterator[Executor]:
    with open_executor(ExecutorOptions(executor="ray", workers=WORKERS)) as executor:
        yield executor


@pytest.fixture(params=["local", "threads", "ray"])
def executor(request: pytest.FixtureRequest) -> Executor:
    if request.param == "ray":
        return request.getfixturevalue("workers")
    return LOCAL if request.param == "local" else ThreadExecutor(WORKERS)


@pytest.fixture(scope="module")
def room(fitted_room: Path) -> Work:
    return Work(scene=load_scene(fitted_room))


# The contract.


def test_results_come_in_the_order_of_the_items(executor) -> None:
    found = list(executor.map(executed.twice, range(6), shared=10))
    assert found == [one for i in range(6) for one in (10 + i, 10 * i)]
    assert list(executor.map(executed.twice, [], shared=1)) == []


def test_nothing_is_begun_before_it_is_asked_for(executor, tmp_path) -> None:
    taken: list[int] = []

    def items() -> Iterator[int]:
        for i in range(50):
            taken.append(i)
            yield i

    found = executor.map(executed.noted, items(), shared=tmp_path)
    assert not taken
    assert not list(tmp_path.iterdir())
    if not isinstance(executor, ThreadExecutor):  # takes all items at once
        with closing(found):
            assert next(found) == 0
            time.sleep(0.2)
            assert len(taken) <= 2 * WORKERS


def test_an_exception_comes_as_it_is_after_earlier_results(executor) -> None:
    found = executor.map(executed.failing, range(6), shared=0)
    assert [next(found), next(found)] == [0, 1]
    with pytest.raises(MissingFileError) as caught:
        next(found)
    assert type(caught.value) is MissingFileError
    assert str(caught.value) == "scan_2.bin: there is no such file."
    assert list(found) == []


def test_one_that_is_closed_begins_no_further_item(executor, tmp_path) -> None:
    found = executor.map(executed.noted, range(200), shared=tmp_path)
    assert next(found) == 0
    found.close()
    time.sleep(0.5)
    begun = len(list(tmp_path.iterdir()))
    assert begun < 200
    time.sleep(0.3)
    assert len(list(tmp_path.iterdir())) == begun
    assert list(executor.map(executed.failing, [7], shared=0)) == [7], "others go on"


# Workers.


@pytest.mark.parametrize("lost", [0, 1])
def test_what_is_closed_ends_what_runs(workers, tmp_path, lost: int) -> None:
    (there := tmp_path / "there").mkdir()
    assert max(workers.map(executed.together, range(4), shared=(there, 2))) == 2, "both run"
    (folder := tmp_path / "late").mkdir()
    found = workers.map(executed.late, range(6), shared=(folder, lost))
    assert next(found) == 0
    found.close()
    (again := tmp_path / "again").mkdir()
    assert max(workers.map(executed.together, range(4), shared=(again, 2))) == 2, "both are free"
    assert [path.name for path in folder.iterdir()] == ["0"]


def test_a_worker_that_was_started_in_the_background_can_be_interrupted() -> None:
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        _hear_interrupts()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        own = signal.signal(signal.SIGINT, lambda *_: None)
        _hear_interrupts()
        signal.raise_signal(signal.SIGINT)  # another's handler stays
        assert own is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)


def test_shared_values_lie_in_a_worker_once(workers) -> None:
    """In the store, that is: all items of a worker read the same memory, and torch has a thread."""
    shared = torch.arange(1 << 20)
    found = list(workers.map(executed.looked_at, range(8), shared=shared))
    assert os.getpid() not in {one[0] for one in found}
    for process in {one[0] for one in found}:
        assert len({one[3] for one in found if one[0] == process}) == 1
    assert {one[1:3] for one in found} == {(1, 1)}
    assert shared.nbytes <= workers.bytes_put < shared.nbytes + 4096


def test_results_may_be_written_to(workers) -> None:
    for row in workers.map(executed.sums, range(3), shared=torch.zeros(3, 4)):
        row += 1
        assert row.tolist() == [2.0] * 4
    assert 0 < workers.bytes_back < 4096
    assert workers.items == 3
    assert workers.cpu_seconds > 0


@pytest.mark.parametrize(
    "value",
    [
        torch.arange(6.0).reshape(2, 3).T, torch.zeros(0, 3), torch.tensor(3),
        torch.ones(3, dtype=torch.bfloat16), torch.tensor([True, False]),
        torch.ones(2, requires_grad=True),
    ],
)  # fmt: skip
def test_tensors_arrive_as_they_were_sent(value) -> None:
    pytest.importorskip("ray.cloudpickle")
    (found,) = _unpacked([bytearray(part) for part in _packed((value,))])
    assert torch.equal(found, value)
    assert found.dtype == value.dtype
    assert found.shape == value.shape
    assert found.requires_grad == value.requires_grad


def test_arrays_are_no_part_of_the_pickle() -> None:
    pytest.importorskip("ray.cloudpickle")
    parts = _packed({"a": torch.zeros(1000), "b": np.zeros(1000)})
    assert sorted(part.nbytes for part in parts)[1:] == [4000, 8000]
    assert parts[0].nbytes < 2000


def test_a_worker_that_is_killed_is_replaced(workers, room, tmp_path, capfd) -> None:
    views, evidence = room.scene.train_views, room.evidence("labels_semantic")
    dying = executed.Dying(evidence, views[3].name, tmp_path)
    found = uplift(room.gaussians, views, dying, executor=workers)
    assert len(list(tmp_path.iterdir())) == 1, "it was killed"
    assert capfd.readouterr().out == "", "which is no result"
    assert layer_bytes(found, tmp_path) == layer_bytes(
        uplift(room.gaussians, views, evidence), tmp_path
    )


def test_an_item_that_kills_all_its_workers_is_given_up(workers, room, tmp_path) -> None:
    views, evidence = room.scene.train_views, room.evidence("labels_semantic")
    dying = executed.Dying(evidence, views[0].name, tmp_path, times=100)
    with pytest.raises(BackendError, match="given up, as its workers died 4 times") as caught:
        uplift(room.gaussians, views[:1], dying, executor=workers)
    assert "\n" not in str(caught.value)
    assert len(list(tmp_path.iterdir())) == 4


# Options.


def test_workers_are_how_many_items_are_worked_on(ray, tmp_path) -> None:
    for count in (2, 1):
        with open_executor(ExecutorOptions(executor="ray", workers=count)) as executor:
            found = list(executor.map(executed.together, range(4), shared=(tmp_path, count)))
        assert max(found) == count


@pytest.mark.parametrize("cpus", [1, 2])
def test_a_worker_has_the_cpus_it_is_given(ray, cpus) -> None:
    heard = Heard()
    options = ExecutorOptions(executor="ray", task_cpus=cpus)
    with open_executor(options, observer=heard) as executor:
        found = list(executor.map(executed.looked_at, range(2), shared=torch.zeros(1)))
    assert {one[1:3] for one in found} == {(cpus, 1)}
    (line,) = heard.lines
    assert line.startswith(f"ray: 2 items by {WORKERS // cpus} workers in ")


@pytest.mark.parametrize("wanted", [{"task_gpus": 7}, {"task_memory": 1e6}, {"task_cpus": 900}])
def test_what_no_machine_has_is_refused(ray, wanted) -> None:
    options = ExecutorOptions(executor="ray", **wanted)
    with (
        open_executor(options, observer=Heard()) as executor,
        pytest.raises(InputError, match=r"expected what one machine has \(2 CPUs, .* got "),
    ):
        list(executor.map(executed.failing, [0], shared=0))


def test_a_machine_that_has_no_room_for_the_memory_has_fewer_workers(ray) -> None:
    has = min(node["Resources"]["memory"] for node in ray.nodes()) / (1 << 30)
    heard = Heard()
    options = ExecutorOptions(executor="ray", task_memory=0.7 * has)
    with open_executor(options, observer=heard) as executor:
        assert list(executor.map(executed.failing, [0], shared=0)) == [0]
    assert heard.lines[0].startswith("ray: 1 items by 1 workers")


def test_options_that_cannot_be() -> None:
    with pytest.raises(RangeError, match="workers: expected at least 1, got 0"):
        ExecutorOptions(executor="ray", workers=0)
    for wrong in ("dask", "ray://", "ray://host", "ray://:1", "ray://host:99999"):
        with pytest.raises(InputError, match=r"expected local, ray or ray://HOST:PORT, got "):
            ExecutorOptions(executor=wrong)
    for given in ({"workers": 2}, {"task_cpus": 2}, {"task_gpus": 1}, {"task_memory": 1}):
        with pytest.raises(InputError, match="go with executor ray, got local"):
            ExecutorOptions(**given)


def test_without_the_package(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with (
        pytest.raises(MissingPackageError, match=r"pip install 'splatseg\[ray\]'"),
        open_executor(ExecutorOptions(executor="ray")),
    ):
        pass


@pytest.mark.parametrize("said", [None, b"", b"HTTP/1.1 400 Bad Request"])
def test_an_address_at_which_no_cluster_answers(said, monkeypatch) -> None:
    """Nobody listens; one that says nothing; one that says something else."""
    pytest.importorskip("ray")
    monkeypatch.setattr(executors, "_SECONDS", 0.3)
    with socket.socket() as server:
        server.bind(("127.0.0.1", 0))
        port = server.getsockname()[1]
        if said is not None:
            server.listen()
            answering = threading.Thread(target=lambda: answer(server, said))
            answering.start()
        with (
            pytest.raises(InputError, match=f"cluster at 127.0.0.1:{port}, but none answers there"),
            open_executor(ExecutorOptions(executor=f"ray://127.0.0.1:{port}")),
        ):
            pass
        if said is not None:
            answering.join()


def answer(server: socket.socket, said: bytes) -> None:
    connection, _ = server.accept()
    with connection:
        connection.sendall(said)
        time.sleep(0.5)


def test_a_cluster_that_runs_is_joined(ray, tmp_path) -> None:
    """By another process, as its driver; it goes on without it."""
    address = ray.get_runtime_context().gcs_address
    script = (
        "import os\n"
        "from splatseg.tasks import ExecutorOptions, open_executor\n"
        "from support import executed\n"
        f"options = ExecutorOptions(executor='ray://{address}')\n"
        "with open_executor(options) as executor:\n"
        "    print(list(executor.map(executed.twice, [5], shared=1)))\n"
    )
    environment = dict(os.environ) | {"RAY_AUTH_MODE": "disabled"}
    done = subprocess.run(
        [sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=True
    )
    assert done.stdout == "[6, 5]\n"
    with open_executor(ExecutorOptions(executor="ray")) as executor:
        assert list(executor.map(executed.twice, [5], shared=1)) == [6, 5]


def test_what_did_not_go_to_workers_is_said(ray) -> None:
    heard = Heard()
    with open_executor(ExecutorOptions(executor="ray"), observer=heard):
        pass
    assert heard.lines == ["executor: none of this work went to workers; it is done in one process"]


# The same bits.


def layer_bytes(layer: Any, folder: Path) -> bytes:
    path = folder / "layer.npz"
    save_layer(layer, path)
    content = path.read_bytes()
    path.unlink()
    return content


def files(folder: Path) -> dict[str, bytes]:
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


@pytest.mark.parametrize("candidates", [1, 8])
@pytest.mark.parametrize("name", ["labels_semantic", "labels_tracked"])
def test_uplift_has_the_same_bits(workers, room, tmp_path, name, candidates) -> None:
    options = UpliftOptions(candidates=candidates)
    args = (room.gaussians, room.scene.train_views, room.evidence(name))
    one, other = (uplift(*args, options=options, executor=way) for way in (LOCAL, workers))
    assert workers.items == len(room.scene.train_views)
    assert layer_bytes(one, tmp_path) == layer_bytes(other, tmp_path)


def test_features_have_the_same_bits(workers, room, tmp_path) -> None:
    args = (room.gaussians, room.scene.train_views, room.evidence("features_dino"))
    one, other = (uplift_features(*args, executor=way) for way in (LOCAL, workers))
    assert workers.items == len(room.scene.train_views)
    assert layer_bytes(one, tmp_path) == layer_bytes(other, tmp_path)


@pytest.mark.parametrize("name", ["masks_nested", "labels_panoptic", "labels_tracked"])
def test_association_has_the_same_bits(workers, room, tmp_path, name) -> None:
    """Masses of views; of masks the rows of W by which votes are sharpened, too."""
    segments = EvidenceSegments(evidence=room.evidence(name))
    args = (room.gaussians, room.scene.train_views, segments)
    one, other = (associate(*args, executor=way) for way in (LOCAL, workers))
    passes = 2 if segments.overlapping else 1
    assert workers.items == passes * len(room.scene.train_views)
    assert layer_bytes(one, tmp_path) == layer_bytes(other, tmp_path)


def test_segment_takes_it_to_the_method(workers, room, tmp_path) -> None:
    options = SegmentOptions(evidence="labels_semantic")
    one, other = (
        segment(room.scene, "uplift", options=options, executor=way).layer
        for way in (LOCAL, workers)
    )
    assert workers.items == len(room.scene.train_views)
    assert layer_bytes(one, tmp_path) == layer_bytes(other, tmp_path)


@pytest.mark.parametrize("model", ["classical", "regions"])
def test_what_is_seen_has_the_same_bytes(workers, fitted_room, tmp_path, model) -> None:
    """A view without a photograph is drawn where the model is; its render is kept, too."""
    written: list[dict[str, bytes]] = []
    for way in (LOCAL, workers):
        folder = tmp_path / f"{len(written)}"
        shutil.copytree(fitted_room, folder)
        scene = load_scene(folder)
        names = tuple(view.name for view in scene.train_views[:3])
        views = [
            replace(view, image=None) if view.name == names[1] else view for view in scene.views
        ]
        scene = replace(scene, views=tuple(views))
        seen = see(scene, model, "seen", options=SeeOptions(views=names), executor=way)
        assert (seen.views, seen.drawn) == (3, 1)
        written.append(files(seen.folder))
    assert workers.items == 3
    assert written[0] == written[1]
    assert len(written[0]) == 5


def test_what_was_seen_before_is_not_seen_again(workers, fitted_room, tmp_path) -> None:
    folder = tmp_path / "scene"
    shutil.copytree(fitted_room, folder)
    scene = load_scene(folder)

    class Stopping(Observer):
        def progress(self, stage: str, done: int, total: int) -> None:
            if done == 2:
                raise KeyboardInterrupt

        def stage(self, stage: str) -> Any:
            return super().stage(stage)

    with pytest.raises(KeyboardInterrupt):
        see(scene, "classical", "seen", observer=Stopping(), executor=workers)
    before = workers.items
    seen = see(scene, "classical", "seen", executor=workers)
    assert seen.kept == 2
    assert workers.items - before == seen.views - 2
    shutil.copytree(fitted_room, tmp_path / "whole")
    whole = see(load_scene(tmp_path / "whole"), "classical", "seen")
    assert files(seen.folder) == files(whole.folder)


def test_renders_have_the_same_bytes(workers, room, tmp_path) -> None:
    layers = {"classes": uplift(
        room.gaussians, room.scene.train_views, room.evidence("labels_semantic")
    )}  # fmt: skip
    options = RenderingOptions(split="test", what=("rgb", "depth", "classes"), coloured=True)
    for name, way in (("one", LOCAL), ("other", workers)):
        render_views(room.scene, tmp_path / name, options=options, layers=layers, executor=way)
    assert workers.items == len(room.scene.test_views)
    assert files(tmp_path / "one") == files(tmp_path / "other")


# The commands.


@pytest.mark.parametrize(
    ("words", "items"),
    [
        ("segment {} --method uplift --evidence labels_semantic --layer l", "train"),
        ("see {} --model classical --evidence seen", "train"),
        ("render {} -o {}/drawn", "test"),
    ],
)
def test_commands_take_workers(ray, fitted_room, tmp_path, capfd, words, items) -> None:
    """What went to them is told; on stdout there is one object."""
    folder = tmp_path / "scene"
    shutil.copytree(fitted_room, folder)
    given = [word.replace("{}", str(folder)) for word in words.split()]
    assert main([*given, "--executor", "ray", "--workers", "1", "--json"]) == 0
    shown = capfd.readouterr()
    assert isinstance(json.loads(shown.out), dict)
    scene = load_scene(fitted_room)
    count = len([view for view in scene.views if view.split == items])
    assert f"ray: {count} items by 1 workers in " in shown.err


def test_commands_refuse_what_cannot_be(fitted_room, tmp_path, capfd) -> None:
    words = ["render", str(fitted_room), "-o", str(tmp_path / "o")]
    for wrong, sentence in (
        (["--executor", "ray", "--workers", "0"], "workers: expected at least 1, got 0"),
        (["--workers", "2"], "go with executor ray, got local"),
        (["--surface", "m.ply", "--executor", "ray"], "executor: expected none with a surface"),
    ):
        assert main([*words, *wrong]) == 2
        assert sentence in " ".join(capfd.readouterr().err.split())
