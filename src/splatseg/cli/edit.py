"""``splatseg edit`` and ``splatseg sharpen``: new scenes of changed Gaussians."""

import time
from dataclasses import dataclass, field
from typing import Annotated

import tyro

from splatseg.cli._shared import Memory, NewScene, OnScene, print_result
from splatseg.edit import load_document
from splatseg.errors import InputError
from splatseg.io.chunks import CHUNKS_FOLDER, is_in_chunks
from splatseg.lift import ConfusionOptions, CutOptions, SharpenOptions
from splatseg.tasks import (
    EditOptions,
    SharpenedScene,
    SharpenSceneOptions,
    edit_chunks,
    edit_scene,
    sharpen_scene,
)


@dataclass(frozen=True, kw_only=True)
class Command(OnScene):
    """Edit a scene: remove, extract, copy, move or colour what is selected.

    The result is a new scene with its layers in step and the edit recorded; SCENE stays as it is.
    Conditions of the selection: --layer with --ids or --names, a layer that is a selection, a
    --box, a --sphere, ranges of --opacity and --size, --colour-near, and of these only one
    connected component (--largest-component, --component-at). All conditions must hold, or any
    with --match any; --invert selects all other Gaussians.

    At most one of --extract, --remove, --duplicate and --merge may be given; --move, --rotate,
    --scale and the colours combine with --extract or stand alone, moves also with --duplicate (the
    copy moves) and --merge (OTHER moves). Without a selection moves and colours apply to the whole
    scene, and its cameras move along.

    Gaussians that cross the boundary of the selection are split first (--cut), so that no half of
    them is moved or left behind; the change of renders by the split alone, and the number of
    Gaussians that it adds, are printed. Small components that a removed object would leave behind
    are removed with it.

    For example:

    splatseg edit room -o room-without-chair --remove --layer objects --names chair

    splatseg edit room -o two-chairs --duplicate --layer objects --ids 3,4 --move 1 0 0

    splatseg edit room -o corner --extract --box -1 -1 0 1 1 2

    splatseg edit room -o cleaner --remove --opacity 0 0.02 --size 0.5 inf --match any

    splatseg edit room -o room-before --undo
    """

    output: NewScene

    options: Annotated[EditOptions, tyro.conf.arg(name="")]
    """What is selected, and what is done with it."""

    cutting: CutOptions = field(default_factory=CutOptions)
    """How Gaussians are split."""

    memory: Memory = None


def run(command: Command) -> None:
    """Edit a scene."""
    started = time.monotonic()
    if is_in_chunks(command.scene / CHUNKS_FOLDER) or command.memory is not None:
        if command.cutting != CutOptions():
            raise InputError("cutting: expected none for a scene in chunks, which splits nothing.")
        made = edit_chunks(
            command.open_streamed(command.memory),
            command.output,
            options=command.options,
            backend=command.backend,
            observer=command.observer,
        )
    else:
        made = edit_scene(
            load_document(command.scene, data=command.data),
            command.output,
            options=command.options,
            cut_options=command.cutting,
            data=command.data,
            backend=command.backend,
            observer=command.observer,
        )
    count, names = len(made.document.scene.gaussians), list(made.document.scene.layers)
    facts = {
        "scene": made.folder,
        "gaussians": count,
        "layers": names,
        "operations": [dict(operation) for operation in made.operations],
        "report": made.report,
        "seconds": round(time.monotonic() - started, 3),
    }
    layers = ", ".join(names) or "no layers"
    lines = [f"{made.folder}: {count} Gaussians; {layers}"]
    if made.report is not None:
        lines.append(f"pictures before and after: {made.report}")
    print_result(facts, lines, json=command.json)


@dataclass(frozen=True, kw_only=True)
class SharpenCommand(OnScene):
    """Sharpen a scene at the boundaries of a layer: each Gaussian gets one label alone.

    The Gaussians are trained further on the photographs and, beside them, on the evidence that
    the layer was made from: as much as possible of a pixel's light shall come from Gaussians of
    the pixel's label. Objects are then cleaner when they are removed or exported, and label maps
    are sharper. It costs a little of the PSNR, which is printed.

    The result is a new scene with as many Gaussians in the same order. LAYER is decided anew;
    all other layers, and the evidence if it is SCENE's own, are copied. SCENE stays as it is.

    For example:

    splatseg sharpen room -o room-sharp --layer objects

    splatseg sharpen room -o room-sharp --layer objects --evidence masks_sam --measure 0

    splatseg sharpen room -o room-sharp --layer semantic --sharpen-steps 500 --json
    """

    output: NewScene

    options: Annotated[SharpenSceneOptions, tyro.conf.arg(name="")]
    """The layer, its evidence, and what is measured."""

    correct_confusion: bool = True
    """Relabel by how often the evidence confuses ids, as segment does."""

    sharpen: SharpenOptions = field(default_factory=SharpenOptions)
    """Length of the training, and weight of the labels."""

    confusion: ConfusionOptions = field(default_factory=ConfusionOptions)
    """How the evidence confuses ids, for --correct-confusion."""


def run_sharpen(command: SharpenCommand) -> None:
    """Sharpen a scene."""
    started = time.monotonic()
    made = sharpen_scene(
        load_document(command.scene, data=command.data),
        command.output,
        options=command.options,
        sharpen_options=command.sharpen,
        confusion=command.confusion if command.correct_confusion else None,
        backend=command.backend,
        observer=command.observer,
    )
    seconds = time.monotonic() - started
    facts = {
        "scene": made.folder,
        "layer": command.options.layer,
        "gaussians": len(made.document.scene.gaussians),
        "agreement_before": made.agreement[0],
        "agreement_after": made.agreement[1],
        "psnr_before": None if made.psnr is None else made.psnr[0],
        "psnr_after": None if made.psnr is None else made.psnr[1],
        "measured_views": made.measured_views,
        "seconds": round(seconds, 3),
    }
    print_result(facts, _sharpened_lines(made, seconds), json=command.json)


def _sharpened_lines(made: SharpenedScene, seconds: float) -> list[str]:
    first, last = (100 * share for share in made.agreement)
    lines = [
        "light of labelled pixels that comes from Gaussians of their label: "
        f"{first:.2f} -> {last:.2f} %"
    ]
    if made.psnr is not None:
        before, after = made.psnr
        lines.append(f"PSNR in {made.measured_views} views: {before:.2f} -> {after:.2f} dB")
    count = len(made.document.scene.gaussians)
    return [*lines, f"{made.folder}: {count} Gaussians, in {seconds:.0f} s"]
