"""What we export comes back as it was."""

from pathlib import Path

import numpy as np
import torch

from splatseg.io.annotations import AnnotationEvidence, open_annotations
from splatseg.io.export import Category, Frame, SegmentInfo, write_coco_panoptic
from support.annotations import HEIGHT, WIDTH, views_of

IDS = (5, 300, 70_000)
CATEGORIES = [
    Category(id=1, name="chair", isthing=True, colour=(1, 2, 3)),
    Category(id=9, name="wall", isthing=False, colour=(0, 0, 9)),
]


def test_coco_panoptic(tmp_path: Path, rng: np.random.Generator) -> None:
    """Segments of all views, ids above 16 bits among them, and their classes."""
    maps = {n: rng.choice([-1, *IDS], (HEIGHT, WIDTH)) for n in ("left/a", "b", "empty")}
    maps["empty"][:] = -1
    frames = (Frame(name=n, image=f"{n}.jpg", ids=torch.from_numpy(m)) for n, m in maps.items())
    segments = {id: SegmentInfo(category_id=9 if id == 300 else 1) for id in IDS}
    write_coco_panoptic(frames, tmp_path / "coco", segments=segments, categories=CATEGORIES)
    evidence = open_annotations(tmp_path / "coco", views=views_of(*maps))
    assert isinstance(evidence, AnnotationEvidence)
    assert evidence.view_names == ("b", "empty", "left/a")
    labels = evidence.as_kind("labels")
    assert labels.classes is not None
    assert {row.id: row.name for row in labels.classes.rows} == {1: "chair", 9: "wall"}
    for name, ids in maps.items():
        places = {segment.id: segment for segment in evidence.segments(name)}
        assert len(places) == (0 if name == "empty" else 3)
        assert [places[i].isthing for i in sorted(places)] == [True, False, True][: len(places)]
        own = np.array([-1, *IDS])[evidence.label_map(name).ids.numpy().clip(0)]
        assert np.array_equal(own, ids)
        classes = labels.label_map(name).ids.numpy()
        assert np.array_equal(classes, np.where(ids == 300, 9, np.where(ids > 0, 1, -1)))
