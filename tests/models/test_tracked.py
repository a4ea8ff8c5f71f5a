"""Seeds followed through views: which views say what, in which order, and what is written.

The tracker is scripted: it follows colours. A red square moves to the right by 4 pixels a view, a
blue one stands still and is there from view 3 on, so that all is known by hand.
"""

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar

import pytest
import torch

from splatseg.core import FeatureMap, LabelMap, MaskSet, Segment, Track
from splatseg.core.scene import ClassInfo, ClassTable
from splatseg.errors import InputError, ShapeError
from splatseg.io.evidence import (
    TrackedEvidence,
    create_evidence,
    evidence_header,
    open_evidence,
    save_features,
    save_label_map,
    save_masks,
    save_segments,
    save_tracks,
)
from splatseg.models import (
    EvidenceRequest,
    TrackingOptions,
    find_model,
    record_evidence,
)

from .conftest import view_of

HEIGHT, WIDTH, COUNT = 24, 48, 8
RED, BLUE = (200, 0, 0), (0, 0, 200)
CLASSES = ClassTable(rows=(ClassInfo(id=3, name="cup"), ClassInfo(id=4, name="desk")))


class ByColour:
    """Follows what has the colour that was marked last under an id."""

    name, note = "by-colour", ""
    settings: ClassVar[dict[str, Any]] = {}

    def __init__(self) -> None:
        self.seen: list[str] = []

    def track(self, frames, seeds) -> Iterator[tuple[str, LabelMap]]:
        colours: dict[int, torch.Tensor] = {}
        for name, image in frames:
            self.seen.append(name)
            seed = seeds.get(name)
            if seed is not None:
                for id in seed.ids.unique().tolist():
                    if id != -1:
                        colours[id] = image[seed.ids == id].mode(dim=0).values
            ids = torch.full(image.shape[:2], -1, dtype=torch.int32)
            for id in sorted(colours, reverse=True):
                ids[(image == colours[id]).all(-1)] = id
            if seed is not None:
                ids = torch.where(seed.ids != -1, seed.ids, ids)
            yield name, LabelMap(ids=ids)


def red(view: int) -> torch.Tensor:
    where = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    where[4:10, 2 + 4 * view : 8 + 4 * view] = True
    return where


def blue(view: int) -> torch.Tensor:
    where = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    where[14:20, 20:28] = view >= 3
    return where


def wanted(view: int, *, red_id: int = -1, blue_id: int = -1) -> list[list[int]]:
    ids = torch.full((HEIGHT, WIDTH), -1, dtype=torch.int32)
    ids[red(view)], ids[blue(view)] = red_id, blue_id
    return ids.tolist()


@pytest.fixture
def moving(tmp_path):
    """Eight views of the two squares, v0 to v7."""
    (tmp_path / "images").mkdir()
    views = []
    for i in range(COUNT):
        image = torch.full((HEIGHT, WIDTH, 3), 90, dtype=torch.uint8)
        image[red(i)], image[blue(i)] = torch.tensor([RED, BLUE], dtype=torch.uint8)
        views.append(view_of(tmp_path / "images" / f"v{i}.png", image))
    return tuple(views)


@pytest.fixture
def masks(tmp_path):
    """Masks of all views: blue, where it is there, before red."""
    folder = create_evidence(tmp_path / "masks", kind="masks")
    for i in range(COUNT):
        dense = torch.stack([mask for mask in (blue(i), red(i)) if bool(mask.any())])
        save_masks(MaskSet.from_dense(dense), folder, f"v{i}")
    return open_evidence(folder)


def labels(folder: Path, **maps: torch.Tensor):
    create_evidence(folder, kind="labels", classes=CLASSES)
    for name, ids in maps.items():
        save_label_map(LabelMap(ids=ids.int()), folder, name)
    return open_evidence(folder)


def followed(views, folder: Path, seeds, *, model=None, overwrite: bool = False, **options):
    model = model or ByColour()
    seen = record_evidence(
        model,
        views,
        folder,
        EvidenceRequest(seeds=seeds, tracking=TrackingOptions(**options), overwrite=overwrite),
    )
    return model, seen, open_evidence(folder)


def maps_of(evidence) -> list[list[list[int]]]:
    return [evidence.label_map(f"v{i}").ids.tolist() for i in range(COUNT)]


def test_new_seeds_are_matched_to_what_is_tracked(moving, masks, tmp_path) -> None:
    """In view 3 blue is mask 1 and red mask 2; red stays track 1 and blue becomes track 2."""
    model, seen, found = followed(moving, tmp_path / "t", masks, seed_every=3)
    assert isinstance(found, TrackedEvidence)
    assert maps_of(found) == [
        wanted(i, red_id=1, blue_id=2 if i >= 3 else -1) for i in range(COUNT)
    ]
    assert model.seen == ["v0", "v1", "v2", "v3", "v3", "v4", "v5", "v6", "v6", "v7"]
    assert found.order == tuple(f"v{i}" for i in range(COUNT))
    assert found.tracks == (Track(id=1, votes={}), Track(id=2, votes={}))
    assert (seen.kind, seen.views, seen.kept, seen.masks) == ("tracked", COUNT, 0, None)
    assert seen.notes == ("2 tracks, from seeds of 3 views (v0, v3, v6).",)
    recorded = evidence_header(tmp_path / "t")["metadata"]
    assert recorded["what"] == "tracked"
    assert recorded["complete"] is True
    assert recorded["tracking"]["seeds"] == "masks"
    assert recorded["tracking"]["seeded_views"] == ["v0", "v3", "v6"]
    assert recorded["tracking"]["seed_every"] == 3


def test_seeds_of_the_first_view_alone(moving, masks, tmp_path) -> None:
    model, _, found = followed(moving, tmp_path / "t", masks, seed_every=None)
    assert maps_of(found) == [wanted(i, red_id=1) for i in range(COUNT)]
    assert model.seen == [f"v{i}" for i in range(COUNT)]
    assert len(found.tracks) == 1


def test_the_default_is_every_fifth_view(moving, masks, tmp_path) -> None:
    _, _, found = followed(moving, tmp_path / "t", masks)
    assert maps_of(found) == [
        wanted(i, red_id=1, blue_id=2 if i >= 5 else -1) for i in range(COUNT)
    ]


def test_what_overlaps_too_little_is_new(moving, tmp_path) -> None:
    """In view 4 the mask of red is half of what is tracked."""
    folder = create_evidence(tmp_path / "m", kind="masks")
    half = red(4)
    half[7:] = False
    save_masks(MaskSet.from_dense(red(0)[None]), folder, "v0")
    save_masks(MaskSet.from_dense(half[None]), folder, "v4")
    seeds = open_evidence(folder)
    _, _, same = followed(moving, tmp_path / "a", seeds, seed_every=2, seed_iou=0.5)
    assert [track.id for track in same.tracks] == [1]
    _, _, other = followed(moving, tmp_path / "b", seeds, seed_every=2, seed_iou=0.51)
    assert [track.id for track in other.tracks] == [1, 2]
    ids = other.label_map("v4").ids
    assert bool((ids[half] == 2).all())
    assert bool((ids[red(4) & ~half] == 1).all()), "the track goes on beside the new seed"


def test_views_before_the_first_seed_are_gone_through_backwards(moving, tmp_path) -> None:
    folder = create_evidence(tmp_path / "m", kind="masks")
    save_masks(MaskSet.from_dense(torch.stack((blue(4), red(4)))), folder, "v4")
    model, seen, found = followed(moving, tmp_path / "t", open_evidence(folder))
    assert model.seen == ["v4", "v5", "v6", "v7", "v4", "v3", "v2", "v1", "v0"]
    assert maps_of(found) == [wanted(i, red_id=2, blue_id=1) for i in range(COUNT)]
    assert found.order == tuple(f"v{i}" for i in range(COUNT))
    folder = create_evidence(tmp_path / "blue", kind="masks")
    save_masks(MaskSet.from_dense(blue(4)[None]), folder, "v4")
    _, seen, _ = followed(moving, tmp_path / "u", open_evidence(folder))
    assert seen.notes[1] == "3 of 8 views show none (v2, v1, v0)."


def test_ids_that_mean_the_same_in_all_views_stay(moving, tmp_path) -> None:
    """Labels of two views by hand: no matching, whatever they overlap."""
    one, two = torch.full((HEIGHT, WIDTH), -1), torch.full((HEIGHT, WIDTH), -1)
    one[red(0)] = 4
    two[blue(5)] = 3
    seeds = labels(tmp_path / "l", v0=one, v5=two)
    model, _, found = followed(moving, tmp_path / "t", seeds, seed_every=1)
    assert model.seen == [f"v{i}" for i in range(COUNT)]
    assert maps_of(found) == [
        wanted(i, red_id=4, blue_id=3 if i >= 5 else -1) for i in range(COUNT)
    ]
    assert found.tracks == (Track(id=3, votes={"cup": 48}), Track(id=4, votes={"desk": 36}))
    assert [row.name for row in found.classes.rows] == ["cup 3", "desk 4"]
    _, _, sparse = followed(moving, tmp_path / "u", seeds, seed_every=6)
    assert [track.id for track in sparse.tracks] == [4]


def test_tracks_can_be_followed_again(moving, tmp_path) -> None:
    ids = torch.full((HEIGHT, WIDTH), -1)
    ids[red(2)] = 30
    folder = create_evidence(tmp_path / "s", kind="tracked", classes=CLASSES)
    save_label_map(LabelMap(ids=ids.int()), folder, "v2")
    save_tracks([Track(id=30, votes={"cup": 5})], folder, order=["v2"])
    _, _, found = followed(moving, tmp_path / "t", open_evidence(folder))
    assert maps_of(found) == [wanted(i, red_id=30) for i in range(COUNT)]
    assert found.tracks == (Track(id=30, votes={"cup": 36}),)


def test_classes_of_segments_are_counted_under_the_tracks(moving, tmp_path) -> None:
    """Red is a cup in view 0, 36 pixels, and in view 5 a desk."""
    folder = create_evidence(tmp_path / "p", kind="panoptic", classes=CLASSES)
    rows = {}
    for name, view, red_class in (("v0", 0, 3), ("v5", 5, 4)):
        ids = torch.full((HEIGHT, WIDTH), -1)
        ids[red(view)], ids[blue(view)] = 9, 2
        save_label_map(LabelMap(ids=ids.int()), folder, name)
        rows[name] = [
            Segment(id=9, category=red_class, isthing=True, score=1.0),
            Segment(id=2, category=4, isthing=True, score=1.0),
        ]
    save_segments(rows, folder)
    _, _, found = followed(moving, tmp_path / "t", open_evidence(folder))
    votes = {track.id: dict(track.votes) for track in found.tracks}
    assert votes == {9: {"cup": 36, "desk": 36}, 10: {"desk": 48}}
    assert found.maps.table is not None
    assert [row.name for row in found.maps.table.rows] == ["cup", "desk"]


def test_levels_and_areas_of_seeds(moving, tmp_path) -> None:
    folder = create_evidence(tmp_path / "m", kind="masks")
    save_masks(MaskSet.from_dense(torch.stack((blue(4), red(4))), levels=[1, 0]), folder, "v4")
    seeds = open_evidence(folder)
    _, _, found = followed(moving, tmp_path / "a", seeds, seed_level=1)
    assert maps_of(found) == [wanted(i, blue_id=1) for i in range(COUNT)]
    _, _, found = followed(moving, tmp_path / "b", seeds, seed_area=40 / (HEIGHT * WIDTH))
    assert maps_of(found) == [wanted(i, blue_id=1) for i in range(COUNT)]


def test_along_the_path_of_the_cameras(moving, masks, tmp_path) -> None:
    """All cameras stand in one place here: the first by name, and then as names go."""
    model, _, found = followed(moving[::-1], tmp_path / "t", masks, view_order="path")
    assert model.seen[:4] == ["v0", "v1", "v2", "v3"]
    recorded = evidence_header(tmp_path / "t")["metadata"]["tracking"]
    assert recorded["view_order"] == "path"
    assert found.order[0] == "v0"


class Stopped(ByColour):
    """Is stopped at a frame."""

    def __init__(self, name: str, error: BaseException) -> None:
        super().__init__()
        self._stop = name, error

    def track(self, frames, seeds):
        for name, ids in super().track(frames, seeds):
            if name == self._stop[0]:
                raise self._stop[1]
            yield name, ids


@pytest.mark.parametrize("error", [KeyboardInterrupt(), RuntimeError("no")])
def test_what_is_stopped_leaves_nothing(moving, masks, tmp_path, error) -> None:
    with pytest.raises(type(error)):
        followed(moving, tmp_path / "t", masks, model=Stopped("v4", error))
    assert not (tmp_path / "t").exists()
    assert not list(tmp_path.glob(".*"))
    _, whole, _ = followed(moving, tmp_path / "t", masks)
    with pytest.raises(type(error)):
        followed(moving, tmp_path / "t", masks, model=Stopped("v4", error), overwrite=True)
    kept = open_evidence(tmp_path / "t")
    assert len(kept.view_names) == COUNT
    assert not list(tmp_path.glob(".*"))
    assert whole.kept == 0


def test_what_was_killed_begins_again(moving, masks, tmp_path) -> None:
    """Half of the views are there, one of them as a tracker that saw less would have it."""
    followed(moving, tmp_path / "whole", masks, seed_every=3)
    shutil.copytree(tmp_path / "whole", tmp_path / "killed")
    header = json.loads((tmp_path / "killed" / "evidence.json").read_text())
    header["metadata"]["complete"] = False
    (tmp_path / "killed" / "evidence.json").write_text(json.dumps(header))
    (tmp_path / "killed" / "tracks.json").unlink()
    for i in range(5, COUNT):
        (tmp_path / "killed" / f"v{i}.png").unlink()
    nothing = LabelMap(ids=torch.full((HEIGHT, WIDTH), -1, dtype=torch.int32))
    save_label_map(nothing, tmp_path / "killed", "v2")
    with pytest.raises(InputError, match="seed_every 3 there, 2 now"):
        followed(moving, tmp_path / "killed", masks, seed_every=2)
    assert (tmp_path / "killed" / "v4.png").is_file(), "other work is not thrown away"
    _, seen, _ = followed(moving, tmp_path / "killed", masks, seed_every=3)
    assert seen.kept == 0
    for path in (tmp_path / "whole").rglob("*"):
        assert path.read_bytes() == (tmp_path / "killed" / path.name).read_bytes(), path.name
    (tmp_path / "killed" / "evidence.json").write_text(json.dumps(header))
    stop = Stopped("v2", KeyboardInterrupt())
    with pytest.raises(KeyboardInterrupt):
        followed(moving, tmp_path / "killed", masks, model=stop, seed_every=3)
    with pytest.raises(InputError):
        open_evidence(tmp_path / "killed")
    _, seen, _ = followed(moving, tmp_path / "killed", masks, seed_every=3)
    assert seen.kept == 0


def test_what_is_whole_is_not_done_again(moving, masks, tmp_path) -> None:
    followed(moving, tmp_path / "t", masks)
    before = (tmp_path / "t" / "tracks.json").read_bytes()
    model, seen, found = followed(moving, tmp_path / "t", masks)
    assert (model.seen, seen.kept, seen.notes) == ([], COUNT, ())
    assert (tmp_path / "t" / "tracks.json").read_bytes() == before
    assert len(found.tracks) == 2
    with pytest.raises(InputError, match="seed_iou 0.5 there, 0.4 now"):
        followed(moving, tmp_path / "t", masks, seed_iou=0.4)
    save_masks(
        MaskSet.from_dense(red(0)[None, :, :] & (torch.arange(WIDTH) > 4)), masks.folder, "v0"
    )
    with pytest.raises(InputError, match="seeds_digest"):
        followed(moving, tmp_path / "t", masks)
    assert len(open_evidence(tmp_path / "t").view_names) == COUNT


def test_views_cannot_be_added_to_tracks(moving, masks, tmp_path) -> None:
    followed(moving[:5], tmp_path / "t", masks, seed_every=None)
    with pytest.raises(InputError, match="holds 5 of 8 views, and the others cannot be added"):
        followed(moving, tmp_path / "t", masks, seed_every=None)
    with pytest.raises(InputError, match="holds 2 views that are not asked for now"):
        followed(moving[:3], tmp_path / "t", masks, seed_every=None)


def test_what_does_not_go_together(moving, masks, tmp_path) -> None:
    model = ByColour()
    with pytest.raises(InputError, match="model 'by-colour': expected seeds, the name of evidence"):
        record_evidence(model, moving, tmp_path / "t")
    for what in ("masks", ["tracked", "masks"]):
        with pytest.raises(InputError, match=r"what it gives \(tracked\), got 'masks'"):
            record_evidence(model, moving, tmp_path / "t", EvidenceRequest(seeds=masks, what=what))
    with pytest.raises(InputError, match="seeds: expected with a tracker, got model 'classical'"):
        record_evidence(
            find_model("classical"), moving, tmp_path / "t", EvidenceRequest(seeds=masks)
        )
    one = labels(tmp_path / "l", v0=torch.full((HEIGHT, WIDTH), -1), v9=torch.ones(2, 2))
    with pytest.raises(InputError, match="expected seeds in at least one of 2 views, got none"):
        followed(moving[:2], tmp_path / "t", one)
    with pytest.raises(
        InputError, match="expected another folder than that of the evidence that is read"
    ):
        followed(moving, masks.folder, masks)
    assert not (tmp_path / "t").exists()
    assert model.seen == []


def test_tracks_and_masks_are_asked_for_apart(moving, masks, tmp_path) -> None:
    class Both(ByColour):
        def masks(self, image):
            return MaskSet.from_dense((image[..., 0] == RED[0])[None])

    with pytest.raises(InputError, match="what: expected tracked alone"):
        record_evidence(
            Both(), moving, tmp_path / "t", EvidenceRequest(seeds=masks, what=["tracked", "masks"])
        )
    with pytest.raises(InputError, match="seeds: expected with a tracker"):
        record_evidence(Both(), moving, tmp_path / "t", EvidenceRequest(seeds=masks, what="masks"))
    seen = record_evidence(Both(), moving, tmp_path / "t", EvidenceRequest(what="masks"))
    assert (seen.kind, seen.masks) == ("masks", COUNT)
    seen = record_evidence(
        Both(), moving, tmp_path / "u", EvidenceRequest(what="tracked", seeds=masks)
    )
    assert seen.kind == "tracked"


def test_features_are_no_seeds(moving, tmp_path) -> None:
    folder = create_evidence(tmp_path / "f", kind="features")
    one = FeatureMap(features=torch.zeros(3, 6, 2), stride=8, height=HEIGHT, width=WIDTH)
    save_features(one, folder, "v0")
    with pytest.raises(InputError, match=r"expected seeds \(masks, .*\), got features"):
        followed(moving, tmp_path / "t", open_evidence(folder))


def test_trackers_that_do_not_keep_step(moving, masks, tmp_path) -> None:
    class Short(ByColour):
        def track(self, frames, seeds):
            yield next(super().track(frames, seeds))

    class Ahead(ByColour):
        def track(self, frames, seeds):
            yield from list(super().track(frames, seeds))

    class Other(ByColour):
        def track(self, frames, seeds):
            for name, ids in super().track(frames, seeds):
                yield f"{name}!", ids

    class Small(ByColour):
        def track(self, frames, seeds):
            for name, ids in super().track(frames, seeds):
                yield name, LabelMap(ids=ids.ids[:5])

    def refused(model, words: str, error=InputError) -> None:
        with pytest.raises(error, match=words):
            followed(moving, tmp_path / "t", masks, model=model)
        assert not (tmp_path / "t").exists()

    refused(Short(), "a label map of each frame in turn, now of 'v1'; got none")
    refused(Ahead(), "a label map of each frame in turn, now of 'v5'; got none")
    refused(Other(), "now of 'v0'; got 'v0!'")
    refused(Small(), "view 'v0': expected 48x24 pixels .* got 48x5", ShapeError)


def test_seeds_are_there_while_their_view_is(moving, masks, tmp_path) -> None:
    """One label map at a time, however many views bring seeds."""
    most: list[int] = []

    class Counting(ByColour):
        def track(self, frames, seeds):
            for name, ids in super().track(frames, seeds):
                most.append(len(seeds))
                yield name, ids

    followed(moving, tmp_path / "t", masks, model=Counting(), seed_every=1)
    assert most == [1] + [0, 1] * (COUNT - 1)


def test_pictures_are_taken_one_at_a_time(moving, masks, tmp_path) -> None:
    """And in the order of the tracker; a progress is told of each."""
    taken: list[str] = []
    told: list[tuple[int, int]] = []

    def image_of(view):
        from splatseg.io.images import load_image

        taken.append(view.name)
        assert len(taken) <= len(told), "none before its view is due"
        return load_image(view)

    request = EvidenceRequest(seeds=masks, image_of=image_of)
    progress = lambda done, count: told.append((done, count))  # noqa: E731
    record_evidence(ByColour(), moving, tmp_path / "t", request, progress=progress)
    assert taken == [f"v{i}" for i in range(COUNT)]
    assert told == [(i, COUNT) for i in range(COUNT + 1)]
