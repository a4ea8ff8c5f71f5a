"""Gradients: the reference against finite differences, the fast ones against the reference."""

from dataclasses import replace

import pytest
import torch
from render_scenes import axis_camera, bands, float32, random_camera, random_gaussians

from splatseg.core import Camera, Gaussians
from splatseg.render import RenderOptions, get_backend
from splatseg.render import render as splat_render

COLUMNS = ("means", "rotations", "scales", "opacities", "sh")
LAST_ROW = torch.tensor([[0.0, 0.0, 0.0, 1.0]], dtype=torch.float64)


def _small_scene() -> tuple[Gaussians, Camera]:
    """Five Gaussians on 6 x 5 pixels, float64: one off to the side, so that its Jacobian is
    clamped, one behind the camera, one faint."""
    generator = torch.Generator().manual_seed(3)
    means = [[0.1, 0.2, 2.0], [-0.3, 0.1, 2.5], [4.5, 0.3, 3.0], [0.2, -0.2, -2.0], [0, 0.3, 4.0]]
    scene = Gaussians(
        means=torch.tensor(means, dtype=torch.float64),
        rotations=torch.randn(5, 4, generator=generator, dtype=torch.float64),
        scales=torch.tensor(
            [[0.7, 1.1, 0.9], [0.9, 0.7, 1.2], [2.0, 2.5, 1.8], [1, 1, 1], [1.5, 1.6, 0.8]],
            dtype=torch.float64,
        ),
        opacities=torch.tensor([0.6, 0.5, 0.7, 0.9, 0.8], dtype=torch.float64),
        sh=torch.randn(5, 4, 3, generator=generator, dtype=torch.float64) * 0.2,
    )
    camera = axis_camera(width=6, height=5, fx=6.0, fy=5.5, cx=3.2, cy=2.4)
    return scene, camera


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("with_signal", [False, True])
def test_the_reference_agrees_with_finite_differences(antialiased, with_signal):
    scene, camera = _small_scene()
    options = RenderOptions(antialiased=antialiased)
    pose = camera.cam_from_world[:3].clone()
    generator = torch.Generator().manual_seed(9)
    signal = torch.randn(5, 2, generator=generator, dtype=torch.float64)
    columns = [scene.means, scene.rotations, scene.scales, scene.opacities, scene.sh]

    def draw(means, rotations, scales, opacities, sh, signal, pose):
        drawn = splat_render(
            Gaussians(means=means, rotations=rotations, scales=scales, opacities=opacities, sh=sh),
            replace(camera, cam_from_world=torch.cat((pose, LAST_ROW))),
            signal if with_signal else None,
            options=options,
            backend="reference",
        )
        return drawn.image, drawn.alpha, drawn.depth

    inputs = [t.clone().requires_grad_() for t in (*columns, signal, pose)]
    image, alpha, _ = draw(*inputs)
    assert (alpha > 0.1).all(), "every pixel must be covered"
    (clamped,) = torch.autograd.grad(image.sum(), inputs[0])
    assert clamped[2].abs().max() > 0, "the clamped one must be seen"
    assert not clamped[3].any(), "the one behind the camera must not"
    assert torch.autograd.gradcheck(draw, inputs, eps=1e-6, atol=1e-6, rtol=1e-5, fast_mode=False)


def test_the_harmonics_agree_with_finite_differences():
    """All 16, towards the coefficients, the places and the pose that give the direction."""
    scene, camera = _small_scene()
    generator = torch.Generator().manual_seed(5)
    sh = torch.randn(5, 16, 3, generator=generator, dtype=torch.float64) * 0.2

    def draw(means, sh, pose):
        return splat_render(
            scene.replace(means=means, sh=sh),
            replace(camera, cam_from_world=torch.cat((pose, LAST_ROW))),
            backend="reference",
        ).image

    inputs = [t.clone().requires_grad_() for t in (scene.means, sh, camera.cam_from_world[:3])]
    assert torch.autograd.gradcheck(draw, inputs, atol=1e-6, rtol=1e-5, fast_mode=True)


def _gradients(backend, scene, camera, signal, v_outputs, options) -> dict[str, torch.Tensor]:
    """Gradients of <image, gradients> + <alpha, ...> + <depth, ...> towards everything."""
    leaves = {name: getattr(scene, name).clone().requires_grad_() for name in COLUMNS}
    pose = camera.cam_from_world[:3].clone().requires_grad_()
    if signal is not None:
        leaves["signal"] = signal.clone().requires_grad_()
        leaves.pop("sh")
    columns = {name: leaf for name, leaf in leaves.items() if name != "signal"}
    drawn = splat_render(
        scene.replace(**columns),
        replace(camera, cam_from_world=torch.cat((pose, LAST_ROW))),
        leaves.get("signal"),
        options=options,
        backend=backend,
    )
    image, alpha, depth = (s.to(drawn.image) for s in v_outputs)
    loss = (drawn.image * image).sum() + (drawn.alpha * alpha).sum() + (drawn.depth * depth).sum()
    loss.backward()
    found = {name: leaf.grad for name, leaf in leaves.items()}
    return found | {"pose": pose.grad}


@pytest.mark.parametrize("channels", [None, 1, 3, 17, 64])
@pytest.mark.parametrize("antialiased", [False, True])
def test_gradients_match_the_reference(fast_backend, rng, channels, antialiased):
    camera = random_camera(rng, width=40, height=33)
    scene = random_gaussians(rng, 250)
    # Opaque ones sit on the edge of the cap, where the derivative jumps.
    scene = scene.replace(opacities=scene.opacities.clamp(max=0.95))
    signal = None if channels is None else float32(rng.normal(size=(250, channels)))
    options = fast_backend.options(antialiased=antialiased)
    band = bands(scene, camera, options)
    certain = float32((~(band.threshold | band.swap)).numpy())
    assert certain.mean() > 0.9
    width = 3 if channels is None else channels
    v_outputs = (
        float32(rng.normal(size=(33, 40, width))) * certain[..., None],
        float32(rng.normal(size=(33, 40))) * certain,
        float32(rng.normal(size=(33, 40))) * certain * 0.3,
    )

    fast = _gradients(fast_backend.name, scene, camera, signal, v_outputs, options)
    wide = scene.to(dtype=torch.float64)
    slow_signal = None if signal is None else signal.double()
    slow = _gradients("reference", wide, camera, slow_signal, v_outputs, options)

    assert fast.keys() == slow.keys()
    for name, expected in slow.items():
        actual = fast[name]
        assert actual is not None, name
        assert torch.isfinite(actual).all(), name
        assert expected.abs().max() > 0, name
        error = torch.linalg.vector_norm(actual.double() - expected)
        assert error < 2e-4 * torch.linalg.vector_norm(expected), name


def test_gradients_at_the_cap_are_zero(backend):
    """min(cap, o e^(-q/2)) is flat where the cap holds: neither opacity nor place matters."""
    scene = random_free_scene(opacity=1.0)
    leaves = [scene.means.requires_grad_(), scene.opacities.requires_grad_()]
    drawn = backend.render(
        scene.replace(means=leaves[0], opacities=leaves[1]), axis_camera(width=1, height=1)
    )
    drawn.alpha.sum().backward()
    assert float(drawn.alpha.detach()) == pytest.approx(backend.options().alpha_max)
    assert not leaves[0].grad.any()
    assert not leaves[1].grad.any()


def random_free_scene(*, opacity: float) -> Gaussians:
    """One ball on the axis."""
    return Gaussians(
        means=torch.tensor([[0.0, 0.0, 2.0]]),
        rotations=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        scales=torch.full((1, 3), 0.5),
        opacities=torch.tensor([opacity]),
        sh=torch.zeros(1, 1, 3),
    )


def test_gradients_by_hand(backend):
    """alpha = o at the centre: d alpha / d o = 1, and the two-layer chain rule for the signal."""
    near, far = random_free_scene(opacity=0.4), random_free_scene(opacity=0.6)
    scene = Gaussians.concatenate([near, far.replace(means=far.means + 1)])
    scene = scene.replace(means=torch.tensor([[0.0, 0, 2.0], [0.0, 0, 3.0]]))
    opacities = scene.opacities.clone().requires_grad_()
    signal = torch.tensor([[2.0], [5.0]], requires_grad=True)
    drawn = backend.render(
        scene.replace(opacities=opacities), axis_camera(width=1, height=1), signal
    )
    drawn.image.sum().backward()
    # 2 o1 + 5 (1 - o1) o2
    assert opacities.grad.tolist() == pytest.approx([2 - 5 * 0.6, 5 * 0.6], rel=1e-4)
    assert signal.grad.flatten().tolist() == pytest.approx([0.4, 0.36], rel=1e-4)


def test_nothing_visible_gives_zero_gradients(backend):
    scene = random_free_scene(opacity=0.5)
    means = torch.tensor([[0.0, 0.0, -5.0]], requires_grad=True)
    backend.render(scene.replace(means=means), axis_camera()).image.sum().backward()
    assert means.grad is not None
    assert not means.grad.any()


def test_gradients_are_finite_where_values_are_extreme(backend):
    """Culled and degenerate rows must not leak 0 * inf into the others or into themselves."""
    scene = Gaussians(
        means=torch.tensor(
            [[0.0, 0, 0], [0, 0, 2], [0, 0, 3], [1e8, 0, 1e8], [0, 0, 0.011], [0, 0, 4]]
        ),
        rotations=torch.eye(4)[:1].expand(6, 4),
        scales=torch.tensor(
            [[1.0, 1, 1], [0, 0, 0], [1e6, 0, 0], [1e7, 1e7, 1e7], [1e-3, 1e-3, 1e-3], [1, 1, 1]]
        ),
        opacities=torch.tensor([0.5, 0.5, 0.5, 0.5, 0.2, 0.0]),
        sh=torch.zeros(6, 4, 3),
    )
    for antialiased in (False, True):
        leaves = {
            name: getattr(scene, name).clone().requires_grad_()
            for name in ("means", "rotations", "scales", "opacities", "sh")
        }
        drawn = backend.render(scene.replace(**leaves), axis_camera(), antialiased=antialiased)
        (drawn.image.sum() + drawn.depth.sum()).backward()
        for name, leaf in leaves.items():
            assert leaf.grad is not None, name
            assert torch.isfinite(leaf.grad).all(), name


@pytest.mark.parametrize("wanted", ["means", "rotations", "scales", "opacities", "sh"])
def test_only_what_is_asked_for_is_differentiated(backend, rng, wanted):
    camera = random_camera(rng, width=20, height=20)
    scene = random_gaussians(rng, 50)
    leaf = getattr(scene, wanted).clone().requires_grad_()
    drawn = backend.render(scene.replace(**{wanted: leaf}), camera)
    drawn.image.sum().backward()
    assert leaf.grad.abs().max() > 0
    assert not drawn.median_depth.requires_grad


@pytest.mark.parametrize("antialiased", [False, True])
def test_the_slope_in_the_projected_centres(rng, antialiased):
    """The reference moves the centre by the leaf's value; the cpu's leaf only has a gradient."""
    generator = torch.Generator().manual_seed(5)
    scene, camera = random_gaussians(rng, 40).to(dtype=torch.float64), random_camera(rng)
    options = RenderOptions(antialiased=antialiased)
    v_outputs = torch.randn(
        camera.height, camera.width, 3, generator=generator, dtype=torch.float64
    )

    def loss(scene, camera, name, screen_offsets=None):
        backend = get_backend(name)
        drawn = backend.render(scene, camera, None, options=options, screen_offsets=screen_offsets)
        return (drawn.image * v_outputs.to(drawn.image)).sum()

    found = {}
    for name, typed in (("reference", scene), ("cpu", scene.to(dtype=torch.float32))):
        screen_offsets = torch.zeros_like(typed.means[:, :2]).requires_grad_()
        loss(typed, camera, name, screen_offsets).backward()
        found[name] = screen_offsets.grad.double()
    reference = found["reference"]
    assert (found["cpu"] - reference).norm() <= 1e-4 * reference.norm()

    step = 1e-5
    row = int(reference.norm(dim=1).argmax())
    for axis in range(2):
        offset = torch.zeros_like(reference)
        offset[row, axis] = step
        rise = loss(scene, camera, "reference", offset) - loss(scene, camera, "reference", -offset)
        assert float(rise) / (2 * step) == pytest.approx(float(reference[row, axis]), rel=1e-4)
