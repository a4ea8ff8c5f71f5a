"""Run-length masks as COCO has them: column by column, alternating runs, zeros first."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool
from numpy.typing import NDArray
from torch import Tensor

from splatseg._check import check_shape
from splatseg.core.boundary import boundary, convert_fields
from splatseg.errors import InputError, RangeError

_MAX_BITS = 35
"""Of a number in compressed counts: 7 characters, which hold any run and any difference of two."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rle:
    """One binary mask as run lengths in column-major order, the first run being zeros."""

    height: int
    width: int
    counts: NDArray[np.uint32]

    def __post_init__(self) -> None:
        convert_fields(self)
        total = int(self.counts.sum(dtype=np.uint64))
        if total != self.height * self.width:
            raise RangeError(
                f"counts: expected runs that add up to {self.height} x {self.width} = "
                f"{self.height * self.width} pixels, got {total}."
            )

    @property
    def area(self) -> int:
        """Number of pixels set."""
        return int(self.counts[1::2].sum(dtype=np.uint64))

    @property
    def bbox(self) -> tuple[int, int, int, int]:
        """x, y, width, height of the tight box; zeros where the mask is empty."""
        ends = np.cumsum(self.counts, dtype=np.int64)
        begins, ends = ends[0::2][: len(self.counts[1::2])], ends[1::2]
        keep = ends > begins
        begins, last = begins[keep], ends[keep] - 1
        if not len(begins):
            return (0, 0, 0, 0)
        x0, x1 = int(begins[0] // self.height), int(last[-1] // self.height)
        # A run that crosses into the next column touches both the bottom and the top row.
        crosses = bool((begins // self.height != last // self.height).any())
        y0 = 0 if crosses else int((begins % self.height).min())
        y1 = self.height - 1 if crosses else int((last % self.height).max())
        return (x0, y0, x1 - x0 + 1, y1 - y0 + 1)

    @classmethod
    @boundary
    def encode(cls, mask: Bool[Tensor, "height width"]) -> "Rle":
        """Run lengths of a boolean mask."""
        check_shape("mask", mask, (None, None))
        height, width = (int(s) for s in mask.shape)
        flat = mask.to(torch.bool).cpu().numpy().T.reshape(-1)
        changes = np.flatnonzero(flat[1:] != flat[:-1]) + 1
        edges = np.concatenate(([0], changes, [flat.size]))
        counts = np.diff(edges).astype(np.uint32)
        if flat.size and flat[0]:
            counts = np.concatenate((np.zeros(1, np.uint32), counts))
        return cls(height=height, width=width, counts=counts)

    def decode(self) -> Bool[Tensor, "height width"]:
        """The mask as booleans."""
        values = np.arange(len(self.counts)) % 2 == 1
        flat = np.repeat(values, self.counts)
        return torch.from_numpy(np.ascontiguousarray(flat.reshape(self.width, self.height).T))

    @classmethod
    @boundary
    def from_coco(cls, text: str | bytes, *, height: int, width: int) -> "Rle":
        """Read COCO's compressed counts: 5 bits a character, least significant first.

        From the third run on, a number is stored as the difference to the run before last.

        Raises:
            InputError: If a character is outside the alphabet or a number does not end.
        """
        # Bytes of what is not ASCII are above 127, which is refused below.
        data = text.encode() if isinstance(text, str) else text
        codes = np.frombuffer(data, np.uint8).astype(np.int64) - 48
        if codes.size and (codes.min() < 0 or codes.max() > 63):
            raise InputError("counts: expected a compressed COCO mask, got other characters.")
        if codes.size and codes[-1] & 32:
            raise InputError("counts: the compressed mask breaks off inside a number.")
        counts: list[int] = []
        value = shift = 0
        for code in codes.tolist():
            value |= (code & 31) << shift
            shift += 5
            if code & 32:
                if shift >= _MAX_BITS:
                    raise InputError("counts: expected runs of 32 bits, got a longer number.")
                continue
            if code & 16:
                value -= 1 << shift
            counts.append(value + (counts[-2] if len(counts) > 2 else 0))
            value = shift = 0
        if any(count < 0 for count in counts):
            raise InputError("counts: the compressed mask holds a negative run.")
        total = sum(counts)
        if total != height * width:  # before they are forced into 32 bits
            raise InputError(
                f"counts: expected runs that add up to {height} x {width} = {height * width} "
                f"pixels, got {total}."
            )
        return cls(height=height, width=width, counts=np.array(counts, np.uint32))

    def to_coco(self) -> str:
        """COCO's compressed counts. Inverse of `from_coco`."""
        out: list[str] = []
        runs = self.counts.tolist()
        for i, run in enumerate(runs):
            value = run - runs[i - 2] if i > 2 else run
            more = True
            while more:
                code = value & 31
                value >>= 5
                more = value != (-1 if code & 16 else 0)
                out.append(chr((code | 32 if more else code) + 48))
        return "".join(out)
