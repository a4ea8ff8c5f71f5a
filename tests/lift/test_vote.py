"""Votes at the pixels that centres fall into."""

import math
from dataclasses import replace

import pytest
import torch

from splatseg.core import Camera, ClassInfo, ClassTable, LabelMap, View
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.methods import vote as module
from splatseg.methods.vote import VoteOptions, centre_weights, centres_in, vote
from splatseg.render import RenderOptions, prepare, weights

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


def halves(left: int, right: int, *, confidence=None) -> LabelMap:
    ids = torch.full((12, 16), left)
    ids[:, 8:] = right
    return LabelMap(ids=ids, confidence=confidence)


def votes_of(*maps: LabelMap) -> tuple[list[View], Maps]:
    views = [View(name=f"v{i}", camera=camera_at()) for i in range(len(maps))]
    return views, Maps({view.name: label_map for view, label_map in zip(views, maps, strict=True)})


CONSTANTS = {
    "memory": "_MEMORY", "min_weight": "_MIN_WEIGHT", "depth_tolerance": "_DEPTH_TOLERANCE",
}  # fmt: skip


def voted(gaussians, views, maps, **changes):
    """Votes with other options, or constants of the module."""
    with pytest.MonkeyPatch.context() as patch:
        for name in CONSTANTS.keys() & changes.keys():
            patch.setattr(module, CONSTANTS[name], changes.pop(name))
        return vote(gaussians, views, maps, options=VoteOptions(**changes), backend=BACKEND)


LEFT, RIGHT = [-5 / 14.4, 1 / 14.4, 2.0], [5 / 14.4, 1 / 14.4, 2.0]
"""Points on the centres of the pixels (5, 6) and (10, 6)."""


@pytest.mark.parametrize("lens", [{}, BARREL])
@pytest.mark.parametrize("memory", [1, 1 << 30])
def test_each_view_votes_for_the_id_at_the_centre(rng, lens, memory) -> None:
    ids = (1, 4, 900)
    views = [View(name=f"v{i}", camera=camera_at(x, **lens)) for i, x in enumerate((-0.2, 0, 0.3))]
    gaussians = random_gaussians(rng, 30)
    maps = random_maps(rng, views, ids)
    counts = torch.zeros(30, 3)
    for view in views:
        pixels, depth = view.camera.project(gaussians.means.double())
        for i, ((u, v), z) in enumerate(zip(pixels.tolist(), depth.tolist(), strict=True)):
            if z > 0.01 and 0 <= u < 16 and 0 <= v < 12:
                id = int(maps.label_map(view.name).ids[math.floor(v), math.floor(u)])
                if id != -1:
                    counts[i, ids.index(id)] += 1
    total = counts.sum(dim=1)
    assert int((total > 0).sum()) > 10
    share, column = (counts / total.clamp_min(1).unsqueeze(1)).max(dim=1)
    expected = torch.where(total > 0, torch.tensor(ids)[column], -1)

    labels = voted(gaussians, views, maps, memory=memory)

    assert labels.ids.tolist() == expected.tolist()
    assert labels.confidence.tolist() == pytest.approx(share.tolist())
    assert labels.evidence is not None
    assert labels.evidence.tolist() == total.tolist()
    assert labels.background == -1


def test_published_votes_are_of_all_views() -> None:
    """Id 1 in three of four views; in the fourth the camera looks away."""
    views, maps = votes_of(*(halves(1, 2),) * 4)
    away = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0], dtype=torch.float64))
    views[3] = View(name="v3", camera=replace(camera_at(), cam_from_world=away))
    gaussians = gaussians_at([LEFT])
    visible = voted(gaussians, views, maps)
    assert (visible.ids.tolist(), visible.confidence.tolist()) == ([1], [1.0])
    published = voted(gaussians, views, maps, rule="published")
    assert (published.ids.tolist(), published.confidence.tolist()) == ([1], [0.75])
    strict = voted(gaussians, views, maps, rule="published", share=0.75)
    assert (strict.ids.tolist(), strict.confidence.tolist()) == ([-1], [0.0])
    # With two of four views looking away, SA-GS loses it and Prompt SA-GS as well.
    views[2] = View(name="v2", camera=views[3].camera)
    for share in (None, 0.6):
        lost = voted(gaussians, views, maps, rule="published", share=share)
        assert lost.ids.tolist() == [-1]
    assert voted(gaussians, views, maps).ids.tolist() == [1]
    assert VoteOptions(rule="published").needed_share == 0.7
    assert VoteOptions().needed_share == 0.0


def test_void_pixels_say_nothing() -> None:
    views, maps = votes_of(halves(1, -1), halves(-1, -1), halves(-1, -1))
    gaussians = gaussians_at([LEFT, RIGHT])
    labels = voted(gaussians, views, maps)
    assert labels.ids.tolist() == [1, -1]
    assert labels.confidence.tolist() == [1.0, 0.0]


def test_what_is_hidden_is_not_asked() -> None:
    """A wall in front of a Gaussian, in one of two views; the other looks from behind."""
    front, hidden = [LEFT[0], LEFT[1], 2.0], [1.5 * LEFT[0], 1.5 * LEFT[1], 3.0]
    gaussians = gaussians_at([front, hidden], opacity=0.98, scale=0.2)
    behind = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0], dtype=torch.float64))
    behind[2, 3] = 5.0
    views = [
        View(name="a", camera=camera_at()),
        View(name="b", camera=replace(camera_at(), cam_from_world=behind)),
    ]
    maps = Maps({"a": halves(1, 1), "b": halves(2, 2)})
    labels = voted(gaussians, views, maps)
    assert labels.confidence.tolist() == [0.5, 0.5]
    assert labels.ids.tolist() == [1, 1]  # ties to the smaller id
    for how in ("depth", "weight"):
        seen = voted(gaussians, views, maps, occlusion=how, min_weight=0.1)
        assert seen.ids.tolist() == [1, 2]
        assert seen.confidence[1] == 1.0
    far = voted(gaussians, views, maps, occlusion="depth", depth_tolerance=0.6)
    assert far.confidence.tolist() == [0.5, 0.5]
    # No median depth, nothing hidden: both are faint.
    faint = gaussians.replace(opacities=torch.full((2,), 0.3))
    assert voted(faint, views, maps, occlusion="depth").confidence.tolist() == [0.5, 0.5]


def test_transmittance_weighs_the_votes(rng, views) -> None:
    gaussians = random_gaussians(rng, 20)
    maps = random_maps(rng, views, (1, 2, 3), void=0.0)
    votes = torch.zeros(20, 3, dtype=torch.float64)
    for view in views:
        matrix = matrix_of(gaussians, view.camera)
        pixels, _ = view.camera.project(gaussians.means.double())
        for i, (u, v) in enumerate(pixels.floor().long().tolist()):
            if 0 <= u < 16 and 0 <= v < 12:
                id = int(maps.label_map(view.name).ids[v, u])
                votes[i, id - 1] += matrix[v, u, i]
    labels = voted(gaussians, views, maps, weight="transmittance")
    assert labels.evidence is not None
    torch.testing.assert_close(labels.evidence.double(), votes.sum(dim=1), rtol=0, atol=5e-3)
    shares = votes / votes.sum(dim=1, keepdim=True).clamp_min(1e-9)
    expected = shares.max(dim=1).values
    torch.testing.assert_close(labels.confidence.double(), expected, rtol=0, atol=5e-3)
    unseen = votes.sum(dim=1) == 0
    assert bool((labels.ids[unseen] == -1).all())
    minimum = voted(gaussians, views, maps, occlusion="weight", min_weight=0.5)
    strong = sum(
        float(matrix_of(gaussians, view.camera)[v, u, 3]) >= 0.5
        for view in views
        for u, v in [view.camera.project(gaussians.means.double())[0][3].floor().long().tolist()]
        if 0 <= u < 16 and 0 <= v < 12
    )
    assert minimum.evidence is not None
    assert float(minimum.evidence[3]) == strong


def test_own_weights_are_entries_of_w(rng) -> None:
    gaussians, camera = random_gaussians(rng, 40), camera_at(**BARREL)
    centres = centres_in(gaussians.means, camera, near=0.01)
    with prepare(gaussians, camera, options=RenderOptions(), backend=BACKEND) as view:
        found = centre_weights(centres, gaussians, view)
    rows = weights(gaussians, camera, centres.pixels, backend=BACKEND)
    for m, i in enumerate(centres.gaussians.tolist()):
        span = slice(int(rows.indptr[m]), int(rows.indptr[m + 1]))
        mine = rows.weights[span][rows.ids[span] == i].float()
        assert float(found[m]) == float(mine.sum())
    assert float(found.max()) > 0.1


def test_centres_beyond_the_fold_of_the_lens_are_not_seen() -> None:
    """A strong barrel: the polynomial brings far points back into the image."""
    camera = Camera(
        width=16, height=12, fx=14.4, fy=14.4, cx=8, cy=6, cam_from_world=torch.eye(4),
        model="opencv", distortion=(-0.3,),
    )  # fmt: skip
    radius = math.sqrt(1 / 0.3)  # r (1 - 0.3 r^2) is 0 there
    means = torch.tensor([[0.1, 0.0, 1.0], [0.99 * radius, 0.0, 1.0], [0.1, 0.0, -1.0]])
    at = camera.project(means)[0]
    assert abs(float(at[1, 0]) - 8) < 1
    assert centres_in(means, camera, near=0.01).gaussians.tolist() == [0]


def test_near_and_border() -> None:
    camera = replace(camera_at(), fx=16, fy=16)
    means = torch.tensor([[0, 0, 0.5], [0, 0, 0.25], [-0.5, 0, 1], [0.5, 0, 1], [0, 0.375, 1]])
    assert centres_in(means, camera, near=0.25).gaussians.tolist() == [0, 2]


def test_confidence_and_reduced_maps() -> None:
    sure = torch.full((12, 16), 0.9)
    views, maps = votes_of(
        halves(1, 1, confidence=sure), halves(2, 2, confidence=0.5 * sure), halves(2, 2)
    )
    labels = voted(gaussians_at([LEFT]), views, maps)
    assert labels.ids.tolist() == [2]
    assert labels.confidence.tolist() == pytest.approx([1.45 / 2.35])
    full = [View(name="v0", camera=camera_at(width=32, height=24))]
    assert voted(gaussians_at([RIGHT]), full, Maps({"v0": halves(1, 2)})).ids.tolist() == [2]


def test_order_of_views_changes_nothing(rng, views) -> None:
    gaussians = random_gaussians(rng, 20)
    maps = random_maps(rng, views, (1, 2, 3))
    calls = []
    options = VoteOptions(weight="transmittance")
    a = vote(gaussians, views, maps, options=options, backend=BACKEND)
    b = vote(
        gaussians,
        views[::-1],
        maps,
        options=options,
        backend=BACKEND,
        progress=lambda done, total: calls.append((done, total)),
    )
    assert torch.equal(a.ids, b.ids)
    assert torch.equal(a.confidence, b.confidence)
    assert calls == [(1, 3), (2, 3), (3, 3)]


def test_info_says_how_it_was_made(rng, views) -> None:
    classes = ClassTable(rows=(ClassInfo(id=4, name="chair"), ClassInfo(id=77, name="unseen")))
    maps = random_maps(rng, views, (1, 4))
    labels = vote(random_gaussians(rng, 30), views, maps, classes=classes, backend=BACKEND)
    info = labels.info
    assert info.method == "vote"
    assert info.options["rule"] == "visible"
    assert info.views == ("v0", "v1", "v2")
    assert info.names == {4: "chair"}


def test_an_empty_scene_has_no_votes() -> None:
    views, maps = votes_of(halves(1, 2))
    assert len(voted(gaussians_at(torch.zeros(0, 3)), views, maps)) == 0


def test_bad_input_is_refused(rng, views) -> None:
    gaussians = random_gaussians(rng)
    maps = random_maps(rng, views[:2], (1,))
    with pytest.raises(InputError, match="at least one view"):
        vote(gaussians, [], maps, backend=BACKEND)
    with pytest.raises(InputError, match="1 of 3 have none, the first is v2"):
        vote(gaussians, views, maps, backend=BACKEND)
    void = Maps({"v0": LabelMap(ids=torch.full((12, 16), -1))})
    with pytest.raises(InputError, match="a labelled pixel at a Gaussian's centre in 1 views"):
        vote(gaussians, views[:1], void, backend=BACKEND)
    stretched = Maps({"v0": LabelMap(ids=torch.ones(12, 12, dtype=torch.int32))})
    with pytest.raises(ShapeError, match=r"v0: expected a map of 16x12 .* got 12x12"):
        vote(gaussians, views[:1], stretched, backend=BACKEND)
    broken = gaussians.replace(means=torch.full_like(gaussians.means, math.nan))
    with pytest.raises(RangeError, match="means"):
        vote(broken, views[:2], maps, backend=BACKEND)
    for wrong in ({"share": 1.1},):
        with pytest.raises(RangeError, match=next(iter(wrong))):
            VoteOptions(**wrong)
    for wrong in ({"rule": "most"}, {"occlusion": "x"}, {"weight": "two"}):
        with pytest.raises(InputError, match=next(iter(wrong))):
            VoteOptions(**wrong)
