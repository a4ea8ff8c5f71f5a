"""The icosphere: watertight, outward, on the unit sphere, in the published order."""

import numpy as np
import pytest
import torch

from splatseg.errors import InputError
from splatseg.street.shapes import template
from support.shape_quality import topology


def test_it_is_a_closed_sphere_of_level_one() -> None:
    vertices, faces = template()
    assert (vertices.shape, vertices.dtype) == ((42, 3), torch.float32)
    assert (faces.shape, faces.dtype) == ((80, 3), torch.int64)
    np.testing.assert_allclose(vertices.norm(dim=1), np.ones(42), rtol=1e-6)
    assert sorted(set(faces.flatten().tolist())) == list(range(42))
    # Each directed edge once, its reverse once: watertight and of one orientation.
    directed = [(a, b) for f in faces.tolist() for a, b in zip(f, f[1:] + f[:1], strict=True)]
    assert len(set(directed)) == 240
    assert {(b, a) for a, b in directed} == set(directed)
    # Six times the volume that faces enclose is positive: they look outwards.
    volumes = torch.linalg.det(vertices[faces].double())
    assert bool((volumes > 0).all())
    assert float(volumes.sum() / 6) == pytest.approx(3.659, abs=1e-3)
    valence = torch.bincount(faces.flatten())
    assert valence[:12].tolist() == [5] * 12
    assert valence[12:].tolist() == [6] * 30


def test_vertices_come_in_the_published_order() -> None:
    """PyTorch3D's: its table of 12, then middles of edges in the order of their vertices."""
    vertices, _ = template()
    short, long = 0.5257, 0.8507
    wanted = {
        0: (-short, long, 0),
        5: (0, short, long),
        6: (0, -short, -long),
        8: (long, 0, -short),
    }
    for row, value in wanted.items():
        np.testing.assert_allclose(vertices[row], value, atol=1e-4)
    # The five edges of vertex 0 go to 1, 5, 7, 10 and 11, the next of vertex 1 to 5, 7, 8, 9.
    edges = [(0, 1), (0, 5), (0, 7), (0, 10), (0, 11), (1, 5), (1, 7), (1, 8), (1, 9)]
    for number, (a, b) in enumerate(edges):
        middle = vertices[a] + vertices[b]
        np.testing.assert_allclose(vertices[12 + number], middle / middle.norm(), atol=1e-6)


def test_it_is_the_callers_own() -> None:
    first = template()
    for part in first:
        part.zero_()
    assert bool(template()[0].any())
    assert bool(template()[1].any())


def test_edges_know_their_faces() -> None:
    _, faces = template()
    found = topology(faces, 42)
    assert len(found.edges) == 120
    for edge, pair in zip(found.edges.tolist(), found.edge_faces.tolist(), strict=True):
        assert len(set(pair)) == 2
        for face in pair:
            assert set(edge) <= set(faces[face].tolist())


def test_open_meshes_are_refused() -> None:
    _, faces = template()
    with pytest.raises(InputError, match=r"watertight mesh of 42 vertices, got the edge \d+ to"):
        topology(faces[1:], 42)
    with pytest.raises(InputError, match="faces at each of 43 vertices"):
        topology(faces, 43)
