"""Digests tell apart what differs, and nothing that only moved."""

from dataclasses import replace
from pathlib import Path

import torch

from splatseg.core import Camera
from splatseg.io.digests import camera_numbers, digest, file_mark


def test_digests_depend_on_values_their_order_and_their_ends() -> None:
    assert digest([1, "a"]) == digest(iter((1, "a")))
    assert len({digest(v) for v in (["ab"], ["a", "b"], ["b", "a"], [1], ["1"], [])}) == 6


def test_every_number_of_a_camera_counts() -> None:
    one = Camera(width=4, height=3, fx=4, fy=5, cx=2, cy=1.5, cam_from_world=torch.eye(4))
    moved = torch.eye(4)
    moved[0, 3] = 1e-6
    others = [
        replace(one, width=5), replace(one, fy=5.5), replace(one, cx=2.5),
        replace(one, cam_from_world=moved),
    ]  # fmt: skip
    assert all(camera_numbers(other) != camera_numbers(one) for other in others)
    assert camera_numbers(replace(one, fx=4.0)) == camera_numbers(one)


def test_files_are_told_by_size_and_beginning_wherever_they_lie(tmp_path: Path) -> None:
    first, second = tmp_path / "a", tmp_path / "b"
    first.write_bytes(b"x" * 10)
    second.write_bytes(b"x" * 10)
    assert file_mark(first) == file_mark(second)
    second.write_bytes(b"x" * 9 + b"y")
    assert file_mark(first) != file_mark(second)
    second.write_bytes(b"x" * 11)
    assert file_mark(first) != file_mark(second)
    assert file_mark(tmp_path / "none") == (0, "")
    assert file_mark(None) is None
