r"""Panoptic labels: a layer of instances and a layer of classes, merged.

An instance has the class that most of the evidence on its Gaussians speaks for,

.. math:: c_k = \arg\max_c \sum_{i \in k} e_i\, s_i\, [c_i = c]

with the evidence e and the confidence s of the layer of classes. Instances of things stay, with
the ids they have. Everything else is stuff: one segment a class, whatever instances it was cut
into. A Gaussian of no instance whose class is one of things goes to the instance of that class
that most of its neighbours belong to, where there is one among them, and otherwise has no label:
a thing that no mask saw is not counted as one.

References:
    Kirillov et al., Panoptic Segmentation (2019), section 4.1: things and stuff.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float, Int64
from numpy.typing import NDArray
from torch import Tensor

from splatseg._check import check_rows
from splatseg.core import UNLABELLED, ClassTable, Gaussians, InstanceFacts, Labels, LayerInfo
from splatseg.core.boundary import boundary
from splatseg.errors import InputError
from splatseg.neighbours import NeighbourIndex

_NEIGHBOURS = 12
"""Labelled Gaussians that a stray one asks."""


@boundary
def merge_panoptic(
    gaussians: Gaussians, instances: Labels, classes: Labels, table: ClassTable
) -> Labels:
    """Merge instances and classes into panoptic labels.

    Args:
        gaussians: The Gaussians of the scene.
        instances: A layer of instances; ids need not be those of anything else.
        classes: A layer of classes, in the ids of `table`.
        table: Which classes are things. A class that it does not know is stuff.

    Returns:
        The layer: things with their ids in `instances`, stuff with ids above them. Its info has
        the class and the name of each segment, what is known of each instance, and the edit
        ``merge_panoptic``, which says how many instances were stuff. Confidence is that of the
        layer a label came from.

    Raises:
        ShapeError: If a layer has not one row a Gaussian.
        InputError: If the layer of classes has no label.

    Example:
        >>> n = 4
        >>> g = Gaussians(means=torch.arange(12.).reshape(4, 3), scales=torch.ones(4, 3),
        ...               rotations=torch.eye(4)[:1].expand(4, 4), opacities=torch.ones(4),
        ...               sh=torch.rand(4, 1, 3))
        >>> from splatseg.core import ClassInfo
        >>> table = ClassTable(rows=(ClassInfo(id=1, name="floor", isthing=False),
        ...                          ClassInfo(id=2, name="cup")))
        >>> one = torch.ones(4)
        >>> cups = Labels(ids=torch.tensor([5, 5, 9, -1]), confidence=one)
        >>> kinds = Labels(ids=torch.tensor([2, 2, 1, 1]), confidence=one)
        >>> merge_panoptic(g, cups, kinds, table).ids
        tensor([ 5,  5, 10, 10], dtype=torch.int32)
    """
    for name, layer in (("instances", instances), ("classes", classes)):
        check_rows(f"{name}", layer, len(gaussians))
    kinds = classes.ids.cpu().long()
    if not bool((kinds != UNLABELLED).any()):
        raise InputError("classes: expected a layer with labels, got one without.")
    own = instances.ids.cpu().long()
    things = {row.id for row in table.rows if row.isthing}
    class_of = _classes(own, kinds, _say(classes))
    kept = {id: kind for id, kind in class_of.items() if kind in things}
    is_thing = torch.isin(own, torch.tensor(sorted(kept), dtype=torch.int64))
    ids = torch.where(is_thing, own, UNLABELLED)
    ids = _adopted(gaussians, ids, kinds, kept, things)
    stuff, numbered = _numbered_stuff(kinds, ids, classes.background, own, things)
    ids = torch.where(ids == UNLABELLED, stuff, ids)
    return replace(
        classes,
        ids=ids.int(),
        confidence=_chosen(is_thing, instances.confidence, classes.confidence, ids),
        candidates=None,
        shares=None,
        evidence=_either(is_thing, instances.evidence, classes.evidence),
        effective_views=_either(is_thing, instances.effective_views, classes.effective_views),
        inferred=_either(is_thing, instances.inferred, classes.inferred),
        background=numbered.get(classes.background, UNLABELLED),
        info=_segments(instances.info, kept, numbered, table).with_edit(
            "merge_panoptic",
            {
                "things": len(kept),
                "stuff": len(numbered),
                "instances_of_stuff": len(class_of) - len(kept),
                "classes_by": classes.info.method or "unknown",
            },
        ),
    )


def _say(classes: Labels) -> Float[Tensor, "n"]:
    """What each Gaussian's class counts."""
    say = classes.confidence.double().cpu()
    if classes.evidence is not None:
        say = say * classes.evidence.double().cpu()
    return say


def _classes(
    own: Int64[Tensor, "n"], kinds: Int64[Tensor, "n"], say: Float[Tensor, "n"]
) -> dict[int, int]:
    """The class of each instance, -1 where none of its Gaussians has one."""
    found = dict.fromkeys(torch.unique(own[own != UNLABELLED]).tolist(), UNLABELLED)
    both = (own != UNLABELLED) & (kinds != UNLABELLED)
    pairs, place = torch.unique(torch.stack((own[both], kinds[both])), dim=1, return_inverse=True)
    sums = torch.zeros(pairs.shape[1], dtype=torch.float64).index_add_(0, place, say[both])
    # By votes, the most last; of equals the smaller class last.
    order = np.lexsort((-pairs[1].numpy(), sums.numpy()))
    return found | dict(pairs[:, torch.from_numpy(order)].T.tolist())


def _adopted(
    gaussians: Gaussians,
    ids: Int64[Tensor, "n"],
    kinds: Int64[Tensor, "n"],
    class_of: Mapping[int, int],
    things: set[int],
) -> Int64[Tensor, "n"]:
    """Gaussians of things without an instance join the one of their class that is around them."""
    stray = (ids == UNLABELLED) & torch.isin(kinds, torch.tensor(sorted(things)))
    asked = torch.nonzero(stray).squeeze(1)
    known = torch.nonzero(ids != UNLABELLED).squeeze(1)
    if not len(asked) or not len(known):
        return ids
    means = gaussians.means.cpu()
    count = min(_NEIGHBOURS, len(known))
    near = NeighbourIndex(means[known]).nearest(means[asked], count).indices
    names = ids[known][near].numpy()
    fits = _kinds_of(names, class_of) == kinds[asked].numpy()[:, None]
    # The commonest among the neighbours that fit; of equals the one that came nearest.
    votes = ((names[:, :, None] == names[:, None, :]) & fits[:, :, None]).sum(axis=1)
    best = np.where(fits, votes, -1).argmax(axis=1)
    rows = np.arange(len(asked))
    out = ids.clone()
    chosen = np.where(fits.any(axis=1), names[rows, best], UNLABELLED)
    out[asked] = torch.from_numpy(chosen)
    return out


def _kinds_of(names: NDArray[np.int64], class_of: Mapping[int, int]) -> NDArray[np.int64]:
    known = np.array(sorted(class_of))
    return np.array([class_of[id] for id in known.tolist()])[np.searchsorted(known, names)]


def _numbered_stuff(
    kinds: Int64[Tensor, "n"],
    ids: Int64[Tensor, "n"],
    background: int,
    own: Int64[Tensor, "n"],
    things: set[int],
) -> tuple[Int64[Tensor, "n"], dict[int, int]]:
    """Segment ids of stuff by Gaussian (-1 for none), and by class."""
    left = torch.unique(kinds[(ids == UNLABELLED) & (kinds != UNLABELLED)]).tolist()
    found = sorted({*left, background} - things - {UNLABELLED})
    first = max(0, int(own.max())) + 1 if len(own) else 1
    numbered = {kind: first + place for place, kind in enumerate(found)}
    out = torch.full_like(kinds, UNLABELLED)
    for kind, id in numbered.items():
        out[kinds == kind] = id
    return out, numbered


def _chosen(is_thing: Tensor, first: Tensor, second: Tensor, ids: Tensor) -> Tensor:
    both = torch.where(is_thing, first.cpu(), second.cpu())
    return torch.where(ids == UNLABELLED, 0.0, both)


def _either(is_thing: Tensor, first: Tensor | None, second: Tensor | None) -> Tensor | None:
    """Of things the instances' column, of others the classes'; None unless both have it."""
    if first is None or second is None:
        return None
    return torch.where(is_thing, first.cpu(), second.cpu())


def _segments(
    info: LayerInfo, kept: Mapping[int, int], numbered: Mapping[int, int], table: ClassTable
) -> LayerInfo:
    """The record of the instances, with the segments that there are now."""
    things = dict(sorted(kept.items()))
    stuff = {id: kind for kind, id in numbered.items()}
    facts = {id: info.instances.get(id, InstanceFacts()) for id in things}
    return replace(
        info,
        names={id: f"{table.name_of(kind)} {id}" for id, kind in things.items()}
        | {id: table.name_of(kind) for id, kind in stuff.items()},
        class_of=things | stuff,
        instances=facts | {id: InstanceFacts(stuff=True) for id in stuff},
    )
