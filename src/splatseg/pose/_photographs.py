"""Photographs made ready: found, turned upright, made smaller, and sorted by lens."""

from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import UInt8
from PIL import Image
from torch import Tensor

from splatseg.core import Camera, View
from splatseg.core.boundary import boundary
from splatseg.errors import FileFormatError, InputError, MissingFileError
from splatseg.io.atomic import check_utf8
from splatseg.io.captures import bare_photographs
from splatseg.io.foreign import reading
from splatseg.io.images import image_size, load_image, open_image, reduced_size
from splatseg.pose._exif import LensFacts, lens_facts
from splatseg.pose._options import PoseOptions
from splatseg.pose._report import LeftOut

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

    def as_json(self) -> dict[str, Any]:
        """For the job of the worker."""
        return {name: getattr(self, name) for name in self.__slots__}


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
