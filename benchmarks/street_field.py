"""The field on primitives of a street: how good it is after so many steps, and what a step costs.

    python benchmarks/street_field.py ../shared/data/street [--geometry 1000] \
        [--iterations 300 1000 3000] [--set width=128 order=levels ...] [--published] [--json FILE]
        [--scene SCENE] [--depth auto] [--mesh FILE] [--save FIELD]

Primitives are put where `splatseg street` puts them and fitted to depth (`--geometry` steps; 0
leaves near spheres), and the field is trained for each number of steps from the start, as rates
fall over all of them. `labels_semantic` of training views teach classes. PSNR and SSIM are means
over the views of `test`; mIoU is pooled over all views of `test` and of `test_novel`, by the
independent scorer. `s` and `rays/s` are of the steps alone, wall clock; `cpu ms` is the processor
time of a step, of all threads: on a machine that others use it says more. `peak` is the share of
the products of matrices, 6 flops a weight and sample, of what a product of two 2048 x 2048 matrices
reaches a second of processor time.
"""

import argparse
import ast
import json
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from scored import _SCORE
from torch import nn

from splatseg.core import Scene, View
from splatseg.evaluate.metrics import psnr, ssim
from splatseg.io.captures import read_capture
from splatseg.io.evidence import open_evidence
from splatseg.io.scans import read_scans
from splatseg.io.scene import load_scene
from splatseg.street.build import DnmpOptions, visible_shares
from splatseg.street.field import MeshField
from splatseg.street.files import save_mesh_field
from splatseg.street.geometry import fit_geometry
from splatseg.street.hits import MeshCaster
from splatseg.street.primitives import PrimitiveMesh, voxel_primitives
from splatseg.street.radiance import PUBLISHED_RADIANCE, RadianceModel, RadianceOptions
from splatseg.street.radiance_rendering import render_view
from splatseg.street.radiance_training import RadianceFit, RadianceRecord, train_radiance
from splatseg.street.shape_files import load_shapes
from splatseg.tasks.street_inputs import capture_points, drive_sources
from splatseg.tasks.work import Work, scene_of_capture


def fitted_mesh(scene: Scene, views: tuple[View, ...], depth: str, steps: int) -> PrimitiveMesh:
    shapes = load_shapes()
    sources = drive_sources(
        Work(scene=scene, backend="cpu"), views, depth=depth, scans=read_scans(scene.source),
        cell=0.1, points=capture_points(scene.source),
    )  # fmt: skip
    primitives = voxel_primitives(sources.points, shapes=shapes)
    print(f"{sources.said}; primitives by level {torch.bincount(primitives.levels).tolist()}")
    if steps:
        options = replace(DnmpOptions().geometry, iterations=steps)
        begun = time.process_time()
        fit = fit_geometry(primitives, shapes, sources.depths(), options=options)
        primitives = fit.primitives
        print(
            f"fitted in {time.process_time() - begun:.0f} s of CPU; error "
            f"{fit.records[0].loss:.3f} to {fit.records[-1].loss:.3f}; {fit.carved} carved, "
            f"{fit.enclosing} around cameras",
            flush=True,
        )
    return primitives.mesh(shapes)


def peak() -> float:
    """Flops a second of processor time."""
    one, two = torch.randn(2, 2048, 2048).unbind(0)
    one @ two
    begun = time.process_time()
    for _ in range(5):
        one @ two
    return 5 * 2 * 2048**3 / (time.process_time() - begun)


def flops(fit: RadianceFit) -> float:
    """Of the products of a step, forward and backward."""
    samples = fit.model.options.rays * fit.hits / fit.rays

    def weights(module: nn.Module | None) -> int:
        layers = [] if module is None else module.modules()
        return sum(layer.weight.numel() for layer in layers if isinstance(layer, nn.Linear))

    model = fit.model
    each = sum(map(weights, (model.trunk, model.opacity, model.semantic, model.colour)))
    return 6.0 * (samples * each + model.options.rays * weights(model.background))


def miou(model: RadianceModel, caster: MeshCaster, views: list[View], data: Path) -> dict:
    """Scores of views, whose label maps the independent scorer reads."""
    ids = torch.tensor(model.ids)
    found: dict[str, list[float]] = {"psnr": [], "ssim": []}
    with tempfile.TemporaryDirectory() as name:
        for view in views:
            seen = render_view(model, caster, view.camera)
            labels = ids[seen.probabilities.argmax(dim=-1)].numpy().astype(np.uint8)
            Image.fromarray(labels).save(Path(name) / f"{view.name}.png")
            truth = view.read_image().float() / 255
            image = seen.colour.clamp(0, 1)
            found["psnr"].append(psnr(image, truth))
            found["ssim"].append(ssim(image, truth))
        pattern = views[0].name.split("_")[0] + "_*"
        said = subprocess.run(
            [sys.executable, str(_SCORE), "semantic", "--pred", name, "--truth",
             str(data / "semantic"), "--views", pattern],
            capture_output=True, text=True, check=True,
        )  # fmt: skip
    scores = {key: float(np.mean(values)) for key, values in found.items()}
    return scores | {"miou": json.loads(said.stdout)["mIoU"]}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--scene", type=Path, help="Gaussians of the drive, for their depth")
    parser.add_argument("--depth", default="auto", help="as splatseg street has it")
    parser.add_argument("--geometry", type=int, default=1000)
    parser.add_argument("--mesh", type=Path, help="where fitted primitives are kept (.npz)")
    parser.add_argument("--iterations", type=int, nargs="+", default=[300, 1000, 3000])
    parser.add_argument("--set", nargs="*", default=[], metavar="OPTION=VALUE")
    parser.add_argument("--published", action="store_true")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--save", type=Path, help="the last field, for benchmarks/street.py")
    args = parser.parse_args()
    capture = read_capture(args.data)
    evidence = open_evidence(args.data / "labels_semantic")
    if args.mesh is not None and args.mesh.is_file():
        with np.load(args.mesh) as kept:
            mesh = PrimitiveMesh(
                vertices=torch.from_numpy(kept["vertices"]),
                levels=torch.from_numpy(kept["levels"]),
                sizes=tuple(kept["sizes"].tolist()),
            )
    else:
        scene = scene_of_capture(capture) if args.scene is None else load_scene(args.scene)
        scene = replace(scene, source=args.data.resolve())
        mesh = fitted_mesh(scene, capture.train_views, args.depth, args.geometry)
        if args.mesh is not None:
            np.savez(args.mesh, vertices=mesh.vertices, levels=mesh.levels, sizes=mesh.sizes)
    caster = MeshCaster(mesh)
    options = PUBLISHED_RADIANCE if args.published else RadianceOptions()
    for setting in args.set:
        name, _, value = setting.partition("=")
        words = getattr(options, name)
        options = replace(
            options, **{name: value if isinstance(words, str) else ast.literal_eval(value)}
        )
    most = peak()
    print(f"{len(mesh)} primitives; peak {most / 1e9:.0f} GFLOP a second of a core")
    print(
        f"{'steps':>6} {'start s':>8} {'s':>7} {'rays/s':>8} {'cpu ms':>7} {'peak':>5} "
        f"{'PSNR':>6} {'SSIM':>6} {'test':>6} {'novel':>6}",
        flush=True,
    )
    rows = []
    for steps in args.iterations:
        marks: list[tuple[float, float]] = []

        def note(record: RadianceRecord, marks: list = marks) -> None:
            if record.iteration in (1, record.iterations):
                marks.append((time.perf_counter(), time.process_time()))

        begun = time.perf_counter()
        fit = train_radiance(
            mesh,
            capture.train_views,
            evidence,
            options=replace(options, iterations=steps),
            progress=note,
        )
        wall, cpu = (marks[1][k] - marks[0][k] for k in (0, 1))
        each = cpu / (steps - 1)
        test = miou(fit.model, caster, [v for v in capture.views if v.split == "test"], args.data)
        beside = [v for v in capture.views if v.split == "test_novel"]
        novel = miou(fit.model, caster, beside, args.data)
        row = {
            "steps": steps,
            "start": marks[0][0] - begun,
            "seconds": wall,
            "rays_per_second": (steps - 1) * options.rays / wall,
            "cpu_ms": 1e3 * each,
            "peak": flops(fit) / each / most,
            "psnr": test["psnr"],
            "ssim": test["ssim"],
            "test": test["miou"],
            "novel": novel["miou"],
            "hits": fit.hits,
            "cache_bytes": fit.cache_bytes,
        }
        rows.append(row)
        print(
            f"{steps:6d} {row['start']:8.1f} {wall:7.1f} {row['rays_per_second']:8.0f} "
            f"{row['cpu_ms']:7.1f} {row['peak']:5.2f} {row['psnr']:6.2f} {row['ssim']:6.3f} "
            f"{row['test']:6.3f} {row['novel']:6.3f}",
            flush=True,
        )
        if args.json is not None:
            args.json.write_text(json.dumps({"options": args.set, "rows": rows}, indent=1))
        if args.save is not None:
            save_mesh_field(MeshField(mesh, fit.model, seen=visible_shares(fit.seen)), args.save)


if __name__ == "__main__":
    main()
