"""Features as a source: queries, thresholds, gate, negatives, masks by 2D features."""

import pytest
import torch

from splatseg.core import FeatureMap, Features, LayerInfo
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.lift.affinity import AffinityHead, projector_shapes
from splatseg.prompting import feature_source
from splatseg.prompting.feature_source import (
    FeatureMembership,
    FeatureMembershipOptions,
)
from splatseg.prompting.prompts import ViewPrompt
from splatseg.prompting.seen import see_prompts
from support.wall import HEIGHT, SKY_ROWS, WIDTH, field_ids


@pytest.fixture
def values(gaussians) -> torch.Tensor:
    """Four directions, one a field; the fields of a half share a component."""
    ids = field_ids(gaussians).clamp_min(0).long()
    table = torch.tensor(
        [[0.0] * 4, [1, 0.6, 0, 0], [0, 0, 1, 0.6], [0.6, 1, 0, 0], [0, 0, 0.6, 1]]
    )
    return table[ids]


def clicks(gaussians, view, *points, negative=()):
    signs = torch.tensor([True] * len(points) + [False] * len(negative))
    prompt = ViewPrompt(
        view=view, points=torch.tensor([*points, *negative], dtype=torch.float32), positive=signs
    )
    return see_prompts(gaussians, [prompt])


UPPER_LEFT, LOWER_LEFT, UPPER_RIGHT = (10.5, 15.5), (10.5, 25.5), (25.5, 15.5)


def test_what_is_like_the_click_is_found(gaussians, view, values) -> None:
    source = FeatureMembership(
        Features(values=values), gaussians, options=FeatureMembershipOptions(threshold=0.95)
    )
    found = source.membership(clicks(gaussians, view, UPPER_LEFT))
    assert torch.equal(found > 0.5, field_ids(gaussians) == 1)
    assert found.min() >= 0
    assert found.max() <= 1


def test_the_threshold_decides_how_much(gaussians, view, values) -> None:
    ids = field_ids(gaussians)
    loose = FeatureMembership(
        Features(values=values), gaussians, options=FeatureMembershipOptions(threshold=0.8)
    )
    found = loose.membership(clicks(gaussians, view, UPPER_LEFT))
    assert torch.equal(found > 0.5, (ids == 1) | (ids == 3)), "cosine 1.2 / 1.36 = 0.88"


def test_negative_points_take_away_what_is_more_like_them(gaussians, view, values) -> None:
    source = FeatureMembership(
        Features(values=values), gaussians, options=FeatureMembershipOptions(threshold=0.8)
    )
    found = source.membership(clicks(gaussians, view, UPPER_LEFT, negative=[LOWER_LEFT]))
    assert torch.equal(found > 0.5, field_ids(gaussians) == 1)


def test_the_threshold_of_points_is_the_mean_of_cosines(gaussians, view, values) -> None:
    """Longer features are no nearer."""
    longer = values * torch.linspace(1, 9, len(values))[:, None]
    ids = field_ids(gaussians)
    for some in (values, longer):
        options = FeatureMembershipOptions(rule="adaptive", threshold=1.0)
        source = FeatureMembership(Features(values=some), gaussians, options=options)
        found = source.membership(clicks(gaussians, view, UPPER_LEFT)) > 0.5
        assert torch.equal(found, (ids == 1) | (ids == 3))


def test_the_gate_of_the_granularity_is_used(gaussians, view) -> None:
    ids = field_ids(gaussians)
    # Channels 0 and 1 tell left from right, 2 and 3 upper from lower: open for parts alone.
    half, level = ((ids == 2) | (ids == 4)).long(), ((ids == 3) | (ids == 4)).long()
    values = torch.cat((torch.eye(2)[half], torch.eye(2)[level]), dim=1)
    head = AffinityHead(
        channels=4,
        unit=True,
        gate_weight=torch.tensor([0.0, 0.0, -40.0, -40.0]),
        gate_bias=torch.tensor([10.0, 10.0, 10.0, 10.0]),
        levels=(1.0, 0.5, 0.0),
    )
    layer = Features(values=values, info=LayerInfo(head=head.to_json()))
    source = FeatureMembership(layer, gaussians)
    seen = clicks(gaussians, view, UPPER_LEFT)
    whole = source.membership(seen, granularity=0.5) > 0.5
    part = source.membership(seen, granularity=1.0) > 0.5
    named = ids > 0
    assert torch.equal(whole[named], ((ids == 1) | (ids == 3))[named])
    assert torch.equal(part[named], (ids == 1)[named])
    assert torch.equal(source.membership(seen) > 0.5, whole), "objects, where nothing is asked"


def test_what_was_never_seen_is_out_and_said(gaussians, view, values) -> None:
    weights = torch.ones(len(values))
    weights[::3] = 0
    source = FeatureMembership(Features(values=values, weights=weights), gaussians)
    assert source.unseen is not None
    assert torch.equal(source.unseen, weights == 0)
    assert not (source.membership(clicks(gaussians, view, UPPER_LEFT))[::3] > 0).any()
    assert FeatureMembership(Features(values=values), gaussians).unseen is None


def region(rows: slice, columns: slice) -> torch.Tensor:
    mask = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    mask[rows, columns] = True
    return mask


def test_a_mask_over_two_fields_asks_with_several_queries(
    gaussians, view, values, monkeypatch
) -> None:
    mask = region(slice(SKY_ROWS + 1, HEIGHT - 1), slice(0, 19))
    seen = see_prompts(gaussians, [ViewPrompt(view=view, mask=mask)])
    ids = field_ids(gaussians)
    options = FeatureMembershipOptions(threshold=0.99)
    several = FeatureMembership(Features(values=values), gaussians, options=options)
    assert torch.equal(several.membership(seen) > 0.5, (ids == 1) | (ids == 3))
    monkeypatch.setattr(feature_source, "_CLUSTERS", 1)
    one = FeatureMembership(Features(values=values), gaussians, options=options)
    assert not (one.membership(seen) > 0.5).any(), "their mean is like neither"


def projected_to(direction):
    """A head whose projection is one direction, whatever the 2D features are."""
    arrays = {name: torch.zeros(shape) for name, shape in projector_shapes(4, 4).items()}
    arrays[max(name for name in arrays if name.startswith("bias"))] = torch.tensor(direction)
    return AffinityHead(channels=4, unit=False, projector=arrays)


def same_everywhere(of) -> FeatureMap:
    return FeatureMap(
        features=torch.ones(HEIGHT // 2, WIDTH // 2, 4), stride=2, height=HEIGHT, width=WIDTH
    )


def test_masks_asked_by_2d_features_are_products_above_mean_and_deviation(
    gaussians, view, values
) -> None:
    """Equation 12: a longer feature scores higher, which a cosine does not see."""
    ids = field_ids(gaussians)
    query = torch.tensor([0.0, 0.0, 1.0, 0.6])
    values = torch.where((ids == 4)[:, None], 3 * values, values)
    head = projected_to(query.tolist())
    layer = Features(values=values, info=LayerInfo(head=head.to_json()))
    mask = region(slice(SKY_ROWS + 1, 19), slice(21, 34))
    seen = see_prompts(gaussians, [ViewPrompt(view=view, mask=mask)])
    products = values.double() @ query.double()
    limit = products.mean() + products.std(correction=0)
    expected = products > limit
    assert torch.equal(expected, ids == 4), "not the field of the mask, which is shorter"
    options = FeatureMembershipOptions(rule="adaptive")
    source = FeatureMembership(layer, gaussians, options=options, guidance=same_everywhere)
    found = source.membership(seen)
    assert torch.equal(found > 0.5, expected)
    assert float(found.max()) == pytest.approx(1.0)
    assert float(found.min()) == pytest.approx(0.0)
    usual = FeatureMembership(
        layer, gaussians, options=FeatureMembershipOptions(threshold=0.97), guidance=same_everywhere
    )
    assert torch.equal(usual.membership(seen) > 0.5, ids == 2), "cosines by default"
    # A point beside it is compared by cosines, and both together mean both.
    both = [*seen, *clicks(gaussians, view, UPPER_LEFT)]
    found = source.membership(both) > 0.5
    assert found[(ids == 4) | (ids == 1)].all()


def test_masks_are_asked_by_2d_features_where_there_are_some(gaussians, view, values) -> None:
    shapes = projector_shapes(4, 4)
    arrays = {name: torch.zeros(shape) for name, shape in shapes.items()}
    last = max(name for name in arrays if name.startswith("bias"))
    # Whatever the 2D features are, the projection is the direction of field 2.
    arrays[last] = torch.tensor([0.0, 0.0, 1.0, 0.6])
    head = AffinityHead(channels=4, unit=False, projector=arrays)
    layer = Features(values=values, info=LayerInfo(head=head.to_json()))
    asked: list[str] = []

    def guidance(of):
        asked.append(of.name)
        return FeatureMap(
            features=torch.ones(HEIGHT // 2, WIDTH // 2, 4), stride=2, height=HEIGHT, width=WIDTH
        )

    mask = region(slice(SKY_ROWS + 1, 19), slice(21, 34))
    seen = see_prompts(gaussians, [ViewPrompt(view=view, mask=mask)])
    options = FeatureMembershipOptions(threshold=0.97)
    source = FeatureMembership(layer, gaussians, options=options, guidance=guidance)
    assert torch.equal(source.membership(seen) > 0.5, field_ids(gaussians) == 2)
    assert asked == ["front"]


def test_the_seed_is_of_the_clusters(gaussians, view, rng) -> None:
    values = torch.from_numpy(rng.normal(size=(len(gaussians), 8))).float()
    seen = see_prompts(gaussians, [ViewPrompt(view=view, mask=region(slice(12, 28), slice(2, 33)))])
    found = [
        FeatureMembership(
            Features(values=values), gaussians, options=FeatureMembershipOptions(seed=seed)
        ).membership(seen)
        for seed in (0, 0, 5)
    ]
    assert torch.equal(found[0], found[1])
    assert not torch.equal(found[0], found[2])


def test_nothing_with_a_feature_is_refused(gaussians, view, values) -> None:
    source = FeatureMembership(Features(values=torch.zeros_like(values)), gaussians)
    with pytest.raises(InputError, match="features where the prompts are"):
        source.membership(clicks(gaussians, view, UPPER_LEFT))


def test_features_of_another_scene_are_refused(gaussians, values) -> None:
    with pytest.raises(ShapeError, match="of another scene"):
        FeatureMembership(Features(values=values[1:]), gaussians)


@pytest.mark.parametrize(
    "change", [{"threshold": 2}, {"clusters": 0}, {"rule": "best"}, {"precision": "float64"}]
)
def test_options_out_of_range_are_refused(change) -> None:
    with pytest.raises((RangeError, InputError), match=next(iter(change))):
        FeatureMembershipOptions(**change)
