"""Which pixels are drawn, what they stand for, and where their rows are kept."""

import math
import tempfile

import numpy as np
import pytest
import torch

from splatseg.core import LabelMap, MaskSet, View
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.lift.training import (
    Batch,
    LabelTargets,
    MaskTargets,
    Ragged,
    RowSampler,
    SamplingOptions,
    held_out_views,
)
from splatseg.lift.training._sampler import (
    draw_by_group,
    draw_by_strata,
    draw_uniformly,
    equal_shares,
)

from .conftest import (
    BACKEND,
    BARREL,
    Maps,
    camera_at,
    matrix_of,
    random_gaussians,
    random_maps,
)

IDS = (3, 8, 900)


class Masks:
    def __init__(self, masks: dict[str, MaskSet]) -> None:
        self._masks = masks

    @property
    def view_names(self) -> tuple[str, ...]:
        return tuple(self._masks)

    def masks(self, name: str) -> MaskSet:
        return self._masks[name]


def sampler_of(gaussians, views, maps, **options) -> RowSampler:
    source = LabelTargets(maps, [view.name for view in views])
    return RowSampler(gaussians, views, source, options=SamplingOptions(**options), backend=BACKEND)


def batches(sampler: RowSampler, rng, batch: int) -> list[Batch]:
    with sampler.draw(rng, batch=batch) as drawn:
        return [drawn.batch(i) for i in range(len(drawn))]


def dense(batch: Batch, count: int) -> torch.Tensor:
    """A batch's W, a row a pixel, through its product with unit signals."""
    signal = torch.eye(count)[batch.weights.touched]
    return batch.weights.product(signal)


def groups_of(*members: list[int]) -> Ragged:
    return Ragged.of([torch.tensor(m) for m in members])


def test_all_pixels_are_all_rows(rng, views) -> None:
    gaussians, maps = random_gaussians(rng), random_maps(rng, views, IDS)
    sampler = sampler_of(gaussians, views, maps, pixels=1000)
    found = batches(sampler, rng, 60)
    seen = []
    for batch in found:
        mine = dense(batch, len(gaussians))
        label = batch.target("label")
        for p in range(len(batch)):
            view, pixel = views[int(batch.views[p])], int(batch.pixels[p])
            row, column = divmod(pixel, 16)
            full = matrix_of(gaussians, view.camera)[row, column].float()
            # Weights are kept in half precision.
            torch.testing.assert_close(mine[p], full, rtol=1e-3, atol=1e-4)
            assert IDS[int(label[p])] == int(maps.label_map(view.name).ids[row, column])
            seen.append((view.name, pixel))
    labelled = sum(int((maps.label_map(v.name).ids >= 0).sum()) for v in views)
    assert len(seen) == len(set(seen)) == labelled
    assert len(found) == math.ceil(labelled / 60)
    sizes = [len(batch) for batch in found]
    assert max(sizes) - min(sizes) <= len(views)
    for batch in found:  # every batch has some of every view
        assert batch.views.unique().tolist() == [0, 1, 2]
        assert torch.equal(batch.target("confidence"), torch.ones(len(batch)))


def test_uniform_draws_every_pixel_alike(rng) -> None:
    counts = torch.zeros(40)
    for _ in range(2000):
        pixels, stands_for = draw_uniformly(torch.arange(40), 10, rng)
        assert len(set(pixels.tolist())) == 10
        assert stands_for.tolist() == [4.0] * 10
        counts[pixels] += 1
    # Binomial with mean 500 and deviation 19: 5 deviations.
    assert float((counts - 500).abs().max()) < 97


def test_strata_cover_the_picture(rng) -> None:
    """Of any 16 pixels one after the other, each quarter of the picture has about 4."""
    height, width = 24, 32
    everything = torch.arange(height * width)
    pixels, stands_for = draw_by_strata(everything, width, 192, rng)
    assert len(set(pixels.tolist())) == 192
    assert stands_for.tolist() == [4.0] * 192
    rows, columns = pixels // width, pixels % width
    # Each patch of 2 x 2 has one.
    assert len(set(zip((rows // 2).tolist(), (columns // 2).tolist(), strict=True))) == 192
    quarter = (rows >= 16) * 2 + (columns >= 16)
    share = torch.bincount((everything // width >= 16) * 2 + (everything % width >= 16)) / 768
    for begin in range(0, 192, 16):
        found = torch.bincount(quarter[begin : begin + 16], minlength=4)
        assert float((found - 16 * share).abs().max()) < 2.2, (begin, found)
    other, _ = draw_by_strata(everything, width, 192, rng)
    assert not torch.equal(pixels, other)


def test_strata_draw_every_pixel_alike(rng) -> None:
    """Where parts do not divide, each pixel stands for as many as its part has."""
    some = torch.tensor([3, 5, 8, 13, 40, 41, 42, 60, 61, 62, 63])
    counts, total = torch.zeros(64), torch.zeros(64)
    for _ in range(2000):
        pixels, stands_for = draw_by_strata(some, 8, 4, rng)
        assert len(pixels) == 4
        counts[pixels] += 1
        total[pixels] += stands_for
    assert bool((counts[some] > 0).all())
    assert float(counts.sum()) == 8000
    assert float((total[some] / 2000 - 1).abs().max()) < 0.15
    assert len(draw_by_strata(some, 8, 100, rng)[0]) == 11
    assert len(draw_by_strata(some[:0], 8, 100, rng)[0]) == 0


def test_groups_draw_equally_many_of_each(rng) -> None:
    groups = groups_of(list(range(30)), list(range(30, 35)), [35])
    counts = torch.zeros(40)
    for _ in range(1000):
        pixels, stands_for = draw_by_group(groups, 40, 9, rng)
        assert len(pixels) == 9
        counts[pixels] += 1
        assert float(stands_for[pixels == 35]) == 1.0
        torch.testing.assert_close(stands_for[pixels < 30], torch.full((4,), 30 / 4))
    assert counts[35:].tolist() == [1000.0, 0, 0, 0, 0]
    assert float(counts[:30].sum()) == 4000
    assert float(counts[30:35].sum()) == 4000


def test_what_pixels_stand_for_is_unbiased_where_groups_overlap(rng) -> None:
    """Sums over a draw, weighted, are on average sums over all pixels of the groups."""
    groups = groups_of(list(range(24)), list(range(20, 30)), list(range(18, 22)))
    value = torch.from_numpy(rng.random(40).astype(np.float32))
    estimates = []
    for _ in range(3000):
        pixels, stands_for = draw_by_group(groups, 40, 12, rng)
        assert len(set(pixels.tolist())) == len(pixels)
        estimates.append(float((value[pixels] * stands_for).sum()))
    assert np.mean(estimates) == pytest.approx(float(value[:30].sum()), rel=0.02)


def test_equal_shares_by_hand(rng) -> None:
    assert equal_shares([10, 10], 8, rng) == [4, 4]
    assert equal_shares([2, 10, 10], 12, rng) == [2, 5, 5]
    assert equal_shares([1, 2], 9, rng) == [1, 2]
    assert sorted(equal_shares([9, 9, 9], 5, rng)) == [1, 2, 2]
    assert equal_shares([], 5, rng) == []


def test_visibility_is_estimated_without_bias(rng) -> None:
    """For reduced maps, lenses and both ways of sampling."""
    gaussians = random_gaussians(rng)
    view = View(name="v", camera=camera_at(width=32, height=24, **BARREL))
    small = View(name="v", camera=camera_at(**BARREL))
    maps = random_maps(rng, [small], IDS)
    n = len(gaussians)
    with sampler_of(gaussians, [view], maps, pixels=1000).draw(rng, batch=100) as drawn:
        whole = drawn.visibility(n)
    assert float(whole.sum()) > 5
    for sampling in ("uniform", "groups"):
        sampler = sampler_of(gaussians, [view], maps, pixels=20, sampling=sampling)
        estimates = []
        for _ in range(300):
            with sampler.draw(rng, batch=100) as drawn:
                estimates.append(drawn.visibility(n))
        error = (torch.stack(estimates).mean(dim=0) - whole).abs().sum() / whole.sum()
        assert float(error) < 0.1


def drawn_pixels(drawn) -> int:
    return sum(len(drawn.batch(i)) for i in range(len(drawn)))


def test_sampling_and_pixels_are_heeded(rng, views) -> None:
    gaussians = random_gaussians(rng)
    ids = torch.full((12, 16), 3)
    ids[0, :6] = 8
    maps = Maps({view.name: LabelMap(ids=ids) for view in views})
    rare = {}
    for sampling in ("uniform", "groups"):
        sampler = sampler_of(gaussians, views, maps, pixels=12, sampling=sampling)
        with sampler.draw(rng, batch=100) as drawn:
            assert drawn_pixels(drawn) == 36
            rare[sampling] = int((drawn.batch(0).target("label") == 1).sum())
        with sampler.draw(rng, batch=100, pixels=5) as drawn:
            assert drawn_pixels(drawn) == 15
    assert rare["groups"] == 18
    assert rare["uniform"] < 10


def test_faint_entries_are_dropped_and_rows_keep_their_sums(rng, views) -> None:
    gaussians, maps = random_gaussians(rng, 60), random_maps(rng, views, IDS)
    whole = batches(sampler_of(gaussians, views, maps), np.random.default_rng(1), 10**6)[0]
    options = {"min_weight": 0.1}
    part = batches(sampler_of(gaussians, views, maps, **options), np.random.default_rng(1), 10**6)
    full, kept = dense(whole, 60), dense(part[0], 60)
    assert torch.equal(whole.pixels, part[0].pixels)
    largest = full.max(dim=1, keepdim=True).values
    expected = torch.where((full >= 0.1) | (full == largest), full, 0.0)
    expected *= (full.sum(dim=1) / expected.sum(dim=1).clamp_min(1e-9))[:, None]
    assert 0 < int((expected > 0).sum()) < int((full > 0).sum())
    # Of two that are equally faint and the largest of a row one stays; which, is not said here.
    tied = ((full == largest) & (full > 0)).sum(dim=1) > 1
    assert float(tied.float().mean()) < 0.05
    torch.testing.assert_close(kept[~tied], expected[~tied], rtol=2e-3, atol=1e-4)
    torch.testing.assert_close(kept.sum(dim=1), full.sum(dim=1), rtol=2e-3, atol=1e-4)


@pytest.fixture
def temporary(tmp_path, monkeypatch):
    """Where temporary files go."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path


@pytest.mark.bits
@pytest.mark.parametrize("source", ["labels", "masks"])
def test_spilled_rows_are_the_same_bit_for_bit(rng, views, temporary, source) -> None:
    tmp_path = temporary
    gaussians = random_gaussians(rng, 40)
    if source == "labels":
        targets = LabelTargets(random_maps(rng, views, IDS), [view.name for view in views])
    else:
        targets = MaskTargets(masks_of(rng, views), [view.name for view in views])

    def draw(memory: int) -> tuple[list[Batch], int, int]:
        options = SamplingOptions(pixels=50, memory=memory)
        sampler = RowSampler(gaussians, views, targets, options=options, backend=BACKEND)
        with sampler.draw(np.random.default_rng(4), batch=40) as drawn:
            files = len(list(tmp_path.rglob("*.npy")))
            found = [drawn.batch(i) for i in range(len(drawn))]
            sizes = [one.nbytes for view in drawn._views for one in view.tensors()]
            spilled = sum(size.stat().st_size for size in tmp_path.rglob("*.npy"))
            assert sum(sizes) - spilled <= memory  # no more than that is in memory
        return found, files, spilled

    inside, no_files, none = draw(1 << 30)
    assert (no_files, none) == (0, 0)
    one_view = None
    for memory in (0, 4000):
        outside, files, spilled = draw(memory)
        assert files > 0
        assert spilled > 0
        assert one_view is None or spilled < one_view  # some of it stayed in memory
        one_view = spilled
        assert not list(tmp_path.iterdir())  # gone when the draw was closed
        for mine, other in zip(inside, outside, strict=True):
            assert torch.equal(mine.pixels, other.pixels)
            assert torch.equal(mine.stands_for, other.stands_for)
            assert torch.equal(mine.weights.touched, other.weights.touched)
            assert torch.equal(dense(mine, 40), dense(other, 40))
            for name, target in mine.targets.items():
                twin = other.targets[name]
                if isinstance(target, Ragged):
                    assert torch.equal(target.starts, twin.starts)
                    assert torch.equal(target.values, twin.values)
                else:
                    assert torch.equal(target, twin)


def test_what_does_not_divide_is_spread_over_batches(rng) -> None:
    """Twelve views of 5 pixels in 4 batches: one of each view's batches gets two."""
    views = [View(name=f"v{i:02d}", camera=camera_at(0.01 * i)) for i in range(12)]
    sampler = sampler_of(random_gaussians(rng), views, random_maps(rng, views, IDS), pixels=5)
    sizes = [len(batch) for batch in batches(sampler, rng, 15)]
    assert sum(sizes) == 60
    assert len(sizes) == 4
    assert max(sizes) < 24  # not the same batch for all views


def test_files_go_when_a_draw_fails(rng, views, temporary) -> None:
    gaussians, maps = random_gaussians(rng), random_maps(rng, views, IDS)

    class Failing(LabelTargets):
        def targets(self, name, pixels):
            if name == "v2":
                raise OSError("gone")
            return super().targets(name, pixels)

    source = Failing(maps, ["v0", "v1", "v2"])
    options = SamplingOptions(memory=0)
    sampler = RowSampler(gaussians, views, source, options=options, backend=BACKEND)
    with pytest.raises(OSError, match="gone"):
        sampler.draw(rng, batch=10)
    assert not list(temporary.iterdir())


def masks_of(rng, views) -> Masks:
    drawn = {}
    for view in views:
        masks = torch.zeros(5, 12, 16, dtype=torch.bool)
        masks[0, 2:9, 3:12] = True
        masks[1, 2:5, 3:7] = True
        masks[2] = torch.from_numpy(rng.random((12, 16)) < 0.1)
        masks[4, 11, 15] = True  # 3 is empty
        drawn[view.name] = MaskSet.from_dense(masks)
    return Masks(drawn)


def test_masks_of_a_pixel(rng, views) -> None:
    """Any number of targets a pixel: all masks that contain it, and every mask gets pixels."""
    gaussians, evidence = random_gaussians(rng), masks_of(rng, views)
    source = MaskTargets(evidence, [view.name for view in views])
    options = SamplingOptions(pixels=20, sampling="groups")
    sampler = RowSampler(gaussians, views, source, options=options, backend=BACKEND)
    batch = batches(sampler, rng, 1000)[0]
    members = batch.ragged_target("masks")
    found = set()
    for p in range(len(batch)):
        name = views[int(batch.views[p])].name
        dense_masks = torch.stack([evidence.masks(name).dense(i) for i in range(5)])
        inside = torch.nonzero(dense_masks.reshape(5, -1)[:, int(batch.pixels[p])]).squeeze(1)
        assert members.row(p).tolist() == inside.tolist()
        found |= {(name, m) for m in inside.tolist()}
    assert found == {(view.name, m) for view in views for m in (0, 1, 2, 4)}
    uniform = RowSampler(
        gaussians, views, source, options=SamplingOptions(pixels=192), backend=BACKEND
    )
    everything = batches(uniform, rng, 1000)[0]
    assert len(everything) == 3 * 192  # pixels outside all masks too
    with pytest.raises(InputError, match="expected one 'masks' a pixel, got Ragged"):
        batch.target("masks")
    with pytest.raises(InputError, match="any number of 'label' a pixel, got NoneType"):
        batch.ragged_target("label")
    none = Masks({"v0": MaskSet.from_dense(torch.zeros(1, 12, 16, dtype=torch.bool))})
    with pytest.raises(InputError, match="expected a mask in 1 views"):
        MaskTargets(none, ["v0"])


def test_masks_of_other_views_or_sizes_have_another_fingerprint() -> None:
    """Whole views, whose run lengths are alike."""
    lying, standing = (MaskSet.from_dense(torch.ones(1, *size) > 0) for size in ((3, 4), (4, 3)))
    given = [{"a": lying}, {"b": lying}, {"a": standing}]
    prints = [MaskTargets(Masks(masks), [*masks]).fingerprint for masks in given]
    assert len(set(prints)) == 3
    assert MaskTargets(Masks(given[0]), ["a"]).fingerprint == prints[0]


def test_a_view_without_labels_gives_no_pixels(rng, views) -> None:
    gaussians = random_gaussians(rng)
    maps = dict(random_maps(rng, views, IDS).maps)
    maps["v1"] = LabelMap(ids=torch.full((12, 16), -1))
    for sampling in ("uniform", "groups"):
        sampler = sampler_of(gaussians, views, Maps(maps), pixels=7, sampling=sampling)
        found = batches(sampler, rng, 5)
        assert sum(len(batch) for batch in found) == 14
        assert not any(bool((batch.views == 1).any()) for batch in found)
    empty = sampler_of(gaussians, views, Maps(maps)).of_views([views[1]])
    with pytest.raises(InputError, match="something to learn in 1, found none"):
        empty.draw(rng, batch=5)


def test_held_out_views_are_spread() -> None:
    views = [View(name=f"v{i:02d}", camera=camera_at()) for i in range(20)]
    kept, held = held_out_views(views[::-1], 0.2)
    assert [view.name for view in held] == ["v02", "v07", "v12", "v17"]
    assert len(kept) == 16
    assert held_out_views(views, 0.0)[1] == []
    assert len(held_out_views(views[:2], 0.9)[1]) == 1
    assert held_out_views(views[:3], 0.1)[1] == []


def test_fingerprints_tell_what_is_other(rng, views) -> None:
    gaussians, maps = random_gaussians(rng), random_maps(rng, views, IDS)
    first = sampler_of(gaussians, views, maps).fingerprints
    assert sampler_of(gaussians, views[::-1], maps).fingerprints == first
    moved = gaussians.replace(means=gaussians.means + 1e-3)
    other = random_maps(rng, views, IDS)
    turned = [View(name=view.name, camera=camera_at(0.7)) for view in views]
    sure = Maps(
        {
            name: LabelMap(ids=found.ids, confidence=torch.rand(12, 16))
            for name, found in maps.maps.items()
        }
    )
    for changed, what in (
        (sampler_of(moved, views, maps), "Gaussians"),
        (sampler_of(gaussians, views, other), "evidence"),
        (sampler_of(gaussians, turned, maps), "views"),
        (sampler_of(gaussians, views, sure), "evidence"),
    ):
        found = changed.fingerprints
        assert {name for name in first if found[name] != first[name]} == {what}


def test_bad_input_is_refused(rng, views) -> None:
    gaussians, maps = random_gaussians(rng), random_maps(rng, views, IDS)
    for wrong in (
        {"pixels": 0},
        {"min_weight": 1.5},
        {"memory": -1},
    ):
        with pytest.raises(RangeError, match=next(iter(wrong))):
            SamplingOptions(**wrong)
    with pytest.raises(InputError, match="sampling"):
        SamplingOptions(sampling="best")
    with pytest.raises(InputError, match="folder: this option was removed; set TMPDIR"):
        SamplingOptions(folder="x")
    with pytest.raises(ShapeError, match="starts: expected to begin with 0 and end with 2"):
        Ragged(starts=torch.tensor([0, 1]), values=torch.zeros(2))
    with sampler_of(gaussians, views, maps).draw(rng, batch=100) as drawn:
        with pytest.raises(InputError, match="at least one view"):
            sampler_of(gaussians, views, maps).of_views([])
        assert len(drawn) > 1


def test_batches_of_few_views_take_all_their_pixels_once(rng, views) -> None:
    """With two views a batch: pairs of pixels of one view, and each pixel in one batch."""
    maps = random_maps(rng, views, (1, 2), void=0.1)
    source = LabelTargets(maps, [view.name for view in views])
    options = SamplingOptions(pixels=60, views_per_batch=2)
    sampler = RowSampler(random_gaussians(rng), views, source, options=options, backend=BACKEND)
    with sampler.draw(np.random.default_rng(3), batch=30) as drawn:
        batches = [drawn.batch(i) for i in range(len(drawn))]
    assert [len(torch.unique(batch.views)) for batch in batches].count(2) == 4
    assert all(len(batch) == 30 for batch in batches)
    seen = torch.cat([batch.views * 1000 + batch.pixels for batch in batches])
    assert len(seen) == len(torch.unique(seen)) == 180
    with sampler.draw(np.random.default_rng(3), batch=30) as again:
        assert torch.equal(again.batch(4).pixels, batches[4].pixels)
    with pytest.raises(RangeError, match="views_per_batch: expected at least 1, got 0"):
        SamplingOptions(views_per_batch=0)
