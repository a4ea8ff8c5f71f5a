"""The building: rooms side by side, doors that can be looked through, and views of every room."""

import pytest
import torch

from splatseg.errors import RangeError
from splatseg.synthetic import building, cameras, cast, room

STEP = torch.tensor([5.4, 4.4])
"""From one room to the next: 5.2 x 4.2 m and the wall between."""


def hit(scene, origin: list[float], towards: list[float]) -> tuple[float, str]:
    """How far it is to what is met, and what that is."""
    way = torch.tensor(towards, dtype=torch.float64) - torch.tensor(origin, dtype=torch.float64)
    way = way / way.norm()
    distance, which = cast(scene, torch.tensor(origin, dtype=torch.float64), way[None])
    solid = scene.primitives[int(which)]
    return float(distance), next(o.name for o in scene.objects if o.id == solid.instance)


def test_rooms_are_in_a_grid_and_ids_are_unique():
    scene = building(2, rooms=7)
    assert len(scene.rooms) == 7
    lows = torch.tensor([low[:2] for low, _ in scene.rooms]) - torch.tensor(scene.rooms[0][0][:2])
    places = (lows / STEP).round().int().tolist()
    assert places == [[0, 0], [1, 0], [2, 0], [0, 1], [1, 1], [2, 1], [0, 2]]
    torch.testing.assert_close(lows, torch.tensor(places) * STEP)
    assert [o.id for o in scene.objects] == list(range(1, len(scene.objects) + 1))
    assert len({o.name for o in scene.objects}) == len(scene.objects)
    assert {p.instance for p in scene.primitives} == {o.id for o in scene.objects}
    for item in scene.objects:
        if item.parent is not None:
            own = item.name.rsplit(" of room ", 1)[1]
            assert scene.objects[item.parent - 1].name.endswith(f" of room {own}")
    sides = torch.tensor(scene.bounds[1]) - torch.tensor(scene.bounds[0])
    torch.testing.assert_close(sides, torch.tensor([3 * 5.4 - 0.2, 3 * 4.4 - 0.2, 2.5]))


def test_doors_are_open_and_walls_are_not():
    scene = building(5, rooms=4)
    for i, j, axis in ((0, 1, 0), (2, 3, 0), (0, 2, 1), (1, 3, 1)):
        low, high = (torch.tensor(scene.rooms[i][k]) for k in range(2))
        along = 0.5 if axis == 0 else 1.95
        eye, target = ((low + high) / 2).tolist(), ((low + high) / 2).tolist()
        eye[1 - axis] = target[1 - axis] = eye[1 - axis] + along
        eye[2] = target[2] = 1.9
        eye[axis], target[axis] = float(high[axis]) - 0.3, float(high[axis]) + 3
        distance, name = hit(scene, eye, target)
        assert distance > 0.3 + 0.2 + 0.9, "nothing is in the door or before it"
        assert name.endswith(f"of room {j + 1}")
        # Its jamb is there, and 0.1 beside it the wall of this room.
        for aside, thick in ((0.44, False), (0.55, True), (-0.55, True)):
            beside, beyond = list(eye), list(target)
            beside[1 - axis] += aside
            beyond[1 - axis] += aside
            distance, name = hit(scene, beside, beyond)
            assert (distance < 0.31) == thick
        above = [*eye[:2], 2.2]
        assert hit(scene, above, [*target[:2], 2.2])[0] == pytest.approx(0.3, abs=1e-6)


def test_a_room_without_neighbours_is_a_room():
    scene, own = building(1, rooms=1), room(seed=0)
    assert len(scene.objects) == len(own.objects)
    assert scene.bounds == own.bounds
    assert len(scene.primitives) == len(own.primitives)


def test_every_room_has_its_share_of_the_views_inside_of_it():
    scene = building(4, rooms=3)
    views = cameras(scene, train=10, test=4, width=32, height=24)
    assert [v.name for v in views[9:12]] == ["train_0009", "test_0000", "test_0001"]
    inside = [
        [
            bool(
                (
                    (v.camera.centre > torch.tensor(low)) & (v.camera.centre < torch.tensor(high))
                ).all()
            )
            for low, high in scene.rooms
        ]
        for v in views
    ]
    assert [row.index(True) for row in inside] == [0] * 3 + [1] * 3 + [2] * 4 + [0, 1, 2, 2]
    for view in views:
        near = (p for p in scene.primitives if bool(p.contains(view.camera.centre[None], 0.25)))
        assert not any(near)


def test_the_seed_decides():
    assert building(4, rooms=2).primitives == building(4, rooms=2).primitives
    first, second = (building(seed, rooms=2).primitives for seed in (4, 5))
    assert first != second
    alike = {(p.shape, p.texture) for p in building(4, rooms=1).primitives}
    assert alike != {(p.shape, p.texture) for p in building(5, rooms=1).primitives}


def test_a_building_has_rooms():
    for wrong in (0, 101):
        with pytest.raises(RangeError, match="rooms"):
            building(rooms=wrong)
