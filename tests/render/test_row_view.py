"""A view of Gaussians in chunks gives what it gives of the same in memory, to the bit."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from render_scenes import float32, random_camera, random_gaussians

from splatseg import render as splat
from splatseg.errors import FileFormatError, InputError
from splatseg.render import SparseImage, SparseSignal
from support.chunked import in_chunks, in_memory

WIDTH, HEIGHT, COUNT = 37, 26, 400
LENSES = {"pinhole": {}, "barrel": {"model": "opencv", "distortion": (-0.15, 0.02)}}


@pytest.fixture(params=LENSES)
def camera(request, rng):
    return replace(random_camera(rng, width=WIDTH, height=HEIGHT), **LENSES[request.param])


@pytest.fixture
def chunked(rng, tmp_path, monkeypatch):
    return in_chunks(random_gaussians(rng, COUNT), tmp_path / "gaussians", monkeypatch, rows=4)


@pytest.fixture
def views(backend, chunked, camera):
    """Of the chunks and of the same in memory; the chunks beside the view are not read."""
    options = backend.options()
    asked = {"options": options, "backend": backend.name}
    with (
        splat.prepare(chunked, camera, **asked) as ours,
        splat.prepare(in_memory(chunked), camera, **asked) as theirs,
    ):
        assert ours.part is not None
        assert theirs.part is None
        assert 0 < len(ours.part.rows) < COUNT
        yield ours, theirs


def equal(backend, one, other) -> None:
    for name in one.__dataclass_fields__:
        a, b = getattr(one, name), getattr(other, name)
        assert backend.same(a, b) if isinstance(a, torch.Tensor) else a == b, name


def test_renders_and_their_adjoint(backend, views, rng) -> None:
    ours, theirs = views
    for channels in (None, 1, 3, 20):
        signal = None if channels is None else float32(rng.normal(size=(COUNT, channels)))
        for warp in ("bilinear", "nearest"):
            equal(backend, ours.render(signal, warp=warp), theirs.render(signal, warp=warp))
    image = float32(rng.normal(size=(HEIGHT, WIDTH, 5)))
    equal(backend, ours.back_project(image), theirs.back_project(image))


def test_rows_of_pixels(backend, views) -> None:
    ours, theirs = views
    pixels = torch.tensor([[0, 0], [WIDTH - 1, HEIGHT - 1], [7, 9], [20, 13]])
    for arguments in ((None, None), (pixels, None), (pixels, 2), (None, 2)):
        equal(backend, ours.weights(*arguments), theirs.weights(*arguments))
    equal(backend, ours.contributors(pixels, 5), theirs.contributors(pixels, 5))


def test_many_channels(backend, views, rng) -> None:
    ours, theirs = views
    pixels, count = WIDTH * HEIGHT, 90
    sparse = SparseImage(
        indptr=torch.arange(pixels + 1),
        channels=torch.from_numpy(rng.integers(0, count, pixels)).int(),
        values=torch.ones(pixels),
        count=count,
    )
    equal(backend, ours.back_project_sparse(sparse), theirs.back_project_sparse(sparse))
    channels = torch.from_numpy(rng.integers(0, count, (COUNT, 2))).int()
    for values in (None, float32(rng.random((COUNT, 2)))):
        signal = SparseSignal(channels=channels, values=values, count=count)
        found = ours.argmax(signal, background=3), theirs.argmax(signal, background=3)
        equal(backend, *found)


def test_parts_of_the_image(backend, chunked, rng) -> None:
    camera = random_camera(rng, width=WIDTH, height=HEIGHT)
    parts = [torch.from_numpy(rng.integers(-1, 4, WIDTH * HEIGHT)) for _ in range(2)]
    asked = {"options": backend.options(), "backend": backend.name}
    with (
        splat.prepare(chunked, camera, **asked) as ours,
        splat.prepare(in_memory(chunked), camera, **asked) as theirs,
    ):
        for one, other in zip(ours.part_sums(parts), theirs.part_sums(parts), strict=True):
            assert one.shape == other.shape
            assert one.has_sorted_indices
            for name in ("data", "indices", "indptr"):
                np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


def test_pictures(views, rng) -> None:
    ours, theirs = views
    tint = torch.from_numpy(rng.integers(0, 256, (COUNT, 4))).to(torch.uint8)
    grey, shown = float32(rng.random((COUNT, 1))), torch.from_numpy(rng.random(COUNT) < 0.5)
    for arguments in ({}, {"tint": tint}, {"signal": grey}, {"tint": tint, "shown": shown}):
        assert torch.equal(ours.picture(**arguments), theirs.picture(**arguments))


def test_a_view_of_nothing(backend, chunked) -> None:
    """With its back to all there is, nothing is read."""
    pose = torch.diag(torch.tensor([-1.0, 1, -1, 1])).double()
    pose[2, 3] = -60
    away = replace(random_camera(np.random.default_rng(1), width=9, height=8), cam_from_world=pose)
    with splat.prepare(chunked, away, options=backend.options(), backend=backend.name) as view:
        assert view.part is not None
        assert len(view.part.rows) == 0
        assert float(view.render().alpha.max()) == 0
        found = view.contributors(torch.tensor([[1, 1]]), 2)
        assert found.ids.tolist() == [[-1, -1]]
        assert found.first.tolist() == [-1]
        assert view.weights().shape == (72, COUNT)
        assert view.back_project(torch.ones(8, 9, 1)).weights.tolist() == [0.0] * COUNT


def test_what_is_made_of_chunks_is_not_in_chunks(chunked, rng) -> None:
    """A column that was exchanged would else be read from the disk as it was."""
    camera = random_camera(rng, width=WIDTH, height=HEIGHT)
    dimmed = chunked.replace(opacities=torch.zeros(COUNT))
    for made in (dimmed, chunked[:5], chunked.to(dtype=torch.float64)):
        assert made.chunks is None
    assert float(splat.render(dimmed, camera).alpha.max()) == 0


def test_a_row_that_cannot_be_rendered_is_refused_when_it_is_read(chunked, tmp_path, rng) -> None:
    path = tmp_path / "gaussians" / "opacities.npy"
    data = bytearray(path.read_bytes())
    data[-4 * COUNT :] = np.full(COUNT, 7, np.float32).tobytes()
    path.write_bytes(data)
    with pytest.raises(FileFormatError, match=r"gaussians: opacities: expected values"):
        splat.render(chunked, random_camera(rng, width=WIDTH, height=HEIGHT))


def test_harmonics_are_read_for_colours_alone(backend, chunked, rng, monkeypatch) -> None:
    """They are most of the bytes; a view that was asked for other things keeps its products."""
    reads: list[bool] = []
    read = chunked.chunks.read

    def counted(runs, *, colours=True):
        reads.append(colours)
        return read(runs, colours=colours)

    watched = chunked.in_chunks(replace(chunked.chunks, read=counted))
    camera = random_camera(rng, width=WIDTH, height=HEIGHT)
    asked = {"options": backend.options(), "backend": backend.name}
    with splat.prepare(watched, camera, **asked) as view:
        assert reads == []
        first = view.render(torch.ones(COUNT, 1))
        assert float(view.weights().row_sums().max()) > 0
        assert reads == [False]
        view.render()
        view.picture()
        assert reads == [False, True]
        equal(backend, view.render(torch.ones(COUNT, 1)), first)
        assert reads == [False, True]
    with splat.prepare(watched, camera, **asked) as view:
        view.picture()
        assert reads == [False, True, True]


def test_screen_offsets_need_gaussians_in_memory(chunked, rng) -> None:
    with (
        splat.prepare(chunked, random_camera(rng, width=9, height=8)) as view,
        pytest.raises(InputError, match="screen_offsets"),
    ):
        view.own.render(screen_offsets=torch.zeros(COUNT, 2))
