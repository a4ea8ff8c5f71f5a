"""Further views of three squares whose instances are known."""

from dataclasses import replace

import torch

from splatseg.core import InstanceTree, LabelMap, Labels, MaskSet, Rle
from splatseg.methods.associate import AssociateOptions, associate
from splatseg.methods.associate._update import _with_new, with_views
from splatseg.render import render

from .test_associate import BACKEND, BORDERS, GAUSSIANS, TRUTH, VIEWS, Segments, columns, mapped
from .test_associated_tree import LEFT, MIDDLE, NESTED, RIGHT, nested, sets, tree_of

OLD, NEW = VIEWS[:2], VIEWS[2:]


def hugging(source: Segments) -> Segments:
    """The segments without pixels at which nothing is: strips are wider than the squares."""
    found: dict[str, LabelMap | MaskSet] = {}
    for view in VIEWS:
        covered = render(GAUSSIANS, view.camera, backend=BACKEND).alpha > 0.5
        segments = source.of[view.name]
        if isinstance(segments, LabelMap):
            found[view.name] = LabelMap(ids=torch.where(covered, segments.ids, -1))
        else:
            masks = tuple(Rle.encode(mask.decode() & covered) for mask in segments.masks)
            found[view.name] = replace(segments, masks=masks)
    return replace(source, of=found)


def updated(layer, source, views=NEW, told=None):
    source = hugging(source)
    level = "tree" if isinstance(layer, InstanceTree) else "object"

    def associated(found, of):
        return associate(
            GAUSSIANS, of, found, options=AssociateOptions(level=level), backend=BACKEND
        )

    return with_views(
        layer,
        GAUSSIANS,
        views,
        source,
        associated=associated,
        longest_side=640,
        backend=BACKEND,
        progress=None if told is None else lambda *now: told.append(now),
    )


def test_known_nodes_get_the_votes_of_further_views() -> None:
    before = tree_of(nested(), views=OLD)
    told: list[tuple[int, int]] = []
    after = updated(before, nested(), told=told)
    assert isinstance(after, InstanceTree)
    assert after.nodes == before.nodes
    assert torch.equal(after.labels.ids, before.labels.ids)
    seen = before.labels.ids > 0
    assert bool((after.labels.evidence[seen] > 1.2 * before.labels.evidence[seen]).all())
    assert told == [(1, 2), (2, 2)]


def without(layer: InstanceTree, rows) -> InstanceTree:
    """The tree before anything was known of some Gaussians, as where they are new."""
    gone = torch.zeros(len(layer), dtype=torch.bool)
    gone[list(rows)] = True
    labels = layer.labels
    emptied = {
        name: column.masked_fill(gone.reshape(-1, *[1] * (column.ndim - 1)), labels.COLUMNS[name])
        for name, column in labels.columns().items()
    }
    return replace(layer, labels=replace(labels, **emptied))


def test_gaussians_that_are_new_get_the_node_that_their_mask_is() -> None:
    """One of each half of the left square; the other tells which half the masks are."""
    whole = tree_of(nested(), views=OLD)
    after = updated(without(whole, (0, 1)), nested())
    assert after.labels.ids.tolist() == whole.labels.ids.tolist()
    assert sets(after.cut()) == {LEFT, MIDDLE, RIGHT}


def test_what_no_node_explains_becomes_a_node_where_nothing_was() -> None:
    """The right square was in no view before: its nodes and labels are not there."""
    old = tree_of(nested({view.name: NESTED[:7] for view in OLD}), views=OLD)
    assert sets(old.cut()) == {LEFT, MIDDLE}
    old = without(old, RIGHT)
    after = updated(old, nested())
    assert sets(after.cut()) == {LEFT, MIDDLE, RIGHT}
    assert after.nodes[: len(old.nodes)] == old.nodes
    (new,) = after.nodes[len(old.nodes) :]
    assert new.id == max(node.id for node in old.nodes) + 1
    assert new.name == f"object {new.id}"
    assert torch.equal(after.cut().ids[:8], old.cut().ids[:8])


def test_what_is_something_else_already_is_no_part_of_a_new_thing() -> None:
    def labels(ids: list[int]) -> Labels:
        known = torch.tensor(ids, dtype=torch.int32)
        return Labels(ids=known, confidence=(known > 0).float(), evidence=(known > 0).float())

    known = labels([1, -1, -1, 1, 1, -1])
    after = _with_new(known, known, labels([7, 7, 7, 9, 9, 9]))
    assert isinstance(after, Labels)
    # Of 9 most are of 1 already: it is no new thing.
    assert after.ids.tolist() == [1, 2, 2, 1, 1, -1]
    assert after.confidence.tolist() == [1, 1, 1, 1, 1, 0]
    assert dict(after.info.names) == {2: "object 2"}


def test_a_part_is_meant_only_within_the_object_that_the_pixel_shows() -> None:
    """By masks of halves alone the parts of the left square lie in the middle one."""
    from splatseg.core import LabelMap
    from splatseg.methods.associate._update import _NodeMaps, _objects

    tree = tree_of(nested(), views=OLD)
    objects, parts = tree.cut("object").ids, tree.cut("part").ids
    left, part, stranger = int(objects[0]), int(parts[0]), int(parts[4])

    class Fixed:
        def __init__(self, ids: list[int]) -> None:
            self.ids = torch.tensor([ids], dtype=torch.int32)

        def label_map(self, name: str) -> LabelMap:
            return LabelMap(ids=self.ids)

    maps = _NodeMaps(
        objects=_objects(tree),
        matched=(Fixed([left, left, left, -1]), Fixed([part, stranger, -1, part])),  # pyright: ignore[reportArgumentType]
    )
    assert maps.label_map("v0").ids.tolist() == [[part, left, left, -1]]


def test_no_mask_that_is_a_node_is_a_change_of_nothing() -> None:
    before = tree_of(nested(), views=OLD)
    after = updated(before, nested({view.name: () for view in NEW}))
    assert after.nodes == before.nodes
    assert torch.equal(after.labels.ids, before.labels.ids)
    assert torch.equal(after.labels.evidence, before.labels.evidence)


def test_label_maps_of_further_views_are_added_to_labels() -> None:
    maps = {
        view.name: mapped(columns(view, *BORDERS), [5 + i, 15 + i, 25 + i])
        for i, view in enumerate(VIEWS)
    }
    before = associate(GAUSSIANS, OLD, Segments(maps), backend=BACKEND)
    assert isinstance(before, Labels)
    after = updated(before, Segments(maps))
    assert isinstance(after, Labels)
    assert torch.equal(after.ids, before.ids)
    named = {int(i) for i in after.ids[: len(TRUTH)]}
    assert len(named) == 3
    # A square that labels do not have becomes one more of them.
    lacking = replace(
        before,
        ids=torch.where(before.ids == before.ids[11], -1, before.ids),
        evidence=torch.where(before.ids == before.ids[11], 0.0, before.evidence),
        confidence=torch.where(before.ids == before.ids[11], 0.0, before.confidence),
    )
    again = updated(lacking, Segments(maps))
    assert torch.equal(again.ids[:8], before.ids[:8])
    (new,) = {int(i) for i in again.ids[8:12]}
    assert new == int(lacking.ids.max()) + 1
    assert again.info.names[new] == f"object {new}"
