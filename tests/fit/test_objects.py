"""Fits that learn objects: rounds at their times, splits, and stops that change no bit."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from splatseg.core import Edited, LabelMap, Selection, camera_of_map
from splatseg.errors import InputError
from splatseg.fit import Checkpoints, FitOptions, fit
from splatseg.fit._objects import ObjectRounds
from splatseg.fit._parameters import raw_parameters
from splatseg.lift import ObjectLabels, SharpenOptions
from splatseg.lift.boundaries.split import main_directions, split_along

from .conftest import tiny_scene
from .test_resume import OPTIONS, _same, _stop_after

LOOSE = SharpenOptions(trust_pixels=-1, label_weight=1.0)


class Halves:
    """Label maps of the tiny scene: what is above the middle of the picture, and below."""

    def __init__(self, capture) -> None:
        self.views = {view.name: view for view in capture.train_views}

    @property
    def view_names(self):
        return sorted(self.views)

    def label_map(self, name: str) -> LabelMap:
        camera = camera_of_map(self.views[name], 48, 56)
        return LabelMap(ids=(camera.pixel_centres()[..., 1] < 24).int() + 1)


def objects_of(capture, options: SharpenOptions = LOOSE, digest: str = "") -> ObjectLabels:
    return ObjectLabels(
        capture.train_views, Halves(capture), options=options, digest=digest, backend="cpu"
    )


def test_stops_change_no_bit(capture, tmp_path: Path) -> None:
    """Labels are decided after steps 36 and 48."""
    plain = fit(capture, options=OPTIONS)
    straight = fit(capture, options=OPTIONS, objects=objects_of(capture))
    assert not _same(plain.gaussians, straight.gaussians)
    path = tmp_path / "checkpoint.npz"
    for stop in (30, 36, 37, 50):
        piece = fit(
            capture, options=OPTIONS, objects=objects_of(capture),
            checkpoints=Checkpoints(path=path, resume=True), progress=_stop_after(stop),
        )  # fmt: skip
        assert piece.steps == stop
    last = fit(
        capture, options=OPTIONS, objects=objects_of(capture),
        checkpoints=Checkpoints(path=path, resume=True),
    )  # fmt: skip
    assert _same(last.gaussians, straight.gaussians)


def test_another_evidence_resumes_nothing(capture, tmp_path: Path) -> None:
    checkpoints = Checkpoints(path=tmp_path / "checkpoint.npz", resume=True)
    fit(
        capture, options=OPTIONS, objects=objects_of(capture, digest="a"), checkpoints=checkpoints,
        progress=_stop_after(40),
    )  # fmt: skip
    for objects in (None, objects_of(capture, digest="b")):
        with pytest.raises(InputError, match="other evidence of objects"):
            fit(capture, options=OPTIONS, objects=objects, checkpoints=checkpoints)


@pytest.mark.parametrize("strategy", ["mcmc", "classic", "fixed"])
def test_there_are_never_more_gaussians_than_allowed(capture, strategy) -> None:
    options = replace(OPTIONS, densify_gradient=1e-6).with_strategy(strategy)
    counts: list[int] = []
    fit(
        capture, options=options, objects=objects_of(capture),
        progress=lambda now: counts.append(now.count),
    )  # fmt: skip
    assert max(counts) <= options.max_gaussians
    if strategy == "fixed":
        assert set(counts) == {60}
    else:
        assert max(counts[:35]) <= 0.9 * options.max_gaussians
    if strategy == "mcmc":
        assert counts[-1] > 0.9 * options.max_gaussians


class Splits:
    """Splits the first Gaussian at each round."""

    digest = ""

    def __init__(self) -> None:
        self.asked: list[int] = []

    def decide(self, gaussians, *, room: int) -> Edited:
        self.asked.append(room)
        if not room:
            return Edited.unchanged(gaussians)
        mask = torch.zeros(len(gaussians), dtype=torch.bool)
        mask[0] = True
        return split_along(
            gaussians, Selection(mask=mask), main_directions(gaussians[mask]), parts=2
        )

    def loss(self, generator):
        return lambda view, gaussians, rows: gaussians.opacities.sum()

    def state(self):
        return {"asked": torch.tensor(self.asked)}

    def restore(self, tensors) -> None:
        self.asked = tensors["asked"].tolist()


def test_rounds_come_at_their_times_and_parts_begin_anew() -> None:
    options = FitOptions(max_gaussians=70)
    gaussians = tiny_scene()
    parameters = raw_parameters(gaussians)
    parameters.logits[5] = -9.0
    ones = parameters.replaced(**{name: torch.ones_like(t) for name, t in parameters.tensors()})
    state = (parameters, ones, ones)
    splits = Splits()
    rounds = ObjectRounds(splits, options=options)
    assert rounds.loss(torch.Generator()) is None
    assert rounds.after_step(state, progress=0.59) is state
    after = rounds.after_step(state, progress=0.6)
    assert rounds.loss(torch.Generator()) is not None
    # The dead one went, and the first became two, which stand behind the others.
    assert [len(one) for one in after] == [60, 60, 60]
    kept = torch.tensor([i for i in range(1, 60) if i != 5])
    for now, before in zip(after, state, strict=True):
        assert torch.equal(now.means[:58], before.means[kept])
    assert not bool(after[1].means[58:].any())
    assert not bool(after[2].sh[58:].any())
    assert torch.allclose(after[0].means[58:].mean(dim=0), gaussians.means[0], atol=1e-6)
    assert len(state[0]) == 60
    assert splits.asked == [70 - 59]
    again = rounds.after_step(after, progress=0.79)
    assert again is after
    copy = ObjectRounds(Splits(), options=options)
    copy.restore(rounds.state())
    assert copy.after_step(after, progress=0.79) is after
    copy.after_step(after, progress=0.81)
    rounds.after_step(after, progress=1.0)
    assert splits.asked == [11], "at the end there is nothing left to learn in"


def test_fits_without_room_for_objects_are_refused() -> None:
    for options, words in (
        (replace(FitOptions(), densify_until=0.95), "densify_until: expected at most 0.9"),
        (replace(FitOptions(), refine_poses=True), "refine_poses: expected none"),
    ):
        with pytest.raises(InputError, match=words):
            ObjectRounds(Splits(), options=options)
    late = ObjectRounds(Splits(), options=replace(FitOptions(), densify_until=0.8))
    parameters = raw_parameters(tiny_scene())
    state = (parameters, parameters.zeros_like(), parameters.zeros_like())
    assert late.after_step(state, progress=0.79) is state
    assert len(late.after_step(state, progress=0.8)[0]) == 61
