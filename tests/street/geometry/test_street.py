"""A generated street: first hits of views that were left out come nearer to the truth."""

import torch

from splatseg.core import Camera
from splatseg.street.depth_views import DepthView
from splatseg.street.geometry import GeometryOptions, fit_geometry
from splatseg.street.hits import PrimitiveCaster, mesh_depth
from splatseg.street.primitives import voxel_primitives
from splatseg.synthetic import SyntheticScene, cast, drive_cameras, street
from support.primitives import shipped, sphere


def depth_of(scene: SyntheticScene, camera: Camera) -> torch.Tensor:
    """True z-depth within 15 m, 0 beyond."""
    origin, directions = camera.rays()
    distance, met = cast(scene, origin, directions.reshape(-1, 3))
    depth = distance.view(directions.shape[:2]) * (directions @ camera.cam_from_world[2, :3])
    return torch.where((met >= 0).view(depth.shape) & (depth < 15), depth, 0.0).float()


def test_test_views_of_a_street_come_nearer_to_the_truth() -> None:
    scene = street(0, length=30.0)
    views = drive_cameras(scene, 5, test_every=5, width=36, height=24, reach=0.3)
    near = {view.name: depth_of(scene, view.camera) for view in views}
    train = [
        DepthView(camera=view.camera, depth=near[view.name])
        for view in views
        if view.split == "train"
    ]
    (test,) = [view for view in views if view.split == "test"]
    points = torch.cat(
        [
            one.camera.unproject(
                one.camera.pixel_centres()[one.depth > 0], one.depth[one.depth > 0]
            )
            for one in train
        ]
    )
    primitives = voxel_primitives(points, shapes=shipped(), sphere=sphere())
    options = GeometryOptions(iterations=60, rays=1024, rate=0.05, offset_rate=0.03)
    found = fit_geometry(primitives, shipped(), train, options=options)

    def median_error(caster: PrimitiveCaster) -> float:
        seen, truth = mesh_depth(caster, test.camera), near[test.name]
        both = (seen > 0) & (truth > 0)
        assert float(both.float().sum() / (truth > 0).float().sum()) > 0.9
        return float((seen - truth)[both].abs().median())

    before, after = (
        median_error(PrimitiveCaster(one.mesh(shipped()))) for one in (primitives, found.primitives)
    )
    assert before > 0.2
    assert after < 0.6 * before
