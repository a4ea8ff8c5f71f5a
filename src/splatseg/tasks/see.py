"""A 2D model looks at a scene's photographs, and what it sees is written down."""

from collections.abc import Callable, Sequence
from dataclasses import field, replace
from functools import partial
from pathlib import Path
from typing import TypeVar

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from splatseg.core import LOCAL, Executor, Model, PromptableMasks, Renderable, Scene, View
from splatseg.core.boundary import boundary
from splatseg.core.models import DepthAwareMasks, Image
from splatseg.core.options import options
from splatseg.core.typed_text import typed_field
from splatseg.errors import InputError
from splatseg.io.evidence import (
    RENDERS_FOLDER,
    EvidenceKind,
    evidence_names,
    find_evidence,
)
from splatseg.io.images import image_camera, load_image
from splatseg.io.scene import check_name
from splatseg.io.scene_folder import scene_path, work_on_scene
from splatseg.models import (
    DescribedEvidence,
    EvidenceRequest,
    LoadOptions,
    TrackingOptions,
    What,
    find_family,
    find_model,
    model_names,
    record_evidence,
)
from splatseg.models.recorded import recorded_model
from splatseg.render import BackendName, PreparedView
from splatseg.tasks.work import (
    EVIDENCE_FOLDER,
    SILENT,
    Observer,
    Work,
    check_streams,
    view_spec,
)

T = TypeVar("T")


@options(
    removed={
        "cache": "`see --model FOLDER` copies evidence that another scene of the photographs has",
        "precision": "nothing is cached; evidence has features in float16",
    }
)
class SeeOptions:
    """What a model predicts, of which views, and what is kept."""

    what: tuple[What, ...] = ()
    """What to predict: masks, labels, panoptic, features, text, depth, tracked. Empty takes what
    the model offers, masks first. Of several, separated by commas or spaces, each further one is
    written to NAME.WHAT, and each image passes the network once."""

    views: tuple[str, ...] = ("train",)
    """Views: train, all, or names, separated by commas or spaces. Recorded with the evidence."""

    allow_missing: bool = False
    """Use the views that recorded evidence has, where some of the requested ones are missing."""

    zero_is_class: bool = False
    """The id 0 of recorded label maps is a class, not void: ids grow by 1."""

    void: int | None = None
    """A further id of recorded label maps that means void, such as 255."""

    suffix: str = ""
    """Text between the view's name and the ending in names of recorded files, such as _pred for
    000_pred.png; files without it are skipped."""

    classes: str | None = None
    """Names of the ids of recorded label maps: ade20k, coco, cityscapes, scannet, kitti360,
    semantic-kitti or voc for the ids of their annotations, with the suffix -train for the ids that
    networks predict; or a JSON file with "classes" (id, name, isthing, colour); or CVAT's
    labelmap.txt. Pictures in a table's colours are read by it."""

    depth_unit: float | None = None
    """Metres of one step of recorded depth maps that are pictures or .npy files, such as 0.001.
    None: they hold inverse depth up to scale and shift."""

    seeds: str | None = None
    """Evidence that says what a tracker follows: masks, panoptic segments, labels or tracks of
    some views, of the scene or its capture."""

    tracking: TrackingOptions = field(default_factory=TrackingOptions)
    """Which seeds count, and the order of the views."""

    depth_from_scene: bool = True
    """Tell models of masks that take it (regions and hed) the depth of the scene's Gaussians too,
    whose steps and folds are borders that colours hide."""

    overwrite: bool = False
    """Replace what an earlier run wrote under the same name."""


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
    executor: Executor = LOCAL,
    observer: Observer = SILENT,
) -> DescribedEvidence:
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
        backend: Rendering backend, for views without photographs.
        executor: Where the model looks at views; each process has the model once.
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
    if executor is not LOCAL:
        check_streams(scene, "executor")
    work = Work(scene=scene, backend=backend, observer=observer)
    check_name("evidence", evidence)
    root = work.root
    views = work.views(options.views)
    found = _model(model, options, model_options, loading, observer, views=scene.views)
    seeds = None if options.seeds is None else work.evidence(options.seeds)
    tracking = None if seeds is None and options.tracking == TrackingOptions() else options.tracking
    if found.note:
        observer.note(f"{found.name}: {found.note}")
    folder = scene_path(root, EVIDENCE_FOLDER, evidence)
    takes_depth = options.depth_from_scene and isinstance(found, DepthAwareMasks)
    depth_of = scene_depth(work) if takes_depth else None
    with work_on_scene(root, "see"), observer.stage("see") as step:
        seen = record_evidence(
            found,
            views,
            folder,
            EvidenceRequest(
                what=options.what or None,
                view_spec=view_spec(options.views),
                overwrite=options.overwrite,
                allow_missing=options.allow_missing,
                seeds=seeds,
                tracking=tracking,
                image_of=ViewImages(work),
                depth_of=depth_of,
            ),
            executor=executor,
            progress=step,
        )
    if seen.drawn:
        was = "view that has no photograph was"
        were = "views that have no photograph were"
        note = (
            f"{seen.drawn} {was if seen.drawn == 1 else were} rendered for the model; the "
            f"renders are in {folder / RENDERS_FOLDER}."
        )
        seen = replace(seen, notes=(*seen.notes, note))
    for note in seen.notes:
        observer.note(note)
    return seen


def scene_depth(work: Work) -> Callable[[View], Float[Tensor, "height width"]]:
    """Depth of views as the scene's Gaussians have it; 0 where little of them is in front."""
    return partial(_depth_of, work.field())


def _depth_of(field: Renderable, view: View) -> Float[Tensor, "height width"]:
    with field.view(view.camera) as prepared:
        signals = prepared.signals(colour=False)
    # NaN is what the renderer could not tell.
    return torch.where(signals.alpha > _SEEN_THROUGH, signals.depth, 0).nan_to_num(0.0)


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


_LOADING = ("size", "dtype", "batch")
"""Options of loading that each model may have its own of."""


def model_of(
    named: str, *, download: bool = False, device: str = "auto", report: Callable[[str], None]
) -> Model:
    """The model of ``NAME[=WEIGHTS][,OPTION=VALUE...]``, or a folder.

    What follows a comma without an ``=`` goes on with the value before it.

    Args:
        named: The word.
        download: Whether weights that are not on this machine may be fetched.
        device: Where it runs.
        report: Told in a sentence what the user should know.

    Raises:
        InputError: If there is none, or it has no such option.
    """
    name = name_of(named)
    family = find_family(name) if name in model_names() else None
    if family is None:
        return find_model(named, report=report)
    first, *rest = _pieces(named)
    weights = first.partition("=")[2]
    if weights and not family.needs_weights:
        raise InputError(f"models: {name} has no weights, got {named!r}.")
    loading = LoadOptions(weights=weights or None, download=download, device=device)
    chosen = family.options()
    for text in rest:
        if family.needs_weights and text.partition("=")[0] in _LOADING:
            field, value = typed_field(LoadOptions, text, what=f"model {name}")
            loading = replace(loading, **{field: value})
        else:
            field, value = typed_field(family.options, text, what=f"model {name}")
            chosen = replace(chosen, **{field: value})
    return find_model(
        name, chosen, loading=loading if family.needs_weights else None, report=report
    )


def model_for(
    option: str,
    named: str,
    protocol: type[T],
    does: str,
    *,
    download: bool = False,
    device: str = "auto",
    report: Callable[[str], None],
) -> T:
    """The model that an option names, which must do what the option needs.

    Args:
        option: The option, for messages.
        named: As `model_of` takes it.
        protocol: What the model must be.
        does: The same in words: ``expected a model that ...``.
        download: Whether weights that are not on this machine may be fetched.
        device: Where it runs.
        report: Told in a sentence what the user should know.

    Raises:
        InputError: If there is no such model, or it does something else.
    """
    model = model_of(named, download=download, device=device, report=report)
    if not isinstance(model, protocol):
        raise InputError(f"{option}: expected a model that {does}, got {model.name}.")
    return model


def prompter_of(
    named: str,
    scene: Scene,
    *,
    download: bool = False,
    device: str = "auto",
    report: Callable[[str], None],
) -> PromptableMasks:
    """A model that predicts masks at points in views of a scene.

    Args:
        named: As `model_of` takes it, or the name of masks of the scene or its capture: of those
            the ones at a point answer.
        scene: The scene whose photographs it will see.
        download: Whether weights that are not on this machine may be fetched.
        device: Where it runs.
        report: Told in a sentence what the user should know.
    """
    folders = scene.evidence_folders
    folder = find_evidence(folders, named) if named in evidence_names(folders) else Path(named)
    if name_of(named) in model_names() or not folder.is_dir():
        return model_for(
            "prompter",
            named,
            PromptableMasks,
            "answers points",
            download=download,
            device=device,
            report=report,
        )
    model = recorded_model(folder, views=scene.views)
    if not isinstance(model, PromptableMasks):
        raise InputError(f"prompter: expected a model that answers points, got {model.name}.")
    return model


def name_of(named: str) -> str:
    """The name of a model that was given with weights and options."""
    return named.split(",")[0].partition("=")[0]


def _pieces(named: str) -> list[str]:
    """The name with its weights, then each option."""
    found: list[str] = []
    for piece in named.split(","):
        if len(found) > 1 and "=" not in piece:
            found[-1] += f",{piece}"
        else:
            found.append(piece)
    return found


_SEEN_THROUGH = 0.5
"""Share of a pixel's light that is stopped where there is a depth."""

_GREYS = (0.0, 1.0, 0.5)
# A scene that fills its views has no background to speak of, and it stays black.
_EMPTY = 0.05
_ALIKE = 0.15
_SOLID = 0.9
_LOOKED_AT = 12
_SMALL = 128


class ViewImages:
    """Gives the picture of a view.

    Models see images only; that some of them are renders is this task's business. What nothing
    covers is of the grey (black, white, half) that the scene itself has least of, so that a dark
    thing has an outline.

    Args:
        work: The scene whose Gaussians are drawn.
    """

    def __init__(self, work: Work) -> None:
        self._field = work.field()
        self._views = tuple(view for view in work.scene.views if view.image is None)
        self._background: float | None = None

    def __call__(self, view: View) -> Image:
        """The photograph of a view, uint8 (H, W, 3); its render where it has none.

        Args:
            view: The view.

        Raises:
            MissingFileError: If the view has a photograph that is not where it was.
            FileFormatError: If it cannot be decoded, or its size is not the camera's.
        """
        if view.image is not None:
            return load_image(view)
        if self._background is None:
            self._background = background_of(self._field, self._views)
        colour, alpha = _drawn_view(self._field, view)
        over = (colour + (1 - alpha)[..., None] * self._background).clamp(0, 1)
        return (over * 255 + 0.5).to(torch.uint8)


def shown_image(view: View, prepared: PreparedView) -> UInt8[Tensor, "height width 3"]:
    """The photograph of a view, or the render of it."""
    if view.image is not None:
        return load_image(view)
    with torch.no_grad():
        colour = prepared.render().image
    return (colour.cpu().clamp(0, 1) * 255 + 0.5).to(torch.uint8)


def background_of(field: Renderable, views: Sequence[View]) -> float:
    """The grey, 0 to 1, that fewest solid pixels of some views resemble; black if none is empty.

    It depends on the field and on all views, not on which of them are asked for, so that work
    that was stopped goes on over the same.
    """
    step = max(1, len(views) // _LOOKED_AT)
    drawn = [_drawn_view(field, view, longest=_SMALL) for view in views[::step][:_LOOKED_AT]]
    alpha = torch.cat([alpha.flatten() for _, alpha in drawn])
    if float((1 - alpha).mean()) < _EMPTY:
        return _GREYS[0]
    colours = torch.cat([colour.flatten(0, 1) for colour, _ in drawn])[alpha > _SOLID]
    alike = [int(((colours - grey).abs() < _ALIKE).all(dim=1).sum()) for grey in _GREYS]
    return _GREYS[alike.index(min(alike))]


def _drawn_view(
    field: Renderable, view: View, *, longest: int | None = None
) -> tuple[Float[Tensor, "height width 3"], Float[Tensor, "height width"]]:
    """Colour over black, and alpha."""
    camera = view.camera if longest is None else image_camera(view, longest)
    with field.view(camera) as looked_at:
        signals = looked_at.signals()
    if signals.colour is None:
        raise InputError("field: expected one with colours, got one without.")
    return signals.colour, signals.alpha
