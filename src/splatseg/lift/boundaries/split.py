r"""Splits of Gaussians, and how cameras see them, in each Gaussian's own frame.

A Gaussian is the image of the unit ball's distribution under :math:`x = \mu + L z` with
:math:`L = R\,\mathrm{diag}(s)`. A direction e of length 1 in z is a line through the Gaussian
whose end, one standard deviation from the centre, is :math:`\mu + L e` in the world.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg._check import check_finite, check_shape
from splatseg.core import Camera, Edited, Gaussians, Selection
from splatseg.core.boundary import boundary
from splatseg.core.rigid import quaternion_from_rotation, rotation_from_quaternion
from splatseg.errors import InputError, RangeError, ShapeError

_MIN_SCALE_RATIO = 1e-4
"""Minimum scale, as a part of the largest, that a division is made with. A Gaussian of no
thickness is taken for one that is very thin."""

_SPHERE_DIRECTIONS = 64
_NEAR = 0.01


def axes_of(gaussians: Gaussians) -> Float[Tensor, "n 3 3"]:
    """L = R diag(s), float64: column k is axis k, one standard deviation long."""
    rotations = rotation_from_quaternion(gaussians.rotations.double())
    return rotations * gaussians.scales.double().unsqueeze(1)


def main_directions(gaussians: Gaussians) -> Float[Tensor, "n 3"]:
    """Unit vectors e along each Gaussian's longest axis, in its own frame."""
    longest = gaussians.scales.argmax(dim=1)
    return torch.nn.functional.one_hot(longest, 3).double()


def directions_of_normals(
    gaussians: Gaussians, normals: Float[Tensor, "n 3"]
) -> Float[Tensor, "n 3"]:
    r"""Directions e whose split separates the two sides of planes best.

    The plane :math:`n \cdot x = d` is :math:`(L^\top n) \cdot z = d - n \cdot \mu` in the
    Gaussian's frame, so e is :math:`L^\top n` at unit length; the main axis where that is zero.
    """
    pulled = torch.einsum("nij,ni->nj", axes_of(gaussians), normals.double())
    return unit_or_main(gaussians, pulled)


def unit_or_main(gaussians: Gaussians, vectors: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Vectors of a Gaussian's frame at unit length; its main direction where there is none."""
    length = torch.linalg.vector_norm(vectors, dim=1, keepdim=True)
    usable = length > 0
    return torch.where(
        usable, vectors / torch.where(usable, length, 1.0), main_directions(gaussians)
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LineExtent:
    """How cameras see a line through each Gaussian."""

    across: Float[Tensor, "n"]
    """Root of the mean of rho squared, see `mixture`: 1 across the views, 0 along them."""

    pixels: Float[Tensor, "n"]
    """Largest standard deviation along the line in any image, pixels; infinite where there
    are no cameras, 0 where none has the centre in its image."""


def line_extent(
    gaussians: Gaussians, directions: Float[Tensor, "n 3"], cameras: Sequence[Camera] = ()
) -> LineExtent:
    r"""How much of the lines `directions` the cameras show.

    Seen along a ray d, whitened :math:`d_w = L^{-1} d`, the projected Gaussian is that of z
    along :math:`d_w`, so that :math:`\rho^2 = 1 - (e \cdot d_w)^2 / |d_w|^2`. Cameras that have
    the centre in their image count by the Gaussian's area in it, :math:`|d_w| |L| / z^2`.
    Without any, directions all over the sphere do.

    Args:
        gaussians: The Gaussians.
        directions: Unit vectors e, each in its Gaussian's frame.
        cameras: Any cameras; distortion is ignored.
    """
    e = directions.double()
    axes = axes_of(gaussians)
    ends = torch.einsum("nij,nj->ni", axes, e)
    total = torch.zeros(len(gaussians), dtype=torch.float64)
    squares = torch.zeros_like(total)
    pixels = torch.zeros_like(total)
    means = gaussians.means.double()
    inverse = _inverse_axes(gaussians)
    for camera in cameras:
        points = camera.cam_from_world.double()[:3, :3] @ means.T
        points = points.T + camera.cam_from_world.double()[:3, 3]
        z = points[:, 2]
        inside = _inside(camera, points)
        rays = means - camera.centre.double()
        distance = torch.linalg.vector_norm(rays, dim=1).clamp_min(1e-12)
        rays = rays / distance.unsqueeze(1)
        weight, rho2 = _area_and_share(inverse, rays, e)
        weight = torch.where(inside, weight / distance**2, 0.0)
        total += weight
        squares += weight * rho2
        shown = ends - (ends * rays).sum(1, keepdim=True) * rays
        size = max(camera.fx, camera.fy) * torch.linalg.vector_norm(shown, dim=1)
        pixels = torch.maximum(pixels, torch.where(inside, size / z.clamp_min(_NEAR), 0.0))
    unseen = total <= 0
    if bool(unseen.any()):
        for ray in _sphere_directions():
            weight, rho2 = _area_and_share(inverse, ray.expand_as(means), e)
            weight = torch.where(unseen, weight, 0.0)
            total += weight
            squares += weight * rho2
    if not cameras:
        pixels = torch.full_like(pixels, torch.inf)
    return LineExtent(
        across=torch.sqrt((squares / total.clamp_min(1e-300)).clamp(0, 1)), pixels=pixels
    )


def _inside(camera: Camera, points: Tensor) -> Tensor:
    """Which points in the camera's frame lie in its image, distortion left aside."""
    z = points[:, 2]
    positive_z = z.clamp_min(_NEAR)
    u = camera.fx * points[:, 0] / positive_z + camera.cx
    v = camera.fy * points[:, 1] / positive_z + camera.cy
    return (z > _NEAR) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)


def _inverse_axes(gaussians: Gaussians) -> Tensor:
    """L^-1 times |L|: the adjugate, up to Gaussians that are thinner than can be divided by."""
    scales = gaussians.scales.double()
    largest = scales.amax(dim=1, keepdim=True)
    scales = torch.maximum(scales, _MIN_SCALE_RATIO * largest).clamp_min(1e-30)
    rotations = rotation_from_quaternion(gaussians.rotations.double())
    volume = scales.prod(dim=1, keepdim=True)
    return (volume / scales).unsqueeze(2) * rotations.transpose(1, 2)


def _area_and_share(inverse: Tensor, rays: Tensor, e: Tensor) -> tuple[Tensor, Tensor]:
    """|d_w| |L|, which is the area of the projection, and rho squared."""
    whitened = torch.einsum("nij,nj->ni", inverse, rays)
    area = torch.linalg.vector_norm(whitened, dim=1)
    along = (whitened * e).sum(dim=1) / area.clamp_min(1e-300)
    return area, (1 - along**2).clamp(0, 1)


def _sphere_directions() -> Tensor:
    """Directions spread over the half sphere (the other half sees the same)."""
    i = torch.arange(_SPHERE_DIRECTIONS, dtype=torch.float64) + 0.5
    z = i / _SPHERE_DIRECTIONS
    angle = torch.pi * (1 + 5**0.5) * i
    ring = torch.sqrt(1 - z * z)
    return torch.stack((ring * torch.cos(angle), ring * torch.sin(angle), z), dim=-1)


_GRID_END = 4.0
"""Standard deviations at which the integral ends."""

_GRID_NODES = 81
_GAUSS_NEWTON_STEPS = 24
_ALPHA_MAX = 0.99
"""Largest alpha of the blending model."""

_REGULARISATION = 1e-3
"""Pull towards o w / r_rho, as a part of the normal matrix' trace: where parts lie over each
other (rho near 0) any opacities with the same sum look alike, and those are taken."""

_ROWS = 16384
"""Gaussians solved at a time, which bounds memory."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Mixture:
    r"""A standard normal distribution in narrower parts.

    **Offsets, widths and weights.** The standard normal density is replaced by N of the same
    standard deviation r < 1 at offsets :math:`m_c` with weights :math:`w_c`, symmetric about 0,
    such that its moments up to the third stay what they are:

    .. math:: \sum_c w_c = 1, \qquad \sum_c w_c m_c = 0, \qquad r^2 + \sum_c w_c m_c^2 = 1

    What freedom is left for a given r (the weights and the ratios of the offsets) makes the squared
    difference of the two densities smallest; a test finds the constants below again.

    **Opacities.** Along the direction of the split a Gaussian's alpha is :math:`o\, e^{-u^2 / 2}`
    at a distance of u standard deviations on the image. Seen at an angle its parts lie closer: with
    :math:`\rho` the part of the split direction's length that the image shows (1 across the view, 0
    along it) they are at :math:`\rho m_c` with deviation
    :math:`r_\rho = \sqrt{1 - \rho^2 (1 - r^2)}`. They are blended one behind the other, so their
    opacities :math:`o_c` (symmetric like the weights) are those that make

    .. math:: \int \Bigl( 1 - \prod_c \bigl(1 - o_c\, e^{-(u - \rho m_c)^2 / 2 r_\rho^2}\bigr)
              - o\, e^{-u^2 / 2} \Bigr)^2 du

    smallest. For a faint Gaussian seen across that is about :math:`o\, w_c / r_\rho`, the plain
    statement that a part of the mass has a part of the weight; parts of an opaque one cover each
    other and need more, and those of one seen end-on lie over each other and need less. The
    opacities depend on o and :math:`\rho` only and are found by Gauss-Newton steps on a grid of u,
    with a slight pull towards that statement where it is all the same.

    References:
        Huber et al., On entropy approximation for Gaussian mixture random vectors (2008), section
        5: splitting one component along an axis with constants found beforehand.
    """

    offsets: tuple[float, ...]
    """Means of the parts, standard deviations of the whole, ascending."""

    weights: tuple[float, ...]
    """Their shares, which add up to 1."""

    @property
    def width(self) -> float:
        """Standard deviation of each part; makes the second moment exactly 1."""
        spread = sum(w * m * m for w, m in zip(self.weights, self.offsets, strict=True))
        return (1.0 - spread) ** 0.5


def _symmetric(offsets: tuple[float, ...], weights: tuple[float, ...]) -> Mixture:
    """From the part of the constants at and right of 0 (an offset of 0 stands first)."""
    skip = 1 if offsets[0] == 0 else 0
    return Mixture(
        offsets=(*(-m for m in reversed(offsets[skip:])), *offsets),
        weights=(*reversed(weights[skip:]), *weights),
    )


MIXTURES: dict[int, Mixture] = {
    # Widths 0.8 and 0.68.
    2: _symmetric((0.6,), (0.5,)),
    3: _symmetric((0.0, 1.12773), (0.57728, 0.21136)),
}
"""By number of parts. Two parts differ by 4.5 % of the density's root mean square and three, that
are narrower, by 2.1 %: a part at the centre is what an opaque Gaussian needs. More parts are had
by splitting again."""


def opacities_of_parts(
    opacities: Float[Tensor, "n"],
    across: Float[Tensor, "n"],
    mixture: Mixture,
) -> Float[Tensor, "n parts"]:
    r"""Opacities of the parts of Gaussians so that the parts together look like them.

    Args:
        opacities: Of the Gaussians, in [0, 1].
        across: :math:`\rho`, how much of the split direction the views show, in [0, 1].
        mixture: How they are split.

    Returns:
        :math:`o_c` of each part, in [0, 1], in the order of the offsets.
    """
    batches = zip(opacities.double().split(_ROWS), across.double().split(_ROWS), strict=True)
    blocks = [_solved(o, rho, mixture) for o, rho in batches]
    if not blocks:
        return opacities.new_zeros(0, len(mixture.offsets))
    return torch.cat(blocks).to(opacities)


def _solved(o: Tensor, rho: Tensor, mixture: Mixture) -> Tensor:
    weights = torch.tensor(mixture.weights, dtype=o.dtype)
    offsets = torch.tensor(mixture.offsets, dtype=o.dtype)
    u = torch.linspace(-_GRID_END, _GRID_END, _GRID_NODES, dtype=o.dtype)
    width = torch.sqrt(1 - rho**2 * (1 - mixture.width**2))
    # Axes: Gaussian, node, part.
    distance = (u[None, :, None] - rho[:, None, None] * offsets) / width[:, None, None]
    densities = torch.exp(-0.5 * distance**2)
    wanted = (o[:, None] * torch.exp(-0.5 * u**2)).clamp_max(_ALPHA_MAX)
    mirrored = _mirror_pairs(len(offsets)).to(o)
    # One unknown a mirrored pair: its opacity.
    start = ((o / width)[:, None] * weights) @ mirrored.T / mirrored.sum(dim=1)
    solution = start
    eye = torch.eye(len(mirrored), dtype=o.dtype)
    for _ in range(_GAUSS_NEWTON_STEPS):
        alpha = (solution @ mirrored)[:, None, :] * densities
        free = alpha < _ALPHA_MAX
        alpha = alpha.clamp_max(_ALPHA_MAX)
        transmittance = torch.prod(1 - alpha, dim=-1, keepdim=True)
        jacobian = (transmittance / (1 - alpha) * torch.where(free, densities, 0.0)) @ mirrored.T
        residual = (1 - transmittance).squeeze(-1) - wanted
        gradient = torch.einsum("nuk,nu->nk", jacobian, residual)
        normal = torch.einsum("nuk,nul->nkl", jacobian, jacobian)
        trace = normal.diagonal(dim1=1, dim2=2).sum(dim=1)[:, None, None] + 1e-12
        gradient += _REGULARISATION * trace.squeeze(2) * (solution - start)
        step = torch.linalg.solve(normal + _REGULARISATION * trace * eye, gradient)
        solution = (solution - step).clamp(0, 1)
    return solution @ mirrored


def _mirror_pairs(parts: int) -> Tensor:
    """Which parts (columns) share one opacity (rows): those at m and -m."""
    mirrored = torch.zeros((parts + 1) // 2, parts)
    for part in range(parts):
        mirrored[min(part, parts - 1 - part), part] = 1
    return mirrored


_AXIS_TOLERANCE = 1e-9
"""Deviation from an axis, below which a direction is that axis."""


@boundary
def split(
    gaussians: Gaussians,
    selection: Selection,
    *,
    normals: Float[Tensor, "m 3"] | None = None,
    parts: int = 3,
    cameras: Sequence[Camera] = (),
) -> Edited:
    r"""Replace each selected Gaussian by parts that keep its moments and look like it.

    With :math:`x = \mu + L z`, :math:`L = R\,\mathrm{diag}(s)`, and a unit direction e in z, the
    parts of a mixture (`mixture`, offsets m, weights w, width r) are

    .. math:: \mu_c = \mu + m_c L e, \qquad
              \Sigma_c = L \bigl( I - (1 - r^2)\, e e^\top \bigr) L^\top

    so that with the weights w the mass, the mean and the covariance stay exactly what they were:

    .. math:: \sum_c w_c = 1, \quad \sum_c w_c \mu_c = \mu, \quad
              \sum_c w_c \bigl(\Sigma_c + (\mu_c - \mu)(\mu_c - \mu)^\top\bigr) = \Sigma

    Along the longest axis only that axis' scale changes. Across a plane with normal n, e is
    :math:`L^\top n` at unit length: the split that moves the parts farthest from the plane,
    measured in their own width.

    Colours and extra columns are copied; opacities are those of `opacities_of_parts`, for the
    angles at which `cameras` see the split.

    Args:
        gaussians: The Gaussians.
        selection: Which are to be split. Those of no size stay as they are.
        normals: For each selected one, in the order of rows, the normal of the cut in the
            world, of any length. None splits along the longest axis.
        parts: 2 or 3. Three are narrower and look more like the whole.
        cameras: Cameras that rendered images matter for; without any, all directions do alike.

    Returns:
        The Gaussians that stay, in order, and behind them the parts, those of one Gaussian
        together; rows lead each part to its Gaussian, fractions are the weights.

    Raises:
        ShapeError: If the selection or the normals are of other Gaussians.
        RangeError: If there is no mixture of so many parts, or a normal is not finite.

    Example:
        >>> one = Gaussians(means=torch.zeros(1, 3), rotations=torch.eye(4)[:1],
        ...                 scales=torch.tensor([[1.0, 0.1, 0.1]]), opacities=torch.ones(1),
        ...                 sh=torch.zeros(1, 1, 3))
        >>> split(one, Selection(mask=torch.tensor([True])), parts=2).gaussians.means[:, 0]
        tensor([-0.6000,  0.6000])
    """
    _check(gaussians, selection, parts)
    rows = selection.ids
    if normals is not None:
        check_shape("normals", normals, (len(rows), 3))
        check_finite("normals", normals)
    chosen = gaussians[rows]
    directions = (
        main_directions(chosen) if normals is None else directions_of_normals(chosen, normals)
    )
    return split_along(gaussians, selection, directions, parts=parts, cameras=cameras)


def split_along(
    gaussians: Gaussians,
    selection: Selection,
    directions: Float[Tensor, "m 3"],
    *,
    parts: int = 3,
    cameras: Sequence[Camera] = (),
) -> Edited:
    """As `split`, with directions e in the frames of the selected Gaussians (z, whitened)."""
    _check(gaussians, selection, parts)
    rows = selection.ids
    check_shape("directions", directions, (len(rows), 3))
    sized = gaussians.scales[rows].amax(dim=1) > 0
    rows, directions = rows[sized], directions[sized]
    chosen = gaussians[rows]
    e = unit_or_main(chosen, directions.double())
    mixture = MIXTURES[parts]
    weights = torch.tensor(mixture.weights, dtype=torch.float64)
    offsets = torch.tensor(mixture.offsets, dtype=torch.float64)
    principal = torch.einsum("nij,nj->ni", axes_of(chosen), e)
    means = chosen.means.double().unsqueeze(1) + offsets[None, :, None] * principal.unsqueeze(1)
    rotations, scales = narrowed(chosen, e, mixture.width)
    across = line_extent(chosen, e, cameras).across
    opacities = opacities_of_parts(chosen.opacities, across, mixture)
    of_part = torch.arange(len(rows)).repeat_interleave(parts)
    parts_of_chosen = chosen[of_part].replace(
        means=means.reshape(-1, 3).to(gaussians.means),
        rotations=rotations[of_part].to(gaussians.rotations),
        scales=scales[of_part].to(gaussians.scales),
        opacities=opacities.reshape(-1).to(gaussians.opacities),
    )
    kept = torch.ones(len(gaussians), dtype=torch.bool)
    kept[rows] = False
    unsplit = torch.nonzero(kept).squeeze(1)
    return Edited(
        gaussians=Gaussians.concatenate([gaussians[unsplit], parts_of_chosen]),
        rows=torch.cat((unsplit, rows[of_part])),
        fractions=torch.cat((torch.ones(len(unsplit)), weights.float().repeat(len(rows)))),
    )


def narrowed(
    gaussians: Gaussians, directions: Float[Tensor, "n 3"], width: float
) -> tuple[Float[Tensor, "n 4"], Float[Tensor, "n 3"]]:
    r"""Rotations and scales of :math:`L (I - (1 - r^2) e e^\top) L^\top`.

    It is :math:`M M^\top` with :math:`M = L (I - (1 - r) e e^\top)`, whose singular value
    decomposition has the axes and the scales. Along an axis nothing turns.
    """
    e = directions.double()
    rotations, scales = gaussians.rotations.double(), gaussians.scales.double()
    along = (e.abs().amax(dim=1) - 1).abs() < _AXIS_TOLERANCE
    axis = torch.nn.functional.one_hot(e.abs().argmax(dim=1), 3).double()
    scales_along = scales * (1 - (1 - width) * axis)
    if bool(along.all()):
        return rotations, scales_along
    slanted = torch.nonzero(~along).squeeze(1)
    shrink = torch.eye(3, dtype=torch.float64) - (1 - width) * torch.einsum(
        "ni,nj->nij", e[slanted], e[slanted]
    )
    turned, sizes, _ = torch.linalg.svd(axes_of(gaussians[slanted]) @ shrink)
    # A mirrored frame has the same covariance once one axis is turned round.
    mirrored = torch.linalg.det(turned) < 0
    turned[mirrored, :, 2] *= -1
    rotations = rotations.index_copy(0, slanted, quaternion_from_rotation(turned))
    return rotations, scales_along.index_copy(0, slanted, sizes)


def _check(gaussians: Gaussians, selection: Selection, parts: int) -> None:
    if len(selection) != len(gaussians):
        raise ShapeError(
            f"selection: expected one over {len(gaussians)} Gaussians, "
            f"got one over {len(selection)}."
        )
    if not selection.count:
        raise InputError("selection: expected at least one Gaussian, got none.")
    if parts not in MIXTURES:
        raise RangeError(f"parts: expected one of {', '.join(map(str, MIXTURES))}, got {parts}.")
