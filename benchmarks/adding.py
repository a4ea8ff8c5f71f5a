"""Scenes that differ in their photographs: PSNR and labels of the same test views.

    python benchmarks/adding.py write ../shared/data/toys PART NEW
    splatseg fit PART -o before; splatseg segment before ...; splatseg fit NEW --add before -o after
    splatseg segment after ... --update
    python benchmarks/adding.py score ../shared/data/toys SCENE ... [--layers NAME ...]

`write` divides a capture: PART has it without every 8th training view, with its evidence of all
views; NEW has the photographs of these, bare. `score` prints a row a scene: PSNR of the test views,
pooled mean IoU of the layer `classes` (against `semantic`), and mean IoU of the others (against
`instance`), by the independent scorer.
"""

import argparse
import json
import statistics
import tempfile
from pathlib import Path

from scored import ScoredScene

from splatseg.core import InstanceTree, Labels
from splatseg.evaluate import psnr, render_and_photograph
from splatseg.io.scene import load_scene, load_scene_layer
from splatseg.lift import GaussianField

_EVIDENCE = ("masks_sam", "labels_semantic", "instance")


def write(data: Path, part: Path, new: Path) -> None:
    """Divide a capture; files are links."""
    content = json.loads((data / "transforms.json").read_text())
    train = [frame for frame in content["frames"] if frame.get("split") == "train"]
    out = {frame["file_path"] for frame in train[4::8]}
    content["frames"] = [f for f in content["frames"] if f["file_path"] not in out]
    content["train_filenames"] = [n for n in content["train_filenames"] if n not in out]
    for frame in content["frames"]:
        _link(data / frame["file_path"], part / frame["file_path"])
    for name in out:
        _link(data / name, new / Path(name).name)
    _link(data / "points3D.ply", part / "points3D.ply")
    for name in _EVIDENCE:
        for file in (data / name).iterdir():
            _link(file, part / name / file.name)
    (part / "transforms.json").write_text(json.dumps(content))
    print(f"{part}: {len(content['frames'])} views; {new}: {len(out)} photographs")


def _link(file: Path, at: Path) -> None:
    at.parent.mkdir(parents=True, exist_ok=True)
    at.symlink_to(file.resolve())


def score(data: Path, scenes: list[Path], layers: list[str]) -> None:
    """A row a scene."""
    for root in scenes:
        scene = load_scene(root)
        field = GaussianField(scene.gaussians)
        decibels = [psnr(*render_and_photograph(field, view)) for view in scene.test_views]
        words = [f"{len(scene.gaussians)} Gaussians", f"PSNR {statistics.fmean(decibels):.2f} dB"]
        with tempfile.TemporaryDirectory() as folder:
            bench = ScoredScene(scene, data, Path(folder))
            for name in layers:
                layer = load_scene_layer(root, name)
                labels = layer.cut() if isinstance(layer, InstanceTree) else layer
                if not isinstance(labels, Labels):
                    raise SystemExit(f"{root}: {name} is no layer of labels")
                command, truth = (
                    ("semantic", "semantic") if name == "classes" else ("instances", "instance")
                )
                said = bench.score(command, [bench.draw(labels, name)], truth)
                words.append(f"{name} {said['mIoU']:.4f} ({len(labels.present)} ids)")
        print(f"{root}: {', '.join(words)}", flush=True)


def main() -> None:
    """Write or score."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    commands = parser.add_subparsers(dest="command", required=True)
    one = commands.add_parser("write")
    for name in ("data", "part", "new"):
        one.add_argument(name, type=Path)
    other = commands.add_parser("score")
    other.add_argument("data", type=Path)
    other.add_argument("scenes", type=Path, nargs="+")
    other.add_argument("--layers", nargs="+", default=["classes", "things", "masks_sam"])
    args = parser.parse_args()
    if args.command == "write":
        write(args.data, args.part, args.new)
    else:
        score(args.data, args.scenes, args.layers)


if __name__ == "__main__":
    main()
