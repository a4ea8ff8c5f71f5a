"""Automatic masks of single photographs against true things and parts: no scene, no lifting.

    python benchmarks/masks_2d.py ../shared/data/office ../shared/data/toys --models classical hed
    python benchmarks/masks_2d.py ../shared/data/office --models hed --weights FILE --views 10
    python benchmarks/masks_2d.py ../shared/data/office --models regions --max-masks 150 --scenes S

Of evenly spaced training views, each true thing (`isthing` in metadata.json) and each part of one,
of at least 400 pixels in the view, counts with the IoU of its best mask. Given are means over
pairs of a thing and a view, and means over things of their means over views; masks a view; seconds
a view on the processor, reading aside, of the contours and masks together. With --scenes, fitted
scenes of the captures in their order, models that take depth are given that of the scene too.
"""

import argparse
import json
import time
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image as Picture

from splatseg.core import AutomaticMasks, MaskSet
from splatseg.core.models import DepthAwareMasks
from splatseg.io.scene import load_scene
from splatseg.models import LoadOptions, find_family, find_model
from splatseg.tasks.see import scene_depth
from splatseg.tasks.work import Work

_MIN_PIXELS = 400

Truth = tuple[str, set[int]]
"""Folder of the true ids, and the ids that count."""


def truths(data: Path) -> list[Truth]:
    """Things, and their parts."""
    about = json.loads((data / "metadata.json").read_text())
    things = {one["id"] for one in about["instances"] if one["isthing"]}
    parts = {one["id"] for one in about["parts"] if one["instance"] in things}
    return [("instance", things), ("part", parts)]


def best_ious(masks: MaskSet, ids: NDArray[np.int64], wanted: set[int]) -> dict[int, float]:
    """The IoU of the best mask of each wanted id of a view."""
    dense = np.zeros((len(masks), ids.size), np.float32)
    for i in range(len(masks)):
        dense[i] = masks.dense(i).numpy().reshape(-1)
    areas = dense.sum(1)
    found: dict[int, float] = {}
    for id, count in zip(*np.unique(ids, return_counts=True), strict=True):
        if id in wanted and count >= _MIN_PIXELS:
            shared = dense @ (ids == id).reshape(-1).astype(np.float32)
            found[int(id)] = float((shared / (areas + count - shared)).max(initial=0.0))
    return found


def rendered_depths(scene: Path, names: list[str]) -> dict[str, tuple[torch.Tensor, float]]:
    """The depth of training views of a fitted scene, and their focal lengths."""
    work = Work(scene=load_scene(scene))
    depth = scene_depth(work)
    views = {view.name: view for view in work.scene.train_views if view.name in names}
    return {name: (depth(view), view.camera.fx) for name, view in views.items()}


def score(
    name: str, model: AutomaticMasks, data: Path, count: int, scene: Path | None = None
) -> None:
    """Print a line a kind of truth."""
    views = sorted(path.stem for path in (data / "instance").glob("train_*.png"))
    views = views[:: max(1, len(views) // count)][:count]
    depths = {} if scene is None else rendered_depths(scene, views)
    shown = f"{name} with depth" if depths else name
    ious: dict[str, dict[int, list[float]]] = {kind: defaultdict(list) for kind, _ in truths(data)}
    masks_of_all, seconds = 0, 0.0
    for view in views:
        (path,) = (data / "images").glob(f"{view}.*")
        image = torch.from_numpy(np.array(Picture.open(path).convert("RGB")))
        began = time.process_time()
        if scene is not None and isinstance(model, DepthAwareMasks):
            masks = model.masks_with_depth(image, *depths[view])
        else:
            masks = model.masks(image)
        seconds += time.process_time() - began
        masks_of_all += len(masks)
        for kind, wanted in truths(data):
            ids = np.asarray(Picture.open(data / kind / f"{view}.png")).astype(np.int64)
            for id, iou in best_ious(masks, ids, wanted).items():
                ious[kind][id].append(iou)
    for kind, of_ids in ious.items():
        pairs = [iou for each in of_ids.values() for iou in each]
        by_id = [np.mean(each) for each in of_ids.values()]
        print(
            f"{shown} {data.name} {kind}: {np.mean(pairs):.3f} over {len(pairs)} pairs, "
            f"{np.mean(by_id):.3f} over {len(by_id)} ids; {len(views)} views, "
            f"{masks_of_all / len(views):.0f} masks and {seconds / len(views):.2f} s a view",
            flush=True,
        )


def main() -> None:
    """Score the models that are asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path, nargs="+")
    parser.add_argument("--models", nargs="+", default=["classical", "hed"])
    parser.add_argument("--weights", help="of those that have some")
    parser.add_argument("--views", type=int, default=10)
    parser.add_argument("--scenes", type=Path, nargs="+", help="fitted scenes of the captures")
    parser.add_argument("--max-masks", type=int)
    parser.add_argument("--min-area", type=float)
    parser.add_argument("--min-score", type=float)
    arguments = parser.parse_args()
    for name in arguments.models:
        family = find_family(name)
        loading = LoadOptions(weights=arguments.weights)
        asked = {
            key: value
            for key in ("max_masks", "min_area", "min_score")
            if (value := getattr(arguments, key)) is not None
        }
        options = replace(family.options(), **asked) if family and asked else None
        loading = loading if family and family.needs_weights else None
        model = find_model(name, options, loading=loading)
        if not isinstance(model, AutomaticMasks):
            raise SystemExit(f"{name} gives no masks")
        scenes = arguments.scenes or [None] * len(arguments.data)
        for data, scene in zip(arguments.data, scenes, strict=True):
            score(name, model, data, arguments.views, scene)


if __name__ == "__main__":
    main()
