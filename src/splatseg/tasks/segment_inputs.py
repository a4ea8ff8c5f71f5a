"""What a method is given: the evidence, views, models and layers that options name, opened."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from splatseg.core import ClassTable, Features, Labels, Layer, Scene, View
from splatseg.core.instance_tree import layer_kind
from splatseg.errors import InputError
from splatseg.evaluate.metrics import psnr
from splatseg.evaluate.photographs import render_and_photograph, scored_pixels
from splatseg.io.evidence import (
    Evidence,
    TrackedEvidence,
    check_map_sizes,
    find_evidence,
    open_evidence,
    without_masked,
)
from splatseg.methods import ANY_COMPANION, Method
from splatseg.render import BackendName
from splatseg.report.fit_report import MIN_PSNR
from splatseg.report.words import counted, spread
from splatseg.tasks.see import model_for
from splatseg.tasks.work import Work, mask_use, photographed

_FIT_VIEWS = 5
_LONGEST = 512
"""Pixels of the longer side in which renders are compared with photographs."""


def trained_features(work: Work, method: Method, options: Any) -> Features | None:
    """The layer that the method's options name to be read again, if they name one."""
    name = None if method.trained is None else getattr(options, method.trained)
    if name is None:
        return None
    layer = work.flat_layer(name)
    if not isinstance(layer, Features):
        raise InputError(
            f"{method.trained}: expected a layer of features, got {name!r} of {layer_kind(layer)}."
        )
    return layer


def named_models(
    method: Method, options: Any, *, report: Callable[[str], None]
) -> dict[str, object]:
    """The models that the method's options name, by option."""
    named = {option: getattr(options, option) for option in method.models}
    return {
        option: model_for(
            option, name, protocol, f"is a {method.models[option].__name__}", report=report
        )
        for option, protocol in method.models.items()
        if (name := named[option]) is not None
    }


def with_companions(work: Work, method: Method, options: Any) -> Any:
    """The options, those that take any companion with the name of one that is at hand.

    Of several, one whose name has ``sam`` in it comes first, then the first by name.
    """
    for option, kinds in method.companions.items():
        if getattr(options, option) != ANY_COMPANION:
            continue
        names = list(work.evidence_of(*kinds))
        if not names:
            wanted = " or ".join(kinds)
            raise InputError(
                f"{option}: expected evidence of {wanted} at hand, got none; make some with "
                f"`splatseg see SCENE --model ...` (docs/models.md says which models give "
                f"{wanted}), or do without by --{option.replace('_', '-')} None."
            )
        name = min(names, key=lambda name: ("sam" not in name, name))
        work.observer.note(f"{option}: {name}, of {len(names)} at hand")
        options = replace(options, **{option: name})
    return options


def named_companions(work: Work, method: Method, options: Any) -> dict[str, Evidence]:
    """The evidence that the method's options name besides, by option."""
    found: dict[str, Evidence] = {}
    for option, kinds in method.companions.items():
        name = getattr(options, option)
        if name is None:
            continue
        evidence = work.known_evidence(name, option=option)
        if evidence.kind not in kinds:
            raise InputError(
                f"{option}: expected evidence of {' or '.join(kinds)}, got {name!r} of "
                f"{evidence.kind}."
            )
        found[option] = evidence
    return found


def evidence_to_lift(
    work: Work, method: Method, name: str | None, *, zero_is_class: bool, void: int | None
) -> tuple[str, Evidence]:
    """The evidence of this name, or else the only one, which the method must take."""
    folder = find_evidence(work.scene.evidence_folders, name)
    evidence = open_evidence(folder, zero_is_class=zero_is_class, void=void)
    method.check_evidence(evidence)
    return folder.name, evidence


def views_to_lift(work: Work, evidence: Evidence, requested: Sequence[str]) -> tuple[View, ...]:
    """The requested views that have evidence; named ones must have it."""
    allowed = work.views(requested)
    check_map_sizes(evidence, allowed)
    if requested[0] not in ("train", "all"):
        return allowed
    known = set(evidence.view_names)
    views = tuple(view for view in allowed if view.name in known)
    if not views:
        raise InputError(
            f"evidence: expected some of at least one of the {len(allowed)} views that "
            f"{requested[0]} allows, got none."
        )
    lacking = [view for view in allowed if view.name not in known]
    # Evidence of the train views alone is as it should be, whatever is allowed.
    if any(view.split == "train" for view in lacking):
        work.observer.note(
            f"{len(lacking)} of {len(allowed)} views have no such evidence, the first is "
            f"{lacking[0].name}"
        )
    return views


def layer_to_update(work: Work, method: Method, name: str) -> Layer:
    """The layer of this name, which the method must have made and can add views to."""
    if method.update is None:
        raise InputError(
            f"update: expected a method that adds views to a layer, {method.name} starts again "
            "with all views."
        )
    layer = work.layer(name, option="update")
    if layer.info.method != method.name and layer.info.method != _FUNCTIONS.get(method.name):
        raise InputError(
            f"update: expected a layer that {method.name} made, {name!r} was made by "
            f"{layer.info.method}."
        )
    if layer.info.views is None:
        raise InputError(f"update: layer {name!r} does not say which views it was made from.")
    return layer


_FUNCTIONS = {"features": "uplift_features"}
"""What layers record where it is not the name of the method."""


def views_to_add(views: Sequence[View], layer: Layer, name: str) -> tuple[View, ...]:
    """The views that a layer does not have."""
    known = set(layer.info.views or ())
    new = tuple(view for view in views if view.name not in known)
    if not new:
        raise InputError(
            f"update: layer {name!r} has all {len(views)} views with evidence already."
        )
    return new


def unmasked(work: Work, evidence: Evidence, views: Sequence[View], view_masks: str) -> Evidence:
    """The evidence without the pixels that masks of views leave out, where they are to."""
    if (mask_use(work.scene) if view_masks == "auto" else view_masks) != "ignore":
        return evidence
    kept = without_masked(evidence, views)
    if kept is not evidence:
        masked = sum(view.mask is not None for view in views)
        work.observer.note(f"masks of {masked} of {len(views)} views leave pixels out")
    return kept


def classes_to_merge(
    work: Work, evidence: Evidence, name: str | None
) -> tuple[Labels, ClassTable] | None:
    """The layer of classes that instances are merged with, and what its ids mean."""
    if name is None:
        return None
    if evidence.kind == "labels":
        raise InputError(f"classes: goes with evidence of instances, not of {evidence.kind}.")
    layer = work.flat_layer(name)
    if not isinstance(layer, Labels):
        raise InputError(f"classes: expected a layer of labels, got {layer_kind(layer)}.")
    table = evidence.maps.table if isinstance(evidence, TrackedEvidence) else evidence.classes
    table = table or work.scene.classes
    if table is None:
        raise InputError(
            "classes: expected a table that says which classes are things, and neither the "
            "capture nor the evidence has one."
        )
    return layer, table


@dataclass(frozen=True, slots=True, kw_only=True)
class FitQuality:
    """How like their photographs a few views of a scene look."""

    psnr: float
    """Mean over the views, dB, at no more than 512 pixels."""

    views: int
    """How many were compared."""

    held_out: bool
    """Whether they were held out of the fit; else it learned from them."""

    @property
    def warning(self) -> str | None:
        """A sentence, without a full stop, where the scene is too poor to carry labels."""
        if self.psnr >= MIN_PSNR:
            return None
        split = "held-out" if self.held_out else "training"
        views = counted(self.views, f"{split} view")
        return (
            f"this scene is too poor to carry labels well: its renders have {self.psnr:.1f} dB "
            f"PSNR on {views}; below {MIN_PSNR:g} dB a fifth to two thirds of the mIoU was lost in "
            "scenes of known truth; fit it longer"
        )


def fit_quality(scene: Scene, *, backend: BackendName = "auto") -> FitQuality | None:
    """Compare a few renders with their photographs: held-out views, else training views.

    Args:
        scene: The scene.
        backend: Rendering backend.

    Returns:
        None where no view has a photograph that is there.

    Raises:
        FileFormatError: If a photograph cannot be read or has not its camera's size.
        InputError: If masks leave nothing to compare.
    """
    held_out = spread(photographed(scene.test_views), _FIT_VIEWS)
    views = held_out or spread(photographed(scene.train_views), _FIT_VIEWS)
    if not views or not len(scene.gaussians):
        return None
    work = Work(scene=scene, backend=backend)
    scores = [score for view in views if (score := _view_psnr(work, view)) is not None]
    if not scores:
        raise InputError(f"views: expected pixels to score, but masks keep none of {len(views)}.")
    mean = math.fsum(scores) / len(scores)
    return FitQuality(psnr=mean, views=len(scores), held_out=bool(held_out))


def _view_psnr(work: Work, view: View) -> float | None:
    """As `evaluate_photographs` scores it; None where its mask keeps nothing."""
    masks = mask_use(work.scene)
    pictures = render_and_photograph(work.field(), view, masks=masks, longest=_LONGEST)
    keep = scored_pixels(view, masks=masks, longest=_LONGEST)
    return None if keep is not None and not keep.any() else psnr(*pictures, keep)


def check_fit(work: Work) -> tuple[str, ...]:
    """Tell where the scene is too poor to carry labels, or cannot be compared with photographs."""
    try:
        quality = fit_quality(work.scene, backend=work.backend)
        warning = None if quality is None else quality.warning
    except InputError as error:
        warning = f"the scene was not held against its photographs: {str(error).rstrip('.')}"
    if warning is None:
        return ()
    work.observer.note(warning)
    return (f"{warning}.",)
