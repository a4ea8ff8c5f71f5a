"""What the server sends to the page: text messages, and pictures and id maps in binary.

Binary messages are little-endian and begin with one byte of kind.
"""

import re
import struct
import zlib
from typing import Any, Literal, TypeAlias

import msgspec
import numpy as np
from numpy.typing import NDArray

VERSION = 1
"""Of the protocol. A page of another version is told to load itself again."""

Stage = Literal["draft", "final"]
Drawing = Literal["server", "gpu"]
"""Who draws while the camera moves: the server, or the page on its own GPU."""

_PATH = re.compile(r"(?<![\w/.])(?:[A-Za-z]:)?[/\\](?:[^\s/\\:'\"]+[/\\])+")


class _Outgoing(msgspec.Struct, kw_only=True):
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
    low_pass: float
    antialiased: bool


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
    ramp: list[str]
    """Colours of the ramp that values are drawn in, evenly spaced, ``#rrggbb``."""

    document: DocumentInfo
    undo: str | None
    redo: str | None
    clients: int
    me: int
    ready: bool
    fitting: FittingInfo | None
    stage: Drawing


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


class Legend(_Outgoing, kw_only=True, tag_field="type", tag="legend"):
    """What the ends of the ramp stand for in the picture at rest of a mode; None without a ramp.

    Depth in scene units, else shares of 1.
    """

    mode: str
    ends: tuple[float, float] | None


class PointAnswer(_Outgoing, kw_only=True, tag_field="type", tag="point"):
    """A point of the scene, or none."""

    gesture: int
    point: list[float] | None


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
    State | Patch | Selected | Legend | PointAnswer | HintAnswer | Clients | Ready | Progress
    | Finished | Error
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


def codes_bytes(version: int, codes: NDArray[np.uint16]) -> bytes:
    """The objects of all Gaussians: ``O``, u32 version, u32 count, zlib of a u16 code each."""
    values = np.ascontiguousarray(codes, dtype="<u2").tobytes()
    return struct.pack("<cII", b"O", version, len(codes)) + zlib.compress(values, 1)


def selection_bytes(version: int, members: NDArray[np.bool_]) -> bytes:
    """What is selected: ``S``, u32 version, u32 count, zlib of a bit each, the highest first."""
    bits = np.packbits(members).tobytes()
    return struct.pack("<cII", b"S", version, len(members)) + zlib.compress(bits, 1)


def error_message(error: BaseException, **about: Any) -> Error:
    """What a page shows of an error: without paths, and what to do by itself."""
    text = _PATH.sub("", str(error)).rstrip(".")
    said, _, fix = text.partition("; ")
    return Error(text=said, fix=fix, **about)
