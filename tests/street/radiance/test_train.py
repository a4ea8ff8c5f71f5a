"""Training: it learns what there is, masks and missing labels count, and bits repeat."""

import math
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from splatseg.core import View
from splatseg.errors import InputError, RangeError
from splatseg.io.evidence import create_evidence, open_evidence
from splatseg.street.hits import MeshCaster
from splatseg.street.primitives import PrimitiveMesh
from splatseg.street.radiance import RadianceOptions
from splatseg.street.radiance_rendering import render_view
from splatseg.street.radiance_training import RadianceFit, train_radiance
from street.radiance.scene import COLOURS, IDS, SMALL, labels, photograph, truth, two_balls, views


def trained(
    options: RadianceOptions, folder: Path, *, seed: int = 0, unknown: bool = False, **more
) -> RadianceFit:
    seen = views()
    folder.mkdir(exist_ok=True)
    evidence = labels(folder / f"labels{unknown}", seen, unknown=unknown)
    return train_radiance(
        two_balls(), seen, evidence, options=options, seed=seed, read=photograph, **more
    )


def state(fit: RadianceFit) -> dict[str, torch.Tensor]:
    return fit.model.state


def same(one: RadianceFit, two: RadianceFit) -> bool:
    return all(torch.equal(state(one)[name], state(two)[name]) for name in state(one))


def test_it_learns_colours_classes_and_the_sky(tmp_path: Path) -> None:
    options = replace(SMALL, iterations=150, rays=128, rate=0.01, feature_rate=0.05)
    fit = trained(options, tmp_path)
    assert fit.model.ids == IDS
    assert len(fit.records) == 150
    assert fit.records[-1].loss < 0.2 * fit.records[0].loss
    assert fit.rays == 3 * 12 * 8
    view = views()[1]
    seen = render_view(fit.model, MeshCaster(two_balls()), view.camera)
    column = truth(view)
    right = (seen.probabilities.argmax(dim=-1) == column).float().mean()
    assert float(right) > 0.9
    assert seen.colour is not None
    assert float((seen.colour - COLOURS[column]).abs().mean()) < 0.1


@pytest.mark.bits
@pytest.mark.parametrize("rays", [64, 1500])
def test_bits_do_not_depend_on_threads(tmp_path: Path, rays: int) -> None:
    """1500 rays are two shares."""
    before = torch.get_num_threads()
    found = []
    try:
        for count in (1, 2, 3):
            torch.set_num_threads(count)
            found.append(trained(replace(SMALL, rays=rays), tmp_path))
    finally:
        torch.set_num_threads(before)
    assert same(found[0], found[1])
    assert same(found[0], found[2])
    assert found[0].records == found[1].records


@pytest.mark.bits
def test_bits_do_not_depend_on_where_hits_are_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    memory = trained(SMALL, tmp_path)
    monkeypatch.setattr("splatseg.street.radiance_training._MEMORY", 0)
    files = trained(SMALL, tmp_path)
    assert [one.in_files for one in (memory, files)] == [False, True]
    assert same(memory, files)


def test_another_seed_gives_another_field(tmp_path: Path) -> None:
    assert not same(trained(SMALL, tmp_path), trained(SMALL, tmp_path, seed=1))


CHANGES = {
    "feature_size": 5,
    "feature_frequencies": 2,
    "position_frequencies": 3,
    "view_frequencies": 2,
    "width": 12,
    "depth": 3,
    "skip": 2,
    "semantic_width": 0,
    "colour_widths": (8, 8),
    "background_widths": (4,),
    "order": "levels",
    "max_hits": 1,
    "fine_hits": 1,
    "coarse_hits": 1,
    "sides": "front",
    "rays": 32,
    "iterations": 4,
    "rate": 1e-2,
    "feature_rate": 1e-1,
    "semantic_weight": 1.0,
}


@pytest.mark.parametrize("name", CHANGES)
def test_each_option_changes_the_field(tmp_path: Path, name: str) -> None:
    # Order matters where a coarse primitive stands before a fine one: seen from behind.
    def reader(view: View) -> torch.Tensor:
        return torch.rand(8, 12, 3, generator=torch.Generator().manual_seed(len(view.name)))

    turned = torch.diag(torch.tensor([-1.0, 1, -1, 1], dtype=torch.float64))
    turned[:3, 3] = torch.tensor([1.0, 0.2, 9.0])
    seen = [
        views()[0],
        replace(views()[1], camera=replace(views()[1].camera, cam_from_world=turned)),
    ]
    evidence = labels(tmp_path / "labels", views()[:1])
    shapes, tables = [], []
    for changed in (False, True):
        options = replace(SMALL, **({name: CHANGES[name]} if changed else {}))
        fit = train_radiance(two_balls(), seen, evidence, options=options, read=reader)
        shapes.append({key: tuple(one.shape) for key, one in fit.model.state.items()})
        tables.append(fit.model.state)
    if shapes[0] == shapes[1]:
        assert any(not torch.equal(tables[0][key], tables[1][key]) for key in tables[0])


def test_every_option_is_tried() -> None:
    assert {field.name for field in fields(RadianceOptions)} == {*CHANGES}


def test_pixels_without_a_label_teach_colours_alone(tmp_path: Path) -> None:
    with_labels = trained(SMALL, tmp_path)
    without = trained(SMALL, tmp_path, unknown=True)
    none = train_radiance(two_balls(), views(), None, ids=IDS, options=SMALL, read=photograph)
    assert all(record.semantic_loss == 0 for record in without.records)
    assert same(without, none)
    start = train_radiance(
        two_balls(), views(), None, ids=IDS, options=replace(SMALL, rate=1e-30), read=photograph
    )
    for name, moved in state(without).items():
        if name.startswith("semantic"):
            assert torch.equal(moved, state(start)[name])
            assert not torch.equal(moved, state(with_labels)[name])
    weightless = trained(replace(SMALL, semantic_weight=0), tmp_path)
    assert torch.equal(weightless.model.features, without.model.features)


def test_views_without_a_label_map_teach_colours_alone(tmp_path: Path) -> None:
    evidence = labels(tmp_path / "some", views()[:1])
    fit = train_radiance(two_balls(), views(), evidence, options=SMALL, read=photograph)
    assert 0 < fit.records[0].semantic_loss < math.log(30)


def test_masked_pixels_teach_nothing(tmp_path: Path) -> None:
    keep = np.zeros((8, 12), dtype=np.uint8)
    keep[:, :6] = 255
    Image.fromarray(keep).save(tmp_path / "mask.png")
    masked = [replace(view, mask=tmp_path / "mask.png") for view in views()]

    def other(view: View) -> torch.Tensor:
        image = photograph(view).clone()
        image[:, 6:] = 0.5
        return image

    options = SMALL
    one = train_radiance(two_balls(), masked, None, ids=IDS, options=options, read=photograph)
    two = train_radiance(two_balls(), masked, None, ids=IDS, options=options, read=other)
    assert one.rays == 3 * 8 * 6
    assert same(one, two)


def test_progress_ends_it_and_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told = []
    monkeypatch.setattr("splatseg.street.radiance_training._MEMORY", 0)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))

    def progress(record) -> None:
        told.append(record.iteration)
        if record.iteration == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        trained(SMALL, tmp_path / "work", progress=progress)
    assert told == [1, 2, 3]
    assert [path.name for path in (tmp_path / "work").iterdir()] == ["labelsFalse"]
    assert [path.name for path in tmp_path.iterdir()] == ["work"]


def test_faults_are_named(tmp_path: Path) -> None:
    seen, mesh = views(), two_balls()
    evidence = labels(tmp_path / "labels", seen)
    empty = PrimitiveMesh(vertices=torch.zeros(0, 3), levels=torch.zeros(0), sizes=(1.0,))
    with pytest.raises(InputError, match="mesh: expected at least one primitive"):
        train_radiance(empty, seen, evidence, options=SMALL, read=photograph)
    with pytest.raises(InputError, match="views: expected pixels"):
        train_radiance(mesh, (), evidence, options=SMALL, read=photograph)
    with pytest.raises(InputError, match="ids: expected ids of classes"):
        train_radiance(mesh, seen, None, options=SMALL, read=photograph)
    with pytest.raises(InputError, match=r"expected ids of \(4, 9\), got 7"):
        train_radiance(mesh, seen, evidence, ids=(4, 9), options=SMALL, read=photograph)
    with pytest.raises(InputError, match="distinct ids"):
        train_radiance(mesh, seen, None, ids=(4, 4), options=SMALL, read=photograph)
    with pytest.raises(InputError, match="a view with a photograph"):
        train_radiance(mesh, seen, evidence, options=SMALL)
    (tmp_path / "masks").mkdir()
    masks = open_evidence(create_evidence(tmp_path / "masks", kind="masks"))
    with pytest.raises(InputError, match="kind labels, got masks"):
        train_radiance(mesh, seen, masks, options=SMALL, read=photograph)


@pytest.mark.parametrize(("value", "error"), [(math.nan, RangeError), (1.5, RangeError)])
def test_photographs_with_values_that_cannot_be_are_refused(value, error) -> None:
    def spoilt(view: View) -> torch.Tensor:
        image = photograph(view).clone()
        image[3, 4, 1] = value
        return image

    with pytest.raises(error, match="photograph of view 'view0'"):
        train_radiance(two_balls(), views(), None, ids=IDS, options=SMALL, read=spoilt)
    with pytest.raises(InputError, match="photograph of view 'view0'"):
        train_radiance(
            two_balls(), views(), None, ids=IDS, options=SMALL, read=lambda _: torch.zeros(4, 4, 3)
        )


def test_photographs_and_label_maps_of_files_are_read(tmp_path: Path) -> None:
    """Files of lossless pictures give what the reader gives."""
    seen = []
    for view in views():
        pixels = (photograph(view) * 255).round().to(torch.uint8).numpy()
        Image.fromarray(pixels).save(tmp_path / f"{view.name}.png")
        seen.append(replace(view, image=tmp_path / f"{view.name}.png"))
    evidence = labels(tmp_path / "labels", views())
    files = train_radiance(two_balls(), seen, evidence, options=SMALL)
    given = train_radiance(two_balls(), seen, evidence, options=SMALL, read=photograph)
    assert same(files, given)


def test_what_rays_saw_is_their_weights(tmp_path: Path) -> None:
    """Opaque balls: what is behind the first triangle is seen by none, and each ray by one."""
    fit = trained(replace(SMALL, iterations=40, order="distance"), tmp_path)
    assert fit.seen.shape == (len(two_balls().vertices),)
    assert bool((fit.seen >= 0).all())
    assert 0 < float(fit.seen.sum()) <= fit.rays * (1 + 1e-5)
    centre = views()[0].camera.centre.float()
    vertices = two_balls().vertices
    ahead = vertices[:42, 2] < -0.5
    assert centre[2] < 0
    assert float(fit.seen[:42][ahead].mean()) > float(fit.seen[:42][~ahead].mean())
