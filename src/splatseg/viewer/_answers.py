"""What the worker does for a page: pictures, selections, commands, jobs; on one `Session`."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import cv2
import msgspec
import numpy as np
import torch
from numpy.typing import NDArray

from splatseg.core import Camera, Scene, Selection, View
from splatseg.errors import InputError
from splatseg.io.scene_folder import scene_path
from splatseg.prompting.prompts import Ball, Lasso, SelectionPrompt, Similar, ViewPrompt
from splatseg.render import BackendName
from splatseg.tasks.work import EXPORTS_FOLDER
from splatseg.viewer import _jobs as jobs
from splatseg.viewer import _messages as messages
from splatseg.viewer._document import (
    COMMANDS,
    MEMBER,
    Apply,
    Confidence,
    Document,
    Edit,
    Isolate,
    Join,
    Keep,
    Mask,
    Refine,
    Select,
    Subtract,
)
from splatseg.viewer._draw import Drawer, Pace
from splatseg.viewer._mirror import Mirror, scene_info, view_infos
from splatseg.viewer._session import Session, open_session
from splatseg.viewer._shaping import combined
from splatseg.viewer._worker import Client, Job, Worker

T = TypeVar("T")

_MODES = ("colour", "objects", "blend", "confidence", "depth", "pca", "similarity")
_MOVING_QUALITY, _REST_QUALITY = 75, 92
_NO_NAME = "page"
"""Name of a view that is no photograph's."""

_MAX_OBJECT = 32766
_FIRST_SUGGESTION = 32768


@dataclass
class _Memory:
    """What is remembered of a page."""

    pace: Pace
    gesture: int | None = None
    base: Mask | None = None
    """What was selected before the gesture."""

    words: str = ""
    """What was last searched for: similarity is to this."""


class SceneAnswers:
    """Answers about one scene.

    Args:
        session: The scene and what was made of it.
        drawer: Draws it.
        worker: Tells all pages.
        relay: The observer of the session.
        name: What the page calls the scene.
        backend: Rendering backend, for jobs.
        fitting: How far its fit is, where it is not finished.
    """

    def __init__(
        self,
        session: Session,
        drawer: Drawer,
        *,
        worker: Worker,
        relay: jobs.Relay,
        name: str,
        backend: BackendName = "auto",
        fitting: messages.FittingInfo | None = None,
    ) -> None:
        self._session = session
        self._drawer = drawer
        self._worker = worker
        self._relay = relay
        self._backend: BackendName = backend
        self._fitting = fitting
        self._ready = False
        self._mirror = Mirror(session.scene, session.confidence)
        self._scene_info = scene_info(session.scene, name)
        self._views = view_infos(session.scene)
        self._look: _Look | None = None
        session.subscribe(self._changed)

    @property
    def session(self) -> Session:
        """The scene and what was made of it."""
        return self._session

    @property
    def exports(self) -> Path | None:
        """Folder of files that pages may fetch."""
        root = self._session.scene.root
        return None if root is None else root / EXPORTS_FOLDER

    def close(self) -> None:
        """Save and release."""
        self._session.close()
        self._drawer.close()

    def prepare(self) -> None:
        """Open what clicks go by, so that the first one is quick."""
        self._session.prepare()
        self._ready = True
        self._worker.broadcast(messages.Ready())

    def join(self, client: Client) -> None:
        """Send a page all that it shows."""
        client.send(self.state(client))

    def state(self, client: Client) -> messages.State:
        """All that a page shows."""
        session, scene = self._session, self._session.scene
        return messages.State(
            scene=self._scene_info,
            views=self._views,
            layers=list(scene.layers),
            source=_or(None, lambda: session.source),
            words=_or(False, lambda: session.words),  # noqa: FBT003
            modes=list(_MODES),
            features=list(messages.FEATURES),
            document=self._mirror.document(session.document),
            undo=session.undo_label,
            redo=session.redo_label,
            clients=len(self._worker.clients),
            me=client.id,
            ready=self._ready,
            fitting=self._fitting,
        )

    def photograph(self, name: str, width: int) -> bytes:
        """A photograph as JPEG."""
        return self._drawer.photograph(name, width)

    def _changed(self, old: Document, new: Document, author: str) -> None:
        """Tell all pages of a change, and draw it."""
        self._worker.broadcast(
            self._mirror.patch(
                old,
                new,
                undo=self._session.undo_label,
                redo=self._session.redo_label,
                author=author,
            )
        )
        self._worker.redraw()

    # Pictures.

    def draw(self, client: Client, request: messages.DrawRequest) -> None:
        """Send a picture, and at rest the id map."""
        self._send_picture(client, request, self._selection())
        if request.rest and request.ids:
            look = self._current_look()
            ids = self._drawer.id_map(request.camera(), look.ids(), shown=self._shown(request))
            client.send_bytes(messages.id_map_bytes(request.id, ids))

    def _send_picture(
        self, client: Client, request: messages.DrawRequest, selection: Confidence | None
    ) -> None:
        pace = _memory(client).pace
        scale = 1.0 if request.rest else pace.scale
        picture = self._picture(request, request.camera(), selection, client, scale=scale)
        if not request.rest:
            pace.took(picture.seconds)
        began = time.perf_counter()
        jpeg = self._drawer.jpeg(picture, _REST_QUALITY if request.rest else _MOVING_QUALITY)
        client.send_picture(
            messages.frame_bytes(
                request.id,
                jpeg,
                draw=1e3 * picture.seconds,
                encode=1e3 * (time.perf_counter() - began),
                scale=scale,
                rest=request.rest,
            )
        )

    def _picture(
        self,
        request: messages.DrawRequest | messages.Still,
        camera: Camera,
        selection: Confidence | None,
        client: Client,
        *,
        scale: float = 1.0,
    ) -> Any:
        wants_objects = request.mode in ("objects", "blend")
        return self._drawer.picture(
            camera,
            mode=request.mode,
            selection=selection,
            objects=self._current_look().objects if wants_objects else (),
            shown=self._shown(request),
            similarity=self._similarity(client) if request.mode == "similarity" else None,
            scale=scale,
        )

    def _selection(self) -> Confidence | None:
        mask = self._session.document.selection
        return None if mask is None else self._session.confidence(mask)

    def _shown(self, request: messages.DrawRequest | messages.Still) -> NDArray[np.bool_] | None:
        only = request.only if isinstance(request, messages.DrawRequest) else None
        if only is None:
            return self._current_look().shown
        return self._session.confidence(self._session.document.object(only).mask) >= MEMBER

    def _similarity(self, client: Client) -> NDArray[np.float32] | None:
        words = _memory(client).words
        if words:
            return self._session.similarity(words)
        selection = self._selection()
        return None if selection is None else selection.astype(np.float32) / 255

    def _current_look(self) -> "_Look":
        revision = self._session.document.revision
        if self._look is None or self._look.revision != revision:
            self._look = _Look(self._session, self._look)
        return self._look

    # Messages.

    def answer(self, client: Client, message: messages.Incoming) -> None:
        """Answer a message."""
        match message:
            case messages.SelectRequest():
                self._select(client, message)
            case messages.CommandRequest():
                self._command(client, message)
            case messages.Undo():
                _memory(client).gesture = None
                self._session.undo(author=client.author)
            case messages.Redo():
                _memory(client).gesture = None
                self._session.redo(author=client.author)
            case messages.DepthRequest():
                point = self._drawer.depth(message.camera.camera(), message.x, message.y)
                client.send(messages.PointAnswer(gesture=message.gesture, point=_triple(point)))
            case messages.Hello():
                raise InputError("hello: was said before.")
            case _:
                raise InputError("message: expected one that has an answer.")

    def hint(self, client: Client) -> None:
        """Say where the next click would help."""
        document = self._session.document
        found = None if document.selection is None else self._session.hint(document.selection)
        if found is None:
            client.send(messages.HintAnswer())
            return
        x, y, view = found
        client.send(messages.HintAnswer(x=x, y=y, view=view))

    def _select(self, client: Client, request: messages.SelectRequest) -> None:
        began = time.perf_counter()
        memory = _memory(client)
        if memory.gesture != request.gesture:
            memory.gesture, memory.base = request.gesture, self._session.document.selection
        stages: dict[str, float] = {}

        def draft(confidence: Confidence) -> None:
            stages["draft"] = _milliseconds(began)
            self._send_selected(client, request, "draft", confidence, stages=stages, began=began)
            if client.camera is not None and not client.busy:
                self._send_picture(client, client.camera, confidence)

        self._select_by(client, request, memory, draft)
        selection = self._selection()
        stages |= {name: round(1e3 * spent, 1) for name, spent in self._session.seconds.items()}
        self._send_selected(client, request, "final", selection, stages=stages, began=began)

    def _select_by(
        self,
        client: Client,
        request: messages.SelectRequest,
        memory: _Memory,
        draft: Callable[[Confidence], None],
    ) -> None:
        session, author = self._session, client.author
        match request.kind:
            case "none":
                session.do(Select(None, {"kind": "none"}), author=author)
            case "all" | "invert" | "layer":
                self._select_mask(client, request, memory, self._whole(request))
            case "grow":
                session.grow(author=author)
            case "shrink":
                session.shrink(author=author)
            case "fill":
                session.fill_holes(author=author)
            case _:
                prompts = request.text if request.kind == "words" else self._prompts(request)
                if request.kind == "words":
                    memory.words = request.text
                session.select(
                    prompts,
                    mode=request.mode,
                    level=request.level,
                    base=memory.base,
                    draft=draft,
                    author=author,
                )

    def _whole(self, request: messages.SelectRequest) -> Confidence:
        """Confidences that no model is asked for."""
        scene = self._session.scene
        if request.kind == "layer":
            layer = scene.layers[request.text]
            if not isinstance(layer, Selection):
                raise InputError(
                    "layer: expected a selection, got another kind of layer; suggest its objects."
                )
            confidence = layer.mask.float() if layer.confidence is None else layer.confidence
            return (confidence * 255).round().to(torch.uint8).numpy()
        whole = np.full(len(scene.gaussians), 255, dtype=np.uint8)
        before = self._selection() if request.kind == "invert" else None
        return whole if before is None else np.where(before >= MEMBER, 0, whole).astype(np.uint8)

    def _select_mask(
        self,
        client: Client,
        request: messages.SelectRequest | messages.SelectObject | messages.SelectSuggestion,
        memory: _Memory,
        confidence: Confidence,
    ) -> None:
        """Select a mask, or change the selection by it."""
        base = None if memory.base is None else self._session.confidence(memory.base)
        mask = self._session.masks.put(combined(confidence, base, request.mode))
        kind = request.kind if isinstance(request, messages.SelectRequest) else "object"
        self._session.do(Select(mask, {"kind": kind}), author=client.author)

    def _send_selected(
        self,
        client: Client,
        request: messages.SelectRequest,
        stage: messages.Stage,
        confidence: Confidence | None,
        *,
        stages: Mapping[str, float],
        began: float,
    ) -> None:
        members = np.empty(0) if confidence is None else confidence[confidence >= MEMBER]
        client.send(
            messages.Selected(
                gesture=request.gesture,
                stage=stage,
                count=len(members),
                confidence=round(float(members.mean()) / 255, 4) if len(members) else 0.0,
                milliseconds=_milliseconds(began),
                stages=dict(stages),
            )
        )

    def _prompts(self, request: messages.SelectRequest) -> Sequence[SelectionPrompt]:
        """What a person showed, as prompts."""
        if request.kind == "similar":
            selection = self._selection()
            if selection is None:
                raise InputError("similar: expected a selection that others are like; click first.")
            return [Similar(Selection.of_confidence(torch.from_numpy(selection / np.float32(255))))]
        view = self._view(request)
        if request.kind == "sphere":
            return [self._ball(request, view)]
        if request.kind in ("lasso", "polygon"):
            return [Lasso(view=view, polygon=_points(request.points))]
        if request.kind == "stroke":
            return [_stroke(request, view)]
        points = [*request.points, *request.negative] if request.kind == "click" else []
        positive = [True] * len(request.points) + [False] * len(request.negative)
        box = None if request.box is None else torch.tensor(request.box, dtype=torch.float32)
        return [
            ViewPrompt(
                view=view,
                points=_points(points),
                positive=torch.tensor(positive[: len(points)], dtype=torch.bool),
                box=box,
            )
        ]

    def _view(self, request: messages.SelectRequest) -> View:
        if request.view is not None:
            return self._session.scene.view(request.view)
        if request.camera is None:
            raise InputError(f"{request.kind}: expected a camera or a view, got neither.")
        return View(name=_NO_NAME, camera=request.camera.camera())

    def _ball(self, request: messages.SelectRequest, view: View) -> Ball:
        if not request.points or request.radius is None:
            raise InputError("sphere: expected a point and a radius.")
        centre = _triple(self._drawer.depth(view.camera, *request.points[0]))
        if centre is None:
            raise InputError("sphere: there is nothing of the scene at this pixel; click on it.")
        return Ball(centre=centre, radius=request.radius)

    # Commands.

    def _command(self, client: Client, request: messages.CommandRequest) -> None:
        given = messages.arguments(request)
        session, memory = self._session, _memory(client)
        memory.gesture = None
        match given:
            case messages.SelectObject() | messages.SelectSuggestion():
                memory.base = session.document.selection
                self._select_mask(client, given, memory, self._confidence_of(given))
                return
            case messages.Split():
                session.split(given.id, by=given.by, plane=given.plane, author=client.author)
                return
            case messages.EditOf():
                command: Any = Apply(self._edit(request.name, given))
            case messages.Keep():
                command = Keep(given.name, given.class_name, given.colour)
            case messages.Isolate():
                command = Isolate(tuple(given.ids))
            case messages.Join():
                command = Join(tuple(given.ids), given.name)
            case messages.OfId() if request.name in ("subtract", "refine"):
                kind = Subtract if request.name == "subtract" else Refine
                command = kind(given.id, self._selected_mask(request.name))
            case _:
                fields = msgspec.structs.asdict(given)
                if "ids" in fields:
                    fields["ids"] = tuple(fields["ids"])
                command = COMMANDS[request.name](**fields)
        session.do(command, author=client.author, revision=request.revision)

    def _selected_mask(self, what: str) -> Mask:
        mask = self._session.document.selection
        if mask is None:
            raise InputError(f"{what}: expected a selection, got none; click first.")
        return mask

    def _confidence_of(
        self, given: messages.SelectObject | messages.SelectSuggestion
    ) -> Confidence:
        """The confidences of objects, or of a suggestion."""
        session, document = self._session, self._session.document
        if isinstance(given, messages.SelectSuggestion):
            found = [one.mask for one in document.suggestions if one.id == given.id]
            if not found:
                raise InputError(f"suggestion: expected one of those there are, got {given.id}.")
            return session.confidence(found[0])
        ids = given.ids or ([] if given.id is None else [given.id])
        return self._union([document.object(id).mask for id in ids])

    def _union(self, masks: Sequence[Mask]) -> Confidence:
        found = np.zeros(len(self._session.scene.gaussians), dtype=np.uint8)
        for mask in masks:
            found = np.maximum(found, self._session.confidence(mask))
        return found

    def _edit(self, kind: str, given: messages.EditOf) -> Edit:
        """An edit of objects, or of the selection."""
        document = self._session.document
        if given.ids is None:
            mask = self._selected_mask(kind)
        else:
            mask = self._session.masks.put(
                self._union([document.object(id).mask for id in given.ids])
            )
        if isinstance(given, messages.Recolour):
            return Edit(kind="recolour", mask=mask, colour=given.colour)
        if not isinstance(given, messages.Move):
            return Edit(kind="remove", mask=mask)
        about = given.about
        return Edit(
            kind="duplicate" if kind == "duplicate" else "move",
            mask=mask,
            rotation=given.rotation,
            translation=given.translation,
            scale=given.scale,
            about=self._mirror.centre(mask)[0] if about is None else about,
        )

    # Jobs.

    def run(self, job: Job) -> None:
        """Do a job, or begin it in a process of its own."""
        given = messages.arguments(job.request)
        if isinstance(given, messages.See | messages.Associate):
            root = self._session.scene.root
            jobs.start_process(job, root, self._backend, given, lambda end: self._ended(job, end))
            return
        with self._relay.telling(job):
            file, text = self._do(job, given)
        self._worker.end_job(
            job,
            messages.Finished(
                id=job.id, result={"file": None if file is None else file.name, "text": text}
            ),
        )

    def _do(self, job: Job, given: Any) -> tuple[Path | None, str]:
        """The file and the sentence that a job ends with."""
        session = self._session
        match given:
            case messages.Export():
                ids = None if given.ids is None else tuple(given.ids)
                name = given.name if given.format is None else f"{given.name}.{given.format}"
                path = session.export(given.what, name, ids=ids)
                return (jobs.zipped(path) if path.is_dir() else path), "exported"
            case messages.SaveLayer():
                session.save_layer(given.name)
                self._send_states()
                return None, f"saved as layer {given.name}"
            case messages.Suggest():
                session.suggest(given.layer, author=job.client.author)
                return None, f"{len(session.document.suggestions)} suggestions"
            case messages.Film():
                return self._film(job, given), f"{given.frames} frames"
            case messages.Still():
                picture = self._picture(given, given.camera.camera(), None, job.client)
                return jobs.write_still(picture.rgb, self._export_folder(), given.name), "picture"
            case _:
                raise InputError(f"job: {job.request.name} cannot be done here.")

    def _film(self, job: Job, given: messages.Film) -> Path:
        centre, _ = self._mirror.centre(self._session.document.selection)
        turn = jobs.Turntable(
            matrix=np.array(given.camera.matrix).reshape(4, 4),
            centre=np.array(centre),
            up=np.array(self._scene_info.up),
        )

        def frame(share: float) -> NDArray[np.uint8]:
            matrix = turn.at(share).ravel().tolist()
            camera = msgspec.structs.replace(given.camera, matrix=matrix).camera()
            return self._picture(given, camera, None, job.client).rgb

        return jobs.write_film(frame, given.frames, job, self._export_folder(), given.name)

    def _export_folder(self) -> Path:
        root = self._session.scene.root
        if root is None:
            raise InputError("export: expected a scene with a folder; save it first.")
        return scene_path(root, EXPORTS_FOLDER, "file").parent

    def _ended(self, job: Job, ending: messages.Finished | messages.Error) -> None:
        """A process has ended; called in another thread."""

        def tell(_: object) -> None:
            if isinstance(ending, messages.Finished):
                self._session.reopen()
                self._send_states()
            self._worker.end_job(job, ending)

        if self._worker.call(tell).cancelled():
            self._worker.end_job(job, ending)

    def _send_states(self) -> None:
        for client in self._worker.clients:
            if client.welcomed:
                client.send(self.state(client))


class _Look:
    """What pictures of one document are drawn from."""

    def __init__(self, session: Session, before: "_Look | None") -> None:
        document = session.document
        self.revision = document.revision
        self._session = session
        self._document = document
        self.shown: NDArray[np.bool_] = session.visible
        self._owners: NDArray[np.int32] | None = None
        self._ids: NDArray[np.int32] | None = None
        if before is not None and before.same_objects(document):
            self._owners, self._ids = before._owners, before._ids

    def same_objects(self, document: Document) -> bool:
        """Whether a document has the same objects and suggestions."""
        mine = self._document
        return mine.objects == document.objects and mine.suggestions == document.suggestions

    @property
    def owners(self) -> NDArray[np.int32]:
        """The object of each Gaussian, -1 for none."""
        if self._owners is None:
            self._owners = self._session.owners()
        return self._owners

    @property
    def objects(self) -> list[tuple[NDArray[np.bool_], tuple[int, int, int]]]:
        """Which Gaussians each object has, and its colour."""
        owners = self.owners
        return [(owners == one.id, one.colour) for one in self._document.objects]

    def ids(self) -> NDArray[np.int32]:
        """The id of each Gaussian in an id map, as the protocol has it."""
        if self._ids is None:
            owners = self.owners
            ids = np.where(owners <= _MAX_OBJECT, owners + 1, 0).astype(np.int32)
            for one in self._document.suggestions:
                if one.id < _FIRST_SUGGESTION:
                    member = self._session.confidence(one.mask) >= MEMBER
                    ids[member & (owners < 0)] = _FIRST_SUGGESTION + one.id
            self._ids = ids
        return self._ids


def _or(otherwise: T, question: Callable[[], T]) -> T:
    """What a layer that cannot be read is asked in vain; clicks will say what is wrong."""
    try:
        return question()
    except InputError:
        return otherwise


def _memory(client: Client) -> _Memory:
    return client.data.setdefault("memory", _Memory(pace=Pace()))


def _milliseconds(began: float) -> float:
    return round(1e3 * (time.perf_counter() - began), 1)


def _triple(point: Any) -> tuple[float, float, float] | None:
    if point is None:
        return None
    x, y, z = (float(value) for value in point)
    return x, y, z


def _points(points: Sequence[messages.Point]) -> torch.Tensor:
    return torch.tensor(points, dtype=torch.float32).reshape(-1, 2)


def _stroke(request: messages.SelectRequest, view: View) -> ViewPrompt:
    """Strokes as the pixels that they cover."""
    drawn = [_covered(points, request.width, view) for points in (request.points, request.negative)]
    positive, negative = (mask if bool(mask.any()) else None for mask in drawn)
    return ViewPrompt(view=view, scribble=positive, negative_scribble=negative)


def _covered(points: Sequence[messages.Point], width: float, view: View) -> torch.Tensor:
    canvas = np.zeros((view.camera.height, view.camera.width), dtype=np.uint8)
    if points:
        # Pixel centres are at +0.5 here, at whole numbers in OpenCV.
        corners = np.round(np.array(points) - 0.5).astype(np.int32).reshape(-1, 1, 2)
        cv2.polylines(canvas, [corners], isClosed=False, color=1, thickness=max(1, round(width)))
    return torch.from_numpy(canvas > 0)


def opener(
    scene: Scene | Path, *, layer: str | None = None, backend: BackendName = "auto"
) -> Callable[[Worker], SceneAnswers]:
    """What opens a scene in the worker's thread.

    Args:
        scene: The scene, or its folder.
        layer: A layer whose objects are suggested at once.
        backend: Rendering backend.
    """

    def opened(worker: Worker) -> SceneAnswers:
        relay = jobs.Relay()
        session = open_session(scene, backend=backend, observer=relay)
        try:
            if layer is not None and not session.document.suggestions:
                session.suggest(layer)
            root = session.scene.root
            return SceneAnswers(
                session,
                Drawer(session.scene, backend=backend),
                worker=worker,
                relay=relay,
                name="scene" if root is None else root.resolve().name,
                backend=backend,
            )
        except BaseException:
            session.close()
            raise

    return opened
