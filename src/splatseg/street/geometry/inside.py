r"""Which primitives enclose a point: by the solid angle that their faces fill around it.

Of a triangle with corners a, b, c as seen from the point,

.. math:: \tan(\Omega / 2) = \frac{a \cdot (b \times c)}
    {|a||b||c| + (a \cdot b)|c| + (b \cdot c)|a| + (c \cdot a)|b|}

and the sum over a watertight mesh is :math:`4 \pi` inside and 0 outside.

References:
    Van Oosterom and Strackee, The Solid Angle of a Plane Triangle (1983).
"""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatseg.core.boundary import boundary
from splatseg.street.mesh import PrimitiveMesh
from splatseg.street.shapes.template import VERTICES, template


@boundary
def enclosing(mesh: PrimitiveMesh, points: Float[Tensor, "p 3"]) -> Bool[Tensor, "m"]:
    """Which primitives of a mesh have one of the points inside.

    Args:
        mesh: The primitives.
        points: Such as the centres of cameras, world.
    """
    _, faces = template()
    shapes = mesh.vertices.view(-1, VERTICES, 3).double()
    low, high = shapes.amin(dim=1), shapes.amax(dim=1)
    found = torch.zeros(len(mesh), dtype=torch.bool)
    for point in points.detach().cpu().double():
        near = ((low <= point) & (point <= high)).all(dim=1).nonzero()[:, 0]
        a, b, c = (shapes[near][:, faces] - point).unbind(dim=2)
        la, lb, lc = (torch.linalg.vector_norm(side, dim=-1) for side in (a, b, c))
        volume = (a * torch.linalg.cross(b, c)).sum(-1)
        below = la * lb * lc + (a * b).sum(-1) * lc + (b * c).sum(-1) * la + (c * a).sum(-1) * lb
        angle = 2 * torch.atan2(volume, below).sum(dim=1)
        found[near[angle > 2 * math.pi]] = True
    return found
