"""Gaussians as a field: everything of a view is what it is on its own, from one projection."""

from dataclasses import replace

import pytest
import torch

from splatseg.core import (
    Camera,
    Features,
    Gaussians,
    InstanceTree,
    Labels,
    LayerInfo,
    Renderable,
    Selection,
    TreeNode,
)
from splatseg.errors import InputError, ShapeError
from splatseg.lift import GaussianField, PointLabelOptions, label_map, labels_of_points
from splatseg.lift.label_maps import ClassifierHead
from splatseg.render import RenderOptions, get_backend, render

from .conftest import BACKEND, BARREL, camera_at, gaussians_at, matrix_of, random_gaussians

COUNT = 24


def head_of(blend: str, *, classes: int = 3) -> ClassifierHead:
    generator = torch.Generator().manual_seed(3)
    return ClassifierHead(
        ids=torch.arange(classes) * 5 + 2,
        weight=torch.randn(classes, 4, generator=generator),
        bias=torch.linspace(-0.5, 0.5, classes),
        blend=blend,
    )


def layers_of(rng) -> dict:
    ids = torch.from_numpy(rng.choice([-1, 2, 4, 9], COUNT))
    nodes = (TreeNode(id=2), TreeNode(id=4, parent=2, level="part"), TreeNode(id=9))
    values = torch.from_numpy(rng.normal(size=(COUNT, 4))).float()
    weights = torch.from_numpy(rng.random(COUNT)).float() - 0.2
    confidence = torch.from_numpy(rng.random(COUNT)).float()
    labels = Labels(ids=ids, confidence=confidence, background=9, info=LayerInfo(method="vote"))
    layers = {
        "labels": labels,
        "tree": InstanceTree(nodes=nodes, labels=Labels(ids=ids, confidence=confidence)),
        "chosen": Selection(mask=ids == 4),
        "plain": Features(values=values),
    }
    for blend in ("features", "probabilities"):
        info = LayerInfo(head=head_of(blend).to_json(), names={2: "two"})
        layers[blend] = Features(values=values, weights=weights.clamp_min(0), info=info)
    return layers


@pytest.fixture
def made(rng) -> tuple[Gaussians, dict]:
    return random_gaussians(rng, COUNT), layers_of(rng)


@pytest.mark.parametrize("lens", [{}, BARREL])
def test_a_view_is_what_each_of_its_parts_is_alone(made, lens) -> None:
    gaussians, layers = made
    camera = camera_at(0.1, **lens)
    alone = render(gaussians, camera, backend=BACKEND)
    field: Renderable = GaussianField(gaussians, layers, backend=BACKEND)
    chosen = Labels(ids=torch.where(layers["chosen"].mask, 1, -1), confidence=torch.ones(COUNT))
    expected = {
        "labels": label_map(gaussians, camera, layers["labels"], backend=BACKEND),
        "tree": label_map(gaussians, camera, layers["tree"].cut(), backend=BACKEND),
        "tree@part": label_map(gaussians, camera, layers["tree"].cut("part"), backend=BACKEND),
        "chosen": label_map(gaussians, camera, chosen, backend=BACKEND),
    }
    for blend in ("features", "probabilities"):
        head, layer = head_of(blend), layers[blend]
        expected[blend] = head.label_map(gaussians, camera, layer, backend=BACKEND)
        expected[f"{blend}@rendered"] = expected[blend]
        hard = head.labels(layer)
        expected[f"{blend}@hard"] = label_map(gaussians, camera, hard, backend=BACKEND)
    with field.view(camera) as view:
        shown = {name: view.label_map(name) for name in expected}
        signals, bare = view.signals(), view.signals(colour=False)
        blended = view.features("plain")
    for name, alone_map in expected.items():
        assert torch.equal(shown[name].ids, alone_map.ids), name
        assert torch.equal(shown[name].confidence, alone_map.confidence), name
    assert not torch.equal(shown["tree"].ids, shown["tree@part"].ids)
    assert not torch.equal(shown["features"].ids, shown["features@hard"].ids)
    assert torch.equal(signals.colour, alone.image)
    assert bare.colour is None
    for got in (signals, bare):
        assert torch.equal(got.alpha, alone.alpha)
        assert torch.equal(got.depth, alone.depth)
        assert torch.equal(got.median_depth, alone.median_depth)
    values = layers["plain"].values
    assert torch.equal(blended, render(gaussians, camera, values, backend=BACKEND).image)


def test_one_projection_a_view(made, monkeypatch) -> None:
    gaussians, layers = made
    backend = type(get_backend("cpu"))
    prepared = []
    prepare = backend.prepare

    def counted(self, *arguments, **options):
        prepared.append(1)
        return prepare(self, *arguments, **options)

    monkeypatch.setattr(backend, "prepare", counted)
    field = GaussianField(gaussians, layers, backend="cpu")
    with field.view(camera_at(**BARREL)) as view:
        view.signals()
        for layer in ("labels", "tree@group", "chosen", "features", "probabilities@hard"):
            view.label_map(layer)
            view.confidence(layer)
    assert len(prepared) == 1


def test_options_of_the_blending_model_are_heeded(made) -> None:
    gaussians, layers = made
    camera = camera_at()
    sharp = RenderOptions(near=1.9)
    field = GaussianField(gaussians, layers, options=sharp, backend=BACKEND)
    with field.view(camera) as view:
        alpha, shown = view.signals().alpha, view.label_map("labels")
    assert torch.equal(alpha, render(gaussians, camera, options=sharp, backend=BACKEND).alpha)
    assert not torch.equal(alpha, render(gaussians, camera, backend=BACKEND).alpha)
    expected = label_map(gaussians, camera, layers["labels"], options=sharp, backend=BACKEND)
    assert torch.equal(shown.ids, expected.ids)


def test_confidence_is_the_mean_of_what_a_pixel_shows(made) -> None:
    gaussians, layers = made
    camera = camera_at()
    matrix = matrix_of(gaussians, camera).float()
    alpha = matrix.sum(dim=-1)
    mean = (matrix @ layers["labels"].confidence) / alpha.clamp_min(1e-6)
    field = GaussianField(gaussians, layers, options=RenderOptions(), backend=BACKEND)
    with field.view(camera) as view:
        sure = view.confidence("labels")
        trained = view.confidence("probabilities")
        own = view.label_map("probabilities").confidence
    covered = alpha > 0.02
    assert 0.1 < float(covered.float().mean()) < 0.9
    torch.testing.assert_close(sure[covered], mean[covered], rtol=0, atol=1e-4)
    assert torch.equal(trained[covered], own[covered])
    for found in (sure, trained):
        assert bool((found[~covered] == -1).all())


def test_what_there_is_to_know_of_layers(made) -> None:
    gaussians, layers = made
    field = GaussianField(gaussians, layers)
    assert field.layer_names == tuple(layers)
    said = field.layer("labels")
    assert (said.kind, said.ids, said.background) == ("labels", (2, 4, 9), 9)
    assert said.info.method == "vote"
    assert field.layer("tree").ids == (2, 9)
    assert field.layer("tree@part").ids == (2, 4, 9)
    assert (field.layer("chosen").kind, field.layer("chosen").ids) == ("selection", (1,))
    assert field.layer("plain").kind == "features"
    # Rendered features of nothing are zeros, to which the classifier says its largest bias.
    trained = field.layer("features")
    assert (trained.kind, trained.ids, trained.background) == ("labels", (2, 7, 12), 12)
    assert trained.info.names == {2: "two"}
    assert field.layer("probabilities").background == -1


def test_nothing_is_labelled_as_the_layer_says(made) -> None:
    _, layers = made
    behind = gaussians_at([[0, 0, -5.0]] * COUNT)
    field = GaussianField(behind, layers, backend=BACKEND)
    with field.view(camera_at()) as view:
        for name in ("labels", "features", "probabilities"):
            assert bool((view.label_map(name).ids == field.layer(name).background).all()), name


def test_the_hard_readout_heeds_the_recorded_min_share(made) -> None:
    gaussians, layers = made
    layer = layers["features"]
    info = replace(layer.info, options={"min_share": 0.7})
    strict = replace(layer, info=info)
    head = head_of("features")
    field = GaussianField(gaussians, {"a": layer, "b": strict})
    assert torch.equal(field.labels("a").ids, head.labels(layer).ids)
    expected = head.labels(layer, min_share=0.7)
    assert torch.equal(field.labels("b").ids, expected.ids)
    assert int((expected.ids == -1).sum()) > int((field.labels("a").ids == -1).sum())
    assert field.labels("b").info.head is None


def test_points_take_labels_by_the_layers_own_readout(made) -> None:
    gaussians, layers = made
    points = gaussians.means[:9] + 0.05
    field = GaussianField(gaussians, layers)
    found = field.labels_at(points, "labels")
    expected = labels_of_points(gaussians, layers["labels"].ids, points)
    assert torch.equal(found.ids, expected.ids)
    assert torch.equal(found.confidence, expected.confidence)
    nearest = PointLabelOptions(rule="nearest", min_opacity=0.0)
    hard = GaussianField(gaussians, layers, points=nearest)
    at_centres = hard.labels_at(gaussians.means, "labels")
    assert at_centres.ids.tolist() == layers["labels"].ids.tolist()
    # At its centre, the nearest Gaussian's own features are classified.
    for blend in ("features", "probabilities"):
        own = head_of(blend).labels(layers[blend])
        seen = layers[blend].weights > 0
        ids = hard.labels_at(gaussians.means, blend).ids
        assert ids[seen].tolist() == own.ids[seen].tolist()
    inside = field.labels_at(gaussians.means, "chosen").ids
    assert set(inside.tolist()) == {1, -1}


@pytest.mark.parametrize("blend", ["features", "probabilities"])
def test_many_classes_are_read_a_few_at_a_time(made, blend) -> None:
    """Classes in several parts, of rendered and of own logits, as one dense product says."""
    gaussians, layers = made
    camera = camera_at()
    matrix = matrix_of(gaussians, camera).float()
    values = torch.randn(COUNT, 70, generator=torch.Generator().manual_seed(1))
    bias = torch.linspace(0, 1, 70)
    weight = torch.randn(70, 4, generator=torch.Generator().manual_seed(2))
    weights = layers["features"].weights
    assert bool((weights == 0).any()), "some Gaussians were never seen: they have no label"
    for features, matrix_of_head, shift in (
        (values, None, bias), (values, None, None), (layers["plain"].values, weight, bias),
    ):  # fmt: skip
        head = ClassifierHead(ids=torch.arange(70), weight=matrix_of_head, bias=shift, blend=blend)
        shown = head.label_map(
            gaussians,
            camera,
            Features(values=features, weights=weights),
            options=RenderOptions(),
            backend=BACKEND,
        )
        if blend == "features":
            best, expected = head.probabilities(matrix @ features).max(dim=-1)
        else:
            seen = matrix @ (head.probabilities(features) * (weights > 0)[:, None])
            best, expected = seen.max(dim=-1)
            nothing = 1 - seen.sum(dim=-1)
            expected = torch.where(best >= nothing, expected, -1)
            best = torch.maximum(best, nothing)
        assert float((shown.ids == expected).float().mean()) > 0.98
        torch.testing.assert_close(shown.confidence, best, rtol=0, atol=1e-3)


def test_bad_addresses_are_refused(made) -> None:
    gaussians, layers = made
    field = GaussianField(gaussians, layers)
    points = torch.zeros(1, 3)
    with pytest.raises(InputError, match=r"expected one of the field \(labels, tree, .* 'walls'"):
        field.layer("walls")
    with pytest.raises(InputError, match="there is none"):
        GaussianField(gaussians).layer("walls")
    with pytest.raises(InputError, match=r"a readout of features after the @ .* 'part'"):
        field.layer("features@part")
    for address in ("labels@part", "labels@hard", "tree@hard"):
        with pytest.raises(InputError):
            field.layer(address)
    with pytest.raises(ShapeError, match="layer 'labels': expected 3 rows"):
        GaussianField(gaussians[:3], layers)
    with field.view(Camera(
        width=4, height=4, fx=4, fy=4, cx=2, cy=2, cam_from_world=torch.eye(4)
    )) as view:  # fmt: skip
        for ask in (view.label_map, view.confidence, field.labels,
                    lambda name: field.labels_at(points, name)):  # fmt: skip
            with pytest.raises(InputError, match="'plain': .* features without one"):
                ask("plain")
        with pytest.raises(InputError, match="expected features, got labels"):
            view.features("labels")
