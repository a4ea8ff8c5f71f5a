"""The room, the views of it, start points, machine labels."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch

from splatseg.errors import InputError, RangeError
from splatseg.synthetic import cameras, look_at, machine_labels, room, start_points


def test_the_room_is_furnished():
    scene = room(seed=3)
    used = {item.class_id for item in scene.objects}
    assert len(used) == len(scene.classes.rows) == 16
    assert len(scene.objects) >= 25
    assert len({item.name for item in scene.objects}) == len(scene.objects)
    assert {solid.instance for solid in scene.primitives} == {o.id for o in scene.objects}
    names = {row.name for row in scene.classes.rows}
    assert all(set(group) <= names for group in scene.related_classes)
    ids = {item.id for item in scene.objects}
    assert all(item.parent in ids for item in scene.objects if item.parent is not None)


def test_the_seed_decides():
    assert room(seed=4).primitives == room(seed=4).primitives
    assert room(seed=4).primitives != room(seed=5).primitives


@pytest.mark.parametrize("seed", range(6))
def test_cameras_stand_free_inside_every_room(seed):
    scene = room(seed=seed)
    views = cameras(scene, train=20, test=5, width=32, height=24)
    assert [v.name for v in views[:2]] == ["train_0000", "train_0001"]
    assert [v.split for v in views].count("test") == 5
    low, high = torch.tensor(scene.bounds[0]), torch.tensor(scene.bounds[1])
    for view in views:
        centre = view.camera.centre
        assert bool(((centre > low) & (centre < high)).all())
        assert not any(bool(s.contains(centre.unsqueeze(0), 0.25)) for s in scene.primitives)
    again = cameras(scene, train=20, test=5, width=32, height=24)
    for a, b in zip(views, again, strict=True):
        assert torch.equal(a.camera.cam_from_world, b.camera.cam_from_world)
    places = torch.stack([v.camera.centre for v in views])
    assert float(torch.pdist(places).min()) > 0.01


def test_everything_is_seen_often_enough_to_be_learnt(small_room, small_truths):
    seen = np.zeros(len(small_room.objects) + 1, dtype=int)
    for name, truth in small_truths.items():
        if name.startswith("train"):
            seen[truth.instance.unique().numpy()] += 1
    assert seen[1:].min() >= 3, [o.name for o in small_room.objects if seen[o.id] < 3]


def test_look_at_puts_the_target_in_the_middle():
    camera = look_at((1, 2, 3), (0, 0, 1), width=80, height=60, field_of_view=90.0)
    pixels, depth = camera.project(torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, 1.1]]).double())
    torch.testing.assert_close(pixels[0], torch.tensor([40.0, 30.0]).double())
    assert float(depth[0]) == pytest.approx(3.0)
    assert float(pixels[1, 1]) < 30.0  # up in the world is up in the image
    assert camera.fx == pytest.approx(40.0)
    with pytest.raises(RangeError, match="^target"):
        look_at((0, 0, 1), (0, 0, 0), width=8, height=8)


def test_start_points_lie_on_surfaces_that_three_views_see(small_views, small_truths):
    cloud = start_points(small_views, small_truths, count=1500, seed=1)
    assert len(cloud) == 1500
    seen = torch.zeros(1500)
    error = torch.full((1500,), torch.inf)
    for view in small_views:
        if view.split != "train":
            continue
        pixels, depth = view.camera.project(cloud.points.double())
        u, v = pixels.floor().long().unbind(-1)
        inside = (u >= 0) & (u < 96) & (v >= 0) & (v < 72) & (depth > 0)
        at = small_truths[view.name].depth[v.clamp(0, 71), u.clamp(0, 95)]
        off = torch.where(inside, (at - depth).abs(), torch.inf)
        error = torch.minimum(error, off)
        # Noise of 1.2 cm and the slope within a pixel.
        seen += off < 0.12
    assert float((seen >= 3).float().mean()) > 0.97
    assert float(error.median()) < 0.012
    assert cloud.colours is not None
    assert float(cloud.colours.float().std(dim=0).min()) > 10


def test_start_points_carry_the_stated_noise(small_views, small_truths):
    """The same draw without noise is not public, so look at a plane: the floor."""
    cloud = start_points(small_views, small_truths, count=4000)
    height = cloud.points[:, 2]
    floor = height[(height.abs() < 0.05)]
    # Rug and skirting boards lie a little above the floor.
    below = floor[floor < 0]
    assert 0.008 < float((below**2).mean().sqrt()) < 0.016


def test_start_points_need_a_train_view(small_views, small_truths):
    with pytest.raises(InputError, match="train view"):
        start_points([v for v in small_views if v.split == "test"], small_truths)


def test_labels_without_severity_are_the_truth(small_room, small_truths):
    labels = machine_labels(small_room, small_truths, severity=0.0)
    for name, truth in small_truths.items():
        assert torch.equal(labels[name], truth.semantic)


def test_labels_are_wrong_to_the_stated_degree(small_room, small_truths):
    known = {row.id for row in small_room.classes.rows}
    right = {}
    for severity in (0.3, 1.0, 2.0):
        labels = machine_labels(small_room, small_truths, seed=1, severity=severity)
        same = [float((labels[n] == t.semantic).float().mean()) for n, t in small_truths.items()]
        right[severity] = float(np.mean(same))
        assert all(set(ids.unique().tolist()) <= known for ids in labels.values())
    assert right[0.3] > right[1.0] > right[2.0]
    assert 0.80 < right[1.0] < 0.95


def test_labels_depend_on_seed_and_nothing_else(small_room, small_truths):
    one = machine_labels(small_room, small_truths, seed=1)
    again = machine_labels(small_room, dict(reversed(small_truths.items())), seed=1)
    other = machine_labels(small_room, small_truths, seed=2)
    assert all(torch.equal(one[n], again[n]) for n in one)
    assert not all(torch.equal(one[n], other[n]) for n in one)


def test_whole_segments_take_the_same_wrong_class_in_several_views(small_room, small_truths):
    """Errors are correlated: an object that is mistaken is mistaken for one class."""
    labels = machine_labels(small_room, small_truths, seed=0, severity=1.5)
    taken: dict[int, list[int]] = {}
    for name, truth in small_truths.items():
        for instance in truth.instance.unique().tolist():
            segment = truth.instance == instance
            own = small_room.class_of(instance)
            ids, counts = labels[name][segment].unique(return_counts=True)
            most = int(ids[counts.argmax()])
            if most != own and segment.sum() > 60 and counts.max() > 0.8 * segment.sum():
                taken.setdefault(instance, []).append(most)
    often = [choices for choices in taken.values() if len(choices) >= 3]
    assert often
    agree = [sum(a == b for a, b in itertools.combinations(c, 2)) for c in often]
    pairs = [len(c) * (len(c) - 1) / 2 for c in often]
    assert sum(agree) / sum(pairs) > 0.8


def test_void_stays_void(small_room, small_truths):
    name, truth = next(iter(small_truths.items()))
    semantic = truth.semantic.clone()
    semantic[:20] = -1
    instance = truth.instance.clone()
    instance[:20] = -1
    cut = replace(truth, semantic=semantic, instance=instance)
    labels = machine_labels(small_room, {name: cut}, seed=3)[name]
    assert bool((labels[:20] == -1).all())


def test_severity_has_a_range(small_room, small_truths):
    with pytest.raises(RangeError, match="^severity"):
        machine_labels(small_room, small_truths, severity=3.0)
