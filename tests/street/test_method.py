"""The method dnmp: labels of Gaussians by the mesh field of the same drive."""

import math
from dataclasses import replace

import pytest
import torch

from splatseg.core import Gaussians
from splatseg.errors import InputError
from splatseg.io.captures import read_capture
from splatseg.io.evidence import open_evidence
from splatseg.io.scans import read_scans
from splatseg.methods import MethodInputs, find_method, keeps_ids, method_names
from splatseg.street.build import PUBLISHED, DnmpOptions

QUICK = DnmpOptions(voxels=(0.8,), geometry_iterations=1, iterations=150, rays=256)


@pytest.fixture(scope="module")
def inputs(generated_drive) -> MethodInputs:
    """Gaussians where lasers hit something, and one far away."""
    capture, scans = read_capture(generated_drive), read_scans(generated_drive)
    found = [scans.scan(name).points for name in scans.scan_names]
    points = torch.cat([*found, torch.full((1, 3), 900.0)]).float()
    rotations = torch.zeros(len(points), 4)
    rotations[:, 0] = 1
    gaussians = Gaussians(
        means=points, rotations=rotations, scales=torch.full((len(points), 3), 0.25),
        opacities=torch.full((len(points),), 0.9), sh=torch.zeros(len(points), 1, 3),
    )  # fmt: skip
    return MethodInputs(
        gaussians=gaussians, views=capture.train_views[::2], classes=capture.classes,
        evidence=open_evidence(generated_drive / "labels_semantic"), backend="cpu",
        metres_per_unit=capture.metres_per_unit, up=capture.up,
    )  # fmt: skip


def test_it_is_found_by_its_name() -> None:
    method = find_method("dnmp")
    assert "dnmp" in method_names()
    assert keeps_ids("dnmp")
    assert (method.evidence, method.returns, method.seeded) == (("labels",), "labels", True)
    assert method.published_options == PUBLISHED


def test_published_settings_are_those_of_the_papers() -> None:
    """Written out from the paper (papers/002) and from DNMP's code where the paper refers to it.

    Paper, section 4.1: batches of 4 096 rays, 5k iterations of geometry, then 50k of the field;
    section 3.2: w = 0.1, eq. 2 is the distance along the ray, eq. 9 asks adjusted vertices. DNMP:
    voxels of 0.5 and 1 m, networks of 8 layers of 256 (the input again after the fourth), features
    of 3 numbers in 3 octaves, 4 fine and 2 coarse hits, rates of 5e-4, weight 0.05 of depth.
    """
    published = find_method("dnmp").published_options
    assert published.voxels == (0.5, 1.0)
    assert published.effective_vertex_rule == "adjusted"
    assert published.radius is None, "the side of the finest voxels"
    geometry = published.geometry
    assert (geometry.iterations, geometry.rays, geometry.error) == (5_000, 4_096, "ray")
    assert (geometry.rate, geometry.offset_rate, geometry.depth_weight) == (5e-4, 5e-4, 0.05)
    assert geometry.final_rate == pytest.approx(0.99501248, abs=1e-6), "0.999999 a step"
    assert geometry.carve == math.inf, "nothing is carved"
    assert (geometry.refresh, geometry.reuse) == (100, 1)
    field = published.radiance
    assert (field.iterations, field.rays) == (50_000, 4_096)
    assert field.semantic_weight == 0.1
    assert (field.depth, field.width, field.skip) == (8, 256, 5)
    assert (field.feature_size, field.feature_frequencies) == (3, 3)
    assert (field.semantic_width, field.colour_widths) == (128, (256, 256))
    assert (field.position_frequencies, field.view_frequencies) == (6, 4)
    assert (field.max_hits, field.fine_hits, field.coarse_hits) == (6, 4, 2)
    assert (field.order, field.sides) == ("levels", "both")
    assert (field.rate, field.feature_rate) == (5e-4, 5e-4)


def test_gaussians_take_the_labels_of_the_field_and_far_ones_none(inputs, generated_drive) -> None:
    steps: list[int] = []
    told = replace(inputs, progress=lambda done, total: steps.append(done))
    labels = find_method("dnmp").run(told, QUICK)
    scans = read_scans(generated_drive)
    truth = torch.cat([scans.scan(name).labels["semantic"] for name in scans.scan_names])
    ids = labels.ids
    assert len(ids) == len(inputs.gaussians)
    assert int(ids[-1]) == -1
    assert float(labels.confidence[-1]) == 0
    known = ids[:-1] >= 0
    assert float(known.float().mean()) > 0.3
    assert float((ids[:-1] == truth)[known].float().mean()) > 0.5
    sky = max(row.id for row in inputs.classes.rows)
    assert labels.background == sky
    assert labels.info.method == "dnmp"
    assert labels.info.options["vertex_rule"] == "weighed"
    assert labels.info.details["undefined"] == int((ids < 0).sum()) > 0
    assert labels.info.names[1] == "road"
    assert steps == sorted(steps)
    assert steps[-1] == 1000


def test_without_gaussians_there_is_nothing_to_label(inputs) -> None:
    none = inputs.gaussians[torch.zeros(0, dtype=torch.int64)]
    with pytest.raises(InputError, match="^gaussians: expected Gaussians to label, got none"):
        find_method("dnmp").run(replace(inputs, gaussians=none), QUICK)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"setting": "slow"}, "setting: expected one of"),
        ({"coarse": "sparse"}, "coarse: this option was removed; all levels"),
        ({"start": "encoded"}, "start: this option was removed"),
        ({"voxels": ()}, "voxels: expected positive lengths"),
        ({"voxels": (0.5, -1.0)}, r"voxels: expected positive lengths"),
        ({"iterations": 0}, "iterations: expected at least 1, got 0"),
        ({"rays": 0}, "rays: expected at least 1"),
        ({"geometry_iterations": -1}, "geometry_iterations: expected at least 0"),
        ({"vertex_rule": "near"}, "vertex_rule: expected one of"),
        ({"carve": 0.0}, "carve: expected more than 0"),
        ({"radius": float("nan")}, "radius: expected more than 0"),
        ({"semantic_weight": -1.0}, "semantic_weight: expected at least 0"),
    ],
)
def test_options_check_themselves(values: dict[str, object], words: str) -> None:
    with pytest.raises(InputError, match=f"^{words}"):
        DnmpOptions(**values)


def test_every_option_reaches_the_stage_that_it_is_of() -> None:
    given = DnmpOptions(
        geometry_iterations=7, carve=0.7, iterations=11, rays=33, semantic_weight=0.4
    )
    assert (given.geometry.iterations, given.geometry.carve) == (7, 0.7)
    radiance = given.radiance
    assert (radiance.iterations, radiance.rays, radiance.semantic_weight) == (11, 33, 0.4)
    fast, published = DnmpOptions(), DnmpOptions(setting="published")
    assert fast.geometry.carve == 0.9
    assert (fast.effective_vertex_rule, published.effective_vertex_rule) == ("weighed", "adjusted")
    for rule in ("adjusted", "weighed", "all"):
        assert replace(published, vertex_rule=rule).effective_vertex_rule == rule
    assert published.geometry.carve > 1
    assert published.radiance.width == 256 > fast.radiance.width
    assert replace(published, iterations=5).radiance.iterations == 5
