"""Generated pointmaps: exact without errors, and wrong by as much as was asked for."""

import math

import numpy as np
import pytest
import torch

from splatseg.errors import RangeError
from splatseg.synthetic import look_at
from splatseg_bench.worlds import PointmapErrors, synthetic_pointmaps

SIZE = (30, 40)
EXACT = PointmapErrors(noise=0, warp=0, wrong_confidence=0)
ANGLES = np.linspace(0, 1, 12)
CAMERAS = {
    f"{i:02d}": look_at([4 * math.cos(a), 4 * math.sin(a), 1], [0, 0, 0.5], width=80, height=60)
    for i, a in enumerate(ANGLES)
}
PAIRS = [(a, b) for a in CAMERAS for b in CAMERAS if a != b]
DEPTHS = {name: torch.linspace(2, 5, 1200).reshape(SIZE) for name in CAMERAS}


def test_exact_maps_project_onto_their_pixels_in_both_cameras() -> None:
    answers = synthetic_pointmaps(CAMERAS, DEPTHS, PAIRS, errors=EXACT)
    scales = []
    for first, second in PAIRS[:20]:
        one, two = answers.pointmaps(first, second)
        scale = float(one.points[0, 0, 2] / DEPTHS[first][0, 0])
        scales.append(scale)
        frame = CAMERAS[first].world_from_cam
        for name, found in ((first, one), (second, two)):
            local = found.points.double() / scale
            pixels, depth = CAMERAS[name].project(local @ frame[:3, :3].T + frame[:3, 3])
            assert float(depth.sub(DEPTHS[name]).abs().max()) < 1e-4
            middle = 2 * torch.stack(
                torch.meshgrid(torch.arange(40) + 0.5, torch.arange(30) + 0.5, indexing="xy"), -1
            )
            assert float((pixels - middle).abs().max()) < 1e-3
            assert float(found.confidence.min()) > 1
    assert 0.5 <= min(scales) < 0.8
    assert 1.3 < max(scales) <= 2


@pytest.mark.parametrize(("noise", "warp"), [(0.02, 0.0), (0.0, 0.03)])
def test_depths_are_wrong_by_as_much_as_asked(noise: float, warp: float) -> None:
    errors = PointmapErrors(noise=noise, warp=warp, sideways=0.5, scale=(1, 1))
    answers = synthetic_pointmaps(CAMERAS, DEPTHS, PAIRS, errors=errors)
    one, _ = answers.pointmaps("00", "01")
    exact, _ = synthetic_pointmaps(
        CAMERAS, DEPTHS, PAIRS, errors=PointmapErrors(noise=0, warp=0, scale=(1, 1))
    ).pointmaps("00", "01")
    off = (one.points - exact.points) / exact.points[..., 2:]
    assert float(off[..., 2].square().mean().sqrt()) == pytest.approx(noise + warp, rel=0.1)
    ray = exact.points / exact.points[..., 2:]
    across = off[..., :2] - off[..., 2:] * ray[..., :2]
    assert float(across.square().mean().sqrt()) == pytest.approx(0.5 * (noise + warp), rel=0.3)
    steps = off[:, 1:, 2] - off[:, :-1, 2]
    assert (float(steps.std()) < 0.2 * (noise + warp)) == (noise == 0)  # smooth, or not


def test_outliers_are_as_many_as_asked_and_lie_elsewhere() -> None:
    answers = synthetic_pointmaps(CAMERAS, DEPTHS, PAIRS, errors=PointmapErrors(outliers=0.25))
    assert len(answers.outliers) == 33
    wrong = sorted(answers.outliers)[0]
    exact = synthetic_pointmaps(CAMERAS, DEPTHS, PAIRS, errors=EXACT).pointmaps(*wrong)[1]
    found = answers.pointmaps(*wrong)[1]
    assert float((found.points - exact.points).norm(dim=-1).median()) > 0.5


def test_some_confidences_are_drawn_by_chance() -> None:
    answers = synthetic_pointmaps(
        CAMERAS, DEPTHS, PAIRS, errors=PointmapErrors(wrong_confidence=0.5)
    )
    wrong = 0
    for pair in PAIRS[:30]:
        rows = answers.pointmaps(*pair)[0].confidence
        wrong += float((rows[0] - rows[0].sort(descending=True).values).abs().max()) > 0.5
    assert 8 < wrong < 22


def test_answers_depend_on_seed_and_pair_alone() -> None:
    one = synthetic_pointmaps(CAMERAS, DEPTHS, PAIRS, seed=1)
    two = synthetic_pointmaps(CAMERAS, DEPTHS, PAIRS, seed=1)
    one.pointmaps("03", "04")
    assert torch.equal(one.pointmaps("00", "01")[1].points, two.pointmaps("00", "01")[1].points)
    other = synthetic_pointmaps(CAMERAS, DEPTHS, PAIRS, seed=2).pointmaps("00", "01")[1]
    assert not torch.equal(other.points, two.pointmaps("00", "01")[1].points)


def test_errors_that_cannot_be() -> None:
    with pytest.raises(RangeError, match="outliers"):
        PointmapErrors(outliers=1.5)
    with pytest.raises(RangeError, match="scale"):
        PointmapErrors(scale=(2, 1))
