"""Graphs of pairs, pairs kept, and blocks: cameras, seconds and peak memory of each.

    python benchmarks/pointmap_graphs.py ../shared/data/office --views 24
    python benchmarks/pointmap_graphs.py ../shared/data/office --views 100 --many

Pointmaps are those of `pointmaps.py`, with 10 % of outlier pairs. Without further options every
pair is recorded and each graph chooses among them: complete, window, one reference, retrieval.
``--many`` records pairs up to 4 apart by name, aligns
those up to 1, 2 and 4 apart in blocks of 50, and the last in blocks of 25, all at once, and without
refinement.
Every row is a process of its own, so that its seconds and its peak of memory are its own; the first
is a process that loaded everything and aligned nothing.
"""

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from pointmaps import answers_for, between, chosen, file_name, pairs_of, written
from poses import compare

from splatseg.io.pointmaps import open_pointmaps
from splatseg.pose.pointmaps import PointmapOptions, recover_from_pointmaps

GRAPHS = ("complete", "window", "retrieval", "reference")
WINDOWS = (1, 2, 4)
NOTHING = "nothing"


def row(capture: Path, photographs: Path, views: int, changes: dict[str, Any]) -> dict[str, Any]:
    """One alignment in this process."""
    found_views = chosen(capture, views)
    given = {file_name(view): view.camera for view in found_views}
    source = open_pointmaps(photographs / "pointmaps")
    out: dict[str, Any] = dict(changes)
    if changes.pop(NOTHING, None) is None:
        begin = time.monotonic()
        options = replace(PointmapOptions(max_points=50_000), **changes)
        found = recover_from_pointmaps(photographs, source, options=options)
        cameras = {file_name(view): view.camera for view in found.capture.views}
        off = compare(cameras, given) | between(cameras, given)
        out |= {name: round(value, 4) for name, value in off.items()}
        out |= {
            "pairs kept": found.report.pairs,
            "contradictory": len(found.report.contradictory),
            "seconds": round(time.monotonic() - begin, 1),
            "of them": {name: round(x, 1) for name, x in found.report.seconds.items()},
        }
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return out | {"peak MiB": round(peak)}


def in_a_process(arguments: argparse.Namespace, folder: Path, changes: dict[str, Any]) -> None:
    """Print the row of a process of its own."""
    words = [sys.executable, __file__, str(arguments.capture), "--views", str(arguments.views)]
    words += ["--row", json.dumps(changes), "--folder", str(folder / "photos")]
    done = subprocess.run(words, check=True, stdout=subprocess.PIPE, text=True)
    print(done.stdout, end="", flush=True)


def rows(many: bool) -> list[dict[str, Any]]:
    """What is changed of the options in each row."""
    if not many:
        graphs: list[dict[str, Any]] = [{"pairs": graph} for graph in GRAPHS]
        return [{NOTHING: True}, *graphs]
    window = {"pairs": "window"}
    windows = [{**window, "window": reach} for reach in WINDOWS]
    # In blocks of 50 without a word on it.
    blocks = [{**window, "window": 4, "block": block} for block in (25, 1000)]
    return [{NOTHING: True}, *windows, *blocks, {**window, "window": 4, "refine": False}]


def main() -> int:
    """Record, align, print a line of JSON a row."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--views", type=int, default=24)
    parser.add_argument("--many", action="store_true", help="windows and blocks")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--row", help=argparse.SUPPRESS)
    parser.add_argument("--folder", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.row is not None:
        changes = json.loads(arguments.row)
        print(json.dumps(row(arguments.capture, arguments.folder, arguments.views, changes)))
        return 0
    views = chosen(arguments.capture, arguments.views)
    names = sorted(file_name(view) for view in views)
    pairs = pairs_of(names, max(WINDOWS) if arguments.many else None)
    answers = answers_for(arguments.capture, views, pairs, 0.1, arguments.seed)
    with tempfile.TemporaryDirectory() as temporary:
        written(Path(temporary), views, answers, pairs)
        for changes in rows(arguments.many):
            in_a_process(arguments, Path(temporary), changes)
    return 0


if __name__ == "__main__":
    sys.exit(main())
