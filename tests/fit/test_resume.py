"""A fit that was stopped goes on as if it had not been, bit for bit."""

import os
import signal
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from splatseg import _native
from splatseg.core import Capture, Gaussians, PointCloud
from splatseg.core.checkpoints import CheckpointWarning
from splatseg.errors import FileFormatError, InputError
from splatseg.fit import (
    Checkpoints,
    CheckpointVersionError,
    FitOptions,
    FitProgress,
    checkpoint_summary,
    fit,
)
from splatseg.fit._checkpoint import (
    CheckpointClock,
    check_identity,
    read_checkpoint,
    write_checkpoint,
)
from splatseg.fit._run import FitRun
from splatseg.io.arrays import discard_checkpoint_file

OPTIONS = FitOptions(
    minutes=None,
    steps=60,
    max_gaussians=120,
    sh_degree=1,
    densify_from=20,
    densify_every=10,
)


@pytest.fixture(autouse=True)
def late_harmonics(with_rates) -> None:
    """Of degree 1 before and after a stop."""
    with_rates(sh_degree_interval=0.4)


def _same(one: Gaussians, other: Gaussians) -> bool:
    return len(one) == len(other) and all(
        torch.equal(getattr(one, name), getattr(other, name))
        for name in ("means", "rotations", "scales", "opacities", "sh")
    )


def _stop_after(steps: int) -> Callable[[FitProgress], None]:
    def stop(progress: FitProgress) -> None:
        if progress.step == steps:
            raise KeyboardInterrupt

    return stop


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """Where the checkpoint is."""
    return tmp_path / "scene" / "fit" / "checkpoint.npz"


CLASSIC = replace(OPTIONS.with_strategy("classic"), reset_every=18, densify_gradient=1e-6)
VARIANTS = {
    "mcmc": OPTIONS,
    "classic": CLASSIC,
    "views": replace(OPTIONS, exposure=True, refine_poses=True, start="random"),
}


@pytest.mark.parametrize("options", VARIANTS.values(), ids=VARIANTS.keys())
def test_stops_change_no_bit(capture: Capture, path: Path, options: FitOptions) -> None:
    """Around steps 20, 30 and 40 the number of Gaussians changes, from 45 on they are averaged.

    Each piece is a new process'.
    """
    straight = fit(capture, options=options)
    assert len(straight.gaussians) != 60, "densification must take part"
    for stop in (1, 19, 20, 21, 30, 47, 52):
        checkpoints = Checkpoints(path=path, resume=True)
        piece = fit(capture, options=options, checkpoints=checkpoints, progress=_stop_after(stop))
        assert piece.interrupted
        assert piece.steps == stop
        assert checkpoint_summary(path).steps == stop
    threads = _native.threads()
    try:
        _native.set_threads(threads + 1)
        last = fit(capture, options=options, checkpoints=Checkpoints(path=path, resume=True))
    finally:
        _native.set_threads(threads)
    assert not last.interrupted
    assert _same(last.gaussians, straight.gaussians)
    assert [r.step for r in last.history] == [r.step for r in straight.history]
    assert [(r.loss, r.psnr, r.count) for r in last.history] == [
        (r.loss, r.psnr, r.count) for r in straight.history
    ]


def test_everything_that_a_step_changes_is_in_the_state(capture: Capture, path: Path) -> None:
    """Nothing differs between a run and its copy, now and ten steps later."""
    from splatseg.fit._photographs import TrainingPhotographs
    from splatseg.render import get_backend

    photographs = TrainingPhotographs(capture.train_views, longest=OPTIONS.longest)
    backend = get_backend("cpu")
    run = FitRun(capture, OPTIONS, backend, photographs)
    for _ in range(25):
        run.step()
    clock = CheckpointClock(Checkpoints(path=path, resume=True), identity={})
    assert clock.saved() is None
    clock.write(run.state())
    copy = FitRun(capture, OPTIONS, backend, photographs, saved=clock.saved())
    for _ in range(10):
        before, after = run.state(), copy.state()
        assert before.tensors.keys() == after.tensors.keys()
        assert all(torch.equal(before.tensors[k], after.tensors[k]) for k in before.tensors)
        for name in ("steps", "progress", "gaussians", "extent", "start_count"):
            assert before.content[name] == after.content[name]
        run.step()
        copy.step()


def test_checkpoints_are_written_at_their_times(capture: Capture, path: Path) -> None:
    seen: list[int] = []

    def look(progress: FitProgress) -> None:
        if path.is_file():
            seen.append(checkpoint_summary(path).steps)

    options = replace(OPTIONS, steps=20)
    fit(capture, options=options, checkpoints=Checkpoints(path=path, steps=7), progress=look)
    assert seen == [7] * 7 + [14] * 6
    assert checkpoint_summary(path).steps == 14, "a finished fit writes none of its own"
    fit(capture, options=options, checkpoints=Checkpoints(path=path, steps=50, at_end=True))
    assert checkpoint_summary(path).steps == 20


def test_seconds_between_checkpoints_grow_with_what_they_cost(path: Path, monkeypatch) -> None:
    from splatseg.fit import _checkpoint
    from splatseg.fit._checkpoint import FitState

    now = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])

    def slow(*_: object) -> None:
        now[0] += 2.0

    monkeypatch.setattr(_checkpoint, "write_checkpoint", slow)
    clock = CheckpointClock(Checkpoints(path=path, seconds=30), identity={})
    due_after = []
    for _ in range(2):
        begin = now[0]
        while not clock.due(1):
            now[0] += 1
        due_after.append(now[0] - begin)
        clock.write(FitState(tensors={}, content={}))
    assert due_after == [30, 120]


def test_the_clock_goes_on_where_it_was(capture: Capture, path: Path) -> None:
    options = replace(OPTIONS, steps=None, minutes=0.03)
    checkpoints = Checkpoints(path=path, resume=True)
    first = fit(capture, options=options, checkpoints=checkpoints, progress=_stop_after(5))
    assert first.interrupted
    again = fit(capture, options=options, checkpoints=checkpoints)
    assert not again.interrupted
    assert again.steps > 5
    assert again.seconds == pytest.approx(1.8, abs=0.5)


def test_a_finished_fit_can_be_made_longer(capture: Capture, path: Path) -> None:
    """The schedule is that of the new length, seen from where the fit is."""
    fit(capture, options=OPTIONS, checkpoints=Checkpoints(path=path, at_end=True))
    seen: list[FitProgress] = []
    longer = replace(OPTIONS, steps=80)
    checkpoints = Checkpoints(path=path, resume=True)
    result = fit(capture, options=longer, checkpoints=checkpoints, progress=seen.append)
    assert [one.step for one in seen] == list(range(61, 81))
    assert seen[0].progress == pytest.approx(61 / 80)
    assert result.steps == 80
    same = fit(capture, options=OPTIONS, checkpoints=checkpoints)
    assert same.steps == 60, "nothing is left to do"


def test_another_fit_is_refused_by_what_differs(capture: Capture, path: Path) -> None:
    checkpoints = Checkpoints(path=path, resume=True)
    fit(capture, options=OPTIONS, checkpoints=checkpoints, progress=_stop_after(3))

    def refusal(capture: Capture, options: FitOptions, backend: str = "auto") -> str:
        with pytest.raises(InputError) as caught:
            fit(capture, options=options, backend=backend, checkpoints=checkpoints)
        assert str(caught.value).startswith(f"{path}: ")
        return str(caught.value)

    message = refusal(capture, replace(OPTIONS, seed=3, dssim_weight=0.5))
    assert "seed 0 instead of 3" in message
    assert "dssim_weight 0.2 instead of 0.5" in message
    assert "steps" not in message
    message = refusal(capture, replace(OPTIONS, max_gaussians=130))
    assert "max_gaussians 120 instead of 130" in message
    message = refusal(capture, replace(OPTIONS, max_gaussians=130, steps=80, seed=3))
    assert "max_gaussians" not in message, "it goes with the length"
    assert "other photographs" not in message
    assert "other cameras" not in message
    assert "backend 'cpu' instead of 'reference'" in refusal(capture, OPTIONS, "reference")

    moved = tuple(replace(v, camera=v.camera.resized(57, 48)) for v in capture.views)
    assert "other cameras" in refusal(replace(capture, views=moved), OPTIONS)
    fewer = tuple(v for v in capture.views if v.name != "view_00")
    assert "other training views" in refusal(replace(capture, views=fewer), OPTIONS)
    assert capture.points is not None
    points = PointCloud(points=capture.points.points + 1, colours=capture.points.colours)
    assert "other start points" in refusal(replace(capture, points=points), OPTIONS)
    masked = tuple(replace(v, mask=v.image) for v in capture.views)
    message = refusal(replace(capture, views=masked), OPTIONS)
    assert "other masks" in message
    assert "cameras" not in message
    swapped = {v.name: v.image for v in capture.train_views}
    swapped["view_00"] = swapped["view_01"]
    views = tuple(replace(v, image=swapped.get(v.name, v.image)) for v in capture.views)
    assert "other photographs" in refusal(replace(capture, views=views), OPTIONS)


def _recorded_otherwise(path: Path, **changes: object) -> None:
    """The checkpoint as if a build with other options had written it; None takes one away."""
    found = read_checkpoint(path)
    identity = dict(found.identity)
    for group in ("options", "defaults"):
        table = {**identity[group], **changes.get(group, {})}
        identity[group] = {name: value for name, value in table.items() if value != "absent"}
    write_checkpoint(replace(found, identity=identity), path)


def test_options_that_came_later_count_as_their_defaults(capture: Capture, path: Path) -> None:
    """And those that went are forgiven at the default that they had."""
    straight = fit(capture, options=OPTIONS)
    checkpoints = Checkpoints(path=path, resume=True)
    fit(capture, options=OPTIONS, checkpoints=checkpoints, progress=_stop_after(30))
    assert OPTIONS.exposure is FitOptions().exposure
    assert OPTIONS.sh_degree != FitOptions().sh_degree

    _recorded_otherwise(path, options={"exposure": "absent"}, defaults={"exposure": "absent"})
    with pytest.raises(InputError, match="exposure false instead of true"):
        fit(capture, options=replace(OPTIONS, exposure=True), checkpoints=checkpoints)

    _recorded_otherwise(path, options={"gone": 3, "bent": [1]}, defaults={"gone": 3, "bent": [2]})
    with pytest.raises(InputError) as caught:
        fit(capture, options=OPTIONS, checkpoints=checkpoints)
    assert "bent [1], an option that this splatseg does not have" in str(caught.value)
    assert "gone" not in str(caught.value)

    _recorded_otherwise(path, options={"bent": [2]})
    rest = fit(capture, options=OPTIONS, checkpoints=checkpoints)
    assert _same(rest.gaussians, straight.gaussians)


def test_an_option_whose_default_is_not_asked_for_is_not_forgiven(
    capture: Capture, path: Path
) -> None:
    checkpoints = Checkpoints(path=path, resume=True)
    fit(capture, options=OPTIONS, checkpoints=checkpoints, progress=_stop_after(3))
    _recorded_otherwise(path, options={"sh_degree": "absent"})
    with pytest.raises(InputError, match="sh_degree 2 instead of 1"):
        fit(capture, options=OPTIONS, checkpoints=checkpoints)


def test_a_checkpoint_of_another_version_cannot_be_resumed(
    capture: Capture, path: Path, monkeypatch
) -> None:
    from splatseg.fit import _checkpoint

    checkpoints = Checkpoints(path=path, resume=True)
    with monkeypatch.context() as patch:
        patch.setattr(_checkpoint, "VERSION", 0)
        fit(capture, options=OPTIONS, checkpoints=checkpoints, progress=_stop_after(3))
    for ask in (lambda: fit(capture, options=OPTIONS, checkpoints=checkpoints),
                lambda: checkpoint_summary(path)):  # fmt: skip
        with pytest.raises(CheckpointVersionError) as caught:
            ask()
        message = str(caught.value)
        assert message.startswith(f"{path}: this fit cannot be resumed")
        assert "version 1, got version 0" in message
        assert "\n" not in message


def test_data_that_moved_are_the_same_data(capture: Capture, path: Path, tmp_path: Path) -> None:
    import shutil

    checkpoints = Checkpoints(path=path, resume=True)
    fit(capture, options=OPTIONS, checkpoints=checkpoints, progress=_stop_after(3))
    shutil.copytree(capture.path, tmp_path / "moved")
    views = tuple(
        replace(v, image=tmp_path / "moved" / Path(str(v.image)).name) for v in capture.views
    )
    moved = replace(capture, views=views, path=tmp_path / "moved")
    assert fit(moved, options=OPTIONS, checkpoints=checkpoints).steps == 60


def test_a_file_that_is_no_whole_checkpoint_says_so(capture: Capture, path: Path) -> None:
    checkpoints = Checkpoints(path=path, resume=True)
    fit(capture, options=OPTIONS, checkpoints=checkpoints, progress=_stop_after(12))
    good = path.read_bytes()

    def refused(content: bytes) -> str:
        path.write_bytes(content)
        with pytest.raises(FileFormatError) as caught:
            fit(capture, options=OPTIONS, checkpoints=checkpoints)
        assert str(caught.value).startswith(f"{path}: ")
        return str(caught.value)

    assert "the checkpoint of a fit, but it cannot be read" in refused(b"")
    assert "the checkpoint of a fit, but it cannot be read" in refused(b"not an archive")
    rng = np.random.default_rng(2)
    for cut in rng.integers(1, len(good), 12):
        refused(good[:cut])
    for at in rng.integers(0, len(good), 60):
        flipped = bytearray(good)
        flipped[at] ^= 1 << int(rng.integers(8))
        path.write_bytes(flipped)
        # A bit that nothing depends on (a date, an attribute) may change; a value never does.
        try:
            found = read_checkpoint(path)
        except FileFormatError:
            continue
        path.write_bytes(good)
        kept = read_checkpoint(path)
        assert found.content == kept.content
        assert found.tensors.keys() == kept.tensors.keys()
        for name, tensor in kept.tensors.items():
            assert torch.equal(found.tensors[name], tensor)
    path.write_bytes(good)
    with path.open("wb") as file:
        np.savez(file, allow_pickle=False, means=np.zeros(3))
    assert "another archive" in refused(path.read_bytes())
    path.write_bytes(good)
    assert fit(capture, options=OPTIONS, checkpoints=checkpoints).steps == 60


def test_states_that_do_not_fit_are_refused(capture: Capture, path: Path) -> None:
    """Whole files with wrong content: somebody made them."""
    checkpoints = Checkpoints(path=path, resume=True)
    fit(capture, options=OPTIONS, checkpoints=checkpoints, progress=_stop_after(12))
    good = read_checkpoint(path)

    def refused(*, tensors: dict[str, object] | None = None, **content: object) -> str:
        state = replace(
            good,
            tensors={
                name: tensor
                for name, tensor in (dict(good.tensors) | (tensors or {})).items()
                if tensor is not None
            },
            content=dict(good.content) | content,
        )
        write_checkpoint(state, path)
        with pytest.raises(FileFormatError) as caught:
            fit(capture, options=OPTIONS, checkpoints=checkpoints)
        return str(caught.value)

    assert "expected a tensor 'generator', got none" in refused(tensors={"generator": None})
    assert "the state of a fit" in refused(tensors={"generator": torch.zeros(3)})
    assert "means, rotations" in refused(tensors={"first/means": None})
    assert "expected as many moments" in refused(
        tensors={
            f"second/{k}": t[:5]
            for k, t in good.group(
                "second",
                ["means", "log_scales", "rotations", "logits", "sh"],
                device=torch.device("cpu"),
            ).items()
        }
    )
    assert "float32 and shape" in refused(tensors={"parameters/logits": torch.zeros(60, 2)})
    assert "float32 and shape" in refused(
        tensors={"parameters/logits": torch.zeros(60, 1, dtype=torch.float64)}
    )
    assert "an order of the training views" in refused(tensors={"order": torch.tensor([11])})
    assert "expected last_shown, recorded in density, got last_shown, more, recorded" in refused(
        tensors={"density/more": torch.zeros(3)}
    )
    assert "expected a number 'steps', got 'many'" in refused(steps="many")
    assert "the state of a fit" in refused(history=[{"step": 1}])
    assert "the state of a fit" in refused(stages=None)


def test_a_published_fit_of_version_0_1_goes_on(capture: Capture, path: Path) -> None:
    """It recorded its learning rates one by one."""
    options = replace(OPTIONS, rates="published")
    checkpoints = Checkpoints(path=path, resume=True)
    fit(capture, options=options, checkpoints=checkpoints, progress=_stop_after(30))
    gone = {"rates": "absent", "position_rate": 1.6e-4, "final_rate": 1.0, "quarter_until": 0.0}
    defaults = {"rates": "absent", "position_rate": 8e-4, "final_rate": 0.2, "quarter_until": 0.02}
    _recorded_otherwise(path, options=gone, defaults=defaults)
    with pytest.raises(InputError, match='rates "published" instead of "fast"'):
        fit(capture, options=OPTIONS, checkpoints=checkpoints)
    assert fit(capture, options=options, checkpoints=checkpoints).steps == 60


def test_a_checkpoint_that_cannot_be_written_is_told_of_and_the_fit_goes_on(
    capture: Capture, path: Path
) -> None:
    path.parent.parent.mkdir()
    path.parent.write_text("a file where the folder should be")
    told: list[str] = []
    with_failures = fit(
        capture,
        options=OPTIONS,
        checkpoints=Checkpoints(path=path, steps=25, at_end=True, failed=told.append),
    )
    assert _same(with_failures.gaussians, fit(capture, options=OPTIONS).gaussians)
    assert len(told) == 3
    assert all("checkpoint.npz: cannot be written" in line for line in told)
    assert all(line.endswith("the work goes on, but has no checkpoint of now") for line in told)
    with pytest.warns(CheckpointWarning, match="cannot be written"):
        fit(capture, options=OPTIONS, checkpoints=Checkpoints(path=path, steps=50))


def test_the_old_one_stays_until_the_new_one_is_whole(
    capture: Capture, path: Path, monkeypatch
) -> None:
    checkpoints = Checkpoints(path=path, resume=True)
    fit(capture, options=OPTIONS, checkpoints=checkpoints, progress=_stop_after(12))
    good = path.read_bytes()

    def broken(file, *_: object, **__: object) -> None:
        file.write(b"half")
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("splatseg.io.arrays.write_array", broken)
        with pytest.raises(KeyboardInterrupt):
            write_checkpoint(read_checkpoint(path), path)
    assert path.read_bytes() == good
    assert fit(capture, options=OPTIONS, checkpoints=checkpoints).steps == 60
    discard_checkpoint_file(path)
    assert not path.parent.exists()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_wait_for_the_step(capture: Capture, path: Path, number: int) -> None:
    """Two in a row as well: the checkpoint is that of a whole step."""
    straight = fit(capture, options=OPTIONS)

    def stop(progress: FitProgress) -> None:
        if progress.step == 33:
            os.kill(os.getpid(), number)
            os.kill(os.getpid(), number)

    before = signal.getsignal(number)
    checkpoints = Checkpoints(path=path, resume=True)
    piece = fit(capture, options=OPTIONS, checkpoints=checkpoints, progress=stop)
    assert signal.getsignal(number) is before
    assert piece.interrupted
    assert piece.steps == 33
    assert checkpoint_summary(path).steps == 33
    rest = fit(capture, options=OPTIONS, checkpoints=checkpoints)
    assert _same(rest.gaussians, straight.gaussians)


def test_the_third_signal_does_not_wait(capture: Capture, path: Path, monkeypatch) -> None:
    """In the middle of a step: what there is can be used, and the last checkpoint stays."""
    whole = FitRun._update
    calls = []

    def interrupted_update(self: FitRun, *arguments: object) -> None:
        calls.append(1)
        if len(calls) == 9:
            for _ in range(3):
                os.kill(os.getpid(), signal.SIGINT)
        whole(self, *arguments)

    monkeypatch.setattr(FitRun, "_update", interrupted_update)
    result = fit(capture, options=OPTIONS, checkpoints=Checkpoints(path=path, steps=5))
    assert result.interrupted
    assert result.steps == 8
    result.gaussians.check_values()
    assert checkpoint_summary(path).steps == 5


def test_intervals_are_checked(path: Path) -> None:
    for seconds in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(InputError, match=r"seconds: expected more than 0"):
            Checkpoints(path=path, seconds=seconds)
    with pytest.raises(InputError, match=r"steps: expected at least 1, got 0"):
        Checkpoints(path=path, steps=0)


def test_names_of_a_damaged_record_do_not_fill_the_screen(tmp_path) -> None:
    identity = {"data": {"x" * 5000: 1, "line\nbreak": 2}, "options": {}, "defaults": {}}
    with pytest.raises(InputError, match="of this fit, got one with other ") as caught:
        check_identity(tmp_path, identity, {"data": {}, "options": {}, "defaults": {}})
    words = str(caught.value)
    assert len(words) < 500 + len(str(tmp_path))
    assert words.isprintable()
