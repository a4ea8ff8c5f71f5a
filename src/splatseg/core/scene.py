"""Views, captures and scenes: what was photographed, and what was made of it.

Views are named by files that others made, and name files that are written: label maps, masks,
renders. A name that climbs, or that one file system takes for another name, must not get there.
"""

import difflib
import re
import unicodedata
from abc import ABC
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from jaxtyping import Float, UInt8
from torch import Tensor

from splatseg.core import upward
from splatseg.core.boundary import boundary, convert_fields
from splatseg.core.camera import Camera
from splatseg.core.gaussians import Gaussians
from splatseg.core.instance_tree import Layer
from splatseg.core.upward import Previewed
from splatseg.errors import InputError, ShapeError

MAX_PART = 200
"""Most bytes of a name between two slashes, as UTF-8. File systems allow 255, suffixes included."""

MAX_NAME = 800
"""Most bytes of a whole name."""

_TABLES = ("evidence", "segments", "tracks", "legend", "quant", "basis", "text_embeddings")
"""Files that lie beside those of views; a view of this name would be taken for one."""

_REFUSED = ("Cc", "Cs", "Zl", "Zp")
"""Unicode categories: control characters, lone surrogates (bytes that are no UTF-8), line ends."""


_DIGITS = 18
_NUMBER = re.compile(r"(\d+)\D*$")


def frame_number(name: str) -> tuple[str, int] | None:
    """The rest of a name and its last number, which counts the frames; None without one.

    Numbers of more than 18 digits count nothing.

    Example:
        >>> frame_number("image_01/0000000003"), frame_number("train_0003_L"), frame_number("a")
        (('image_01/', 3), ('train__L', 3), None)
    """
    found = _NUMBER.search(name)
    if found is None or len(found[1]) > _DIGITS:
        return None
    return name[: found.start(1)] + name[found.end(1) :], int(found[1])


def view_name_fault(name: str) -> str | None:
    """What is wrong with a name, as the end of a sentence; None where nothing is.

    Example:
        >>> view_name_fault("left/0001"), view_name_fault("../0001")
        (None, "expected a view's name without . or .. at the start of a part, got '../0001'")
    """
    got = f"got {name!r:.60}"
    if any(unicodedata.category(letter) in _REFUSED for letter in name):
        return f"expected a view's name of UTF-8 without control characters, {got}"
    parts = name.split("/")
    if "" in parts or "\\" in name:
        return f"expected a view's name as of a file below a folder, {got}"
    if any(part.startswith(".") for part in parts):
        return f"expected a view's name without . or .. at the start of a part, {got}"
    longest = max(len(part.encode()) for part in parts)
    if longest > MAX_PART or len(name.encode()) > MAX_NAME:
        return (
            f"expected a view's name of at most {MAX_NAME} bytes, {MAX_PART} between slashes, "
            f"got {len(name.encode())}"
        )
    return None


def check_view_name(name: str) -> None:
    """Raise `InputError` unless `name` can be that of a view."""
    fault = view_name_fault(name)
    if fault is not None:
        raise InputError(f"view: {fault}.")


def clean_view_names(names: Sequence[str]) -> list[str]:
    """Names of views that are valid and distinct on every file system, as near as can be.

    Names that are good stay; of several that differ only in case, or in how their accents are
    written, the first by code point does, and the others get a number.

    Args:
        names: What photographs are called; distinct.

    Example:
        >>> clean_view_names(["000", "../../000", "a", "A"])
        ['000', '000_2', 'a_2', 'A']
    """
    cleaned = [_cleaned(name) for name in names]
    found = list(cleaned)
    taken = {_folded(name) for name in _TABLES}
    others: list[int] = []
    # Names that can stay come first, so that no other one takes theirs.
    for i in sorted(range(len(names)), key=lambda i: (cleaned[i] != names[i], names[i])):
        if _folded(found[i]) in taken:
            others.append(i)
        taken.add(_folded(found[i]))
    for i in others:
        number = 2
        while _folded(found[i]) in taken:
            found[i] = f"{cleaned[i]}_{number}"
            number += 1
        taken.add(_folded(found[i]))
    return found


def _cleaned(name: str) -> str:
    parts = [_cleaned_part(part) for part in name.replace("\\", "/").split("/")]
    parts = [part for part in parts if part]
    while len("/".join(parts).encode()) > MAX_NAME - MAX_PART:
        del parts[0]
    return "/".join(parts) or "view"


def _cleaned_part(part: str) -> str:
    letters = ("_" if unicodedata.category(letter) in _REFUSED else letter for letter in part)
    # Room for a number: 150 bytes, none of them half a letter.
    return "".join(letters).lstrip(".").encode()[: MAX_PART - 50].decode(errors="ignore")


def _folded(name: str) -> str:
    """The same for names that some file system holds for one."""
    return unicodedata.normalize("NFC", unicodedata.normalize("NFC", name).casefold())


class SceneLayers(Mapping[str, Layer]):
    """Layers by name, read from the scene's folder each time one is asked for.

    A scene that was not saved has none. What another program writes meanwhile is seen.

    Raises:
        InputError: If there is no layer of the name; the message lists those there are.
    """

    def __init__(self, root: Path | None) -> None:
        self._root = root

    def _names(self) -> tuple[str, ...]:
        return () if self._root is None else upward.scene_layer_names(self._root)

    def __getitem__(self, name: str) -> Layer:
        where = "a scene that was not saved" if self._root is None else self._root
        if self._root is None or name not in self._names():
            known = ", ".join(self._names()) or "it has none"
            raise InputError(f"layer: expected one of {where} ({known}), got {name!r}.")
        return upward.load_scene_layer(self._root, name)

    def __iter__(self) -> Iterator[str]:
        return iter(self._names())

    def __len__(self) -> int:
        return len(self._names())

    def __contains__(self, name: object) -> bool:
        return name in self._names()

    def __repr__(self) -> str:
        return f"SceneLayers({', '.join(self._names()) or 'none'})"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class View(Previewed):
    """One photograph with its camera. The pixels stay on disk until somebody asks."""

    name: str
    """The file's stem, or its relative path without suffix where stems clash. Files of the view
    are called so, below their folders: see `view_names`."""

    camera: Camera
    """In the photograph's own pixels, after its EXIF orientation was applied."""

    image: Path | None = None
    """The photograph; None for a view that has none."""

    split: str = "train"
    """``train``, ``test`` or a further name of the capture's own."""

    mask: Path | None = None
    """Image whose zero pixels are to be ignored."""

    depth: Path | None = None
    """Depth map of the capture."""

    depth_unit: float | None = None
    """Scene units of one step of the depth map."""

    def __post_init__(self) -> None:
        convert_fields(self)
        check_view_name(self.name)

    def __repr__(self) -> str:
        size = f"{self.camera.width}x{self.camera.height}"
        photograph = "" if self.image is not None else ", no photograph"
        return f"View({self.name!r}, {self.split}, {size} pixels{photograph})"

    def read_image(self, *, longest: int | None = None) -> UInt8[Tensor, "height width 3"]:
        """The photograph, upright, 8 bit sRGB; see `io.images.load_image`.

        Args:
            longest: Longest side in pixels; a larger photograph is reduced to it.

        Raises:
            InputError: If the view has no photograph.
            MissingFileError: If the photograph is not where it was.
        """
        return upward.load_image(self, longest=longest)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PointCloud:
    """Start points of a capture, in the world.

    What is not finite stays: readers of captures leave it out, and a fit refuses it.
    """

    points: Float[Tensor, "n 3"]

    colours: UInt8[Tensor, "n 3"] | None = None
    """Red, green, blue, 0 to 255."""

    def __post_init__(self) -> None:
        convert_fields(self)

    def __len__(self) -> int:
        return len(self.points)

    def __repr__(self) -> str:
        colours = "" if self.colours is None else ", with colours"
        return f"PointCloud({len(self):,} points{colours})"


@dataclass(frozen=True, slots=True, kw_only=True)
class ClassInfo:
    """One row of a class table."""

    id: int
    name: str

    isthing: bool = True
    """True where single objects are counted, False for stuff such as a wall."""

    colour: tuple[int, int, int] | None = None
    """Red, green, blue, 0 to 255, for images."""

    def __post_init__(self) -> None:
        convert_fields(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class ClassTable:
    """The names behind ids."""

    rows: tuple[ClassInfo, ...]

    def __post_init__(self) -> None:
        convert_fields(self)
        ids = [row.id for row in self.rows]
        if len(set(ids)) != len(ids):
            twice = sorted({i for i in ids if ids.count(i) > 1})
            raise InputError(f"classes: expected distinct ids, got {twice} more than once.")

    @boundary
    def name_of(self, id: int) -> str:
        """Name of an id, or ``id N`` where the table does not know it."""
        return next((row.name for row in self.rows if row.id == id), f"id {id}")

    @boundary
    def by_name(self, name: str) -> ClassInfo:
        """The row with this name.

        Raises:
            InputError: If there is none.
        """
        for row in self.rows:
            if row.name == name:
                return row
        known = ", ".join(row.name for row in self.rows)
        raise InputError(f"class: expected one of {known}, got {name!r}.")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _WithViews(Previewed, ABC):
    """What a capture and a scene have in common: views with names of their own, in splits."""

    views: tuple[View, ...]

    def __post_init__(self) -> None:
        convert_fields(self)
        names = [view.name for view in self.views]
        if len(set(names)) != len(names):
            twice = next(name for name in names if names.count(name) > 1)
            raise InputError(f"views: expected distinct names, got {twice!r} more than once.")

    @property
    def train_views(self) -> tuple[View, ...]:
        """Views that methods may learn from."""
        return tuple(view for view in self.views if view.split == "train")

    @property
    def test_views(self) -> tuple[View, ...]:
        """Held-out views of the split ``test``."""
        return tuple(view for view in self.views if view.split == "test")

    def view(self, name: str) -> View:
        """The view of this name.

        Raises:
            InputError: If there is none.
        """
        for view in self.views:
            if view.name == name:
                return view
        close = difflib.get_close_matches(name, [view.name for view in self.views], n=3)
        shown = ", ".join(close or [*(view.name for view in self.views[:5]), "..."])
        raise InputError(
            f"view: there is no {name!r} among {len(self.views)} views "
            f"({'close to it: ' if close else ''}{shown})."
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Capture(_WithViews):
    """What a capture folder holds: photographs with poses, and what else came with them."""

    path: Path
    format: str
    """Which reader took it: nerfstudio, colmap, llff, ..."""

    points: PointCloud | None = None
    classes: ClassTable | None = None

    up: tuple[float, float, float] | None = None
    """Direction away from the ground in the world, where the capture records it."""

    metres_per_unit: float | None = None
    """Length of a scene unit, where the capture records it."""

    splats: Path | None = None
    """A splat file that lies beside the photographs."""

    notes: tuple[str, ...] = ()
    """What a person should know of how it was read."""

    missing: tuple[str, ...] = ()
    """Photographs that it lists and that are not there, as it calls them; no view is of them."""

    def __repr__(self) -> str:
        points = "no points" if self.points is None else f"{len(self.points):,} points"
        return f"Capture({str(self.path)!r}, {self.format}: {_counted(self)}, {points})"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scene(_WithViews):
    """Gaussians with the views they came from."""

    gaussians: Gaussians
    views: tuple[View, ...] = ()
    classes: ClassTable | None = None
    up: tuple[float, float, float] | None = None
    metres_per_unit: float | None = None

    source: Path | None = None
    """Folder of the capture; evidence recorded there goes by its folder names."""

    root: Path | None = None
    """Folder of the scene, once it was saved."""

    provenance: Mapping[str, Any] = field(default_factory=dict[str, Any])
    """How it was made, in values that JSON holds."""

    def __repr__(self) -> str:
        where = "not saved" if self.root is None else repr(str(self.root))
        return f"Scene({where}: {len(self.gaussians):,} Gaussians, {_counted(self)})"

    @property
    def evidence_folders(self) -> list[Path]:
        """Where evidence is sought by name: the scene's own folder, then its capture's."""
        return [folder for folder in (self.root, self.source) if folder is not None]

    @property
    def layers(self) -> SceneLayers:
        """The layers of its folder by name, read when asked for."""
        return SceneLayers(self.root)


def _counted(views: _WithViews) -> str:
    """How many views of which split."""
    splits = [view.split for view in views.views]
    counts = ", ".join(f"{splits.count(s)} {s}" for s in dict.fromkeys(splits))
    return f"{len(splits)} views" + (f" ({counts})" if counts else "")


@boundary
def camera_of_map(view: View, height: int, width: int) -> Camera:
    """The camera of a map's pixels: the view's own, or reduced in proportion.

    Raises:
        ShapeError: If the map is larger than the photograph, or has not its proportions.
    """
    camera = view.camera
    if (height, width) == (camera.height, camera.width):
        return camera
    # A reduced side may be off by the rounding of one pixel.
    across, down = width / camera.width, height / camera.height
    out_of_proportion = abs(across - down) * max(camera.width, camera.height) > 1.0 + 1e-9
    if across > 1 or down > 1 or out_of_proportion:
        raise ShapeError(
            f"view {view.name}: expected a map of {camera.width}x{camera.height} pixels as its "
            f"photograph has, or fewer in proportion, got {width}x{height}."
        )
    return camera.resized(width, height)
