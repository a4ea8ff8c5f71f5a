"""The protocol of the page and the server, version 1: what may come, and what goes.

Every text message is a JSON object whose ``type`` names one of the classes here. What comes is
declared with its ranges, so that it is checked before anything is allocated or computed; fields
that are not declared are refused. What goes out in binary is little-endian and begins with one
byte of kind. Cameras have OpenCV axes and ``matrix`` is world_from_camera, row by row.
"""

import math
import struct
import zlib
from typing import Annotated, Any, Literal, TypeAlias, cast

import msgspec
import numpy as np
import torch
from msgspec import Meta
from numpy.typing import NDArray

from splatseg.core import Camera
from splatseg.errors import InputError, brief, reason

FEATURES = ("layer", "coco", "select_suggestion")
"""What a server can besides the first form of the protocol."""

VERSION = 1
"""Of the protocol. A page of another version is told to load itself again."""

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
Stage = Literal["draft", "final"]

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


class _Incoming(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
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
        """The camera of the renderer."""
        rows = np.array(self.matrix).reshape(4, 4)
        # The nearest rotation: what came may have been through float32.
        left, _, right = np.linalg.svd(rows[:3, :3])
        cam_from_world = np.eye(4)
        cam_from_world[:3, :3] = (left @ right).T
        cam_from_world[:3, 3] = -(left @ right).T @ rows[:3, 3]
        return Camera(
            width=self.width,
            height=self.height,
            fx=self.focal,
            fy=self.focal,
            cx=self.width / 2,
            cy=self.height / 2,
            cam_from_world=torch.from_numpy(cam_from_world),
        )


class Hello(_Incoming, kw_only=True, tag_field="type", tag="hello"):
    """The first message of a page."""

    version: int
    token: Annotated[str, Meta(max_length=200)] | None = None


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
    """Of a sphere, scene units."""

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
    Hello | DrawRequest | SelectRequest | CommandRequest | Undo | Redo | DepthRequest
    | HintRequest | JobRequest | Cancel
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
    """a x + b y + c z = d, with "plane"."""


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
    """Masks of the photographs."""

    model: Annotated[str, Meta(pattern=r"\A[a-z0-9][a-z0-9-]{0,39}\Z")] = "classical"


class Associate(_Incoming, kw_only=True):
    """A layer of the masks."""


class Export(_Incoming, kw_only=True):
    """Files for other programs."""

    what: Literal["splat", "objects", "points", "table", "coco"] = "splat"
    name: FileName
    format: Literal["ply", "compressed.ply", "splat", "spz", "sog", "glb"] | None = None
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


# What goes to the page.


class _Outgoing(msgspec.Struct, frozen=True, kw_only=True):
    """What the server sends."""


class ObjectInfo(_Outgoing, kw_only=True):
    """A row of the list of objects."""

    id: int
    name: str
    class_name: str = msgspec.field(name="class")
    colour: tuple[int, int, int]
    visible: bool
    locked: bool
    count: int
    confidence: float
    source: str
    centre: tuple[float, float, float]
    radius: float


class SelectionInfo(_Outgoing, kw_only=True):
    """How much is selected, and how surely."""

    count: int
    confidence: float
    centre: tuple[float, float, float]
    radius: float


class SuggestionInfo(_Outgoing, kw_only=True):
    """A row of the list of suggestions."""

    id: int
    name: str
    count: int
    score: float
    centre: tuple[float, float, float]
    radius: float


class EditInfo(_Outgoing, kw_only=True):
    """One edit."""

    kind: str
    count: int


class DocumentInfo(_Outgoing, kw_only=True):
    """The whole document."""

    revision: int
    objects: list[ObjectInfo]
    selection: SelectionInfo | None
    suggestions: list[SuggestionInfo]
    edits: list[EditInfo]
    isolated: list[int]


class HomeInfo(_Outgoing, kw_only=True):
    """The camera to begin with; `focal` is in pixels of `width` x `height`."""

    matrix: list[float]
    focal: float
    width: int
    height: int


class ViewInfo(_Outgoing, kw_only=True):
    """One view of the scene."""

    name: str
    matrix: list[float]
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    split: str
    photograph: bool


class SceneInfo(_Outgoing, kw_only=True):
    """What is looked at."""

    name: str
    count: int
    up: tuple[float, float, float]
    centre: tuple[float, float, float]
    radius: float
    home: HomeInfo


class FittingInfo(_Outgoing, kw_only=True):
    """How far the fit of the scene is."""

    steps: int
    progress: float


class State(_Outgoing, kw_only=True, tag_field="type", tag="state"):
    """Everything, to a page that joins."""

    version: int = VERSION
    scene: SceneInfo
    views: list[ViewInfo]
    layers: list[str]
    source: str | None
    words: bool
    modes: list[str]
    features: list[str]
    document: DocumentInfo
    undo: str | None
    redo: str | None
    clients: int
    me: int
    ready: bool
    fitting: FittingInfo | None


class Patch(_Outgoing, kw_only=True, tag_field="type", tag="patch"):
    """What changed from one revision to another."""

    from_: int = msgspec.field(name="from")
    to: int
    objects: list[ObjectInfo]
    gone: list[int]
    order: list[int] | None
    suggestions: list[SuggestionInfo] | None
    selection: SelectionInfo | None
    edits: list[EditInfo] | None
    isolated: list[int] | None
    undo: str | None
    redo: str | None
    author: str


class Selected(_Outgoing, kw_only=True, tag_field="type", tag="selected"):
    """The answer to a selection; a draft comes before the final one."""

    gesture: int
    stage: Stage
    count: int
    confidence: float
    milliseconds: float
    stages: dict[str, float]


class PointAnswer(_Outgoing, kw_only=True, tag_field="type", tag="point"):
    """A point of the scene, or none."""

    gesture: int
    point: tuple[float, float, float] | None


class HintAnswer(_Outgoing, kw_only=True, tag_field="type", tag="hint"):
    """Where the next click would help; all None where nowhere."""

    x: float | None = None
    y: float | None = None
    view: str | None = None


class Clients(_Outgoing, kw_only=True, tag_field="type", tag="clients"):
    """How many pages are open."""

    n: int


class Ready(_Outgoing, kw_only=True, tag_field="type", tag="ready"):
    """The first click will be quick."""


class Progress(_Outgoing, kw_only=True, tag_field="type", tag="progress"):
    """How far a job is."""

    id: int
    done: int
    total: int
    text: str


class Finished(_Outgoing, kw_only=True, tag_field="type", tag="finished"):
    """A job is done."""

    id: int
    result: dict[str, str | None]


class Error(_Outgoing, kw_only=True, tag_field="type", tag="error"):
    """What could not be done, and what to do."""

    text: str
    fix: str = ""
    gesture: int | None = None
    id: int | None = None
    command: str | None = None


Outgoing: TypeAlias = (
    State | Patch | Selected | PointAnswer | HintAnswer | Clients | Ready | Progress | Finished
    | Error
)  # fmt: skip


def form(message: Outgoing) -> str:
    """A message as text."""
    return msgspec.json.encode(message).decode()


def frame_bytes(
    camera: int, jpeg: bytes, *, draw: float, encode: float, scale: float, rest: bool
) -> bytes:
    """A picture: ``F``, u32 camera, f32 ms of drawing and of encoding, f32 scale, u8 rest, JPEG."""
    return struct.pack("<cIfffB", b"F", camera, draw, encode, scale, rest) + jpeg


def id_map_bytes(camera: int, ids: NDArray[np.uint16]) -> bytes:
    """An id map: ``I``, u32 camera, u16 width and height, zlib of the u16 values row by row."""
    height, width = ids.shape
    values = np.ascontiguousarray(ids, dtype="<u2").tobytes()
    return struct.pack("<cIHH", b"I", camera, width, height) + zlib.compress(values, 1)
