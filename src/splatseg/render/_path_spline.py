"""Uniform cubic B-splines over poses, see `render.paths`."""

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg.render._path_poses import Poses, angles_between

_SAMPLES_PER_SPAN = 32


def poses_along_spline(keys: Poses, *, frames: int, closed: bool, unit: float) -> Poses:
    """Frames at equal steps of pose space along the B-spline over the keys."""
    if len(keys) == 1:
        return keys[torch.zeros(frames, dtype=torch.int64)]
    controls = _controls(keys, closed=closed)
    spans = len(controls) - 3
    dense = _spline(
        controls, torch.linspace(0, spans, spans * _SAMPLES_PER_SPAN + 1, dtype=torch.float64)
    )
    distances = (dense.centres[1:] - dense.centres[:-1]).norm(dim=1)
    angles = unit * angles_between(dense.quaternions[1:], dense.quaternions[:-1])
    length = torch.cat(
        (distances.new_zeros(1), (distances.square() + angles.square()).sqrt().cumsum(dim=0))
    )
    # The last frame of a closed film is one step before its first.
    share = torch.arange(frames, dtype=torch.float64) / max(1, frames if closed else frames - 1)
    targets = share * length[-1]
    high = torch.searchsorted(length, targets).clamp(1, len(length) - 1)
    low = high - 1
    fractions = (targets - length[low]) / (length[high] - length[low]).clamp_min(1e-15)
    return _spline(controls, (low + fractions) / _SAMPLES_PER_SPAN)


def _controls(keys: Poses, *, closed: bool) -> Poses:
    """Control points: keys with the neighbours that the ends need, in consistent signs.

    An open spline has its end keys mirrored outwards, so that it begins and ends at them.
    """
    count = len(keys)
    if closed:
        padded = keys[torch.tensor([count - 1, *range(count), 0, 1])]
        centres, quaternions = padded.centres, padded.quaternions
    else:
        quaternions = _with_consistent_signs(keys.quaternions)
        centres, quaternions = (
            torch.cat((2 * x[:1] - x[1:2], x, 2 * x[-1:] - x[-2:-1]))
            for x in (keys.centres, quaternions)
        )
    return Poses(centres=centres, quaternions=_with_consistent_signs(quaternions))


def _with_consistent_signs(quaternions: Float[Tensor, "n 4"]) -> Float[Tensor, "n 4"]:
    """The same orientations with signs such that neighbouring quaternions agree."""
    flips = (quaternions[1:] * quaternions[:-1]).sum(dim=1) < 0
    signs = torch.where(flips, -1.0, 1.0).double().cumprod(dim=0)
    return torch.cat((quaternions[:1], quaternions[1:] * signs[:, None]))


def _spline(controls: Poses, parameters: Float[Tensor, "m"]) -> Poses:
    """The B-spline at parameters from 0 to the number of controls less 3."""
    first = parameters.floor().long().clamp(0, len(controls) - 4)
    t = (parameters - first)[:, None]
    basis = (
        (1 - t) ** 3 / 6,
        (3 * t**3 - 6 * t**2 + 4) / 6,
        (-3 * t**3 + 3 * t**2 + 3 * t + 1) / 6,
        t**3 / 6,
    )
    centres = sum(b * controls.centres[first + j] for j, b in enumerate(basis))
    blend = sum(b * controls.quaternions[first + j] for j, b in enumerate(basis))
    quaternions = torch.as_tensor(blend)
    return Poses(
        centres=torch.as_tensor(centres),
        quaternions=quaternions / quaternions.norm(dim=1, keepdim=True).clamp_min(1e-12),
    )
