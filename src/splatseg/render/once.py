"""One view, used once: prepared, asked, and closed again. See `prepare` for views used again."""

from jaxtyping import Float, Int
from torch import Tensor

from splatseg.core import Camera, Gaussians
from splatseg.core.boundary import boundary
from splatseg.render._backend import RenderOptions
from splatseg.render._rows import SparseWeights
from splatseg.render._values import BackProjected, Contributors, Rendered
from splatseg.render.prepared import prepare
from splatseg.render.warp import WarpMode


@boundary
def render(
    gaussians: Gaussians,
    camera: Camera,
    signal: Float[Tensor, "n channels"] | None = None,
    *,
    options: RenderOptions | None = None,
    backend: str = "auto",
    warp: WarpMode = "bilinear",
) -> Rendered:
    r"""Render any per-Gaussian signal in a view: ``W @ signal``.

    .. math:: I(p) = \sum_i f_i \, \alpha_i(p) \prod_{j < i} (1 - \alpha_j(p))

    with :math:`\alpha_i(p) = \min(0.99, o_i e^{-q_i(p) / 2})` and q the squared Mahalanobis
    distance to the projected Gaussian (Kerbl et al. 2023, eq. 3 and appendix C). Constants are
    in `render._values`, conventions in ``docs/conventions.md``.

    Differentiable in torch towards the signal, and towards means, rotations, scales, opacities,
    spherical harmonics and ``camera.cam_from_world`` where they require a gradient.

    Args:
        gaussians: The Gaussians to render.
        camera: The camera; with distortion, the image is in the photograph's distorted pixels.
        signal: One row a Gaussian, 1 to 1024 channels; None is the colour of the SH.
        options: Switches of the blending model; None is what the Gaussians were
            fitted with, with the constants of the backend (`options_for`).
        backend: ``auto``, ``cpu``, ``cuda`` or ``reference``.
        warp: How distorted pixels read the pinhole image: ``bilinear`` from the four
            pixels around, or ``nearest``, for ids and wherever the result is to agree with
            `weights` and `contributors`. Without distortion the two are the same.

    Returns:
        Image, alpha, expected and median depth, see `Rendered`.

    Raises:
        ShapeError: If the signal has not one row a Gaussian.
        RangeError: If a value is NaN, infinite or out of range; it names the argument.

    Example:
        >>> import torch
        >>> one = Gaussians(means=torch.tensor([[0.0, 0, 2]]), rotations=torch.eye(4)[:1],
        ...                 scales=torch.ones(1, 3), opacities=torch.ones(1),
        ...                 sh=torch.zeros(1, 1, 3))
        >>> camera = Camera(width=9, height=9, fx=9, fy=9, cx=4.5, cy=4.5,
        ...                 cam_from_world=torch.eye(4))
        >>> drawn = render(one, camera)
        >>> [round(float(v), 4) for v in (drawn.alpha[4, 4], drawn.depth[4, 4])]
        [0.99, 2.0]
    """
    with prepare(gaussians, camera, options=options, backend=backend) as view:
        return view.render(signal, warp=warp)


@boundary
def back_project(
    gaussians: Gaussians,
    camera: Camera,
    image: Float[Tensor, "height width channels"],
    *,
    options: RenderOptions | None = None,
    backend: str = "auto",
    warp: WarpMode = "bilinear",
) -> BackProjected:
    """Accumulate an image on the Gaussians: ``W.T @ image``, the adjoint of `render`.

    ``<render(f), g> == <f, back_project(g)>`` for every signal f and image g.

    Args:
        gaussians: The Gaussians of the scene.
        camera: Whose pixels the image has, distortion included.
        image: 1 to 1024 channels, float.
        options: As for `render`.
        backend: As for `render`.
        warp: As for `render`.

    Returns:
        Weighted sums (n, channels) and weights (n,), see `BackProjected`.

    Raises:
        ShapeError: If the image has not the camera's size.
        RangeError: If a value is NaN, infinite or out of range.
    """
    with prepare(gaussians, camera, options=options, backend=backend) as view:
        return view.back_project(image, warp=warp)


@boundary
def contributors(
    gaussians: Gaussians,
    camera: Camera,
    pixels: Int[Tensor, "p 2"],
    k: int,
    *,
    options: RenderOptions | None = None,
    backend: str = "auto",
) -> Contributors:
    """The k Gaussians of largest weight in each pixel, the front-most and the median one.

    Args:
        gaussians: The Gaussians of the scene.
        camera: Whose pixels are meant; with distortion, the nearest pinhole pixel is read.
        pixels: Column and row of each pixel.
        k: How many, at least 1; no more than there are Gaussians, or than 256 where these are
            fewer, and pixels x k at most 2^28.
        options: As for `render`.
        backend: As for `render`.

    Raises:
        RangeError: If a pixel lies outside the image, or k is less than 1 or too large.
    """
    with prepare(gaussians, camera, options=options, backend=backend) as view:
        return view.contributors(pixels, k)


@boundary
def weights(
    gaussians: Gaussians,
    camera: Camera,
    pixels: Int[Tensor, "p 2"] | None = None,
    k: int | None = None,
    *,
    options: RenderOptions | None = None,
    backend: str = "auto",
) -> SparseWeights:
    """W of one view as sparse rows, for views that are used again and again.

    With lens distortion a row is that of the pinhole pixel which the photograph's pixel falls
    into, so that a row holds the Gaussians of one ray: its sum is the alpha of
    ``render(..., warp="nearest")``. ``render`` itself reads four pinhole pixels by default
    (``warp="bilinear"``); at the edges of objects its alpha differs from the row's sum by up to
    a third. Use ``warp="nearest"`` in `render` and `back_project` where they must agree with rows
    of W.

    Args:
        gaussians: The Gaussians of the scene.
        camera: Whose pixels are the rows.
        pixels: Column and row of each row; None is the whole image, row by row.
        k: Keep each pixel's k strongest entries; None keeps all.
        options: As for `render`.
        backend: As for `render`.
    """
    with prepare(gaussians, camera, options=options, backend=backend) as view:
        return view.weights(pixels, k)
