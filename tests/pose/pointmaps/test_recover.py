"""Photographs and pointmaps in, a capture out: from a folder, from a network, and begun again."""

import shutil
from dataclasses import dataclass, field, replace

import pytest
import torch

from splatseg.core import Pointmap, PointmapModel
from splatseg.errors import InputError, MissingFileError
from splatseg.io.pointmaps import open_pointmaps
from splatseg.pose import _pointmap_pixels, pointmaps
from splatseg.pose.pointmaps import PointmapOptions, recover_from_pointmaps
from splatseg_bench.worlds import PointmapErrors, SyntheticPointmaps
from support.pointmaps import PhotographedRoom, complete, window

WRONG = PointmapErrors(noise=0.02, warp=0.03, outliers=0.1)
FEW = PointmapOptions(max_points=4000)


@pytest.fixture(autouse=True)
def quick(monkeypatch) -> None:
    """Fewer pixels and steps."""
    monkeypatch.setattr(pointmaps, "_SAMPLES", 300)
    monkeypatch.setattr(pointmaps, "_ROBUST_ITERATIONS", 20)


@dataclass
class Network:
    """Answers for images, which it knows by what they show."""

    photographed: PhotographedRoom
    answers: SyntheticPointmaps
    name: str = "generated"
    note: str = ""
    asked: list[tuple[str, str]] = field(default_factory=list)

    @property
    def settings(self) -> dict[str, int]:
        return {"size": 96}

    def pointmaps(self, first: torch.Tensor, second: torch.Tensor) -> tuple[Pointmap, Pointmap]:
        # `PhotographedRoom.write` paints the place of a photograph into its third channel.
        names = tuple(self.photographed.names[int(one[0, 0, 2]) // 20] for one in (first, second))
        self.asked.append((names[0], names[1]))
        return self.answers.pointmaps(*names)


def _distance_to_surfaces(photographed: PhotographedRoom, capture) -> torch.Tensor:
    """Relative errors of the cloud's depths in a photograph, in the capture's own unit."""
    view = capture.views[0]
    pixels, depth = view.camera.project(capture.points.points.double())
    inside = (depth > 0) & (pixels >= 0).all(1) & (pixels < torch.tensor([96, 72])).all(1)
    columns, rows = pixels[inside].long().unbind(1)
    true = photographed.depths[view.image.name][rows, columns]
    ratio = depth[inside] / true
    near = ratio / ratio.median()
    return (near - 1).abs()


def test_a_recorded_folder_becomes_a_capture(tmp_path, photographed) -> None:
    photographs = photographed.write(tmp_path / "photos")
    source = photographed.record(tmp_path / "maps", complete(8), WRONG)
    found = recover_from_pointmaps(photographs, source, options=FEW)
    off = photographed.errors_of(photographed.cameras_of(found.capture))
    assert off.rotation.max() < 1.0
    assert off.centre.max() < 0.02
    assert abs(off.focal).max() < 0.01
    assert found.report.pairs == 56
    assert len(found.report.contradictory) == 6
    assert set(found.report.contradictory) == photographed.answers(complete(8), WRONG).outliers
    assert found.report.points == len(found.capture.points) == 4000
    assert float(_distance_to_surfaces(photographed, found.capture).median()) < 0.03
    assert [view.image.name for view in found.capture.test_views] == photographed.names[::8]
    assert not found.reused


def test_colours_are_those_of_the_photographs(tmp_path, photographed) -> None:
    photographs = photographed.write(tmp_path / "photos")
    source = photographed.record(tmp_path / "maps", complete(8))
    points = recover_from_pointmaps(photographs, source, options=FEW).capture.points
    third = points.colours[:, 2] // 20
    assert set(third.tolist()) == set(range(8))
    assert (points.colours[:, 0].int() + points.colours[:, 1].int() == 255).all()


def test_what_was_found_is_read_again_until_the_options_change(tmp_path, photographed) -> None:
    photographs = photographed.write(tmp_path / "photos")
    source = photographed.record(tmp_path / "maps", window(8, 2))
    kept = tmp_path / "capture"
    one = recover_from_pointmaps(photographs, source, folder=kept, options=FEW)
    two = recover_from_pointmaps(photographs, source, folder=kept, options=FEW)
    assert (one.reused, two.reused) == (False, True)
    assert two.report == one.report
    assert torch.equal(two.capture.points.points, one.capture.points.points)
    fewer = PointmapOptions(max_points=900)
    three = recover_from_pointmaps(photographs, source, folder=kept, options=fewer)
    assert not three.reused
    assert three.report.points == 900


def test_a_network_is_asked_once_for_each_pair(tmp_path, photographed) -> None:
    photographs = photographed.write(tmp_path / "photos")
    network = Network(photographed, photographed.answers(complete(8)))
    assert isinstance(network, PointmapModel)
    options = PointmapOptions(max_points=900, pairs="window", window=2)
    kept = tmp_path / "capture"
    found = recover_from_pointmaps(photographs, network, folder=kept, options=options)
    assert len(network.asked) == len(set(network.asked)) == found.report.pairs == 26
    assert open_pointmaps(kept / "pointmaps").metadata["model"] == "generated"
    # A run that was stopped after half of the pairs asks about the others alone.
    for path in sorted((kept / "pointmaps").glob("*.npz"))[::2]:
        path.unlink()
    (kept / "aligned.npz").unlink()
    network.asked.clear()
    again = recover_from_pointmaps(photographs, network, folder=kept, options=options)
    assert len(network.asked) == 13
    assert torch.equal(again.capture.points.points, found.capture.points.points)


def test_pairs_are_chosen_as_asked(tmp_path, photographed) -> None:
    photographs = photographed.write(tmp_path / "photos")
    source = photographed.record(tmp_path / "maps", complete(8))
    for name, count in (("reference", 14), ("window", 12), ("complete", 56)):
        options = PointmapOptions(max_points=100, pairs=name, window=1)
        wanted = 14 if name == "window" else count
        found = recover_from_pointmaps(photographs, source, options=options)
        assert found.report.pairs == wanted


def test_a_network_is_asked_about_all_pairs_or_about_those_that_look_alike(
    tmp_path, photographed, monkeypatch
) -> None:
    photographs = photographed.write(tmp_path / "photos")
    for complete_up_to, neighbours, pairs in ((8, 1, 56), (7, 1, 14)):
        network = Network(photographed, photographed.answers(complete(8)))
        monkeypatch.setattr(_pointmap_pixels, "_COMPLETE_UP_TO", complete_up_to)
        monkeypatch.setattr(_pointmap_pixels, "_NEIGHBOURS", neighbours)
        options = PointmapOptions(max_points=100)
        found = recover_from_pointmaps(photographs, network, options=options)
        # Shades without a feature look like nothing: each with the next by name is left.
        assert found.report.pairs == len(network.asked) == pairs


def test_pairs_that_are_missing_are_named(tmp_path, photographed) -> None:
    photographs = photographed.write(tmp_path / "photos")
    apart = photographed.record(tmp_path / "apart", [(0, 1), (1, 2), (3, 4), (5, 6), (6, 7)])
    with pytest.raises(InputError, match="connect all 8 photographs, got 3 parts"):
        recover_from_pointmaps(photographs, apart, options=FEW)
    alone = photographed.record(tmp_path / "alone", window(7, 1))
    with pytest.raises(InputError, match=f"got none with '{photographed.names[7]}'"):
        recover_from_pointmaps(photographs, alone, options=FEW)


def test_a_map_of_a_single_point_is_named_and_nothing_is_left(tmp_path, photographed) -> None:
    photographs = photographed.write(tmp_path / "photos")
    source = photographed.record(tmp_path / "maps", window(8, 1))
    first, second = photographed.names[3:5]
    one, two = source.pointmaps(first, second)
    source.save(first, second, (one, replace(two, points=torch.ones_like(two.points))))
    message = f"points of '{second}' that differ, .* in the pair '{first}', '{second}'"
    with pytest.raises(InputError, match=message):
        recover_from_pointmaps(photographs, source, folder=tmp_path / "capture", options=FEW)
    assert not (tmp_path / "capture").exists()


def test_a_stop_in_the_middle_leaves_nothing_half_written(tmp_path, photographed) -> None:
    photographs = photographed.write(tmp_path / "photos")
    source = photographed.record(tmp_path / "maps", window(8, 1))
    whole = recover_from_pointmaps(photographs, source, options=FEW)
    for stage in ("pairs", "alignment", "cloud"):

        def stop(now, stage=stage) -> None:
            if now.stage == stage:
                raise KeyboardInterrupt

        kept = tmp_path / stage
        with pytest.raises(KeyboardInterrupt):
            recover_from_pointmaps(photographs, source, folder=kept, options=FEW, progress=stop)
        assert not kept.exists()
        again = recover_from_pointmaps(photographs, source, folder=kept, options=FEW)
        assert torch.equal(again.capture.points.points, whole.capture.points.points)


def test_photographs_that_are_no_photographs(tmp_path, photographed) -> None:
    source = photographed.record(tmp_path / "maps", window(8, 1))
    with pytest.raises(MissingFileError):
        recover_from_pointmaps(tmp_path / "nowhere", source, options=FEW)
    photographs = photographed.write(tmp_path / "photos")
    shutil.copy(tmp_path / "maps" / "pointmaps.json", photographs / photographed.names[3])
    with pytest.raises(InputError, match=photographed.names[3]):
        recover_from_pointmaps(photographs, source, options=FEW)


def test_a_network_that_answers_something_else(tmp_path, photographed) -> None:
    photographs = photographed.write(tmp_path / "photos")
    network = Network(photographed, photographed.answers(complete(8)))
    network.pointmaps = lambda first, second: [1, 2]  # type: ignore[method-assign]
    with pytest.raises(InputError, match="model generated: expected two Pointmaps for two images"):
        recover_from_pointmaps(photographs, network, options=FEW)
