"""Label maps of layers in views: of labels, and of features with their classifier."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, cast, get_args

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from splatseg._check import check_choice, check_rows, check_shape
from splatseg.core import JSON, UNLABELLED, Camera, Features, Gaussians, LabelMap, Labels, LayerInfo
from splatseg.core.boundary import boundary
from splatseg.errors import InputError, ShapeError
from splatseg.render import PreparedView, Rendered, RenderOptions, SparseSignal, prepare
from splatseg.render.warp import WarpMode


class ViewRenderer:
    """Renders signals of Gaussians in one view, without gradients.

    Args:
        gaussians: The Gaussians of the view.
        view: The view; it stays open as long as this is used.
    """

    def __init__(self, gaussians: Gaussians, view: PreparedView) -> None:
        self._gaussians = gaussians
        self.view: PreparedView = view
        """The view itself."""

    @property
    def size(self) -> tuple[int, int]:
        """Height and width."""
        return self.view.camera.height, self.view.camera.width

    def render(
        self, signal: Float[Tensor, "n channels"] | None, *, warp: WarpMode = "bilinear"
    ) -> Rendered:
        """``W @ signal``, on the device of the Gaussians; None is the colour."""
        on_device = None if signal is None else signal.to(self._gaussians.means)
        with torch.no_grad():
            return self.view.render(on_device, warp=warp)

    def scores(
        self, signal: Float[Tensor, "n channels"], *, warp: WarpMode = "bilinear"
    ) -> tuple[Float[Tensor, "height width channels"], Float[Tensor, "height width"]]:
        """The image and alpha."""
        rendered = self.render(signal, warp=warp)
        return rendered.image.float().cpu(), rendered.alpha.float().cpu()


@boundary
def label_map(
    gaussians: Gaussians,
    camera: Camera,
    labels: Labels,
    *,
    options: RenderOptions | None = None,
    backend: str = "auto",
) -> LabelMap:
    r"""The label map that a layer has in a view, in the pixels of any camera.

    A pixel's id is the one with the largest blending weight:

    .. math:: s_c(p) = \sum_i w_{pi}\, a_{ic} + [c = b] \Bigl(1 - \sum_i w_{pi}\Bigr), \qquad
              \mathrm{id}(p) = \arg\max_c s_c(p)

    where :math:`a_{ic}` is 1 for the label of Gaussian i and 0 else (a hard layer), or its share of
    the evidence (a soft layer). No label, -1, competes as one more id: a hard layer's unlabelled
    Gaussians stand for it, a soft layer's missing shares. The transmittance behind all Gaussians
    stands for the layer's background label b, and for no label where it has none.

    One pass, whose time and memory do not grow with the number of ids (`PreparedView.argmax`).
    Ties go to the smaller id, and -1 loses every tie. With lens distortion a pixel of the
    photograph takes the id of the pinhole pixel that its centre falls into.

    Args:
        gaussians: The Gaussians of the scene.
        camera: Any camera.
        labels: Their labels, one row a Gaussian; soft where it has candidates.
        options: Switches of the blending model.
        backend: Name of the rendering backend.

    Returns:
        Ids, and as confidence the winner's score, its share of the pixel's weight in [0, 1].

    Raises:
        ShapeError: If `labels` has another number of rows than `gaussians`.
    """
    check_rows("labels", labels, len(gaussians))
    with prepare(gaussians, camera, options=options, backend=backend) as view:
        return view_label_map(view, labels)


def view_label_map(view: PreparedView, labels: Labels) -> LabelMap:
    """`label_map` of a view that is prepared, for any number of layers."""
    if view.part is not None:
        # The ids of what was read for the view are all that it can show.
        labels, view = labels[view.part.rows], view.part.view()
    named = labels.ids if labels.candidates is None else labels.candidates
    ids = torch.unique(torch.cat((torch.unique(named.cpu()), torch.tensor([labels.background]))))
    none = torch.tensor([UNLABELLED])
    ids = torch.cat((ids[ids != UNLABELLED], none)).long()  # behind the ids: it loses ties
    background = int(torch.nonzero(ids == labels.background)[0])
    found = view.argmax(_signal(labels, ids), background=background)
    winner = ids.to(torch.int32)[found.channels.long()]
    return LabelMap(ids=winner, confidence=found.values.clamp(0, 1))


def _signal(labels: Labels, ids: Int64[Tensor, "m"]) -> SparseSignal:
    """The entries of a, with the ids by their index; the last, -1, has what no id claims."""
    if labels.candidates is None or labels.shares is None:
        return SparseSignal(channels=_indices(labels.ids.cpu().unsqueeze(1), ids), count=len(ids))
    candidates, shares = labels.candidates.cpu(), labels.shares.float().cpu()
    known = candidates != UNLABELLED
    unclaimed = (1 - (shares * known).sum(dim=1, keepdim=True)).clamp_min(0)
    none = torch.full((len(labels), 1), len(ids) - 1, dtype=torch.int32)
    named = torch.where(known, _indices(candidates, ids), -1)
    return SparseSignal(
        channels=torch.cat((named, none), dim=1),
        values=torch.cat((shares, unclaimed), dim=1),
        count=len(ids),
    )


def _indices(of: Tensor, ids: Int64[Tensor, "m"]) -> Tensor:
    """Indices into `ids`, which ascend but for the last, -1."""
    found = torch.searchsorted(ids[:-1], of.long().contiguous())
    return torch.where(of == UNLABELLED, len(ids) - 1, found).to(torch.int32)


Blend = Literal["features", "probabilities"]
_ROWS = 65536
"""Gaussians classified at a time."""
_CHANNELS = 32
"""Classes drawn at a time."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ClassifierHead:
    r"""Reads ids out of features.

    There are two ways from features :math:`f_i` to the ids of a pixel (`ClassifierHead.blend`):
    render the features and classify what is seen, or classify every Gaussian and render that,

    .. math:: \arg\max_c \; \Bigl(A \sum_i w_{pi} f_i + b\Bigr)_c \qquad \text{or} \qquad
              \arg\max_c \sum_i w_{pi} \, \mathrm{softmax}(A f_i + b)_c .

    Sums of logits are unbounded: one Gaussian that is very sure outvotes all others of a pixel.
    Probabilities are not.
    """

    ids: Int64[Tensor, "classes"]
    """The id of each class."""

    weight: Float[Tensor, "classes channels"] | None
    """A; None where features are logits of the classes."""

    bias: Float[Tensor, "classes"] | None
    """b; None is 0."""

    blend: Blend
    """What is rendered: features, or the probabilities of Gaussians."""

    def __post_init__(self) -> None:
        check_shape("ids", self.ids, (None,))
        if self.weight is not None:
            check_shape("weight", self.weight, (len(self.ids), None))
        if self.bias is not None:
            check_shape("bias", self.bias, (len(self.ids),))
        check_choice("blend", self.blend, get_args(Blend))

    @property
    def background(self) -> int:
        """The id of pixels that nothing covers, -1 for none.

        Where features are rendered, the classifier reads zeros there.
        """
        if self.blend == "probabilities" or not len(self.ids):
            return UNLABELLED
        return int(self.ids[0 if self.bias is None else int(self.bias.argmax())])

    def logits(self, features: Float[Tensor, "m channels"]) -> Float[Tensor, "m classes"]:
        """``A f + b`` of features, rendered or of Gaussians."""
        return self._logits_of(features, slice(None))

    def _logits_of(self, features: Tensor, classes: slice) -> Tensor:
        """The logits of some classes, whatever the axes before the channels."""
        weight, bias = self.weight, self.bias
        found = features[..., classes] if weight is None else features @ weight[classes].T
        return found if bias is None else found + bias[classes]

    def probabilities(self, features: Float[Tensor, "m channels"]) -> Float[Tensor, "m classes"]:
        """The softmax of the logits."""
        return torch.softmax(self.logits(features), dim=-1)

    def labels(
        self, features: Features, *, min_share: float = 0.0, info: LayerInfo | None = None
    ) -> Labels:
        """The hard readout: each Gaussian's most likely id, with its probability as confidence.

        Gaussians with a weight of 0 and those below `min_share` have the id -1. The labels have
        the `info` that is given, or that of the features without the head.
        """
        count = len(features)
        seen = torch.ones(count) if features.weights is None else features.weights
        index = torch.zeros(count, dtype=torch.int64)
        share = torch.zeros(count)
        for start in range(0, count, _ROWS):
            rows = slice(start, start + _ROWS)
            share[rows], index[rows] = self.probabilities(features.values[rows]).max(dim=-1)
        sure = (seen > 0) & (share >= min_share)
        return Labels(
            ids=torch.where(sure, self.ids[index], UNLABELLED),
            confidence=torch.where(sure, share.clamp(0, 1), 0.0),
            evidence=seen,
            info=replace(features.info, head=None) if info is None else info,
        )

    def label_map(
        self,
        gaussians: Gaussians,
        camera: Camera,
        features: Features,
        *,
        options: RenderOptions | None = None,
        backend: str = "auto",
    ) -> LabelMap:
        """The rendered readout: the label map of a view.

        Where features are rendered, pixels that nothing covers have the label that the
        classifier gives to nothing, its largest bias. Where probabilities are, the light that
        passes, and that of Gaussians with a weight of 0, stands for no label and competes.

        Raises:
            ShapeError: If `gaussians` has another number of rows than `features`.
        """
        if len(gaussians) != len(features):
            raise ShapeError(
                f"gaussians: expected {len(features)}, one a feature, got {len(gaussians)}."
            )
        with prepare(gaussians, camera, options=options, backend=backend) as view:
            return self.view_label_map(ViewRenderer(gaussians, view), features)

    def view_label_map(
        self,
        view: ViewRenderer,
        features: Features,
        *,
        log_totals: Float[Tensor, "n"] | None = None,
    ) -> LabelMap:
        """`label_map` of a view that is prepared, for any number of layers.

        Args:
            view: The view of the Gaussians that have the features.
            features: One row a Gaussian.
            log_totals: `log_totals` of the features, where they are kept from view to view.
        """
        if not len(self.ids):
            raise InputError("ids: expected at least one class, got none.")
        if self.blend == "features":
            return self._of_rendered_features(view, features)
        totals = self.log_totals(features) if log_totals is None else log_totals
        return self._of_rendered_probabilities(view, features, totals)

    def log_totals(self, features: Features) -> Float[Tensor, "n"]:
        """The logarithm of the sum of exponentials of each Gaussian's logits."""
        totals = torch.empty(len(features))
        for start in range(0, len(features), _ROWS):
            rows = slice(start, start + _ROWS)
            totals[rows] = torch.logsumexp(self.logits(features.values[rows]), dim=-1)
        return totals

    def _of_rendered_features(self, view: ViewRenderer, features: Features) -> LabelMap:
        rendered = None
        if self.weight is not None:
            rendered, _ = view.scores(features.values, warp="nearest")
        best = torch.full(view.size, -torch.inf)
        total = torch.full(view.size, -torch.inf)
        index = torch.zeros(view.size, dtype=torch.int64)
        for start in range(0, len(self.ids), _CHANNELS):
            classes = slice(start, start + _CHANNELS)
            if rendered is None:
                logits, _ = view.scores(features.values[:, classes], warp="nearest")
                logits = logits if self.bias is None else logits + self.bias[classes]
            else:
                logits = self._logits_of(rendered, classes)
            logit, column = logits.max(dim=-1)
            index = torch.where(logit > best, column + start, index)
            best = torch.maximum(logit, best)
            total = torch.logaddexp(total, torch.logsumexp(logits, dim=-1))
        return LabelMap(
            ids=self.ids[index].to(torch.int32), confidence=(best - total).exp().clamp(0, 1)
        )

    def _of_rendered_probabilities(
        self, view: ViewRenderer, features: Features, log_totals: Float[Tensor, "n"]
    ) -> LabelMap:
        best = torch.full(view.size, -1.0)
        claimed = torch.zeros(view.size)
        index = torch.zeros(view.size, dtype=torch.int64)
        for start in range(0, len(self.ids), _CHANNELS):
            classes = slice(start, start + _CHANNELS)
            logits = self._logits_of(features.values, classes)
            probabilities = (logits - log_totals[:, None]).exp()
            if features.weights is not None:
                probabilities[features.weights <= 0] = 0
            rendered, _ = view.scores(probabilities, warp="nearest")
            score, column = rendered.max(dim=-1)
            claimed = claimed + rendered.sum(dim=-1)
            index = torch.where(score > best, column + start, index)
            best = torch.maximum(score, best)
        # No label loses ties.
        labelled = best >= 1 - claimed
        return LabelMap(
            ids=torch.where(labelled, self.ids[index], UNLABELLED).to(torch.int32),
            confidence=torch.where(labelled, best, 1 - claimed).clamp(0, 1),
        )

    def to_json(self) -> dict[str, JSON]:
        """The head in values that JSON holds, for the info of a layer of features."""
        return {
            "blend": self.blend,
            "ids": self.ids.tolist(),
            "weight": None if self.weight is None else self.weight.tolist(),
            "bias": None if self.bias is None else self.bias.tolist(),
        }

    @classmethod
    def of(cls, features: Features) -> "ClassifierHead":
        """The head that a layer of features holds in its info. Inverse of `to_json`.

        Raises:
            InputError: If it holds none.
        """
        found = cast("Mapping[str, Any] | None", features.info.head)
        if found is None or not has_classifier(features):
            raise InputError("features: expected a layer with a classifier head, got one without.")
        weight, bias = found.get("weight"), found.get("bias")
        try:
            return cls(
                ids=torch.tensor(_numbers(found["ids"]), dtype=torch.int64),
                weight=None if weight is None else torch.tensor(weight, dtype=torch.float32),
                bias=None if bias is None else torch.tensor(bias, dtype=torch.float32),
                blend=found["blend"],
            )
        except (TypeError, ValueError) as error:
            raise InputError(
                f"features: expected a classifier head, got one that cannot be read ({error})."
            ) from error


def has_classifier(features: Features) -> bool:
    """Whether a layer of features holds a classifier head, by which it is read as labels."""
    found = features.info.head
    return found is not None and {"ids", "blend"} <= set(found)


def _numbers(values: Any) -> Sequence[int]:
    return [int(value) for value in values]
