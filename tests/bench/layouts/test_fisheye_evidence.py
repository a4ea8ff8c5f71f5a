"""Evidence of photographs that were taken again through a fisheye lens, as layouts are written."""

import json
from dataclasses import replace

import cv2
import numpy as np
import torch
from PIL import Image

from splatseg.core import Camera, Rle
from support.benchmark_layouts.fisheye import fisheye_inside, through_fisheye
from support.benchmark_layouts.source import Source, read_source


def seen_at(source: Source, lens: Camera, u: float, v: float) -> tuple[float, float]:
    """The pixel of the photograph that a pixel of the fisheye image sees, by our own camera."""
    point = lens.unproject(torch.tensor([[u, v]]).double(), torch.ones(1).double())
    pinhole = replace(source.views[0].camera, cam_from_world=lens.cam_from_world)
    x, y = pinhole.project(point)[0][0].tolist()
    return x, y


def test_features_masks_and_ids_go_through_the_lens(generated_room, tmp_path) -> None:
    source = read_source(generated_room)
    camera = source.views[0].camera
    lens = fisheye_inside(camera)
    rows, columns = camera.height // 8, camera.width // 8
    # Cells whose channels are their own place, which a mixture of neighbours keeps.
    v, u = np.mgrid[0:rows, 0:columns]
    np.savez(tmp_path / "a.npz", f=np.stack((u, v), -1).astype(np.int8))
    through_fisheye(tmp_path / "a.npz", tmp_path / "b.npz", source, lens)
    with np.load(tmp_path / "b.npz") as archive:
        found = archive["f"]
    ids = np.zeros((camera.height, camera.width), np.uint8)
    cv2.circle(ids, (camera.width // 3, camera.height // 3), 30, 7, -1)
    Image.fromarray(ids).save(tmp_path / "a.png")
    through_fisheye(tmp_path / "a.png", tmp_path / "b.png", source, lens)
    run = Rle.encode(torch.from_numpy(ids > 0))
    size = [camera.height, camera.width]
    rle = {"size": size, "counts": run.to_coco()}
    one = {"segmentation": rle, "area": run.area, "bbox": [0.0, 0.0, 1.0, 1.0]}
    (tmp_path / "a.json").write_text(json.dumps({"masks": [one]}))
    through_fisheye(tmp_path / "a.json", tmp_path / "b.json", source, lens)
    bent = np.asarray(Image.open(tmp_path / "b.png"))
    assert set(np.unique(bent)) == {0, 7}
    (row,) = json.loads((tmp_path / "b.json").read_text())["masks"]
    mask = Rle.from_coco(row["segmentation"]["counts"], height=size[0], width=size[1]).decode()
    assert np.array_equal(mask.numpy(), bent > 0)
    assert row["area"] == int((bent > 0).sum()) != run.area
    for i, j in ((2, 3), (rows // 2, columns // 2), (rows - 3, 4)):
        x, y = seen_at(source, lens, 8 * j + 4, 8 * i + 4)
        assert abs(found[i, j] - (np.array([x, y]) / 8 - 0.5)).max() <= 0.51
    for i in range(4, camera.height, 37):
        for j in range(4, camera.width, 41):
            x, y = seen_at(source, lens, j + 0.5, i + 0.5)
            around = ids[max(int(y) - 1, 0) : int(y) + 2, max(int(x) - 1, 0) : int(x) + 2]
            assert bent[i, j] in around
