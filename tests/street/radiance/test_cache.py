"""Hits that are kept: compressed within the step, in files as in memory."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from splatseg.street.hits import MeshCaster, MeshHits
from splatseg.street.training_rays import CachedHits, cached_hits
from street.radiance.scene import two_balls


def found() -> list[MeshHits]:
    rng = torch.Generator().manual_seed(0)
    caster = MeshCaster(two_balls())
    directions = torch.randn(90, 3, generator=rng) * 0.3 + torch.tensor([0.0, 0, 1])
    return [
        caster.hits(torch.tensor([0.0, 0, -5]), part, max_hits=4) for part in directions.split(40)
    ]


def same(one: CachedHits, two: CachedHits) -> bool:
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
    assert same(cached_hits(found(), memory=1 << 20), in_files)
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
