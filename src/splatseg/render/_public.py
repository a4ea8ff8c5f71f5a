"""The public functions of rendering: they check, choose a backend and handle any lens."""

from weakref import WeakKeyDictionary

import torch
from jaxtyping import Float, Int
from torch import Tensor

from splatseg._check import check_choice, check_finite, check_shape
from splatseg.core import Camera, Gaussians
from splatseg.errors import InputError, RangeError
from splatseg.render._backend import BackProjected, Contributors, Layout, Rendered
from splatseg.render._options import RenderOptions
from splatseg.render._registry import get_backend, options_for
from splatseg.render._view_weights import ViewWeights
from splatseg.render.views import (
    back_project_view,
    contributors_view,
    render_view,
    weights_view,
)
from splatseg.render.warp import WarpMode

MAX_CHANNELS = 1024
_checked: "WeakKeyDictionary[Gaussians, tuple[int, ...]]" = WeakKeyDictionary()


def render(
    gaussians: Gaussians,
    camera: Camera,
    signal: Float[Tensor, "n channels"] | None = None,
    *,
    options: RenderOptions | None = None,
    backend: str = "auto",
    warp: WarpMode = "bilinear",
) -> Rendered:
    r"""Draw any per-Gaussian signal as a view shows it: ``W @ signal``.

    .. math:: I(p) = \sum_i f_i \, \alpha_i(p) \prod_{j < i} (1 - \alpha_j(p))

    with :math:`\alpha_i(p) = \min(0.99, o_i e^{-q_i(p) / 2})` and q the squared Mahalanobis
    distance to the projected Gaussian (Kerbl et al. 2023, eq. 3 and appendix C). Constants are
    in `render._constants`, conventions in ``docs/conventions.md``.

    Differentiable in torch towards the signal, and towards means, rotations, scales, opacities,
    harmonics and ``camera.cam_from_world`` where they require a gradient.

    Args:
        gaussians: What to draw.
        camera: Where from; with distortion, the image is in the photograph's distorted pixels.
        signal: One row a Gaussian, 1 to 1024 channels; None is the colour of the harmonics.
        options: Switches of the blending model; None is what the Gaussians are
            meant for, with the constants of the backend (`options_for`).
        backend: ``auto``, ``cpu``, ``cuda`` or ``reference``.
        warp: How distorted pixels read the straightened image: ``bilinear`` from the four
            pixels around, or ``nearest``, for ids and wherever the result is to agree with
            `weights` and `contributors`. Without distortion the two are the same.

    Returns:
        Image, alpha, expected and median depth, see `Rendered`.

    Raises:
        ShapeError: If the signal has not one row a Gaussian.
        RangeError: If a value is NaN, infinite or out of range; it names the argument.

    Example:
        >>> one = Gaussians(means=torch.tensor([[0.0, 0, 2]]), rotations=torch.eye(4)[:1],
        ...                 scales=torch.ones(1, 3), opacities=torch.ones(1),
        ...                 sh=torch.zeros(1, 1, 3))
        >>> camera = Camera(width=9, height=9, fx=9, fy=9, cx=4.5, cy=4.5,
        ...                 cam_from_world=torch.eye(4))
        >>> drawn = render(one, camera)
        >>> [round(float(v), 4) for v in (drawn.alpha[4, 4], drawn.depth[4, 4])]
        [0.99, 2.0]
    """
    _check_scene(gaussians)
    if signal is not None:
        _check_columns("signal", signal, (len(gaussians), None))
    chosen = get_backend(backend, like=gaussians.means)
    options = options or options_for(gaussians, backend)
    return render_view(gaussians, camera, signal, options=options, backend=chosen, warp=warp)


def back_project(
    gaussians: Gaussians,
    camera: Camera,
    image: Float[Tensor, "height width channels"],
    *,
    options: RenderOptions | None = None,
    backend: str = "auto",
    warp: WarpMode = "bilinear",
) -> BackProjected:
    """Collect an image on the Gaussians: ``W.T @ image``, the adjoint of `render`.

    ``<render(f), g> == <f, back_project(g)>`` for every signal f and image g.

    Args:
        gaussians: What the view shows.
        camera: Whose pixels the image has, distortion included.
        image: 1 to 1024 channels, float.
        options: Switches of the blending model; None is what the Gaussians are
            meant for, with the constants of the backend (`options_for`).
        backend: ``auto``, ``cpu``, ``cuda`` or ``reference``.
        warp: As for `render`.

    Returns:
        Weighted sums (n, channels) and weights (n,), see `BackProjected`.

    Raises:
        ShapeError: If the image has not the camera's size.
        RangeError: If a value is NaN, infinite or out of range.
    """
    _check_scene(gaussians)
    _check_columns("image", image, (camera.height, camera.width, None))
    chosen = get_backend(backend, like=gaussians.means)
    options = options or options_for(gaussians, backend)
    return back_project_view(gaussians, camera, image, options=options, backend=chosen, warp=warp)


def contributors(
    gaussians: Gaussians,
    camera: Camera,
    pixels: Int[Tensor, "p 2"],
    k: int,
    *,
    options: RenderOptions | None = None,
    backend: str = "auto",
) -> Contributors:
    """The k Gaussians that make most of each pixel, the front-most and the median one.

    Args:
        gaussians: What the view shows.
        camera: Whose pixels are meant; with distortion, the nearest straightened pixel is read.
        pixels: Column and row of each pixel.
        k: How many, at least 1.
        options: Switches of the blending model; None is what the Gaussians are
            meant for, with the constants of the backend (`options_for`).
        backend: ``auto``, ``cpu``, ``cuda`` or ``reference``.

    Raises:
        RangeError: If a pixel lies outside the image or k is less than 1.
    """
    _check_scene(gaussians)
    _check_pixels(pixels, camera)
    if k < 1:
        raise RangeError(f"k: expected at least 1, got {k}.")
    chosen = get_backend(backend, like=gaussians.means)
    options = options or options_for(gaussians, backend)
    return contributors_view(gaussians, camera, pixels, k, options=options, backend=chosen)


def weights(
    gaussians: Gaussians,
    camera: Camera,
    pixels: Int[Tensor, "p 2"] | None = None,
    k: int | None = None,
    *,
    layout: Layout = "csr",
    options: RenderOptions | None = None,
    backend: str = "auto",
) -> ViewWeights:
    """W of one view as a matrix, for views that are used again and again.

    With lens distortion a row is that of the pinhole pixel which the photograph's pixel falls
    into, so that a row holds the Gaussians of one ray: its sum is the alpha of
    ``render(..., warp="nearest")``. ``render`` itself reads four pinhole pixels by default
    (``warp="bilinear"``); at the edges of things its alpha differs from the row's sum by up to
    a third. Take ``warp="nearest"`` in `render` and `back_project` where they are to agree with
    rows of W.

    Args:
        gaussians: What the view shows.
        camera: Whose pixels are the rows.
        pixels: Column and row of each row; None is the whole image, row by row.
        k: Keep each pixel's k strongest entries; None keeps all.
        layout: ``csr`` has rows of single pixels; ``blocks`` has 4 x 4 pixel blocks and is
            faster, for whole images and all entries of pinhole cameras.
        options: Switches of the blending model; None is what the Gaussians are
            meant for, with the constants of the backend (`options_for`).
        backend: ``auto``, ``cpu``, ``cuda`` or ``reference``.

    Raises:
        InputError: If ``blocks`` is asked for with pixels, with k or with a distorted camera.
    """
    _check_scene(gaussians)
    check_choice("layout", layout, ("csr", "blocks"))
    if pixels is not None:
        _check_pixels(pixels, camera)
    if k is not None and k < 1:
        raise RangeError(f"k: expected at least 1, got {k}.")
    if layout == "blocks" and (pixels is not None or k is not None or not camera.is_pinhole):
        raise InputError(
            "layout: blocks hold the whole image of a pinhole camera, with all entries; "
            "use csr for pixels, k or a distorted camera."
        )
    chosen = get_backend(backend, like=gaussians.means)
    options = options or options_for(gaussians, backend)
    return weights_view(
        gaussians, camera, pixels, k, layout=layout, options=options, backend=chosen
    )


def _check_scene(gaussians: Gaussians) -> None:
    """Scan the values once; again only after somebody wrote into the tensors."""
    columns = (
        gaussians.means,
        gaussians.rotations,
        gaussians.scales,
        gaussians.opacities,
        gaussians.sh,
    )
    versions = tuple(-1 if t.is_inference() else t._version for t in columns)  # pyright: ignore[reportPrivateUsage]
    if -1 in versions or _checked.get(gaussians) != versions:
        gaussians.check_values()
        _checked[gaussians] = versions


def _check_columns(name: str, tensor: Tensor, shape: tuple[int | None, ...]) -> None:
    check_shape(name, tensor, shape)
    if not 1 <= tensor.shape[-1] <= MAX_CHANNELS:
        raise RangeError(f"{name}: expected 1 to {MAX_CHANNELS} channels, got {tensor.shape[-1]}.")
    if not tensor.is_floating_point():
        raise InputError(f"{name}: expected floating-point values, got {tensor.dtype}.")
    check_finite(name, tensor)


def _check_pixels(pixels: Tensor, camera: Camera) -> None:
    check_shape("pixels", pixels, (None, 2))
    if pixels.is_floating_point() or pixels.dtype == torch.bool:
        raise InputError(f"pixels: expected integers (column, row), got {pixels.dtype}.")
    size = torch.tensor([camera.width, camera.height], device=pixels.device)
    outside = ((pixels < 0) | (pixels >= size)).any(dim=1)
    if bool(outside.any()):
        first = pixels[outside][0].tolist()
        raise RangeError(
            f"pixels: expected columns in [0, {camera.width}) and rows in "
            f"[0, {camera.height}), got {first}."
        )
