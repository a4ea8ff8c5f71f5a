"""A method on a scene in chunks: on the Gaussians that its views see, few of a large scene.

A Gaussian that no pixel of a view shows is no part of what the view says, nor of what it shows of
others: with the rest alone W has the same columns, to the bit. So the views are gone through once
for what they see, that is read, and the method runs as in memory.
"""

from dataclasses import replace
from typing import Any

import torch

from splatseg.core import LOCAL, Edited, Gaussians, Layer, apply_rows
from splatseg.core.chunks import Chunks
from splatseg.errors import InputError
from splatseg.methods import Method, MethodInputs, Refined
from splatseg.render import prepare
from splatseg.tasks.work import Work, check_streams

_COMPLETION_BYTES = 450
"""Of each Gaussian while labels spread to neighbours."""


def check_streamed(work: Work, method: Method, options: Any, *, completes: bool) -> None:
    """Refuse before the work what cannot be done with a scene in chunks.

    Args:
        work: The scene.
        method: The method.
        options: What all methods share (`SegmentOptions`).
        completes: Whether labels are to spread to Gaussians that no view explains.

    Raises:
        InputError: If it cannot.
    """
    chunks = work.gaussians.chunks
    if chunks is None:
        return
    if method.camera is None:
        check_streams(work.scene, f"method {method.name}")
    if work.executor is not LOCAL:
        check_streams(work.scene, "executor")
    if options.update:
        check_streams(work.scene, "update")
    if options.classes is not None:
        check_streams(work.scene, "classes")
    needed = len(work.gaussians) * _COMPLETION_BYTES
    if completes and needed > chunks.memory:
        raise InputError(
            f"complete: neighbours of all {len(work.gaussians)} Gaussians take about "
            f"{needed / 1e9:.1f} GB, more than the {chunks.memory / 1e9:.1f} GB that were allowed; "
            "allow more, or do without (--no-complete)."
        )


def run_on_seen(inputs: MethodInputs, method: Method, options: Any, chunks: Chunks) -> Layer:
    """The layer that a method makes of what its views see; all else has no label, or no features.

    Args:
        inputs: What the method is given, with Gaussians in chunks; progress counts views twice.
        method: One that says through which cameras it looks.
        options: Its own.
        chunks: Where the Gaussians are.

    Raises:
        InputError: If the views see more than fits in the memory.
    """
    if method.camera is None:
        raise InputError(f"method {method.name}: expected one that says through what it looks.")
    begun, total = len(inputs.views), 2 * len(inputs.views)

    def tell(done: int) -> None:
        if inputs.progress is not None:
            inputs.progress(done, total)

    def run_on(done: int, of: int) -> None:
        tell(begun + done * begun // max(of, 1))

    seen = torch.zeros(len(inputs.gaussians), dtype=torch.bool)
    for done, view in enumerate(inputs.views, start=1):
        camera = method.camera(inputs, options, view)
        with prepare(inputs.gaussians, camera, backend=inputs.backend) as prepared:
            nothing = torch.zeros(camera.height, camera.width, 1)
            # By the warp that methods read lenses with.
            seen |= prepared.back_project(nothing, warp="nearest").weights.cpu() > 0
        tell(done)
    rows = torch.nonzero(seen).squeeze(1)
    own = read_rows(inputs.gaussians, chunks, rows)
    made = method.run(replace(inputs, gaussians=own, progress=run_on), options)
    if isinstance(made, Refined):
        raise InputError(f"method {method.name}: expected one that leaves Gaussians as they are.")
    index = torch.full((len(seen),), -1)
    index[rows] = torch.arange(len(rows))
    return apply_rows(made, Edited(gaussians=inputs.gaussians, rows=index))


def read_rows(gaussians: Gaussians, chunks: Chunks, rows: torch.Tensor) -> Gaussians:
    """Some rows, ascending, in memory.

    Raises:
        InputError: If they do not fit in the memory that is allowed.
    """
    needed = len(rows) * 4 * (11 + 3 * gaussians.sh.shape[1])
    if needed > chunks.memory:
        raise InputError(
            f"memory: {len(rows)} Gaussians take about {needed / 1e9:.1f} GB, more than the "
            f"{chunks.memory / 1e9:.1f} GB that were allowed; allow more, or take fewer views."
        )
    return gaussians[rows]
