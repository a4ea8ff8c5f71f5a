"""Votes of label maps on Gaussians."""

import pytest
import torch

from splatseg.core import ClassInfo, ClassTable, LabelMap, View
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.lift import UpliftOptions, uplift
from splatseg.lift.voting import uplift as module
from splatseg.render.warp import warp_into_photograph

from .conftest import (
    BACKEND,
    BARREL,
    Maps,
    camera_at,
    gaussians_at,
    matrix_of,
    random_gaussians,
    random_maps,
)

IDS = (1, 4, 5, 900)


def votes_of(gaussians, views, maps: Maps, ids) -> torch.Tensor:
    """The definition, from the spelt-out matrix: (n, ids) in float64."""
    votes = torch.zeros(len(gaussians), len(ids), dtype=torch.float64)
    for view in views:
        onehot = maps.label_map(view.name).ids.unsqueeze(-1) == torch.tensor(ids)
        image = onehot.double()
        if not view.camera.is_pinhole:
            image = warp_into_photograph(view.camera, "nearest").adjoint(image)
        votes += torch.einsum("hwn,hwc->nc", matrix_of(gaussians, view.camera), image)
    return votes


@pytest.mark.parametrize("lens", [{}, BARREL])
def test_labels_are_the_strongest_votes(rng, lens) -> None:
    views = [View(name=f"v{i}", camera=camera_at(x, **lens)) for i, x in enumerate((-0.2, 0.1))]
    gaussians = random_gaussians(rng)
    maps = random_maps(rng, views, IDS)
    votes = votes_of(gaussians, views, maps, IDS)

    labels = uplift(gaussians, views, maps, backend=BACKEND)

    seen = votes.sum(dim=1) > 0
    assert int(seen.sum()) > 5
    shares = votes / votes.sum(dim=1, keepdim=True).clamp_min(1e-30)
    confidence, column = shares.max(dim=1)
    expected = torch.where(seen, torch.tensor(IDS)[column], -1)
    assert labels.ids.tolist() == expected.tolist()
    torch.testing.assert_close(labels.confidence.double(), confidence, rtol=0, atol=1e-5)
    assert labels.candidates is None
    assert labels.shares is None


@pytest.mark.parametrize("memory", [1, 14 * 4 * 2, 1 << 30])
def test_candidates_are_exact_whatever_the_memory(rng, views, memory, monkeypatch) -> None:
    """Fewer ids than slots: what each Gaussian remembers is all there is. One pass."""
    gaussians = random_gaussians(rng)
    maps = random_maps(rng, views, IDS)
    votes = votes_of(gaussians, views, maps, IDS)
    shares = votes / votes.sum(dim=1, keepdim=True).clamp_min(1e-30)
    expected, order = shares.sort(dim=1, descending=True, stable=True)

    calls = []
    monkeypatch.setattr(module, "SLOTS", 4)
    labels = uplift(
        gaussians,
        views,
        maps,
        options=UpliftOptions(candidates=3, table_memory=memory),
        backend=BACKEND,
        progress=lambda done, total: calls.append((done, total)),
    )

    assert labels.shares is not None
    assert labels.candidates is not None
    assert labels.evidence is not None
    torch.testing.assert_close(labels.shares.double(), expected[:, :3], rtol=0, atol=1e-5)
    torch.testing.assert_close(labels.evidence.double(), votes.sum(dim=1), rtol=1e-5, atol=1e-5)
    real = expected[:, :3] > 0
    assert torch.equal(labels.candidates[real].long(), torch.tensor(IDS)[order[:, :3]][real])
    assert bool((labels.candidates[~real] == -1).all())
    assert calls == [(1, 3), (2, 3), (3, 3)]
    assert labels.info.details["largest_error_bound"] == 0


def test_voids_cast_no_vote_and_unseen_gaussians_have_no_label(views) -> None:
    """One Gaussian in the middle, one behind the camera; half of the view is void."""
    gaussians = gaussians_at([[0, 0, 2], [0, 0, -2]])
    ids = torch.full((12, 16), -1)
    ids[:, 8:] = 3
    one = [View(name="v", camera=camera_at())]
    maps = Maps({"v": LabelMap(ids=ids)})
    labels = uplift(gaussians, one, maps, backend=BACKEND)
    assert labels.ids.tolist() == [3, -1]
    assert labels.confidence.tolist() == [1.0, 0.0]
    soft = uplift(gaussians, one, maps, options=UpliftOptions(candidates=2), backend=BACKEND)
    assert soft.candidates is not None
    assert soft.shares is not None
    assert soft.candidates.tolist() == [[3, -1], [-1, -1]]
    assert soft.shares.tolist() == [[1.0, 0.0], [0.0, 0.0]]


def test_a_pixel_votes_with_its_confidence() -> None:
    gaussians = gaussians_at([[0, 0, 2]])
    ids = torch.ones(12, 16, dtype=torch.int32)
    ids[:, 8:] = 2
    confidence = torch.full((12, 16), 0.9)
    confidence[:, 8:] = 0.3
    maps = Maps({"v": LabelMap(ids=ids, confidence=confidence)})
    labels = uplift(gaussians, [View(name="v", camera=camera_at())], maps, backend=BACKEND)
    assert labels.ids.tolist() == [1]
    assert labels.confidence.tolist() == pytest.approx([0.75], abs=1e-6)
    passing = 1 - matrix_of(gaussians, camera_at()).sum(dim=-1)
    facts = labels.info.details["background_votes"]
    assert labels.background == 1
    assert facts["share"] == pytest.approx(0.75, abs=1e-6)
    light = float((passing * confidence).sum() / confidence.sum())
    assert facts["uncovered_share"] == pytest.approx(light, abs=1e-6)


def test_equal_votes_go_to_the_smaller_id() -> None:
    """Two views of one camera give sums that are equal to the last bit, on every backend."""
    gaussians = gaussians_at([[0, 0, 2]])
    views = [View(name=name, camera=camera_at()) for name in "ab"]
    for first, second in ((7, 2), (2, 7)):
        maps = Maps(
            {
                "a": LabelMap(ids=torch.full((12, 16), first)),
                "b": LabelMap(ids=torch.full((12, 16), second)),
            }
        )
        for memory in (1, 1 << 20):
            labels = uplift(
                gaussians, views, maps, options=UpliftOptions(table_memory=memory), backend=BACKEND
            )
            assert labels.confidence.tolist() == pytest.approx([0.5], abs=1e-6)
            assert labels.ids.tolist() == [2]


def test_thresholds_take_labels_away() -> None:
    gaussians = gaussians_at([[0, 0, 2]])
    view = View(name="v", camera=camera_at())
    ids = torch.ones(12, 16, dtype=torch.int32)
    ids[:, 9:] = 2
    maps = Maps({"v": LabelMap(ids=ids)})
    matrix = matrix_of(gaussians, view.camera)[..., 0]
    weight = float(matrix.sum())
    share = float(matrix[:, :9].sum()) / weight
    assert 0.5 < share < 0.9

    def label(**changes) -> int:
        options = UpliftOptions(**changes)
        return int(uplift(gaussians, [view], maps, options=options, backend=BACKEND).ids[0])

    assert label(min_share=share - 0.05) == 1
    assert label(min_share=share + 0.05) == -1
    assert label(min_weight=0.99 * weight) == 1
    assert label(min_weight=1.01 * weight) == -1
    options = UpliftOptions(min_weight=1.01 * weight, candidates=2)
    unsure = uplift(gaussians, [view], maps, options=options, backend=BACKEND)
    assert unsure.candidates is not None
    assert unsure.shares is not None
    assert unsure.candidates.tolist() == [[-1, -1]]
    assert unsure.shares.tolist() == [[0.0, 0.0]]


def test_the_sky_is_what_passes(monkeypatch) -> None:
    """Sky above, a wall of Gaussians below: the light that passes is nearly all sky's."""
    wall = [[x, y, 2.0] for x in torch.arange(-1.4, 1.5, 0.2) for y in torch.arange(0.1, 1.2, 0.2)]
    gaussians = gaussians_at(wall, opacity=0.99)
    view = View(name="v", camera=camera_at())
    ids = torch.full((12, 16), 5)
    ids[:6] = 2
    maps = Maps({"v": LabelMap(ids=ids)})
    labels = uplift(gaussians, [view], maps, backend=BACKEND)
    assert labels.background == 2

    matrix = matrix_of(gaussians, view.camera)
    residual = 1 - matrix.sum(dim=-1)
    facts = labels.info.details["background_votes"]
    assert facts["uncovered_share"] == pytest.approx(float(residual.mean()), abs=1e-6)
    assert facts["share"] == pytest.approx(float(residual[:6].sum() / residual.sum()), abs=1e-6)

    def background(name: str, value: float) -> int:
        monkeypatch.setattr(module, name, value)
        found = uplift(gaussians, [view], maps, backend=BACKEND).background
        monkeypatch.undo()
        return found

    assert background("_MIN_UNCOVERED", facts["uncovered_share"] * 0.99) == 2
    assert background("_MIN_UNCOVERED", facts["uncovered_share"] * 1.01) == -1
    assert background("_MIN_BACKGROUND_SHARE", facts["share"] * 0.99) == 2
    assert background("_MIN_BACKGROUND_SHARE", facts["share"] * 1.01) == -1


def test_reduced_label_maps_vote_through_a_reduced_camera(rng) -> None:
    gaussians = random_gaussians(rng)
    full = View(name="v", camera=camera_at(width=32, height=24))
    half = View(name="v", camera=camera_at(width=16, height=12))
    maps = random_maps(rng, [half], IDS)
    a = uplift(gaussians, [full], maps, backend=BACKEND)
    b = uplift(gaussians, [half], maps, backend=BACKEND)
    assert torch.equal(a.ids, b.ids)
    assert torch.equal(a.confidence, b.confidence)


def test_info_says_how_it_was_made(rng, views) -> None:
    classes = ClassTable(rows=(ClassInfo(id=4, name="chair"), ClassInfo(id=77, name="unseen")))
    labels = uplift(
        random_gaussians(rng), views, random_maps(rng, views, IDS), classes=classes, backend=BACKEND
    )
    info = labels.info
    assert info.method == "uplift"
    assert info.options["candidates"] == 1
    assert info.views == ("v0", "v1", "v2")
    assert info.names == {4: "chair"}


def test_bad_input_is_refused(rng, views) -> None:
    gaussians = random_gaussians(rng)
    maps = random_maps(rng, views[:2], IDS)
    with pytest.raises(InputError, match="at least one view"):
        uplift(gaussians, [], maps, backend=BACKEND)
    with pytest.raises(InputError, match="1 of 3 have none, the first is v2"):
        uplift(gaussians, views, maps, backend=BACKEND)
    void = Maps({"v0": LabelMap(ids=torch.full((12, 16), -1))})
    with pytest.raises(InputError, match="expected a labelled pixel in 1 views"):
        uplift(gaussians, views[:1], void, backend=BACKEND)
    stretched = Maps({"v0": LabelMap(ids=torch.ones(12, 12, dtype=torch.int32))})
    with pytest.raises(ShapeError, match=r"v0: expected a map of 16x12 .* got 12x12"):
        uplift(gaussians, views[:1], stretched, backend=BACKEND)
    for wrong in (
        {"candidates": 0},
        {"min_weight": -1.0},
        {"min_weight": float("nan")},
        {"min_share": 1.1},
        {"table_memory": 0},
    ):
        with pytest.raises(RangeError, match=next(iter(wrong))):
            UpliftOptions(**wrong)


class TestNumberOfIds:
    """Layers do not change with how many ids there are, or what they are called."""

    @pytest.mark.parametrize("backend", [BACKEND, "cpu"])
    @pytest.mark.parametrize("lens", [{}, BARREL])
    def test_new_names_change_nothing(self, rng, lens, backend) -> None:
        views = [View(name=f"v{i}", camera=camera_at(x, **lens)) for i, x in enumerate((-0.2, 0.1))]
        gaussians = random_gaussians(rng, 40)
        few = random_maps(rng, views, range(4))
        confidence = {name: torch.from_numpy(rng.random((12, 16))).float() for name in few.maps}
        named, renamed = {}, {}
        for name, label_map in few.maps.items():
            seen = label_map.ids
            named[name] = LabelMap(ids=seen, confidence=confidence[name])
            renamed[name] = LabelMap(
                ids=torch.where(seen >= 0, 1000 + 7 * seen, -1), confidence=confidence[name]
            )
        options = UpliftOptions(candidates=3)
        found = uplift(gaussians, views, Maps(named), options=options, backend=backend)
        again = uplift(gaussians, views, Maps(renamed), options=options, backend=backend)
        assert torch.equal(found.shares, again.shares)
        assert torch.equal(found.confidence, again.confidence)
        for ids, new in ((found.ids, again.ids), (found.candidates, again.candidates)):
            assert torch.equal(torch.where(ids >= 0, 1000 + 7 * ids, -1), new)
        assert int((found.ids >= 0).sum()) > 5

    @pytest.mark.parametrize("extra", [100, 124, 125, 300])
    def test_a_row_of_further_ids_changes_nothing_above_it(self, rng, extra) -> None:
        """The lower rows of pixels hold ids that no Gaussian of the upper ones is shown by."""
        view = View(name="v", camera=camera_at(width=64, height=48))
        # Small ones above the middle, and one below that catches the further ids.
        means = rng.uniform((-0.5, -0.6, 1.5), (0.5, -0.3, 3.0), (60, 3))
        gaussians = gaussians_at([*means.tolist(), [0.0, 0.6, 2.0]], scale=0.02, opacity=0.7)
        top = torch.from_numpy(rng.integers(-1, 4, (48, 64)))
        top[24:] = -1
        wide = top.clone()
        wide[36:] = 10 + torch.arange(12 * 64).reshape(12, 64) % extra
        few, many = (
            uplift(
                gaussians,
                [view],
                Maps({"v": LabelMap(ids=ids)}),
                options=UpliftOptions(candidates=3),
                backend="cpu",
            )
            for ids in (top, wide)
        )
        for name in ("ids", "confidence", "candidates", "shares"):
            assert torch.equal(getattr(few, name)[:60], getattr(many, name)[:60]), name
        assert int((few.ids[:60] >= 0).sum()) > 20
        assert int(many.ids[60]) >= 10
