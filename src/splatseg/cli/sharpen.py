"""``splatseg sharpen``: a new scene whose Gaussians belong to one side each of boundaries."""

import time
from dataclasses import dataclass, field
from typing import Annotated

import tyro

from splatseg.cli._types import Backend, Data, Json, NewScene, Quiet, SceneFolder, Seed
from splatseg.cli._work import ConsoleObserver, print_result
from splatseg.edit import load_document
from splatseg.lift import ConfusionOptions, SharpenOptions
from splatseg.tasks import SharpenedScene, SharpenSceneOptions, sharpen_scene


@dataclass(frozen=True, slots=True, kw_only=True)
class Command:
    """Sharpen a scene at the boundaries of a layer: each Gaussian gets one label alone.

    The Gaussians go on learning from the photographs and, beside them, from the evidence that
    the layer was made from: of the light of a pixel, as much as possible shall come from
    Gaussians of the pixel's label. Objects then come out cleaner when they are removed or
    exported, and label maps are sharper. It costs a little of the PSNR, which is printed.

    The result is a new scene with as many Gaussians in the same order. LAYER is decided anew;
    all other layers, and the evidence if it is SCENE's own, come along. SCENE stays as it is.

    For example:

    splatseg sharpen room -o room-sharp --layer objects

    splatseg sharpen room -o room-sharp --layer objects --evidence masks_sam --measure 0

    splatseg sharpen room -o room-sharp --layer semantic --sharpen-steps 500 --json
    """

    scene: SceneFolder
    output: NewScene

    layer: Annotated[str, tyro.conf.arg(metavar="NAME")]
    """The layer whose boundaries count: labels."""

    evidence: str | None = None
    """Name of the evidence that tells where boundaries are. None takes what the layer was made
    from. Segments with ids of each view's own take those of LAYER that they fit best."""

    correct_confusion: bool = True
    """Relabel under how often the evidence takes one id for another, as segment does."""

    measure: int = 8
    """Held-out views in which renders are compared with photographs before and after; 0 for
    none."""

    seed: Seed = 0
    backend: Backend = "auto"
    data: Data = None
    json: Json = False
    quiet: Quiet = False

    sharpen: SharpenOptions = field(default_factory=SharpenOptions)
    """How long, and how much labels count."""

    confusion: ConfusionOptions = field(default_factory=ConfusionOptions)
    """How the evidence errs, for --correct-confusion."""


def run(command: Command) -> None:
    """Sharpen a scene."""
    started = time.monotonic()
    made = sharpen_scene(
        load_document(command.scene, data=command.data),
        command.output,
        options=SharpenSceneOptions(
            layer=command.layer,
            evidence=command.evidence,
            measure=command.measure,
            seed=command.seed,
        ),
        sharpen_options=command.sharpen,
        confusion=command.confusion if command.correct_confusion else None,
        backend=command.backend,
        observer=ConsoleObserver(quiet=command.quiet, json=command.json),
    )
    seconds = time.monotonic() - started
    facts = {
        "scene": made.folder,
        "layer": command.layer,
        "gaussians": len(made.document.scene.gaussians),
        "agreement_before": made.agreement[0],
        "agreement_after": made.agreement[1],
        "psnr_before": None if made.psnr is None else made.psnr[0],
        "psnr_after": None if made.psnr is None else made.psnr[1],
        "measured_views": made.measured_views,
        "seconds": round(seconds, 3),
    }
    print_result(facts, _lines(made, seconds), json=command.json)


def _lines(made: SharpenedScene, seconds: float) -> list[str]:
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
