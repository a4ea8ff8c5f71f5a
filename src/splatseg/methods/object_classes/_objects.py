"""Labels of objects in closed form: votes of all pixels of an object, and of objects alike.

Masks are associated into objects (`methods.associate`), which need no names; labels vote for
classes on the Gaussians, and features are lifted onto them (`methods.cosseg`). Then each object
gets the class that its own votes and those of objects that look like it speak for
(`lift.object_classes`), and a Gaussian that is in several objects in part gets the classes of its
objects by its shares in them, together with what its own votes say (`_shares`). Nothing is trained.
"""

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np
import torch
from torch import Tensor

from splatseg.core import (
    UNLABELLED,
    ClassTable,
    Gaussians,
    InstanceTree,
    Labels,
    LabelSource,
    LayerInfo,
    View,
)
from splatseg.lift.object_classes import (
    PooledObjects,
    classify_objects,
    pool_objects,
    with_categories,
)
from splatseg.lift.voting.uplift import UpliftOptions, uplift
from splatseg.methods.associate import associate
from splatseg.methods.associate._table import SegmentSource
from splatseg.methods.cosseg import BlockSource, distilled_features
from splatseg.methods.object_classes._options import ObjectLabelOptions
from splatseg.methods.object_classes._shares import CANDIDATES, own_share, spread
from splatseg.render import RenderOptions


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ObjectLabels:
    """What objects are."""

    classes: Labels | None
    """The class of each Gaussian, soft; None where labels are of tracks."""

    objects: Labels
    """Which object it is of, with the class of each."""


def label_objects(
    gaussians: Gaussians,
    views: Sequence[View],
    evidence: LabelSource,
    *,
    features: BlockSource | None,
    masks: SegmentSource,
    options: ObjectLabelOptions,
    classes: ClassTable | None = None,
    categories: Mapping[int, Mapping[int, float]] | None = None,
    render_options: RenderOptions | None = None,
    backend: str = "auto",
    told: Callable[[int, int], None] | None = None,
) -> ObjectLabels:
    """Associate masks, and find the class of each object.

    Args:
        gaussians: The Gaussians of the scene.
        views: Those whose labels, features and masks count.
        evidence: Label maps, of classes or of tracks.
        features: Several blocks of a network; None takes votes of each object alone.
        masks: Masks of objects, parts and groups; or segments of objects, which do not overlap.
        options: How features are lifted, and votes and features weighed.
        classes: Names of the classes.
        categories: Of tracks, how much speaks for which class. None: labels are classes.
        render_options: Switches of the blending model.
        backend: Name of the rendering backend.
        told: Called with the stages done and all there are.

    Raises:
        InputError: If there are no views, one has no label map, features or masks, or no pixel has
            a label.
        ShapeError: If maps, masks or features do not have their photograph's proportions.
    """

    def tell(stage: int) -> None:
        if told is not None:
            told(stage, 4)

    found = uplift(
        gaussians,
        views,
        evidence,
        options=UpliftOptions(candidates=CANDIDATES),
        classes=classes,
        render_options=render_options,
        backend=backend,
    )
    tell(1)
    instances = associate(gaussians, views, masks, backend=backend)
    # Those of a tree where segments may overlap.
    objects = instances.cut("object") if isinstance(instances, InstanceTree) else instances
    tell(2)
    scales: tuple[Tensor, ...] = (torch.zeros(len(gaussians), 1),)
    weights = torch.zeros(len(gaussians))
    if features is not None:
        distilled = distilled_features(
            gaussians,
            views,
            features,
            components=options.components,
            division="mean",
            longest_side=options.lifted_side,
            render_options=render_options,
            backend=backend,
        )
        scales = distilled.scales[-1:] if options.compared == "deepest" else distilled.scales
        weights = distilled.weights
    tell(3)
    info = replace(found.info, method="object-classes", options=asdict(options))
    votes = replace(found, info=info)
    pooled = pool_objects(objects, votes, scales, weights)
    if categories is not None:
        objects, pooled = named_by_tracks(objects, pooled)
        pooled = with_categories(pooled, categories, rounds=options.classification.category_rounds)
    probabilities = classify_objects(pooled, options=options.classification)
    tell(4)
    names = {} if classes is None else {row.id: row.name for row in classes.rows}
    return ObjectLabels(
        classes=(
            spread(
                objects,
                votes,
                pooled,
                probabilities,
                own=own_share(options, objects, votes),
                candidates=options.candidates,
            )
            if categories is None
            else None
        ),
        objects=_with_classes(objects, pooled, probabilities, replace(info, names=names)),
    )


def named_by_tracks(objects: Labels, pooled: PooledObjects) -> tuple[Labels, PooledObjects]:
    """Objects with the ids of tracks, each track's for one object at most.

    The assignment has the largest sum of votes (Kuhn 1955). Objects that are left over have ids
    above those of all tracks.

    Args:
        objects: Which object each Gaussian is of.
        pooled: The objects with their votes for tracks.
    """
    from scipy.optimize import linear_sum_assignment

    votes = pooled.votes.numpy()
    rows, columns = linear_sum_assignment(votes, maximize=True)
    tracks = pooled.classes.tolist()
    given = {
        int(row): tracks[column]
        for row, column in zip(rows, columns, strict=True)
        if votes[row, column] > 0
    }
    fresh = itertools.count(max([0, *tracks]) + 1)
    names = torch.tensor(
        [given[row] if row in given else next(fresh) for row in range(len(votes))],
        dtype=torch.int64,
    )
    # The last row is of -1.
    table = torch.full((max([0, *pooled.ids.tolist()]) + 2,), UNLABELLED)
    table[pooled.ids] = names
    candidates = objects.candidates
    found = replace(
        objects,
        ids=table[objects.ids.cpu().long()].int(),
        candidates=None if candidates is None else table[candidates.cpu().long()].int(),
    )
    order = torch.argsort(names)
    return found, replace(
        pooled,
        ids=names[order],
        votes=pooled.votes[order],
        features=pooled.features[order],
        known=pooled.known[order],
    )


def _with_classes(
    objects: Labels, pooled: PooledObjects, probabilities: Tensor, info: LayerInfo
) -> Labels:
    """Objects with what each is, and how surely."""
    decided = (probabilities.sum(dim=1) > 0).numpy()
    best = probabilities.argmax(dim=1)
    kinds = {
        int(id): int(pooled.classes[column])
        for id, column, known in zip(pooled.ids, best, decided, strict=True)
        if known
    }
    surely = probabilities.amax(dim=1).numpy()
    names = {
        id: f"{info.names[kind]} {id}" if kind in info.names else str(id)
        for id, kind in kinds.items()
    }
    sure = {
        str(int(id)): round(float(value), 4)
        for id, value, known in zip(pooled.ids, surely, decided, strict=True)
        if known
    }
    details = {**objects.info.details, "class_probability": sure}
    mean = float(np.mean(list(sure.values()))) if sure else 0.0
    return replace(
        objects,
        info=replace(
            objects.info,
            method=info.method,
            options=info.options,
            class_of=kinds,
            names=names,
            details={**details, "mean_class_probability": round(mean, 4)},
        ),
    )
