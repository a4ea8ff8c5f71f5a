"""Photographs made ready: of a folder or a video, turned upright, made smaller, sorted by lens."""

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from jaxtyping import UInt8
from msgspec import Meta
from PIL import Image
from torch import Tensor

from splatseg.core import Camera, View
from splatseg.core.boundary import boundary, convert_fields
from splatseg.core.options import Count, Natural, options
from splatseg.errors import FileFormatError, InputError, MissingFileError
from splatseg.io.atomic import check_utf8
from splatseg.io.captures import bare_photographs
from splatseg.io.foreign import reading
from splatseg.io.images import image_size, load_image, open_image, reduced_size

HEIC_SUFFIXES = frozenset({".heic", ".heif", ".hif", ".avif"})
RAW_SUFFIXES = frozenset({
    ".3fr", ".arw", ".cr2", ".cr3", ".crw", ".dcr", ".dng", ".erf", ".iiq", ".kdc", ".mef",
    ".mrw", ".nef", ".nrw", ".orf", ".pef", ".raf", ".raw", ".rw2", ".rwl", ".sr2", ".srf",
    ".srw", ".x3f",
})  # fmt: skip
MIN_PHOTOGRAPHS = 3
HOW_TO_PHOTOGRAPH = (
    "photograph the scene from many places, walking and not turning on the spot, each picture "
    "overlapping the next by about two thirds, sharp, and of things that stand still and have "
    "texture"
)
# Where EXIF data say nothing: a field of view of 45 degrees, as COLMAP guesses.
_GUESSED_FOCAL = 1.2


@dataclass(frozen=True, slots=True, kw_only=True)
class LensFacts:
    """What EXIF data say of a lens."""

    identity: tuple[str, ...]
    """Make, model, lens and focal lengths; all empty where there are no such data."""

    focal: float | None
    """Focal length in pixels of the photograph as it is now; None where the data do not say."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Photograph:
    """One photograph that can be read."""

    path: Path
    width: int
    """Upright, pixels."""

    height: int
    facts: LensFacts


@dataclass(frozen=True, slots=True, kw_only=True)
class WorkingLens:
    """One lens, and the photographs taken with it, as the mapper gets them."""

    width: int
    """Of the working copies, pixels."""

    height: int
    full_width: int
    """Of the photographs."""

    full_height: int
    focal: float
    """Where to begin, pixels of the working copies."""

    prior: bool
    """Whether `focal` comes from EXIF data."""

    images: dict[str, str]
    """File name of the photograph by file name of the working copy."""


def find_photographs(folder: Path) -> tuple[Path, ...]:
    """Photographs in a folder or its folder ``images``, sorted by name.

    Raises:
        MissingFileError: If there is no such folder.
        InputError: If there are fewer than three, or HEIC or RAW files without a JPEG of the
            same name, or names that are not UTF-8.
    """
    if not folder.is_dir():
        raise MissingFileError(f"{folder}: there is no such folder of photographs.")
    found = bare_photographs(folder)
    for path in found:
        check_utf8(path)
    _refuse_undecodable(folder, found)
    if len(found) < MIN_PHOTOGRAPHS:
        raise InputError(
            f"{folder}: expected at least {MIN_PHOTOGRAPHS} photographs, got {len(found)}; "
            f"{HOW_TO_PHOTOGRAPH}."
        )
    return found


@boundary
def holds_photographs(folder: Path) -> bool:
    """Whether a folder, or its folder ``images``, holds photographs, be they HEIC or RAW."""
    folders = [path for path in (folder, folder / "images") if path.is_dir()]
    return bool(bare_photographs(folder)) or any(
        path.suffix.lower() in HEIC_SUFFIXES | RAW_SUFFIXES
        for parent in folders
        for path in parent.iterdir()
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class LeftOut:
    """A photograph without a pose."""

    name: str
    """Its file name."""

    why: str

    def __post_init__(self) -> None:
        convert_fields(self)


def read_headers(paths: Sequence[Path]) -> tuple[list[Photograph], list[LeftOut]]:
    """Size and lens of each photograph, and those that cannot be read."""
    good: list[Photograph] = []
    bad: list[LeftOut] = []
    for path in paths:
        try:
            width, height = image_size(path)
            with open_image(path) as image, reading(path, "a photograph"):
                facts = lens_facts(image)
        except FileFormatError as error:
            bad.append(LeftOut(name=path.name, why=_reason(error, path)))
        else:
            good.append(Photograph(path=path, width=width, height=height, facts=facts))
    return good, bad


CameraSharing = Literal["auto", "shared", "per-image"]
"""Which photographs share one lens."""


Mapper = Literal["auto", "global", "incremental"]
"""Who turns matches into cameras."""


Matching = Literal["auto", "exhaustive", "retrieval"]
"""Which pairs of photographs are compared."""


@options(
    removed={
        "max_features": "the 8192 features of the largest scales are kept",
        "exhaustive_up_to": "`matching` chooses for any number of photographs",
        "overlap": "each photograph is compared with the 6 that follow it by name",
        "neighbours": "each photograph is compared with the 16 that look most like it",
    }
)
class PoseOptions:
    """How poses are recovered from photographs."""

    longest: Annotated[int, Meta(ge=64)] = 1000
    """Longest side, in pixels, at which features are found. More sees finer detail, takes
    longer (with its square) and rarely helps."""

    matching: Matching = "auto"
    """exhaustive: every photograph with every other. retrieval: with those that follow it by
    name and those that look most like it. auto: exhaustive up to 60 photographs."""

    mapper: Mapper = "auto"
    """auto: global, and incremental too where that left photographs out or fits badly; the
    better model is kept."""

    cameras: CameraSharing = "auto"
    """auto: photographs of one size with the same make, model and focal length in their EXIF
    data (or none of these) share a lens. shared: all do. per-image: none do."""

    frames: Annotated[int, Meta(ge=3)] = 120
    """Frames taken from a video."""

    seed: Natural = 0
    """Seed of everything that is drawn at random."""

    threads: Count | None = None
    """Threads; None is OMP_NUM_THREADS, else all cores. Only on one thread is the result the
    same to the bit in every run."""


def write_working_copies(
    photographs: Sequence[Photograph],
    folder: Path,
    *,
    options: PoseOptions,
    threads: int,
    progress: Callable[[int, int], None],
) -> tuple[list[WorkingLens], list[LeftOut]]:
    """Upright, small copies without loss, and the lenses they were taken with.

    Copies that are there from an earlier run are kept.

    Raises:
        InputError: If all are to share a lens and their sizes differ.
    """
    folder.mkdir(parents=True, exist_ok=True)
    names = [f"{i:06d}.png" for i in range(len(photographs))]
    done = 0

    def copy(item: tuple[Photograph, str]) -> LeftOut | None:
        try:
            _copy(item[0], folder / item[1], longest=options.longest)
        except FileFormatError as error:
            path = item[0].path
            return LeftOut(name=path.name, why=_reason(error, path))
        return None

    failed: list[LeftOut] = []
    kept: list[tuple[Photograph, str]] = []
    pool = ThreadPoolExecutor(max_workers=threads)
    try:
        pairs = list(zip(photographs, names, strict=True))
        for pair, failure in zip(pairs, pool.map(copy, pairs), strict=True):
            done += 1
            progress(done, len(pairs))
            if failure is None:
                kept.append(pair)
            else:
                failed.append(failure)
    finally:
        # After Ctrl-C only the copies that are being written are waited for.
        pool.shutdown(cancel_futures=True)
    return _lenses(kept, options), failed


def working_focal(photograph: Photograph, longest: int) -> tuple[float, bool]:
    """Focal length to begin with, in pixels of the working copy, and whether EXIF data gave it."""
    width, height = reduced_size(photograph.width, photograph.height, longest)
    if photograph.facts.focal is None:
        return _GUESSED_FOCAL * max(width, height), False
    return photograph.facts.focal * max(width, height) / max(
        photograph.width, photograph.height
    ), True


def _lenses(kept: Sequence[tuple[Photograph, str]], options: PoseOptions) -> list[WorkingLens]:
    groups: dict[tuple[object, ...], list[tuple[Photograph, str]]] = {}
    sizes = Counter((photograph.width, photograph.height) for photograph, _ in kept)
    if options.cameras == "shared" and len(sizes) > 1:
        listed = ", ".join(f"{n} of {w}x{h}" for (w, h), n in sizes.most_common())
        raise InputError(
            f"cameras: expected photographs of one size to share a lens, got {listed}."
        )
    for photograph, name in kept:
        key: tuple[object, ...] = (photograph.width, photograph.height)
        if options.cameras == "auto":
            key = (*key, photograph.facts.identity)
        elif options.cameras == "per-image":
            key = (name,)
        groups.setdefault(key, []).append((photograph, name))
    lenses: list[WorkingLens] = []
    for members in groups.values():
        first = members[0][0]
        width, height = reduced_size(first.width, first.height, options.longest)
        # One that knows its focal length speaks for those that share its lens.
        focals = [working_focal(photograph, options.longest) for photograph, _ in members]
        focal, prior = next((f for f in focals if f[1]), focals[0])
        lenses.append(
            WorkingLens(
                width=width,
                height=height,
                full_width=first.width,
                full_height=first.height,
                focal=focal,
                prior=prior,
                images={name: photograph.path.name for photograph, name in members},
            )
        )
    return lenses


def read_reduced(photograph: Photograph, *, longest: int) -> UInt8[Tensor, "height width 3"]:
    """A photograph upright and, where it is larger, reduced to a longest side.

    Raises:
        FileFormatError: If it cannot be decoded.
    """
    camera = Camera(
        width=photograph.width,
        height=photograph.height,
        fx=1.0,
        fy=1.0,
        cx=0.0,
        cy=0.0,
        cam_from_world=torch.eye(4, dtype=torch.float64),
    )
    view = View(name="photograph", camera=camera, image=photograph.path)
    return load_image(view, longest=longest)


def _copy(photograph: Photograph, target: Path, *, longest: int) -> None:
    if target.is_file():
        return
    pixels = read_reduced(photograph, longest=longest).numpy()
    temporary = target.with_suffix(".tmp")
    # Little compression: it is read twice and thrown away.
    Image.fromarray(pixels).save(temporary, format="PNG", compress_level=1)
    temporary.replace(target)


def _refuse_undecodable(folder: Path, found: Sequence[Path]) -> None:
    """Raise for HEIC and RAW files, unless each lies beside its own JPEG."""
    holder = found[0].parent if found else folder
    folders = {holder, folder, folder / "images"}
    stems = {path.stem.lower() for path in found}
    for suffixes, kind, how in (
        (
            HEIC_SUFFIXES,
            "HEIC",
            "`heif-convert in.heic out.jpg` or `sips -s format jpeg *.heic --out FOLDER` on a Mac",
        ),
        (
            RAW_SUFFIXES,
            "RAW",
            "`darktable-cli in.nef out.jpg`, or export JPEGs from the program of the camera",
        ),
    ):
        files = sorted(
            path
            for parent in folders
            if parent.is_dir()
            for path in parent.iterdir()
            if path.suffix.lower() in suffixes and path.stem.lower() not in stems
        )
        if files:
            more = f" and {len(files) - 1} more" if len(files) > 1 else ""
            raise InputError(
                f"{files[0]}: expected JPEG or PNG photographs, got a {kind} file{more}; convert "
                f"them first: {how}."
            )


def _reason(error: FileFormatError, path: Path) -> str:
    return str(error).removeprefix(f"{path}: ").rstrip(".")


# What the EXIF data of a photograph say about its lens.
#
# With the focal length in terms of 35 mm film :math:`f_{35}`, whose frame has a diagonal of
# :math:`\sqrt{36^2 + 24^2} = 43.27` mm, the focal length in pixels is
#
# .. math:: f = f_{35} \, \frac{\sqrt{w^2 + h^2}}{43.27}.
#
# Else it is the focal length in millimetres times the pixels of the sensor for a millimetre
# (tag FocalPlaneXResolution), scaled by how much smaller the photograph was made since.
#
# References: CIPA DC-008 (Exif 2.32), tags FocalLengthIn35mmFilm and FocalPlaneXResolution.


_MAKE, _MODEL, _EXIF_IFD = 0x010F, 0x0110, 0x8769
_FOCAL, _FOCAL_35, _LENS_MODEL = 0x920A, 0xA405, 0xA434
_WIDTH, _HEIGHT = 0xA002, 0xA003
_PLANE_X, _PLANE_UNIT = 0xA20E, 0xA210
_MILLIMETRES = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
_DIAGONAL_35 = math.hypot(36.0, 24.0)
# Fields of view from 6 to 118 degrees; anything else is a tag that was filled with nonsense.
_PLAUSIBLE = (0.3, 10.0)
_SAME_SHAPE = 0.02


def lens_facts(image: Image.Image) -> LensFacts:
    """What the EXIF data of an opened image say of its lens."""
    if image.format == "PNG" and "exif" not in image.info:
        # Pillow would decode the whole image to look for them behind the pixels.
        return LensFacts(identity=("",) * 5, focal=None)
    exif = image.getexif()
    detail: Mapping[int, Any] = exif.get_ifd(_EXIF_IFD)
    identity = tuple(
        str(tags.get(tag, "")).strip("\0 ")
        for tags, tag in (
            (exif, _MAKE),
            (exif, _MODEL),
            (detail, _LENS_MODEL),
            (detail, _FOCAL),
            (detail, _FOCAL_35),
        )
    )
    return LensFacts(identity=identity, focal=_focal(detail, *image.size))


def _focal(detail: Mapping[int, Any], width: int, height: int) -> float | None:
    taken = (_number(detail, _WIDTH), _number(detail, _HEIGHT))
    if taken[0] and taken[1]:
        # Either may have been turned; the shape of an uncropped image is the same.
        now, then = max(width, height) / min(width, height), max(taken) / min(taken)
        if abs(now - then) > _SAME_SHAPE * then:
            return None
    focal = 0.0
    if film := _number(detail, _FOCAL_35):
        focal = film * math.hypot(width, height) / _DIAGONAL_35
    elif taken[0] and taken[1]:
        millimetre = _MILLIMETRES.get(int(_number(detail, _PLANE_UNIT) or 2), 0.0)
        density = _number(detail, _PLANE_X)
        if millimetre:
            scale = max(width, height) / max(taken)
            focal = _number(detail, _FOCAL) * density / millimetre * scale
    low, high = (factor * max(width, height) for factor in _PLAUSIBLE)
    return focal if low <= focal <= high else None


def _number(tags: Mapping[int, Any], tag: int) -> float:
    """A number of EXIF data; 0 where it lacks or is none, as cameras write for "unknown"."""
    try:
        value = float(tags.get(tag, 0))
    except (TypeError, ValueError, ZeroDivisionError):
        return 0.0
    return value if math.isfinite(value) and value > 0 else 0.0
