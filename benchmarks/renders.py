"""What segmenting a splat without photographs costs: masks of renders against masks of photographs.

    python benchmarks/renders.py SCENE ../shared/data/office

The Gaussians of a scene that was fitted to the capture are imported twice, with the capture's
photographs and as a file without any. A model looks at the training views of each, photographs
there and renders of virtual views here; `associate` makes instances of both, and each layer is
drawn into the capture's own test views and scored by the independent scorer, mean IoU of instances
first. The test views' photographs and poses play no part in the second. Rows: views that the model
saw, masks a view, seconds of the model and of the method.
"""

import argparse
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from scored import ScoredScene

from splatseg.core import Labels, Scene
from splatseg.io.scene import load_scene
from splatseg.models import DescribedEvidence
from splatseg.tasks import ImportOptions, SegmentOptions, import_scene, see, segment
from splatseg.tasks.import_scene import UpAxis

ALLOWED = 0.05
"""How much lower the mean IoU of renders may be."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """One way of getting evidence, and what came of it."""

    title: str
    seen: DescribedEvidence
    seconds: float
    score: dict[str, float]

    def print(self) -> None:
        """Print a line of the table."""
        masks = 0 if self.seen.masks is None else self.seen.masks / max(self.seen.views, 1)
        score = self.score
        print(
            f"{self.title:12s} views {self.seen.views:4d}  masks {masks:6.1f}  "
            f"see {self.seen.seconds:6.0f} s  segment {self.seconds:5.0f} s  "
            f"mIoU {score['mIoU']:.4f}  recall50 {score['recall50']:.3f}  "
            f"precision50 {score['precision50']:.3f}  ids {score['predicted_instances']}",
            flush=True,
        )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("scene", type=Path, help="fitted to the capture")
    parser.add_argument("data", type=Path, help="the capture, with instance maps of its test views")
    parser.add_argument("--model", default="classical")
    parser.add_argument("--up", default=None, help="as of `splatseg import`; the scene's own")
    parser.add_argument("--width", type=int, default=ImportOptions().width, help="of renders")
    parser.add_argument("--work", type=Path, default=None, help="folder to keep, emptied by nobody")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        work = asked.work or Path(temporary)
        work.mkdir(exist_ok=True)
        fitted = load_scene(asked.scene, data=asked.data)
        scored = ScoredScene(fitted, asked.data, work)
        file = asked.scene / "gaussians.ply"
        up = asked.up or _axis(fitted)
        ways = {
            "photographs": ImportOptions(data=asked.data, as_is=True),
            "renders": ImportOptions(up=up, width=asked.width),
        }
        rows: dict[str, Row] = {}
        for title, options in ways.items():
            scene = import_scene(file, work / title, options=options).scene
            rows[title] = _row(title, scene, asked.model, scored)
            rows[title].print()
    lost = rows["photographs"].score["mIoU"] - rows["renders"].score["mIoU"]
    print(f"renders lose {100 * lost:.1f} points of mean IoU, {100 * ALLOWED:.0f} are allowed")
    return 0 if lost <= ALLOWED else 1


def _row(title: str, scene: Scene, model: str, scored: ScoredScene) -> Row:
    """See, segment, draw into the test views and score."""
    seen = see(scene, model, "masks")
    began = time.monotonic()
    labels = segment(scene, "associate", options=SegmentOptions(evidence="masks")).labels
    seconds = time.monotonic() - began
    said = scored.score("instances", [scored.draw(_checked(labels, scored), title)], "instance")
    return Row(title=title, seen=seen, seconds=seconds, score=said)


def _checked(labels: Labels, scored: ScoredScene) -> Labels:
    if len(labels) != len(scored.scene.gaussians):
        raise SystemExit("an imported file has other Gaussians than the scene it is of")
    return labels


def _axis(scene: Scene) -> UpAxis:
    """The axis nearest to the scene's up."""
    up = scene.up or (0.0, -1.0, 0.0)
    index = max(range(3), key=lambda i: abs(up[i]))
    return ("+x", "+y", "+z")[index] if up[index] > 0 else ("-x", "-y", "-z")[index]


if __name__ == "__main__":
    sys.exit(main())
