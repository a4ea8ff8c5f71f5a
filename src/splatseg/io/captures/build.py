"""From what a layout says of each photograph to checked views.

Every reader of a layout only parses: it gives one `RawView` a photograph. Names, splits,
missing photographs, sizes and poses are dealt with here, once, so that every layout refuses
the same mistakes in the same words.
"""

import unicodedata
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path, PurePosixPath

from splatseg.core import Camera, Capture, PointCloud, View
from splatseg.core.scene import clean_view_names
from splatseg.errors import InputError, MissingFileError, quoted
from splatseg.io.atomic import check_utf8
from splatseg.io.captures.points import finite_points, read_metadata
from splatseg.io.captures.raw_views import RawView, camera_of, intrinsics_of_size, scaled_to
from splatseg.io.foreign import derived_from, expect, is_file, is_folder
from splatseg.io.images import DEFAULT_LONGEST, IMAGE_SUFFIXES, image_size, reduced_size, same_shape

TEST_EVERY = 8
"""Without a split of its own, views 0, 8, 16 ... of a capture by sorted name are test views."""


_LONGEST = 100
"""Characters of a path in a message; its end is kept."""

MIN_THERE = 0.5
"""Least share of the photographs that a capture lists which must be there."""

# So many photographs that are not there are named in a note.
_NAMED = 20


# Photographs are not always where a capture says. Blender and instant-ngp leave the suffix out,
# converters change it, Windows does not mind case and macOS decomposes accents; paths are those of
# the machine that a capture was made on, and what makes smaller copies puts them beside the folder
# under its name with a number, as in ``images_4``.
SMALLER = (2, 4, 8)
"""Numbers of the folders of smaller copies: pixels of the photograph for one of a copy."""

_FIRST = (".png", ".jpg", ".jpeg")
_FOLDERS = ("", "images", "input", "rgb")
_DEEPEST = 16
"""Folders that may be left out of the front of a path."""


class Photographs:
    """Finds photographs by their path, or by their stem in the same folder."""

    def __init__(self) -> None:
        self._by_stem: dict[Path, dict[str, list[Path]]] = {}

    def find(self, listed: Path) -> Path | None:
        """The photograph of a path that a capture lists, None where there is none."""
        if is_file(listed):
            return listed
        stems = self._stems(listed.parent)
        found = stems.get(_key(listed.name), [])
        suffix = listed.suffix[1:]
        if not found and suffix.isalnum() and not suffix.isdigit():
            found = stems.get(_key(listed.stem), [])
        own = (listed.name, listed.stem)
        return min(found, key=lambda file: (file.stem not in own, *_rank(file)), default=None)

    def find_all(self, listed: Sequence[Path]) -> list[Path | None]:
        """The photograph of each path; no file is that of two of them."""
        named = {path for path in listed if is_file(path)}
        found: list[Path | None] = []
        for path in listed:
            file = self.find(path)
            if file is not None and file != path:
                file = None if file in named else file
                named |= set() if file is None else {file}
            found.append(file)
        return found

    def count(self, listed: Iterable[Path]) -> int:
        """How many of these are there."""
        return sum(self.find(path) is not None for path in listed)

    def _stems(self, folder: Path) -> dict[str, list[Path]]:
        if folder not in self._by_stem:
            stems: dict[str, list[Path]] = {}
            for file in folder.iterdir() if is_folder(folder) else ():
                if file.suffix.lower() in IMAGE_SUFFIXES and is_file(file):
                    stems.setdefault(_key(file.stem), []).append(file)
            self._by_stem[folder] = stems
        return self._by_stem[folder]


def moves(below: Path) -> list[tuple[int, Callable[[Path], list[Path]]]]:
    """Where files of a capture may lie instead of where it lists them, in the order to look.

    Each comes with how many pixels of the photograph one of what lies there stands for.

    Args:
        below: The capture's folder.
    """
    found: list[tuple[int, Callable[[Path], list[Path]]]] = [
        (1, partial(_moved_path, dropped=dropped, folder=folder, below=below))
        for dropped in range(_DEEPEST + 1)
        for folder in _FOLDERS
    ]
    return found + [(number, partial(_smaller, number=number, below=below)) for number in SMALLER]


def _moved_path(path: Path, *, dropped: int, folder: str, below: Path) -> list[Path]:
    """A path in a folder of the capture, without its first folders."""
    parts = path.relative_to(below).parts if path.is_relative_to(below) else path.parts[1:]
    parts = tuple(part for part in parts if part != "..")
    return [below.joinpath(folder, *parts[dropped:])] if dropped < len(parts) else []


def _smaller(path: Path, *, number: int, below: Path) -> list[Path]:
    """Where a smaller copy of a file may lie: a folder of its path with a number at its name.

    The name of the capture's folder stays.
    """
    parts = path.relative_to(below).parts if path.is_relative_to(below) else path.parts[-2:]
    base = path.parents[len(parts) - 1] if len(parts) <= len(path.parents) else path.parent
    copies: list[Path] = []
    for i, part in enumerate(parts[:-1]):
        if part not in (".", ".."):
            copies.append(base.joinpath(*parts[:i], f"{part}_{number}", *parts[i + 1 :]))
    return copies


def _key(stem: str) -> str:
    """What stems have in common that differ in case or in how accents are written."""
    return unicodedata.normalize("NFC", stem).casefold()


def _rank(file: Path) -> tuple[int, str]:
    """Of files of one stem the one to take comes first: PNG before JPEG before others."""
    suffix = file.suffix.lower()
    return (_FIRST.index(suffix) if suffix in _FIRST else len(_FIRST), file.name)


def build_capture(
    path: Path,
    raw: Sequence[RawView],
    *,
    format: str,
    points: PointCloud | None = None,
    splats: Path | None = None,
    notes: Sequence[str] = (),
    up: tuple[float, float, float] | None = None,
    metres_per_unit: float | None = None,
    strict: bool = False,
) -> Capture:
    """Check what a reader found and make the capture of it.

    Photographs are sought by their stem too, and where fewer than half are where they are listed,
    in the capture's own folders and in folders of smaller copies. Those that are not there, cannot
    be opened, are of another shape than their intrinsics or their mask, or have an impossible pose
    or lens are left out, and a note names them. They are left out before views are split, and after
    they are named: a view keeps its name when the others come back. Start points that are not
    finite are left out and counted. What metadata.json says comes before `up` and
    `metres_per_unit`.

    Raises:
        InputError: If there is no photograph, one is listed twice, more than half of the
            photographs, any with `strict`, cannot be used, or all points, any with `strict`, are
            not finite.
        MissingFileError: If more than half of the photographs are missing, or any with
            `strict`, or masks or depth maps of those that are there.
    """
    expect(raw, path, f"photographs with poses, got a {format} capture of none", error=InputError)
    raw, found_notes = _located(path, raw)
    with derived_from(path):
        names = view_names([view.relative for view in raw])
    order = sorted(range(len(raw)), key=lambda i: names[i])
    missing = tuple(raw[i].relative for i in order if not is_file(raw[i].image))
    left_out = _left_out(path, missing, listed=len(raw), strict=strict)
    cameras, camera_notes = _cameras(
        path, raw, [i for i in order if is_file(raw[i].image)], strict=strict
    )
    order = [i for i in order if i in cameras]
    used = [raw[i] for i in order]
    _check_files(path, used)
    splits, split_note = _splits(used)
    with derived_from(path):
        views = [
            View(
                name=names[i],
                camera=cameras[i],
                image=raw[i].image,
                split=split,
                mask=raw[i].mask,
                depth=raw[i].depth,
                depth_unit=raw[i].depth_unit,
            )
            for i, split in zip(order, splits, strict=True)
        ]
    metadata = read_metadata(path)
    point_notes: tuple[str, ...] = ()
    if points is not None:
        points, point_notes = finite_points(points, where=path, strict=strict)
    found = (*left_out, *found_notes, *camera_notes, *point_notes, *notes, *split_note)
    with derived_from(path):
        return Capture(
            path=path,
            format=format,
            views=tuple(views),
            points=points,
            classes=metadata.classes,
            up=metadata.up or up,
            metres_per_unit=metadata.metres_per_unit or metres_per_unit,
            splats=splats,
            notes=(*found, *_size_notes(views)),
            missing=missing,
        )


def _located(path: Path, raw: Sequence[RawView]) -> tuple[list[RawView], list[str]]:
    """Views with the photographs that are there instead of the paths that are listed, and notes."""
    photographs = Photographs()
    there = photographs.find_all([view.image for view in raw])
    notes: list[str] = []
    number, move = 1, None
    if sum(file is not None for file in there) < MIN_THERE * len(raw):
        for pixels, candidates in moves(path):
            found = [_moved(photographs, candidates(view.image)) for view in raw]
            files = [file for file in found if file is not None]
            # Without its first folders a path may be that of another photograph too.
            if len(files) >= MIN_THERE * len(raw) and len(set(files)) == len(files):
                there, number, move = found, pixels, candidates
                folder = files[0].parent
                where = folder.relative_to(path) if folder.is_relative_to(path) else folder
                notes.append(
                    f"photographs were read from {_first([str(where)])}, as they are not where the "
                    "capture lists them"
                )
                break
    located: list[RawView] = []
    others: list[str] = []
    for view, file in zip(raw, there, strict=True):
        if file is None:
            located.append(view)
            continue
        suffix = file.suffix if file.stem == view.image.name else ""
        if not suffix and file.name != view.image.name:
            others.append(view.relative)
        if move is not None:
            mask, depth = (
                next((c for c in move(f) if is_file(c)), f) if f else None
                for f in (view.mask, view.depth)
            )
            view = replace(view, mask=mask, depth=depth, copy_of=number)
        located.append(replace(view, image=file, relative=view.relative + suffix))
    if others:
        notes.append(
            f"{len(others)} photographs have another suffix or case than the capture lists "
            f"({_first(others)})"
        )
    return located, notes


def _moved(photographs: Photographs, candidates: Sequence[Path]) -> Path | None:
    """The first of these that is there, None where none is."""
    return next(filter(None, map(photographs.find, candidates)), None)


def _cameras(
    path: Path, raw: Sequence[RawView], order: Sequence[int], *, strict: bool
) -> tuple[dict[int, Camera], list[str]]:
    """Cameras of the photographs that can be used, by index, and notes of them and the others.

    Raises:
        InputError: The complaint about the first that cannot, if it is one of more than half
            with those that are not there, or with `strict`.
    """
    cameras: dict[int, Camera] = {}
    unfit: dict[str, list[str]] = {}
    scaled: list[str] = []
    first: InputError | None = None
    for i in order:
        view, fault = raw[i], "cannot be opened"
        try:
            size = image_size(view.image)
            fault = "are of another shape than their intrinsics say"
            written = intrinsics_of_size(view, size)
            intrinsics = scaled_to(written, size, where=str(view.image))
            fault = "have a mask that cannot be opened or is of another shape"
            mask = _mask_size(view, size)
            fault = "have a pose or a lens that no camera has"
            with derived_from(where := f"{path}: {view.relative}"):
                cameras[i] = camera_of(view, intrinsics, size, where=where)
        except InputError as error:
            unfit.setdefault(fault, []).append(view.relative)
            first = first or error
            continue
        for what, (width, height) in (
            ("intrinsics", written.size or size),
            ("masks", mask),
        ):
            if (width, height) != size:
                to = f"photographs of {size[0]}x{size[1]}"
                scaled.append(f"{what} of {width}x{height} were scaled to {to}")
    if first is not None and (strict or len(cameras) < MIN_THERE * len(raw)):
        raise first
    notes = [
        f"{len(names)} of {len(raw)} photographs {fault} and are left out ({_first(names, _NAMED)})"
        for fault, names in unfit.items()
    ]
    return cameras, [*notes, *dict.fromkeys(scaled)]


def _mask_size(view: RawView, size: tuple[int, int]) -> tuple[int, int]:
    """The size of a view's mask, that of its photograph where it has none or it is missing.

    Raises:
        InputError: If it is no uniform scale of the photograph's, or it cannot be opened.
    """
    if view.mask is None or not is_file(view.mask):
        return size
    mask = image_size(view.mask)
    what = f"a mask of {size[0]}x{size[1]} pixels as its photograph has, or a uniform scale of it, "
    what += f"got {mask[0]}x{mask[1]}"
    expect(same_shape(*size, *mask), view.mask, what, error=InputError)
    return mask


def view_names(relatives: Sequence[str]) -> list[str]:
    """Names of views: the file's stem, or its relative path where stems clash.

    Relative paths start below the folder that all photographs share, and lose their suffix
    unless only the suffix tells two photographs apart. What climbs in them is left out, and names
    that differ only in case get a number: files are called so, see `clean_view_names`.

    Raises:
        InputError: If a photograph is listed twice, or a path is that of no file.

    Example:
        >>> view_names(["images/left/1.jpg", "images/right/1.jpg", "images/left/2.jpg"])
        ['left/1', 'right/1', '2']
    """
    paths = [PurePosixPath(relative) for relative in relatives]
    for relative, path in zip(relatives, paths, strict=True):
        if not path.name:
            raise InputError(f"photographs: expected the path of a file, got {quoted(relative)}.")
    twice = [str(path) for path, count in Counter(paths).items() if count > 1]
    what = f"each once, got {len(twice)} more than once ({_first(twice)})"
    expect(not twice, "photographs", what, error=InputError)
    parents = [path.parent.parts for path in paths]
    shared = 0
    while all(len(p) > shared and p[shared] == parents[0][shared] for p in parents):
        shared += 1
    below = [PurePosixPath(*path.parts[shared:]) for path in paths]
    stems = Counter(path.stem for path in below)
    bare = Counter(path.with_suffix("") for path in below)
    return clean_view_names(
        [
            path.stem
            if stems[path.stem] == 1
            else str(path if bare[path.with_suffix("")] > 1 else path.with_suffix(""))
            for path in below
        ]
    )


def _left_out(path: Path, missing: Sequence[str], *, listed: int, strict: bool) -> tuple[str, ...]:
    """The note that names photographs that are not there; too many of them are refused."""
    if not missing:
        return ()
    if strict or listed - len(missing) < MIN_THERE * listed:
        allowed = "all of them" if strict else "at least half of them"
        raise MissingFileError(
            f"{path}: {len(missing)} of {listed} photographs that it lists are not there, expected "
            f"{allowed} ({_first(missing)})."
        )
    verb = "is" if len(missing) == 1 else "are"
    return (
        f"{len(missing)} of {listed} photographs that the capture lists {verb} not there and left "
        f"out ({_first(missing, _NAMED)})",
    )


def _check_files(path: Path, raw: Sequence[RawView]) -> None:
    """Refuse names that no scene can hold, before there is one to lose, and files that lack."""
    check_utf8(path)
    for view in raw:
        check_utf8(view.image)
    for what, named in (("masks", [v.mask for v in raw]), ("depth maps", [v.depth for v in raw])):
        files = [file for file in named if file is not None]
        for file in files:
            check_utf8(file)
        missing = [str(file) for file in files if not is_file(file)]
        if missing:
            raise MissingFileError(
                f"{path}: {len(missing)} of {len(files)} {what} are missing ({_first(missing)})."
            )


def _first(names: Sequence[str], count: int = 5) -> str:
    shown = [name if len(name) <= _LONGEST else f"...{name[-_LONGEST:]}" for name in names[:count]]
    listed = ", ".join(shown) + (", ..." if len(names) > count else "")
    return "".join(c if c.isprintable() else "?" for c in listed)


def _splits(raw: Sequence[RawView]) -> tuple[list[str], tuple[str, ...]]:
    """Splits of views that are already sorted by name, and a note where they are not their own."""
    if len(raw) == 1 or any(view.split is not None for view in raw):
        return [view.split or "train" for view in raw], ()
    splits = ["test" if i % TEST_EVERY == 0 else "train" for i in range(len(raw))]
    return splits, (f"no split of its own: every {TEST_EVERY}th view by name is a test view",)


def _size_notes(views: Sequence[View]) -> list[str]:
    large = [v for v in views if max(v.camera.width, v.camera.height) > DEFAULT_LONGEST]
    if not large:
        return []
    camera = large[0].camera
    width, height = reduced_size(camera.width, camera.height, DEFAULT_LONGEST)
    return [
        f"{len(large)} photographs are larger than {DEFAULT_LONGEST} pixels "
        f"({camera.width}x{camera.height}); they are worked on at {width}x{height}"
    ]
