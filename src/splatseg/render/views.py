r"""Views in the photograph's own pixels: a backend's pinhole images behind the lens's warp.

For a camera with distortion the view is the product of two sparse matrices, :math:`R W` (see
`render.warp`); for a pinhole camera R is the identity and nothing is resampled.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from splatseg._check import check_shape
from splatseg.core import Camera, Gaussians
from splatseg.errors import InputError
from splatseg.render._backend import (
    Backend,
    BackProjected,
    Contributors,
    Layout,
    Rendered,
)
from splatseg.render._options import RenderOptions
from splatseg.render._view_weights import ViewWeights
from splatseg.render.warp import WarpMode, straightened, warp_into_photograph


def render_view(
    gaussians: Gaussians,
    camera: Camera,
    signal: Float[Tensor, "n channels"] | None = None,
    *,
    options: RenderOptions,
    backend: Backend,
    warp: WarpMode = "bilinear",
) -> Rendered:
    r"""Draw a view in the pixels of any camera: :math:`R W \, \text{signal}`.

    Image and alpha are linear in W and are warped as such. The expected depth stays
    :math:`\sum w z / \sum w` over the warped weights; the median depth is the nearest pinhole
    pixel's, because medians do not add up.

    Args:
        gaussians: The Gaussians; values were checked by the caller.
        camera: Any camera.
        signal: What to draw, or None for the colour of the harmonics.
        options: Switches of the blending model.
        backend: Who draws the pinhole image.
        warp: How the pinhole image is read: ``nearest`` for label signals.
    """
    drawn = backend.render(gaussians, straightened(camera), signal, options=options)
    if camera.is_pinhole:
        return drawn
    lens = warp_into_photograph(camera, warp)
    moments = lens.apply(torch.stack((drawn.alpha, drawn.alpha * drawn.depth), dim=-1))
    alpha, weighted_depth = moments.unbind(-1)
    covered = alpha > 0
    depth = torch.where(covered, weighted_depth / torch.where(covered, alpha, 1.0), 0.0)
    nearest = warp_into_photograph(camera, "nearest")
    return Rendered(
        image=lens.apply(drawn.image),
        alpha=alpha,
        depth=depth,
        median_depth=nearest.apply(drawn.median_depth.unsqueeze(-1)).squeeze(-1),
    )


def back_project_view(
    gaussians: Gaussians,
    camera: Camera,
    image: Float[Tensor, "height width channels"],
    *,
    options: RenderOptions,
    backend: Backend,
    warp: WarpMode = "bilinear",
) -> BackProjected:
    r"""Collect an image in any camera's pixels on the Gaussians: :math:`W^\top R^\top g`.

    Exactly the adjoint of `render_view`: ``<render_view(f), g> == <f, back_project_view(g)>``.
    The weights are those of the photograph's pixels, :math:`W^\top R^\top 1`.

    Raises:
        ShapeError: If `image` does not have the camera's size.
    """
    check_shape("image", image, (camera.height, camera.width, None))
    if camera.is_pinhole:
        return backend.back_project(gaussians, straightened(camera), image, options=options)
    lens = warp_into_photograph(camera, warp)
    # The backend's own weights count pinhole pixels; a channel of ones counts the photograph's.
    with_ones = torch.cat((image, torch.ones_like(image[..., :1])), dim=-1)
    sums = backend.back_project(
        gaussians, straightened(camera), lens.adjoint(with_ones), options=options
    ).sums
    return BackProjected(sums=sums[:, :-1], weights=sums[:, -1])


def contributors_view(
    gaussians: Gaussians,
    camera: Camera,
    pixels: Int[Tensor, "p 2"],
    k: int,
    *,
    options: RenderOptions,
    backend: Backend,
) -> Contributors:
    """The k strongest Gaussians of pixels (column, row) of any camera.

    With distortion they are those of the pinhole pixel that each pixel's centre falls into.
    """
    return backend.contributors(
        gaussians, straightened(camera), _in_pinhole(camera, pixels), k, options=options
    )


def weights_view(
    gaussians: Gaussians,
    camera: Camera,
    pixels: Int[Tensor, "p 2"] | None = None,
    k: int | None = None,
    *,
    layout: Layout,
    options: RenderOptions,
    backend: Backend,
) -> ViewWeights:
    """W of any camera's pixels; with distortion by the nearest warp, rows as for contributors.

    Raises:
        InputError: If blocks are asked for of a camera with distortion: a block of the
            photograph is no block of the pinhole image.
    """
    if not camera.is_pinhole:
        if layout == "blocks":
            raise InputError(
                "layout: blocks need a pinhole camera, got one with lens distortion; "
                "use csr or camera.undistorted()."
            )
        if pixels is None:
            pixels = camera.pixel_centres().reshape(-1, 2).floor().long()
        pixels = _in_pinhole(camera, pixels)
    return backend.weights(
        gaussians, straightened(camera), pixels, k, layout=layout, options=options
    )


def _in_pinhole(camera: Camera, pixels: Tensor) -> Tensor:
    if camera.is_pinhole:
        return pixels
    return warp_into_photograph(camera, "nearest").nearest_sources(pixels)[0]
