"""A view prepared once gives what views prepared each time give, bit for bit on the CPU."""

from dataclasses import replace

import gsplat_in_torch
import numpy as np
import pytest
import torch
from render_scenes import Bench, float32, random_camera, random_gaussians

import splatseg.render.reference as reference_backend
from splatseg import render as splat
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.render import SparseImage, _backend
from splatseg.render.cpu import set_threads
from splatseg.render.cuda import CudaBackend
from splatseg.render.prepared import PreparedView
from splatseg.render.reference import ReferenceBackend

WIDTH, HEIGHT, COUNT = 37, 26, 90
LENSES = {"pinhole": {}, "barrel": {"model": "opencv", "distortion": (-0.15, 0.02)}}


@pytest.fixture(params=LENSES)
def camera(request, rng):
    return replace(random_camera(rng, width=WIDTH, height=HEIGHT), **LENSES[request.param])


@pytest.fixture
def scene(rng):
    return random_gaussians(rng, COUNT)


def prepared(bench, scene, camera):
    return splat.prepare(scene, camera, options=bench.options(), backend=bench.name)


def _same(backend, one, other) -> None:
    for name in one.__dataclass_fields__:
        a, b = getattr(one, name), getattr(other, name)
        assert backend.same(a, b) if isinstance(a, torch.Tensor) else a == b, name


def test_products_in_any_order_are_the_direct_ones(backend, rng, camera, scene) -> None:
    """Each kind of product twice, so that none spoils the view for the next."""
    widths = [None, 1, 64, 3, 5, None, 2, 16]
    signals = [None if c is None else float32(rng.normal(size=(COUNT, c))) for c in widths]
    image = float32(rng.normal(size=(HEIGHT, WIDTH, 5)))
    pixels = torch.tensor([[0, 0], [WIDTH - 1, HEIGHT - 1], [7, 9], [7, 9]])
    with prepared(backend, scene, camera) as view:
        for signal in signals:
            _same(backend, view.render(signal), backend.render(scene, camera, signal))
            _same(backend, view.back_project(image), backend.back_project(scene, camera, image))
            _same(
                backend,
                view.contributors(pixels, 3),
                backend.contributors(scene, camera, pixels, 3),
            )
        for arguments in ((None, None), (pixels, None), (pixels, 2), (None, 2)):
            _same(backend, view.weights(*arguments), backend.weights(scene, camera, *arguments))
        _same(backend, view.render(), backend.render(scene, camera))


def test_gradients_are_the_direct_ones(backend, rng, camera, scene) -> None:
    signal = float32(rng.normal(size=(COUNT, 6)))

    def gradients(render):
        leaves = [scene.means.clone().requires_grad_(), signal.clone().requires_grad_()]
        moved = scene.replace(means=leaves[0])
        for values in (leaves[1], None):
            drawn = render(moved, values)
            (drawn.image.square().sum() + drawn.depth.sum()).backward()
        return [leaf.grad for leaf in leaves]

    direct = gradients(lambda moved, values: backend.render(moved, camera, values))
    with prepared(backend, scene, camera) as frozen:
        frozen.render(signal)
        kept = {}

        def render(moved, values):
            view = kept.setdefault("view", prepared(backend, moved, camera))
            with torch.no_grad():
                view.render(values)
            return view.render(values)

        found = gradients(render)
        kept["view"].close()
    assert all(backend.same(a, b) for a, b in zip(direct, found, strict=True))
    assert bool(direct[0].any())


def test_harmonics_are_those_of_the_moment_of_rendering(backend, camera, scene) -> None:
    with prepared(backend, scene, camera) as view:
        before = view.render().image
        ones = view.render(torch.ones(COUNT, 3)).image
        assert torch.equal(view.render().image, before)
        assert not torch.equal(ones, before)


def test_a_view_is_projected_once(monkeypatch, rng, scene) -> None:
    calls = []
    original = reference_backend.project

    def project(*arguments, **options):
        calls.append(1)
        return original(*arguments, **options)

    monkeypatch.setattr(reference_backend, "project", project)
    with splat.prepare(scene, random_camera(rng), backend="reference") as view:
        view.render()
        view.render(torch.ones(COUNT, 4))
        view.back_project(torch.ones(40, 50, 2))
        view.contributors(torch.tensor([[0, 0]]), 1)
        assert len(calls) == 1


def test_a_closed_view_says_so(backend, camera, scene) -> None:
    view = prepared(backend, scene, camera)
    view.render()
    view.close()
    view.close()
    for call in (
        view.render,
        lambda: view.render(torch.ones(COUNT, 20)),
        lambda: view.back_project(torch.ones(HEIGHT, WIDTH, 1)),
        lambda: view.contributors(torch.tensor([[0, 0]]), 1),
        view.weights,
    ):
        with pytest.raises(InputError, match="closed"):
            call()


def test_what_it_is_given_is_checked(backend, camera, scene) -> None:
    with prepared(backend, scene, camera) as view:
        with pytest.raises(ShapeError, match="signal"):
            view.render(torch.ones(COUNT + 1, 2))
        with pytest.raises(RangeError, match="signal"):
            view.render(torch.full((COUNT, 2), torch.nan))
        with pytest.raises(ShapeError, match="image"):
            view.back_project(torch.ones(HEIGHT, WIDTH + 1, 2))
        with pytest.raises(RangeError, match="k: "):
            view.weights(k=0)
        with pytest.raises(ShapeError, match="image"):
            view.back_project_sparse(sparse_image(torch.zeros(3, 1)))
    with pytest.raises(RangeError, match="means"):
        splat.prepare(scene.replace(means=scene.means * torch.nan), camera, backend=backend.name)


def sparse_image(dense: torch.Tensor) -> SparseImage:
    """The entries of (pixels, channels) that are not 0."""
    row, channel = torch.nonzero(dense, as_tuple=True)
    counts = torch.bincount(row, minlength=len(dense))
    return SparseImage(
        indptr=torch.cat((torch.zeros(1, dtype=torch.int64), counts.cumsum(0))),
        channels=channel.to(torch.int32),
        values=dense[row, channel],
        count=dense.shape[1],
    )


def overlapping_masks(rng, channels: int) -> torch.Tensor:
    """Rectangles with weights (pixels, channels); pixels lie in none, one or many."""
    image = torch.zeros(HEIGHT, WIDTH, channels)
    for channel in range(channels):
        (top, bottom), (left, right) = (
            sorted(rng.integers(0, size, 2).tolist()) for size in (HEIGHT, WIDTH)
        )
        image[top : bottom + 1, left : right + 1, channel] = float(rng.uniform(0.1, 2))
    image[:, :3] = 0
    return image


@pytest.mark.parametrize("channels", [1, 20, 150])
def test_sparse_images_are_back_projected_as_dense_ones(
    backend, rng, camera, scene, channels
) -> None:
    image = overlapping_masks(rng, channels)
    with prepared(backend, scene, camera) as view:
        found = view.back_project_sparse(sparse_image(image.flatten(0, 1)))
        expected = view.back_project(image, warp="nearest")
    assert backend.same(found.weights, expected.weights.float())
    table = torch.zeros(COUNT, channels)
    table[found.gaussians, found.channels] = found.sums
    assert backend.same(table, expected.sums.float())
    key = found.gaussians * channels + found.channels
    assert bool((key.diff() > 0).all())
    assert bool((found.sums != 0).all())


def test_a_sparse_image_of_nothing_still_shows_gaussians(backend, camera, scene) -> None:
    nothing = sparse_image(torch.zeros(WIDTH * HEIGHT, 0))
    with prepared(backend, scene, camera) as view:
        found = view.back_project_sparse(nothing)
        seen = view.back_project(torch.zeros(HEIGHT, WIDTH, 1), warp="nearest").weights
    assert len(found.sums) == 0
    assert backend.same(found.weights, seen.float())
    assert bool((found.weights > 0).any())


@pytest.mark.bits
def test_sparse_back_projection_does_not_depend_on_threads(rng, same_threads_afterwards) -> None:
    camera, scene = random_camera(rng, width=131, height=90), random_gaussians(rng, 3000)
    ids = torch.from_numpy(rng.integers(0, 300, (90 * 131, 1)))
    image = torch.zeros(90 * 131, 300).scatter_(1, ids, 1.0)
    found = []
    for count in (1, 2, 3, 7):
        set_threads(count)
        with splat.prepare(scene, camera, backend="cpu") as view:
            found.append(view.back_project_sparse(sparse_image(image)))
    for other in found[1:]:
        _same(Bench("cpu"), found[0], other)


def test_sparse_images_are_checked() -> None:
    good = {
        "indptr": torch.tensor([0, 1]),
        "channels": torch.zeros(1, dtype=torch.int32),
        "values": torch.ones(1),
        "count": 1,
    }
    SparseImage(**good)
    for name, bad, said in (
        ("indptr", torch.tensor([0, 2]), "indptr"),
        ("indptr", torch.tensor([0, 1], dtype=torch.int32), "int64"),
        ("channels", torch.ones(1, dtype=torch.int32), r"channels: expected values in \[0, 1\)"),
        ("channels", -torch.ones(1, dtype=torch.int32), "channels"),
        ("channels", torch.zeros(2, dtype=torch.int32), "values"),
        ("values", torch.ones(1).double(), "float32"),
    ):
        with pytest.raises(InputError, match=said):
            SparseImage(**{**good, name: bad})


@pytest.mark.parametrize("chunk", [1, 7, 64])
def test_backends_without_a_kernel_go_a_few_channels_at_a_time(
    monkeypatch, rng, scene, chunk
) -> None:
    monkeypatch.setattr(_backend, "_CHANNELS", chunk)
    camera = random_camera(rng, width=WIDTH, height=HEIGHT)
    image = overlapping_masks(rng, 20)
    options = splat.default_options("reference")
    view = PreparedView(scene, camera, options=options, backend=ReferenceBackend())
    found = view.back_project_sparse(sparse_image(image.flatten(0, 1)))
    table = torch.zeros(COUNT, 20)
    table[found.gaussians, found.channels] = found.sums
    expected = view.back_project(image).sums.float()
    torch.testing.assert_close(table, expected, rtol=1e-6, atol=1e-7)


def test_the_cuda_backend_keeps_its_projection(rng, scene, monkeypatch) -> None:
    """On gsplat's own torch code; no GPU is needed for what is done around it."""
    camera = random_camera(rng, width=WIDTH, height=HEIGHT)
    backend = CudaBackend(library=gsplat_in_torch.LIBRARY, device="cpu")
    options = splat.RenderOptions(alpha_max=0.999)
    calls = []
    original = gsplat_in_torch.LIBRARY.isect_tiles
    monkeypatch.setattr(
        gsplat_in_torch.LIBRARY,
        "isect_tiles",
        lambda *args, **kwargs: (calls.append(1), original(*args, **kwargs))[1],
    )
    signal = float32(rng.normal(size=(COUNT, 5)))
    direct = backend.render(scene, camera, signal, options=options)
    calls.clear()
    with PreparedView(scene, camera, options=options, backend=backend) as view:
        for _ in range(2):
            _same(Bench("cuda"), view.render(signal), direct)
        view.back_project(torch.ones(HEIGHT, WIDTH, 2))
        view.weights()
        assert len(calls) == 1
        leaf = signal.clone().requires_grad_()
        image = float32(np.ones((HEIGHT, WIDTH, 5)))
        for _ in range(2):
            leaf.grad = None
            (view.render(leaf).image * image).sum().backward()
            torch.testing.assert_close(leaf.grad, view.back_project(image).sums)
