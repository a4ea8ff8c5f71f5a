"""``splatseg bench``: methods under a published protocol, with the published figures beside."""

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console
from rich.table import Table

from splatseg.cli._shared import (
    Backend,
    ConsoleObserver,
    Json,
    Quiet,
    Seed,
    plain,
    print_result,
    typed,
)
from splatseg.cli._words import listed
from splatseg.fit import Preset
from splatseg.tasks import ExecutorOptions, open_executor
from splatseg_bench.options import BenchOptions
from splatseg_bench.protocols import PROTOCOLS
from splatseg_bench.run import BenchRun, bench
from splatseg_bench.tables import bench_table, write_tables

_DEFAULT = BenchOptions()


@dataclass(frozen=True, slots=True, kw_only=True)
class Command:
    """Run methods under a published protocol: fit, see, segment, score, one table.

    Each scene is fitted once for all methods, and what was measured is kept: the same command goes
    on after it was stopped, and does nothing twice. Every choice of the protocol is recorded with
    each result (docs/benchmarks.md). The table, with the published figures beside, is written as
    OUT/PROTOCOL.md, .csv, .tex and .html.

    For example:

    splatseg bench spin-nerf --data spin-nerf --method uplift -o bench

    splatseg bench lerf-ovs-2d --data lerf_ovs --method features --model clip=weights -o bench

    splatseg bench spin-nerf-words --data spin-nerf --method prompt --model sam2 --grounder langsam
    --option view_share=0.5 -o bench

    splatseg bench lerf-mask --data lerf_mask --method associate --model sam2 --steps 9000 -o bench
    """

    protocol: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="PROTOCOL")]
    """The protocol; one of those above."""

    data: Annotated[Path, tyro.conf.arg(metavar="DIR")]
    """The data set in the layout that it is published in: a scene, or all of them."""

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="OUT")]
    """Where fits, predictions, results and tables are kept."""

    method: Annotated[tuple[str, ...], tyro.conf.arg(metavar="METHOD ..")] = _DEFAULT.methods
    """Methods of `splatseg segment`, by comma or by space."""

    model: Annotated[tuple[str, ...], tyro.conf.arg(metavar="MODEL ..")] = ()
    """Who sees for the methods, each NAME[=WEIGHTS][,OPTION=VALUE...], or a folder of recorded
    evidence in which {scene} stands for the scene's name. A method takes the first that gives what
    it needs."""

    option: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME=VALUE ..")] = ()
    """Options of methods other than their own, named as in `splatseg segment --method METHOD
    --help` with _ for -, such as view_share=0.5; results record them."""

    companion: Annotated[tuple[str, ...], tyro.conf.arg(metavar="MODEL ..")] = ()
    """Who sees what methods take besides their evidence, such as features and masks, named in the
    same way. Each option of a method takes the first that gives what it may name."""

    prompter: Annotated[str, tyro.conf.arg(metavar="MODEL")] = _DEFAULT.prompter
    """Who turns strokes into a mask: a model that answers points, named in the same way."""

    grounder: Annotated[str | None, tyro.conf.arg(metavar="MODEL")] = None
    """Who finds words in the drawn first view, such as langsam: words become the mask of a prompt
    so. Without it words are asked for by features."""

    scenes: Annotated[tuple[str, ...], tyro.conf.arg(metavar="SCENE ..")] = ()
    """Scenes to run, by comma or by space; all without it."""

    fitted: Annotated[str | None, tyro.conf.arg(metavar="DIR")] = None
    """Scene folders that were fitted before, with {scene} for the scene's name; without it scenes
    are fitted."""

    preset: Preset = _DEFAULT.preset
    """Preset of the fits, see `splatseg fit`."""

    steps: int | None = None
    """Length of the fits in steps."""

    max_gaussians: int | None = None
    """Most Gaussians of a fit."""

    switch: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME=VALUE ..")] = ()
    """Choices other than the protocol's; results record them."""

    beside: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="OUT ..")] = ()
    """Folders of other runs whose results stand in the same table; refused, with the differences,
    where they were scored by other choices or in other scenes."""

    published: bool = False
    """Methods as their authors published them."""

    again: bool = False
    """Measure again what was measured before."""

    download: bool = False
    """Fetch weights that are not on this machine; what and how much is said before."""

    device: str = _DEFAULT.device
    """Where networks run: cpu, cuda, cuda:1. auto takes cuda where there is one."""

    seed: Seed = 0
    backend: Backend = "auto"

    executing: tyro.conf.OmitArgPrefixes[ExecutorOptions] = field(default_factory=ExecutorOptions)
    """Where scenes are fitted and measured."""

    json: Json = False
    quiet: Quiet = False


Command.__doc__ = f"{Command.__doc__}\n\nProtocols:\n\n" + "\n".join(
    f"- {one.name}: {one.summary}" for one in PROTOCOLS
)


def run(command: Command) -> None:
    """Run a protocol and print its table."""
    words = typed(sys.argv)
    observer = ConsoleObserver(quiet=command.quiet, json=command.json)
    with open_executor(command.executing, observer=observer) as executor:
        done = bench(
            command.protocol,
            command.data,
            command.output,
            options=BenchOptions(
                methods=listed("--method", command.method),
                models=command.model,
                method_options=command.option,
                companions=command.companion,
                prompter=command.prompter,
                grounder=command.grounder,
                scenes=listed("--scenes", command.scenes) if command.scenes else (),
                fitted=command.fitted,
                preset=command.preset,
                steps=command.steps,
                max_gaussians=command.max_gaussians,
                switches=command.switch,
                published=command.published,
                beside=command.beside,
                seed=command.seed,
                again=command.again,
                download=command.download,
                device=command.device,
            ),
            backend=command.backend,
            command=words,
            executor=executor,
            observer=observer,
        )
    paths = write_tables(done, command.output, command=words)
    if command.json:
        print_result(_facts(done, paths), [], json=True)
        return
    _print_table(done)
    print_result({}, [str(paths[0].with_suffix(".html"))], json=False)


def _facts(done: BenchRun, paths: tuple[Path, ...]) -> dict[str, object]:
    return {
        "protocol": done.protocol.name,
        "methods": {one.method: dict(one.scores) for one in done.methods},
        "oracle": {one.method: list(one.oracle) for one in done.methods if one.oracle},
        "kept": done.kept,
        "notes": list(done.notes),
        "files": [str(path) for path in paths],
    }


def _print_table(done: BenchRun) -> None:
    columns, rows = bench_table(done, notes=False, classes=False)
    table = Table(title=f"{done.protocol.name}: {done.protocol.summary}")
    for name in columns:
        table.add_column(plain(name))
    for column in table.columns[1:-1]:
        column.justify = "right"
        column.no_wrap = True  # a figure that is cut off is another figure
    for row in rows:
        table.add_row(*(plain(f"{cell:.3f}" if isinstance(cell, float) else cell) for cell in row))
    Console(highlight=False).print(table)
