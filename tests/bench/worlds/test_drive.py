"""The generated drive of `support.drive`: the layout of a street, read by the project's readers."""

import json

import numpy as np
import torch
from PIL import Image
from torch.nn.functional import max_pool2d

from splatseg.io.captures import read_capture
from splatseg.io.evidence import open_evidence
from splatseg.io.scans import read_scans


def test_a_drive_is_a_capture_with_scans_and_evidence(generated_drive):
    capture = read_capture(generated_drive)
    assert capture.format == "nerfstudio"
    assert [view.split for view in capture.views].count("test_novel") == 1
    assert len(capture.train_views) == 10
    assert len(capture.test_views) == 2
    assert capture.points is not None
    assert len(capture.points) == 3000
    assert capture.metres_per_unit == 1.0
    scans = read_scans(generated_drive)
    assert scans.scan_names == ("0000", "0001", "0002")
    labels = open_evidence(generated_drive / "labels_semantic")
    assert set(labels.view_names) == {view.name for view in capture.train_views}
    assert scans.classes == capture.classes


def test_depth_and_scans_lie_on_the_same_surfaces(generated_drive):
    """What the laser meets may be hidden from a camera, but floats before nothing it sees."""
    capture, scans = read_capture(generated_drive), read_scans(generated_drive)
    unit = json.loads((generated_drive / "metadata.json").read_text())["depth"]["unit_m"]
    points = torch.cat([scans.scan(name).points for name in scans.scan_names])
    close = floating = 0
    for view in capture.views:
        with Image.open(generated_drive / "depth" / f"{view.name}.png") as opened:
            depth = torch.from_numpy(np.array(opened).astype(np.float64) * unit)
        pixels, z = view.camera.project(points)
        half = pixels / 2
        inside = (z > 0.5) & ((half >= 0) & (half < half.new_tensor([48, 32]))).all(dim=1)
        column, row = half[inside].long().unbind(dim=1)
        far = depth.where(depth > 0, 100.0)
        low, high = (-max_pool2d(-far[None], 3, 1, 1)[0], max_pool2d(far[None], 3, 1, 1)[0])
        near = z[inside] > 0.97 * low[row, column] - 0.05
        close += int((near & (z[inside] < 1.03 * high[row, column] + 0.05)).sum())
        floating += int((~near).sum())
    assert close > 10_000
    assert floating < 0.01 * close


def test_the_sky_has_a_class_in_label_maps(generated_drive):
    capture = read_capture(generated_drive)
    assert capture.classes is not None
    sky = capture.classes.by_name("sky").id
    for kind in ("semantic", "labels_semantic"):
        with Image.open(generated_drive / kind / "train_0000.png") as opened:
            ids = np.array(opened)
        assert (ids[:4] == sky).mean() > 0.2
        assert (ids[-4:] == sky).sum() == 0
        assert ids.min() > 0
    scans = read_scans(generated_drive)
    assert sky not in scans.scan("0000").labels["semantic"].tolist()
