"""Poses of drawn photographs against where they were really taken from."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from splatseg.errors import FileFormatError, InputError
from splatseg.pose import (
    LeftOut,
    PoseOptions,
    PoseProgress,
    PoseReport,
    PoseResult,
    load_pose_report,
    recover_poses,
)

# Smaller than the photographs: intrinsics have to come back to the photographs' own pixels.
OPTIONS = PoseOptions(longest=400, threads=1)


@pytest.fixture(scope="module")
def folder(room: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The photographs, some stored turned, with a broken and an empty one among them."""
    folder = tmp_path_factory.mktemp("photographs")
    for i in range(7):
        room.save(i, folder / f"p{i}.png", orientation=(1, 6, 3)[i % 3])
    Image.new("RGB", (room.width, room.height), (90, 90, 90)).save(folder / "plain.png")
    (folder / "broken.jpg").write_bytes(b"\xff\xd8\xff\xe0 this is not a photograph")
    return folder


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the result is kept."""
    return tmp_path_factory.mktemp("scene") / "capture"


@pytest.fixture(scope="module")
def stages() -> list[str]:
    """Stages that the work told of."""
    return []


@pytest.fixture(scope="module")
def result(folder: Path, kept: Path, stages: list[str]) -> PoseResult:
    """The poses."""

    def note(now: PoseProgress) -> None:
        if now.stage not in stages:
            stages.append(now.stage)

    return recover_poses(folder, folder=kept, options=OPTIONS, progress=note)


def test_poses_of_turned_photographs_are_those_of_upright_ones(
    result: PoseResult, room: Any
) -> None:
    names = [view.name for view in result.capture.views]
    assert names == [f"p{i}" for i in range(7)]
    room.check(result.capture, list(range(7)))


def test_points_reproject_into_the_photographs_own_pixels(result: PoseResult, room: Any) -> None:
    """The colour of a point is that of the photographs where the camera says it is seen."""
    capture = result.capture
    assert capture.points is not None
    assert capture.points.colours is not None
    view = capture.views[3]
    upright = room.pictures[3]
    pixels, depth = view.camera.project(capture.points.points.double())
    inside = (depth > 0) & (pixels > 2).all(-1)
    inside &= (pixels < torch.tensor([room.width - 2, room.height - 2])).all(-1)
    at = pixels[inside].floor().long().numpy()
    seen = upright[at[:, 1], at[:, 0]].astype(float)
    colours = capture.points.colours[inside].numpy().astype(float)
    assert len(at) > 50
    assert np.median(np.abs(seen - colours)) < 15
    shuffled = np.random.default_rng(0).permutation(colours)
    assert np.median(np.abs(seen - shuffled)) > 25


def test_the_report_names_what_was_left_out_and_why(result: PoseResult, room: Any) -> None:
    report = result.report
    assert report.photographs == 9
    assert report.registered == tuple(f"p{i}.png" for i in range(7))
    why = {left.name: left.why for left in report.left_out}
    assert set(why) == {"broken.jpg", "plain.png"}
    assert "cannot be read" in why["broken.jpg"] or "expected an image" in why["broken.jpg"]
    assert "features" in why["plain.png"]
    assert 0 < report.error < 1
    assert report.points == len(result.capture.points or [])
    assert report.track_length > 2
    assert report.mapper in {attempt.mapper for attempt in report.tries}
    (lens,) = report.lenses
    assert (lens.width, lens.height, lens.photographs) == (room.width, room.height, 7)
    assert lens.start == "guess"
    assert set(report.seconds) == {"copies", "features", "matches", "mapping", "finish"}
    assert PoseReport.from_json(json.loads(json.dumps(report.as_json()))) == report


def test_every_eighth_photograph_is_held_out(result: PoseResult) -> None:
    assert [view.name for view in result.capture.test_views] == ["p0"]
    assert result.capture.format == "sfm"


def test_the_stages_are_told(result: PoseResult, stages: list[str]) -> None:
    assert result.report.registered
    assert stages[:4] == ["copies", "features", "matches", "mapping"]


def test_a_second_run_reads_what_the_first_one_kept(
    result: PoseResult, folder: Path, kept: Path
) -> None:
    assert sorted(entry.name for entry in kept.iterdir()) == ["poses.json", "sparse"]
    told: list[str] = []
    again = recover_poses(
        folder, folder=kept, options=OPTIONS, progress=lambda now: told.append(now.stage)
    )
    assert again.reused
    assert not result.reused
    assert not told
    assert again.report == result.report
    for one, other in zip(again.capture.views, result.capture.views, strict=True):
        assert torch.equal(one.camera.cam_from_world, other.camera.cam_from_world)
        assert (one.name, one.image, one.split) == (other.name, other.image, other.split)


def test_other_tools_find_their_own_model(result: PoseResult, kept: Path, room: Any) -> None:
    """sparse/0 is COLMAP's, in pixels of the upright photographs."""
    from splatseg.io.captures.colmap_model import read_colmap_model

    assert result.report.registered
    model = read_colmap_model(kept / "sparse" / "0")
    assert {image.name for image in model.images.values()} == set(result.report.registered)
    assert {(c.model, c.width, c.height) for c in model.cameras.values()} == {
        ("OPENCV", room.width, room.height)
    }


@pytest.fixture(scope="module")
def shuffled(room: Any, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[int]]:
    """The photographs under names whose order says nothing."""
    order = [4, 0, 6, 2, 5, 1, 3]
    folder = tmp_path_factory.mktemp("shuffled")
    for i, which in enumerate(order):
        room.save(which, folder / "images" / f"q{i}.png")
    return folder, order


def test_unordered_photographs_are_found_by_their_looks_the_same_in_every_run(
    shuffled: tuple[Path, list[int]], room: Any
) -> None:
    folder, order = shuffled
    options = replace(OPTIONS, matching="retrieval", overlap=1, neighbours=3, mapper="incremental")
    first = recover_poses(folder, options=options)
    assert first.report.mapper == "incremental"
    room.check(first.capture, order)
    assert first.capture.path == folder
    assert all(view.image is not None and view.image.is_file() for view in first.capture.views)
    second = recover_poses(folder, options=options)
    for one, other in zip(first.capture.views, second.capture.views, strict=True):
        assert torch.equal(one.camera.cam_from_world, other.camera.cam_from_world)
        assert one.camera.fx == other.camera.fx
    assert first.capture.points is not None
    assert second.capture.points is not None
    assert torch.equal(first.capture.points.points, second.capture.points.points)


def test_photographs_of_different_things_are_refused(
    rng: np.random.Generator, tmp_path: Path
) -> None:
    folder, kept = tmp_path / "noise", tmp_path / "capture"
    folder.mkdir()
    for i in range(3):
        Image.fromarray(rng.integers(0, 255, (120, 160, 3), np.uint8)).save(folder / f"{i}.png")
    with pytest.raises(InputError, match=r"at least 3 can be placed, got 0 of 3; photograph the"):
        recover_poses(folder, folder=kept, options=OPTIONS)
    assert list(kept.iterdir()) == []


@pytest.mark.parametrize(("most", "everything"), [(7, False), (8, True)])
def test_all_pairs_are_compared_up_to_a_number_of_photographs(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, most: int, everything: bool
) -> None:
    """Of eight that can be read; the job goes as far as the choice of pairs."""
    from splatseg.pose import _recover, _worker

    compared: list[str] = []
    monkeypatch.setattr(_worker.Job, "_match_pairs", lambda *_, **__: compared.append("all"))
    monkeypatch.setattr(_worker.Job, "_match_likely", lambda *_: compared.append("likely"))
    monkeypatch.setattr(_worker.Job, "_look_again", lambda _: None)

    def match(job: dict[str, Any], *_: object, **__: object) -> None:
        _worker.Job(job)._match()
        raise InputError("far enough")

    monkeypatch.setattr(_recover, "run_worker", match)
    options = replace(OPTIONS, exhaustive_up_to=most)
    with pytest.raises(InputError, match="far enough"):
        recover_poses(folder, folder=tmp_path / "capture", options=options)
    assert compared == ["all" if everything else "likely"]


@pytest.mark.parametrize(
    "report",
    [None, [], {}, {"error": "small"}, {"seconds": {"match": "long"}}, {"lenses": [{"width": 8}]}],
)
def test_a_damaged_report_of_poses_names_its_file(tmp_path, report) -> None:
    sound = PoseReport(
        photographs=2, registered=("a.jpg",), left_out=(LeftOut(name="b.jpg", why="dark"),),
        mapper="glomap", tries=(), error=0.5, longest=1600, points=9, track_length=2.5, lenses=(),
        seconds={"match": 1.5},
    )  # fmt: skip
    file = tmp_path / "poses.json"
    content = {"format": "splatseg-poses", "version": 1, "made_of": "x", "report": sound.as_json()}
    file.write_text(json.dumps(content))
    assert load_pose_report(tmp_path) == load_pose_report(tmp_path, made_of="x") == sound
    assert load_pose_report(tmp_path, made_of="y") is None
    damaged = {**sound.as_json(), **report} if report else report
    file.write_text(json.dumps({**content, "report": damaged}))
    with pytest.raises(FileFormatError, match=r"poses\.json: expected the report of poses"):
        load_pose_report(tmp_path)
