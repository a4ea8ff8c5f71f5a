"""Codes that are wanted: that of the sphere, and those between two others."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from splatseg._check import check_shape
from splatseg.core.boundary import boundary
from splatseg.street.shapes.autoencoder import ShapeAutoEncoder
from splatseg.street.shapes.chamfer import chamfer

_SEED = 7
_DRAWN, _KEPT, _STEPS, _RATE = 512, 4, 150, 0.03
_PARALLEL = 1e-6


def sphere_code(shapes: ShapeAutoEncoder) -> Float[Tensor, "mu"]:
    """The code of length 1 whose shape is nearest to the sphere; the same for the same weights.

    Nearest is the least Chamfer distance between vertices and middles of faces of the shape, and
    those of the template. Descent starts from the best of fixed codes, drawn evenly over their
    sphere, and from what the encoder makes of the template.
    """
    device = shapes.vertices.device
    wanted = _points(shapes.vertices[None], shapes)

    def far(codes: Tensor) -> Float[Tensor, "n"]:
        return chamfer(_points(shapes.decode(codes), shapes), wanted.expand(len(codes), -1, -1))

    generator = torch.Generator().manual_seed(_SEED)
    codes = torch.randn(_DRAWN, shapes.code_size, generator=generator).to(device)
    with torch.no_grad():
        if shapes.encoder is not None:
            codes = torch.cat((shapes.encode(wanted), codes))
        codes = functional.normalize(codes[far(codes).argsort(stable=True)[:_KEPT]], dim=1)
    with torch.enable_grad():
        codes.requires_grad_()
        optimiser = torch.optim.Adam([codes], lr=_RATE)
        for step in range(_STEPS):
            for group in optimiser.param_groups:
                group["lr"] = _RATE * (1 - step / _STEPS)
            optimiser.zero_grad()
            far(codes).sum().backward(inputs=[codes])
            optimiser.step()
    with torch.no_grad():
        found = functional.normalize(codes.detach(), dim=1)
        return found[far(found).argmin()].clone()


def _points(vertices: Float[Tensor, "n 42 3"], shapes: ShapeAutoEncoder) -> Tensor:
    """Vertices and middles of faces."""
    return torch.cat((vertices, vertices[:, shapes.faces].mean(dim=2)), dim=1)


@boundary
def interpolate_codes(
    start: Float[Tensor, "n mu"], end: Float[Tensor, "n mu"], shares: Float[Tensor, "t"]
) -> Float[Tensor, "n t mu"]:
    r"""Codes on the shorter arc between others, at constant speed.

    .. math:: \frac{\sin((1 - t) \omega) z_0 + \sin(t \omega) z_1}{\sin \omega},
        \quad \cos \omega = z_0 \cdot z_1

    Opposite codes have no shorter arc: there the middle is the code 0.

    Args:
        start: Codes of any length but 0, at 0.
        end: As many, at 1.
        shares: Where between them.
    """
    check_shape("start", start, (None, None))
    check_shape("end", end, tuple(start.shape))
    one, two = (functional.normalize(codes, dim=1)[:, None] for codes in (start, end))
    # Codes that are alike have no arc, and no gradient of its angle: they are taken a little apart.
    cosine = (one * two).sum(dim=-1, keepdim=True).clamp(-1 + _PARALLEL, 1 - _PARALLEL)
    angle = torch.acos(cosine)
    t = shares.to(start)[None, :, None]
    first, second = torch.sin((1 - t) * angle), torch.sin(t * angle)
    return functional.normalize(first * one + second * two, dim=-1)
