"""The protocol of the page and the server, version 1: what may come; what goes is `_outgoing`.

Every text message is a JSON object whose ``type`` names one of the classes here. What comes is
declared with its ranges, so that it is checked before anything is allocated or computed; fields
that are not declared are refused. Cameras have OpenCV axes, and ``matrix`` is world_from_camera,
row by row.
"""

import functools
import math
from typing import Annotated, Any, Literal, TypeAlias, cast

import msgspec
import numpy as np
import torch
from msgspec import Meta

from splatseg.core import Camera
from splatseg.errors import InputError, brief, reason
from splatseg.io.splats import WritableFormat
from splatseg.viewer._outgoing import VERSION as VERSION
from splatseg.viewer._outgoing import Clients as Clients
from splatseg.viewer._outgoing import DocumentInfo as DocumentInfo
from splatseg.viewer._outgoing import Drawing as Drawing
from splatseg.viewer._outgoing import EditInfo as EditInfo
from splatseg.viewer._outgoing import Error as Error
from splatseg.viewer._outgoing import Finished as Finished
from splatseg.viewer._outgoing import FittingInfo as FittingInfo
from splatseg.viewer._outgoing import HintAnswer as HintAnswer
from splatseg.viewer._outgoing import HomeInfo as HomeInfo
from splatseg.viewer._outgoing import Legend as Legend
from splatseg.viewer._outgoing import ObjectInfo as ObjectInfo
from splatseg.viewer._outgoing import Outgoing as Outgoing
from splatseg.viewer._outgoing import Patch as Patch
from splatseg.viewer._outgoing import PointAnswer as PointAnswer
from splatseg.viewer._outgoing import Progress as Progress
from splatseg.viewer._outgoing import Ready as Ready
from splatseg.viewer._outgoing import SceneInfo as SceneInfo
from splatseg.viewer._outgoing import Selected as Selected
from splatseg.viewer._outgoing import SelectionInfo as SelectionInfo
from splatseg.viewer._outgoing import Stage as Stage
from splatseg.viewer._outgoing import State as State
from splatseg.viewer._outgoing import SuggestionInfo as SuggestionInfo
from splatseg.viewer._outgoing import ViewInfo as ViewInfo
from splatseg.viewer._outgoing import codes_bytes as codes_bytes
from splatseg.viewer._outgoing import error_message as error_message
from splatseg.viewer._outgoing import form as form
from splatseg.viewer._outgoing import frame_bytes as frame_bytes
from splatseg.viewer._outgoing import id_map_bytes as id_map_bytes
from splatseg.viewer._outgoing import selection_bytes as selection_bytes

FEATURES = ("layer", "coco", "select_suggestion", "preview")
"""What a server can besides the first form of the protocol."""

MAX_TEXT = 4096
"""Most bytes of a text message."""

MAX_LONG_TEXT = 65536
"""Most bytes of a selection or a command: strokes and lists of ids are long."""

MAX_SIDE = 4096
"""Most pixels a side of what is drawn."""

_MAX_PIXELS = 1 << 23
_RIGID = 1e-4
"""How far rows of a rotation may be from unit length and from right angles: a page has float32."""

Mode = Literal["colour", "objects", "blend", "confidence", "depth", "pca", "similarity"]
SelectMode = Literal["set", "add", "remove", "intersect"]
SelectKind = Literal[
    "click", "box", "stroke", "lasso", "polygon", "sphere", "words", "similar", "layer", "all",
    "none", "invert", "grow", "shrink", "fill",
]  # fmt: skip

Number = Annotated[int, Meta(ge=0, le=2**32 - 1)]
Id = Annotated[int, Meta(ge=0, le=2**31 - 1)]
Ids = Annotated[list[Id], Meta(min_length=1, max_length=4000)]
Side = Annotated[int, Meta(ge=16, le=MAX_SIDE)]
Coordinate = Annotated[float, Meta(ge=-1e6, le=1e6)]
World = Annotated[float, Meta(ge=-1e9, le=1e9)]
Point = tuple[Coordinate, Coordinate]
Points = Annotated[list[Point], Meta(max_length=4000)]
Vector = tuple[World, World, World]
Quaternion = tuple[World, World, World, World]
Byte = Annotated[int, Meta(ge=0, le=255)]
Colour = tuple[Byte, Byte, Byte]
Name = Annotated[str, Meta(min_length=1, max_length=80)]
OptionalName = Annotated[str, Meta(max_length=80)]
ClassName = Annotated[str, Meta(max_length=80)]
FileName = Annotated[str, Meta(pattern=r"\A[A-Za-z0-9][A-Za-z0-9._-]{0,79}\Z")]
LayerName = Annotated[str, Meta(min_length=1, max_length=200)]
Matrix = Annotated[list[World], Meta(min_length=16, max_length=16)]


class _Incoming(msgspec.Struct, kw_only=True, forbid_unknown_fields=True):
    """What the page may send."""


class ViewCamera(_Incoming, kw_only=True):
    """A pinhole camera with its principal point in the middle of its pixels."""

    width: Side
    height: Side
    focal: Annotated[float, Meta(ge=1, le=1e6)]
    """Pixels of `width` x `height`."""

    matrix: Matrix
    """world_from_camera, row by row."""

    def __post_init__(self) -> None:
        if self.width * self.height > _MAX_PIXELS:
            raise ValueError(f"expected at most {_MAX_PIXELS} pixels")
        rows = np.array(self.matrix).reshape(4, 4)
        rotation = rows[:3, :3]
        straight = np.abs(rotation @ rotation.T - np.eye(3)).max() <= _RIGID
        if not straight or np.linalg.det(rotation) < 0 or rows[3].tolist() != [0, 0, 0, 1]:
            raise ValueError("expected a rigid matrix, a rotation and a translation")

    def camera(self) -> Camera:
        """The camera of the renderer; the same object while it is the same camera."""
        return _camera(self.width, self.height, self.focal, tuple(self.matrix))


@functools.lru_cache(maxsize=16)
def _camera(width: int, height: int, focal: float, matrix: tuple[float, ...]) -> Camera:
    """A camera of the renderer. What is prepared for one is found by the object that it is."""
    rows = np.array(matrix).reshape(4, 4)
    # The nearest rotation: what came may have been through float32.
    left, _, right = np.linalg.svd(rows[:3, :3])
    cam_from_world = np.eye(4)
    cam_from_world[:3, :3] = (left @ right).T
    cam_from_world[:3, 3] = -(left @ right).T @ rows[:3, 3]
    return Camera(
        width=width,
        height=height,
        fx=focal,
        fy=focal,
        cx=width / 2,
        cy=height / 2,
        cam_from_world=torch.from_numpy(cam_from_world),
    )


class Hello(_Incoming, kw_only=True, tag_field="type", tag="hello"):
    """The first message of a page."""

    version: int
    token: Annotated[str, Meta(max_length=200)] | None = None
    stage: Drawing = "server"
    """A page that draws is told what each Gaussian belongs to."""


class StageRequest(_Incoming, kw_only=True, tag_field="type", tag="stage"):
    """Another one draws from now on."""

    stage: Drawing


class DrawRequest(ViewCamera, kw_only=True, tag_field="type", tag="camera"):
    """Draw this; the newest camera of a page replaces one that was not drawn yet."""

    id: Number
    mode: Mode = "colour"
    only: Id | None = None
    """Draw this object alone."""

    rest: bool = False
    """The camera stands still: full size."""

    ids: bool = False
    """Whether an id map is to follow the picture at rest."""

    preview: "Move | None" = None
    """A move under way, which is drawn and changes nothing."""


class SelectRequest(_Incoming, kw_only=True, tag_field="type", tag="select"):
    """What a person shows. Pixels are those of `camera`, or of the photograph `view`."""

    gesture: Number
    kind: SelectKind
    camera: ViewCamera | None = None
    view: Annotated[str, Meta(max_length=800)] | None = None
    points: Points = msgspec.field(default_factory=lambda: cast("list[Point]", []))
    negative: Points = msgspec.field(default_factory=lambda: cast("list[Point]", []))
    box: tuple[Coordinate, Coordinate, Coordinate, Coordinate] | None = None
    width: Annotated[float, Meta(ge=1, le=1000)] = 12.0
    """Of a stroke, pixels."""

    radius: Annotated[float, Meta(gt=0, le=1e9)] | None = None
    """Of the balls of a sphere brush, scene units; `points` are where it went."""

    text: Annotated[str, Meta(max_length=200)] = ""
    level: Annotated[float, Meta(ge=0, le=1)] = 0.5
    mode: SelectMode = "set"


class CommandRequest(_Incoming, kw_only=True, tag_field="type", tag="command"):
    """A change of the document."""

    name: str
    arguments: msgspec.Raw = msgspec.field(default_factory=lambda: msgspec.Raw(b"{}"))
    revision: Annotated[int, Meta(ge=0, le=2**53)] | None = None
    """Of the document that it was made on; None does not compare."""


class Undo(_Incoming, kw_only=True, tag_field="type", tag="undo"):
    """Undo the last command of all."""


class Redo(_Incoming, kw_only=True, tag_field="type", tag="redo"):
    """Do again what was undone."""


class DepthRequest(_Incoming, kw_only=True, tag_field="type", tag="depth"):
    """The point of the scene under a pixel."""

    gesture: Number
    camera: ViewCamera
    x: Coordinate
    y: Coordinate


class HintRequest(_Incoming, kw_only=True, tag_field="type", tag="hint"):
    """Where the next click would help most, when there is time."""


class JobRequest(_Incoming, kw_only=True, tag_field="type", tag="job"):
    """Long work."""

    id: Number
    name: str
    arguments: msgspec.Raw = msgspec.field(default_factory=lambda: msgspec.Raw(b"{}"))


class Cancel(_Incoming, kw_only=True, tag_field="type", tag="cancel"):
    """End a job."""

    id: Number


Incoming: TypeAlias = (
    Hello | StageRequest | DrawRequest | SelectRequest | CommandRequest | Undo | Redo
    | DepthRequest | HintRequest | JobRequest | Cancel
)  # fmt: skip


# Arguments of commands, by name. Masks never travel: what needs one means the selection.


class OfIds(_Incoming, kw_only=True):
    """Objects, or suggestions."""

    ids: Ids


class OfId(_Incoming, kw_only=True):
    """One object."""

    id: Id


class Keep(_Incoming, kw_only=True):
    """The selection as an object; without a name one is made up."""

    name: OptionalName = ""
    class_name: ClassName = ""
    colour: Colour | None = None


class Rename(_Incoming, kw_only=True):
    """Another name."""

    id: Id
    name: Name


class SetClass(OfIds, kw_only=True):
    """Another class."""

    class_name: ClassName


class SetColour(OfIds, kw_only=True):
    """Another colour of the label."""

    colour: Colour


class SetVisible(OfIds, kw_only=True):
    """Shown or hidden."""

    visible: bool


class SetLocked(OfIds, kw_only=True):
    """Locked or free."""

    locked: bool


class Isolate(_Incoming, kw_only=True):
    """These alone are shown; of none, all are."""

    ids: Annotated[list[Id], Meta(max_length=4000)]


class Join(OfIds, kw_only=True):
    """Several objects as one, called as the first where no name is given."""

    name: OptionalName = ""


class Split(OfId, kw_only=True):
    """One object as several."""

    by: Literal["parts", "tree", "plane"] = "parts"
    plane: tuple[World, World, World, World] | None = None
    """a, b, c, d of a x + b y + c z + d = 0, with "plane"."""


class SelectObject(_Incoming, kw_only=True):
    """The selection is an object or several, or is changed by them."""

    id: Id | None = None
    ids: Ids | None = None
    mode: SelectMode = "set"

    def __post_init__(self) -> None:
        if (self.id is None) == (self.ids is None):
            raise ValueError("expected an id, or ids")


class SelectSuggestion(OfId, kw_only=True):
    """The selection is a suggestion, or is changed by it."""

    mode: SelectMode = "set"


class EditOf(_Incoming, kw_only=True):
    """Gaussians of objects; without ids those of the selection."""

    ids: Ids | None = None


class Move(EditOf, kw_only=True):
    """Where to: x -> about + scale * rotation (x - about) + translation."""

    rotation: Quaternion = (1.0, 0.0, 0.0, 0.0)
    """wxyz."""

    translation: Vector = (0.0, 0.0, 0.0)
    scale: Annotated[float, Meta(ge=1e-6, le=1e6)] = 1.0
    about: Vector | None = None
    """None is the middle of what is moved."""

    def __post_init__(self) -> None:
        if not 1e-6 < math.hypot(*self.rotation) < 1e6:
            raise ValueError("expected a rotation, a quaternion that is not 0")


class Recolour(EditOf, kw_only=True):
    """Another colour of the Gaussians."""

    colour: Colour


COMMANDS: dict[str, type[_Incoming]] = {
    "keep": Keep,
    "rename": Rename,
    "set_class": SetClass,
    "set_colour": SetColour,
    "set_visible": SetVisible,
    "set_locked": SetLocked,
    "isolate": Isolate,
    "join": Join,
    "split": Split,
    "subtract": OfId,
    "refine": OfId,
    "delete": OfIds,
    "accept": OfIds,
    "reject": OfIds,
    "select_object": SelectObject,
    "select_suggestion": SelectSuggestion,
    "remove": EditOf,
    "duplicate": Move,
    "move": Move,
    "recolour": Recolour,
}
"""Names of commands, and their arguments."""


class See(_Incoming, kw_only=True):
    """Masks of the views."""

    model: Annotated[str, Meta(pattern=r"\A[a-z0-9][a-z0-9-]{0,39}\Z")] | None = None
    """None takes what is at hand: masks that are there, weights on this machine, or ``regions``,
    which needs none."""


class Associate(_Incoming, kw_only=True):
    """A layer of the masks."""


class Export(_Incoming, kw_only=True):
    """Files for other programs."""

    what: Literal["splat", "objects", "points", "table", "coco"] = "splat"
    name: FileName
    format: WritableFormat | None = None
    """Of splats; None goes by the ending of `name`, and is PLY without one."""

    ids: Ids | None = None


class SaveLayer(_Incoming, kw_only=True):
    """The objects as a layer of the scene."""

    name: LayerName


class Still(_Incoming, kw_only=True):
    """A picture as a file."""

    camera: ViewCamera
    mode: Mode = "colour"
    name: FileName = "picture"


class Film(Still, kw_only=True):
    """A turntable, as a film."""

    frames: Annotated[int, Meta(ge=2, le=1000)] = 120
    name: FileName = "turntable"


class Suggest(_Incoming, kw_only=True):
    """Objects of a layer, to accept or to reject."""

    layer: LayerName


JOBS: dict[str, type[_Incoming]] = {
    "see": See,
    "associate": Associate,
    "export": Export,
    "save_layer": SaveLayer,
    "picture": Still,
    "film": Film,
    "suggest": Suggest,
}
"""Names of jobs, and their arguments."""

_decoder = msgspec.json.Decoder(Incoming)


def parse(text: str) -> Incoming:
    """A message of the page.

    Raises:
        InputError: If it is too long, no JSON, or not of a declared form.
    """
    data = text.encode(errors="replace")
    _check_length(len(data), MAX_LONG_TEXT)
    try:
        message = _decoder.decode(data)
    except (msgspec.DecodeError, RecursionError) as error:
        raise InputError(f"message: {_said(error)}.") from error
    if not isinstance(message, SelectRequest | CommandRequest):
        _check_length(len(data), MAX_TEXT)
    return message


def _check_length(length: int, limit: int) -> None:
    if length > limit:
        raise InputError(f"message: expected at most {limit} bytes, got {length}.")


def arguments(request: CommandRequest | JobRequest) -> Any:
    """The arguments of a command or a job, as `COMMANDS` or `JOBS` declare them.

    Raises:
        InputError: If there is none of the name, or the arguments are of another form.
    """
    kinds = COMMANDS if isinstance(request, CommandRequest) else JOBS
    what = "command" if isinstance(request, CommandRequest) else "job"
    kind = kinds.get(request.name)
    if kind is None:
        raise InputError(f"{what}: expected one of {', '.join(kinds)}, got {brief(request.name)}.")
    try:
        return msgspec.json.decode(request.arguments, type=kind)
    except (msgspec.DecodeError, RecursionError) as error:
        raise InputError(f"{request.name}: {_said(error)}.") from error


def _said(error: BaseException) -> str:
    """What msgspec found, as the rest of a sentence."""
    words = reason(error)
    return words if words[:2].isupper() else words[:1].lower() + words[1:]
