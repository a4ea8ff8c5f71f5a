"""What of a capture and of its scans is a block's."""

from dataclasses import replace

import pytest
import torch

from splatseg.core import Camera, Capture, PointCloud, View
from splatseg.core.scans import Scan
from splatseg.errors import InputError
from splatseg.io.captures import read_capture
from splatseg.io.scans import read_scans
from splatseg.street.block_field import DriveScans, block_capture
from splatseg.street.blocks import DriveBlockOptions, cut_drive, frame_centres
from street.blocks.support import NumberedScans, straight


def capture_along(places: torch.Tensor, tmp_path, points: PointCloud | None = None) -> Capture:
    views = []
    for i, place in enumerate(places):
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, 3] = -place
        camera = Camera(width=4, height=4, fx=4, fy=4, cx=2, cy=2, cam_from_world=pose)
        split = "test" if i % 10 == 4 else "train"
        views.append(View(name=f"{i:04d}", camera=camera, split=split))
    return Capture(path=tmp_path, format="nerfstudio", views=tuple(views), points=points)


def test_views_of_an_overlap_are_of_both_blocks(tmp_path):
    places = straight(200.0, step=2.0)
    capture, drive = capture_along(places, tmp_path), cut_drive(places)
    parts = [block_capture(capture, drive, block) for block in drive.blocks]
    found = [[int(view.name) * 2 for view in part.views] for part in parts]
    # The overlap around 50 m is from 40 to 60, where weights reach 0.
    assert found[0] == list(range(0, 60, 2))
    assert found[1] == list(range(42, 110, 2))
    assert sorted({x for part in found for x in part}) == list(range(0, 201, 2))
    assert {view.split for view in parts[0].views} == {"train", "test"}


def test_start_points_are_those_in_reach(tmp_path):
    x = torch.arange(-100.0, 300.0, 5.0)
    cloud = PointCloud(
        points=torch.stack((x, 0 * x, 0 * x), dim=1),
        colours=(torch.arange(len(x)) % 256)[:, None].expand(-1, 3).byte(),
    )
    places = straight(200.0)
    capture, drive = capture_along(places, tmp_path, cloud), cut_drive(places)
    part = block_capture(capture, drive, drive.blocks[1])
    assert part.points is not None
    assert part.points.points[:, 0].tolist() == list(range(-20, 175, 5))
    assert part.points.colours is not None
    assert part.points.colours[0].tolist() == [16, 16, 16]
    far = cut_drive(places, options=DriveBlockOptions(reach=30.0))
    small = block_capture(capture, far, far.blocks[1])
    assert small.points is not None
    assert small.points.points[:, 0].tolist() == list(range(10, 145, 5))
    assert block_capture(replace(capture, points=None), drive, drive.blocks[0]).points is None


def test_a_drive_of_one_block_is_the_capture(generated_drive):
    capture = read_capture(generated_drive)
    drive = cut_drive(frame_centres(capture.train_views))
    part = block_capture(capture, drive, drive.blocks[0])
    assert [view.name for view in part.views] == [view.name for view in capture.views]
    assert part.points is not None
    assert capture.points is not None
    assert torch.equal(part.points.points, capture.points.points)
    scans = read_scans(generated_drive)
    own, to_label = (
        f(drive.blocks[0]) for f in (DriveScans(scans, drive).of, DriveScans(scans, drive).to_label)
    )
    for source in (own, to_label):
        assert source.scan_names == scans.scan_names
        for name in scans.scan_names:
            here, there = source.scan(name), scans.scan(name)
            assert torch.equal(here.points, there.points)
            assert torch.equal(here.labels["semantic"], there.labels["semantic"])
            ids = torch.arange(len(there), dtype=torch.int32)
            assert torch.equal(here.recorded_labels(ids), there.recorded_labels(ids))


def test_a_block_without_training_views_is_refused(tmp_path):
    places = straight(200.0)
    capture, drive = capture_along(places, tmp_path), cut_drive(places)
    views = [replace(v, split="test") if int(v.name) > 85 else v for v in capture.views]
    with pytest.raises(InputError, match=r"blocks: .* block 2 of 4 has none; longer blocks"):
        block_capture(replace(capture, views=tuple(views)), drive, drive.blocks[2])


def test_scans_are_of_the_blocks_where_they_were_measured():
    places = torch.tensor([[5.0, 0, 0], [45, 0, 0], [55, 0, 0], [95, 0, 0]])
    drive = cut_drive(straight(100.0, step=0.5), options=DriveBlockOptions(reach=20.0))
    assert len(drive) == 2
    scans = DriveScans(NumberedScans(places, spread=40.0), drive)
    assert [tuple(scans.of(block).scan_names) for block in drive.blocks] == [
        ("0000", "0001", "0002"),
        ("0001", "0002", "0003"),
    ]
    for block in drive.blocks:
        for name in scans.of(block).scan_names:
            part, whole = scans.of(block).scan(name), scans.scan(name)
            kept = drive.near(block, whole.points)
            assert 0 < int(kept.sum()) < len(whole)
            assert torch.equal(part.points, whole.points[kept])
            assert torch.equal(part.labels["semantic"], whole.labels["semantic"][kept])


def test_clouds_without_a_place_are_of_all_blocks_that_have_their_points():
    class Clouds:
        scan_names = ("cloud",)

        def scan(self, name: str) -> Scan:
            return Scan(name=name, points=straight(120.0))

    drive = cut_drive(straight(300.0), options=DriveBlockOptions(reach=20.0))
    scans = DriveScans(Clouds(), drive)
    assert [len(scans.of(block).scan_names) for block in drive.blocks] == [1, 1, 1, 0, 0]


def test_points_to_label_are_those_where_a_block_counts():
    places = straight(200.0, step=10.0)
    source = NumberedScans(places)
    drive = cut_drive(straight(200.0))
    scans = DriveScans(source, drive)
    assert scans.scan_names == source.scan_names
    for block in drive.blocks:
        part = scans.to_label(block)
        for name in part.scan_names:
            whole = source.scan(name)
            counts = drive.counts(block, whole.points)
            assert torch.equal(part.scan(name).points, whole.points[counts])
            share = part.share(name)
            assert torch.equal(share.rows, torch.nonzero(counts)[:, 0])
        with pytest.raises(InputError, match="there is no 'none' in this block"):
            part.scan("none")
    labelled = {name: set(scans.labelled_by(name)) for name in scans.scan_names}
    assert labelled["0000"] == {0}
    assert {0, 1} <= labelled["0005"]
