"""Segments on a coarser grid."""

from dataclasses import replace

import torch
from torch import Tensor

from splatseg.core import LabelMap, MaskSet, Rle


def reduced_segments(segments: LabelMap | MaskSet, longest: int) -> LabelMap | MaskSet:
    """Segments on a coarser grid: each pixel takes what is at its middle."""
    height, width = segments.height, segments.width
    share = longest / max(height, width)
    if share >= 1:
        return segments
    h, w = max(1, round(share * height)), max(1, round(share * width))
    down = ((torch.arange(h) + 0.5) * height / h).long()
    across = ((torch.arange(w) + 0.5) * width / w).long()

    def taken(picture: Tensor) -> Tensor:
        return picture[down.unsqueeze(1), across]

    if isinstance(segments, LabelMap):
        return LabelMap(ids=taken(segments.ids.cpu()))
    masks = tuple(Rle.encode(taken(mask.decode())) for mask in segments.masks)
    return replace(segments, height=h, width=w, masks=masks)
