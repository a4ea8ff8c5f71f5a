"""Pixels as rays: directions of any lens, label maps of any size, ids without a table."""

from dataclasses import replace
from pathlib import Path

import torch

from splatseg.core import LabelMap
from splatseg.io.evidence import create_evidence, open_evidence, save_label_map
from splatseg.street.training_rays import label_ids, training_rays
from street.radiance.scene import IDS, photograph, views


def test_directions_are_those_of_the_cameras_lens_included() -> None:
    bent = [
        replace(view, camera=replace(view.camera, model="opencv", distortion=(0.1 * i, 0.01)))
        for i, view in enumerate(views())
    ]
    rays = training_rays(bent, None, IDS, read=lambda _: torch.ones(8, 12, 3))
    assert len(rays) == 288
    found = rays.directions(torch.arange(288))
    expected = []
    for i, view in enumerate(bent):
        all_directions = view.camera.rays()[1].reshape(-1, 3)
        expected.append(all_directions[rays.pixels[96 * i : 96 * i + 96].long()])
        assert torch.allclose(rays.view_directions(i), expected[-1], atol=1e-12)
    assert torch.allclose(found.double(), torch.cat(expected), atol=1e-6)
    assert len(rays.planes) == 3 * 96


def test_one_lens_is_kept_once() -> None:
    one = training_rays(views(), None, IDS, read=photograph)
    assert len(one.planes) == 96
    assert bool((one.columns == -1).all())


def test_label_maps_of_another_size_are_read_at_centres_of_pixels(tmp_path: Path) -> None:
    folder = create_evidence(tmp_path / "labels", kind="labels")
    small = torch.tensor([[IDS[0], IDS[1]], [IDS[2], -1]])
    save_label_map(LabelMap(ids=small), folder, "view0")
    evidence = open_evidence(folder)
    assert label_ids(views(), evidence) == tuple(sorted(IDS))
    rays = training_rays(views()[:1], evidence, IDS, read=photograph)
    columns = rays.columns.view(8, 12)
    assert columns[:4, :6].unique().tolist() == [0]
    assert columns[:4, 6:].unique().tolist() == [1]
    assert columns[4:, :6].unique().tolist() == [2]
    assert columns[4:, 6:].unique().tolist() == [-1]
