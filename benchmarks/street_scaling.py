"""Where the published networks of a street would end: smaller and shorter runs, continued.

    python benchmarks/street_scaling.py ../shared/data/street --field FIELD.safetensors \
        [--widths 64 128 256] [--steps 200 400 800 1600] [--json FILE]
    python benchmarks/street_scaling.py ../shared/data/street --read FILE

One run of the published setting (50 000 steps of 4 096 rays, 8 layers of 256) is ten hours of two
cores. Here a crop of the drive (every second training view of the poses 20 to 33) is learned by the
published network and by narrower ones (all widths of its layers in proportion, all else as
published), each run from the start to its own end, as rates fall over all of a run. Batches have
1 024 rays. A run of n steps here is either n steps of the published setting (`updates`), or as many
as draw each ray of the whole drive as often as the rays of the crop were drawn (`passes`; 50 000
published steps are 9.5 passes):

    n' = n (1024 / 4096) (rays of the drive / rays of the crop)

Which of the two tells more is open, so both are told. Primitives are those of a field that was made
before. Held-out views of the crop are scored: PSNR (mean over views) and mIoU (pooled).

Curves are continued by two laws, both fitted to all widths at once by least squares, with a level
of its own for each width: `log`, q = a_w + b log n', which never ends and gives an upper end; and
`power`, q = a_w - b n'^-c, which does, and gives a lower one (c between 0.1 and 2). A width with
few runs has its level by these and the shape of the curve by the others. The interval is the 95 %
of a bootstrap over the held-out views under both laws together: it knows nothing of how far the
laws reach, of the crop, or of the smaller batch.
"""

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from splatseg.core import View
from splatseg.evaluate import Confusion, semantic_score
from splatseg.evaluate.metrics import psnr
from splatseg.io.captures import read_capture
from splatseg.io.evidence import open_evidence
from splatseg.street.files import load_mesh_field
from splatseg.street.hits import MeshCaster
from splatseg.street.radiance import PUBLISHED_RADIANCE, RadianceModel, RadianceOptions
from splatseg.street.radiance_rendering import render_view
from splatseg.street.radiance_training import train_radiance

POSES = range(20, 34)
RAYS = 1024
WHOLE = 50_000
GUESSES = np.linspace(0.1, 2.0, 39)
MEASURES = ("psnr", "miou")


def scaled(width: int, steps: int) -> RadianceOptions:
    """The published setting with all of its widths in proportion."""
    return replace(
        PUBLISHED_RADIANCE, width=width, semantic_width=width // 2, colour_widths=(width, width),
        background_widths=(width, width), iterations=steps, rays=RAYS,
    )  # fmt: skip


def pose(view: View) -> int:
    return int(view.name.split("_")[1])


def held_out(model: RadianceModel, caster: MeshCaster, views: list[View], data: Path) -> list[dict]:
    """PSNR and counts of classes of each view."""
    rows = []
    ids = torch.tensor(model.ids)
    for view in views:
        shown = render_view(model, caster, view.camera)
        with Image.open(data / "semantic" / f"{view.name}.png") as file:
            truth = torch.from_numpy(np.array(file).astype(np.int32))
        truth = torch.where(truth == 0, -1, truth)
        counts = Confusion.of(ids[shown.probabilities.argmax(dim=-1)], truth).counts
        image = view.read_image().float() / 255
        rows.append(
            {
                "view": view.name,
                "psnr": psnr(shown.colour.clamp(0, 1), image),
                "counts": counts.tolist(),
            }
        )
    return rows


def pooled(rows: list[dict]) -> tuple[float, float]:
    """PSNR and mIoU of some views."""
    total = Confusion.none()
    for row in rows:
        total = total + Confusion(counts=torch.tensor(row["counts"]))
    return float(np.mean([row["psnr"] for row in rows])), semantic_score(total).miou


def continued(
    runs: list[dict], chosen: list[int], width: int, axis: str
) -> dict[str, tuple[float, float]]:
    """What a width ends at by either law, from some of the held-out views."""
    widths = sorted({run["width"] for run in runs})
    level = np.array([[run["width"] == w for w in widths] for run in runs], dtype=float)
    steps = np.array([run[axis] for run in runs], dtype=float)
    own = widths.index(width)
    found = {}
    values = np.array([pooled([run["views"][i] for i in chosen]) for run in runs])
    for column, name in enumerate(MEASURES):
        y = values[:, column]
        log = np.linalg.lstsq(np.column_stack((level, np.log(steps))), y, rcond=None)[0]
        fits = []
        for power in GUESSES:
            terms = np.column_stack((level, -((steps / steps.min()) ** -power)))
            weights = np.linalg.lstsq(terms, y, rcond=None)[0]
            error = float(((terms @ weights - y) ** 2).sum())
            end = (WHOLE / steps.min()) ** -power
            fits.append((error, weights[own] - weights[-1] * end))
        found[name] = (min(fits)[1], log[own] + log[-1] * np.log(WHOLE))
    return found


def told(runs: list[dict]) -> None:
    """Print the curves and where they end."""
    print(f"{'width':>6} {'steps':>6} {'of the drive':>13} {'s':>6} {'PSNR':>6} {'mIoU':>6}")
    for run in runs:
        decibels, classes = pooled(run["views"])
        print(
            f"{run['width']:6d} {run['steps']:6d} {run['drive_steps']:13.0f} "
            f"{run['cpu_seconds']:6.0f} {decibels:6.2f} {classes:6.3f}"
        )
    count = len(runs[0]["views"])
    rng = np.random.default_rng(0)
    draws = [list(range(count)), *(rng.integers(0, count, count).tolist() for _ in range(300))]
    for axis, name_of_axis in (("steps", "updates"), ("drive_steps", "passes")):
        for width in sorted({run["width"] for run in runs}):
            ends = [continued(runs, chosen, width, axis) for chosen in draws]
            for name in MEASURES:
                both = np.array([end[name] for end in ends])
                low, high = np.percentile(both, (2.5, 97.5))
                power, log = ends[0][name]
                print(
                    f"by {name_of_axis}: width {width}, {WHOLE} steps, {name}: power {power:.3f}, "
                    f"log {log:.3f}; 95 % of both {low:.3f} to {high:.3f}"
                )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--field", type=Path, help="whose primitives are used")
    parser.add_argument("--widths", type=int, nargs="+", default=[64, 128, 256])
    parser.add_argument("--steps", type=int, nargs="+", default=[200, 400, 800, 1600])
    parser.add_argument("--json", type=Path, help="runs; those that are there are kept")
    parser.add_argument("--read", type=Path, help="runs that were made, to be continued again")
    args = parser.parse_args()
    if args.read is not None:
        told(json.loads(args.read.read_text()))
        return
    if args.field is None:
        raise SystemExit("expected --field or --read, got neither")
    capture = read_capture(args.data)
    evidence = open_evidence(args.data / "labels_semantic")
    views = [view for view in capture.train_views if pose(view) in POSES][::2]
    share = len(views) / len(capture.train_views)
    tests = [view for view in capture.views if view.split == "test" and pose(view) in POSES]
    middle = torch.stack([view.camera.centre for view in views])
    beside = [
        view
        for view in capture.views
        if view.split == "test_novel"
        and float((middle - view.camera.centre).norm(dim=1).min()) < 2.0
    ]
    out = tests + beside
    print(f"{len(views)} views to learn from; held out: {', '.join(view.name for view in out)}")
    mesh = load_mesh_field(args.field).mesh
    caster = MeshCaster(mesh)
    runs = json.loads(args.json.read_text()) if args.json and args.json.is_file() else []
    there = {(run["steps"], run["width"]) for run in runs}
    # The shortest of all widths first: what is stopped has curves of every width.
    for steps, width in sorted({(s, w) for s in args.steps for w in args.widths} - there):
        begun = time.process_time()
        fit = train_radiance(mesh, views, evidence, options=scaled(width, steps))
        runs.append(
            {
                "width": width,
                "steps": steps,
                "drive_steps": steps * RAYS / PUBLISHED_RADIANCE.rays / share,
                "cpu_seconds": time.process_time() - begun,
                "views": held_out(fit.model, caster, out, args.data),
            }
        )
        decibels, classes = pooled(runs[-1]["views"])
        print(f"width {width} steps {steps}: {decibels:.2f} dB, mIoU {classes:.3f}", flush=True)
        if args.json is not None:
            args.json.write_text(json.dumps(runs))
    told(runs)


if __name__ == "__main__":
    main()
