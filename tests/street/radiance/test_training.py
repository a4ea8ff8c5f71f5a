"""Training of colours and classes: rays, kept hits, steps."""

import math
from collections.abc import Iterator
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from splatseg.core import LabelMap, View
from splatseg.errors import InputError, RangeError
from splatseg.io.evidence import create_evidence, open_evidence, save_label_map
from splatseg.street.hits import MeshCaster, MeshHits
from splatseg.street.primitives import PrimitiveMesh
from splatseg.street.radiance import RadianceOptions
from splatseg.street.radiance_rendering import render_view
from splatseg.street.radiance_training import RadianceFit, train_radiance
from splatseg.street.training_rays import CachedHits, cached_hits, label_ids, training_rays
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


# Pixels as rays: directions of any lens, label maps of any size, ids without a table.


def test_directions_are_those_of_the_cameras_lens_included() -> None:
    bent = [
        replace(view, camera=replace(view.camera, model="opencv", distortion=(0.1 * i, 0.01)))
        for i, view in enumerate(views())
    ]
    rays = training_rays(bent, None, IDS, read=lambda _: torch.ones(8, 12, 3))
    assert len(rays) == 288
    found = rays.directions(torch.arange(288))
    expected = []
    for i, view in enumerate(bent):
        all_directions = view.camera.rays()[1].reshape(-1, 3)
        expected.append(all_directions[rays.pixels[96 * i : 96 * i + 96].long()])
        assert torch.allclose(rays.view_directions(i), expected[-1], atol=1e-12)
    assert torch.allclose(found.double(), torch.cat(expected), atol=1e-6)
    assert len(rays.planes) == 3 * 96


def test_one_lens_is_kept_once() -> None:
    one = training_rays(views(), None, IDS, read=photograph)
    assert len(one.planes) == 96
    assert bool((one.columns == -1).all())


def test_label_maps_of_another_size_are_read_at_centres_of_pixels(tmp_path: Path) -> None:
    folder = create_evidence(tmp_path / "labels", kind="labels")
    small = torch.tensor([[IDS[0], IDS[1]], [IDS[2], -1]])
    save_label_map(LabelMap(ids=small), folder, "view0")
    evidence = open_evidence(folder)
    assert label_ids(views(), evidence) == tuple(sorted(IDS))
    rays = training_rays(views()[:1], evidence, IDS, read=photograph)
    columns = rays.columns.view(8, 12)
    assert columns[:4, :6].unique().tolist() == [0]
    assert columns[:4, 6:].unique().tolist() == [1]
    assert columns[4:, :6].unique().tolist() == [2]
    assert columns[4:, 6:].unique().tolist() == [-1]


# Hits that are kept: compressed within the step, in files as in memory.


def found() -> list[MeshHits]:
    rng = torch.Generator().manual_seed(0)
    caster = MeshCaster(two_balls())
    directions = torch.randn(90, 3, generator=rng) * 0.3 + torch.tensor([0.0, 0, 1])
    return [
        caster.hits(torch.tensor([0.0, 0, -5]), part, max_hits=4) for part in directions.split(40)
    ]


def same_hits(one: CachedHits, two: CachedHits) -> bool:
    return (
        torch.equal(one.starts, two.starts)
        and np.array_equal(one.faces, two.faces)
        and np.array_equal(one.weights, two.weights)
    )


def test_hits_come_back_ray_by_ray_within_a_step_of_their_weights() -> None:
    parts = found()
    kept = cached_hits(parts, memory=1 << 20)
    rays = torch.tensor([80, 3, 3, 41])
    places, faces, weights = kept.of(rays, 4)
    all_faces = torch.cat([part.faces for part in parts])[rays].reshape(-1)
    all_weights = torch.cat([part.weights for part in parts])[rays].reshape(-1, 3)
    assert torch.equal(places, (all_faces >= 0).nonzero()[:, 0])
    assert torch.equal(faces, all_faces[places])
    assert float((weights - all_weights[places]).abs().max()) < 2 / 65535
    assert torch.allclose(weights.sum(dim=1), torch.ones(len(weights)), atol=1e-5)
    assert kept.folder is None
    assert kept.nbytes == 8 * kept.hits


@pytest.mark.parametrize("memory", [0, 500])
def test_in_files_they_are_the_same_as_in_memory(memory: int) -> None:
    in_files = cached_hits(found(), memory=memory)
    assert same_hits(cached_hits(found(), memory=1 << 20), in_files)
    assert in_files.folder is not None
    assert in_files.folder.is_dir()
    in_files.close()
    assert not in_files.folder.exists()


@pytest.mark.parametrize("memory", [0, 1 << 20])
def test_rays_that_meet_nothing_have_no_hits(memory: int) -> None:
    none = [MeshCaster(two_balls()).hits(torch.tensor([0.0, 0, -5]), torch.tensor([[0.0, 1, 0]]))]
    for parts in (none, []):
        kept = cached_hits(parts, memory=memory)
        assert kept.hits == 0
        assert len(kept.starts) == len(parts) + 1
        kept.close()


def test_a_fault_on_the_way_leaves_no_files(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))

    def parts() -> Iterator[MeshHits]:
        yield from found()
        raise RuntimeError("stopped")

    with pytest.raises(RuntimeError, match="stopped"):
        cached_hits(parts(), memory=0)
    assert list(tmp_path.iterdir()) == []
