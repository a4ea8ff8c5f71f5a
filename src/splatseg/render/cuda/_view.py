"""One view on the GPU: gsplat's projection and tile lists, and products over them."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import torch
from torch import Tensor

from splatseg.core import Camera, Gaussians
from splatseg.core.sh import evaluate_sh
from splatseg.render._constants import ALPHA_MIN, MEDIAN_TRANSMITTANCE
from splatseg.render._options import RenderOptions
from splatseg.render.reference._composite import Entries

GSPLAT_ALPHA_MAX = 0.999
"""gsplat's opacity cap, a literal in its kernels."""

TILE = 16
"""Side of gsplat's tiles, pixels."""

CHANNELS = 32
"""Channels of one kernel launch; gsplat gets slow above (its own default chunk)."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CudaView:
    """A projected scene. All tensors are float32, on the GPU, with one row a Gaussian."""

    gsplat: ModuleType | Any
    width: int
    height: int
    visible: Tensor
    """Rows that reach the image; the others' columns below hold no meaning."""
    centres: Tensor
    conics: Tensor
    depths: Tensor
    opacities: Tensor
    tile_starts: Tensor
    tile_ids: Tensor

    @staticmethod
    def of(
        gaussians: Gaussians,
        camera: Camera,
        *,
        options: RenderOptions,
        gsplat: ModuleType | Any,
    ) -> "CudaView":
        """Project, cull and sort; gradients flow to the Gaussians and the pose."""
        device = gaussians.device
        across, down = -(-camera.width // TILE), -(-camera.height // TILE)
        if len(gaussians) == 0:
            # gsplat divides by the number of Gaussians.
            return CudaView._empty(camera, gsplat=gsplat, device=device)
        pose = camera.cam_from_world.to(device=device, dtype=torch.float32)
        # gsplat keeps z >= near where we keep z > near.
        near = float(torch.nextafter(torch.tensor(options.near), torch.tensor(math.inf)))
        radii, centres, depths, conics, compensations = gsplat.fully_fused_projection(
            gaussians.means,
            None,
            gaussians.rotations,
            gaussians.scales,
            pose[None],
            camera.K.to(device=device, dtype=torch.float32)[None],
            camera.width,
            camera.height,
            eps2d=options.low_pass,
            near_plane=near,
            far_plane=math.inf,
            calc_compensations=options.antialiased,
            opacities=gaussians.opacities,
        )
        opacities = gaussians.opacities[None]
        visible = (radii[0] > 0).all(dim=-1)
        if options.antialiased:
            opacities = opacities * torch.where(visible, compensations, 0.0)
        _, keys, tile_ids = gsplat.isect_tiles(
            centres, radii, depths, TILE, across, down, packed=False
        )
        return CudaView(
            gsplat=gsplat,
            width=camera.width,
            height=camera.height,
            visible=torch.nonzero(visible)[:, 0],
            centres=centres,
            conics=conics,
            depths=depths,
            opacities=opacities,
            tile_starts=gsplat.isect_offset_encode(keys, 1, across, down).reshape(1, down, across),
            tile_ids=tile_ids,
        )

    @staticmethod
    def _empty(camera: Camera, *, gsplat: ModuleType | Any, device: torch.device) -> "CudaView":
        """The view of no Gaussians."""
        across, down = -(-camera.width // TILE), -(-camera.height // TILE)
        none = torch.zeros(1, 0, device=device)
        return CudaView(
            gsplat=gsplat,
            width=camera.width,
            height=camera.height,
            visible=torch.zeros(0, dtype=torch.int64, device=device),
            centres=torch.zeros(1, 0, 2, device=device),
            conics=torch.zeros(1, 0, 3, device=device),
            depths=none,
            opacities=none,
            tile_starts=torch.zeros(1, down, across, dtype=torch.int32, device=device),
            tile_ids=torch.zeros(0, dtype=torch.int32, device=device),
        )

    def detached(self) -> "CudaView":
        """The same view with its geometry frozen."""
        return CudaView(
            gsplat=self.gsplat,
            width=self.width,
            height=self.height,
            visible=self.visible,
            centres=self.centres.detach(),
            conics=self.conics.detach(),
            depths=self.depths.detach(),
            opacities=self.opacities.detach(),
            tile_starts=self.tile_starts,
            tile_ids=self.tile_ids,
        )

    def product(self, signal: Tensor) -> tuple[Tensor, Tensor]:
        """``W @ signal`` (height, width, channels) and ``W @ 1`` (height, width)."""
        if len(self.visible) == 0:
            # Connected to the signal, so that gradients are 0, not missing.
            nothing = 0 * signal.sum(dim=0).expand(self.height, self.width, -1)
            return nothing, signal.new_zeros(self.height, self.width)
        images: list[Tensor] = []
        alpha = signal.new_zeros(self.height, self.width)
        for part in signal.split(CHANNELS, dim=1):
            image, total = self.gsplat.rasterize_to_pixels(
                self.centres,
                self.conics,
                part[None].contiguous(),
                self.opacities,
                self.width,
                self.height,
                TILE,
                self.tile_starts,
                self.tile_ids,
            )
            images.append(image[0])
            alpha = total[0, ..., 0]
        return torch.cat(images, dim=-1), alpha

    def adjoint(self, image: Tensor) -> Tensor:
        """``W.T @ image``: the gradient of <W f, image> with respect to f."""
        frozen = self.detached()
        columns: list[Tensor] = []
        for part in image.split(CHANNELS, dim=2):
            with torch.enable_grad():
                signal = image.new_zeros(self.centres.shape[1], part.shape[2], requires_grad=True)
                drawn, _ = frozen.product(signal)
            (column,) = torch.autograd.grad(drawn, signal, part.contiguous())
            columns.append(column)
        return torch.cat(columns, dim=1)

    def for_visible(self, of_rows: Callable[[Tensor], Tensor]) -> Tensor:
        """A column computed for the rows that are visible, 0 for the others.

        The others are left out of the formula, so that they give no NaN gradients.
        """
        values = of_rows(self.visible)
        full = values.new_zeros(self.centres.shape[1], *values.shape[1:])
        return full.index_copy(0, self.visible, values)

    @torch.no_grad()
    def entries(self) -> Entries:
        """All non-zero entries of W, pixel by pixel, front to back."""
        if len(self.visible) == 0:
            none = torch.zeros(0, dtype=torch.int64, device=self.centres.device)
            return Entries(pixels=none, ids=none, weights=none.double(), median=none.bool())
        ids, pixels, _ = self.gsplat.rasterize_to_indices_in_range(
            0,
            2**30,
            torch.ones(1, self.height, self.width, device=self.centres.device),
            self.centres,
            self.conics,
            self.opacities,
            self.width,
            self.height,
            TILE,
            self.tile_starts,
            self.tile_ids,
        )
        du = pixels % self.width + 0.5 - self.centres[0, ids, 0]
        dv = pixels // self.width + 0.5 - self.centres[0, ids, 1]
        a, b, c = self.conics[0, ids].unbind(-1)
        q = a * du**2 + 2 * b * du * dv + c * dv**2
        alpha = self.opacities[0, ids] * torch.exp(-q / 2)
        # The kernel listed them, so they are blended, whichever way exp rounds here.
        alpha = alpha.clamp(ALPHA_MIN, GSPLAT_ALPHA_MAX).double()
        # Transmittance before each entry: a running sum of logarithms, less the sum that the
        # pixels before it have gathered. Float64 keeps that difference exact enough.
        gathered = torch.cumsum(torch.log1p(-alpha), dim=0)
        start = torch.searchsorted(pixels, pixels)
        before_pixel = torch.cat((gathered.new_zeros(1), gathered))[start]
        behind = torch.exp(gathered - before_pixel)
        before = behind / (1 - alpha)
        return Entries(
            pixels=pixels,
            ids=ids,
            weights=alpha * before,
            median=(before > MEDIAN_TRANSMITTANCE) & (behind <= MEDIAN_TRANSMITTANCE),
        )


def colours(view: CudaView, gaussians: Gaussians, camera: Camera, degree: int | None) -> Tensor:
    """Colours of the harmonics along the rays to the Gaussians that are visible."""
    centre = camera.centre.to(device=gaussians.device, dtype=torch.float32)

    def of_rows(rows: Tensor) -> Tensor:
        rays = gaussians.means[rows] - centre
        directions = rays / torch.linalg.vector_norm(rays, dim=1, keepdim=True)
        return evaluate_sh(gaussians.sh[rows], directions, degree=degree)

    return view.for_visible(of_rows)
