"""The CUDA backend without a GPU: what it says, and its glue over gsplat's functions in torch.

Where there is a GPU the whole suite runs on it too (see conftest); here the arithmetic around
gsplat's kernels is proven on any machine: channels, depths, medians, rows, gradients, culling.
"""

import importlib.util

import gsplat_in_torch
import pytest
import torch
from render_scenes import (
    axis_camera,
    bands,
    float32,
    random_camera,
    random_gaussians,
)

import splatseg.render.cuda as cuda_module
from splatseg import render as splat
from splatseg.errors import BackendError, MissingPackageError
from splatseg.render import RenderOptions
from splatseg.render.cuda import CudaBackend
from splatseg.render.reference import ReferenceBackend

OPTIONS = RenderOptions(alpha_max=0.999)
COUNT = 120


@pytest.fixture
def cuda() -> CudaBackend:
    """The backend over gsplat's functions in torch."""
    return CudaBackend(library=gsplat_in_torch.LIBRARY, device="cpu")


@pytest.fixture
def reference() -> ReferenceBackend:
    """The readable backend."""
    return ReferenceBackend()


@pytest.fixture
def camera(rng):
    return random_camera(rng, width=37, height=29)


@pytest.fixture
def scene(rng):
    scene = random_gaussians(rng, COUNT)
    # gsplat's torch projection in float32 is poor for points and needles; its CUDA is not used.
    return scene.replace(scales=scene.scales.clamp(0.05, 0.6))


@pytest.fixture
def inside(scene, camera):
    """Pixels where float32 and float64 take the same branches."""
    band = bands(scene, camera, OPTIONS)
    keep = ~(band.threshold | band.swap | band.median)
    assert keep.float().mean() > 0.9
    return keep


# --- what it says -----------------------------------------------------------------------------


class _NoModules:
    """Stands for importlib where nothing is installed."""

    @staticmethod
    def import_module(name: str) -> None:
        raise ImportError(name)


def test_without_a_gpu_it_says_so(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(MissingPackageError, match="install a CUDA build of torch") as caught:
        CudaBackend()
    assert "cpu backend" in str(caught.value)


def test_asking_for_cuda_never_gives_another(monkeypatch, scene, camera):
    if torch.cuda.is_available() and importlib.util.find_spec("gsplat"):
        assert splat.get_backend("cuda").name == "cuda"
        return
    with pytest.raises(MissingPackageError):
        splat.get_backend("cuda")
    with pytest.raises(MissingPackageError):
        splat.render(scene, camera, backend="cuda")


def test_kernels_that_do_not_load_are_reported(monkeypatch):
    """gsplat without its compiled part imports well and fails at the first call."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    with pytest.raises(BackendError, match=r"kernels do not load .*needs nvcc of the CUDA toolkit"):
        cuda_module.load_gsplat(device="cpu")


def test_without_gsplat_it_says_what_else_that_needs(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    monkeypatch.setattr(cuda_module, "importlib", _NoModules)
    with pytest.raises(MissingPackageError, match=r"pip install 'splatseg\[cuda\]'") as caught:
        cuda_module.load_gsplat()
    assert "nvcc of the CUDA toolkit 13.0" in str(caught.value)


def test_without_a_gpu_it_does_not_send_for_gsplat(monkeypatch):
    """It would be of no use there, so what is missing first is said first."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(cuda_module, "importlib", _NoModules)
    with pytest.raises(MissingPackageError, match="NVIDIA GPU"):
        cuda_module.load_gsplat()


@pytest.mark.parametrize("alpha_max", [0.99, 0.5])
def test_another_opacity_cap_is_refused(cuda, scene, camera, alpha_max):
    options = RenderOptions(alpha_max=alpha_max)
    image = torch.zeros(camera.height, camera.width, 1)
    for ask in (
        lambda: cuda.render(scene, camera, None, options=options),
        lambda: cuda.prepare(scene, camera, options=options).back_project(image),
        lambda: cuda.prepare(scene, camera, options=options).contributors(
            torch.tensor([[0, 0]]), 1
        ),
        lambda: cuda.prepare(scene, camera, options=options).rows(None, None),
    ):
        with pytest.raises(BackendError, match=r"0\.999.*RenderOptions\(alpha_max=0\.999\)"):
            ask()


# --- its glue ---------------------------------------------------------------------------------


@pytest.mark.parametrize("channels", [None, 1, 3, 31, 32, 33, 70])
@pytest.mark.parametrize("antialiased", [False, True])
def test_views_match_the_reference(
    cuda, reference, rng, scene, camera, inside, channels, antialiased
):
    options = RenderOptions(alpha_max=0.999, antialiased=antialiased)
    signal = None if channels is None else float32(rng.normal(size=(COUNT, channels)))
    fast = cuda.render(scene, camera, signal, options=options)
    slow = reference.render(scene, camera, signal, options=options)
    band = bands(scene, camera, options)
    keep = inside & ~(band.threshold | band.median)
    assert slow.alpha.mean() > 0.15
    for name in ("image", "alpha", "depth", "median_depth"):
        torch.testing.assert_close(
            getattr(fast, name)[keep], getattr(slow, name)[keep], atol=1e-4, rtol=1e-4
        )


@pytest.mark.parametrize("channels", [1, 31, 32, 65])
def test_the_adjoint_is_the_transpose(cuda, rng, scene, camera, channels):
    signal = float32(rng.normal(size=(COUNT, channels)))
    image = float32(rng.normal(size=(camera.height, camera.width, channels)))
    drawn = cuda.render(scene, camera, signal, options=OPTIONS)
    back = cuda.prepare(scene, camera, options=OPTIONS).back_project(image)
    product = drawn.image.double() * image.double()
    right = (signal.double() * back.sums.double()).sum()
    assert abs(product.sum() - right) < 1e-5 * product.abs().sum()
    assert float(back.weights.sum()) == pytest.approx(float(drawn.alpha.sum()), rel=1e-5)
    assert not back.sums.requires_grad


def test_rows_are_those_of_w(cuda, rng, scene, camera):
    dense = torch.stack(
        [
            cuda.render(scene, camera, column[:, None], options=OPTIONS).image.flatten()
            for column in torch.eye(COUNT)
        ],
        dim=1,
    )
    every = cuda.prepare(scene, camera, options=OPTIONS).rows(None, None)
    rows = torch.repeat_interleave(torch.arange(every.shape[0]), every.indptr.diff())
    found = torch.zeros_like(dense)
    found[rows, every.ids.long()] = every.weights.float()
    torch.testing.assert_close(found, dense, atol=1e-5, rtol=2**-10)

    # In the order asked for, the same pixel twice, and one where nothing is.
    pixels = torch.tensor([[20, 20], [3, 4], [20, 20], [36, 28]])
    some = cuda.prepare(scene, camera, options=OPTIONS).rows(pixels, None)
    wanted = dense[pixels[:, 1] * camera.width + pixels[:, 0]]
    signal = float32(rng.normal(size=(COUNT, 4)))
    torch.testing.assert_close(some.product(signal), wanted @ signal, atol=5e-3, rtol=0)

    ranked = cuda.prepare(scene, camera, options=OPTIONS).contributors(pixels, 3)
    strongest = wanted.sort(dim=1, descending=True).values[:, :3]
    torch.testing.assert_close(ranked.weights, strongest, atol=1e-5, rtol=1e-4)


def test_gradients_reach_everything(cuda, reference, rng, scene, camera, inside):
    """gsplat's torch projection is differentiated by autograd, as its kernels are by hand."""
    scene = scene.replace(opacities=scene.opacities.clamp(max=0.95))
    band = bands(scene, camera, OPTIONS)
    v_image = float32(rng.normal(size=(camera.height, camera.width, 3)))
    v_image = v_image * (~(band.threshold | band.swap))[..., None]
    found = []
    for backend in (cuda, reference):
        names = ("means", "rotations", "scales", "opacities", "sh")
        leaves = {name: getattr(scene, name).clone().requires_grad_() for name in names}
        drawn = backend.render(scene.replace(**leaves), camera, None, options=OPTIONS)
        ((drawn.image * v_image).sum() + (drawn.depth * v_image[..., 0]).sum()).backward()
        found.append({name: leaf.grad for name, leaf in leaves.items()})
    for name, expected in found[1].items():
        error = torch.linalg.vector_norm(found[0][name] - expected)
        assert error < 2e-3 * torch.linalg.vector_norm(expected), name


@pytest.mark.parametrize("depth", [0.5, -1.0])
def test_the_near_plane_itself_is_not_drawn(cuda, scene, depth):
    """gsplat keeps z >= near, the model z > near."""
    one = scene[:1].replace(means=torch.tensor([[0.0, 0.0, depth]]), opacities=torch.ones(1))
    options = RenderOptions(alpha_max=0.999, near=0.5)
    assert not cuda.render(one, axis_camera(), None, options=options).alpha.any()


@pytest.mark.parametrize("count", [0, 5])
def test_nothing_visible(cuda, scene, camera, count):
    hidden = scene[:count].replace(means=scene.means[:count] * 0 - 5)
    signal = torch.ones(count, 40, requires_grad=True)
    drawn = cuda.render(hidden, camera, signal, options=OPTIONS)
    assert drawn.image.shape == (camera.height, camera.width, 40)
    assert not drawn.image.any()
    drawn.image.sum().backward()
    assert not signal.grad.any()
    image = torch.ones(camera.height, camera.width, 2)
    assert cuda.prepare(hidden, camera, options=OPTIONS).back_project(image).sums.shape == (
        count,
        2,
    )
    kept = cuda.prepare(hidden, camera, options=OPTIONS).rows(None, None)
    assert len(kept.ids) == 0
