"""A capture in blocks: whose views and points are, how work is shared, how fits are joined."""

import signal
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from splatseg.core import Capture, Edited, Gaussians, PointCloud, View
from splatseg.core.checkpoints import Checkpoints
from splatseg.errors import InputError
from splatseg.evaluate import psnr, render_and_photograph
from splatseg.fit import FitOptions, FitRecord, FitResult, Refinement, cut_capture, fit, fit_blocks
from splatseg.fit._block_fits import (
    BlockFits,
    block_checkpoint,
    fit_block,
    join_blocks,
    refine_block,
    refined_steps,
)
from splatseg.fit.blocks import CaptureBlocks
from splatseg.lift import GaussianField
from splatseg.render import back_project
from splatseg.synthetic import look_at

OPTIONS = FitOptions(minutes=None, steps=1000, max_gaussians=10_000)
HALF = 0.1
"""Half of the thickness of the wall between the rooms, which is at x = 0."""


def box(low: tuple[float, ...], high: tuple[float, ...], step: float = 0.2) -> torch.Tensor:
    """Points on the six sides of a box."""
    sides = []
    for axis in range(3):
        across = [k for k in range(3) if k != axis]
        grid = torch.meshgrid(
            *(torch.arange(low[k] + step / 2, high[k], step) for k in across), indexing="ij"
        )
        for end in (low[axis], high[axis]):
            side = torch.empty(grid[0].numel(), 3)
            side[:, axis] = end
            for k, values in zip(across, grid, strict=True):
                side[:, k] = values.reshape(-1)
            sides.append(side)
    return torch.cat(sides)


LOOKS = {
    "left_in": ((-2.5, 0, 1.2), (-0.2, 0.1, 1.2)),  # at the wall between the rooms
    "left_out": ((-2.0, 1, 1.2), (-3.9, 0.5, 1.2)),
    "left_floor": ((-3, -1, 1.5), (-2, 0.5, 0.1)),
    "right_in": ((2.5, 0, 1.2), (0.2, 0.1, 1.2)),
    "right_out": ((2.0, 1, 1.2), (3.9, 0.5, 1.2)),
    "right_floor": ((3, -1, 1.5), (2, 0.5, 0.1)),
}


def rooms(*, wall: bool = True, more: tuple[View, ...] = ()) -> Capture:
    """Two rooms of 4 x 4 x 2.5 beside each other, with six cameras."""
    left = box((-4, -2, 0), (-HALF, 2, 2.5))
    points = torch.cat((left, left * torch.tensor([-1.0, 1, 1])))
    if not wall:
        points = points[points[:, 0].abs() > HALF + 1e-6]
    views = tuple(
        View(
            name=name,
            camera=look_at(eye, target, width=64, height=48),
            image=Path(f"{name}.png"),
        )
        for name, (eye, target) in LOOKS.items()
    )
    return Capture(
        path=Path("rooms"),
        format="test",
        views=(*views, *more),
        points=PointCloud(points=points, colours=torch.full_like(points, 9).to(torch.uint8)),
        up=(0, 0, 1),
    )


def names(cut: CaptureBlocks) -> list[set[str]]:
    return [{view.name for view in block.capture.views} for block in cut.blocks]


def x_of(cut: CaptureBlocks, block: int) -> torch.Tensor:
    points = cut.blocks[block].capture.points
    assert points is not None
    assert points.colours is not None
    assert len(points.colours) == len(points)
    return points.points[:, 0]


def test_a_wall_hides_the_next_room():
    cut = cut_capture(rooms(), 2, options=OPTIONS)
    assert float(cut.cells.high[0, 0]) == pytest.approx(0, abs=1e-9)
    left = {name for name in LOOKS if name.startswith("left")}
    assert names(cut) == [left, set(LOOKS) - left]
    # Not one point of the next room but those of the overlap.
    half = cut.cells.overlap / 2
    for block, sign in ((0, 1), (1, -1)):
        beyond = sign * x_of(cut, block)
        assert float(beyond.max()) < half + 1e-6
        assert int((beyond > 0).sum()) > 0
        assert int((beyond <= 0).sum()) == int((sign * rooms().points.points[:, 0] <= 0).sum())


def test_without_the_wall_who_looks_there_is_of_both():
    cut = cut_capture(rooms(wall=False), 2, options=OPTIONS)
    left, right = names(cut)
    assert left == {"left_in", "left_out", "left_floor", "right_in"}
    assert right == {"right_in", "right_out", "right_floor", "left_in"}
    # What they see beyond the overlap comes along, what nobody sees does not.
    beyond = x_of(cut, 0)
    half = cut.cells.overlap / 2
    everything = rooms(wall=False).points.points[:, 0]
    assert 0 < int((beyond > half).sum()) < int((everything > half).sum())


def test_a_view_is_of_the_block_it_stands_in_whatever_it_sees():
    """Just before where the wall would be, it shows the other room and nothing of its own."""
    away = look_at((-0.15, 0, 1.2), (3.9, 0.2, 1.2), width=64, height=48)
    out = View(name="out", camera=away, image=Path("out.png"))
    cut = cut_capture(rooms(wall=False, more=(out,)), 2, options=OPTIONS)
    at = cut.cells.cell_of(away.centre[None])
    assert int(at) == 0
    assert all("out" in one for one in names(cut))


def test_the_border_is_in_the_wall_though_cameras_stand_elsewhere():
    """The wall is not half-way between the cameras of the rooms, and each room keeps its face."""
    capture = rooms()
    nearer = [
        replace(view, camera=look_at((-0.6, 0, 1.2), (-3, y, 1.0), width=64, height=48))
        for view, y in zip(capture.views[:2], (0.5, -0.5), strict=True)
    ]
    back = look_at((-3.5, 0, 1.2), (-HALF, 0, 1.2), width=64, height=48)
    looks_back = View(name="back", camera=back, image=Path("back.png"))
    capture = replace(capture, views=(*nearer, *capture.views[2:], looks_back))
    middle = (-0.6 + 2.0) / 2
    cut = cut_capture(capture, 2, options=OPTIONS)
    assert abs(float(cut.cells.high[0, 0])) < HALF < middle
    # With no wall it may be anywhere between them.
    free = cut_capture(replace(capture, points=rooms(wall=False).points), 2, options=OPTIONS)
    assert -0.6 < float(free.cells.high[0, 0]) < 2.0


def test_a_view_that_sees_little_of_a_block_is_not_of_it():
    """As the camera turns to the other room it shows more of it, and from a quarter on counts."""
    told = []
    for y in np.linspace(-6, 0, 25):
        camera = look_at((-1.0, -1.5, 1.2), (1.5, float(y), 1.0), width=64, height=48)
        turned = View(name="turned", camera=camera, image=Path("turned.png"))
        capture = rooms(wall=False, more=(turned,))
        told.append("turned" in names(cut_capture(capture, 2, options=OPTIONS))[1])
    assert told == sorted(told)
    assert 3 < sum(told) < 22


def test_a_block_is_refined_with_views_that_show_a_little_of_it():
    """A fiftieth is enough, where a fit needs a quarter; nothing is not."""
    little = []
    for y in np.linspace(-6, 0, 25):
        camera = look_at((-1.0, -1.5, 1.2), (1.5, float(y), 1.0), width=64, height=48)
        turned = View(name="turned", camera=camera, image=Path("turned.png"))
        block = cut_capture(rooms(wall=False, more=(turned,)), 2, options=OPTIONS).blocks[1]
        fitted = {view.name for view in block.capture.views}
        refined = {view.name for view in block.border_views}
        assert fitted <= refined
        little.append(("turned" in refined) - ("turned" in fitted))
    assert 2 < sum(little) < 22
    left = cut_capture(rooms(), 2, options=OPTIONS).blocks[0]
    behind = {view.name for view in left.border_views} - {view.name for view in left.capture.views}
    assert behind <= {"right_floor"}, "whoever looks at a wall shows nothing of what is behind it"


def test_each_view_counts_as_in_one_fit_and_gaussians_add_up():
    capture = rooms(wall=False)
    options = replace(OPTIONS, densify_every=90, densify_from=240, reset_every=600)
    cut = cut_capture(capture, 3, options=options)
    views = [len(block.capture.views) for block in cut.blocks]
    assert len(set(views)) > 1
    kept, everything = 0.0, capture.points.points
    for block, own in zip(cut.blocks, views, strict=True):
        assert block.options.steps == round(1000 * own / 6)
        assert block.options.densify_every == 90 * own / 6
        assert block.options.densify_from == 240 * own / 6
        assert block.options.reset_every == 600 * own / 6
        assert block.options.bias_correction_steps == pytest.approx(6 / own)
        points = block.capture.points.points
        assert block.options.max_gaussians == round(10_000 * len(points) / len(everything))
        of_cell = float((cut.cells.cell_of(points) == block.index).sum()) / len(points)
        kept += of_cell * block.options.max_gaussians
    # Those of the cells add up to what one fit would have.
    assert kept == pytest.approx(10_000, abs=3)
    rest = (
        "steps minutes max_gaussians densify_every densify_from reset_every bias_correction_steps"
    )
    for name in FitOptions.__dataclass_fields__:
        assert name in rest or getattr(cut.blocks[0].options, name) == getattr(options, name)


def test_minutes_add_up():
    cut = cut_capture(rooms(wall=False), 3, options=FitOptions(minutes=5.0))
    minutes = [block.options.minutes for block in cut.blocks]
    assert sum(minutes) == pytest.approx(0.75 * 5.0), "the rest is the refinement's"
    views = [len(block.capture.views) for block in cut.blocks]
    assert minutes == pytest.approx([3.75 * own / sum(views) for own in views])
    assert all(block.options.steps is None for block in cut.blocks)
    assert cut_capture(rooms(), 1, options=FitOptions(minutes=5.0)).blocks[0].options.minutes == 5.0


def test_every_block_has_a_step():
    cut = cut_capture(rooms(), 3, options=replace(OPTIONS, steps=1))
    assert [block.options.steps for block in cut.blocks] == [1, 1, 1]


def test_their_number_follows_views_and_gaussians(monkeypatch):
    assert len(cut_capture(rooms(), options=OPTIONS)) == 1
    many = replace(OPTIONS, max_gaussians=2_000_001)
    assert len(cut_capture(rooms(), options=many)) == 3
    assert len(cut_capture(rooms(), options=replace(OPTIONS, max_gaussians=20_000_000))) == 6
    monkeypatch.setattr("splatseg.fit.blocks._VIEWS", 3)
    assert len(cut_capture(rooms(), "auto", options=OPTIONS)) == 2


def test_test_views_and_views_without_photographs_are_of_no_block():
    capture = rooms()
    test, bare = replace(capture.views[0], split="test"), replace(capture.views[1], image=None)
    cut = cut_capture(replace(capture, views=(test, bare, *capture.views[2:])), 2, options=OPTIONS)
    assert "left_floor" in names(cut)[0]
    assert set.union(*names(cut)) == set(LOOKS) - {"left_in", "left_out"}
    assert cut.capture.views[0].split == "test"


@pytest.mark.parametrize(
    ("changes", "options", "count", "message"),
    [
        ({"points": None}, {}, 2, "rooms: expected a capture with start points"),
        ({"points": PointCloud(points=torch.zeros(0, 3))}, {}, 2, "expected a capture with start"),
        ({"views": ()}, {}, 2, "rooms: expected training views with photographs, got none"),
        ({}, {}, 7, "blocks: expected at most as many as training views with photographs, 6, got"),
        ({}, {}, 0, "count"),
        ({}, {"exposure": True}, 2, "exposure: expected none with blocks"),
        ({}, {"refine_poses": True}, 2, "refine_poses: expected none with blocks"),
        (
            {},
            {"strategy": "fixed", "start": "points", "prune_floaters": False},
            2,
            "strategy: expected mcmc or classic with blocks, got fixed",
        ),
    ],
)
def test_what_cannot_be_cut_is_refused(changes, options, count, message):
    with pytest.raises(InputError, match=message):
        cut_capture(replace(rooms(), **changes), count, options=replace(OPTIONS, **options))


def test_the_record_names_views_and_cells():
    cut = cut_capture(rooms(), 2, options=OPTIONS)
    record = cut.record()
    assert [set(one) for one in record["views"]] == names(cut)
    assert record["overlap"] == cut.cells.overlap
    assert record["low"][0] == [None, None]


# Fits.


SHORT = FitOptions(minutes=None, steps=24, max_gaussians=70, seed=3)


def same(one: Gaussians, other: Gaussians) -> bool:
    tensors = ("means", "scales", "rotations", "opacities", "sh")
    return all(torch.equal(getattr(one, name), getattr(other, name)) for name in tensors)


def test_a_block_corrects_the_bias_of_the_steps_of_the_whole(capture: Capture):
    """The first step of Adam goes as far as the rate; counted as a later one, it goes farther."""
    first = replace(SHORT, steps=1, strategy="classic", start="points", prune_floaters=False)
    start = capture.points.points
    moved = [
        fit(capture, options=replace(first, bias_correction_steps=steps)).gaussians.means - start
        for steps in (1.0, 3.0)
    ]
    seen = moved[0].abs() > 1e-6
    assert int(seen.sum()) > 20
    # m / (1 - 0.9^t) over the root of v / (1 - 0.999^t), at t = 3 and t = 1.
    ratio = (0.1 / (1 - 0.9**3)) / (0.001 / (1 - 0.999**3)) ** 0.5
    torch.testing.assert_close(
        moved[1][seen] / moved[0][seen],
        torch.tensor(ratio).expand(int(seen.sum())),
        rtol=0.02,
        atol=0,
    )


def test_one_block_is_a_fit(capture: Capture):
    whole = fit(capture, options=SHORT)
    blocks = fit_blocks(cut_capture(capture, 1, options=SHORT))
    assert same(whole.gaussians, blocks.gaussians)
    assert blocks.gaussians.low_pass == whole.gaussians.low_pass
    assert blocks.gaussians.antialiased == whole.gaussians.antialiased
    assert [r.psnr for r in blocks.history] == [r.psnr for r in whole.history]
    assert blocks.views == capture.views


def parts_of(cut: CaptureBlocks) -> list[Gaussians]:
    """What each block keeps of a fit by itself."""
    parts = []
    for block in cut.blocks:
        alone = fit(block.capture, options=block.options).gaussians
        own = alone[cut.cells.cell_of(alone.means) == block.index]
        assert 0 < len(own) < len(alone)
        parts.append(own)
    return parts


def test_of_each_block_the_gaussians_of_its_cell_are_joined_and_refined(capture: Capture):
    cut = cut_capture(capture, 2, options=SHORT)
    joined = Gaussians.concatenate(parts_of(cut))
    shared = BlockFits(cells=cut.cells, joined=joined)
    steps = [refined_steps(block, block.options.steps) for block in cut.blocks]
    refined = [
        refine_block(shared, block, steps=count)
        for block, count in zip(cut.blocks, steps, strict=True)
    ]
    found = fit_blocks(cut)
    assert same(found.gaussians, Gaussians.concatenate(refined))
    assert len(found.gaussians) == len(joined)
    assert not same(found.gaussians, joined)
    fits = sum(block.options.steps for block in cut.blocks)
    assert found.steps == fits + sum(steps)
    views = ", ".join(str(len(block.capture.views)) for block in cut.blocks)
    assert found.notes == (
        f"2 blocks of {views} training views were fitted and joined.",
        f"They were refined among their neighbours in {sum(steps)} steps.",
    )


def test_a_block_is_refined_among_what_its_views_show(capture: Capture):
    """As by hand: those that its views show learn, from progress 0.3 on, and its own are kept."""
    cut = cut_capture(capture, 2, options=SHORT)
    joined = Gaussians.concatenate(parts_of(cut))
    block = cut.blocks[1]
    own = cut.cells.cell_of(joined.means) == 1
    given = own.clone()
    for view in block.border_views:
        ones = torch.ones(view.camera.height, view.camera.width, 1)
        given |= back_project(joined, view.camera, ones).weights > 0
    run = Refinement(joined[given], block.border_views, steps=7, start=0.3, options=block.options)
    for _ in range(7):
        run.step()
    kept = torch.nonzero(given).squeeze(1)
    wanted = run.gaussians()[torch.isin(kept, torch.nonzero(own).squeeze(1))]
    found = refine_block(BlockFits(cells=cut.cells, joined=joined), block, steps=7)
    assert same(found, wanted)
    assert len(found) == int(own.sum())


def test_ctrl_c_ends_a_refinement_after_the_step(capture: Capture):
    cut = cut_capture(capture, 2, options=SHORT)
    heard: list[float] = []

    def stop(index: int, done: float) -> None:
        heard.append(done)
        if len(heard) == 2:
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt, match="^2 of 2 blocks are fitted, but not refined$"):
        fit_blocks(cut, refining=stop)
    assert len(heard) == 2


def test_a_refinement_has_a_fifth_of_the_steps_and_each_view_as_many():
    block = cut_capture(rooms(wall=False), 2, options=OPTIONS).blocks[0]
    three = replace(block, border_views=block.capture.views[:3])
    assert len(block.capture.views) == 4
    assert refined_steps(three, 1000) == 150
    assert refined_steps(replace(block, border_views=block.capture.views), 1000) == 200
    assert refined_steps(block, 1) == 1


def test_refined_blocks_show_their_photographs_better(capture: Capture):
    """What the neighbours show is taken as they have it, and no longer as the block had it."""
    options = replace(SHORT, steps=200, max_gaussians=400)
    cut = cut_capture(capture, 2, options=options)

    def quality(gaussians: Gaussians) -> float:
        field = GaussianField(gaussians)
        return float(np.mean([psnr(*render_and_photograph(field, v)) for v in capture.train_views]))

    joined = quality(Gaussians.concatenate(parts_of(cut)))
    assert quality(fit_blocks(cut).gaussians) > joined + 0.1


def test_a_block_is_not_refined_before_all_are_joined(capture: Capture):
    cut = cut_capture(capture, 2, options=SHORT)
    with pytest.raises(ValueError, match="^joined: expected the Gaussians of all blocks"):
        refine_block(BlockFits(cells=cut.cells), cut.blocks[0], steps=1)


def test_a_refinement_that_was_stopped_begins_again_and_fits_do_not(
    capture: Capture, tmp_path: Path
):
    cut = cut_capture(capture, 2, options=SHORT)
    heard: list[tuple[int, float]] = []

    def stop(index: int, done: float) -> None:
        heard.append((index, done))
        if index == 1:
            raise KeyboardInterrupt

    checkpoints = Checkpoints(path=tmp_path / "blocks", steps=1000)
    told = "^2 of 2 blocks are fitted, but not refined; `resume` goes on from there$"
    with pytest.raises(KeyboardInterrupt, match=told):
        fit_blocks(cut, refining=stop, checkpoints=checkpoints)
    first = refined_steps(cut.blocks[0], cut.blocks[0].options.steps)
    assert [done for index, done in heard if index == 0] == [
        (step + 1) / first for step in range(first)
    ]
    steps: list[int] = []
    going_on = fit_blocks(
        cut,
        progress=lambda index, status: steps.append(index),
        checkpoints=replace(checkpoints, resume=True),
    )
    assert steps == []
    assert same(going_on.gaussians, fit_blocks(cut).gaussians)


def result(opacities: list[float], **more) -> FitResult:
    count = len(opacities)
    return FitResult(
        gaussians=Gaussians(
            means=torch.arange(3.0 * count).reshape(count, 3),
            rotations=torch.eye(4)[:1].repeat(count, 1),
            scales=torch.ones(count, 3),
            opacities=torch.tensor(opacities),
            sh=torch.zeros(count, 1, 3),
        ),
        interrupted=False,
        **more,
    )


def test_joined_fits_follow_each_other_and_the_faintest_are_too_many():
    def record(step: int, count: int) -> FitRecord:
        return FitRecord(step=step, seconds=step / 10, loss=0.1, psnr=20.0, count=count)

    first = result(
        [0.9, 0.2, 0.4], steps=100, seconds=10.0, history=(record(50, 3),), stages={"read": 1.0}
    )
    second = result(
        [0.3, 0.8],
        steps=60,
        seconds=7.0,
        history=(record(50, 2),),
        stages={"read": 2.0, "loss": 3.0},
    )
    cut = cut_capture(rooms(), 2, options=replace(OPTIONS, max_gaussians=5))
    joined = join_blocks(cut, [first, second])
    assert joined.gaussians.opacities.tolist() == pytest.approx([0.9, 0.2, 0.4, 0.3, 0.8])
    assert (joined.steps, joined.seconds) == (160, 17.0)
    assert [(r.step, r.seconds) for r in joined.history] == [(50, 5.0), (150, 15.0)]
    assert joined.stages == {"read": 3.0, "loss": 3.0}
    cut = cut_capture(rooms(), 2, options=replace(OPTIONS, max_gaussians=3))
    assert join_blocks(cut, [first, second]).gaussians.opacities.tolist() == pytest.approx(
        [0.9, 0.4, 0.8]
    )


def test_what_was_stopped_goes_on_to_the_same_bits(capture: Capture, tmp_path: Path):
    cut = cut_capture(capture, 2, options=SHORT)
    straight = fit_blocks(cut)
    heard: list[tuple[int, int]] = []

    def stop(index: int, status) -> None:
        heard.append((index, status.step))
        if index == 1 and status.step == 5:
            raise KeyboardInterrupt

    checkpoints = Checkpoints(path=tmp_path / "blocks", steps=4)
    with pytest.raises(KeyboardInterrupt, match="^1 of 2 blocks are fitted; `resume` goes on"):
        fit_blocks(cut, progress=stop, checkpoints=checkpoints)
    assert heard[-1] == (1, 5)
    assert sorted(path.name for path in (tmp_path / "blocks").iterdir()) == [
        "0000-of-0002.npz",
        "0001-of-0002.npz",
    ]
    steps: list[tuple[int, int]] = []
    going_on = fit_blocks(
        cut,
        progress=lambda index, status: steps.append((index, status.step)),
        checkpoints=replace(checkpoints, resume=True),
    )
    assert steps[0] == (1, 6), "the first block is not fitted again"
    assert same(going_on.gaussians, straight.gaussians)


def test_a_block_alone_is_one_of_all(capture: Capture, tmp_path: Path):
    """What an executor runs elsewhere: a function of what all share and of one block."""
    cut = cut_capture(capture, 2, options=SHORT)
    shared = BlockFits(cells=cut.cells, checkpoints=Checkpoints(path=tmp_path / "kept", steps=1000))
    results = [fit_block(shared, block) for block in reversed(cut.blocks)]
    assert block_checkpoint(tmp_path / "kept", 1, 2).is_file()
    joined = join_blocks(cut, results[::-1])
    sharing = replace(shared, joined=joined.gaussians)
    again = [
        refine_block(sharing, block, steps=refined_steps(block, one.steps))
        for block, one in zip(cut.blocks, results[::-1], strict=True)
    ]
    assert same(Gaussians.concatenate(again), fit_blocks(cut).gaussians)


class Objects:
    """Evidence that is told what it is asked, and adds nothing to a loss."""

    digest = "none"

    def __init__(self, told: list[str]) -> None:
        self.told = told

    def decide(self, gaussians: Gaussians, *, room: int) -> Edited:
        self.told.append(f"decide {room > 0}")
        return Edited(gaussians=gaussians, rows=torch.arange(len(gaussians)))

    def loss(self, generator: torch.Generator):
        self.told.append("loss")
        return lambda view, gaussians, rows: gaussians.means.sum() * 0

    def state(self) -> dict[str, torch.Tensor]:
        return {}

    def restore(self, tensors: dict[str, torch.Tensor]) -> None:
        pass


def test_evidence_of_objects_is_asked_for_the_views_of_a_block(capture: Capture):
    asked: list[tuple[str, ...]] = []
    told: list[str] = []

    def objects(of: Capture) -> Objects:
        asked.append(tuple(view.name for view in of.views))
        told.append("block")
        return Objects(told)

    cut = cut_capture(capture, 2, options=SHORT)
    fit_blocks(cut, objects=objects)
    fitted = [tuple(v.name for v in block.capture.views) for block in cut.blocks]
    assert asked == [*fitted, *(tuple(v.name for v in b.border_views) for b in cut.blocks)]
    last = len(told) - 1 - told[::-1].index("block")
    steps = refined_steps(cut.blocks[1], cut.blocks[1].options.steps)
    assert told[last:] == ["block", "decide False", *["loss"] * steps], "nothing is split"
