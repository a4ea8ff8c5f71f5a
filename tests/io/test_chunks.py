"""Gaussians in chunks on the disk: what is written comes back, and what is damaged is told."""

import json
import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import torch

from splatseg.core import Gaussians
from splatseg.core.chunks import morton_order
from splatseg.core.coarser import coarser
from splatseg.errors import FileFormatError, InputError, MissingFileError, RangeError
from splatseg.io import chunks as files
from splatseg.io.chunks import ChunkWriter, level_folder, level_rows, open_chunks, write_chunks
from support.chunked import in_chunks, in_memory

COLUMNS = ("means", "rotations", "scales", "opacities", "sh")


@pytest.fixture
def gaussians(rng) -> Gaussians:
    return some(rng, 300)


def some(rng, count: int) -> Gaussians:
    def floats(*shape: int) -> torch.Tensor:
        return torch.from_numpy(rng.normal(size=shape).astype(np.float32))

    return Gaussians(
        means=floats(count, 3),
        rotations=torch.nn.functional.normalize(floats(count, 4), dim=1),
        scales=floats(count, 3).exp(),
        opacities=torch.sigmoid(floats(count)),
        sh=floats(count, 4, 3),
        extra={"number": torch.arange(count), "wide": floats(count, 2)},
        antialiased=True,
        low_pass=0.1,
    )


def equal(one: Gaussians, other: Gaussians) -> bool:
    kept = {*one.extra} == {*other.extra}
    return (
        kept
        and all(torch.equal(getattr(one, name), getattr(other, name)) for name in COLUMNS)
        and all(torch.equal(one.extra[name], other.extra[name]) for name in one.extra)
        and (one.antialiased, one.low_pass) == (other.antialiased, other.low_pass)
    )


def test_what_is_written_comes_back_to_the_bit(gaussians, tmp_path, monkeypatch) -> None:
    found = in_chunks(gaussians, tmp_path / "gaussians", monkeypatch)
    order = found.extra["number"]
    assert sorted(order.tolist()) == list(range(300))
    assert equal(in_memory(found), gaussians[order])
    assert found.chunks is not None
    runs = [(0, 20), (20, 21), (200, 300)]
    read, wanted = found.chunks.read(runs), torch.cat([order[a:b] for a, b in runs])
    assert equal(read, gaussians.replace(extra={})[wanted])
    assert torch.equal(found.colours, gaussians[order].colours)
    bare = found.chunks.read(runs, colours=False)
    assert equal(bare.replace(sh=read.sh), read)
    assert bare.sh.shape == (121, 1, 3)
    assert float(bare.sh.abs().max()) == 0
    assert len(found.chunks.read([])) == 0


@pytest.mark.parametrize("memory", [1, 40 * 108, 10**9])
def test_any_memory_gives_the_same_files(gaussians, tmp_path, monkeypatch, memory) -> None:
    """With little of it the source is read many times."""
    in_chunks(gaussians, tmp_path / "much", monkeypatch)
    reads: list[tuple[int, int]] = []
    monkeypatch.setattr(files, "_BLOCK", 64)

    def rows(first: int, end: int) -> Gaussians:
        reads.append((first, end))
        return gaussians[first:end]

    told: list[tuple[int, int]] = []
    (tmp_path / "little").mkdir()
    write_chunks(
        rows, 300, tmp_path / "little", memory=memory,
        progress=lambda done, total: told.append((done, total)),
    )  # fmt: skip
    for path in sorted((tmp_path / "much").iterdir()):
        assert path.read_bytes() == (tmp_path / "little" / path.name).read_bytes(), path
    assert max(end - first for first, end in reads) <= 64
    # 4 of 300 stand apart, 296 are 19 chunks; two and a half chunks of 108 bytes a Gaussian fit.
    passes = {1: 1 + 20, 40 * 108: 1 + 9, 10**9: 1 + 1}[memory]
    assert told[-1] == (passes * 300, passes * 300)
    assert [done for done, _ in told] == sorted(done for done, _ in told)


def test_rows_of_a_chunk_lie_near_each_other(rng, tmp_path, monkeypatch) -> None:
    found = in_chunks(some(rng, 4000), tmp_path / "gaussians", monkeypatch, rows=100)
    chunks = found.chunks
    assert chunks is not None
    # The largest 1/64 stand first and apart.
    assert int(chunks.starts[1]) == 4000 // 64
    largest = in_memory(found).scales.amax(dim=1)
    assert float(largest[: 4000 // 64].min()) > float(largest[4000 // 64 :].max())
    sides = (chunks.high - chunks.low)[1:]
    assert float(sides.median()) < 0.5 * float((found.means.amax(0) - found.means.amin(0)).min())
    for i, (first, end) in enumerate(zip(chunks.starts[:-1], chunks.starts[1:], strict=True)):
        own = found.means[first:end]
        assert torch.equal(own.amin(dim=0), chunks.low[i])
        assert torch.equal(own.amax(dim=0), chunks.high[i])
        assert float(largest[first:end].max()) == float(chunks.largest[i])


def test_the_curve_goes_through_octants_one_after_the_other() -> None:
    corners = torch.tensor([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)]).float()
    order, apart = morton_order(corners.flip(0), torch.ones(8))
    assert order.tolist() == [7, 6, 5, 4, 3, 2, 1, 0]
    assert apart == 0
    order, apart = morton_order(torch.zeros(64, 3), torch.arange(64.0))
    assert (order[0].item(), apart) == (63, 1), "of 64 one is the largest"
    assert order[1:].tolist() == list(range(63)), "equal ones keep their order"
    assert len(morton_order(torch.zeros(0, 3), torch.zeros(0))[0]) == 0


def test_harmonics_of_half_precision(gaussians, tmp_path, monkeypatch) -> None:
    found = in_chunks(gaussians, tmp_path / "gaussians", monkeypatch, half=True)
    order = found.extra["number"]
    rounded = gaussians.sh[order].half()
    assert found.sh.dtype == torch.float16
    assert torch.equal(found.sh, rounded)
    assert found.chunks is not None
    assert torch.equal(found.chunks.read([(0, 300)]).sh, rounded.float())
    assert equal(in_memory(found).replace(sh=gaussians.sh[order]), gaussians[order])
    bright = gaussians.replace(sh=gaussians.sh + 70_000)
    (tmp_path / "bright").mkdir()
    with (
        pytest.raises(InputError, match="float16 can hold"),
        ChunkWriter(tmp_path / "bright", 300, like=bright, half=True) as writer,
    ):
        writer.append(bright)


def test_coarser_levels_keep_the_largest(rng, tmp_path, monkeypatch) -> None:
    gaussians = some(rng, 640)
    monkeypatch.setattr(files, "CHUNK_ROWS", 100)
    write_chunks(lambda a, b: gaussians[a:b], 640, tmp_path, memory=10**9, levels=2, half=True)
    levels = [open_chunks(level_folder(tmp_path, level), memory=1) for level in range(3)]
    # 10 of 640 stand apart; 630 are seven chunks, 25 and then 7 of each hundred, 8 and 2 of 30.
    assert [len(level) for level in levels] == [640, 10 + 6 * 25 + 8, 10 + 6 * 7 + 2]
    for level in levels:
        assert torch.equal(in_memory(level).means[:10], in_memory(levels[0]).means[:10])
        assert (level.antialiased, level.low_pass) == (True, 0.1)
        assert level.sh.dtype == torch.float16
        assert level.chunks is not None
        level.chunks.read([(0, len(level))]).check_values()
    first = levels[0].chunks.read([(10, 14)])
    wanted = coarser(first)
    for name in ("means", "rotations", "scales", "opacities"):
        assert torch.equal(getattr(in_memory(levels[1])[10:11], name), getattr(wanted, name))


def test_a_row_of_a_level_stands_for_the_heaviest_of_its_run(rng, tmp_path, monkeypatch) -> None:
    gaussians = some(rng, 640)
    monkeypatch.setattr(files, "CHUNK_ROWS", 100)
    write_chunks(lambda a, b: gaussians[a:b], 640, tmp_path, memory=10**9, levels=2)
    assert level_rows(tmp_path, 0).tolist() == list(range(640))
    first, second = (level_rows(tmp_path, level) for level in (1, 2))
    assert first[:10].tolist() == list(range(10)), "who stands apart stays"
    whole = in_memory(open_chunks(tmp_path, memory=1))
    weights = whole.opacities * whole.scales.sort(dim=1).values[:, 1:].prod(dim=1)
    below, row = list(range(10, 640)), 10
    while below:  # runs of four within chunks of a hundred
        run = below[: min(4, 100 - (below[0] - 10) % 100)]
        assert first[row] == max(run, key=lambda one: float(weights[one]))
        below, row = below[len(run) :], row + 1
    assert row == len(first)
    # Of the next level it is one of those that the level below has.
    assert len(second) == len(open_chunks(level_folder(tmp_path, 2), memory=1))
    assert set(second.tolist()) < set(first.tolist())


def test_a_level_of_other_chunks_is_refused(rng, tmp_path, monkeypatch) -> None:
    gaussians = some(rng, 640)
    monkeypatch.setattr(files, "CHUNK_ROWS", 100)
    write_chunks(lambda a, b: gaussians[a:b], 640, tmp_path, memory=10**9, levels=1)
    other = tmp_path / "other"
    other.mkdir()
    write_chunks(lambda a, b: gaussians[a : min(b, 400)], 400, other, memory=10**9, levels=1)
    shutil.rmtree(level_folder(tmp_path, 1))
    shutil.copytree(level_folder(other, 1), level_folder(tmp_path, 1))
    with pytest.raises(FileFormatError, match="the chunks of level 0, coarser, got others"):
        level_rows(tmp_path, 1)
    with pytest.raises(MissingFileError):
        level_rows(other, 2)


def test_a_level_of_chunks_of_other_lengths_is_refused(rng, tmp_path, monkeypatch) -> None:
    """As many chunks, and the last of them longer."""
    monkeypatch.setattr(files, "CHUNK_ROWS", 100)
    for name, count in (("long", 640), ("short", 620)):
        gaussians = some(rng, count)
        (tmp_path / name).mkdir()
        write_chunks(
            lambda a, b, of=gaussians: of[a:b], count, tmp_path / name, memory=10**9, levels=1
        )
    level = level_folder(tmp_path / "short", 1)
    shutil.rmtree(level)
    shutil.copytree(level_folder(tmp_path / "long", 1), level)
    with pytest.raises(FileFormatError, match="the chunks of level 0, coarser, got others"):
        level_rows(tmp_path / "short", 1)


def test_the_source_must_be_renderable_and_not_empty(gaussians, tmp_path) -> None:
    bad = gaussians.replace(opacities=gaussians.opacities + 2)
    with pytest.raises(RangeError, match="opacities"):
        write_chunks(lambda a, b: bad[a:b], 300, tmp_path, memory=10**9)
    with pytest.raises(InputError, match="at least one"):
        write_chunks(lambda a, b: bad[a:b], 0, tmp_path, memory=10**9)
    parts = [gaussians[:0], gaussians[:7]]
    with pytest.raises(InputError, match="expected 300 Gaussians, got 7"):
        write_parts(tmp_path, parts, 300)
    assert not (tmp_path / "chunks.json").exists()
    write_parts(tmp_path, parts, 7)
    assert len(open_chunks(tmp_path, memory=1).chunks or ()) == 1, "none is no chunk"


def write_parts(folder: Path, parts: Sequence[Gaussians], count: int) -> None:
    with ChunkWriter(folder, count, like=parts[0]) as writer:
        for part in parts:
            writer.append(part)


def truncate(path) -> None:
    path.write_bytes(path.read_bytes()[:-4])


def of_another_type(path) -> None:
    np.save(path, np.load(path).astype(np.float64))


def of_fewer_rows(path) -> None:
    np.save(path, np.load(path)[:-1])


@pytest.mark.parametrize("name", [*COLUMNS, "extra_0"])
@pytest.mark.parametrize("damage", [truncate, of_another_type, of_fewer_rows, "missing"])
def test_a_damaged_file_is_named(gaussians, tmp_path, monkeypatch, name, damage) -> None:
    folder = tmp_path / "gaussians"
    in_chunks(gaussians, folder, monkeypatch)
    path = folder / f"{name}.npy"
    if damage == "missing":
        path.unlink()
    else:
        damage(path)
    if name == "extra_0" and damage is of_another_type:
        assert open_chunks(folder, memory=1).extra["number"].dtype == torch.float64
    else:
        error = MissingFileError if damage == "missing" else FileFormatError
        with pytest.raises(error, match=rf"{name}\.npy"):
            open_chunks(folder, memory=1)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"gaussians": 299}, r"chunks of 299 rows together, got 300"),
        ({"version": 2}, r"version"),
        ({"format": "other"}, r"Gaussians in chunks"),
        ({"chunks": []}, r"chunks of 300 rows together, got 0"),
        ({"chunks": [{"rows": 300}]}, r"low"),
        ({"extra": ["a", "b", "c"]}, r"extra_2\.npy"),
        ({"low_pass": -1}, r"low_pass"),
    ],
)
def test_a_broken_index_is_one_error(gaussians, tmp_path, monkeypatch, change, said) -> None:
    folder = tmp_path / "gaussians"
    in_chunks(gaussians, folder, monkeypatch)
    path = folder / "chunks.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises((FileFormatError, MissingFileError), match=said):
        open_chunks(folder, memory=1)


def test_an_index_that_is_not_json_or_not_there(gaussians, tmp_path, monkeypatch) -> None:
    folder = tmp_path / "gaussians"
    in_chunks(gaussians, folder, monkeypatch)
    (folder / "chunks.json").write_text("{")
    with pytest.raises(FileFormatError, match=r"chunks\.json"):
        open_chunks(folder, memory=1)
    (folder / "chunks.json").unlink()
    with pytest.raises(MissingFileError, match=r"no chunks\.json"):
        open_chunks(folder, memory=1)


def test_a_box_that_does_not_hold_its_chunk_is_told_when_that_is_read(
    gaussians, tmp_path, monkeypatch
) -> None:
    """Views would miss what lies outside."""
    folder = tmp_path / "gaussians"
    in_chunks(gaussians, folder, monkeypatch)
    path = folder / "chunks.json"
    content = json.loads(path.read_text())
    content["chunks"][3]["high"] = content["chunks"][3]["low"]
    path.write_text(json.dumps(content))
    chunks = open_chunks(folder, memory=1).chunks
    assert chunks is not None
    start = int(chunks.starts[3])
    chunks.read([(0, start), (int(chunks.starts[4]), 300)])
    for run in ((start, start + 2), (start + 3, 300), (0, start + 2)):
        with pytest.raises(FileFormatError, match="the box of chunk 3 to hold"):
            chunks.read([run])


def test_a_file_that_shrinks_while_it_is_open(gaussians, tmp_path, monkeypatch) -> None:
    folder = tmp_path / "gaussians"
    chunks = in_chunks(gaussians, folder, monkeypatch).chunks
    assert chunks is not None
    truncate(folder / "scales.npy")
    with pytest.raises(FileFormatError, match=r"scales\.npy"):
        chunks.read([(0, 300)])
