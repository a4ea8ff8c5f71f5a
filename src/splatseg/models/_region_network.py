"""The network that comes with the package: outlines and boxes of things and parts in photographs.

Inverted residuals (Sandler et al. 2018) on five scales, joined from the coarsest to the finest
(Lin et al. 2017), at half the photograph's size. Of each pixel it predicts whether outlines of a
thing, of a part, and those that HED draws pass it; whether it is of a thing or of walls, floors and
ceilings; and how far from it the box ends of the thing, and of the part, that it is of (as Tian et
al. 2019). The boxes tell regions of one thing from those of its like beside it, which no colour
does. Trained on generated rooms and tables with exact truth, on no photograph
(`scripts/train_regions`).
"""

import itertools
from functools import cache
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, UInt8
from numpy.typing import NDArray
from torch import Tensor, nn
from typing_extensions import override

from splatseg.io.tensors import read_tensors

WEIGHTS = Path(__file__).parent / "weights" / "regions.safetensors"

OUTPUTS = 12
"""Contours of things, parts and HED; thing; left, top, right, bottom of the thing, of the part."""

CONTOURS = 6
"""Channels of contours of `contours_and_boxes`."""

ENLARGED = 2.0
"""Second size that a photograph is seen in, against its own."""

BOX_SCALE = 8.0
"""Pixels at which distances d to a box's sides go from linear to logarithmic: the network gives
log(1 + d / 8)."""

_WIDTHS, _DECODED = (20, 32, 72, 144, 256), 40
_MEAN, _SPREAD = 0.45, 0.25
_STRIDE = 32
_MIRRORED = (0, 1, 2, 3, 6, 5, 4, 7, 10, 9, 8, 11)
"""Outputs of the mirrored photograph: left and right change places."""

_FARTHEST = 6.0


class _Convolution(nn.Sequential):
    """A convolution, in training with batch norm, which the weights that are shipped contain."""

    def __init__(
        self, before: int, after: int, size: int = 1, *, stride: int = 1, groups: int = 1,
        normalised: bool,
    ) -> None:  # fmt: skip
        convolution = nn.Conv2d(
            before, after, size, stride, size // 2, groups=groups, bias=not normalised
        )
        super().__init__(convolution, *([nn.BatchNorm2d(after)] if normalised else []))


class _Residual(nn.Module):
    """Widened, filtered channel by channel, narrowed; added to what came where shapes agree."""

    def __init__(
        self, before: int, after: int, *, stride: int = 1, wider: int = 3, size: int = 3,
        normalised: bool,
    ) -> None:  # fmt: skip
        super().__init__()
        inner = before * wider
        self.widen = _Convolution(before, inner, normalised=normalised)
        self.filter = _Convolution(
            inner, inner, size, stride=stride, groups=inner, normalised=normalised
        )
        self.narrow = _Convolution(inner, after, normalised=normalised)
        self._added = stride == 1 and before == after

    @override
    def forward(self, x: Tensor) -> Tensor:
        found = self.narrow(F.relu(self.filter(F.relu(self.widen(x)))))
        return x + found if self._added else found


class RegionNetwork(nn.Module):
    """Outlines and boxes at half the size of its input.

    Args:
        normalised: With batch norms, as it is trained.
    """

    def __init__(self, *, normalised: bool = False) -> None:
        super().__init__()

        def residual(before: int, after: int, **how: int) -> _Residual:
            return _Residual(before, after, normalised=normalised, **how)

        first, *_, last = _WIDTHS
        self.stem = nn.Sequential(
            _Convolution(3, first, 3, stride=2, normalised=normalised),
            nn.ReLU(),
            residual(first, first, wider=2),
        )
        self.stages = nn.ModuleList()
        for k, (before, after) in enumerate(itertools.pairwise(_WIDTHS)):
            further = ([3], [3, 5], [5, 5], [5, 5])[k]
            self.stages.append(
                nn.Sequential(
                    residual(before, after, stride=2),
                    *(residual(after, after, size=size) for size in further),
                )
            )
        self.overall = nn.Conv2d(last, last, 1)
        self.lateral = nn.ModuleList(nn.Conv2d(width, _DECODED, 1) for width in _WIDTHS)
        self.decoded = nn.ModuleList(residual(_DECODED, _DECODED, wider=2) for _ in _WIDTHS)
        self.head = nn.Conv2d(_DECODED, OUTPUTS, 3, padding=1)
        self.coarse_head = nn.Conv2d(_DECODED, OUTPUTS, 1) if normalised else None
        """At an eighth of the size, in training."""

    @override
    def forward(
        self, pixels: Float[Tensor, "n 3 h w"]
    ) -> tuple[Float[Tensor, "n 12 h2 w2"], Float[Tensor, "n 12 h8 w8"] | None]:
        """Logits of contours and things, and of each side log(1 + d / 8).

        Args:
            pixels: sRGB in [0, 1] less 0.45, over 0.25; sides are multiples of 32.
        """
        scales = [self.stem(pixels)]
        for stage in self.stages:
            scales.append(stage(scales[-1]))
        scales[-1] = scales[-1] + F.relu(self.overall(scales[-1].mean((2, 3), keepdim=True)))
        found: Tensor | None = None
        coarse: Tensor | None = None
        for k in reversed(range(len(scales))):
            x = self.lateral[k](scales[k])
            if found is not None:
                size = x.shape[-2:]
                x = x + F.interpolate(found, size, mode="bilinear", align_corners=False)
            found = self.decoded[k](F.relu(x))
            if k == 2 and self.coarse_head is not None:
                coarse = self.coarse_head(found)
        return self.head(found), coarse


@cache
def weights() -> dict[str, Tensor]:
    """All tensors that come with the package, by name."""
    return read_tensors(WEIGHTS)


@cache
def region_network() -> RegionNetwork:
    """The network with the weights of the package, in evaluation mode."""
    with torch.device("meta"):
        network = RegionNetwork()
    state = {
        name.removeprefix("network."): value.float()
        for name, value in weights().items()
        if name.startswith("network.")
    }
    network.load_state_dict(state, assign=True)
    network = network.requires_grad_(False).eval()  # noqa: FBT003
    return network.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]


@torch.inference_mode()
def contours_and_boxes(
    network: RegionNetwork, image: UInt8[np.ndarray, "h w 3"]
) -> tuple[Float[np.ndarray, "h w 6"], Float[np.ndarray, "h w 9"]]:
    """What the network says of an sRGB image, and of the image enlarged.

    Enlarged, it sees finer rims; boxes are those of the image as it is.

    Returns:
        Probabilities of contours: the mean of the others' things and parts; things, parts and
        HED's of the image; things and parts of the enlarged one. And the probability of a thing,
        then left, top, right and bottom in pixels of the box of the thing, and of the part, that
        each pixel is of.
    """
    import cv2

    height, width = image.shape[:2]
    found = _predicted(network, image)
    size = (round(width * ENLARGED), round(height * ENLARGED))
    enlarged = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_LINEAR), np.uint8)
    finer = _predicted(network, enlarged)[..., :2]
    finer = np.asarray(cv2.resize(finer, (width, height), interpolation=cv2.INTER_AREA))
    together = (found[..., :2].sum(2, keepdims=True) + finer.sum(2, keepdims=True)) / 4
    contours = np.concatenate((together, found[..., :3], finer), axis=2).astype(np.float32)
    boxes = _boxes(np.expm1(found[..., 4:]) * np.float32(BOX_SCALE))
    return contours, np.concatenate((found[..., 3:4], boxes), axis=2)


def _predicted(network: RegionNetwork, image: NDArray[np.uint8]) -> NDArray[np.float32]:
    """(h, w, 12) probabilities and logarithms, the mean of the image and its mirror image."""
    import cv2

    height, width = image.shape[:2]
    below, beside = -height % _STRIDE, -width % _STRIDE
    padded = np.pad(image, ((0, below), (0, beside), (0, 0)), mode="edge")
    pixels = (torch.from_numpy(padded).float() / 255 - _MEAN) / _SPREAD
    pixels = pixels.permute(2, 0, 1)[None].contiguous(memory_format=torch.channels_last)
    straight = network(pixels)[0][0]
    mirrored = network(pixels.flip(-1))[0][0].flip(-1)[list(_MIRRORED)]
    probabilities = (straight[:4].sigmoid() + mirrored[:4].sigmoid()) / 2
    sides = ((straight[4:] + mirrored[4:]) / 2).clamp(0, _FARTHEST)
    found = torch.cat((probabilities, sides)).permute(1, 2, 0).numpy()
    size = (width + beside, height + below)
    large = cv2.resize(np.ascontiguousarray(found), size, interpolation=cv2.INTER_LINEAR)
    return np.asarray(large, np.float32)[:height, :width]


def _boxes(distances: NDArray[np.float32]) -> NDArray[np.float32]:
    """Boxes by the distances of their sides (h, w, 4 k) from each pixel, within the image."""
    height, width = distances.shape[:2]
    y, x = np.mgrid[:height, :width].astype(np.float32) + np.float32(0.5)
    found = distances.copy()
    for k, (start, sign, end) in enumerate(
        ((x, -1, width), (y, -1, height), (x, 1, width), (y, 1, height))
    ):
        for side in range(k, distances.shape[2], 4):
            found[..., side] = np.clip(start + sign * distances[..., side], 0, end)
    return found
