"""``splatseg demo``: a generated room goes through the main job."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console
from rich.table import Table

from splatseg.cli._shared import Backend, Printing, print_result
from splatseg.report.words import counted
from splatseg.tasks import Demo, DemoOptions, make_demo


@dataclass(frozen=True, kw_only=True)
class Command(Printing):
    """Run the whole pipeline on a generated room with known truth.

    Photographs of the room and class maps with a network's mistakes are generated; then fit, see,
    segment, render, evaluate and export run on them, and each command is printed: classes from
    the maps, objects from masks that need no weights, renders of held-out views, files and
    reports. Takes about three minutes on two cores. DIR/scene/reports has a page of the fit and
    one of each layer, with the truth beside it.

    For example:

    splatseg demo

    splatseg demo -o another-room --seed 1

    splatseg demo --steps 300 --train-views 12 --width 160 --json
    """

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="DIR")] = Path("splatseg-demo")
    """Folder for all results. The folder of an earlier demo is replaced."""

    options: Annotated[DemoOptions, tyro.conf.arg(name="")] = field(default_factory=DemoOptions)
    """Room, number of photographs, and length of the fit."""

    backend: Backend = "auto"


def run(command: Command) -> None:
    """Generate the room and run the main job on it."""
    made = make_demo(
        command.output,
        options=command.options,
        backend=command.backend,
        observer=command.observer,
    )
    if command.json:
        print_result({"folder": made.folder} | made.record, [], json=True)
    else:
        _print_tables(made)


def _print_tables(made: Demo) -> None:
    console = Console(highlight=False)
    console.print()
    scores = Table("labels", "views", "mIoU", "accuracy", title="Class maps against the truth")
    for column in scores.columns[2:]:
        column.justify = "right"
    came: Mapping[str, float] = {"mIoU": made.came.miou, "accuracy": made.came.accuracy}
    test, objects = made.figures["semantic", "test"], made.figures["objects", "test"]
    for what, views, row in (
        ("as they came", "train", came),
        ("lifted and rendered", "train", made.figures["semantic", "train"]),
        ("lifted and rendered", "held out", test),
    ):
        scores.add_row(what, views, f"{row['mIoU']:.3f}", f"{row['accuracy']:.3f}")
    console.print(scores)
    views = counted(test["photographs"], "held-out view")
    console.print(f"Renders of {views}: PSNR {test['PSNR']:.2f} dB, SSIM {test['SSIM']:.3f}")
    console.print(
        f"Objects from masks without weights: {objects['predicted_instances']} for "
        f"{objects['truth_instances']} true ones, mIoU {objects['mIoU']:.3f} held out"
    )
    seconds: Mapping[str, float] = made.record["seconds"]
    times = Table("step", "seconds", title=f"{made.record['seconds_total']:.0f} s in all")
    times.columns[1].justify = "right"
    for name, value in seconds.items():
        times.add_row(name, f"{value:.1f}")
    console.print(times)
    pages = " and ".join(str(page) for page in made.reports)
    print_result({}, ["", f"Open {pages} in a browser."], json=False)
