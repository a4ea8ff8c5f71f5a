r"""Sharpening: positions, shapes and opacities refined by photographs and label maps.

A fit on photographs alone does not care whether a Gaussian reaches from one thing over another
of the same colour, or whether a thing lets a little of what is behind it through. Labels do. So
Gaussians go on learning from the photographs and, beside them, from the label maps: of the weight
of a pixel as much as possible shall be that of Gaussians of the pixel's id,

.. math:: L = L_{\mathrm{photo}} + \lambda \, \frac{1}{|P|} \sum_{p \in P}
          \Bigl(1 - \sum_{i:\, l_i = y(p)} w_{pi}\Bigr)

over the pixels P that have an id y. COB-GS (Zhang et al. 2025) learns a mask value of each
Gaussian by this loss for one mask, splits those that both sides pull at, and fits colours again.
Here the labels are decided in closed form (`uplift`), all of them at once, and the loss is one
of positions, shapes and opacities: what two sides pull at moves, shrinks or becomes opaque.

With more than a few ids the sum is not rendered for each of them. Every step gives each id a random
code c of +1 and -1 in K channels and renders the codes of the Gaussians' labels; as
:math:`E[c_a \cdot c_b] = K [a = b]`,

.. math:: \sum_{i:\, l_i = y} w_{pi} =
          E\Bigl[\tfrac{1}{K}\, c_{y} \cdot \sum_i w_{pi} c_{l_i}\Bigr],

so that K channels have the right gradient on average, whatever the number of ids.

Pixels whose id the layer does not show anywhere near do not count: a model that errs alike in many
views would bend the geometry to its errors.

References:
    Zhang et al., COB-GS: Clear Object Boundaries in 3DGS Segmentation Based on Boundary-Adaptive
    Gaussian Splitting, CVPR 2025.
"""

import math
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Annotated

import numpy as np
import torch
from jaxtyping import Bool, Int32, Int64
from msgspec import Meta
from torch import Tensor

from splatseg.core import UNLABELLED, Gaussians, LabelMap, Labels, LabelSource, View, camera_of_map
from splatseg.core.boundary import boundary
from splatseg.core.options import Natural, NonNegative, options
from splatseg.errors import InputError
from splatseg.fit import Exposure, FitOptions, Refinement
from splatseg.lift.label_maps import label_map
from splatseg.lift.voting.confusion import (
    CANDIDATES,
    DEFAULT_CONFUSION,
    ConfusionOptions,
    correct_confusion,
)
from splatseg.lift.voting.uplift import UpliftOptions, uplift, voting_views
from splatseg.render import render

DECIDE_EVERY = 200
"""Steps after which labels are decided again."""

_CODES = 4
"""K: channels of the random codes. More is less noise for more time."""

_RATES_FROM = 0.6
"""Progress of a fit whose learning rates the first step has; the last has those of a fit's end."""


@options(
    removed={
        "decide_every": "labels are decided again every 200 steps",
        "codes": "four channels of codes are rendered",
        "rates_from": "learning rates begin as they are at 0.6 of a fit",
    }
)
class SharpenOptions:
    """How labels sharpen the geometry."""

    sharpen_steps: Natural = 400
    """Steps, each from one photograph and its label map; 0 leaves the Gaussians as they are."""

    label_weight: NonNegative = 0.1
    """Lambda: weight of the label maps beside the photographs. 1 is cleanest, and costs most
    image quality."""

    trust_pixels: Annotated[int, Meta(ge=-1)] = 2
    """Distance in pixels, along each axis, within which the layer, as it was, must show the id of
    a pixel of the label maps for that pixel to count: it moves a boundary, and does not contradict
    all other views. -1 lets all pixels count."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sharpened:
    """Refined Gaussians, row by row those of before."""

    gaussians: Gaussians

    labels: Labels
    """Their labels, soft, decided from the same label maps."""

    agreement: tuple[float, float]
    """Before and after: share of the weight of labelled pixels, in [0, 1], that is that of
    Gaussians of the pixel's id."""

    exposures: Mapping[str, Exposure] = field(default_factory=dict[str, Exposure])
    """Of the views that were learned from; empty without `FitOptions.exposure`."""


@boundary
def sharpen(
    gaussians: Gaussians,
    views: Sequence[View],
    evidence: LabelSource,
    *,
    options: SharpenOptions | None = None,
    confusion: ConfusionOptions | None = DEFAULT_CONFUSION,
    fit_options: FitOptions | None = None,
    exposures: Mapping[str, Exposure] | None = None,
    seed: int = 0,
    backend: str = "auto",
    progress: Callable[[int, int], None] | None = None,
) -> Sharpened:
    """Fit Gaussians to photographs and label maps together, so that each is of one thing.

    Their number and order stay: layers stay in step. The result depends on the seed and not on
    the order of the views or the number of threads.

    Args:
        gaussians: The Gaussians of the scene.
        views: Views with photographs and label maps. Only these are used.
        evidence: Their label maps, with ids that mean the same in all views (`MatchedMaps` for
            segments); pixels at -1 do not count.
        options: How long, and how much labels count.
        confusion: How the evidence errs, see `correct_confusion`; None takes the majority.
        fit_options: How the photographs are compared (see `refinement_options`), and rates. Its
            seed is not used, and the poses of the views stay as they are: the label maps are
            rendered with them.
        exposures: Where exposures begin, for ``fit_options.exposure``, by name of the view.
        seed: Order of views and codes.
        backend: Name of the rendering backend.
        progress: Called with the steps done and all there are.

    Raises:
        InputError: If there are no views, one has no photograph or no label map, or no pixel has
            a label.
        ShapeError: If a label map does not have its photograph's proportions.
    """
    options = options or SharpenOptions()
    update = _LabelUpdate(
        views=_photographed(views, evidence),
        label_maps=CachedLabelMaps(evidence),
        votes=UpliftOptions(candidates=2 if confusion is None else CANDIDATES),
        confusion=confusion,
        backend=backend,
    )
    fit = replace(fit_options or FitOptions(), seed=seed, refine_poses=False)
    return _refined(gaussians, update, options, fit, exposures=exposures, progress=progress)


def _photographed(views: Sequence[View], evidence: LabelSource) -> list[View]:
    """The views in the order of their names, if all have a label map and a photograph."""
    ordered = voting_views(views, evidence, "a label map")
    for view in ordered:
        if view.image is None:
            raise InputError(f"views: expected a photograph of each, {view.name} has none.")
    return ordered


def _refined(
    gaussians: Gaussians,
    update: "_LabelUpdate",
    options: SharpenOptions,
    fit: FitOptions,
    *,
    exposures: Mapping[str, Exposure] | None,
    progress: Callable[[int, int], None] | None,
) -> Sharpened:
    """Fit with the loss of the label maps; labels are decided again every few steps."""
    labels, before = update.labels(gaussians)
    after = before
    trusted = update.trusted(gaussians, labels, options.trust_pixels)
    refinement = Refinement(
        gaussians,
        update.views,
        steps=options.sharpen_steps,
        start=_RATES_FROM,
        options=fit,
        exposures=exposures,
        backend=update.backend,
    )
    for done in range(options.sharpen_steps):
        generator = refinement.generator
        loss = LabelLoss(trusted, labels.ids.cpu(), options, generator, update.backend)
        refinement.step(loss)
        last = done + 1 == options.sharpen_steps
        if last or (done + 1) % DECIDE_EVERY == 0:
            gaussians = refinement.gaussians()
            labels, after = update.labels(gaussians)
        if progress is not None:
            progress(done + 1, options.sharpen_steps)
    record = {"options": asdict(options), "seed": fit.seed, "agreement": [before, after]}
    info = labels.info.with_edit("sharpen", record)
    return Sharpened(
        gaussians=gaussians,
        labels=replace(labels, info=info),
        agreement=(before, after),
        exposures=refinement.exposures,
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _LabelUpdate:
    """Decides labels from the votes of views, whenever Gaussians changed."""

    views: Sequence[View]
    label_maps: "CachedLabelMaps"
    votes: UpliftOptions
    confusion: ConfusionOptions | None
    backend: str

    def labels(self, gaussians: Gaussians) -> tuple[Labels, float]:
        """Labels by the votes of all views, and how many of the votes agree with them."""
        votes = uplift(
            gaussians, self.views, self.label_maps, options=self.votes, backend=self.backend
        )
        labels = votes
        if self.confusion is not None:
            correlation = votes.info.view_correlation
            labels = correct_confusion(votes, options=self.confusion, view_correlation=correlation)
        return labels, _agreement(votes, labels)

    def trusted(self, gaussians: Gaussians, labels: Labels, pixels: int) -> "CachedLabelMaps":
        """The label maps without what contradicts the layer; all of them where pixels is -1."""
        if pixels < 0:
            return self.label_maps
        hard = replace(labels, candidates=None, shares=None)
        by_name = {view.name: view for view in self.views}
        return CachedLabelMaps(
            TrustedLabelMaps(self.label_maps, gaussians, by_name, hard, pixels, self.backend)
        )


def _agreement(votes: Labels, labels: Labels) -> float:
    """Share of all votes that went to the label their Gaussian has."""
    if votes.candidates is None or votes.shares is None or votes.evidence is None:
        return math.nan
    own = (votes.shares * (votes.candidates == labels.ids[:, None])).sum(1).double()
    own = torch.where(labels.ids == UNLABELLED, 0.0, own)
    mass = votes.evidence.double()
    return float((own * mass).sum() / mass.sum().clamp_min(1e-12))


@dataclass(frozen=True, slots=True, eq=False)
class CachedLabelMaps:
    """Label maps, compressed once they were made: some are rendered each time."""

    source: LabelSource
    kept: dict[str, tuple[tuple[int, ...], bytes, bytes | None]] = field(default_factory=dict)
    ids: set[int] = field(default_factory=set[int])
    """All ids of the maps that are kept."""

    @property
    def view_names(self) -> Sequence[str]:
        """Views of the source."""
        return self.source.view_names

    def label_map(self, name: str) -> LabelMap:
        """The map of a view, decompressed."""
        if name not in self.kept:
            view_map = self.source.label_map(name)
            self.ids.update(torch.unique(view_map.ids).tolist())
            shape = (view_map.height, view_map.width)
            confidence = view_map.confidence
            packed = None if confidence is None else _compressed(confidence.float())
            self.kept[name] = (shape, _compressed(view_map.ids), packed)
        shape, ids, packed = self.kept[name]
        confidence = None if packed is None else _decompressed(packed, np.float32, shape)
        return LabelMap(ids=_decompressed(ids, np.int32, shape), confidence=confidence)

    def state(self, names: Sequence[str]) -> dict[str, Tensor]:
        """The maps of some views as they are kept, for a checkpoint."""
        sizes: list[tuple[int, ...]] = []
        blocks: list[bytes] = []
        for name in names:
            shape, ids, confidence = self.kept[name]
            sizes.append((*shape, len(ids), len(confidence or b"")))
            blocks += [ids, confidence or b""]
        maps = np.frombuffer(b"".join(blocks), np.uint8).copy()
        return {"maps": torch.from_numpy(maps), "sizes": torch.tensor(sizes).reshape(-1, 4)}

    def restore(self, names: Sequence[str], tensors: Mapping[str, Tensor]) -> None:
        """Keep what `state` returned of the same views, instead of what the source has."""
        maps, at = tensors["maps"].numpy().tobytes(), 0
        for name, row in zip(names, tensors["sizes"].tolist(), strict=True):
            height, width, ids, confidence = row
            packed = maps[at + ids : at + ids + confidence] or None
            self.kept[name] = ((height, width), maps[at : at + ids], packed)
            self.ids.update(torch.unique(self.label_map(name).ids).tolist())
            at += ids + confidence


@dataclass(frozen=True, slots=True, eq=False)
class TrustedLabelMaps:
    """Label maps without the pixels that contradict what a layer shows around them."""

    label_maps: CachedLabelMaps
    gaussians: Gaussians
    views: Mapping[str, View]
    labels: Labels
    pixels: int
    backend: str

    @property
    def view_names(self) -> Sequence[str]:
        """Views of the label maps."""
        return self.label_maps.view_names

    def label_map(self, name: str) -> LabelMap:
        """The map of a view, without what the layer does not show near."""
        view_map = self.label_maps.label_map(name)
        camera = camera_of_map(self.views[name], view_map.height, view_map.width)
        rendered = label_map(self.gaussians, camera, self.labels, backend=self.backend).ids
        shown = shown_near(view_map.ids, rendered, self.pixels)
        return LabelMap(
            ids=torch.where(shown, view_map.ids, UNLABELLED), confidence=view_map.confidence
        )


def shown_near(
    ids: Int32[Tensor, "height width"], rendered: Int32[Tensor, "height width"], pixels: int
) -> Bool[Tensor, "height width"]:
    """Where `rendered` has the pixel's own id at most so many pixels away along each axis."""
    height, width = ids.shape
    # No pixel has the id -2.
    around = torch.nn.functional.pad(rendered, (pixels,) * 4, value=-2)
    found = torch.zeros(ids.shape, dtype=torch.bool)
    for down in range(2 * pixels + 1):
        for across in range(2 * pixels + 1):
            found |= around[down : down + height, across : across + width] == ids
    return found


def _compressed(values: Tensor) -> bytes:
    return zlib.compress(values.cpu().contiguous().numpy().tobytes(), 1)


def _decompressed(compressed: bytes, kind: type[np.generic], shape: tuple[int, ...]) -> Tensor:
    return torch.from_numpy(np.frombuffer(zlib.decompress(compressed), kind).reshape(shape).copy())


@dataclass(frozen=True, slots=True, eq=False)
class LabelLoss:
    """The second term of the loss, for one step."""

    label_maps: CachedLabelMaps
    labels: Int32[Tensor, "n"]
    options: SharpenOptions
    generator: torch.Generator
    backend: str

    def __call__(self, view: View, gaussians: Gaussians, rows: Int64[Tensor, "m"]) -> Tensor:
        """Weight times the share of the light that is missing."""
        view_map = self.label_maps.label_map(view.name)
        own = self.labels[rows.cpu()]
        known = self.label_maps.ids | {UNLABELLED, *torch.unique(own).tolist()}
        ids = torch.tensor(sorted(known), dtype=torch.int32)
        codes = 2.0 * torch.randint(0, 2, (len(ids), _CODES), generator=self.generator)
        codes -= 1
        # What has no label agrees with nothing.
        codes[ids == UNLABELLED] = 0
        signal = codes[torch.searchsorted(ids, own)].to(gaussians.means)
        rendered = render(
            gaussians,
            camera_of_map(view, view_map.height, view_map.width),
            signal,
            backend=self.backend,
        ).image
        weight = (view_map.ids != UNLABELLED).float()
        if view_map.confidence is not None:
            weight = weight * view_map.confidence
        wanted = codes[torch.searchsorted(ids, view_map.ids)] * weight.unsqueeze(-1)
        agreement = (rendered * wanted.to(rendered)).sum() / _CODES
        total_weight = float(weight.sum())
        return self.options.label_weight * (1 - agreement / max(total_weight, 1.0))
