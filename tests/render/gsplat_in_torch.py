"""gsplat's public functions on the CPU: its own torch code, and the parts it has in CUDA only.

gsplat 1.5.3 ships a PyTorch version of its projection and tile lists for its own tests. What it
does not ship, listing what contributes to each pixel and adding it up, stands here in torch,
after the comments of its documentation; `blend` is independent of splatseg.
"""

from types import SimpleNamespace

import torch
from gsplat.cuda import _torch_impl
from torch import Tensor

CAP, SKIP, STOP = 0.999, 1 / 255, 1e-4


def fully_fused_projection(
    means,
    covars,
    quats,
    scales,
    viewmats,
    Ks,
    width,
    height,
    *,
    eps2d,
    near_plane,
    far_plane,
    calc_compensations,
    opacities,
):
    """gsplat's projection; with `opacities` it also culls those under 1/255, as CUDA does."""
    covars, _ = _torch_impl._quat_scale_to_covar_preci(quats, scales, compute_preci=False)
    radii, centres, depths, conics, compensations = _torch_impl._fully_fused_projection(
        means,
        covars,
        viewmats,
        Ks,
        width,
        height,
        eps2d=eps2d,
        near_plane=near_plane,
        far_plane=far_plane,
        calc_compensations=calc_compensations,
    )
    visible = opacities if compensations is None else opacities * compensations[0]
    radii = radii * (visible >= SKIP)[None, :, None]
    return radii, centres, depths, conics, compensations


def isect_tiles(centres, radii, depths, tile_size, across, down, *, packed):
    """Tile lists by gsplat's own loop."""
    assert not packed
    return _torch_impl._isect_tiles(centres, radii, depths, tile_size, across, down)


def isect_offset_encode(keys, images, across, down):
    """Where each tile's list begins."""
    return _torch_impl._isect_offset_encode(keys, images, across, down)


def _alphas(centres: Tensor, conics: Tensor, opacities: Tensor, points: Tensor) -> Tensor:
    """Alphas of all Gaussians (columns) at all points (rows)."""
    offset = points[:, None] - centres
    sigma = (
        0.5 * (conics[:, 0] * offset[..., 0] ** 2 + conics[:, 2] * offset[..., 1] ** 2)
        + conics[:, 1] * offset[..., 0] * offset[..., 1]
    )
    return (opacities * torch.exp(-sigma)).clamp_max(CAP) * (sigma >= 0)


def blend(centres: Tensor, conics: Tensor, opacities: Tensor, points: Tensor) -> Tensor:
    """Weights (points x Gaussians) of Gaussians that are sorted front to back."""
    alphas = _alphas(centres, conics, opacities, points)
    alphas = alphas * (alphas >= SKIP)
    left = torch.cumprod(1 - alphas, dim=1)
    before = torch.cat((torch.ones_like(left[:, :1]), left[:, :-1]), dim=1)
    return alphas * before * (left > STOP)


def _tiles(width, height, tile_size, starts, ids):
    """(pixel numbers, their centres, Gaussians front to back) of each tile with any."""
    flat = torch.cat((starts.flatten(), torch.tensor([len(ids)])))
    across = starts.shape[-1]
    for tile in torch.nonzero(flat.diff())[:, 0].tolist():
        top, left = tile // across * tile_size, tile % across * tile_size
        rows = torch.arange(top, min(top + tile_size, height))
        columns = torch.arange(left, min(left + tile_size, width))
        v, u = torch.meshgrid(rows, columns, indexing="ij")
        points = torch.stack((u, v), -1).reshape(-1, 2) + 0.5
        members = ids[flat[tile] : flat[tile + 1]].long()
        yield (v * width + u).flatten(), points, members


def rasterize_to_pixels(centres, conics, colours, opacities, width, height, tile_size, starts, ids):
    """Add up what contributes to each pixel; at most 513 channels, as gsplat."""
    assert 1 <= colours.shape[-1] <= 513
    image = torch.zeros(height * width, colours.shape[-1])
    alpha = torch.zeros(height * width)
    for pixels, points, members in _tiles(width, height, tile_size, starts, ids):
        weights = blend(centres[0, members], conics[0, members], opacities[0, members], points)
        image = image.index_add(0, pixels, weights @ colours[0, members])
        alpha = alpha.index_add(0, pixels, weights.sum(dim=1))
    size = (1, height, width)
    return image.reshape(*size, -1), alpha.reshape(*size, 1)


def rasterize_to_indices_in_range(
    first, last, transmittances, centres, conics, opacities, width, height, tile_size, starts, ids
):
    """(Gaussian, pixel, image) of all that contributes, by pixel, front to back."""
    assert first == 0
    assert last > len(ids)
    assert bool((transmittances == 1).all())
    found_ids, found_pixels = [ids[:0].long()], [ids[:0].long()]
    for pixels, points, members in _tiles(width, height, tile_size, starts, ids):
        weights = blend(centres[0, members], conics[0, members], opacities[0, members], points)
        row, column = torch.nonzero(weights, as_tuple=True)
        found_ids.append(members[column])
        found_pixels.append(pixels[row])
    pixel = torch.cat(found_pixels)
    order = torch.argsort(pixel, stable=True)
    return torch.cat(found_ids)[order], pixel[order], torch.zeros_like(pixel)


LIBRARY = SimpleNamespace(
    fully_fused_projection=fully_fused_projection,
    isect_tiles=isect_tiles,
    isect_offset_encode=isect_offset_encode,
    rasterize_to_pixels=rasterize_to_pixels,
    rasterize_to_indices_in_range=rasterize_to_indices_in_range,
)
"""Stands for the module `gsplat`."""
