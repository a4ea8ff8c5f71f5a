"""Splats in another frame than their capture are found by drawing them, and moved."""

import json

import numpy as np
import pytest
import torch

from splatseg.core import Similarity
from splatseg.errors import InputError
from splatseg.importing import align

Z_UP = [[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]


def similarity(matrix, offset=(0.0, 0.0, 0.0), scale=1.0) -> Similarity:
    return Similarity(
        rotation=torch.tensor(matrix, dtype=torch.float64),
        translation=torch.tensor(offset, dtype=torch.float64),
        scale=scale,
    )


def test_splats_in_their_place_stay(blobs, make_capture) -> None:
    found = align(blobs, make_capture(blobs))
    assert not found.moved
    assert torch.equal(found.capture_from_file.matrix, torch.eye(4, dtype=torch.float64))
    assert found.correlation > 0.99
    assert found.psnr > 35


@pytest.mark.parametrize(
    "matrix", [Z_UP, np.diag([1.0, -1, -1]).tolist(), [[0.0, 1, 0], [1, 0, 0], [0, 0, -1]]]
)
def test_a_change_of_axes_is_undone(matrix, blobs, make_capture) -> None:
    capture = make_capture(blobs)
    turn = similarity(matrix)
    found = align(blobs.transformed(turn), capture)
    assert found.moved
    assert torch.allclose(found.capture_from_file.rotation, turn.rotation.T)
    assert found.correlation > 0.99 > 0.5 > found.correlation_as_is
    assert "->" in found.what


def test_nerfstudio_transform_beside_the_file(blobs, make_capture, tmp_path) -> None:
    """The data parser's world: x -> scale * (R x + t)."""
    capture = make_capture(blobs)
    rotation = torch.linalg.qr(torch.tensor([[1.0, 2, 0], [0.3, 1, 1], [2, 0, 1]]).double())[0]
    rotation = rotation * torch.sign(torch.linalg.det(rotation))
    offset = torch.tensor([0.4, -2.0, 1.0], dtype=torch.float64)
    parsed = torch.cat((rotation, offset[:, None]), dim=1)
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "dataparser_transforms.json").write_text(
        json.dumps({"transform": parsed.tolist(), "scale": 0.25})
    )
    moved = blobs.transformed(
        similarity(rotation.tolist(), tuple((0.25 * offset).tolist()), scale=0.25)
    )
    found = align(moved, capture, splats=tmp_path / "run" / "splat.ply")
    assert "dataparser_transforms.json" in found.what
    back = moved.transformed(found.capture_from_file)
    assert torch.allclose(back.means, blobs.means, atol=1e-4)
    assert found.correlation > 0.99


def test_applied_transform_of_the_capture(blobs, make_capture) -> None:
    capture = make_capture(blobs, applied_transform=[[1, 0, 0, 2], [0, 0, 1, 0], [0, -1, 0, 1]])
    colmap = blobs.transformed(similarity(Z_UP, (2.0, 0.0, 1.0)).inverse())
    found = align(colmap, capture)
    assert "applied_transform" in found.what
    assert torch.allclose(colmap.transformed(found.capture_from_file).means, blobs.means, atol=1e-4)


def test_splats_of_something_else_are_refused(blobs, walls, make_capture) -> None:
    with pytest.raises(InputError, match=r"do not fit its photographs \(correlation .* doctor"):
        align(walls, make_capture(blobs))
