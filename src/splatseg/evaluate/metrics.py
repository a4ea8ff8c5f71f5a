r"""Measures of how well maps and pictures agree. Pure functions on tensors.

Ids are those of memory: 0 and up, -1 none. In the truth -1 is void: those pixels are left out
of everything. In the prediction -1 is an answer, and a wrong one.

Counts are pooled in a confusion matrix :math:`c_{t,p}`, the number of pixels with true class t
that were given class p. With :math:`c_{t\cdot}` a row's sum and :math:`c_{\cdot p}` a column's:

.. math:: \mathrm{IoU}_k = \frac{c_{kk}}{c_{k\cdot} + c_{\cdot k} - c_{kk}}

References:
    Long, Shelhamer and Darrell, Fully Convolutional Networks for Semantic Segmentation (2015),
    section 5: accuracy, mean accuracy, mean IoU and frequency weighted IoU.
    Wang, Bovik, Sheikh and Simoncelli, Image Quality Assessment (2004): SSIM.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import torch
from jaxtyping import Bool, Float, Int, Num, UInt8
from torch import Tensor

from splatseg._check import check_finite, check_shape, check_values
from splatseg.core import UNLABELLED
from splatseg.core.boundary import boundary, convert_fields
from splatseg.errors import InputError, RangeError, ShapeError

SSIM_WINDOW = 11
"""Pixels across the Gaussian window of SSIM."""

SSIM_SIGMA = 1.5
"""Its standard deviation in pixels."""

_SSIM_C1 = 0.01**2
_SSIM_C2 = 0.03**2
_MIN_ERROR = 1e-12


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Confusion:
    """How often each class was taken for which. Those of single views add up.

    Example:
        >>> truth = torch.tensor([[0, 0, 1, -1]])
        >>> Confusion.of(torch.tensor([[0, 1, 1, 1]]), truth).counts[1:, 1:]
        tensor([[1, 1],
                [0, 1]])
    """

    counts: Num[Tensor, "classes_plus_1 classes_plus_1"]
    """``counts[t + 1, p + 1]``: pixels of true class t given class p; row and column 0 are -1.
    Row 0 is all zero, for void pixels do not count. int64, or float64 sums of weights."""

    def __post_init__(self) -> None:
        convert_fields(self)
        size = int(self.counts.shape[0]) if self.counts.ndim else 0
        check_shape("counts", self.counts, (size, size))

    @classmethod
    def none(cls) -> "Confusion":
        """Counts of no view, to begin a sum with."""
        return cls(counts=torch.zeros(1, 1, dtype=torch.int64))

    @classmethod
    def of(
        cls,
        predicted: Int[Tensor, "height width"],
        truth: Int[Tensor, "height width"],
        weights: Float[Tensor, "height width"] | None = None,
    ) -> "Confusion":
        """Count one map, or any other array of ids.

        Args:
            predicted: Ids, -1 none.
            truth: Ids, -1 void.
            weights: What each entry counts, 0 or more, for entries that are no pixels; None
                counts every one as 1.

        Raises:
            ShapeError: If the sizes differ; nothing is resized.
            RangeError: If an id is below -1, or a weight is negative or not finite.
        """
        predicted, truth = id_pair(predicted, truth)
        real = truth != UNLABELLED
        p, t = predicted[real] + 1, truth[real] + 1
        size = 1 + max((int(ids.max()) + 1 for ids in (predicted, truth) if ids.numel()), default=0)
        if weights is None:
            counts = torch.bincount(t * size + p, minlength=size * size)
        else:
            check_shape("weights", weights, tuple(truth.shape))
            check_values("weights", weights, 0.0, math.inf)
            counts = torch.bincount(
                t * size + p, weights=weights.cpu().double()[real], minlength=size * size
            )
        return cls(counts=counts.reshape(size, size))

    def __add__(self, other: "Confusion") -> "Confusion":
        size = max(len(self.counts), len(other.counts))
        kind = torch.promote_types(self.counts.dtype, other.counts.dtype)
        counts = self.counts.new_zeros(size, size, dtype=kind)
        for part in (self.counts, other.counts):
            counts[: len(part), : len(part)] += part
        return Confusion(counts=counts)

    @property
    def pixels(self) -> int:
        """Pixels that count."""
        return int(self.counts.sum())


@dataclass(frozen=True, slots=True, kw_only=True)
class SemanticScore:
    """What a confusion matrix amounts to. All figures are in [0, 1]."""

    miou: float
    """Mean of the pooled IoU over the classes present in the truth."""

    fwiou: float
    """The same, weighted by each class's share of the truth's pixels."""

    accuracy: float
    """Share of the pixels whose class is right."""

    mean_accuracy: float
    """Mean over the classes present of the share of their pixels that is right."""

    per_class: Mapping[int, float]
    """IoU of each class present in the truth, by id."""


@boundary
def semantic_score(confusion: Confusion) -> SemanticScore:
    r"""Score a pooled confusion matrix.

    .. math::
        \mathrm{mIoU} = \frac{1}{|P|} \sum_{k \in P} \mathrm{IoU}_k, \qquad
        \mathrm{fwIoU} = \sum_{k \in P} \frac{c_{k\cdot}}{\sum c} \mathrm{IoU}_k

    with P the classes that the truth has. A class that is only predicted lowers others' IoU,
    but is no member of the mean.

    Raises:
        InputError: If no pixel of the truth has a class.
    """
    counts = confusion.counts.double()
    total = counts.sum()
    if not total > 0:
        raise InputError("truth: expected at least one pixel with a class, all are void.")
    hits = counts.diagonal()
    in_truth = counts.sum(dim=1)
    present = in_truth > 0
    union = (in_truth + counts.sum(dim=0) - hits)[present]
    iou = hits[present] / union
    classes = (torch.nonzero(present).squeeze(1) - 1).tolist()
    return SemanticScore(
        miou=float(iou.mean()),
        fwiou=float((iou * in_truth[present]).sum() / total),
        accuracy=float(hits.sum() / total),
        mean_accuracy=float((hits[present] / in_truth[present]).mean()),
        per_class=MappingProxyType(dict(zip(classes, iou.tolist(), strict=True))),
    )


@boundary
def matched_miou(confusion: Confusion) -> float:
    """Mean IoU over the true classes once each was matched with another class of the layer.

    The matching is one to one and the best there is; a true class without a partner counts 0.
    Where this is far above the mean IoU, the two number their classes differently.

    Raises:
        InputError: If no pixel of the truth has a class.
    """
    from scipy.optimize import linear_sum_assignment

    counts = confusion.counts.double()
    in_truth, predicted = counts.sum(dim=1)[1:], counts.sum(dim=0)[1:]
    present = in_truth > 0
    if not bool(present.any()):
        raise InputError("truth: expected at least one pixel with a class, all are void.")
    used = predicted > 0
    shared = counts[1:, 1:][present][:, used]
    union = in_truth[present, None] + predicted[None, used] - shared
    iou = (shared / union).numpy()
    rows, columns = linear_sum_assignment(iou, maximize=True)
    return float(iou[rows, columns].sum()) / int(present.sum())


@boundary
def per_image_miou(confusions: Iterable[Confusion]) -> float:
    """Mean over views of each view's own mean IoU over the classes its truth has.

    Small classes weigh more than in the pooled figure, and so do views with few classes. Views
    whose truth is void altogether do not take part.

    Raises:
        InputError: If no view has a pixel with a class.
    """
    values = [semantic_score(one).miou for one in confusions if one.pixels]
    if not values:
        raise InputError("truth: expected at least one view with a class, all pixels are void.")
    return math.fsum(values) / len(values)


@dataclass(frozen=True, slots=True, kw_only=True)
class BinaryScore:
    """How well masks agree, over views. All figures are in [0, 1]."""

    iou_mean: float
    """Mean over views of intersection over union; a view where both are empty counts 1."""

    iou_pooled: float
    """Intersection over union of all views' pixels together; 0 where there are none."""

    accuracy: float
    """Mean over views of the share of pixels that agree."""


@boundary
def binary_score(
    pairs: Iterable[tuple[Bool[Tensor, "height width"], Bool[Tensor, "height width"]]],
) -> BinaryScore:
    """Score (predicted, true) masks of one or more views.

    Raises:
        ShapeError: If the sizes of a pair differ.
        InputError: If there is no pair.
    """
    ious: list[float] = []
    agreements: list[float] = []
    intersection = union = 0
    for index, (predicted, truth) in enumerate(pairs):
        if predicted.shape != truth.shape:
            raise ShapeError(
                f"pairs[{index}]: expected masks of one size, "
                f"got {tuple(predicted.shape)} and {tuple(truth.shape)}."
            )
        predicted, truth = predicted.bool(), truth.bool()
        both, either = int((predicted & truth).sum()), int((predicted | truth).sum())
        intersection, union = intersection + both, union + either
        ious.append(both / either if either else 1.0)
        agreements.append(float((predicted == truth).double().mean()))
    if not ious:
        raise InputError("pairs: expected at least one view, got none.")
    return BinaryScore(
        iou_mean=math.fsum(ious) / len(ious),
        iou_pooled=intersection / max(union, 1),
        accuracy=math.fsum(agreements) / len(agreements),
    )


@boundary
def psnr(
    image: Float[Tensor, "height width channels"] | UInt8[Tensor, "height width channels"],
    truth: Float[Tensor, "height width channels"] | UInt8[Tensor, "height width channels"],
    keep: Bool[Tensor, "height width"] | None = None,
) -> float:
    r"""Peak signal-to-noise ratio in decibels, :math:`-10 \log_{10} \mathrm{MSE}`.

    Args:
        image: Picture, uint8 or floating point with white at 1.
        truth: The photograph, alike.
        keep: Pixels that count, at least one; None counts all.

    Returns:
        At most 120 dB, what a mean square error of 1e-12 amounts to.

    Raises:
        ShapeError: If sizes differ.
        RangeError: If a value is NaN or infinite.
        InputError: If `keep` keeps nothing.

    Example:
        >>> round(psnr(torch.zeros(2, 2, 3), torch.full((2, 2, 3), 0.1)), 3)
        20.0
    """
    a, b = _image_pair(image, truth)
    squares = (a - b) ** 2
    if keep is not None:
        squares = squares[_kept(keep, squares)]
    return -10 * math.log10(max(float(squares.mean()), _MIN_ERROR))


@boundary
def ssim(
    image: Float[Tensor, "height width channels"] | UInt8[Tensor, "height width channels"],
    truth: Float[Tensor, "height width channels"] | UInt8[Tensor, "height width channels"],
    keep: Bool[Tensor, "height width"] | None = None,
) -> float:
    r"""Structural similarity, mean over pixels and channels, at most 1.

    .. math:: \frac{(2 \mu_a \mu_b + 0.01^2)(2 \sigma_{ab} + 0.03^2)}
                   {(\mu_a^2 + \mu_b^2 + 0.01^2)(\sigma_a^2 + \sigma_b^2 + 0.03^2)}

    with moments under a Gaussian window of 11 pixels and sigma 1.5, only where the window lies
    inside the picture, each channel for itself.

    Args:
        image: Picture of at least 11 x 11 pixels, uint8 or floating point with white at 1.
        truth: The photograph, alike.
        keep: Pixels that count: those windows whose middle is one of them. None counts all.

    Raises:
        ShapeError: If the sizes differ or are smaller than the window.
        InputError: If `keep` keeps no window's middle.
    """
    a, b = _image_pair(image, truth)
    if min(a.shape[:2]) < SSIM_WINDOW:
        raise ShapeError(
            f"image: expected at least {SSIM_WINDOW} x {SSIM_WINDOW} pixels, "
            f"got {a.shape[0]} x {a.shape[1]}."
        )
    inner = None
    if keep is not None:
        border = SSIM_WINDOW // 2
        check_shape("keep", keep, tuple(a.shape[:2]))
        inner = keep[border:-border, border:-border]
        inner = _kept(inner, inner)
    a, b = a.movedim(-1, 0), b.movedim(-1, 0)
    moments = _window_means(torch.stack((a, b, a * a, b * b, a * b)))
    mean_a, mean_b, square_a, square_b, product = moments.unbind(0)
    variances = square_a - mean_a**2 + square_b - mean_b**2
    covariance = product - mean_a * mean_b
    likeness = (2 * mean_a * mean_b + _SSIM_C1) * (2 * covariance + _SSIM_C2)
    likeness = likeness / ((mean_a**2 + mean_b**2 + _SSIM_C1) * (variances + _SSIM_C2))
    return float(likeness.mean() if inner is None else likeness[:, inner].mean())


def _kept(keep: Tensor, pixels: Tensor) -> Tensor:
    """A checked mask of pixels, on the CPU."""
    check_shape("keep", keep, tuple(pixels.shape[:2]))
    if keep.dtype != torch.bool or not bool(keep.any()):
        raise InputError(f"keep: expected booleans with a True among them, got {keep.dtype}.")
    return keep.cpu()


def _window_means(images: Tensor) -> Tensor:
    """Means under the window, wherever it fits, along the last two axes."""
    offsets = torch.arange(SSIM_WINDOW, dtype=images.dtype) - SSIM_WINDOW // 2
    window = torch.exp(-0.5 * (offsets / SSIM_SIGMA) ** 2)
    window = window / window.sum()
    rows = images.shape[-2] - SSIM_WINDOW + 1
    columns = images.shape[-1] - SSIM_WINDOW + 1
    weights = window.tolist()
    down = weights[0] * images[..., :rows, :]
    for i, weight in enumerate(weights[1:], start=1):
        down.add_(images[..., i : i + rows, :], alpha=weight)
    means = weights[0] * down[..., :columns]
    for i, weight in enumerate(weights[1:], start=1):
        means.add_(down[..., i : i + columns], alpha=weight)
    return means


def id_pair(predicted: Tensor, truth: Tensor) -> tuple[Tensor, Tensor]:
    """Ids of a prediction and of the truth as int64 on the CPU, checked.

    Raises:
        ShapeError: If the sizes differ.
        RangeError: If an id is below -1.
    """
    if predicted.shape != truth.shape:
        raise ShapeError(
            f"predicted: expected the truth's size {tuple(truth.shape)}, "
            f"got {tuple(predicted.shape)}."
        )
    for name, ids in (("predicted", predicted), ("truth", truth)):
        if ids.numel() and int(ids.min()) < UNLABELLED:
            raise RangeError(f"{name}: expected ids of -1 or more, got {int(ids.min())}.")
    return predicted.cpu().long(), truth.cpu().long()


def _image_pair(image: Tensor, truth: Tensor) -> tuple[Tensor, Tensor]:
    if image.shape != truth.shape:
        raise ShapeError(
            f"image: expected the photograph's size {tuple(truth.shape)}, got {tuple(image.shape)}."
        )
    check_finite("image", image)
    check_finite("truth", truth)
    a, b = (x.double() / 255 if x.dtype == torch.uint8 else x.double() for x in (image, truth))
    return a.cpu(), b.cpu()
