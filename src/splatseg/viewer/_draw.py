"""Pictures of a camera in every mode, id maps, depth of a pixel, photographs; how large to draw."""

import time
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from splatseg.core import Camera, Scene
from splatseg.core.sh import evaluate_sh
from splatseg.render import BackendName, PreparedView, SparseSignal, prepare

Confidence = NDArray[np.uint8]
Colour = tuple[int, int, int]

_HALF = 128
_TINT = (1.0, 0.45, 0.0)
_STRENGTH = 0.6
_OVERLAY = 0.55
_MIN_SCALE = 0.4
_SECONDS = 1 / 15
_PHOTOGRAPHS = 32 << 20
_MIN_ALPHA = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class Picture:
    """A picture, 8 bit sRGB (height, width, 3), and the seconds that it took."""

    rgb: NDArray[np.uint8]
    seconds: float


class Drawer:
    """Draws a scene; not thread-safe.

    Args:
        scene: The scene.
        backend: Rendering backend.
    """

    def __init__(self, scene: Scene, *, backend: BackendName = "auto") -> None:
        self._scene = scene
        self._backend: BackendName = backend
        self._view: PreparedView | None = None
        self._key: object = None
        self._photographs: OrderedDict[tuple[str, int], bytes] = OrderedDict()

    def close(self) -> None:
        """Release the last view."""
        if self._view is not None:
            self._view.close()
        self._view, self._key = None, None

    def picture(
        self,
        camera: Camera,
        *,
        mode: str = "colour",
        selection: Confidence | None = None,
        objects: Sequence[tuple[NDArray[np.uint8] | NDArray[np.bool_], Colour]] = (),
        shown: NDArray[np.bool_] | None = None,
        similarity: NDArray[np.float32] | None = None,
        scale: float = 1.0,
    ) -> Picture:
        """A picture of a camera, `scale` times as large."""
        began = time.perf_counter()
        view = self._prepared(scaled(camera, scale), shown)
        if mode == "depth":
            drawn = view.render()
            inverse = torch.where(drawn.alpha > _MIN_ALPHA, 1 / drawn.depth.clamp_min(1e-6), 0.0)
            image = (inverse / inverse.max().clamp_min(1e-9)).unsqueeze(-1).expand(-1, -1, 3)
        else:
            signal = self._signal(view.camera, mode, selection, objects, similarity)
            image = view.render(signal).image
        rgb = (image.clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()
        return Picture(rgb=rgb, seconds=time.perf_counter() - began)

    def jpeg(self, picture: Picture, quality: int) -> bytes:
        """The picture as JPEG."""
        _, data = cv2.imencode(
            ".jpg",
            np.ascontiguousarray(picture.rgb[..., ::-1]),
            [cv2.IMWRITE_JPEG_QUALITY, quality],
        )
        return data.tobytes()

    def id_map(
        self,
        camera: Camera,
        ids: NDArray[np.int32],
        *,
        background: int = 0,
        shown: NDArray[np.bool_] | None = None,
    ) -> NDArray[np.uint16]:
        """The strongest id of each pixel, of one id a Gaussian."""
        view = self._prepared(camera, shown)
        names, channels = np.unique(np.append(ids, background), return_inverse=True)
        signal = SparseSignal(
            channels=torch.from_numpy(channels[:-1].astype(np.int32)[:, None]), count=len(names)
        )
        found = view.argmax(signal, background=int(channels[-1])).channels.cpu().numpy()
        return names[found].astype(np.uint16)

    def depth(self, camera: Camera, x: float, y: float) -> NDArray[np.float64] | None:
        """The point of the scene under a pixel; None where there is nothing."""
        column, row = int(x), int(y)
        if not (0 <= column < camera.width and 0 <= row < camera.height):
            return None
        drawn = self._prepared(camera, None).render(torch.ones(len(self._scene.gaussians), 1))
        if float(drawn.alpha[row, column]) < _MIN_ALPHA:
            return None
        pixel = torch.tensor([x, y], dtype=torch.float64)
        depth = drawn.median_depth[row, column].double()
        return camera.unproject(pixel, depth).numpy()

    def photograph(self, name: str, width: int) -> bytes:
        """The photograph of a view, at most so wide, as JPEG."""
        key = (name, width)
        if key not in self._photographs:
            view = self._scene.view(name)
            camera = view.camera
            longest = max(width, round(width * camera.height / camera.width))
            image = view.read_image(longest=longest)
            self._photographs[key] = self.jpeg(Picture(rgb=image.numpy(), seconds=0.0), 85)
            while sum(map(len, self._photographs.values())) > _PHOTOGRAPHS:
                self._photographs.popitem(last=False)
        self._photographs.move_to_end(key)
        return self._photographs[key]

    def _prepared(self, camera: Camera, shown: NDArray[np.bool_] | None) -> PreparedView:
        hidden = None if shown is None or shown.all() else shown.tobytes()
        pose = tuple(camera.cam_from_world.flatten().tolist())
        key = (camera.width, camera.height, camera.fx, camera.fy, pose, hidden)
        if self._view is None or key != self._key:
            self.close()
            gaussians = self._scene.gaussians
            if hidden is not None and shown is not None:
                keep = torch.from_numpy(shown).to(gaussians.device)
                gaussians = gaussians.replace(opacities=gaussians.opacities * keep)
            self._view = prepare(gaussians, camera, backend=self._backend)
            self._key = key
        return self._view

    def _signal(
        self,
        camera: Camera,
        mode: str,
        selection: Confidence | None,
        objects: Sequence[tuple[NDArray[np.uint8] | NDArray[np.bool_], Colour]],
        similarity: NDArray[np.float32] | None,
    ) -> torch.Tensor:
        """Colours of the Gaussians, the selection's tint mixed in."""
        gaussians = self._scene.gaussians
        ways = torch.nn.functional.normalize(gaussians.means - camera.centre.to(gaussians.means))
        colours = evaluate_sh(gaussians.sh, ways).clamp_min(0)
        labels = torch.full_like(colours, 0.25)
        for mask, colour in objects:
            member = torch.from_numpy(mask >= (1 if mask.dtype == np.bool_ else _HALF))
            labels[member] = torch.tensor(colour, dtype=torch.float32) / 255
        if mode == "objects":
            colours = labels
        elif mode == "blend":
            colours = colours * (1 - _OVERLAY) + labels * _OVERLAY
        elif mode == "confidence":
            share = torch.zeros(len(gaussians)) if selection is None else _share(selection)
            colours = share.unsqueeze(-1).expand(-1, 3)
        elif mode == "similarity" and similarity is not None:
            colours = torch.from_numpy(similarity).float().unsqueeze(-1).expand(-1, 3)
        if selection is not None and mode not in ("confidence", "similarity"):
            weight = (_share(selection) * _STRENGTH).unsqueeze(-1)
            colours = colours * (1 - weight) + torch.tensor(_TINT) * weight
        return colours.contiguous()


def _share(confidence: Confidence) -> torch.Tensor:
    return torch.from_numpy(np.where(confidence >= _HALF, confidence, 0) / np.float32(255)).float()


def scaled(camera: Camera, scale: float) -> Camera:
    """The same view in so many times the pixels."""
    if scale == 1:
        return camera
    width, height = (max(16, round(side * scale)) for side in (camera.width, camera.height))
    across, down = width / camera.width, height / camera.height
    return replace(
        camera,
        width=width,
        height=height,
        fx=camera.fx * across,
        fy=camera.fy * down,
        cx=camera.cx * across,
        cy=camera.cy * down,
    )


class Pace:
    """How large to draw while the camera moves, so that frames come often enough."""

    def __init__(self) -> None:
        self._scale = 0.5

    @property
    def scale(self) -> float:
        """Share of the full width, 0.4 to 1."""
        return self._scale

    def took(self, seconds: float) -> None:
        """A frame at this scale took so long."""
        wanted = self._scale * (_SECONDS / max(seconds, 1e-4)) ** 0.25
        self._scale = min(1.0, max(_MIN_SCALE, wanted))
