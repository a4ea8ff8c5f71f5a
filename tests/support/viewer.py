"""A page without a browser: what it sends and gets, and a scene of three things to be served."""

import json
import struct
import zlib
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import httpx
import numpy as np
import torch
from numpy.typing import NDArray
from websockets.sync.client import ClientConnection, connect

from splatseg.core import Camera, Gaussians, InstanceFacts, Labels, LayerInfo, Scene, View
from splatseg.core.sh import SH_C0
from splatseg.io.images import write_png
from splatseg.io.scene import save_scene, save_scene_layer

WIDTH, HEIGHT, FOCAL = 96, 72, 90.0
EACH = 150
RED, BLUE, GREEN = (0.9, 0.1, 0.1), (0.1, 0.1, 0.9), (0.1, 0.8, 0.1)
MATRIX = np.array([[1, 0, 0, 0], [0, 0, 1, -4], [0, -1, 0, 0], [0, 0, 0, 1]], dtype=float)
"""world_from_camera: from (0, -4, 0) along y, z up."""

RED_PIXEL, BLUE_PIXEL, NOTHING = (26.0, 36.0), (70.0, 36.0), (2.0, 2.0)


def camera() -> Camera:
    return Camera(
        width=WIDTH, height=HEIGHT, fx=FOCAL, fy=FOCAL, cx=WIDTH / 2, cy=HEIGHT / 2,
        cam_from_world=torch.from_numpy(np.linalg.inv(MATRIX)),
    )  # fmt: skip


def write_scene(folder: Path) -> Path:
    """A red ball on the left, a blue one on the right, a green one high behind; with a layer."""
    rng = np.random.default_rng(5)
    centres = np.array([[-1, 0, 0], [1, 0, 0], [0, 3, 1.5]])
    ways = rng.normal(size=(3, EACH, 3))
    ways /= np.linalg.norm(ways, axis=2, keepdims=True)
    means = (centres[:, None] + 0.4 * ways * rng.uniform(0, 1, (3, EACH, 1)) ** (1 / 3)).reshape(
        -1, 3
    )
    colours = np.repeat(np.array([RED, BLUE, GREEN]), EACH, axis=0)
    count = len(means)
    gaussians = Gaussians(
        means=torch.from_numpy(means).float(),
        rotations=torch.eye(4)[:1].repeat(count, 1),
        scales=torch.full((count, 3), 0.08),
        opacities=torch.full((count,), 0.9),
        sh=torch.from_numpy((colours - 0.5) / SH_C0).float().unsqueeze(1),
    )
    photograph = folder.parent / "photographs" / "first.png"
    photograph.parent.mkdir(parents=True, exist_ok=True)
    image = np.full((HEIGHT, WIDTH, 3), (200, 100, 50), dtype=np.uint8)
    image[26:46, 16:36] = (20, 200, 220)  # where the red ball is
    write_png(image, photograph)
    view = View(name="first", camera=camera(), image=photograph)
    scene = Scene(gaussians=gaussians, views=(view,), up=(0.0, 0.0, 1.0))
    save_scene(scene, folder)
    ids = 1 + torch.arange(3).repeat_interleave(EACH)
    info = LayerInfo(method="hand", instances={i: InstanceFacts() for i in (1, 2, 3)})
    layer = Labels(ids=ids.int(), confidence=torch.ones(count), info=info)
    save_scene_layer(layer, folder, "things")
    return folder


def json_camera() -> dict[str, Any]:
    return {
        "width": WIDTH, "height": HEIGHT, "focal": FOCAL, "matrix": MATRIX.ravel().tolist()
    }  # fmt: skip


@dataclass
class Frame:
    """A picture that came."""

    camera: int
    scale: float
    rest: bool
    bgr: NDArray[np.uint8]

    @property
    def size(self) -> tuple[int, int]:
        return self.bgr.shape[1], self.bgr.shape[0]

    def rgb(self, x: float, y: float) -> tuple[int, int, int]:
        """The colour at a pixel of the full size."""
        column, row = int(x * self.size[0] / WIDTH), int(y * self.size[1] / HEIGHT)
        blue, green, red = self.bgr[row, column].tolist()
        return red, green, blue


def unpacked_frame(data: bytes) -> Frame:
    id, _, _, scale, rest = struct.unpack_from("<IfffB", data, 1)
    image = cv2.imdecode(np.frombuffer(data[18:], dtype=np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    return Frame(camera=id, scale=scale, rest=bool(rest), bgr=image)


def unpacked_ids(data: bytes) -> NDArray[np.uint16]:
    _, width, height = struct.unpack_from("<IHH", data, 1)
    return np.frombuffer(zlib.decompress(data[9:]), dtype="<u2").reshape(height, width)


class Page:
    """What the page does, over the socket."""

    def __init__(self, **arguments: Any) -> None:
        self._stack = ExitStack()
        self.socket: ClientConnection = self._stack.enter_context(
            connect(close_timeout=1, **arguments)
        )
        self.heard: list[Any] = []
        """Everything that came: objects of text messages, bytes of others."""

    def __enter__(self) -> "Page":
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def send(self, type: str, **fields: Any) -> None:
        self.socket.send(json.dumps({"type": type, **fields}))

    def receive(self, seconds: float = 30) -> Any:
        message = self.socket.recv(timeout=seconds)
        self.heard.append(message if isinstance(message, bytes) else json.loads(message))
        return self.heard[-1]

    def until(self, wanted: Callable[[Any], bool], seconds: float = 30) -> Any:
        """The next message that is wanted; those before it are `heard`."""
        while True:
            message = self.receive(seconds)
            if wanted(message):
                return message

    def next(self, type: str, **fields: Any) -> dict[str, Any]:
        """The next text message of a type, with these values."""

        def wanted(message: Any) -> bool:
            return (
                isinstance(message, dict)
                and message["type"] == type
                and all(message[name] == value for name, value in fields.items())
            )

        return self.until(wanted)

    def frame(self, camera: int | None = None, *, rest: bool | None = None) -> Frame:
        """The next picture, of a camera."""
        while True:
            found = unpacked_frame(
                self.until(lambda message: isinstance(message, bytes) and message[:1] == b"F")
            )
            if camera in (None, found.camera) and rest in (None, found.rest):
                return found

    def ids(self) -> NDArray[np.uint16]:
        """The next id map."""
        return unpacked_ids(
            self.until(lambda message: isinstance(message, bytes) and message[:1] == b"I")
        )

    def draw(self, id: int, **fields: Any) -> None:
        self.send("camera", id=id, **{**json_camera(), **fields})

    def still(self, id: int, **fields: Any) -> Frame:
        """A picture at rest."""
        self.draw(id, rest=True, **fields)
        return self.frame(id, rest=True)

    def select(self, gesture: int, kind: str = "click", **fields: Any) -> dict[str, Any]:
        """A selection, to its end."""
        self.send("select", **{"gesture": gesture, "kind": kind, "camera": json_camera(), **fields})
        return self.next("selected", gesture=gesture, stage="final")

    def command(self, command: str, /, **arguments: Any) -> dict[str, Any]:
        """A command, to the patch that it makes."""
        self.send("command", name=command, arguments=arguments)
        return self.next("patch")

    def refused(self, command: str, /, **arguments: Any) -> dict[str, Any]:
        """A command that ends in an error."""
        self.send("command", name=command, arguments=arguments)
        return self.next("error", command=command)


def base_url(server: Any) -> str:
    """Where the server is, without a slash at the end."""
    return server.url.partition("#")[0].partition("?")[0].rstrip("/")


@contextmanager
def logged_in(server: Any) -> Iterator[httpx.Client]:
    """An HTTP client with the cookie."""
    base = base_url(server)
    with httpx.Client(base_url=base, verify=False) as client:  # no certificates to be read
        token = {"token": server.access.token}
        answer = client.post("/login", json=token, headers={"origin": base})
        assert answer.status_code == 204
        yield client


def opened(server: Any, *, hello: bool = True, **fields: Any) -> Page:
    """A page that has said hello, with `fields`, and has the state, as `page.heard[0]`."""
    base = base_url(server)
    page = Page(
        uri=f"{base.replace('http', 'ws')}/socket",
        origin=base,
        additional_headers={"Cookie": f"{server.access.cookie}={server.access.token}"},
        max_size=None,
    )
    if hello:
        page.send("hello", version=1, **fields)
        page.next("state")
    return page
