"""The method: what is found, what options do, and that bits repeat."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from splatseg.core import Features, LabelMap, View
from splatseg.core.checkpoints import Checkpoints
from splatseg.errors import InputError, ShapeError
from splatseg.lift.label_maps import ClassifierHead
from splatseg.methods._trained import TrainingContext
from splatseg.methods.cosseg import CossegOptions, train_cosseg
from splatseg.methods.cosseg.features import ReducedBlocks
from splatseg.methods.cosseg.options import COMPONENTS, HEAD
from splatseg.methods.cosseg.points import spatial_features
from splatseg.methods.cosseg.train import decoded_in_views

from .conftest import Blocks, Maps, camera

DRAWN_BY = "auto"  # training is the same on all; what renders is tested in lift
QUICK = {"steps": 30, "batch": 200, "pixels": 200, "held_out": 0.0, "rate": 0.01}


@pytest.fixture(autouse=True)
def small(monkeypatch):
    """A small decoder."""
    monkeypatch.setattr("splatseg.methods.cosseg.options.DECODED", (6, 5))
    monkeypatch.setattr("splatseg.methods.cosseg.options.PUBLISHED_DECODED", (6, 5))
    monkeypatch.setattr("splatseg.methods.cosseg.train.HEAD", (8, 4))
    monkeypatch.setattr("splatseg.methods.cosseg.options.PUBLISHED_DROPOUT", 0.0)


def context(**changes) -> TrainingContext:
    return TrainingContext(backend=DRAWN_BY, **{"seed": 3} | changes)


def trained(halves, encoder_file, *, given=None, features=True, **changes) -> Features:
    options = CossegOptions(**QUICK | {"encoder": encoder_file} | changes)
    return train_cosseg(
        halves.gaussians, halves.views, halves.evidence,
        features=halves.blocks if features else None, options=options, metres_per_unit=1.0,
        context=given or context(),
    )  # fmt: skip


def right(halves, features: Features) -> float:
    """Share of Gaussians away from the middle that have their half's id."""
    labels = ClassifierHead.of(features).labels(features)
    away = halves.means[:, 0].abs() > 0.1
    return float((labels.ids == halves.side)[away].float().mean())


@pytest.mark.parametrize(
    "change",
    [
        {},
        {"spatial": "none"},
        {"semantic": "none", "steps": 150},
        {"spatial": "first", "semantic": "first"},
        {"points": "visible"},
    ],
)
def test_halves_are_told_apart(halves, encoder_file, change) -> None:
    features = trained(halves, encoder_file, **{"steps": 80} | change)
    assert features.values.shape == (384, 4)
    wanted = 0.8 if change.get("semantic") == "none" else 0.97
    assert right(halves, features) > wanted
    assert features.info.method == "cosseg"
    assert features.info.details["decoded"] == 384


def test_one_view_that_errs_is_overruled_by_what_is_alike(halves, encoder_file) -> None:
    maps = dict(halves.evidence.maps)
    ids = maps["v1"].ids.clone()
    ids[:, :8] = 8  # a strip of the left half
    maps["v1"] = LabelMap(ids=ids)
    wrong = replace_evidence(halves, Maps(maps))
    assert right(halves, trained(wrong, encoder_file, steps=80)) > 0.97


def replace_evidence(halves, evidence):
    class Changed:
        def __getattr__(self, name):
            return evidence if name == "evidence" else getattr(halves, name)

    return Changed()


@pytest.mark.parametrize(
    "change",
    [
        {"semantic": "first"},
        {"semantic": "none"},
        {"spatial": "first"},
        {"spatial": "none"},
        {"points": "visible"},
        {"rate": 0.02},
        {"steps": 20},
        {"batch": 100},
        {"pixels": 150},
        {"sampling": "groups"},
        {"passes": 1},
        {"min_weight": 0.3},
        {"schedule": "constant"},
        {"final_rate": 0.5},
        {"held_out": 0.3},
    ],
)
def test_each_option_makes_a_difference(halves, encoder_file, change) -> None:
    usual, changed = trained(halves, encoder_file), trained(halves, encoder_file, **change)
    same_shape = usual.values.shape == changed.values.shape
    assert not (same_shape and torch.equal(usual.values, changed.values))


@pytest.mark.parametrize(
    ("name", "value"),
    [("features.COMPONENTS", 2), ("features.LIFTED_SIDE", 16), ("train.HEAD", (4,)),
     ("options.DECODED", (6, 7))],
)  # fmt: skip
def test_each_constant_counts(halves, encoder_file, monkeypatch, name, value) -> None:
    usual = trained(halves, encoder_file).values
    monkeypatch.setattr(f"splatseg.methods.cosseg.{name}", value)
    if name == "features.COMPONENTS":
        monkeypatch.setattr(ReducedBlocks.__init__, "__kwdefaults__", {"components": value})
    changed = trained(halves, encoder_file).values
    assert not (usual.shape == changed.shape and torch.equal(usual, changed))


def test_gaussians_in_few_pixels_are_left_to_their_neighbours(
    halves, encoder_file, monkeypatch
) -> None:
    from splatseg.methods.cosseg.features import pixel_counts

    counts = pixel_counts(halves.gaussians, halves.views, backend=DRAWN_BY)
    least = int(counts.median())
    monkeypatch.setattr("splatseg.methods.cosseg.options.PUBLISHED_MIN_PIXELS", least)
    features = trained(halves, encoder_file, points="visible")
    few = counts < least
    assert features.weights is not None
    assert bool((features.weights[few] == 0).all())
    assert not features.values[few].any()
    assert features.info.details["decoded"] == int((~few).sum())
    labels = ClassifierHead.of(features).labels(features)
    assert bool((labels.ids[few] == -1).all())
    assert bool((labels.ids[~few] != -1).all())
    monkeypatch.setattr("splatseg.methods.cosseg.options.PUBLISHED_MIN_PIXELS", 10_000)
    with pytest.raises(InputError, match="at least 10000 pixels, got none of 384"):
        trained(halves, encoder_file, points="visible")


def test_what_was_skipped_and_assumed_is_recorded(halves, encoder_file) -> None:
    features = trained(halves, encoder_file)
    details = features.info.details
    assert details["blocks"] == ["block3", "block12"]
    assert details["skipped"] == ["class token", "principal components"]
    assert details["point_network"] == encoder_file.name
    assert (details["metres_per_unit"], details["scale_assumed"]) == (1.0, False)
    assert features.info.options["encoder"] == encoder_file.name
    unknown = train_cosseg(
        halves.gaussians, halves.views, halves.evidence, features=halves.blocks,
        options=CossegOptions(**QUICK | {"encoder": encoder_file}), context=context(),
    )  # fmt: skip
    assert unknown.info.details["scale_assumed"] is True


@pytest.mark.bits
@pytest.mark.parametrize("points", ["all", "visible"])
def test_bits_do_not_depend_on_threads_or_on_the_order_of_views(
    halves, encoder_file, points
) -> None:
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        first = trained(halves, encoder_file, points=points)
        torch.set_num_threads(2)
        second = trained(halves, encoder_file, points=points)
    finally:
        torch.set_num_threads(before)
    assert torch.equal(first.values, second.values)
    turned = replace_views(halves)
    assert torch.equal(trained(turned, encoder_file, points=points).values, first.values)
    other = trained(halves, encoder_file, points=points, given=context(seed=4))
    assert not torch.equal(other.values, first.values)


def replace_views(halves):
    class Changed:
        def __getattr__(self, name):
            return halves.views[::-1] if name == "views" else getattr(halves, name)

    return Changed()


def interrupted(halves, encoder_file, folder, **setting):
    """The layer of a training that was interrupted and went on, and the context it went on with."""
    path = folder / "training.npz"

    def stop(done: int, _: int) -> None:
        if done == 11:
            raise KeyboardInterrupt

    stopped = context(checkpoints=Checkpoints(path=path), progress=stop)
    with pytest.raises(KeyboardInterrupt):
        trained(halves, encoder_file, given=stopped, **setting)
    resumed = context(checkpoints=Checkpoints(path=path, resume=True))
    return trained(halves, encoder_file, given=resumed, **setting), resumed


@pytest.mark.bits
def test_what_was_interrupted_goes_on_to_the_same_bits(halves, encoder_file, tmp_path) -> None:
    again, resumed = interrupted(halves, encoder_file, tmp_path)
    assert torch.equal(again.values, trained(halves, encoder_file).values)
    with pytest.raises(InputError, match="distilled"):
        trained(halves, encoder_file, given=resumed, features=False)


def test_points_of_views_lie_in_files_beyond_the_budget(halves, encoder_file) -> None:
    whole = trained(halves, encoder_file, points="visible")
    spilled = trained(halves, encoder_file, points="visible", memory=0)
    assert torch.equal(whole.values, spilled.values)


@pytest.mark.parametrize(
    ("changes", "views"), [({}, 4), ({"held_out": 0.3}, 3), ({"points": "all"}, None)]
)
def test_what_views_decode_is_stored_where_they_were_learnt_from(
    halves, encoder_file, monkeypatch, changes, views
) -> None:
    """The views that were learnt from, not those held out; elsewhere all are decoded together."""
    found = []

    def spied(points, *given):
        found.append(len(points := list(points)))
        return torch.full_like(decoded_in_views(points, *given), 7.0)

    monkeypatch.setattr("splatseg.methods.cosseg.train.decoded_in_views", spied)
    layer = trained(halves, encoder_file, **VISIBLE | {"steps": 2} | changes)
    assert found == ([] if views is None else [views])
    assert bool((layer.values == 7).all()) == (views is not None)


def test_views_have_the_coordinates_of_the_scene(halves, encoder_file, monkeypatch) -> None:
    """One origin and one scale, though views show different parts of the wall."""
    found = []

    def spied(*given, **named):
        pyramid, levels = spatial_features(*given, **named)
        found.append((given[1].double(), pyramid.positions.double()))
        return pyramid, levels

    monkeypatch.setattr("splatseg.methods.cosseg.points.spatial_features", spied)
    options = CossegOptions(**QUICK | VISIBLE | {"encoder": encoder_file, "steps": 4})
    moved = [View(name=f"v{x}", camera=camera(x / 2)) for x in (-2, -1, 1, 2)]
    maps = Maps({view.name: LabelMap(ids=halves.ids(view)) for view in moved})
    blocks = Blocks({view.name: halves.deep(view) for view in moved})
    train_cosseg(halves.gaussians, moved, maps, features=blocks, options=options, context=context())
    assert len(found) == 5  # the scene and four views
    assert len({len(points) for points, _ in found}) > 1
    whole, local = found[0]
    scale = (local[1:] - local[0]).norm() / (whole[1:] - whole[0]).norm()
    origin = (whole * scale - local).mean(dim=0)
    for points, fed in found:
        torch.testing.assert_close(points * scale - origin, fed, atol=1e-4, rtol=1e-4)


VISIBLE = {"points": "visible", "views_per_step": 4}


@pytest.mark.parametrize("change", [{"views_per_step": 2}, {}, {"sampling": "strata"}])
def test_options_of_a_step_make_a_difference(halves, encoder_file, monkeypatch, change) -> None:
    usual = trained(halves, encoder_file, **VISIBLE)
    if not change:
        monkeypatch.setattr("splatseg.methods.cosseg.options.PUBLISHED_DROPOUT", 0.5)
    changed = trained(halves, encoder_file, **VISIBLE | change)
    assert not torch.equal(usual.values, changed.values)


def test_a_step_is_of_as_many_views_as_it_says() -> None:
    """Batches of one view each, of which a step takes several; `batch` is all its pixels."""
    options = CossegOptions(points="visible", views_per_step=8, batch=4096)
    training = options.training()
    assert options.drawing().views_per_batch == 1
    assert (training.batch, training.accumulate) == (512, 8)
    for other in ({"points": "all"}, {"spatial": "none"}):
        usual = replace(options, **other)
        assert usual.drawing().views_per_batch is None
        assert (usual.training().batch, usual.training().accumulate) == (4096, 1)


def test_what_was_interrupted_under_the_published_setting_goes_on(
    halves, encoder_file, tmp_path, monkeypatch
) -> None:
    """With running statistics and drop-out; the layer knows its loss curve."""
    monkeypatch.setattr("splatseg.methods.cosseg.options.PUBLISHED_DROPOUT", 0.5)
    setting = VISIBLE | {"sampling": "strata"}
    whole = trained(halves, encoder_file, **setting)
    again, _ = interrupted(halves, encoder_file, tmp_path, **setting)
    assert torch.equal(again.values, whole.values)
    curve = whole.info.details["loss_curve"]
    assert again.info.details["loss_curve"] == curve
    assert [step for step, _ in curve] == list(range(1, 31))
    assert curve[-1][1] < curve[0][1]


def test_the_published_setting(monkeypatch) -> None:
    """As the papers print it: Dou et al. 3.3, 4.1; Hu et al. Fig. 7 and their S3DIS settings."""
    monkeypatch.undo()
    published = CossegOptions.published()
    assert (published.rate, published.schedule, published.steps) == (1e-3, "constant", 10_000)
    assert (published.points, published.blend) == ("visible", "features")
    assert published.decoded == (32, 32, 128, 256, 512, 1024)
    assert (HEAD, COMPONENTS) == ((64, 32), 64)
    assert (published.dropout, published.min_pixels) == (0.5, 10)
    assert (published.semantic, published.spatial) == ("all", "all")
    assert (published.held_out, published.patience, published.readout) == (0.0, 0, "rendered")
    assert (published.views_per_step, published.batch, published.sampling) == (8, 4096, "strata")


def test_the_published_setting_learns(halves, encoder_file) -> None:
    """As it is, but for widths and pixels; and it says how far it went."""
    options = replace(
        CossegOptions.published(steps=60), encoder=encoder_file, rate=0.01, batch=200, pixels=200,
        views_per_step=4,
    )  # fmt: skip
    features = train_cosseg(
        halves.gaussians, halves.views, halves.evidence, features=halves.blocks, options=options,
        metres_per_unit=1.0, context=context(),
    )  # fmt: skip
    assert right(halves, features) > 0.97
    said = "60 steps of 4 views x 50 pixels, not the published setting"
    assert features.info.details["trained"] == said
    assert features.info.details["point_network_trained_on"] == "what the file does not say"


def test_how_long_it_was_trained_is_said_beside_what_was_published() -> None:
    options = replace(CossegOptions.published(steps=700), encoder=Path("other.safetensors"))
    assert options.trained(650) == "published, 650 of 10000 steps of 8 views x 512 pixels"
    assert CossegOptions(batch=90).trained(3) == (
        "3 steps of 90 pixels of all views, not the published setting"
    )


def test_bad_input_is_one_clear_sentence(halves, encoder_file) -> None:
    some = Blocks({name: one for name, one in halves.blocks.found.items() if name != "v2"})
    with pytest.raises(InputError, match="1 of 4 have none, the first is v2"):
        train_cosseg(
            halves.gaussians, halves.views, halves.evidence, features=some,
            options=CossegOptions(**QUICK | {"encoder": encoder_file}), context=context(),
        )  # fmt: skip
    narrow = Blocks(dict(halves.blocks.found))
    one = narrow.found["v3"]
    first = replace(one.maps[0], features=one.maps[0].features[..., :2])
    narrow.found["v3"] = replace(one, maps=(first, *one.maps[1:]))
    with pytest.raises(ShapeError, match="expected 3 channels of block3 of view v3"):
        train_cosseg(
            halves.gaussians, halves.views, halves.evidence, features=narrow,
            options=CossegOptions(**QUICK | {"encoder": encoder_file}), context=context(),
        )  # fmt: skip
    few = halves.gaussians[torch.arange(20)]
    with pytest.raises(InputError, match="expected at least 36 points"):
        train_cosseg(
            few, halves.views, halves.evidence, features=halves.blocks,
            options=CossegOptions(**QUICK | {"encoder": encoder_file}), context=context(),
        )  # fmt: skip
    with pytest.raises(InputError, match="features: expected evidence of features to decode"):
        trained(halves, encoder_file, features=False, spatial="none")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"semantic": "none", "spatial": "none"}, "expected one of the two"),
        ({"views_per_step": 0}, "views_per_step: expected at least 1"),
        ({"joint_steps": 0}, "joint_steps: expected at least 1"),
        ({"rate": -1.0}, "rate: expected at least 0"),
        ({"spatial": "some"}, "spatial: expected one of"),
        ({"transitions": "views"}, "transitions: this option was removed; it was measured"),
    ],
)
def test_options_out_of_range_are_refused(change, message) -> None:
    with pytest.raises(InputError, match=message):
        CossegOptions(**change)
