r"""Labels that contradict each other, decided object by object, by votes and by what looks alike.

Labels of views err: a segmenter is wrong about an object from a whole range of views. Objects are
found by masks (`methods.associate`), whose errors are others; each gets the class that its own
votes and those of objects that look like it speak for (`classify`), in closed form: nothing is
trained. A Gaussian that is in several objects in part gets the classes of its objects by its shares
in them, together with what its own votes say:

.. math:: P_{ic} = (1 - \lambda) \Bigl(\sum_k s_{ik} r_{kc}
          + \bigl(1 - \sum_k s_{ik}\bigr) q_{ic}\Bigr) + \lambda\, q_{ic}, \qquad
          \lambda = \max(1 - \rho / \rho_0,\; \eta / \eta_0 - 1),
          \text{ in } [0, 1]

with :math:`s_{ik}` the share of Gaussian i in object k, :math:`r_{kc}` what k is, and
:math:`q_{ic}` what the Gaussian's own votes say, relabelled by how the evidence errs. Objects are
found with errors of their own: where views err independently, and :math:`\rho`, the correlation of
neighbouring views, is small, the votes of each Gaussian know better; where errors hold over ranges
of views they know nothing more. They also know better where objects are none: where much of the
disagreement of votes, :math:`\eta`, is between the Gaussians of an object (`heterogeneity`).

No publication has this as a whole. Its parts are known: probabilistic linear discriminant analysis,
and expectation maximization for what the objects of a track are. Features are lifted as those of
`methods.cosseg` are; the network of that paper is not in it. docs/decisions/cosseg.md.

References:
    Ioffe, Probabilistic Linear Discriminant Analysis (2006).
    Dempster, Laird and Rubin, Maximum Likelihood from Incomplete Data via the EM Algorithm (1977).
"""

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from splatseg.core import (
    LOCAL,
    UNLABELLED,
    ClassTable,
    Executor,
    Gaussians,
    InstanceTree,
    LabelMap,
    Labels,
    LabelSource,
    LayerInfo,
    View,
)
from splatseg.core.evidence import SegmentSource
from splatseg.core.options import Count, Share, options
from splatseg.errors import InputError
from splatseg.io.evidence import PanopticEvidence, TrackedEvidence
from splatseg.lift.segments import EvidenceSegments
from splatseg.lift.voting.confusion import correct_confusion
from splatseg.lift.voting.uplift import UpliftOptions, uplift
from splatseg.methods._method import Method, MethodInputs
from splatseg.methods.associate import associate
from splatseg.methods.cosseg.features import BlockSource, distilled_features
from splatseg.methods.object_classes.classify import (
    PooledObjects,
    classify_objects,
    heterogeneity,
    pool_objects,
    with_categories,
)
from splatseg.render import RenderOptions as RenderOptions

MAX_CORRELATION = 1 / 3
"""Correlation of neighbouring views from which on own votes have no share, unless objects are
heterogeneous."""

MAX_HETEROGENEITY = 0.22
"""Share of the disagreement of votes that may be between the Gaussians of an object before own
votes have a share; they have all of it at twice as much."""

CANDIDATES = 16
"""Ids of a Gaussian whose votes are counted."""


_FIXED = "it is fixed at the value that was best"


@options(
    removed=dict.fromkeys(
        (
            "compared", "lifted_side", "components", "classification", "max_correlation",
            "max_heterogeneity", "vote_exponent", "feature_exponent", "vote_floor",
            "feature_components", "shrinkage", "full_votes", "category_rounds", "rounds",
        ),
        _FIXED,
    )
)  # fmt: skip
class ObjectLabelOptions:
    """How objects get their classes, and Gaussians those of their objects."""

    features: str | None = None
    """Name of evidence of features, such as features_dino, by whose deepest block objects look
    alike. None takes the votes of each object alone."""

    masks: str | None = None
    """Name of evidence of masks, such as masks_sam, by which objects are found. None takes the
    segments that are labelled themselves, of tracks and of panoptic maps; maps of classes have
    none."""

    own_share: Share | None = None
    """Share, in [0, 1], that a Gaussian's own votes have in its class beside its object's. None:
    the more the less neighbouring views err alike, as measured. Of tracks none."""

    candidates: Count = 1
    """Ids stored of each Gaussian. 1 makes a hard layer; with more it has their shares and is
    rendered softly."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _CategoryMaps:
    """Categories of panoptic segments as a `LabelSource`."""

    evidence: PanopticEvidence

    @property
    def view_names(self) -> Sequence[str]:
        """Views that have a file."""
        return self.evidence.view_names

    def label_map(self, name: str) -> LabelMap:
        """Category ids of a view."""
        return self.evidence.category_map(name)


def run(inputs: MethodInputs, options: ObjectLabelOptions) -> Labels:
    """Of label maps the classes of Gaussians, of segments the objects with a class each."""
    evidence = inputs.evidence
    masks = inputs.companions.get("masks", evidence)
    if masks.kind == "labels":
        raise InputError(
            "masks: expected evidence of masks, such as masks_sam, to find objects by, got none."
        )
    tracked = isinstance(evidence, TrackedEvidence)
    found = label_objects(
        inputs.gaussians,
        inputs.views,
        _CategoryMaps(evidence=evidence) if isinstance(evidence, PanopticEvidence) else evidence,
        features=inputs.features("features"),
        masks=EvidenceSegments(evidence=masks),
        options=options,
        classes=inputs.label_names if evidence.kind == "labels" else inputs.categories,
        categories=_categories(evidence, inputs.categories) if tracked else None,
        backend=inputs.backend,
        executor=inputs.executor,
        progress=inputs.progress,
    )
    if found.classes is None or evidence.kind != "labels":
        return found.objects
    return found.classes


def _categories(
    evidence: TrackedEvidence, table: ClassTable | None
) -> Mapping[int, Mapping[int, float]]:
    """How many pixels under each track were taken for which class."""
    if table is None:
        raise InputError(
            f"{evidence.folder}: expected a table of classes to tell what tracks are of, and "
            "neither the capture nor the evidence has one."
        )
    ids = {row.name: row.id for row in table.rows}
    return {
        track.id: {ids[name]: float(votes) for name, votes in track.votes.items() if name in ids}
        for track in evidence.tracks
    }


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
    backend: str = "auto",
    executor: Executor = LOCAL,
    progress: Callable[[int, int], None] | None = None,
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
        backend: Name of the rendering backend.
        executor: Where the views are worked on; the layers do not depend on it.
        progress: Called with the stages done and all there are.

    Raises:
        InputError: If there are no views, one has no label map, features or masks, or no pixel has
            a label.
        ShapeError: If maps, masks or features do not have their photograph's proportions.
    """

    def tell(stage: int) -> None:
        if progress is not None:
            progress(stage, 4)

    found = uplift(
        gaussians,
        views,
        evidence,
        options=UpliftOptions(candidates=CANDIDATES),
        classes=classes,
        backend=backend,
        executor=executor,
    )
    tell(1)
    instances = associate(gaussians, views, masks, backend=backend, executor=executor)
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
            backend=backend,
            executor=executor,
        )
        scales = distilled.scales[-1:]
        weights = distilled.weights
    tell(3)
    info = replace(found.info, method="object-classes", options=asdict(options))
    votes = replace(found, info=info)
    pooled = pool_objects(objects, votes, scales, weights)
    if categories is not None:
        objects, pooled = named_by_tracks(objects, pooled)
        pooled = with_categories(pooled, categories)
    probabilities = classify_objects(pooled)
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


@dataclass(frozen=True, slots=True, kw_only=True)
class SelfAgreement:
    """How much of the answer are a Gaussian's own votes, and why."""

    share: float
    """Lambda, in [0, 1]."""

    correlation: float | None
    heterogeneity: float


def own_share(options: ObjectLabelOptions, objects: Labels, votes: Labels) -> SelfAgreement:
    """Lambda, as given or from how the votes err.

    Args:
        options: The share, or the limits from which it follows.
        objects: Which object each Gaussian is of.
        votes: What label maps say of each, with candidates.
    """
    correlation, between = votes.info.view_correlation, heterogeneity(objects, votes)
    share = options.own_share
    if share is None:
        share = between / MAX_HETEROGENEITY - 1
        if correlation is not None:
            share = max(share, 1 - correlation / MAX_CORRELATION)
    return SelfAgreement(
        share=min(1.0, max(0.0, share)), correlation=correlation, heterogeneity=between
    )


def spread(
    objects: Labels,
    votes: Labels,
    pooled: PooledObjects,
    probabilities: Tensor,
    *,
    own: SelfAgreement,
    candidates: int,
) -> Labels:
    """Classes of objects on the Gaussians by their shares, and what own votes say.

    Args:
        objects: Which objects Gaussians are in.
        votes: What label maps say of each, with candidates.
        pooled: The objects whose classes are known.
        probabilities: Of their classes, rows of zeros where nothing is known of one.
        own: How much of the answer are own votes.
        candidates: Ids kept of each Gaussian; with 1 the layer is hard.

    Returns:
        The votes with the result for ids, candidates and shares.
    """
    count, width = len(objects), len(pooled.classes)
    total = torch.zeros(count, width + 1)
    left = torch.full((count,), 1 - own.share)
    for member, given in _memberships(objects):
        row = torch.searchsorted(pooled.ids, member).clamp_max(len(pooled.ids) - 1)
        there = (member != UNLABELLED) & (pooled.ids[row] == member)
        there &= probabilities[row].sum(dim=1) > 0
        share = torch.where(there, given, 0.0) * (1 - own.share)
        total[:, :width] += probabilities[row].float() * share[:, None]
        left -= share
    left = left.clamp_min(0) + own.share
    relabelled = votes
    if votes.candidates is not None and votes.candidates.shape[1] > 1:
        relabelled = correct_confusion(votes, view_correlation=votes.info.view_correlation)
    if relabelled.candidates is None or relabelled.shares is None:
        raise TypeError("votes: expected a soft layer.")
    for rank in range(relabelled.candidates.shape[1]):
        ids = relabelled.candidates[:, rank].cpu().long().contiguous()
        column = torch.searchsorted(pooled.classes, ids).clamp_max(width - 1)
        column = torch.where(ids == UNLABELLED, width, column)
        share = relabelled.shares[:, rank].cpu().float() * left
        total.scatter_add_(1, column[:, None], share[:, None])
    details = {
        **votes.info.details,
        "own_share": round(own.share, 4),
        "heterogeneity": round(own.heterogeneity, 4),
    }
    info = replace(votes.info, details=details)
    return _kept(total[:, :width], pooled, replace(votes, info=info), candidates)


def _memberships(objects: Labels) -> Iterator[tuple[Tensor, Tensor]]:
    """Objects that Gaussians are in, with their shares, of which the sum is at most 1."""
    if objects.candidates is None or objects.shares is None:
        yield objects.ids.cpu().long(), torch.ones(len(objects))
        return
    members, shares = objects.candidates.cpu().long().T, objects.shares.cpu().float().T
    # Shares that were solved for each by itself may add up to more than 1.
    shares = shares / shares.sum(dim=0).clamp_min(1.0)
    yield from zip(members.contiguous(), shares.contiguous(), strict=True)


def _kept(
    shares: Float[Tensor, "n classes"], pooled: PooledObjects, votes: Labels, candidates: int
) -> Labels:
    """The most likely ids."""
    kept = min(candidates, shares.shape[1])
    # Stable: of equals the one with the smaller id.
    order = torch.sort(shares, dim=1, descending=True, stable=True)
    best, column = order.values[:, :kept], order.indices[:, :kept]
    ids = torch.where(best > 0, pooled.classes[column], UNLABELLED).int()
    return replace(
        votes,
        ids=ids[:, 0],
        confidence=best[:, 0].clamp(0, 1),
        candidates=ids if candidates > 1 else None,
        shares=best if candidates > 1 else None,
    )


METHOD = Method(
    name="object-classes",
    summary="labels that contradict each other, decided object by object by votes and likeness",
    reference="docs/decisions/cosseg.md; PLDA (Ioffe 2006), EM (Dempster et al. 1977)",
    evidence=("labels", "tracked", "panoptic"),
    options=ObjectLabelOptions,
    run=run,
    keeps_ids=True,
    repairs=True,
    companions={"features": ("features",), "masks": ("masks", "panoptic", "tracked")},
)
