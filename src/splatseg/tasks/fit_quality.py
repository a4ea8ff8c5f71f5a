"""Whether a scene looks enough like its photographs to carry labels."""

from dataclasses import dataclass

from splatseg.core import Scene, View
from splatseg.evaluate import evaluate_photographs
from splatseg.lift import GaussianField
from splatseg.render import BackendName
from splatseg.report.fit_report import MIN_PSNR
from splatseg.report.words import counted
from splatseg.tasks.scene_parts import mask_use

_VIEWS = 5
_LONGEST = 512


@dataclass(frozen=True, slots=True, kw_only=True)
class FitQuality:
    """How like their photographs a few views of a scene look."""

    psnr: float
    """Mean over the views, dB, at no more than 512 pixels."""

    views: int
    """How many were looked at."""

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
    """Hold a few renders against their photographs: held-out views, else training views.

    Args:
        scene: The scene.
        backend: Who renders.

    Returns:
        None where no view has a photograph that is there.

    Raises:
        FileFormatError: If a photograph cannot be read or has not its camera's size.
        InputError: If masks leave nothing to compare.
    """
    held_out = _spread(scene.test_views)
    views = held_out or _spread(scene.train_views)
    if not views or not len(scene.gaussians):
        return None
    report = evaluate_photographs(
        GaussianField(scene.gaussians, backend=backend),
        views,
        masks=mask_use(scene),
        longest=_LONGEST,
    )
    return FitQuality(psnr=report.psnr, views=len(report.views), held_out=bool(held_out))


def _spread(views: tuple[View, ...]) -> tuple[View, ...]:
    """A few of the views whose photographs are there, spread over them."""
    there = [view for view in views if view.image is not None and view.image.is_file()]
    count = min(_VIEWS, len(there))
    return tuple(there[i * len(there) // count] for i in range(count))
