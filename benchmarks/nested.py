"""Nested masks of the train views as a tree, scored on the test views by the independent scorer.

    python benchmarks/nested.py SCENE ../shared/data/office [--rows tree sam ...] [--work DIR]

Rows:

- `tree`: `masks_nested` through `associate`: what the default cut answers (`score.py instances`),
  what the cuts hold together of instances and of parts (`score.py tree`), CPU time and memory.
- `parts`, `objects`: association of the masks of one level alone, which the recorded truth of the
  masks (`../masks_nested_truth`) tells: what a tree must not fall short of.
- `sam`: `masks_sam`, whose levels are drawn at random, as a tree.

The truth of the masks is looked at for references only. How often each cue of a node's level is
right says `benchmarks/nested_cues.py`.
"""

import json
import resource
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from scored import ScoredScene, run_rows

from splatseg.core import InstanceTree, Labels, MaskSet
from splatseg.io.evidence import open_evidence
from splatseg.lift.completion import complete
from splatseg.lift.segments import EvidenceSegments
from splatseg.methods.associate import AssociateOptions, associate

_CUTS = ("group", "object", "part", 0.75)


class OneLevel:
    """The masks of some levels, which the recorded truth of the masks tells."""

    overlapping = True
    persistent = False

    def __init__(self, data: Path, name: str, levels: Sequence[str]) -> None:
        self._source = EvidenceSegments(evidence=open_evidence(data / name))
        self._truth = data.parent / f"{name}_truth" / data.name
        self._levels = set(levels)

    @property
    def view_names(self) -> Sequence[str]:
        return self._source.view_names

    def segments_of(self, name: str) -> MaskSet:
        masks = self._source.segments_of(name)
        if not isinstance(masks, MaskSet):
            raise TypeError("expected masks")
        rows = true_levels(self._truth, name)
        kept = [i for i, row in enumerate(rows) if row["level"] in self._levels]
        return masks.subset(kept)

    def categories_of(self, name: str) -> Mapping[int, int]:
        return self._source.categories_of(name)


def true_levels(folder: Path, view: str) -> list[dict[str, object]]:
    """Level, instance and part of each mask of a view."""
    return json.loads((folder / f"{view}.json").read_text())


class Bench(ScoredScene):
    """A scene that trees are made of."""

    def made(self, source: object, **options: object) -> tuple[Labels | InstanceTree, float]:
        """A completed layer and the CPU seconds that it took."""
        began = time.process_time()
        layer = associate(
            self.scene.gaussians,
            self.scene.train_views,
            source,  # type: ignore[arg-type]
            options=AssociateOptions(**options),  # type: ignore[arg-type]
        )
        seconds = time.process_time() - began
        flat = layer.labels if isinstance(layer, InstanceTree) else layer
        flat = complete(self.scene.gaussians, flat)
        return (replace(layer, labels=flat) if isinstance(layer, InstanceTree) else flat), seconds


def report_tree(bench: Bench, name: str, tree: InstanceTree, seconds: float) -> None:
    """Score the default cut and all cuts of a tree."""
    folders = {level: bench.draw(tree.cut(level), f"{name}_{level}") for level in _CUTS}
    said = bench.score("instances", [folders["object"]], "instance")
    line(f"{name}, objects", said, seconds)
    for truth in ("instance", "part"):
        said = bench.score("tree", list(folders.values()), truth)
        line(f"{name}, all cuts against {truth}", said, seconds)


def line(title: str, said: Mapping[str, float], seconds: float) -> None:
    ids = f"{said.get('predicted_instances', '-')}/{said['truth_instances']}"
    print(
        f"{title:48s} mIoU {said['mIoU']:.4f}  recall50 {said['recall50']:.3f}  ids {ids}  "
        f"{seconds:6.1f} s of CPU",
        flush=True,
    )


def tree(bench: Bench) -> None:
    """The default."""
    source = EvidenceSegments(evidence=open_evidence(bench.data / "masks_nested"))
    layer, seconds = bench.made(source)
    if not isinstance(layer, InstanceTree):
        raise TypeError("expected a tree")
    counts = Counter(node.level for node in layer.nodes)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(f"{len(layer.nodes)} nodes {dict(counts)}, {peak:.2f} GiB resident at most")
    report_tree(bench, "masks_nested", layer, seconds)


def one_level(level: str, truth: str) -> Callable[[Bench], None]:
    """A row: association of the masks of one level."""

    def row(bench: Bench) -> None:
        source = OneLevel(bench.data, "masks_nested", (level,))
        layer, seconds = bench.made(source, level="object")
        if isinstance(layer, InstanceTree):
            raise TypeError("expected labels")
        folder = bench.draw(layer, f"{level}s")
        line(f"{level} masks alone", bench.score("instances", [folder], truth), seconds)
        line(f"{level} masks alone, tree", bench.score("tree", [folder], truth), seconds)

    return row


def sam(bench: Bench) -> None:
    """Masks of a level drawn at random."""
    source = EvidenceSegments(evidence=open_evidence(bench.data / "masks_sam"))
    layer, seconds = bench.made(source)
    if isinstance(layer, InstanceTree):
        report_tree(bench, "masks_sam", layer, seconds)


ROWS: dict[str, Callable[[Bench], None]] = {
    "tree": tree,
    "parts": one_level("part", "part"),
    "objects": one_level("object", "instance"),
    "sam": sam,
}


if __name__ == "__main__":
    run_rows(__doc__, Bench, ROWS)
