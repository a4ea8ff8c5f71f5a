"""A 2D model looks at a scene's photographs, and what it sees is written down."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

from splatseg.core import Model, Scene, View
from splatseg.core.boundary import boundary, convert_fields
from splatseg.errors import InputError
from splatseg.io.evidence import (
    RENDERS_FOLDER,
    Evidence,
    EvidenceKind,
    find_evidence,
    open_evidence,
)
from splatseg.io.scene import check_name
from splatseg.io.scene_folder import scene_path, work_on_scene
from splatseg.models import (
    EvidenceRequest,
    LoadOptions,
    ModelCache,
    SeenEvidence,
    TrackingOptions,
    What,
    find_model,
    model_names,
    record_evidence,
)
from splatseg.models.recorded import recorded_model
from splatseg.render import BackendName
from splatseg.tasks._observer import SILENT, Observer
from splatseg.tasks._view_images import ViewImages
from splatseg.tasks.scene_parts import views_asked, views_recorded

EVIDENCE_FOLDER = "evidence"


@dataclass(frozen=True, slots=True, kw_only=True)
class SeeOptions:
    """What a model is asked, of which views, and what is kept."""

    what: tuple[What, ...] = ()
    """What to ask the model for; nothing takes what it has, masks before the others. Of several
    each further one is written to NAME.WHAT, and each image passes the network once."""

    views: tuple[str, ...] = ("train",)
    """Which views: train, all, or names of views. It is recorded with the evidence."""

    allow_missing: bool = False
    """Take the views that recorded evidence has, where some that are asked for are missing."""

    zero_is_class: bool = False
    """The id 0 of recorded label maps is a class and not void: ids grow by 1."""

    void: int | None = None
    """A further id of recorded label maps that means none, such as 255."""

    suffix: str = ""
    """What stands in the names of recorded files between the view and the ending, such as _pred
    for 000_pred.png; files without it are left aside."""

    classes: str | None = None
    """Names of the ids of recorded label maps: ade20k, coco, cityscapes, scannet, kitti360,
    semantic-kitti or voc, for the ids of their annotations, with -train behind it for the ids that
    networks learn; or a JSON file with "classes" (id, name, isthing, colour), where 0 is a class
    if it is called so; or CVAT's labelmap.txt. Pictures in a table's colours are read by it."""

    depth_unit: float | None = None
    """Metres of one step of recorded depth maps that are pictures or .npy files, such as 0.001.
    Without it those are relative: inverse depth up to a scale and a shift."""

    cache: Path | None = None
    """Folder where the model's answers are kept by the content of the photographs, for other
    scenes of them."""

    precision: Literal["float16", "int8"] = "float16"
    """How features are kept in the cache."""

    seeds: str | None = None
    """Name of the evidence that says what a tracker is to follow: masks, panoptic segments,
    labels or tracks of some views, of the scene or its capture."""

    tracking: TrackingOptions = field(default_factory=TrackingOptions)
    """Which of the seeds count, and the order of the views."""

    overwrite: bool = False
    """Replace evidence of this name, once the new one is complete."""

    def __post_init__(self) -> None:
        convert_fields(self)


@boundary
def see(
    scene: Scene,
    model: str | Model,
    evidence: str,
    *,
    options: SeeOptions | None = None,
    model_options: object = None,
    loading: LoadOptions | None = None,
    backend: BackendName = "auto",
    observer: Observer = SILENT,
) -> SeenEvidence:
    """Write what a model sees in views to SCENE/evidence/NAME, a file a view.

    A view with a photograph is shown by it. One that has none, a virtual view, is drawn, and the
    render is kept beside the evidence in ``_renders``; models get images only.

    A call that was stopped, by an exception out of the observer too, has written whole views;
    the same call again does the rest. A tracker begins again: it leaves all views or none.

    Args:
        scene: The scene, read from its folder.
        model: The model; or the name of one, or a file or folder of evidence recorded elsewhere.
        evidence: Name of the evidence to write.
        options: What is asked.
        model_options: Options of the model's family, such as `ClassicalOptions`; None takes its
            defaults.
        loading: The model's weights, and where and how it runs.
        backend: Who renders views without photographs.
        observer: Is told of the progress.

    Raises:
        InputError: If there is no such model, it cannot be asked this, the scene has no such
            views, other evidence of this name is there, or another process works on the scene.
        FileFormatError: If recorded evidence is broken or has not the photograph's size, or weights
            are broken.
        MissingFileError: If weights are not on this machine.
        BackendError: If an image does not fit the memory of the device.
    """
    options = options or SeeOptions()
    check_name("evidence", evidence)
    if scene.root is None:
        raise InputError("scene: expected one that was read from its folder, got one without.")
    views = views_asked(scene, options.views)
    found = _model(model, options, model_options, loading, observer, views=scene.views)
    seeds = _seeds(scene, options.seeds)
    tracking = None if seeds is None and options.tracking == TrackingOptions() else options.tracking
    cache = None
    if options.cache is not None:
        cache = ModelCache(folder=options.cache, precision=options.precision, report=observer.note)
    if found.note:
        observer.note(f"{found.name}: {found.note}")
    folder = scene_path(scene.root, EVIDENCE_FOLDER, evidence)
    images = ViewImages(scene, backend=backend)
    with work_on_scene(scene.root, "see"), observer.stage("see") as step:
        seen = record_evidence(
            found,
            views,
            folder,
            EvidenceRequest(
                what=options.what,
                view_spec=views_recorded(options.views),
                overwrite=options.overwrite,
                allow_missing=options.allow_missing,
                cache=cache,
                seeds=seeds,
                tracking=tracking,
                image_of=images,
            ),
            progress=step,
        )
    if images.drawn:
        seen = replace(seen, notes=(*seen.notes, _rendered(images.drawn, folder)))
    for note in seen.notes:
        observer.note(note)
    if cache is not None:
        observer.note(f"{cache.folder}: {cache.size()}")
    return seen


def _seeds(scene: Scene, name: str | None) -> Evidence | None:
    return None if name is None else open_evidence(find_evidence(scene.evidence_folders, name))


def _rendered(drawn: int, folder: Path) -> str:
    views = (
        "view that has no photograph was" if drawn == 1 else "views that have no photograph were"
    )
    return f"{drawn} {views} rendered for the model; the renders are in {folder / RENDERS_FOLDER}."


def _model(
    asked: str | Model,
    options: SeeOptions,
    model_options: object,
    loading: LoadOptions | None,
    observer: Observer,
    *,
    views: Sequence[View],
) -> Model:
    """The model with its settings; settings that it does not have are refused."""
    if isinstance(asked, str) and asked not in model_names() and Path(asked).exists():
        if model_options is not None or loading is not None:
            raise InputError(f"options: model {asked} takes neither options nor weights.")
        told: dict[tuple[What, ...], EvidenceKind] = {("masks",): "masks", ("depth",): "depth"}
        return recorded_model(
            asked,
            views=views,
            kind=told.get(options.what),
            zero_is_class=options.zero_is_class,
            void=options.void,
            suffix=options.suffix,
            classes=options.classes,
            depth_unit=options.depth_unit,
        )
    if isinstance(asked, str):
        model = find_model(asked, model_options, loading=loading, report=observer.note)
    elif model_options is not None or loading is not None:
        raise InputError("model: expected a name with options and weights, got a model made.")
    else:
        model = asked
    name = asked if isinstance(asked, str) else model.name
    given = (options.void, options.depth_unit)
    if options.zero_is_class or given != (None, None) or options.suffix or options.classes:
        raise InputError(
            "zero_is_class, void, suffix, classes, depth_unit: expected with evidence recorded "
            f"elsewhere, got model {name}."
        )
    return model
