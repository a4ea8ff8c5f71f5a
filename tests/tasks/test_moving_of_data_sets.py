"""Boxes of data sets as commands are given them, on the clock that is asked for."""

import numpy as np
import pytest

from splatseg.tasks.moving import moving_things
from support.kitti import DRIVE, stored_box, write, write_boxes, write_drive


@pytest.mark.parametrize(("clock", "start"), [("frames", 2.5), ("recorded", None)])
def test_boxes_are_on_the_clock_that_is_asked_for(tmp_path, clock, start) -> None:
    write_boxes(write_drive(tmp_path), stored_box(1, np.diag([4.0, 2, 1, 1]), 3))
    times = [f"2013-05-28 08:46:{2 + i:02d}.500000000" for i in range(6)]
    write(tmp_path / f"data_3d_raw/{DRIVE}/velodyne_points/timestamps.txt", "\n".join(times))
    things = moving_things(tmp_path, (), clock)
    assert things is not None
    (box,) = things.boxes
    assert box.start == start if clock == "frames" else box.start > 1e9
