"""Pictures of a camera in every mode, id maps, the surface under pixels, photographs."""

import time
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from splatseg.core import Camera, Features, Gaussians, Scene, View
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.prompting.seen import ViewCache
from splatseg.render import BackendName, PreparedView, SparseSignal, prepare
from splatseg.viewer._pace import Pace as Pace
from splatseg.viewer._tint import (
    NO_OBJECT,
    RAMP,
    SELECTED,
    Colour,
    Confidence,
    Tint,
    component_tint,
    owner_tint,
    owners_of,
    ramp_tint,
    range_of,
    selected_share,
    selected_tint,
    stretched,
)

Objects = Sequence[tuple[NDArray[np.uint8] | NDArray[np.bool_], Colour]]

MODES = ("colour", "objects", "blend", "confidence", "depth", "pca", "similarity")
_PHOTOGRAPHS = 32 << 20
"""Bytes of photographs that are kept."""

_WIDEST = 2048
_SMALLEST = 16
_PHOTOGRAPH_QUALITY = 85
_MIN_ALPHA = 0.5
_IDS = 1 << 16
_NO_NAME = "page"


@dataclass(frozen=True, slots=True, kw_only=True)
class Picture:
    """A picture, 8 bit sRGB (height, width, 3), and the seconds that it took."""

    rgb: NDArray[np.uint8]
    seconds: float
    ends: tuple[float, float] | None = None
    """Values at the dark blue and at the yellow end of the ramp: z-depth in scene units, else
    shares of 1; None where no value is drawn."""


class Drawer:
    """Draws a scene. It keeps the view of the last camera; it is not thread-safe.

    Args:
        scene: The scene.
        backend: Rendering backend.
        views: Where views of full size are prepared, to share; None keeps the last one alone.
    """

    def __init__(
        self, scene: Scene, *, backend: BackendName = "auto", views: ViewCache | None = None
    ) -> None:
        self._scene = scene
        self._views = views
        self._backend: BackendName = backend
        self._view: PreparedView | None = None
        self._key: object = None
        self._left: tuple[bytes, Gaussians] | None = None
        self._owned: tuple[Objects, NDArray[np.int32], NDArray[np.uint8]] | None = None
        self._components: Tint | None = None
        self._photographs: OrderedDict[tuple[str, int], bytes] = OrderedDict()

    @property
    def backend(self) -> BackendName:
        """The rendering backend."""
        return self._backend

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
        objects: Objects = (),
        shown: NDArray[np.bool_] | None = None,
        similarity: NDArray[np.float32] | None = None,
        scale: float = 1.0,
    ) -> Picture:
        """A picture of a camera.

        Modes: ``colour`` is the scene's own; ``objects`` the object with the largest weight of
        each pixel, in its colour; ``blend`` half of each; ``confidence`` that of the selection,
        or without one that of the objects, from blue to yellow; ``depth`` from yellow, near, to
        blue, far, between the percentiles 2 and 98 of the picture; ``pca`` the three principal
        components of the first layer of features, the same in every view; ``similarity`` from
        blue to yellow over the colours. Over all but confidence the selection is orange.

        Args:
            camera: The camera.
            mode: What is drawn.
            selection: Confidences of a selection, (n,), selected from 128 on.
            objects: Masks of objects, (n,), confidences or booleans, and their colours. What is
                worked out of them is kept while it is the same sequence.
            shown: False where a Gaussian is left out, (n,).
            similarity: Any numbers, (n,), for the mode of the name.
            scale: Share of the camera's pixels along each side, above 0, at most 1.

        Raises:
            InputError: If there is no such mode, or the scene has nothing to draw it from.
            ShapeError: If an argument has not one entry a Gaussian.
            RangeError: If `scale` is out of range.
        """
        began = time.perf_counter()
        if mode not in MODES:
            raise InputError(f"mode: expected one of {', '.join(MODES)}, got {mode!r}.")
        if not 0 < scale <= 1:
            raise RangeError(f"scale: expected above 0 and at most 1, got {scale}.")
        self._check("selection", selection, np.uint8)
        self._check("shown", shown, np.bool_)
        for mask, _ in objects:
            self._check("objects", mask, np.uint8, np.bool_)
        view = self._prepared(scaled(camera, scale), shown, share=scale == 1)
        ends = None
        if mode == "objects":
            rgb = self._with_selection(view, self._drawn_objects(view, objects), selection)
        elif mode == "depth":
            rgb, ends = _drawn_depth(view)
            rgb = self._with_selection(view, rgb, selection)
        else:
            if mode == "confidence":
                ends = (0.0, 1.0)
            elif mode == "similarity" and similarity is not None:
                ends = range_of(similarity)
            tint = self._tint(mode, selection, objects, similarity)
            if selection is not None and mode != "confidence":
                tint = selected_tint(selection, tint)
            rgb = view.picture(None if tint is None else torch.from_numpy(tint)).numpy()
        return Picture(rgb=rgb, seconds=time.perf_counter() - began, ends=ends)

    def jpeg(self, picture: Picture, quality: int) -> bytes:
        """The picture as JPEG.

        Args:
            picture: The picture.
            quality: From 1 to 100.
        """
        return _jpeg(picture.rgb, quality)

    def id_map(
        self,
        camera: Camera,
        ids: NDArray[np.int32],
        *,
        background: int = 0,
        shown: NDArray[np.bool_] | None = None,
    ) -> NDArray[np.uint16]:
        """The id with the largest weight of each pixel, (height, width).

        Args:
            camera: The camera.
            ids: An id of each Gaussian, (n,), 0 to 65535.
            background: The id of what no Gaussian covers.
            shown: False where a Gaussian is left out, (n,).

        Raises:
            ShapeError: If an argument has not one entry a Gaussian.
            RangeError: If an id is out of range.
        """
        self._check("ids", ids, np.int32)
        self._check("shown", shown, np.bool_)
        low, high = (
            min(int(ids.min(initial=0)), background),
            max(int(ids.max(initial=0)), background),
        )
        if low < 0 or high >= _IDS:
            raise RangeError(f"ids: expected 0 to {_IDS - 1}, got {low if low < 0 else high}.")
        signal = SparseSignal(channels=torch.from_numpy(ids[:, None]), count=high + 1)
        found = self._prepared(camera, shown).argmax(signal, background=background)
        return found.channels.numpy().astype(np.uint16)

    def surface(
        self,
        camera: Camera,
        points: Sequence[tuple[float, float]],
        *,
        shown: NDArray[np.bool_] | None = None,
    ) -> list[NDArray[np.float64] | None]:
        """The points of the scene under pixels, each (3,), scene units; None where nothing is.

        Their depth is the pixels' median depth: that of the Gaussian with which half of the light
        is stopped.

        Args:
            camera: The camera.
            points: Pixels from the left and from the upper edge.
            shown: False where a Gaussian is left out, (n,).
        """
        self._check("shown", shown, np.bool_)
        found: list[NDArray[np.float64] | None] = [None] * len(points)
        inside = [
            i for i, (x, y) in enumerate(points) if 0 <= x < camera.width and 0 <= y < camera.height
        ]
        if not inside:
            return found
        chosen = torch.tensor([points[i] for i in inside], dtype=torch.float64)
        medians = self._prepared(camera, shown).contributors(chosen.floor().long(), 1).median
        pose = camera.cam_from_world
        for i, point, row in zip(inside, chosen, medians.tolist(), strict=True):
            if row >= 0:
                mean = self._scene.gaussians.means[row].to(pose)
                found[i] = camera.unproject(point, pose[2, :3] @ mean + pose[2, 3]).numpy()
        return found

    def photograph(self, name: str, width: int) -> bytes:
        """The photograph of a view as JPEG, its render where it has none; some of them are kept.

        Args:
            name: The view.
            width: Pixels across at most, 16 to 2048.

        Raises:
            InputError: If there is no such view, or its photograph is gone.
        """
        width = min(max(width, _SMALLEST), _WIDEST)
        key = (name, width)
        if key not in self._photographs:
            view = self._scene.view(name)
            height = max(1, round(width * view.camera.height / view.camera.width))
            if view.image is None:
                camera = view.camera.resized(width, height)
                with prepare(self._scene.gaussians, camera, backend=self._backend) as drawn:
                    image = drawn.picture()
            else:
                image = view.read_image(longest=max(width, height))
            self._photographs[key] = _jpeg(image.numpy(), _PHOTOGRAPH_QUALITY)
            while len(self._photographs) > 1 and self._photograph_bytes > _PHOTOGRAPHS:
                self._photographs.popitem(last=False)
        self._photographs.move_to_end(key)
        return self._photographs[key]

    @property
    def _photograph_bytes(self) -> int:
        return sum(map(len, self._photographs.values()))

    def _check(self, name: str, values: NDArray[np.generic] | None, *types: type) -> None:
        count = len(self._scene.gaussians)
        if values is None:
            return
        if values.shape != (count,):
            raise ShapeError(f"{name}: expected ({count},), one a Gaussian, got {values.shape}.")
        if values.dtype.type not in types:
            expected = " or ".join(np.dtype(kind).name for kind in types)
            raise InputError(f"{name}: expected {expected}, got {values.dtype}.")

    def _prepared(
        self, camera: Camera, shown: NDArray[np.bool_] | None, *, share: bool = True
    ) -> PreparedView:
        """The view of a camera, the last one where it is the same."""
        hidden = None if shown is None or bool(shown.all()) else shown.tobytes()
        if hidden is None and share and self._views is not None:
            return self._views.prepared(View(name=_NO_NAME, camera=camera))
        pose = tuple(camera.cam_from_world.flatten().tolist())
        lens = (camera.fx, camera.fy, camera.cx, camera.cy, camera.model, camera.distortion)
        key = (camera.width, camera.height, lens, pose, hidden)
        if self._view is None or key != self._key:
            self.close()
            left = self._scene.gaussians if hidden is None else self._without(hidden)
            self._view = prepare(left, camera, backend=self._backend)
            self._key = key
        return self._view

    def _without(self, hidden: bytes) -> Gaussians:
        """The scene's Gaussians; what is hidden has an opacity of 0, and projection drops it."""
        if self._left is None or self._left[0] != hidden:
            gaussians = self._scene.gaussians
            shown = torch.from_numpy(np.frombuffer(hidden, np.bool_).copy())
            opacities = gaussians.opacities * shown.to(gaussians.opacities)
            self._left = hidden, gaussians.replace(opacities=opacities)
        return self._left[1]

    def _owners(self, objects: Objects) -> tuple[NDArray[np.int32], NDArray[np.uint8]]:
        if self._owned is None or self._owned[0] is not objects:
            self._owned = objects, *owners_of(objects, len(self._scene.gaussians))
        return self._owned[1:]

    def _tint(
        self,
        mode: str,
        selection: Confidence | None,
        objects: Objects,
        similarity: NDArray[np.float32] | None,
    ) -> Tint | None:
        """The tint of a mode that is drawn by colours of Gaussians."""
        if mode == "blend":
            return owner_tint(self._owners(objects)[0], [colour for _, colour in objects])
        if mode == "confidence":
            sure = self._owners(objects)[1] if selection is None else selection
            return ramp_tint(sure, covers=True)
        if mode == "similarity" and similarity is not None:
            self._check("similarity", similarity, np.float32, np.float64)
            return ramp_tint(stretched(similarity), covers=False)
        if mode == "pca":
            if self._components is None:
                self._components = _components_of(self._scene)
            return self._components
        return None

    def _drawn_objects(self, view: PreparedView, objects: Objects) -> NDArray[np.uint8]:
        """Each pixel in the colour of the object with the largest weight."""
        owner, _ = self._owners(objects)
        # Channels: nothing that covers the pixel, no object, objects.
        table = np.array([(0, 0, 0), NO_OBJECT, *(colour for _, colour in objects)], np.uint8)
        signal = SparseSignal(channels=torch.from_numpy(owner[:, None] + 2), count=len(table))
        return table[view.argmax(signal, background=0).channels.numpy()]

    def _with_selection(
        self, view: PreparedView, rgb: NDArray[np.uint8], selection: Confidence | None
    ) -> NDArray[np.uint8]:
        """A picture with the selection's colour mixed in by how much of each pixel it has."""
        if selection is None:
            return rgb
        tint = np.full((len(selection), 4), 255, np.uint8)
        tint[:, :3] = selected_share(selection)[:, None]
        share = view.picture(torch.from_numpy(tint)).numpy()[..., :1].astype(np.float32) / 255
        return np.round(rgb + (np.array(SELECTED, np.float32) - rgb) * share).astype(np.uint8)


def _drawn_depth(view: PreparedView) -> tuple[NDArray[np.uint8], tuple[float, float] | None]:
    """Expected depth, near yellow, far blue, black where less than half of the light is stopped.

    With the depths that are blue and yellow; None where nothing is seen.
    """
    drawn = view.render()
    depth, covered = drawn.depth.cpu().numpy(), drawn.alpha.cpu().numpy() > _MIN_ALPHA
    rgb = np.zeros((*depth.shape, 3), np.uint8)
    if not covered.any():
        return rgb, None
    near, far = (float(value) for value in np.percentile(depth[covered], (2, 98)))
    along = np.clip((depth[covered] - near) / max(far - near, 1e-9), 0, 1)
    rgb[covered] = RAMP[np.round(255 * (1 - along)).astype(np.uint8)]
    return rgb, (far, near)


def _components_of(scene: Scene) -> Tint:
    """Principal components of the first layer of features."""
    for name in scene.layers:
        layer = scene.layers[name]
        if isinstance(layer, Features):
            known = None if layer.weights is None else layer.weights.numpy() > 0
            return component_tint(layer.values.float().numpy(), known)
    raise InputError("mode: pca needs a layer of features, and the scene has none.")


def _jpeg(rgb: NDArray[np.uint8], quality: int) -> bytes:
    options = [cv2.IMWRITE_JPEG_QUALITY, quality]
    _, data = cv2.imencode(".jpg", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), options)
    return data.tobytes()


def scaled(camera: Camera, scale: float) -> Camera:
    """The same view in so many times the pixels along each side, at least 16."""
    if scale == 1:
        return camera
    width, height = (max(_SMALLEST, round(side * scale)) for side in (camera.width, camera.height))
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
