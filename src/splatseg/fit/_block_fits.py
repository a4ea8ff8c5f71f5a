"""Blocks of a capture are fitted, joined, and refined among their neighbours.

Each block is fitted by itself. What it sees beyond its cell it learns too, and leaves to the
others, whose Gaussians there are not the same: at a border, half of a surface is that of one fit
and half that of another. Therefore each block is refined once more among the Gaussians of all (a
sweep of the additive Schwarz method), from every photograph that shows it, and again keeps what is
its own. Blocks are independent in both rounds.
"""

import time
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import torch
from jaxtyping import Bool
from torch import Tensor

from splatseg.core import LOCAL, Capture, Executor, Gaussians, View
from splatseg.core.boundary import boundary
from splatseg.core.checkpoints import Checkpoints, deferred_interrupts
from splatseg.fit._objects import ObjectSupervision
from splatseg.fit._options import FitOptions
from splatseg.fit._photographs import TrainingPhotographs
from splatseg.fit._refine import Refinement
from splatseg.fit._run import FitProgress, FitRecord, FitResult, fit
from splatseg.fit.blocks import CaptureBlock, CaptureBlocks, Cells
from splatseg.render import prepare

_STEPS = 0.2
"""Steps of a refinement, of those of a fit. A tenth leaves borders 0.5 dB worse."""

_FROM = 0.3
"""Progress of a fit whose learning rates the refinement begins with: where blocks disagree by much,
those of its end are too low."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BlockFits:
    """What the fits of all blocks share, and the refinements."""

    cells: Cells
    backend: str = "auto"

    checkpoints: Checkpoints | None = None
    """`Checkpoints.path` is the folder in which each block has a file; None keeps nothing."""

    progress: Callable[[int, FitProgress], None] | None = None
    """Called after every step of a fit with the number of the block."""

    refining: Callable[[int, float], None] | None = None
    """Called after every step of a refinement with the number of the block, and how much of it is
    done, in [0, 1]."""

    objects: Callable[[Capture], ObjectSupervision] | None = None
    """Gives the evidence of objects in the views of a block; None is none."""

    joined: Gaussians | None = None
    """Those of all blocks; None before they are joined."""

    def __reduce__(self) -> tuple[Callable[..., "BlockFits"], tuple[()]]:
        """What another process gets: nobody there is told of steps."""
        own = self.checkpoints
        if own is not None:
            own = Checkpoints(
                path=own.path, seconds=own.seconds, steps=own.steps, resume=own.resume
            )
        again = partial(
            BlockFits,
            cells=self.cells,
            backend=self.backend,
            checkpoints=own,
            objects=self.objects,
            joined=self.joined,
        )
        return again, ()

    def checkpoints_of(self, block: CaptureBlock) -> Checkpoints | None:
        """Of one block: its last one stays, as what was fitted."""
        if self.checkpoints is None:
            return None
        path = block_checkpoint(self.checkpoints.path, block.index, len(self.cells))
        return replace(self.checkpoints, path=path, at_end=True)


def block_checkpoint(folder: Path, index: int, count: int) -> Path:
    """Where the checkpoint of a block is."""
    return folder / f"{index:04d}-of-{count:04d}.npz"


def fit_block(shared: BlockFits, block: CaptureBlock) -> FitResult:
    """Fit a block. Its result has the Gaussians of its cell only.

    Args:
        shared: The same for all blocks.
        block: One of them.

    Raises:
        InputError: As `fit`.
    """
    report = shared.progress
    result = fit(
        block.capture,
        options=block.options,
        backend=shared.backend,
        progress=None if report is None else lambda status: report(block.index, status),
        checkpoints=shared.checkpoints_of(block),
        objects=None if shared.objects is None else shared.objects(block.capture),
    )
    own = shared.cells.cell_of(result.gaussians.means) == block.index
    return replace(result, gaussians=result.gaussians[own])


def _fitted(shared: BlockFits, block: CaptureBlock) -> Generator[FitResult]:
    yield fit_block(shared, block)


def refined_steps(block: CaptureBlock, steps: int) -> int:
    """Steps of the refinement of a block whose fit had so many: a view has as many everywhere."""
    return max(1, round(_STEPS * steps * len(block.border_views) / len(block.capture.views)))


def refine_block(shared: BlockFits, block: CaptureBlock, *, steps: int) -> Gaussians:
    """The Gaussians of a block's cell, refined among those of all blocks that its views see.

    Args:
        shared: The same for all blocks, with `BlockFits.joined`.
        block: One of them.
        steps: How many.

    Returns:
        As many as the block has, in the same order.

    Raises:
        ValueError: If blocks are not joined.
        KeyboardInterrupt: If it was interrupted.
    """
    if shared.joined is None:
        raise ValueError("joined: expected the Gaussians of all blocks, got None.")
    own = shared.cells.cell_of(shared.joined.means) == block.index
    given = own | _seen(
        shared.joined, block.border_views, options=block.options, backend=shared.backend
    )
    run = Refinement(
        shared.joined[given],
        block.border_views,
        steps=steps,
        start=_FROM,
        options=block.options,
        backend=shared.backend,
    )
    extra = None
    if shared.objects is not None:
        supervision = shared.objects(replace(block.capture, views=block.border_views))
        supervision.decide(run.gaussians(), room=0)
        extra = partial(supervision.loss, run.generator)
    with deferred_interrupts() as interrupts:
        for done in range(steps):
            if interrupts.requested:
                raise KeyboardInterrupt
            run.step(None if extra is None else extra())
            if shared.refining is not None:
                shared.refining(block.index, (done + 1) / steps)
    return run.gaussians()[own[given]]


def _refined(shared: BlockFits, item: tuple[CaptureBlock, int]) -> Generator[Gaussians]:
    block, steps = item
    yield refine_block(shared, block, steps=steps)


def _seen(
    gaussians: Gaussians, views: Sequence[View], *, options: FitOptions, backend: str
) -> Bool[Tensor, "n"]:
    """Which Gaussians any of the views shows."""
    seen = torch.zeros(len(gaussians), dtype=torch.bool)
    photographs = TrainingPhotographs.of(views, options=options)
    for index in range(len(views)):
        camera = photographs.camera(index)
        ones = torch.ones(camera.height, camera.width, 1)
        with torch.no_grad(), prepare(gaussians, camera, backend=backend) as prepared:
            seen |= prepared.back_project(ones).weights.cpu() > 0
    return seen


@boundary
def fit_blocks(
    cut: CaptureBlocks,
    *,
    backend: str = "auto",
    executor: Executor = LOCAL,
    progress: Callable[[int, FitProgress], None] | None = None,
    refining: Callable[[int, float], None] | None = None,
    checkpoints: Checkpoints | None = None,
    objects: Callable[[Capture], ObjectSupervision] | None = None,
) -> FitResult:
    """Fit the blocks of a capture, join them, and refine each among its neighbours.

    With `FitOptions.steps` the result depends on the seed alone, however often it was stopped.

    Args:
        cut: The capture in blocks.
        backend: Name of the renderer.
        executor: Where blocks are fitted.
        progress: Called after every step of a fit with the number of the block, of blocks that are
            fitted in this process.
        refining: Called after every step of a refinement, as `BlockFits.refining`.
        checkpoints: Where and how often blocks write checkpoints, its path a folder. A finished
            block leaves its last one, from which a resumed fit takes it. Refinements write none,
            and begin again. None writes none.
        objects: Gives the evidence of objects in the views of a block; None is none.

    Raises:
        InputError: As `fit`.
        KeyboardInterrupt: If it was interrupted; the message says how many blocks are fitted.
    """
    shared = BlockFits(
        cells=cut.cells,
        backend=backend,
        checkpoints=checkpoints,
        progress=progress,
        refining=refining,
        objects=objects,
    )
    onwards = "" if checkpoints is None else "; `resume` goes on from there"
    results: list[FitResult] = []
    with deferred_interrupts():
        for result in executor.map(_fitted, cut.blocks, shared=shared):
            if result.interrupted:
                raise KeyboardInterrupt(f"{len(results)} of {len(cut)} blocks are fitted{onwards}")
            results.append(result)
        joined = join_blocks(cut, results)
        if len(cut) == 1:
            return joined
        began = time.monotonic()
        steps = [refined_steps(b, r.steps) for b, r in zip(cut.blocks, results, strict=True)]
        items = list(zip(cut.blocks, steps, strict=True))
        try:
            parts = list(
                executor.map(_refined, items, shared=replace(shared, joined=joined.gaussians))
            )
        except KeyboardInterrupt as interrupt:
            told = f"{len(cut)} of {len(cut)} blocks are fitted, but not refined{onwards}"
            raise KeyboardInterrupt(told) from interrupt
    seconds = time.monotonic() - began
    return replace(
        joined,
        gaussians=Gaussians.concatenate(parts),
        steps=joined.steps + sum(steps),
        seconds=joined.seconds + seconds,
        stages={**joined.stages, "refinement": seconds},
        notes=(*joined.notes, f"They were refined among their neighbours in {sum(steps)} steps."),
    )


def join_blocks(cut: CaptureBlocks, results: Sequence[FitResult]) -> FitResult:
    """One result of those of all blocks, in their order.

    No Gaussian is of two cells. If there are more than `FitOptions.max_gaussians`, the faintest
    are left out. Steps, seconds and records follow each other.

    Args:
        cut: The capture in blocks.
        results: Of `fit_block`, one a block.
    """
    gaussians = Gaussians.concatenate([result.gaussians for result in results])
    limit = cut.options.max_gaussians
    if len(gaussians) > limit:
        kept = gaussians.opacities.argsort(descending=True, stable=True)[:limit]
        gaussians = gaussians[kept.sort().values]
    history: list[FitRecord] = []
    stages: dict[str, float] = {}
    steps, seconds = 0, 0.0
    for result in results:
        history += [
            replace(record, step=steps + record.step, seconds=seconds + record.seconds)
            for record in result.history
        ]
        stages = {
            name: stages.get(name, 0.0) + result.stages.get(name, 0.0)
            for name in [*stages, *(n for n in result.stages if n not in stages)]
        }
        steps, seconds = steps + result.steps, seconds + result.seconds
    views = ", ".join(str(len(block.capture.views)) for block in cut.blocks)
    return FitResult(
        gaussians=gaussians,
        steps=steps,
        seconds=seconds,
        history=tuple(history),
        interrupted=False,
        stages=stages,
        views=cut.capture.views,
        notes=(f"{len(cut)} blocks of {views} training views were fitted and joined.",),
    )
