"""The method `objects`: every Gaussian of an object has its vector."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from lift.conftest import camera_at, gaussians_at
from splatseg.core import FeatureMap, Features, Labels, View
from splatseg.errors import InputError, ShapeError
from splatseg.io.scene import load_scene
from splatseg.lift import label_map
from splatseg.methods import find_method
from splatseg.methods.objects import (
    ObjectFeatures,
    ObjectFeaturesOptions,
    cell_shares,
    object_features,
)
from splatseg.tasks import SegmentOptions, segment

FEATURES = SegmentOptions(evidence="features_text")


def made(scene, **options) -> Features:
    chosen = ObjectFeaturesOptions(masks="masks_sam", **options)
    layer = segment(scene, "objects", options=FEATURES, method_options=chosen).layer
    assert isinstance(layer, Features)
    return layer


@pytest.fixture(scope="module")
def scene(fitted_room):
    return load_scene(fitted_room)


def test_gaussians_of_an_object_have_one_vector(scene) -> None:
    layer = made(scene)
    info = layer.info
    assert info.method == "objects"
    assert info.options["masks"] == "masks_sam"
    distinct = torch.unique(layer.values[layer.weights > 0], dim=0)
    assert len(distinct) == info.details["objects"] > 5
    assert not layer.values[layer.weights == 0].any()
    # Cells that show an object, over all its Gaussians, are no more than there are.
    assert 0 < float(layer.weights.sum()) <= len(scene.train_views) * 30 * 40
    assert 0 < float(info.details["residual"]) < 1


def test_masks_are_needed(scene) -> None:
    options = find_method("objects").options()
    with pytest.raises(InputError, match="masks: expected evidence of masks"):
        segment(scene, "objects", options=FEATURES, method_options=options)
    with pytest.raises(InputError, match="masks: expected one of those at hand"):
        segment(scene, "objects", options=FEATURES, method_options=replace(options, masks="none"))


STRIDE = 4


@dataclass
class Grids:
    maps: dict[str, FeatureMap]

    @property
    def view_names(self):
        return tuple(self.maps)

    def features(self, name):
        return self.maps[name]


@pytest.fixture
def views() -> list[View]:
    places = enumerate((-0.5, -0.2, 0.0, 0.3, 0.6))
    return [View(name=f"v{i}", camera=camera_at(x, width=48, height=36)) for i, x in places]


@pytest.fixture
def balls():
    """Seven balls, of three objects and none, none of them larger than a few cells."""
    means = [[-0.8, 0.1, 2], [-0.5, -0.3, 2], [0.0, 0.3, 2], [0.2, 0.2, 1.7], [0.5, -0.1, 2.2],
             [0.8, 0.3, 2], [0.9, -0.4, 2]]  # fmt: skip
    gaussians = gaussians_at(means, scale=0.12, opacity=0.95)
    ids = torch.tensor([4, 4, 9, 9, 30, 30, -1])
    return gaussians, Labels(ids=ids.int(), confidence=torch.ones(7))


TRUE = torch.tensor([[1.0, 0, 3], [0, 2, -1], [-2, 1, 0.5], [0.3, 0.3, 0.3]])
"""Of 4, 9, 30 and none."""


def mixed(balls, views, blur: float) -> Grids:
    """What cells show, by loops."""
    gaussians, objects = balls
    maps = {}
    for view in views:
        ids = label_map(gaussians, view.camera, objects).ids
        rows, columns = ids.shape[0] // STRIDE, ids.shape[1] // STRIDE
        shares = np.zeros((rows, columns, 4))
        for i in range(ids.shape[0]):
            for j in range(ids.shape[1]):
                which = {4: 0, 9: 1, 30: 2}.get(int(ids[i, j]), 3)
                shares[i // STRIDE, j // STRIDE, which] += 1 / STRIDE**2
        spread = [gaussian_filter(shares[..., k], blur, mode="nearest") for k in range(4)]
        features = torch.from_numpy(np.stack(spread, axis=2)) @ TRUE.double()
        maps[view.name] = FeatureMap(
            features=features, stride=STRIDE, height=ids.shape[0], width=ids.shape[1]
        )
    return Grids(maps)


@pytest.fixture
def without_ridge(monkeypatch):
    monkeypatch.setattr("splatseg.methods.objects.RIDGE", 1e-9)


@pytest.mark.parametrize("blur", [0.0, 0.7, 1.4])
@pytest.mark.usefixtures("without_ridge")
def test_mixed_features_are_told_apart_whatever_blurred_them(balls, views, blur) -> None:
    evidence = mixed(balls, views, blur)
    found = object_features(balls[0], views, evidence, balls[1])
    assert found.ids.tolist() == [4, 9, 30]
    assert found.blur == blur
    assert found.residual < 1e-4
    torch.testing.assert_close(found.values, TRUE[:3], rtol=0, atol=0.02)
    assert bool((found.cells > 0).all())
    backwards = object_features(balls[0], views[::-1], evidence, balls[1])
    assert torch.equal(backwards.values, found.values)


@pytest.mark.usefixtures("without_ridge")
def test_another_blur_leaves_more(balls, views, monkeypatch) -> None:
    evidence = mixed(balls, views, 1.0)
    best = object_features(balls[0], views, evidence, balls[1])
    monkeypatch.setattr("splatseg.methods.objects.BLURS", (0.0,))
    found = object_features(balls[0], views, evidence, balls[1])
    assert (found.blur, best.blur) == (0.0, 1.0)
    assert found.residual > 10 * best.residual
    assert float((found.values - TRUE[:3]).abs().max()) > 0.1


def test_a_large_ridge_draws_to_the_mean(balls, views, monkeypatch) -> None:
    monkeypatch.setattr("splatseg.methods.objects.RIDGE", 1e9)
    evidence = mixed(balls, views, 0.0)
    mean = torch.cat([grid.features.flatten(0, 1) for grid in evidence.maps.values()]).mean(dim=0)
    found = object_features(balls[0], views, evidence, balls[1])
    torch.testing.assert_close(found.values, mean.float().expand(3, 3), rtol=0, atol=1e-4)


def test_shares_of_cells_by_hand() -> None:
    rows = np.array([[0, 0, 2, 2, 2], [0, 1, 2, 2, 1], [1, 1, 1, 2, 0]])
    grid = FeatureMap(features=torch.zeros(1, 2, 1), stride=2, height=3, width=5)
    there, shares = cell_shares(rows, grid)
    assert there.tolist() == [0, 1, 2]
    # What is beyond the last cells belongs to them.
    np.testing.assert_allclose(shares[0, 0], np.array([3, 3, 0]) / 6)
    np.testing.assert_allclose(shares[0, 1], np.array([1, 2, 6]) / 9)


def test_rows_of_gaussians() -> None:
    found = ObjectFeatures(ids=torch.tensor([3, 7]), values=torch.zeros(2, 4), cells=torch.ones(2))
    objects = Labels(ids=torch.tensor([7, -1, 3, 5]).int(), confidence=torch.ones(4))
    assert found.of_gaussians(objects).tolist() == [1, -1, 0, -1]


def test_an_object_that_no_view_shows_has_the_mean(balls, views) -> None:
    gaussians, objects = balls
    ids = objects.ids.clone()
    behind = torch.cat((gaussians.means, torch.tensor([[0.0, 0, -5]])))
    more = Labels(ids=torch.cat((ids, torch.tensor([99]).int())), confidence=torch.ones(8))
    evidence = mixed(balls, views, 0.0)
    found = object_features(gaussians_at(behind, scale=0.12, opacity=0.95), views, evidence, more)
    assert found.ids.tolist() == [4, 9, 30, 99]
    assert float(found.cells[3]) == 0


def test_what_does_not_fit_is_refused(balls, views) -> None:
    gaussians, objects = balls
    evidence = mixed(balls, views, 0.0)
    none = replace(objects, ids=torch.full((7,), -1).int())
    with pytest.raises(InputError, match="at least one object"):
        object_features(gaussians, views, evidence, none)
    with pytest.raises(ShapeError, match="objects: expected 7 rows, got 1"):
        object_features(
            gaussians, views, evidence, Labels(ids=torch.ones(1).int(), confidence=torch.ones(1))
        )
    wide = evidence.maps["v2"]
    evidence.maps["v2"] = replace(wide, features=torch.zeros(9, 12, 5))
    with pytest.raises(ShapeError, match="expected 3 channels of view v2, as of view v0, got 5"):
        object_features(gaussians, views, evidence, objects)
    evidence.maps["v2"] = replace(wide, features=torch.full((9, 12, 3), torch.nan))
    with pytest.raises(InputError, match="finite features of view v2"):
        object_features(gaussians, views, evidence, objects)
    with pytest.raises(InputError, match="v9"):
        object_features(gaussians, [replace(views[0], name="v9")], evidence, objects)
