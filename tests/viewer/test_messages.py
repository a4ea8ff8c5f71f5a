"""The protocol: what comes is checked against its declaration, what goes has the declared bytes."""

import json
import struct
import zlib

import msgspec
import numpy as np
import pytest
import torch

from splatseg.errors import InputError
from splatseg.viewer import _messages as messages
from support.viewer import json_camera

EYE = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
CAMERA = {"width": 64, "height": 48, "focal": 50, "matrix": EYE}
DRAW = {"type": "camera", "id": 1, **CAMERA}
SELECT = {"type": "select", "gesture": 3, "kind": "click", "camera": CAMERA, "points": [[1, 2]]}
ROTATION = np.array([[0, -1, 0, 3], [1, 0, 0, 4], [0, 0, 1, 5], [0, 0, 0, 1]], dtype=float)


def parsed(value: object) -> messages.Incoming:
    return messages.parse(json.dumps(value))


def without(value: dict[str, object], name: str) -> dict[str, object]:
    return {key: kept for key, kept in value.items() if key != name}


@pytest.mark.parametrize(
    ("value", "kind"),
    [
        ({"type": "hello", "version": 1}, messages.Hello),
        ({"type": "hello", "version": 1, "stage": "gpu"}, messages.Hello),
        ({"type": "stage", "stage": "gpu"}, messages.StageRequest),
        (DRAW, messages.DrawRequest),
        (SELECT, messages.SelectRequest),
        ({"type": "command", "name": "keep", "arguments": {}, "revision": 3},
         messages.CommandRequest),
        ({"type": "undo"}, messages.Undo),
        ({"type": "redo"}, messages.Redo),
        ({"type": "depth", "gesture": 1, "camera": CAMERA, "x": 3, "y": 4},
         messages.DepthRequest),
        ({"type": "hint"}, messages.HintRequest),
        ({"type": "job", "id": 1, "name": "see"}, messages.JobRequest),
        ({"type": "cancel", "id": 1}, messages.Cancel),
    ],
)  # fmt: skip
def test_each_type_is_a_class_of_its_own(value, kind) -> None:
    assert type(parsed(value)) is kind


def test_a_camera_may_show_a_move_under_way() -> None:
    plain = parsed(DRAW)
    assert isinstance(plain, messages.DrawRequest)
    assert plain.preview is None
    motion = {"ids": None, "translation": [1, 2, 3], "scale": 2, "about": [0, 0, 1]}
    moved = parsed({**DRAW, "preview": motion})
    assert isinstance(moved, messages.DrawRequest)
    assert moved.preview == messages.Move(translation=(1, 2, 3), scale=2, about=(0, 0, 1))


def test_defaults_are_those_of_the_protocol() -> None:
    drawn, selected = parsed(DRAW), parsed(SELECT)
    assert isinstance(drawn, messages.DrawRequest)
    assert (drawn.mode, drawn.only, drawn.rest, drawn.ids) == ("colour", None, False, False)
    assert isinstance(selected, messages.SelectRequest)
    assert (selected.level, selected.mode, selected.width, selected.view) == (0.5, "set", 12, None)
    assert selected.points == [(1, 2)]
    assert selected.negative == []
    assert selected.text == ""


REFUSED = {
    "a hello of no known stage": {"type": "hello", "version": 1, "stage": "tpu"},
    "no known stage": {"type": "stage", "stage": "forced"},
    "a stage of nothing": {"type": "stage"},
    "a stage with more": {"type": "stage", "stage": "gpu", "path": "/"},
    "no type": without(DRAW, "type"),
    "another type": {"type": "exec"},
    "a list": [1],
    "an unknown field": {**DRAW, "shell": "ls"},
    "no camera id": without(DRAW, "id"),
    "a negative id": {**DRAW, "id": -1},
    "an id of more than 32 bits": {**DRAW, "id": 2**32},
    "text for a number": {**DRAW, "width": "64"},
    "a fraction of a pixel": {**DRAW, "width": 64.5},
    "too small": {**DRAW, "width": 15},
    "too wide": {**DRAW, "width": 4097},
    "too high": {**DRAW, "height": 4097},
    "too many pixels": {**DRAW, "width": 4096, "height": 4096},
    "no focal length": {**DRAW, "focal": 0},
    "a short matrix": {**DRAW, "matrix": EYE[:15]},
    "a long matrix": {**DRAW, "matrix": [*EYE, 0]},
    "a scaled matrix": {**DRAW, "matrix": [2, *EYE[1:]]},
    "a mirror": {**DRAW, "matrix": [-1, *EYE[1:]]},
    "a projective matrix": {**DRAW, "matrix": [*EYE[:12], 0, 0, 1, 1]},
    "a far place": {**DRAW, "matrix": [1, 0, 0, 1e300, *EYE[4:]]},
    "another mode": {**DRAW, "mode": "../secret"},
    "an object below 0": {**DRAW, "only": -5},
    "a preview of another form": {**DRAW, "preview": {"colour": [1, 2, 3]}},
    "a preview of no size": {**DRAW, "preview": {"scale": 0}},
    "a preview turned by nothing": {**DRAW, "preview": {"rotation": [0, 0, 0, 0]}},
    "a preview far away": {**DRAW, "preview": {"translation": [1e10, 0, 0]}},
    "another kind": {**SELECT, "kind": "everything"},
    "points of three": {**SELECT, "points": [[1, 2, 3]]},
    "too many points": {**SELECT, "points": [[1, 2]] * 4001},
    "a point far outside": {**SELECT, "points": [[1e9, 0]]},
    "a level above 1": {**SELECT, "level": 1.01},
    "a level below 0": {**SELECT, "level": -0.01},
    "no radius": {**SELECT, "radius": 0},
    "a wide stroke": {**SELECT, "width": 1001},
    "a long text": {**SELECT, "text": "a" * 201},
    "a long name of a view": {**SELECT, "view": "a" * 801},
    "another selection mode": {**SELECT, "mode": "replace"},
    "a revision below 0": {"type": "command", "name": "keep", "revision": -1},
}


@pytest.mark.parametrize("value", REFUSED.values(), ids=REFUSED)
def test_what_is_not_declared_is_refused_in_a_sentence(value) -> None:
    with pytest.raises(InputError, match=r"^message: .*\.$"):
        parsed(value)


@pytest.mark.parametrize(
    "text",
    ["", "{", "null", "NaN", '{"type": "hello", "version": NaN}',
     '{"type": "camera", "id": 1, "width": 1e400}', "[" * 3000, "\ud800", '"hello"',
     '{"type": "hello", "version": 1, "version": "x"}'],
)  # fmt: skip
def test_what_is_no_json_object_is_refused(text: str) -> None:
    with pytest.raises(InputError):
        messages.parse(text)


def test_matrices_may_have_been_through_float32() -> None:
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    matrix = np.eye(4)
    matrix[:3, :3] = turn.astype(np.float32)
    drawn = parsed({**DRAW, "matrix": matrix.ravel().tolist()})
    assert isinstance(drawn, messages.DrawRequest)
    rotation = drawn.camera().cam_from_world[:3, :3].numpy()
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(rotation, turn.T, atol=1e-6)


def test_a_camera_is_the_renderers() -> None:
    drawn = parsed({**DRAW, "matrix": ROTATION.ravel().tolist()})
    assert isinstance(drawn, messages.DrawRequest)
    camera = drawn.camera()
    assert (camera.width, camera.height, camera.fx, camera.fy) == (64, 48, 50, 50)
    assert (camera.cx, camera.cy) == (32, 24)
    torch.testing.assert_close(camera.world_from_cam, torch.from_numpy(ROTATION))


def test_long_messages_are_those_with_strokes_and_lists_alone() -> None:
    points = [[float(i), 0.5] for i in range(1000)]
    assert parsed({**SELECT, "points": points})
    ids = {"type": "command", "name": "accept", "arguments": {"ids": list(range(2000))}}
    assert parsed(ids)
    with pytest.raises(InputError, match="at most 4096 bytes, got 4"):
        messages.parse(json.dumps(DRAW) + " " * messages.MAX_TEXT)
    with pytest.raises(InputError, match="at most 65536 bytes"):
        messages.parse(json.dumps(SELECT) + " " * messages.MAX_LONG_TEXT)
    # Four bytes a letter: it is bytes that count.
    with pytest.raises(InputError, match="at most 65536 bytes"):
        messages.parse(json.dumps("\N{GRINNING FACE}" * 20_000, ensure_ascii=False))


COMMANDS = {
    "keep": {"name": "mug", "class_name": "cup", "colour": [1, 2, 3]},
    "rename": {"id": 1, "name": "mug"},
    "set_class": {"ids": [1], "class_name": "cup"},
    "set_colour": {"ids": [1], "colour": [0, 255, 3]},
    "set_visible": {"ids": [1, 2], "visible": False},
    "set_locked": {"ids": [1], "locked": True},
    "isolate": {"ids": []},
    "join": {"ids": [1, 2]},
    "split": {"id": 1, "by": "plane", "plane": [0, 0, 1, 2]},
    "subtract": {"id": 1},
    "refine": {"id": 1},
    "delete": {"ids": [1]},
    "accept": {"ids": [0]},
    "reject": {"ids": [0]},
    "select_object": {"id": 1, "mode": "add"},
    "select_suggestion": {"id": 1},
    "remove": {},
    "duplicate": {"translation": [1, 0, 0]},
    "move": {"ids": [1], "rotation": [1, 0, 0, 0], "scale": 2},
    "recolour": {"colour": [1, 2, 3]},
}


@pytest.mark.parametrize("name", messages.COMMANDS)
def test_arguments_of_commands_are_declared(name: str) -> None:
    request = parsed({"type": "command", "name": name, "arguments": COMMANDS[name]})
    assert isinstance(request, messages.CommandRequest)
    given = messages.arguments(request)
    assert type(given) is messages.COMMANDS[name]
    for key, value in COMMANDS[name].items():
        assert json.loads(msgspec.json.encode(getattr(given, key))) == value


BAD_ARGUMENTS = [
    ("format_disk", {}),
    ("rename", {"id": 1}),
    ("rename", {"id": 1, "name": ""}),
    ("rename", {"id": 1, "name": "a" * 81}),
    ("rename", {"id": 2**31, "name": "a"}),
    ("rename", {"id": -1, "name": "a"}),
    ("rename", {"id": "1", "name": "a"}),
    ("delete", {"ids": []}),
    ("delete", {"ids": [1] * 4001}),
    ("set_colour", {"ids": [1], "colour": [1, 2, 256]}),
    ("set_colour", {"ids": [1], "colour": [1, 2]}),
    ("split", {"id": 1, "by": "axe"}),
    ("move", {"rotation": [0, 0, 0, 0]}),
    ("move", {"scale": 0}),
    ("move", {"scale": 1e7}),
    ("move", {"translation": [1e10, 0, 0]}),
    ("select_object", {}),
    ("select_object", {"id": 1, "ids": [1]}),
    ("keep", {"name": "a", "mask": {"id": "0" * 32, "count": 1}}),
    ("keep", []),
]


@pytest.mark.parametrize(("name", "given"), BAD_ARGUMENTS)
def test_other_arguments_are_refused(name: str, given: object) -> None:
    request = parsed({"type": "command", "name": name, "arguments": given})
    assert isinstance(request, messages.CommandRequest)
    with pytest.raises(InputError, match=rf"^({name}|command): .*\.$"):
        messages.arguments(request)


@pytest.mark.parametrize(
    ("name", "given"),
    [
        ("shell", {}),
        ("see", {"model": "../x"}),
        ("see", {"model": "a" * 60}),
        ("export", {}),
        ("export", {"name": "../../x"}),
        ("export", {"name": ".hidden"}),
        ("export", {"name": "a/b"}),
        ("export", {"name": "a\n"}),
        ("export", {"name": "x", "what": "all"}),
        ("export", {"name": "x", "format": "exe"}),
        ("save_layer", {"name": ""}),
        ("film", {"camera": CAMERA, "frames": 1001}),
        ("film", {"camera": CAMERA, "frames": 1}),
        ("picture", {"camera": {**CAMERA, "width": 10**6}}),
        ("picture", {"camera": CAMERA, "name": "/etc/passwd"}),
    ],
)
def test_arguments_of_jobs_are_declared(name: str, given: object) -> None:
    request = parsed({"type": "job", "id": 1, "name": name, "arguments": given})
    assert isinstance(request, messages.JobRequest)
    with pytest.raises(InputError, match=rf"^({name}|job): .*\.$"):
        messages.arguments(request)


def test_a_picture_has_its_head() -> None:
    data = messages.frame_bytes(2**32 - 1, b"JPEG", draw=1.5, encode=2.5, scale=0.5, rest=True)
    assert data[:1] == b"F"
    assert struct.unpack_from("<I", data, 1) == (2**32 - 1,)
    assert struct.unpack_from("<fff", data, 5) == (1.5, 2.5, 0.5)
    assert data[17] == 1
    assert data[18:] == b"JPEG"


def test_an_id_map_has_its_head_and_its_rows() -> None:
    ids = np.array([[0, 1, 2], [65535, 256, 3]], dtype=np.uint16)
    data = messages.id_map_bytes(7, ids)
    assert data[:1] == b"I"
    assert struct.unpack_from("<IHH", data, 1) == (7, 3, 2)
    assert zlib.decompress(data[9:]) == b"\0\0\1\0\2\0\xff\xff\0\1\3\0"


def test_streams_have_their_head_and_a_value_of_each_gaussian() -> None:
    codes = np.array([0, 1, 4095, 258], dtype=np.uint16)
    data = messages.codes_bytes(2**32 - 1, codes)
    assert struct.unpack("<cII", data[:9]) == (b"O", 2**32 - 1, 4)
    assert zlib.decompress(data[9:]) == bytes([0, 0, 1, 0, 255, 15, 2, 1])
    members = np.array([True, False, True, False, False, False, False, True, False, True])
    data = messages.selection_bytes(3, members)
    assert struct.unpack("<cII", data[:9]) == (b"S", 3, 10)
    assert zlib.decompress(data[9:]) == bytes([0b10100001, 0b01000000])


def test_words_that_python_reserves_are_written_as_the_protocol_has_them() -> None:
    made = messages.Patch(
        from_=1, to=2, objects=[], gone=[], order=None, suggestions=None, selection=None,
        edits=None, isolated=None, undo="Select", redo=None, author="3",
    )  # fmt: skip
    said = json.loads(messages.form(made))
    assert said["type"] == "patch"
    assert (said["from"], said["to"]) == (1, 2)
    row = messages.ObjectInfo(
        id=1, name="</script>", class_name="cup", colour=(1, 2, 3), visible=True, locked=False,
        count=5, confidence=1.0, source="", centre=(0, 0, 0), radius=1,
    )  # fmt: skip
    assert json.loads(msgspec.json.encode(row))["class"] == "cup"


def test_the_same_camera_is_the_same_object() -> None:
    given = json_camera()
    one = messages.ViewCamera(**given).camera()
    assert messages.DrawRequest(id=3, **given).camera() is one
    for name, value in {"width": 97, "height": 73, "focal": 91.0}.items():
        other = messages.ViewCamera(**(given | {name: value})).camera()
        assert other is not one
        assert (other.width, other.height, other.fx) == tuple(
            (given | {name: value})[key] for key in ("width", "height", "focal")
        )
