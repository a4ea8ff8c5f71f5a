r"""Renders held against photographs, and LPIPS: how far apart a network sees two pictures.

.. math:: d(x, y) = \sum_l \frac{1}{H_l W_l} \sum_{h, w}
          \left\| w_l \odot (\hat x^l_{hw} - \hat y^l_{hw}) \right\|_2^2

where :math:`\hat x^l` are the features of layer l, each pixel's scaled to length 1 across
channels (Zhang et al., eq. 1). As in the authors' code the heads hold :math:`w_l^2`, one number
a channel, so that the sum over channels is a product with them.

The layers are AlexNet's five or VGG-16's five last ReLUs of a block, in plain torch: torchvision
is not needed, and no weights come with splatseg or are downloaded: they are the user's.

References:
    Zhang, Isola, Efros, Shechtman and Wang, The Unreasonable Effectiveness of Deep Features as a
    Perceptual Metric (2018).
    Krizhevsky, One weird trick for parallelizing convolutional neural networks (2014): this
    AlexNet. Simonyan and Zisserman (2015): VGG-16.
"""

import math
import re
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor
from torch.nn import functional

from splatseg._check import check_shape
from splatseg.core import Renderable, View
from splatseg.core.boundary import boundary
from splatseg.errors import InputError, ShapeError
from splatseg.evaluate.held_out import Progress
from splatseg.evaluate.metrics import SSIM_WINDOW, psnr, ssim
from splatseg.io.images import image_camera, load_alpha, load_image, load_mask
from splatseg.io.tensors import read_tensors

# What ImageNet's pictures are shifted and scaled by, for values from -1 to 1.
_SHIFT = (-0.030, -0.088, -0.188)
_SCALE = (0.458, 0.448, 0.450)
_TINY = 1e-10
# torchvision's `features.N.weight`, and `net.sliceK.N.weight` of the lpips package.
_CONVOLUTION = re.compile(r"(?:features|net\.slice\d)\.(\d+)\.(weight|bias)")
# `linL.model.1.weight` of the lpips package's files, and `lins.L.model.1.weight` of its modules.
_HEAD = re.compile(r"lins?\.?(\d)\.model\.1\.weight")


@dataclass(frozen=True, slots=True, kw_only=True)
class _Layer:
    """One convolution, by its number in torchvision's list."""

    index: int
    out: int
    kernel: int = 3
    stride: int = 1
    padding: int = 1
    pool: int = 0
    """Side of the max-pooling, of stride 2, before it; 0 is none."""

    tap: bool = False
    """Whether the features after its ReLU count."""


_ALEXNET = (
    _Layer(index=0, out=64, kernel=11, stride=4, padding=2, tap=True),
    _Layer(index=3, out=192, kernel=5, padding=2, pool=3, tap=True),
    _Layer(index=6, out=384, pool=3, tap=True),
    _Layer(index=8, out=256, tap=True),
    _Layer(index=10, out=256, tap=True),
)
_VGG16 = (
    _Layer(index=0, out=64),
    _Layer(index=2, out=64, tap=True),
    _Layer(index=5, out=128, pool=2),
    _Layer(index=7, out=128, tap=True),
    _Layer(index=10, out=256, pool=2),
    _Layer(index=12, out=256),
    _Layer(index=14, out=256, tap=True),
    _Layer(index=17, out=512, pool=2),
    _Layer(index=19, out=512),
    _Layer(index=21, out=512, tap=True),
    _Layer(index=24, out=512, pool=2),
    _Layer(index=26, out=512),
    _Layer(index=28, out=512, tap=True),
)
_NETWORKS = {"alex": _ALEXNET, "vgg": _VGG16}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Lpips:
    """The measure with its weights. Call it on two 8-bit pictures."""

    network: str
    """``alex`` or ``vgg``."""

    kernels: tuple[tuple[Tensor, Tensor], ...]
    """Weights and biases of the convolutions, first to last."""

    heads: tuple[Float[Tensor, "channels"], ...]
    """A weight for each channel of each of the five layers, 0 or more."""

    def __call__(
        self,
        picture: UInt8[Tensor, "height width 3"],
        photograph: UInt8[Tensor, "height width 3"],
    ) -> float:
        """The distance; 0 for equal pictures.

        Raises:
            ShapeError: If the sizes differ, or are too small for the network.
        """
        check_shape("photograph", photograph, (None, None, 3))
        check_shape("picture", picture, photograph.shape)
        if min(photograph.shape[:2]) < 32:
            raise ShapeError(
                f"photograph: expected at least 32x32 pixels for LPIPS, got "
                f"{photograph.shape[1]}x{photograph.shape[0]}."
            )
        with torch.no_grad():
            ours, theirs = self.features(picture), self.features(photograph)
            total = 0.0
            for head, one, other in zip(self.heads, ours, theirs, strict=True):
                apart = (_unit(one) - _unit(other)).square()
                total += float((apart * head[:, None, None]).sum(dim=0).mean())
        return total

    def features(
        self, image: UInt8[Tensor, "height width 3"]
    ) -> list[Float[Tensor, "channels rows columns"]]:
        """What the five layers give."""
        x = image.float().movedim(-1, 0) / 127.5 - 1
        x = (x - torch.tensor(_SHIFT)[:, None, None]) / torch.tensor(_SCALE)[:, None, None]
        out: list[Tensor] = []
        for layer, (weight, bias) in zip(_NETWORKS[self.network], self.kernels, strict=True):
            if layer.pool:
                x = functional.max_pool2d(x[None], layer.pool, stride=2)[0]
            x = functional.conv2d(
                x[None], weight, bias, stride=layer.stride, padding=layer.padding
            )[0].relu()
            if layer.tap:
                out.append(x)
        return out


def load_lpips(files: Sequence[Path]) -> Lpips:
    """LPIPS from files of weights: the network's, and the heads' where they are not in it.

    Names are those of torchvision's AlexNet or VGG-16 (``features.0.weight``) with the heads of
    the lpips package (``lin0.model.1.weight``), or of a whole module of that package. Which
    network it is, its first convolution says.

    Args:
        files: ``.safetensors`` or ``.npz``; for how to make one of a ``.pth``, see
            `splatseg.io.tensors.read_tensors`.

    Raises:
        MissingFileError: If a file is not there.
        FileFormatError: If a file is damaged.
        InputError: If weights are missing, or not of one of the two networks.
    """
    if not files:
        raise InputError("lpips: expected files of weights, got none.")
    where = ", ".join(str(file) for file in files)
    tensors = {name: tensor for file in files for name, tensor in read_tensors(file).items()}
    found: dict[tuple[int, str], Tensor] = {}
    heads: dict[int, Tensor] = {}
    for name, tensor in tensors.items():
        convolution, head = _CONVOLUTION.fullmatch(name), _HEAD.fullmatch(name)
        if convolution:
            found[int(convolution[1]), convolution[2]] = tensor.float()
        elif head:
            heads[int(head[1])] = tensor.float().reshape(-1)
    network = _network(found, where)
    layers = _NETWORKS[network]
    return Lpips(
        network=network,
        kernels=tuple(_kernel(found, layers, i, where) for i in range(len(layers))),
        heads=_heads(heads, [layer.out for layer in layers if layer.tap], where),
    )


def _network(found: Mapping[tuple[int, str], Tensor], where: str) -> str:
    first = found.get((0, "weight"))
    if first is None:
        raise InputError(
            f"{where}: expected the weights of AlexNet or VGG-16 (features.0.weight), got none."
        )
    for name, layers in _NETWORKS.items():
        side = layers[0].kernel
        if tuple(first.shape) == (layers[0].out, 3, side, side):
            return name
    raise InputError(
        f"{where}: expected a first convolution of AlexNet (64, 3, 11, 11) or VGG-16 "
        f"(64, 3, 3, 3), got {tuple(first.shape)}."
    )


def _kernel(
    found: Mapping[tuple[int, str], Tensor], layers: Sequence[_Layer], layer_index: int, where: str
) -> tuple[Tensor, Tensor]:
    layer = layers[layer_index]
    channels = layers[layer_index - 1].out if layer_index else 3
    weight, bias = (found.get((layer.index, kind)) for kind in ("weight", "bias"))
    if weight is None or bias is None:
        raise InputError(f"{where}: expected weight and bias of convolution {layer.index}.")
    shape = (layer.out, channels, layer.kernel, layer.kernel)
    if tuple(weight.shape) != shape or tuple(bias.shape) != (layer.out,):
        raise InputError(
            f"{where}: expected convolution {layer.index} of shape {shape}, "
            f"got {tuple(weight.shape)}."
        )
    return weight, bias


def _heads(found: Mapping[int, Tensor], channels: Sequence[int], where: str) -> tuple[Tensor, ...]:
    sizes = [len(found[i]) if i in found else None for i in range(len(channels))]
    if sizes != list(channels):
        raise InputError(
            f"{where}: expected heads lin0 to lin4 of {', '.join(map(str, channels))} channels, "
            f"got {', '.join(map(str, sizes))}."
        )
    return tuple(found[i] for i in range(len(channels)))


def _unit(features: Float[Tensor, "channels rows columns"]) -> Tensor:
    """Each pixel's features scaled to length 1."""
    return features / (features.square().sum(dim=0, keepdim=True).sqrt() + _TINY)


# Renders held against photographs.


MaskUse = Literal["off", "ignore", "alpha"]
"""What the masks of views mean, as in a fit."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewScore:
    """How like its photograph one picture is."""

    name: str
    """Of the view."""

    psnr: float
    """Decibels."""

    ssim: float
    lpips: float | None = None
    """None where no network was given."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PhotographReport:
    """How like the photographs the pictures are."""

    psnr: float
    """Mean over views, decibels."""

    psnr_min: float
    """Of the worst view, decibels."""

    ssim: float
    """Mean over views."""

    views: tuple[str, ...]
    """Views that were scored."""

    per_view: tuple[ViewScore, ...] = ()
    """The scores of each of them."""

    lpips: float | None = None
    """Mean over views; None where no network was given."""


@boundary
def evaluate_photographs(
    field: Renderable,
    views: Sequence[View],
    *,
    masks: MaskUse = "off",
    lpips: Callable[[torch.Tensor, torch.Tensor], float] | None = None,
    longest: int | None = None,
    seconds: float = math.inf,
    progress: Progress | None = None,
) -> PhotographReport:
    """Score the pictures against the photographs, as 8-bit files of both would score.

    Args:
        field: What is rendered.
        views: Views with photographs.
        masks: What masks mean. ``ignore``: only pixels that a view's mask keeps are scored, for a
            fit that ignored the others knows nothing of them; a view of which nothing is kept is
            left out. ``alpha``: what the mask, or the alpha channel of the photograph, cuts out is
            scored, photograph and picture over white, as is the custom for such scenes. ``off``,
            and a view without a mask: every pixel.
        lpips: A network with weights (`splatseg.evaluate.photographs.load_lpips`); None leaves that
            score out.
        longest: Longest side in pixels to which larger photographs are reduced, and drawn in;
            None keeps every pixel.
        seconds: After so long no further view is begun; at least one is scored.
        progress: Called with the views done and their number.

    Raises:
        InputError: If there are no views, one has no photograph, or masks leave nothing to score.
        MissingFileError: If a photograph is not where it was.
    """
    if not views:
        raise InputError("views: expected at least one view with a photograph, got none.")
    scores: list[ViewScore] = []
    begin = time.monotonic()
    for done, view in enumerate(views, start=1):
        score = _view_score(field, view, masks=masks, lpips=lpips, longest=longest)
        if score is not None:
            scores.append(score)
        if progress is not None:
            progress(done, len(views))
        if scores and time.monotonic() - begin > seconds:
            break
    if not scores:
        raise InputError(f"views: expected pixels to score, but masks keep none of {len(views)}.")
    distances = [score.lpips for score in scores if score.lpips is not None]
    return PhotographReport(
        psnr=math.fsum(score.psnr for score in scores) / len(scores),
        psnr_min=min(score.psnr for score in scores),
        ssim=math.fsum(score.ssim for score in scores) / len(scores),
        views=tuple(score.name for score in scores),
        per_view=tuple(scores),
        lpips=math.fsum(distances) / len(distances) if distances else None,
    )


def _view_score(
    field: Renderable,
    view: View,
    *,
    masks: MaskUse,
    lpips: Callable[[torch.Tensor, torch.Tensor], float] | None,
    longest: int | None,
) -> ViewScore | None:
    """The scores of a view; None where its mask keeps nothing that could be scored."""
    rendered, photograph = render_and_photograph(field, view, masks=masks, longest=longest)
    keep = scored_pixels(view, masks=masks, longest=longest)
    if keep is not None:
        if not keep.any():
            return None
        # A network sees whole pictures: where nothing is known, the photograph stands.
        rendered = torch.where(keep[..., None], rendered, photograph)
    return ViewScore(
        name=view.name,
        psnr=psnr(rendered, photograph, keep),
        ssim=ssim(rendered, photograph, keep),
        lpips=None if lpips is None else lpips(rendered, photograph),
    )


def scored_pixels(
    view: View, *, masks: MaskUse, longest: int | None
) -> Bool[Tensor, "height width"] | None:
    """Which pixels of a view are scored: None is all, and none is where SSIM would have none."""
    mask = load_mask(view, longest=longest) if masks == "ignore" else None
    if mask is None:
        return None
    border = SSIM_WINDOW // 2
    inner = mask[border:-border, border:-border] > 0
    return mask > 0 if inner.any() else torch.zeros_like(mask, dtype=torch.bool)


@boundary
def render_and_photograph(
    field: Renderable,
    view: View,
    *,
    masks: MaskUse = "off",
    longest: int | None = None,
) -> tuple[UInt8[Tensor, "height width 3"], UInt8[Tensor, "height width 3"]]:
    """What a field shows in a view, and what the camera saw, both as 8-bit files hold them.

    Arguments and errors are those of `evaluate_photographs`.
    """
    photograph = load_image(view, longest=longest)
    with field.view(image_camera(view, longest)) as looked_at:
        shown = looked_at.signals()
    if shown.colour is None:
        raise InputError("field: expected colours of a view, got none.")
    image = shown.colour.double()
    opaque = load_alpha(view, longest=longest) if masks == "alpha" else None
    if opaque is not None:
        image = image + (1 - shown.alpha.double())[..., None]
        photograph = _over_white(photograph, opaque, view)
    return (image.clamp(0, 1) * 255 + 0.5).to(torch.uint8), photograph


def _over_white(photograph: torch.Tensor, opaque: torch.Tensor, view: View) -> torch.Tensor:
    """A photograph cut out by a mask, over white; its own alpha was blended so when it was read."""
    if view.mask is None:
        return photograph
    share = opaque.double()[..., None] / 255
    return (photograph * share + 255 * (1 - share) + 0.5).to(torch.uint8)
