"""How often each cue of a node's level is right, against the recorded truth of nested masks.

    python benchmarks/nested_cues.py SCENE ../shared/data/office

Two tables. The first is of all nodes: group, object or part, where the level of a node is that of
most of its masks, without the fragments of textures. The second is of nodes that lie in another:
is it an object of its own, or a part of what it lies in (the same instance)? Of the cues that are
numbers as many nodes are called objects as there are, those that the cue is most for, so that all
cues are compared alike; to call all by what is more frequent is the first row.

A capture without `../masks_nested_truth/NAME` has masks that are exact (a generated room): then
the truth is read off its maps of instances.

The truth of the masks is looked at for counting only.
"""

import argparse
import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse
import torch
from numpy.typing import NDArray
from PIL import Image
from scipy.sparse.csgraph import connected_components

from splatseg.core import Gaussians, MaskSet
from splatseg.io.evidence import open_evidence
from splatseg.io.scene import load_scene
from splatseg.lift.segments import EvidenceSegments
from splatseg.methods.associate import AssociateOptions
from splatseg.methods.associate._clustering import Nesting, cluster, nesting
from splatseg.methods.associate._levels import node_levels, separated_levels
from splatseg.methods.associate._table import SegmentTable, segment_table
from splatseg.methods.associate._tree import SegmentTree, segment_tree
from splatseg.neighbours import NeighbourIndex

_LEVELS = ("part", "object", "group")
_NEIGHBOURS = 8


@dataclass(frozen=True)
class Truth:
    """What most of the masks of each node are."""

    level: list[str]
    instance: NDArray[np.int64]

    def own_object(self, tree: SegmentTree) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Nodes in others, and whether each is an object of its own."""
        rows = [
            row
            for row, parent in enumerate(tree.parent.tolist())
            if parent >= 0 and "texture" not in (self.level[row], self.level[parent])
        ]
        parents = tree.parent[rows]
        in_group = np.array([self.level[parent] == "group" for parent in parents.tolist()], bool)
        return np.array(rows), in_group | (self.instance[rows] != self.instance[parents])


def mask_truth(data: Path, name: str, view: str, masks: MaskSet) -> list[dict[str, Any]]:
    """Level and instance of each mask of a view."""
    recorded = data.parent / f"{name}_truth" / data.name / f"{view}.json"
    if recorded.exists():
        return json.loads(recorded.read_text())
    instance = np.asarray(Image.open(data / "instance" / f"{view}.png")).astype(int)
    rows: list[dict[str, Any]] = []
    for mask in masks.masks:
        inside = mask.decode().numpy()
        ids = np.unique(instance[inside])
        whole = len(ids) == 1 and inside.sum() == (instance == ids[0]).sum()
        level = "group" if len(ids) > 1 else "object" if whole else "part"
        rows.append({"level": level, "instance": int(ids[0])})
    return rows


def node_truth(data: Path, name: str, table: SegmentTable, tree: SegmentTree) -> Truth:
    source = EvidenceSegments(evidence=open_evidence(data / name))
    rows: dict[str, list[dict[str, Any]]] = {}
    for view in table.views:
        masks = source.segments_of(view)
        if not isinstance(masks, MaskSet):
            raise TypeError("expected masks")
        rows[view] = mask_truth(data, name, view, masks)
    of = [
        rows[table.views[view]][mask]
        for view, mask in zip(table.view.tolist(), table.name.tolist(), strict=True)
    ]
    level, instance = [], []
    for node in range(len(tree.parent)):
        members = [of[i] for i in np.flatnonzero(tree.node == node).tolist()]
        counts = Counter(row["level"] for row in members)
        del counts["texture"]
        level.append(counts.most_common(1)[0][0] if counts else "texture")
        instance.append(Counter(row["instance"] for row in members).most_common(1)[0][0])
    return Truth(level=level, instance=np.array(instance))


def level_answers(
    tree: SegmentTree, nested: Nesting, score: NDArray[np.float64]
) -> dict[str, list[str]]:
    """The level of each node by each cue alone, and by the rule."""
    children, count = tree.children, len(tree.parent)
    height, depth = np.zeros(count, int), np.zeros(count, int)
    for node in reversed(tree.top_down()):
        height[node] = 1 + max((height[i] for i in children[node]), default=-1)
    for node in tree.top_down():
        if tree.parent[node] >= 0:
            depth[node] = depth[tree.parent[node]] + 1
    tiled = np.array(
        [tree.size[c].sum() / tree.size[i] if c else 0.0 for i, c in enumerate(children)]
    )
    _, divided = separated_levels(tree, nested, min_support=0.3, min_views=2)

    def thirds(values: NDArray[np.float64]) -> list[str]:
        rank = np.argsort(np.argsort(values, kind="stable"), kind="stable")
        return [_LEVELS[3 * i // max(count, 1)] for i in rank.tolist()]

    return {
        "levels below (0 part, 1 object, 2 group)": [_LEVELS[min(h, 2)] for h in height],
        "levels above (0 object, 1 part)": ["object" if d == 0 else "part" for d in depth],
        "children tile it (object if 0.7 or more)": [
            "object" if t >= 0.7 else "part" for t in tiled
        ],
        "size, by thirds": thirds(tree.size),
        "support over views, by thirds": thirds(tree.support),
        "predicted IoU, by thirds": thirds(score),
        "fewest exceptions": [_LEVELS[level] for level in node_levels(tree)],
        "fewest exceptions, divided (the rule)": [_LEVELS[i] for i in divided[:count]],
    }


def child_cues(
    tree: SegmentTree,
    table: SegmentTable,
    nested: Nesting,
    gaussians: Gaussians,
    rows: NDArray[np.int64],
) -> dict[str, NDArray[np.float64]]:
    """For each of some nodes how much each cue is for an object of its own."""
    cores = _cores(tree, table)
    near = NeighbourIndex(gaussians).nearest_others(_NEIGHBOURS).indices.numpy()
    colour = 0.5 + 0.2821 * gaussians.sh[:, 0].double().cpu().numpy()
    children = tree.children
    found: dict[str, list[float]] = {}
    for row in rows.tolist():
        parent = int(tree.parent[row])
        own, whole = np.zeros(len(near), bool), np.zeros(len(near), bool)
        own[cores[row]], whole[cores[parent]] = True, True
        rest = whole & ~own
        others = near[cores[row]]
        links = own[others]
        spread = np.flatnonzero(links.ravel())
        graph = scipy.sparse.coo_matrix(
            (
                np.ones(len(spread)),
                (np.repeat(cores[row], _NEIGHBOURS)[spread], others.ravel()[spread]),
            ),
            shape=(len(near), len(near)),
        )
        pieces = connected_components(graph.tocsr()[cores[row]][:, cores[row]], directed=False)
        largest = np.bincount(pieces[1]).max() / max(len(cores[row]), 1) if pieces[0] else 0.0
        apart = np.abs(_mean(colour, own) - _mean(colour, rest)).sum()
        values = {
            "it has children": float(bool(children[row])),
            "masks of its parent leave it out": 1 - _held(tree, table, nested, row),
            "little contact in 3D (8 nearest)": -float(rest[others].mean()) if own.any() else 0.0,
            "one connected piece in 3D": float(largest),
            "small beside its parent": -tree.size[row] / tree.size[parent],
            "its parent is large": tree.size[parent],
            "many beside it": len(children[parent]),
            "support over views": tree.support[row],
            "colour unlike the rest of its parent": float(apart),
        }
        for cue, value in values.items():
            found.setdefault(cue, []).append(float(value))
    return {cue: np.array(values) for cue, values in found.items()}


def _mean(colour: NDArray[np.float64], where: NDArray[np.bool_]) -> NDArray[np.float64]:
    return colour[where].mean(axis=0) if where.any() else np.zeros(3)


def _held(tree: SegmentTree, table: SegmentTable, nested: Nesting, row: int) -> float:
    """Share of the pairs of masks of one view of a node and its parent that lie inside."""
    own = np.flatnonzero(tree.node == row)
    outer = np.flatnonzero(tree.node == tree.parent[row])
    together = table.view[own][:, None] == table.view[outer]
    inside = nested.inside.tocsr()[own][:, outer].toarray().astype(bool) & together
    return float(inside.sum() / max(together.sum(), 1))


def _cores(tree: SegmentTree, table: SegmentTable) -> list[NDArray[np.int64]]:
    """The Gaussians of which a node holds at least half of what its views see."""
    masses = table.masses(tree.node, np.ones(len(tree.node)))
    squares = table.visibility().power(2)
    had = np.zeros((len(table.views), len(tree.parent)))
    member = tree.node >= 0
    had[table.view[member], tree.node[member]] = 1
    found = []
    for row in range(len(tree.parent)):
        start, stop = masses.indptr[row], masses.indptr[row + 1]
        gaussian = masses.indices[start:stop]
        seen = (squares @ had[:, row])[gaussian]
        found.append(np.sort(gaussian[masses.data[start:stop] >= 0.5 * seen]))
    return found


def tell(title: str, right: Mapping[str, Sequence[bool]]) -> None:
    """Print how often a cue is right, over all and by what is true."""
    all_of = [value for values in right.values() for value in values]
    parts = "  ".join(f"{kind} {np.mean(values):.2f}" for kind, values in right.items() if values)
    print(f"{title:44s} {np.mean(all_of):.3f} of {len(all_of)};  {parts}", flush=True)


def tell_levels(truth: Truth, answers: Mapping[str, list[str]]) -> None:
    for name, answer in answers.items():
        right: dict[str, list[bool]] = {level: [] for level in _LEVELS}
        for true, said in zip(truth.level, answer, strict=True):
            if true != "texture":
                right[true].append(true == said)
        tell(name, right)


def tell_children(is_object: NDArray[np.bool_], cues: Mapping[str, NDArray[np.float64]]) -> None:
    count = int(is_object.sum())
    frequent = 2 * count >= len(is_object)
    for name, values in {"what is more frequent": None, **cues}.items():
        called = np.full(len(is_object), frequent)
        if values is not None:
            called = np.zeros(len(is_object), bool)
            called[np.argsort(-values, kind="stable")[:count]] = True
        right = called == is_object
        tell(name, {"object": right[is_object].tolist(), "part": right[~is_object].tolist()})


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene", type=Path)
    parser.add_argument("data", type=Path)
    parser.add_argument("--evidence", default="masks_nested")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    scene, options = load_scene(arguments.scene), AssociateOptions()
    table = segment_table(
        scene.gaussians,
        scene.train_views,
        EvidenceSegments(evidence=open_evidence(arguments.data / arguments.evidence)),
        longest_side=options.longest_side,
    )
    agreement = table.agreement()
    nested = nesting(agreement, table.level)
    tree = segment_tree(
        table,
        agreement,
        nested,
        cluster(nested.agreement, options.agreement, conflicts=nested.conflicts),
        min_support=options.min_support,
        min_views=options.min_views,
    )
    truth = node_truth(arguments.data, arguments.evidence, table, tree)
    score = np.array([table.score[tree.node == node].mean() for node in range(len(tree.parent))])
    tell_levels(truth, level_answers(tree, nested, score))
    rows, is_object = truth.own_object(tree)
    print()
    tell_children(is_object, child_cues(tree, table, nested, scene.gaussians, rows))


if __name__ == "__main__":
    main()
