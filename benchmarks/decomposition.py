"""Trees of instances, scored on the test views by the independent scorer.

    python benchmarks/decomposition.py SCENE ../shared/data/office --layers masks_sam saga

Layers of the scene, or files elsewhere: trees and labels as they are, affinity features decomposed
(`lift.decompose`) and completed. Of each:

- `instances`: the objects against true instances, matched one to one (`score.py instances`);
- `tree`: the best node of any cut for each true instance and each true part (`score.py tree`);
- counts of nodes, and how many objects are in groups: no truth knows groups.
"""

import argparse
import tempfile
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path

from scored import ScoredScene

from splatseg.core import Features, InstanceTree, Labels
from splatseg.io.layers import load_layer
from splatseg.io.scene import load_scene
from splatseg.lift import complete
from splatseg.methods.saga.decomposition import DecomposeOptions, decompose

CUTS = ("group", "object", "part")


def layer_file(scene: Path, name: str) -> Path:
    """A layer of the scene, or a file."""
    own = scene / "layers" / f"{name}.npz"
    return own if own.is_file() else Path(name)


def decomposed(bench: ScoredScene, features: Features) -> tuple[InstanceTree, float]:
    """The tree of some features, completed, and CPU seconds of the decomposition."""
    began = time.process_time()
    tree = decompose(bench.scene.gaussians, features, options=DecomposeOptions())
    seconds = time.process_time() - began
    return replace(tree, labels=complete(bench.scene.gaussians, tree.labels)), seconds


def report(bench: ScoredScene, name: str, layer: InstanceTree | Labels, seconds: float) -> None:
    """Print a line of scores, and one of counts."""
    cuts = {"object": layer} if isinstance(layer, Labels) else {c: layer.cut(c) for c in CUTS}
    folders = {c: bench.draw(labels, f"{name}_{c}") for c, labels in cuts.items()}
    said = bench.score("instances", [folders["object"]], "instance")
    scores = [said["mIoU"]] + [
        bench.score("tree", list(folders.values()), truth)["mIoU"] for truth in ("instance", "part")
    ]
    print(
        f"{name:24s} instances {scores[0]:.4f}  recall50 {said['recall50']:.3f}  "
        f"ids {said['predicted_instances']}/{said['truth_instances']}  tree {scores[1]:.4f}  "
        f"parts {scores[2]:.4f}  {seconds:6.1f} s of CPU",
        flush=True,
    )
    if isinstance(layer, InstanceTree):
        groups = {node.id for node in layer.nodes if node.level == "group"}
        inside = sum(n.level == "object" and n.parent in groups for n in layer.nodes)
        counts = dict(Counter(node.level for node in layer.nodes))
        print(f"{'':24s} nodes {counts}, {inside} objects in groups", flush=True)


def main() -> None:
    """Parse the command line, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene", type=Path)
    parser.add_argument("data", type=Path)
    parser.add_argument("--layers", nargs="+", required=True)
    parser.add_argument("--work", type=Path, help="keep label maps here")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        work = arguments.work or Path(temporary)
        bench = ScoredScene(load_scene(arguments.scene), arguments.data, work)
        for name in arguments.layers:
            layer = load_layer(layer_file(arguments.scene, name))
            seconds = 0.0
            if isinstance(layer, Features):
                layer, seconds = decomposed(bench, layer)
            if not isinstance(layer, InstanceTree | Labels):
                raise SystemExit(f"{name}: expected labels, a tree or features")
            report(bench, Path(name).stem, layer, seconds)


if __name__ == "__main__":
    main()
