"""The Gaussians of a scene: aligned arrays, one row a Gaussian; and scales and opacities of files.

Files have logs and logits. Torch computes a sigmoid in vector registers where it can and one by
one at the end of a thread's share; the two round differently, so that one file read by two threads
and by three gave other opacities in the last bit. `exponential` and `sigmoid` compute in float64
and round once: the result depends on the value alone.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from dataclasses import replace as _replace
from types import MappingProxyType
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from splatseg._check import check_finite, check_values
from splatseg.core.boundary import boundary, convert_fields
from splatseg.core.chunks import Chunks
from splatseg.core.coerce import as_rows
from splatseg.core.rigid import Similarity, quaternion_from_rotation, quaternion_multiply
from splatseg.core.sh import SH_C0, degree_of, rotate_sh
from splatseg.core.upward import Previewed
from splatseg.errors import InputError, RangeError, ShapeError

_COLOURS = 1 << 20
"""Gaussians on the disk whose colours are read at once."""

_BLOCK = 1 << 15
"""Values converted at once: the float64 copies stay in the processor's cache."""


def exponential(values: Float[np.ndarray, "*shape"]) -> NDArray[np.float32]:
    """``exp(values)`` as float32: scales from their logs.

    Minus infinity gives 0, NaN stays, and what float32 cannot hold becomes infinite.

    Example:
        >>> exponential(np.array([0.0, -np.inf], np.float32)).tolist()
        [1.0, 0.0]
    """
    flat = np.ascontiguousarray(values).reshape(-1)
    found = np.empty(flat.shape, np.float32)
    with np.errstate(over="ignore", under="ignore"):
        for start in range(0, len(flat), _BLOCK):
            part = slice(start, start + _BLOCK)
            found[part] = np.exp(flat[part].astype(np.float64))
    return found.reshape(values.shape)


def sigmoid(values: Float[np.ndarray, "*shape"]) -> NDArray[np.float32]:
    """``1 / (1 + exp(-values))`` as float32: opacities from their logits.

    Minus infinity gives 0, plus infinity 1, and NaN stays.

    Example:
        >>> sigmoid(np.array([0.0, np.inf], np.float32)).tolist()
        [0.5, 1.0]
    """
    flat = np.ascontiguousarray(values).reshape(-1)
    found = np.empty(flat.shape, np.float32)
    with np.errstate(over="ignore", under="ignore"):
        for start in range(0, len(flat), _BLOCK):
            part = slice(start, start + _BLOCK)
            found[part] = 1 / (1 + np.exp(-flat[part].astype(np.float64)))
    return found.reshape(values.shape)


_ARRAYS = ("means", "rotations", "scales", "opacities", "sh")

LOW_PASS = 0.3
"""Variance of 3DGS's low-pass, square pixels."""


@dataclass(frozen=True, slots=True, weakref_slot=True, kw_only=True, eq=False)
class Gaussians(Previewed):
    """3D Gaussians with colour, and any further columns, sliced and saved together.

    The covariance of Gaussian i is R diag(s)^2 R^T with R the rotation of its quaternion and s
    its scales (Kerbl et al. 2023, eq. 6). Values are physical: linear scales and opacities,
    not the logs and logits of files.

    Shapes are checked when one is made; values are checked by `check_values`, which readers
    and renderers call, because a scan of millions of rows on every slice is not free.

    Example:
        >>> g = Gaussians(means=torch.zeros(2, 3), rotations=torch.eye(4)[:1].expand(2, 4),
        ...               scales=torch.ones(2, 3), opacities=torch.ones(2),
        ...               sh=torch.zeros(2, 1, 3), extra={"class_id": torch.tensor([4, 7])})
        >>> g[1:].extra["class_id"]
        tensor([7])
    """

    means: Float[Tensor, "n 3"]
    """Centres in the world, scene units."""

    rotations: Float[Tensor, "n 4"]
    """Unit quaternions (w, x, y, z), world_from_gaussian."""

    scales: Float[Tensor, "n 3"]
    """Standard deviations along the Gaussian's own axes, scene units, not negative."""

    opacities: Float[Tensor, "n"]
    """Opacity at the centre, in [0, 1]."""

    sh: Float[Tensor, "n coefficients 3"]
    """Spherical harmonics of the colour, 1, 4, 9 or 16 a channel, see `core.sh`."""

    extra: Mapping[str, Tensor] = field(default_factory=dict[str, Tensor])
    """Further columns by name, (n,) or (n, c): they survive slicing, joining and saving."""

    antialiased: bool = False
    """Whether the opacities are meant for antialiased rendering (`RenderOptions.antialiased`):
    Gaussians fitted with one setting render wrongly with the other. It is written to files of
    formats that can hold it."""

    low_pass: float = LOW_PASS
    """Variance of the filter that they are drawn with, square pixels
    (`RenderOptions.low_pass`). Other than 3DGS's, it goes with them into PLY files."""

    chunks: Chunks | None = field(default=None, init=False, repr=False)
    """Where they are on the disk: the arrays are maps of files then, and a view reads what it
    needs. None for Gaussians in memory, and for all that is made of others: whoever changes a
    column or takes rows has Gaussians of his own."""

    def __post_init__(self) -> None:
        convert_fields(self)
        n = len(self.means)
        degree_of(self.sh.shape[1])
        for name, column in self.extra.items():
            if column.ndim not in (1, 2) or column.shape[0] != n:
                raise ShapeError(
                    f"extra[{name!r}]: expected ({n},) or ({n}, c), got {tuple(column.shape)}."
                )
        object.__setattr__(self, "extra", MappingProxyType(dict(self.extra)))

    def __len__(self) -> int:
        return self.means.shape[0]

    def __repr__(self) -> str:
        extra = f", extra={sorted(self.extra)}" if self.extra else ""
        where = "" if self.device.type == "cpu" else f", device={str(self.device)!r}"
        return f"Gaussians({len(self):,}, sh_degree={self.sh_degree}{extra}{where})"

    def __getitem__(self, index: slice | Tensor) -> "Gaussians":
        """Rows by slice, boolean mask (n,) or integer ids, extra columns included."""
        index = as_rows("index", index, len(self))
        arrays = {name: getattr(self, name)[index] for name in _ARRAYS}
        extra = {name: column[index] for name, column in self.extra.items()}
        return self.replace(**arrays, extra=extra)

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics, 0 to 3."""
        return degree_of(self.sh.shape[1])

    @property
    def colours(self) -> Float[Tensor, "n 3"]:
        """The mean colour over directions (degree 0), not clamped."""
        if self.chunks is not None:
            # Harmonics lie side by side: looked at in the map, all of them would stay.
            parts = [self.chunks.read([run]).sh[:, 0] for run in self.chunks.blocks(_COLOURS)]
            return 0.5 + SH_C0 * torch.cat([self.sh[:0, 0].float(), *parts])
        return 0.5 + SH_C0 * self.sh[:, 0]

    @property
    def device(self) -> torch.device:
        """Where the arrays are."""
        return self.means.device

    @property
    def dtype(self) -> torch.dtype:
        """Type of the floating-point arrays."""
        return self.means.dtype

    def replace(self, **changes: Any) -> "Gaussians":
        """The same Gaussians with some columns exchanged."""
        return _replace(self, **changes)

    def in_chunks(self, chunks: Chunks) -> "Gaussians":
        """The same Gaussians, of which views read `chunks`; see `io.chunks.open_chunks`."""
        made = self.replace()
        object.__setattr__(made, "chunks", chunks)
        return made

    @boundary
    def to(
        self,
        target: torch.device | torch.dtype | str | None = None,
        /,
        *,
        device: torch.device | str | None = None,
        dtype: torch.dtype | None = None,
    ) -> "Gaussians":
        """Move to a device, or change the floating-point type (extra columns keep theirs).

        ``to("cuda")`` and ``to(torch.float64)`` are short for ``device=`` and ``dtype=``.

        Raises:
            InputError: If the device is not here, or is no place for values.
        """
        if isinstance(target, torch.dtype):
            dtype = target
        elif target is not None:
            device = target
        device = _device(device)
        arrays = {n: getattr(self, n).to(device=device, dtype=dtype) for n in _ARRAYS}
        extra = {name: column.to(device=device) for name, column in self.extra.items()}
        return self.replace(**arrays, extra=extra)

    def check_values(self) -> None:
        """Raise `RangeError` unless every row can be rendered.

        Means, rotations, scales, opacities and SH are finite, scales are not negative,
        opacities lie in [0, 1] and no quaternion is zero. Of Gaussians on the disk only the means
        are looked at, which are used as a whole; what a view reads is checked then.
        """
        if self.chunks is not None:
            check_finite("means", self.means)
            return
        check_finite("means", self.means)
        check_finite("rotations", self.rotations)
        check_values("scales", self.scales, 0.0, float("inf"))
        check_values("opacities", self.opacities, 0.0, 1.0)
        check_finite("sh", self.sh)
        zero = (self.rotations == 0).all(dim=1)
        if bool(zero.any()):
            row = int(torch.nonzero(zero)[0])
            raise RangeError(
                f"rotations: expected quaternions that are not zero, got zero in row {row} "
                f"({int(zero.sum())} of {len(self)} rows)."
            )

    @boundary
    def transformed(self, target_from_source: Similarity) -> "Gaussians":
        """The Gaussians moved by a similarity: centres, axes, scales and spherical harmonics.

        Rendering the result from a camera moved the same way gives the same image.
        """
        turn = quaternion_from_rotation(target_from_source.rotation.double()).to(self.means)
        return self.replace(
            means=target_from_source.apply(self.means),
            rotations=quaternion_multiply(turn.expand_as(self.rotations), self.rotations),
            scales=self.scales * target_from_source.scale,
            sh=rotate_sh(self.sh, target_from_source.rotation),
        )

    @staticmethod
    @boundary
    def concatenate(parts: "Sequence[Gaussians]") -> "Gaussians":
        """Join scenes row by row.

        All must have the same SH degree, extra columns, `antialiased` and `low_pass`.

        Raises:
            InputError: If there is nothing to join or the columns differ.
        """
        if not parts:
            raise InputError("parts: expected at least one set of Gaussians, got none.")
        names = list(parts[0].extra)
        for i, part in enumerate(parts):
            if set(part.extra) != set(names):
                raise InputError(
                    f"parts[{i}]: expected the extra columns {sorted(names)}, "
                    f"got {sorted(part.extra)}."
                )
            if part.sh.shape[1] != parts[0].sh.shape[1]:
                raise ShapeError(
                    f"parts[{i}]: expected spherical harmonics of degree {parts[0].sh_degree}, "
                    f"got {part.sh_degree}."
                )
            for name in ("antialiased", "low_pass"):
                expected, got = getattr(parts[0], name), getattr(part, name)
                if got != expected:
                    raise InputError(
                        f"parts[{i}]: expected {name} to be {expected} as in the first, got {got}."
                    )
        arrays = {name: torch.cat([getattr(part, name) for part in parts]) for name in _ARRAYS}
        extra = {name: torch.cat([part.extra[name] for part in parts]) for name in names}
        return parts[0].replace(**arrays, extra=extra)


def no_gaussians() -> Gaussians:
    """None of degree 0."""
    nothing = torch.zeros(0, 3)
    return Gaussians(
        means=nothing,
        rotations=torch.zeros(0, 4),
        scales=nothing,
        opacities=torch.zeros(0),
        sh=torch.zeros(0, 1, 3),
    )


def _device(device: torch.device | str | None) -> torch.device | None:
    """A device that is here and holds values."""
    if device is None:
        return None
    try:
        found = torch.device(device)
        torch.empty(0, device=found)
    except (RuntimeError, AssertionError) as error:
        raise InputError(f"device: expected one that is here, got {str(device)!r}.") from error
    if found.type == "meta":
        raise InputError("device: expected one that holds values, got 'meta'.")
    return found
