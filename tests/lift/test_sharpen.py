"""Labels sharpen the geometry: scenes whose photographs do not care and whose labels do."""

from dataclasses import replace

import pytest
import torch

from splatseg.core import Gaussians, LabelMap, Labels, View
from splatseg.errors import InputError, RangeError
from splatseg.fit import FitOptions
from splatseg.io.images import save_png
from splatseg.lift import SharpenOptions, UpliftOptions, correct_confusion, sharpen, uplift
from splatseg.lift.boundaries import sharpen as module
from splatseg.lift.boundaries.sharpen import CachedLabelMaps, LabelLoss
from splatseg.render import back_project, render
from splatseg.render.cpu import set_threads, threads

from .conftest import BARREL, Maps, camera_at, gaussians_at

LEFT, RIGHT = 2, 5
BLACK = FitOptions(background="black")
OPTIONS = SharpenOptions(sharpen_steps=200, label_weight=1.0)


@pytest.fixture(autouse=True)
def short(monkeypatch) -> None:
    """Rates as in a fit that begins, and labels decided often."""
    monkeypatch.setattr(module, "DECIDE_EVERY", 50)
    monkeypatch.setattr(module, "_RATES_FROM", 0.0)


def wall(**lens) -> tuple[Gaussians, list[View], Maps]:
    """A grey wall; all pixels left of x = 0 are LEFT. One column of Gaussians straddles it."""
    x, y = torch.meshgrid(
        torch.tensor([-0.75, -0.45, 0.04, 0.45, 0.75]), torch.arange(-0.6, 0.7, 0.3), indexing="ij"
    )
    means = torch.stack((x, y, torch.full_like(x, 2.0)), -1).reshape(-1, 3)
    gaussians = gaussians_at(means, scale=0.13, opacity=0.8)
    views, maps = [], {}
    for i, at in enumerate((-0.2, 0.0, 0.2)):
        camera = camera_at(at, width=32, height=24, **lens)
        views.append(View(name=f"v{i}", camera=camera))
        edge = camera.cx - camera.fx * at / 2
        u = camera.pixel_centres()[..., 0]
        maps[f"v{i}"] = LabelMap(ids=torch.where(u < edge, LEFT, RIGHT).int())
    return gaussians, views, Maps(maps)


@pytest.fixture
def scene(tmp_path):
    """The wall with its photographs on disk."""
    return photographed(tmp_path, *wall())


def photographed(folder, gaussians, views, maps):
    with_files = []
    for view in views:
        path = folder / f"{view.name}.png"
        save_png(render(gaussians, view.camera, backend="cpu").image, path)
        with_files.append(replace(view, image=path))
    return gaussians, with_files, maps


def exact_share(gaussians, views, maps, labels) -> float:
    """Light of labelled pixels from Gaussians of their id, over all light that reaches them."""
    own = whole = 0.0
    for view in views:
        label_map = maps.label_map(view.name)
        for id in (LEFT, RIGHT):
            mask = (label_map.ids == id).float().unsqueeze(-1)
            sums = back_project(gaussians, view.camera, mask, backend="cpu", warp="nearest").sums
            own += float(sums[labels.ids == id].sum())
            whole += float(sums.sum())
    return own / whole


def test_what_straddles_takes_a_side(scene) -> None:
    gaussians, views, maps = scene
    found = sharpen(
        gaussians, views, maps, options=OPTIONS, fit_options=BLACK, confusion=None, backend="cpu"
    )
    before, after = found.agreement
    labels = uplift(gaussians, views, maps, backend="cpu")
    assert before == pytest.approx(exact_share(gaussians, views, maps, labels), abs=1e-3)
    assert after == pytest.approx(exact_share(found.gaussians, views, maps, found.labels), abs=1e-3)
    # Of the light on the wrong side about half is left.
    assert 1 - after < 0.55 * (1 - before)
    assert len(found.gaussians) == len(gaussians)
    straddling = slice(10, 15)
    assert bool(
        (found.gaussians.means[straddling, 0] > gaussians.means[straddling, 0] + 0.004).all()
    )
    facts = found.labels.info.edit("sharpen")
    assert facts["agreement"] == [before, after]
    assert facts["options"]["sharpen_steps"] == 200


def test_without_weight_labels_do_nothing(scene) -> None:
    gaussians, views, maps = scene
    options = replace(OPTIONS, label_weight=0.0)
    found = sharpen(gaussians, views, maps, options=options, fit_options=BLACK, backend="cpu")
    before, after = found.agreement
    assert after == pytest.approx(before, abs=0.01)


def test_poses_stay_whatever_the_fit_did(scene) -> None:
    """Label maps are drawn with the poses of the views: photographs must not move them."""
    gaussians, views, maps = scene
    options = replace(OPTIONS, sharpen_steps=9)
    found = [
        sharpen(
            gaussians,
            views,
            maps,
            options=options,
            fit_options=replace(BLACK, refine_poses=refine_poses),
            backend="cpu",
        )
        for refine_poses in (False, True)
    ]
    assert torch.equal(found[0].gaussians.means, found[1].gaussians.means)


def test_a_thing_that_lets_light_through_becomes_opaque(tmp_path) -> None:
    """Before a wall of its colour; only labels tell that what is seen is all of the thing."""
    x, y = torch.meshgrid(torch.arange(-1.2, 1.3, 0.2), torch.arange(-1.0, 1.1, 0.2), indexing="ij")
    means = torch.stack((x, y, torch.full_like(x, 2.5)), -1).reshape(-1, 3)
    back = gaussians_at(means, scale=0.2, opacity=0.95)
    thing = gaussians_at([[0.0, 0.0, 1.5]], scale=0.25, opacity=0.6)
    parts = ("means", "rotations", "scales", "opacities", "sh")
    gaussians = Gaussians(
        **{name: torch.cat((getattr(back, name), getattr(thing, name))) for name in parts}
    )
    gaussians, views, _ = photographed(tmp_path, gaussians, *wall()[1:])
    maps = {}
    for view in views:
        seen = render(thing, view.camera, backend="cpu").alpha > 0.1
        maps[view.name] = LabelMap(ids=torch.where(seen, RIGHT, LEFT).int())
    found = sharpen(
        gaussians, views, Maps(maps), options=OPTIONS, fit_options=BLACK, confusion=None,
        backend="cpu",
    )  # fmt: skip
    assert int(found.labels.ids[-1]) == RIGHT
    assert float(found.gaussians.opacities[-1]) > 0.8
    assert found.agreement[1] > found.agreement[0]


def test_codes_have_the_exact_value_and_gradient_on_average(scene, monkeypatch) -> None:
    """Against one-hot images of each id, over 400 draws of one channel."""
    gaussians, views, maps = scene
    view = views[0]
    labels = uplift(gaussians, views, maps, backend="cpu").ids
    rows = torch.arange(len(gaussians))

    def gradient_of(make) -> tuple[float, torch.Tensor]:
        leaf = gaussians.replace(opacities=gaussians.opacities.clone().requires_grad_())
        value = make(leaf)
        value.backward()
        return float(value.detach()), leaf.opacities.grad

    def exact(leaf):
        label_map = maps.label_map(view.name).ids
        same = 0.0
        for id in (LEFT, RIGHT):
            signal = (labels == id).float().unsqueeze(1)
            rendered = render(leaf, view.camera, signal, backend="cpu").image[..., 0]
            same = same + (rendered * (label_map == id)).sum()
        return 0.3 * (1 - same / label_map.numel())

    monkeypatch.setattr(module, "_CODES", 1)
    options = SharpenOptions(label_weight=0.3)
    generator = torch.Generator().manual_seed(0)
    loss = LabelLoss(CachedLabelMaps(maps), labels, options, generator, "cpu")
    value, mean_gradient = 0.0, torch.zeros(len(gaussians))
    for _ in range(400):
        one, one_gradient = gradient_of(lambda leaf: loss(view, leaf, rows))
        value, mean_gradient = value + one / 400, mean_gradient + one_gradient / 400
    wanted, wanted_gradient = gradient_of(exact)
    # The codes of two ids agree or do not: the mean of 400 is within 4 / sqrt(400) of its own.
    assert value == pytest.approx(wanted, abs=0.2 * 0.3)
    error = (mean_gradient - wanted_gradient).norm() / wanted_gradient.norm()
    assert float(error) < 0.2


def test_pixels_and_gaussians_without_a_label_say_nothing(scene) -> None:
    gaussians, views, _ = scene
    view, rows = views[0], torch.arange(len(gaussians))
    generator = torch.Generator().manual_seed(0)
    nothing = torch.full((24, 32), -1, dtype=torch.int32)
    nobody = torch.full((len(gaussians),), -1, dtype=torch.int32)
    ids = torch.full((24, 32), LEFT, dtype=torch.int32)
    all_left = torch.full((len(gaussians),), LEFT, dtype=torch.int32)

    def value(label_map, labels) -> float:
        label_maps = CachedLabelMaps(Maps({view.name: label_map}))
        options = SharpenOptions(label_weight=1.0)
        return float(
            LabelLoss(label_maps, labels, options, generator, "cpu")(view, gaussians, rows)
        )

    alpha = float(render(gaussians, view.camera, backend="cpu").alpha.mean())
    assert value(LabelMap(ids=ids), all_left) == pytest.approx(1 - alpha, abs=1e-5)
    assert value(LabelMap(ids=ids), nobody) == 1.0
    assert value(LabelMap(ids=nothing), all_left) == 1.0
    # A confidence is a pixel's say.
    sure = torch.zeros(24, 32)
    sure[:, :16] = 0.5
    left_alpha = float(render(gaussians, view.camera, backend="cpu").alpha[:, :16].mean())
    label_map = LabelMap(ids=ids, confidence=sure)
    assert value(label_map, all_left) == pytest.approx(1 - left_alpha, abs=1e-5)


def test_distorted_and_reduced_maps_count_in_their_own_pixels(tmp_path) -> None:
    gaussians, views, maps = photographed(tmp_path, *wall(**BARREL))
    half = {name: LabelMap(ids=label_map.ids[::2, ::2]) for name, label_map in maps.maps.items()}
    for source in (maps, Maps(half)):
        found = sharpen(
            gaussians, views, source, options=OPTIONS, fit_options=BLACK, confusion=None,
            backend="cpu",
        )  # fmt: skip
        assert 1 - found.agreement[1] < 0.6 * (1 - found.agreement[0])


@pytest.mark.bits
def test_neither_threads_nor_the_order_of_views_matter_but_the_seed(scene, monkeypatch) -> None:
    gaussians, views, maps = scene
    monkeypatch.setattr(module, "DECIDE_EVERY", 3)
    options = replace(OPTIONS, sharpen_steps=7)

    def run(views, seed=0) -> Gaussians:
        return sharpen(gaussians, views, maps, options=options, seed=seed, backend="cpu").gaussians

    first = run(views)
    before = threads()
    try:
        set_threads(3)
        again = run(views[::-1])
    finally:
        set_threads(before)
    for name in ("means", "scales", "opacities", "sh", "rotations"):
        assert torch.equal(getattr(first, name), getattr(again, name))
    assert not torch.equal(first.means, run(views, seed=1).means)


def test_steps_are_reported_and_none_leaves_everything(scene) -> None:
    gaussians, views, maps = scene
    reported: list[tuple[int, int]] = []
    options = replace(OPTIONS, sharpen_steps=3)
    sharpen(
        gaussians, views, maps, options=options, backend="cpu",
        progress=lambda done, total: reported.append((done, total)),
    )  # fmt: skip
    assert reported == [(1, 3), (2, 3), (3, 3)]
    found = sharpen(
        gaussians, views, maps, options=replace(OPTIONS, sharpen_steps=0), confusion=None,
        backend="cpu",
    )  # fmt: skip
    assert found.gaussians is gaussians
    wanted = uplift(gaussians, views, maps, options=UpliftOptions(candidates=2), backend="cpu")
    assert torch.equal(found.labels.ids, wanted.ids)
    assert found.agreement[0] == found.agreement[1]


def test_steps_behind_the_last_decision_count_too(scene) -> None:
    gaussians, views, maps = scene
    options = replace(OPTIONS, sharpen_steps=3)
    found = sharpen(gaussians, views, maps, options=options, backend="cpu")
    assert not torch.equal(found.gaussians.means, gaussians.means)
    assert found.agreement[0] != found.agreement[1]


def test_confusion_is_corrected_unless_told_not_to(scene) -> None:
    gaussians, views, maps = scene
    none = replace(OPTIONS, sharpen_steps=0)
    votes = uplift(gaussians, views, maps, options=UpliftOptions(candidates=8), backend="cpu")
    measured = votes.info.view_correlation
    again = sharpen(gaussians, views, maps, options=none, backend="cpu").labels
    assert again.shares is not None
    assert torch.equal(again.shares, correct_confusion(votes, view_correlation=measured).shares)
    assert not torch.equal(again.shares[:, 0], votes.shares[:, 0])


def test_ids_near_by_are_trusted() -> None:
    from splatseg.lift.boundaries.sharpen import shown_near

    drawn = torch.full((4, 6), 1, dtype=torch.int32)
    drawn[:, 3:] = 2
    ids = torch.full((4, 6), 2, dtype=torch.int32)
    for pixels, first in ((0, 3), (1, 2), (2, 1), (9, 0)):
        near = shown_near(ids, drawn, pixels)
        assert bool(near[:, first:].all())
        assert not bool(near[:, :first].any())
    corner = torch.full((4, 6), 1, dtype=torch.int32)
    corner[0, 0] = 2
    assert shown_near(ids, corner, 1).nonzero().tolist() == [[0, 0], [0, 1], [1, 0], [1, 1]]
    # Beyond the border there is nothing, whatever the id.
    for id in (0, 1, 2):
        assert not bool(shown_near(torch.full_like(ids, id), torch.full_like(ids, 3), 1).any())


def test_what_contradicts_all_other_views_does_not_bend_the_geometry(scene) -> None:
    """One view takes the left of the wall for a third thing."""
    gaussians, views, maps = scene
    wrong = maps.maps["v1"].ids.clone()
    wrong[:, :8] = 9
    bad = Maps(maps.maps | {"v1": LabelMap(ids=wrong)})

    def opacity(source, **change) -> torch.Tensor:
        options = replace(OPTIONS, sharpen_steps=60, **change)
        found = sharpen(
            gaussians, views, source, options=options, fit_options=BLACK, confusion=None,
            backend="cpu",
        )  # fmt: skip
        return found.gaussians.opacities[:5].mean()

    trusting, careful = opacity(bad, trust_pixels=-1), opacity(bad)
    assert float(careful) > float(trusting) + 0.005


def test_agreement_of_the_label_and_not_of_the_majority() -> None:
    from splatseg.lift.boundaries.sharpen import _agreement

    ids = torch.tensor([[1, 2], [2, 1], [-1, -1]], dtype=torch.int32)
    votes = Labels(
        ids=ids[:, 0],
        confidence=torch.tensor([0.75, 0.5, 0.0]),
        candidates=ids,
        shares=torch.tensor([[0.75, 0.25], [0.5, 0.5], [0.0, 0.0]]),
        evidence=torch.tensor([4.0, 2.0, 0.0]),
    )
    assert _agreement(votes, votes) == pytest.approx((3 + 1) / 6)
    other = replace(votes, ids=torch.tensor([2, 2, -1], dtype=torch.int32))
    assert _agreement(votes, other) == pytest.approx((1 + 1) / 6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"sharpen_steps": -1}, "sharpen_steps"),
        ({"label_weight": float("nan")}, "label_weight"),
        ({"label_weight": -0.1}, "label_weight"),
        ({"trust_pixels": -2}, "trust_pixels"),
    ],
)
def test_options_are_checked(change, message) -> None:
    with pytest.raises(RangeError, match=message):
        SharpenOptions(**change)


def test_views_need_photographs_and_maps(scene) -> None:
    gaussians, views, maps = scene
    bare = [replace(views[0], image=None), *views[1:]]
    with pytest.raises(InputError, match="v0 has none"):
        sharpen(gaussians, bare, maps, backend="cpu")
    with pytest.raises(InputError, match="v1"):
        sharpen(gaussians, views, Maps({"v0": maps.maps["v0"], "v2": maps.maps["v2"]}))
    with pytest.raises(InputError, match="expected at least one view"):
        sharpen(gaussians, [], maps)
