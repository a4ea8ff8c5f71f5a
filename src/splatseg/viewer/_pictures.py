"""Pictures of a session's document: what is shown of it, and in which colours."""

import time
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from splatseg.core import Camera, Selection
from splatseg.edit import transform
from splatseg.viewer import _messages as messages
from splatseg.viewer._document import MEMBER, Confidence, Document, Edit
from splatseg.viewer._draw import Drawer, Picture
from splatseg.viewer._session import Session
from splatseg.viewer._shown import changes_rows, similarity_of

_MAX_OBJECT = 32766
_FIRST_SUGGESTION = 32768
_FIRST_THING = 49152
"""From here on an id of an id map is a thing that a click would select: it has an outline alone."""


Number = TypeVar("Number", bound=np.generic)


class Pictures:
    """Draws a session's document as it is now.

    Args:
        session: The session.
        drawer: Draws its scene.
    """

    def __init__(self, session: Session, drawer: Drawer) -> None:
        self._session = session
        self._scene_drawer = drawer
        self._edited: tuple[tuple[Edit, ...], Drawer] | None = None
        self._kept: _Look | None = None
        self._last: _Drawn | None = None

    @property
    def drawer(self) -> Drawer:
        """Draws the scene as its edits make it: what was moved is where it was moved to."""
        edits = self._session.document.edits
        if not changes_rows(edits):
            return self._scene_drawer
        if self._edited is None or self._edited[0] != edits:
            self.close()
            scene = self._session.edited_scene()
            self._edited = (
                edits,
                Drawer(scene, backend=self._scene_drawer.backend, views=self._session.views),
            )
        return self._edited[1]

    def close(self) -> None:
        """Release what draws edits."""
        if self._edited is not None:
            self._edited[1].close()
        self._edited = None

    @property
    def selection(self) -> Confidence | None:
        """The confidences of what is selected; None where nothing is."""
        mask = self._session.document.selection
        return None if mask is None else self._session.confidence(mask)

    def picture(
        self,
        request: messages.DrawRequest | messages.Still,
        camera: Camera,
        *,
        selection: Confidence | None,
        words: str = "",
        preview: Edit | None = None,
        scale: float = 1.0,
    ) -> Picture:
        """A picture of a camera.

        Args:
            request: Mode, and the object that is drawn alone.
            camera: The camera.
            selection: What is tinted.
            words: What similarity is to; empty for the selection.
            preview: A move that is drawn as if it were made.
            scale: Share of the camera's pixels.
        """
        began = time.perf_counter()
        wants_objects = request.mode in ("objects", "blend")
        similarity = self._similarity(words) if request.mode == "similarity" else None
        look = self._look
        with self._drawing(preview) as drawer:
            picture = drawer.picture(
                camera,
                mode=request.mode,
                selection=None if selection is None else look.drawn(selection),
                objects=look.objects if wants_objects else (),
                shown=self._shown(request),
                similarity=None if similarity is None else look.drawn(similarity),
                scale=scale,
            )
        return replace(picture, seconds=time.perf_counter() - began)

    @contextmanager
    def _drawing(self, preview: Edit | None) -> Generator[Drawer]:
        """What draws a picture; with a move that is not made yet, for one picture alone."""
        if preview is None:
            yield self.drawer
            return
        session = self._session
        chosen = self._look.drawn(session.confidence(preview.mask) >= MEMBER)
        edits = changes_rows(session.document.edits)
        if edits:
            chosen &= ~session.shown.copies
        if not chosen.any():
            yield self.drawer
            return
        scene = session.edited_scene() if edits else session.scene
        moved = transform(
            scene.gaussians,
            similarity_of(preview),
            selection=Selection(mask=torch.from_numpy(chosen)),
        )
        drawer = Drawer(
            replace(scene, gaussians=moved.gaussians), backend=self._scene_drawer.backend
        )
        try:
            yield drawer
        finally:
            drawer.close()

    def surface(
        self, camera: Camera, points: Sequence[tuple[float, float]]
    ) -> list[NDArray[np.float64] | None]:
        """The points of what is shown under pixels, see `Drawer.surface`."""
        return self.drawer.surface(camera, points, shown=self._look.shown)

    def id_map(self, request: messages.DrawRequest) -> NDArray[np.uint16]:
        """The object or suggestion at each pixel, as the protocol has it.

        A selection changes nothing of it: it is drawn once for a camera and what there is.
        """
        camera, ids, shown = request.camera(), self._look.ids, self._shown(request)
        last = self._last
        if (
            last is None
            or last.camera is not camera
            or last.ids is not ids
            or not np.array_equal(last.shown, shown)
        ):
            drawn = self.drawer.id_map(camera, ids, shown=shown)
            self._last = last = _Drawn(camera=camera, ids=ids, shown=shown, drawn=drawn)
        return last.drawn

    @property
    def _look(self) -> "_Look":
        revision = self._session.document.revision
        if self._kept is None or self._kept.revision != revision:
            self._kept = _Look(self._session, self._kept)
        return self._kept

    def _shown(self, request: messages.DrawRequest | messages.Still) -> NDArray[np.bool_]:
        only = request.only if isinstance(request, messages.DrawRequest) else None
        if only is None:
            return self._look.shown
        members = self._session.confidence(self._session.document.object(only).mask) >= MEMBER
        return self._look.drawn(members)

    def _similarity(self, words: str) -> NDArray[np.float32] | None:
        if words:
            return self._session.similarity(words)
        selection = self.selection
        return None if selection is None else np.divide(selection, 255, dtype=np.float32)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Drawn:
    """The last id map, and what it was drawn of."""

    camera: Camera
    ids: NDArray[np.int32]
    shown: NDArray[np.bool_]
    drawn: NDArray[np.uint16]


class _Look:
    """What pictures of one document are drawn from."""

    def __init__(self, session: Session, before: "_Look | None") -> None:
        document = session.document
        self.revision = document.revision
        self._session = session
        self._document = document
        self._rows = session.shown.rows if changes_rows(document.edits) else None
        self.shown: NDArray[np.bool_] = self.drawn(session.shown.visible)
        self._owners: NDArray[np.int32] | None = None
        self._ids: NDArray[np.int32] | None = None
        self._objects: list[tuple[NDArray[np.bool_], tuple[int, int, int]]] | None = None
        self._things: NDArray[np.int32] | None = None
        if before is not None and before.same_objects(document):
            self._owners, self._ids, self._things = before._owners, before._ids, before._things
            self._objects = before._objects

    def drawn(self, values: NDArray[Number]) -> NDArray[Number]:
        """Values of the scene's Gaussians as those of the Gaussians that are drawn."""
        return values if self._rows is None else values[self._rows]

    def same_objects(self, document: Document) -> bool:
        """Whether a document has the same objects, suggestions and edits."""
        mine = self._document
        return (mine.objects, mine.suggestions, mine.edits) == (
            document.objects, document.suggestions, document.edits,
        )  # fmt: skip

    @property
    def owners(self) -> NDArray[np.int32]:
        """The object of each Gaussian, -1 for none."""
        if self._owners is None:
            self._owners = self.drawn(self._session.shown.owners)
        return self._owners

    @property
    def objects(self) -> list[tuple[NDArray[np.bool_], tuple[int, int, int]]]:
        """Which Gaussians each object has, and its colour; the same list while they are."""
        if self._objects is None:
            owners = self.owners
            self._objects = [(owners == one.id, one.colour) for one in self._document.objects]
        return self._objects

    @property
    def ids(self) -> NDArray[np.int32]:
        """The id of each Gaussian in an id map."""
        things = self._session.things
        if self._ids is None or self._things is not things:
            self._things = things
            things, owners = self.drawn(things), self.owners
            ids = np.where(owners <= _MAX_OBJECT, owners + 1, 0).astype(np.int32)
            last = np.iinfo(np.uint16).max - _FIRST_THING
            known = (things >= 0) & (things <= last) & (owners < 0)
            ids[known] = _FIRST_THING + things[known]
            for one in self._document.suggestions:
                if one.id < _FIRST_THING - _FIRST_SUGGESTION:
                    member = self.drawn(self._session.confidence(one.mask)) >= MEMBER
                    ids[member & (owners < 0)] = _FIRST_SUGGESTION + one.id
            self._ids = ids
        return self._ids
