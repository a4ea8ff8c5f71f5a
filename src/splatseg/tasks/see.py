"""A 2D model looks at a scene's photographs, and what it sees is written down."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from splatseg.core import Model, Scene
from splatseg.core.boundary import boundary, convert_fields
from splatseg.errors import InputError
from splatseg.io.scene import check_name
from splatseg.models import ModelCache, SeenEvidence, find_model, record_evidence
from splatseg.models.classical import Classical, RegionOptions
from splatseg.models.recorded import AnyRecorded, recorded_model
from splatseg.tasks._observer import SILENT, Observer
from splatseg.tasks.scene_parts import views_asked, views_recorded

EVIDENCE_FOLDER = "evidence"

What = Literal["masks", "labels", "panoptic", "features", "text"]
"""What a model can be asked for."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SeeOptions:
    """What a model is asked, of which views, and what is kept."""

    what: What | None = None
    """What to ask the model for. None takes what it has, masks before the others."""

    views: tuple[str, ...] = ("train",)
    """Which views: train, all, or names of views. It is recorded with the evidence."""

    allow_missing: bool = False
    """Take the views that recorded evidence has, where some that are asked for are missing."""

    zero_is_class: bool = False
    """The id 0 of recorded label maps is a class and not void: ids grow by 1."""

    void: int | None = None
    """A further id of recorded label maps that means none, such as 255."""

    cache: Path | None = None
    """Folder where the model's answers are kept by the content of the photographs, for other
    scenes of them."""

    precision: Literal["float16", "int8"] = "float16"
    """How features are kept in the cache."""

    overwrite: bool = False
    """Delete evidence of this name first."""

    def __post_init__(self) -> None:
        convert_fields(self)


@boundary
def see(
    scene: Scene,
    model: str | Model,
    evidence: str,
    *,
    options: SeeOptions | None = None,
    regions: RegionOptions | None = None,
    observer: Observer = SILENT,
) -> SeenEvidence:
    """Write what a model sees in views to SCENE/evidence/NAME, a file a view.

    A call that was stopped, by an exception out of the observer too, has written whole views;
    the same call again does the rest.

    Args:
        scene: The scene, read from its folder.
        model: The model; or the name of one, or a folder of evidence recorded elsewhere.
        evidence: Name of the evidence to write.
        options: What is asked.
        regions: Settings of the masks of the model ``classical``.
        observer: Is told of the progress.

    Raises:
        InputError: If there is no such model, it cannot be asked this, the scene has no such
            views, or other evidence of this name is there.
        FileFormatError: If recorded evidence is broken or has not the photograph's size.
    """
    options = options or SeeOptions()
    check_name("evidence", evidence)
    if scene.root is None:
        raise InputError("scene: expected one that was read from its folder, got one without.")
    views = views_asked(scene, options.views)
    found = _model(model, options, regions)
    cache = None
    if options.cache is not None:
        cache = ModelCache(folder=options.cache, precision=options.precision, report=observer.note)
    if found.note:
        observer.note(f"{found.name}: {found.note}")
    folder = scene.root / EVIDENCE_FOLDER / evidence
    folder.parent.mkdir(exist_ok=True)
    with observer.stage("see") as step:
        seen = record_evidence(
            found,
            views,
            folder,
            what=options.what,
            asked=views_recorded(options.views),
            overwrite=options.overwrite,
            missing="skip" if options.allow_missing else "refuse",
            cache=cache,
            progress=step,
        )
    for note in seen.notes:
        observer.note(note)
    if cache is not None:
        observer.note(f"{cache.folder}: {cache.size()}")
    return seen


def _model(asked: str | Model, options: SeeOptions, regions: RegionOptions | None) -> Model:
    """The model with its settings; settings that it does not have are refused."""
    model = find_model(asked) if isinstance(asked, str) else asked
    name = asked if isinstance(asked, str) else model.name
    if not isinstance(model, Classical) and regions not in (None, RegionOptions()):
        raise InputError(f"expected settings of regions with model classical, got model {name}.")
    if isinstance(model, AnyRecorded) and isinstance(asked, str):
        kind = "masks" if options.what == "masks" else None
        return recorded_model(
            name, kind=kind, zero_is_class=options.zero_is_class, void=options.void
        )
    if options.zero_is_class or options.void is not None:
        raise InputError(
            f"zero_is_class, void: expected with recorded label maps, got model {name}."
        )
    if isinstance(model, Classical) and regions is not None:
        return Classical(regions=regions)
    return model
