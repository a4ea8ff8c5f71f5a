"""Scenes that can be solved by hand, one for each constant and branch of the model.

The camera sits at the origin and looks along z; focal length 10; the axis meets the centre of
pixel (4, 4). A Gaussian of scale 0 is drawn as the low-pass alone, variance 0.3, so that at d
pixels from its centre alpha = o exp(-d^2 / 0.6).
"""

import math

import pytest
import torch
from render_scenes import assert_close, axis_camera, float32, gaussians_of

from splatseg.core import Camera
from splatseg.render._values import ALPHA_MIN, TRANSMITTANCE_MIN

TINY = 1e-6
LOW_PASS = 0.3


def on_axis(opacities, *, first_depth: float = 1.0, **changes):
    """One Gaussian behind the other on the optical axis, a unit apart."""
    depths = [first_depth + i for i in range(len(opacities))]
    return gaussians_of([[0.0, 0.0, z] for z in depths], opacities=opacities, **changes)


def middle(image: torch.Tensor) -> float:
    """The value at pixel (4, 4)."""
    return float(image[4, 4].squeeze())


# --- one Gaussian -----------------------------------------------------------------------------


def test_alpha_is_opacity_at_the_centre(backend):
    assert middle(backend.render(on_axis([0.5]), axis_camera()).alpha) == pytest.approx(0.5)


def test_alpha_is_capped(backend):
    cap = backend.options().alpha_max
    drawn = backend.render(on_axis([1.0]), axis_camera())
    assert middle(drawn.alpha) == pytest.approx(cap, abs=TINY)
    # Away from the centre the same Gaussian is under the cap and not touched by it.
    assert float(drawn.alpha[4, 5]) == pytest.approx(math.exp(-0.5 / LOW_PASS), rel=1e-5)


@pytest.mark.parametrize("cap", [0.5, 0.9])
def test_the_cap_is_an_option(cap, reference, rng):
    for bench in (reference, type(reference)("cpu")):
        drawn = bench.render(on_axis([1.0, 1.0]), axis_camera(), alpha_max=cap)
        assert middle(drawn.alpha) == pytest.approx(1 - (1 - cap) ** 2, abs=TINY)


@pytest.mark.parametrize(("opacity", "drawn"), [(0.99 * ALPHA_MIN, 0.0), (1.01 * ALPHA_MIN, 1.0)])
def test_alphas_under_one_step_of_a_byte_are_skipped(backend, opacity, drawn):
    alpha = backend.render(on_axis([opacity]), axis_camera()).alpha
    assert middle(alpha) == pytest.approx(drawn * opacity, abs=1e-9, rel=1e-5)


def test_alphas_under_one_step_are_skipped_pixel_by_pixel(backend):
    """With variance 0.3, alpha 1/255 of opacity o is reached at d^2 = 0.6 ln(255 o)."""
    alpha = backend.render(on_axis([0.9]), axis_camera()).alpha
    for row in range(9):
        for column in range(9):
            squared = (row - 4) ** 2 + (column - 4) ** 2
            expected = 0.9 * math.exp(-squared / (2 * LOW_PASS))
            expected = expected if expected >= ALPHA_MIN else 0.0
            assert float(alpha[row, column]) == pytest.approx(expected, rel=1e-5, abs=1e-9)
    assert (alpha > 0).sum() == 9, "3 x 3 pixels: d^2 = 4 is beyond 3.26"


def test_the_ellipse_is_not_cut_at_three_sigma(backend):
    """At 3.2 sigma the alpha 0.9 exp(-5.12) = 1.37/255 is still drawn."""
    sigma = math.sqrt(1 - LOW_PASS)
    camera = axis_camera(fx=1.0, fy=1.0, cx=4.5 + 0.2)
    alpha = backend.render(on_axis([0.9], scales=sigma), camera).alpha
    assert float(alpha[4, 1]) == pytest.approx(0.9 * math.exp(-(3.2**2) / 2), rel=1e-4)


def test_the_low_pass_is_added_to_both_variances(backend):
    """Projected variances (f s / z)^2 + 0.3 along u and v, with focal lengths that differ."""
    camera = axis_camera(fx=10.0, fy=20.0)
    alpha = backend.render(gaussians_of([0, 0, 2.0], scales=0.2, opacities=0.8), camera).alpha
    var_u, var_v = (10 * 0.2 / 2) ** 2 + LOW_PASS, (20 * 0.2 / 2) ** 2 + LOW_PASS
    assert float(alpha[4, 6]) == pytest.approx(0.8 * math.exp(-4 / (2 * var_u)), rel=1e-5)
    assert float(alpha[6, 4]) == pytest.approx(0.8 * math.exp(-4 / (2 * var_v)), rel=1e-5)


@pytest.mark.parametrize("low_pass", [0.1, 1.0])
def test_the_low_pass_is_an_option(backend, low_pass):
    alpha = backend.render(on_axis([0.8]), axis_camera(), low_pass=low_pass).alpha
    expected = 0.8 * math.exp(-1 / (2 * low_pass))
    assert float(alpha[4, 5]) == pytest.approx(expected, rel=1e-5)


def test_without_a_low_pass_a_point_is_not_drawn(backend):
    alpha = backend.render(on_axis([0.8]), axis_camera(), low_pass=0.0).alpha
    assert not alpha.any()


def test_antialiasing_keeps_the_light(backend):
    """Variance 1 becomes 1.3 in both directions: opacity times sqrt(1 / 1.69)."""
    scene = gaussians_of([0, 0, 10.0], scales=1.0, opacities=0.8)
    alpha = backend.render(scene, axis_camera(), antialiased=True).alpha
    assert middle(alpha) == pytest.approx(0.8 / 1.3, rel=1e-5)
    expected = 0.8 / 1.3 * math.exp(-1 / 2.6)
    assert float(alpha[4, 5]) == pytest.approx(expected, rel=1e-5)


def test_antialiasing_drops_what_is_too_small(backend):
    """A point has no light at all; variance 1e-3 keeps 0.9 * 1e-3 / 0.301, under 1/255."""
    for size in (0.0, math.sqrt(1e-3)):
        scene = gaussians_of([0, 0, 10.0], scales=size, opacities=0.9)
        assert not backend.render(scene, axis_camera(), antialiased=True).alpha.any()


# --- where it is drawn ------------------------------------------------------------------------


def test_pixel_centres_are_at_halves(backend):
    """A point at (u, v) = (6.5, 2.5) is brightest in column 6, row 2, and symmetric about it."""
    scene = gaussians_of([0.2, -0.2, 1.0])
    alpha = backend.render(scene, axis_camera()).alpha
    assert float(alpha[2, 6]) == pytest.approx(0.5)
    assert float(alpha[2, 5]) == pytest.approx(float(alpha[2, 7]), rel=1e-5)
    assert float(alpha[1, 6]) == pytest.approx(float(alpha[3, 6]), rel=1e-5)


def test_x_is_right_and_y_is_down_and_the_pose_is_cam_from_world(backend):
    """The camera moves one to the right and one down of the world: points move left and up."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = torch.tensor([-0.2, -0.1, 0.0])
    alpha = backend.render(gaussians_of([0, 0, 1.0]), axis_camera(cam_from_world=pose)).alpha
    assert float(alpha[3, 2]) == pytest.approx(0.5)


def test_a_needle_lies_where_its_quaternion_turns_it(backend):
    """Long along its own x; wxyz turned by 90 degrees about z it is long along v."""
    long_x = {"scales": [[1.0, 0.0, 0.0]], "opacities": 0.9}
    camera = axis_camera()
    point = [0, 0, 5.0]
    half = math.sqrt(0.5)
    flat = backend.render(gaussians_of(point, **long_x), camera).alpha
    upright = backend.render(
        gaussians_of(point, rotations=[half, 0, 0, half], **long_x), camera
    ).alpha
    assert float(flat[4, 6]) == pytest.approx(0.9 * math.exp(-4 / (2 * 4.3)), rel=1e-5)
    assert float(flat[6, 4]) == 0
    assert_close(upright, flat.T, atol=TINY)


def test_a_needle_can_lie_slantwise(backend):
    """Turned by 45 degrees about z, from x towards y, it runs down to the right."""
    angle = math.pi / 8
    scene = gaussians_of(
        [0, 0, 5.0],
        scales=[[1.0, 0.0, 0.0]],
        opacities=0.9,
        rotations=[math.cos(angle), 0, 0, math.sin(angle)],
    )
    alpha = backend.render(scene, axis_camera()).alpha
    # Along the needle the variance is 4.3, across 0.3.
    assert float(alpha[6, 6]) == pytest.approx(0.9 * math.exp(-8 / (2 * 4.3)), rel=1e-5)
    assert float(alpha[5, 3]) == pytest.approx(0.9 * math.exp(-2 / (2 * 0.3)), rel=1e-4)


def test_quaternions_need_not_have_unit_length(backend):
    scene = gaussians_of([0, 0, 5.0], scales=[[1, 0.2, 0.1]], rotations=[0.5, 0.1, 0.7, 0.2])
    once = backend.render(scene, axis_camera()).alpha
    long = backend.render(scene.replace(rotations=scene.rotations * 7), axis_camera()).alpha
    assert_close(long, once, atol=TINY)


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize("principal", [4.5, 3.0])
def test_the_jacobian_is_clamped_to_the_view_and_a_margin(backend, axis, side, principal):
    """A ball far outside: its slope counts up to the edge of the view plus 0.3 half widths.

    With W = 9, f = 10: slopes are held in [-c/10 - 0.135, (9 - c)/10 + 0.135]. A ball of scale
    s at depth z and slope t has the variance (f s / z)^2 (1 + t^2) along t's axis, plus 0.3.
    """
    slope, z, s = side * 3.0, 2.0, 4.0
    mean = [0.0, 0.0, z]
    mean[axis] = slope * z
    principal_point = {"cx": 4.5, "cy": 4.5} | {("cx", "cy")[axis]: principal}
    camera = axis_camera(**principal_point)
    scene = gaussians_of(mean, scales=s, opacities=0.9)
    margin = 0.3 * 0.5 * 9 / 10
    held = min(max(slope, -principal / 10 - margin), (9 - principal) / 10 + margin)
    variance = (10 * s / z) ** 2 * (1 + held**2) + LOW_PASS
    pixel = [4, 4]
    pixel[axis] = 6
    distance = 6.5 - (10 * slope + principal)
    alpha = backend.render(scene, camera).alpha
    expected = 0.9 * math.exp(-(distance**2) / (2 * variance))
    assert expected > 2 * ALPHA_MIN
    # The other axis is exact: the centre's own row (or column), if the principal point is there.
    assert float(alpha[pixel[1], pixel[0]]) == pytest.approx(expected, rel=1e-4)


def test_inside_the_margin_the_jacobian_is_that_of_the_centre(backend):
    """Slope 0.5 is outside the view (0.45) and inside the margin (0.585): not clamped."""
    camera, s, z = axis_camera(), 0.3, 2.0
    alpha = backend.render(gaussians_of([1.0, 0, z], scales=s, opacities=0.9), camera).alpha
    variance = (10 * s / z) ** 2 * (1 + 0.5**2) + LOW_PASS
    assert float(alpha[4, 8]) == pytest.approx(0.9 * math.exp(-1 / (2 * variance)), rel=1e-5)


# --- the near plane ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("depth", "is_drawn"), [(-1.0, False), (0.0, False), (0.5, False), (0.50001, True), (3.0, True)]
)
def test_only_what_lies_beyond_the_near_plane_is_drawn(backend, depth, is_drawn):
    scene = gaussians_of([0.0, 0.0, depth], scales=0.01)
    alpha = backend.render(scene, axis_camera(), near=0.5).alpha
    assert middle(alpha) == pytest.approx(0.5 if is_drawn else 0.0)


def test_the_near_plane_is_at_one_hundredth(backend):
    scene = gaussians_of([[0, 0, 0.0099], [0, 0, 0.0101]], opacities=[0.5, 0.25])
    assert middle(backend.render(scene, axis_camera()).alpha) == pytest.approx(0.25)


# --- several Gaussians ------------------------------------------------------------------------


def test_weights_are_alpha_times_what_those_before_let_through(backend):
    signal = torch.eye(3)
    image = backend.render(on_axis([0.5, 0.4, 0.8]), axis_camera(), signal).image
    expected = [0.5, 0.5 * 0.4, 0.5 * 0.6 * 0.8]
    assert image[4, 4].tolist() == pytest.approx(expected, rel=1e-5)


def test_nothing_shows_through_an_opaque_stack(backend):
    """Each takes 95 %. The fourth would leave 6e-6 <= 1e-4, so it is not blended and the pixel
    ends: the fifth, which alone would leave 1.1e-4, is not blended either."""
    signal = torch.tensor([[1.0], [0.0], [0.0], [1e6], [1e6]])
    drawn = backend.render(on_axis([0.95, 0.95, 0.95, 0.95, 0.1]), axis_camera(), signal)
    assert middle(drawn.image) == pytest.approx(0.95, rel=1e-5)
    assert middle(drawn.alpha) == pytest.approx(1 - 0.05**3, rel=1e-6)


def test_a_pixel_goes_on_while_more_than_a_ten_thousandth_is_left(backend):
    """0.05^3 = 1.25e-4; one that takes 19 % leaves 1.0125e-4 and is blended, one that takes 21 %
    would leave 0.9875e-4 and is not."""
    for opacity, blended in ((0.19, True), (0.21, False)):
        signal = torch.tensor([[0.0], [0.0], [0.0], [1.0]])
        drawn = backend.render(on_axis([0.95, 0.95, 0.95, opacity]), axis_camera(), signal)
        expected = opacity * 0.05**3 if blended else 0.0
        assert middle(drawn.image) == pytest.approx(expected, rel=1e-3, abs=1e-12)
    assert TRANSMITTANCE_MIN == 1e-4


def test_a_skipped_gaussian_does_not_end_the_pixel(backend):
    """Behind three opaque ones, one with alpha < 1/255 is skipped and a visible one follows."""
    opacities = [0.95, 0.95, 0.95, 0.5 * ALPHA_MIN, 0.1]
    image = backend.render(on_axis(opacities), axis_camera(), torch.eye(5)).image
    assert float(image[4, 4, 3]) == 0
    assert float(image[4, 4, 4]) == pytest.approx(0.1 * 0.05**3, rel=1e-3)


def test_order_is_by_depth_whatever_the_index(backend):
    scene = gaussians_of([[0, 0, 3.0], [0, 0, 1.0], [0, 0, 2.0]], opacities=[0.5, 0.6, 0.7])
    image = backend.render(scene, axis_camera(), torch.eye(3)).image
    expected = [0.4 * 0.3 * 0.5, 0.6, 0.4 * 0.7]
    assert image[4, 4].tolist() == pytest.approx(expected, rel=1e-5)


def test_equal_depths_are_ordered_by_index(backend):
    """300 at the same place: the first takes half, the next half of the rest, and so on."""
    count = 300
    scene = gaussians_of([[0.0, 0.0, 2.0]] * count, opacities=0.5)
    image = backend.render(scene, axis_camera(), torch.eye(count)[:, :16]).image
    blended = 13  # 0.5^13 = 1.22e-4, and the next would leave 0.61e-4
    expected = [0.5 ** (i + 1) if i < blended else 0.0 for i in range(16)]
    assert image[4, 4].tolist() == pytest.approx(expected, rel=1e-5)


# --- depth ------------------------------------------------------------------------------------


def test_expected_depth_is_the_mean_over_what_is_seen(backend):
    scene = gaussians_of([[0, 0, 2.0], [0, 0, 4.0]], opacities=[0.4, 0.9])
    drawn = backend.render(scene, axis_camera())
    assert middle(drawn.depth) == pytest.approx((0.4 * 2 + 0.54 * 4) / 0.94, rel=1e-5)
    assert float(drawn.depth[0, 0]) == 0


@pytest.mark.parametrize(
    ("opacities", "median"),
    [([0.4], 0.0), ([0.4, 0.1], 0.0), ([0.4, 0.2], 2.0), ([0.5], 1.0), ([0.8, 0.9], 1.0)],
)
def test_median_depth_is_where_half_of_the_light_is_gone(backend, opacities, median):
    """Transmittance 0.6, 0.54, 0.48, exactly 0.5 and 0.2."""
    assert middle(backend.render(on_axis(opacities), axis_camera()).median_depth) == median


def test_depth_is_along_the_axis_not_along_the_ray(backend):
    drawn = backend.render(gaussians_of([1.2, 0, 3.0]), axis_camera())
    assert float(drawn.depth[4, 8]) == pytest.approx(3.0, rel=1e-6)


# --- colour -----------------------------------------------------------------------------------

SH_C0, SH_C1 = 0.28209479177387814, 0.4886025119029199


def test_colour_is_half_plus_the_harmonics(backend):
    scene = on_axis([0.5], sh=[[[1.0, 0.0, -1.0]]])
    image = backend.render(scene, axis_camera()).image
    expected = [0.5 * (0.5 + SH_C0), 0.5 * 0.5, 0.5 * (0.5 - SH_C0)]
    assert image[4, 4].tolist() == pytest.approx(expected, rel=1e-5)


def test_colour_is_not_negative_but_may_exceed_one(backend):
    scene = on_axis([0.5], sh=[[[-9.0, 9.0, 0.0]]])
    image = backend.render(scene, axis_camera()).image
    assert image[4, 4].tolist() == pytest.approx([0.0, 0.5 * (0.5 + 9 * SH_C0), 0.25], rel=1e-5)


def test_colour_depends_on_the_direction_from_the_camera_to_the_gaussian(backend):
    """The three functions of degree 1 are -y, z, -x times 0.4886, red, green and blue here."""
    sh = torch.zeros(1, 4, 3)
    for k in range(3):
        sh[0, k + 1, k] = 0.5
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = torch.tensor([0.0, 0.0, 1.0])
    point = torch.tensor([0.3, -0.6, 2.0])
    scene = gaussians_of(point, opacities=0.5, sh=sh)
    image = backend.render(scene, axis_camera(cam_from_world=pose)).image
    ray = point + torch.tensor([0, 0, 1.0])
    x, y, z = (ray / torch.linalg.vector_norm(ray)).tolist()
    expected = [0.5 * (0.5 + 0.5 * SH_C1 * t) for t in (-y, z, -x)]
    assert image[2, 5].tolist() == pytest.approx(expected, rel=1e-5)
    plain = backend.render(scene, axis_camera(cam_from_world=pose), sh_degree=0).image
    assert plain[2, 5].tolist() == pytest.approx([0.25] * 3, rel=1e-5)


def test_a_signal_takes_the_place_of_colour(backend):
    scene = on_axis([0.5], sh=[[[1.0, 1.0, 1.0]]])
    image = backend.render(scene, axis_camera(), float32([[-3.0, 7.0]])).image
    assert image[4, 4].tolist() == pytest.approx([-1.5, 3.5])


# --- the adjoint and the rows -----------------------------------------------------------------


def test_back_projection_by_hand(backend):
    camera = Camera(width=1, height=1, fx=10, fy=10, cx=0.5, cy=0.5, cam_from_world=torch.eye(4))
    back = backend.back_project(on_axis([0.5, 0.4]), camera, float32([[[2.0, -1.0]]]))
    assert back.weights.tolist() == pytest.approx([0.5, 0.2], rel=1e-5)
    assert back.sums.flatten().tolist() == pytest.approx([1.0, -0.5, 0.4, -0.2], rel=1e-5)


def test_contributors_by_hand(backend):
    """Weights 0.2, 0.16, 0.32 and transmittances 0.8, 0.64, 0.32: the last passes one half."""
    scene = on_axis([0.2, 0.2, 0.5])
    pixels = torch.tensor([[4, 4], [0, 0]])
    found = backend.contributors(scene, axis_camera(), pixels, 4)
    assert found.ids[0].tolist() == [2, 0, 1, -1]
    assert found.weights[0].tolist() == pytest.approx([0.32, 0.2, 0.16, 0.0], rel=1e-5)
    assert found.first.tolist() == [0, -1]
    assert found.median.tolist() == [2, -1]
    assert found.ids[1].tolist() == [-1] * 4


def test_contributors_of_equal_weight_come_front_to_back(backend):
    """Opacities o and then o / (1 - o) weigh the same, up to the last digit."""
    ties = 0
    for o in torch.linspace(0.05, 0.45, 40).tolist():
        found = backend.contributors(
            on_axis([o, o / (1 - o)]), axis_camera(), torch.tensor([[4, 4]]), 2
        )
        near, far = found.weights[0].tolist()
        assert near == pytest.approx(far, rel=1e-6)
        if near == far:
            ties += 1
            assert found.ids[0].tolist() == [0, 1]
    assert ties > 5, "the scene must have ties"
