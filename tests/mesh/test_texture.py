"""Textures: colours in closed form, texels inside their triangles, charts that do not overlap."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from splatseg.errors import InputError, MissingPackageError
from splatseg.io.export import TriangleMesh
from splatseg.mesh import bake_texture, fuse_object, seen_colours, vertex_normals
from splatseg.mesh.texture import unwrap
from support.mesh_maps import BLUE, OBJECT, RED, box, grid, ring, seen

BOX = ((-0.3, -0.2, 0.0), (0.3, 0.2, 0.4))
VOXEL = 0.6 / 40
AWAY = 1
"""A view a sixth of a turn from the first."""


@pytest.fixture(scope="module")
def maps():
    return seen(box(*BOX), ring((0.0, 0.0, 0.2)))


@pytest.fixture(scope="module")
def mesh(maps) -> TriangleMesh:
    made = fuse_object(maps, OBJECT, grid(*BOX, resolution=40))
    assert made is not None
    return made


def looked_up(texture, face: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Colours of points of triangles, read through uv as a viewer does: v up."""
    uv = np.einsum("nk,nkj->nj", weights, texture.uv.numpy()[texture.faces.numpy()[face]])
    height, width = texture.image.shape[:2]
    column = np.clip((uv[:, 0] * width).astype(int), 0, width - 1)
    row = np.clip(((1 - uv[:, 1]) * height).astype(int), 0, height - 1)
    return texture.image.numpy()[row, column].astype(int)


def test_a_box_of_two_colours_has_each_on_its_side(maps, mesh) -> None:
    texture = bake_texture(mesh, maps, OBJECT, tolerance=3 * VOXEL, texel=VOXEL / 2)
    assert 0.5 < texture.seen < 1
    face = np.arange(len(mesh.faces))
    weights = np.full((len(face), 3), 1 / 3)
    colours = looked_up(texture, face, weights)
    middle = mesh.vertices[mesh.faces].mean(1).numpy()
    # A pixel is wider than a voxel, so that some rows of texels mix; the bottom, which nobody
    # sees, has the colours of the sides.
    for side, colour in ((middle[:, 0] < -4 * VOXEL, RED), (middle[:, 0] > 4 * VOXEL, BLUE)):
        assert side.sum() > 500
        right = (np.abs(colours[side] - np.array(colour)) <= 2).all(1)
        assert right.mean() > 0.99


def test_charts_are_the_surface_and_do_not_overlap(mesh) -> None:
    atlas = unwrap(mesh, VOXEL / 2)
    assert np.array_equal(atlas.source[atlas.faces], mesh.faces.numpy())
    assert (atlas.texels >= 0).all()
    assert (atlas.texels <= [atlas.width, atlas.height]).all()
    # Texels of all triangles by their number: none is in two triangles but at shared edges.
    from splatseg.mesh.texture import _texels

    rows, columns, _, weights = _texels(atlas.texels[atlas.faces], (atlas.height, atlas.width))
    inner = (weights > 1e-6).all(1)
    key = rows[inner] * atlas.width + columns[inner]
    assert len(np.unique(key)) == len(key)
    assert np.allclose(weights.sum(1), 1)


def test_a_texel_is_as_large_as_asked(mesh) -> None:
    corners = mesh.vertices[mesh.faces].numpy()
    for texel in (VOXEL, VOXEL / 3):
        atlas = unwrap(mesh, texel)
        flat = atlas.texels[atlas.faces]
        texels = np.linalg.norm(flat[:, 0] - flat[:, 1], axis=1)
        length = np.linalg.norm(corners[:, 0] - corners[:, 1], axis=1)
        # Charts are seen from an axis, which makes edges shorter; xatlas stretches small ones to
        # whole texels.
        assert 0.85 < np.median(texels * texel / length) < 1.1


def test_each_option_counts(maps, mesh) -> None:
    normals = vertex_normals(mesh)
    loose = seen_colours(mesh.vertices, normals, maps, OBJECT, tolerance=3 * VOXEL)
    strict = seen_colours(mesh.vertices, normals, maps, OBJECT, tolerance=VOXEL / 20)
    assert int(strict.seen.sum()) < int(loose.seen.sum())
    near = seen_colours(mesh.vertices, normals, maps, OBJECT, tolerance=VOXEL)
    inwards = seen_colours(mesh.vertices, -normals, maps, OBJECT, tolerance=VOXEL)
    assert int(inwards.seen.sum()) < 0.1 * int(near.seen.sum())
    other = seen_colours(mesh.vertices, normals, maps, 99, tolerance=3 * VOXEL)
    assert not bool(other.seen.any())


def test_what_nobody_sees_has_the_colour_of_the_nearest(maps, mesh) -> None:
    found = seen_colours(mesh.vertices, vertex_normals(mesh), maps, OBJECT, tolerance=3 * VOXEL)
    below = (mesh.vertices[:, 2] < 0.01) & (mesh.vertices[:, 0] > 3 * VOXEL) & ~found.seen
    assert int(below.sum()) > 50
    right = (found.colours[below].int() - torch.tensor(BLUE)).abs() <= 2
    assert float(right.all(1).double().mean()) > 0.95


def test_views_count_by_the_cosine(maps) -> None:
    """A point that one view sees square and another one aslant, in other colours."""
    one = maps[0]
    point = one.camera.unproject(
        torch.tensor([[80.5, 80.5]], dtype=torch.float64), one.depth[80:81, 80].double()
    )
    towards = one.camera.centre - point
    bright = replace(one, colour=torch.full_like(one.colour, 250))
    dark = replace(one, colour=torch.full_like(one.colour, 50))
    mean = seen_colours(point, towards, [bright, dark], OBJECT, tolerance=0.1)
    assert mean.colours.unique().tolist() == [150]
    far = replace(maps[AWAY], colour=torch.full_like(one.colour, 50))
    direction = far.camera.centre - point
    cosine = float((towards * direction).sum() / towards.norm() / direction.norm())
    assert 0.1 < cosine < 0.9
    mixed = seen_colours(point, towards, [bright, far], OBJECT, tolerance=10)
    expected = (250 + 50 * cosine) / (1 + cosine)
    assert float(mixed.colours.float().mean()) == pytest.approx(expected, abs=1)


def test_mistakes(maps, mesh, monkeypatch) -> None:
    empty = TriangleMesh(vertices=mesh.vertices, faces=mesh.faces[:0])
    with pytest.raises(InputError, match="triangles"):
        bake_texture(empty, maps, OBJECT, tolerance=0.1, texel=0.01)
    with pytest.raises(InputError, match="texel"):
        bake_texture(mesh, maps, OBJECT, tolerance=0.1, texel=0)
    monkeypatch.setitem(__import__("sys").modules, "xatlas", None)
    with pytest.raises(MissingPackageError, match=r"splatseg\[mesh\]"):
        bake_texture(mesh, maps, OBJECT, tolerance=0.1, texel=0.01)
