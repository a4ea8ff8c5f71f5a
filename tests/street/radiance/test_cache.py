"""Hits that are kept: compressed within the step, in files as in memory, and never half of them."""

import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from random import Random

import numpy as np
import pytest
import torch

from splatseg.errors import FileFormatError, InputError, MissingFileError
from splatseg.street.hits import MeshCaster, MeshHits
from splatseg.street.radiance.cache import CachedHits, cached_hits, read_hits
from street.radiance.scene import two_balls
from support.fuzz.mutations import mutate


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


def kept_in(folder: Path) -> CachedHits:
    """Hits that lie in a folder, found if they are not there or damaged, as copies in memory."""
    kept = cached_hits(found(), memory=0, folder=folder, triangles=160, identity="a")
    return replace(kept, faces=np.array(kept.faces), weights=np.array(kept.weights))


def refuse() -> Iterator[MeshHits]:
    raise RuntimeError("asked again")
    yield


def test_hits_come_back_ray_by_ray_within_a_step_of_their_weights() -> None:
    parts = found()
    kept = cached_hits(parts, memory=1 << 20, folder=None, triangles=160, identity="a")
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
def test_in_files_they_are_the_same_as_in_memory(tmp_path: Path, memory: int) -> None:
    in_memory = cached_hits(found(), memory=1 << 20, folder=None, triangles=160, identity="a")
    in_files = cached_hits(
        found(), memory=memory, folder=tmp_path / "hits", triangles=160, identity="a"
    )
    again = cached_hits(
        refuse(), memory=memory, folder=tmp_path / "hits", triangles=160, identity="a"
    )
    assert in_files.folder == again.folder == tmp_path / "hits"
    assert same(in_memory, in_files)
    assert same(in_memory, again)
    again.close()
    assert (tmp_path / "hits").is_dir()


def test_temporary_files_go_with_it() -> None:
    kept = cached_hits(found(), memory=0, folder=None, triangles=160, identity="a")
    assert kept.folder is not None
    assert kept.folder.is_dir()
    kept.close()
    assert not kept.folder.exists()
    assert not kept.folder.parent.exists()


def test_hits_of_something_else_are_found_again(tmp_path: Path) -> None:
    cached_hits(found()[:1], memory=0, folder=tmp_path / "hits", triangles=160, identity="a")
    with pytest.raises(FileFormatError, match="hits of these rays"):
        read_hits(tmp_path / "hits", triangles=160, identity="b")
    other = cached_hits(found(), memory=0, folder=tmp_path / "hits", triangles=160, identity="b")
    assert same(
        other, cached_hits(found(), memory=1 << 20, folder=None, triangles=160, identity="b")
    )


@pytest.mark.parametrize("name", ["counts.bin", "faces.bin", "weights.bin"])
def test_half_a_file_is_refused_and_found_again(tmp_path: Path, name: str) -> None:
    whole = cached_hits(found(), memory=0, folder=tmp_path / "hits", triangles=160, identity="a")
    path = tmp_path / "hits" / name
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(FileFormatError, match=name):
        read_hits(tmp_path / "hits", triangles=160, identity="a")
    again = cached_hits(found(), memory=0, folder=tmp_path / "hits", triangles=160, identity="a")
    assert again.hits == whole.hits
    path.unlink()
    with pytest.raises(MissingFileError, match=name):
        read_hits(tmp_path / "hits", triangles=160, identity="a")
    cached_hits(found(), memory=0, folder=tmp_path / "hits", triangles=160, identity="a")
    assert read_hits(tmp_path / "hits", triangles=160, identity="a").hits == whole.hits


@pytest.mark.parametrize(
    "change",
    [
        {"rays": -1}, {"rays": "9"}, {"rays": True}, {"rays": 90.5}, {"rays": 89},
        {"rays": 10**400}, {"hits": None}, {"hits": float("nan")}, {"hits": 2**63}, {"hits": [3]},
        {"hits": -8},
        {"version": 3}, {"version": "1"}, {"version": None}, {"identity": ["a"]}, {"format": "b"},
        {"rays": 2**62, "hits": 2**62},
    ],
    ids=lambda change: ", ".join(change),
)  # fmt: skip
def test_a_header_that_cannot_be_is_refused(tmp_path: Path, change: dict[str, object]) -> None:
    cached_hits(found(), memory=0, folder=tmp_path / "hits", triangles=160, identity="a")
    header = tmp_path / "hits" / "cache.json"
    header.write_text(json.dumps(json.loads(header.read_text()) | change))
    with pytest.raises(FileFormatError):
        read_hits(tmp_path / "hits", triangles=160, identity="a")


@pytest.mark.parametrize("text", ["", "[]", "{", '"a"', "\ufeff", "null", "{}", "\0" * 90])
def test_a_header_that_is_none_is_refused_and_found_again(tmp_path: Path, text: str) -> None:
    whole = kept_in(tmp_path / "hits")
    (tmp_path / "hits" / "cache.json").write_text(text)
    with pytest.raises(FileFormatError, match=str(tmp_path)):
        read_hits(tmp_path / "hits", triangles=160, identity="a")
    assert same(kept_in(tmp_path / "hits"), whole)


@pytest.mark.parametrize("value", [-1, 160, 2**31 - 1, -(2**31)])
def test_a_triangle_out_of_range_is_refused_and_found_again(tmp_path: Path, value: int) -> None:
    whole = kept_in(tmp_path / "hits")
    path = tmp_path / "hits" / "faces.bin"
    faces = np.frombuffer(path.read_bytes(), "<i4").copy()
    faces[3] = value
    path.write_bytes(faces.tobytes())
    with pytest.raises(FileFormatError, match="expected 160 triangles"):
        read_hits(tmp_path / "hits", triangles=160, identity="a")
    assert same(kept_in(tmp_path / "hits"), whole)


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("counts", "faces"),
        ("counts", "weights"),
        ("faces", "weights"),  # of one size: what else they are is told by their values
    ],
)
def test_swapped_files_are_refused_and_found_again(tmp_path: Path, one: str, other: str) -> None:
    folder = tmp_path / "hits"
    whole = kept_in(folder)
    first, second = (folder / f"{name}.bin" for name in (one, other))
    content = first.read_bytes()
    first.write_bytes(second.read_bytes())
    second.write_bytes(content)
    with pytest.raises(FileFormatError):
        read_hits(folder, triangles=160, identity="a")
    assert same(kept_in(folder), whole)


def test_triangles_that_there_are_not_are_refused(tmp_path: Path) -> None:
    cached_hits(found(), memory=0, folder=tmp_path / "hits", triangles=160, identity="a")
    with pytest.raises(FileFormatError, match="expected 80 triangles"):
        read_hits(tmp_path / "hits", triangles=80, identity="a")


def test_damage_at_random_is_refused_or_stays_within_the_primitives(tmp_path: Path) -> None:
    """Values that could be true are not told from true ones: there is no check sum."""
    sound = tmp_path / "sound"
    whole = cached_hits(found(), memory=0, folder=sound, triangles=160, identity="a")
    random = Random(0)
    for i in range(240):
        folder = tmp_path / str(i)
        shutil.copytree(sound, folder)
        name = ("cache.json", "counts.bin", "faces.bin", "weights.bin")[i % 4]
        _, damaged = mutate(random, (sound / name).read_bytes())
        (folder / name).write_bytes(damaged)
        try:
            kept = read_hits(folder, triangles=160, identity="a")
        except (FileFormatError, MissingFileError):
            continue
        assert len(kept.starts) == len(whole.starts)
        _, faces, weights = kept.of(torch.arange(90), 4)
        assert 0 <= int(faces.min()) <= int(faces.max()) < 160
        assert bool(((weights >= 0) & (weights <= 1)).all())


def test_counts_that_do_not_add_up_are_refused(tmp_path: Path) -> None:
    cached_hits(found(), memory=0, folder=tmp_path / "hits", triangles=160, identity="a")
    path = tmp_path / "hits" / "counts.bin"
    path.write_bytes(bytes(len(path.read_bytes())))
    with pytest.raises(FileFormatError, match="counts"):
        read_hits(tmp_path / "hits", triangles=160, identity="a")


def test_an_interrupted_search_leaves_nothing(tmp_path: Path) -> None:
    def broken() -> Iterator[MeshHits]:
        yield found()[0]
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        cached_hits(broken(), memory=0, folder=tmp_path / "hits", triangles=160, identity="a")
    assert list(tmp_path.iterdir()) == []


def test_a_folder_of_something_else_stays(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(InputError, match="cache_folder"):
        cached_hits(found(), memory=0, folder=tmp_path, triangles=160, identity="a")
    assert (tmp_path / "mine.txt").read_text() == "mine"


@pytest.mark.parametrize("name", ["counts", "faces", "weights"])
def test_files_that_changed_since_are_not_read(tmp_path: Path, name: str) -> None:
    caster = MeshCaster(two_balls())
    directions = torch.tensor([[0.0, 0.0, 1.0], [0.05, 0.0, 1.0]])
    hits = [caster.hits(torch.tensor([0.0, 0, -5]), directions, max_hits=4)]
    cached_hits(hits, triangles=160, memory=0, folder=tmp_path / "hits", identity="a")
    file = tmp_path / "hits" / f"{name}.bin"
    content = bytearray(file.read_bytes())
    # As likely as what was there: one triangle less or more, or two rays' counts exchanged.
    content[0] ^= 1
    if name == "counts":
        content[1] += -1 if content[0] % 2 else 1
    file.write_bytes(bytes(content))
    with pytest.raises(FileFormatError, match="check sums"):
        read_hits(tmp_path / "hits", triangles=160, identity="a")
