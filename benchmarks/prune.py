"""What leaving out Gaussians that no training view needs does to size and held-out views.

    python benchmarks/prune.py SCENE [SCENE ...] --every 3

Each SCENE is one of ``splatseg fit --no-prune-floaters``. Prints how many Gaussians go, PSNR on
every so many held-out views before and after, the seconds of CPU it took, and for comparison
PSNR without the needles: those more than fifty times as long as wide.
"""

import argparse
import time
from pathlib import Path

from splatseg.core import Gaussians, View
from splatseg.evaluate import evaluate_photographs
from splatseg.fit._photographs import TrainingPhotographs
from splatseg.fit._refine import without_floaters
from splatseg.io.images import DEFAULT_LONGEST
from splatseg.io.scene import load_scene
from splatseg.lift import GaussianField

_NEEDLE = 50


def scored(gaussians: Gaussians, views: list[View]) -> str:
    """PSNR in words."""
    report = evaluate_photographs(GaussianField(gaussians), views)
    return f"{len(gaussians)} Gaussians, PSNR {report.psnr:.4f} (least {report.psnr_min:.4f})"


def main() -> None:
    """Print four lines a scene."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", type=Path, nargs="+")
    parser.add_argument("--every", type=int, default=1, help="score every so many held-out views")
    arguments = parser.parse_args()
    for root in arguments.scenes:
        scene = load_scene(root)
        views = list(scene.test_views[:: arguments.every])
        photographs = TrainingPhotographs(scene.train_views, longest=DEFAULT_LONGEST)
        begin = time.process_time()
        pruned = without_floaters(scene.gaussians, photographs, scene.views, backend="cpu")
        seconds = time.process_time() - begin
        _, middle, largest = scene.gaussians.scales.sort(dim=1).values.unbind(1)
        print(f"{root}: {len(photographs)} training views, {seconds:.1f} s of CPU")
        print(f"  before   {scored(scene.gaussians, views)}")
        print(f"  after    {scored(pruned, views)}", flush=True)
        blunt = scene.gaussians[largest <= _NEEDLE * middle]
        print(f"  no needles, all else: {scored(blunt, views)}", flush=True)


if __name__ == "__main__":
    main()
