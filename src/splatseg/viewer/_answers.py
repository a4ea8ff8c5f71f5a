"""What the worker does for a page: pictures, selections, commands, jobs; on one `Session`."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

from splatseg.core import UNLABELLED, Features, Labels, Scene, Selection
from splatseg.errors import InputError
from splatseg.render import BackendName
from splatseg.tasks.work import EXPORTS_FOLDER
from splatseg.viewer import _jobs as jobs
from splatseg.viewer import _messages as messages
from splatseg.viewer._client import Client, Job
from splatseg.viewer._commands import command_of, confidence_of, edit_of
from splatseg.viewer._document import MEMBER, Confidence, Document, Edit, Mask, Select
from splatseg.viewer._draw import Drawer, Pace
from splatseg.viewer._mirror import Mirror, scene_info, view_infos
from splatseg.viewer._pictures import Pictures
from splatseg.viewer._prompts import prompts_of
from splatseg.viewer._selecting import bytes_of
from splatseg.viewer._session import Session, open_session
from splatseg.viewer._shaping import combined
from splatseg.viewer._streams import Streams
from splatseg.viewer._tint import RAMP_STOPS
from splatseg.viewer._worker import Worker

T = TypeVar("T")

_MODES = ("colour", "objects", "blend", "confidence", "depth", "pca", "similarity")
_MOVING_QUALITY, _REST_QUALITY = 75, 92


@dataclass
class _Memory:
    """What is remembered of a page."""

    pace: Pace
    gesture: int | None = None
    base: Mask | None = None
    """What was selected before the gesture."""

    words: str = ""
    """What was last searched for: similarity is to this."""

    legend: messages.Legend | None = None
    """What it was told last of the colours."""


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
        stage: Who draws while the camera moves, unless a page chooses otherwise.
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
        stage: messages.Drawing = "server",
    ) -> None:
        self._session = session
        self._drawer = drawer
        self._worker = worker
        self._fitting = fitting
        self._stage: messages.Drawing = stage
        self._ready = False
        self._features: dict[str, bool] = {}
        self._cleaning = float("inf")
        """Seconds that a Gaussian of the last selection took from its draft on."""
        self._drawing = 0.0
        """Seconds of the last picture at rest."""
        self._mirror = Mirror(session.confidence, lambda: session.shown.centres)
        self._scene_info = scene_info(session.scene, name)
        self._views = view_infos(session.scene)
        self._pictures = Pictures(session, drawer)
        self._streams = Streams(session)
        self._jobs = jobs.SceneJobs(
            session,
            pictures=self._pictures,
            mirror=self._mirror,
            worker=worker,
            relay=relay,
            backend=backend,
            layers_changed=self._send_states,
        )
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
        self._jobs.close()
        self._session.close()
        self._pictures.close()
        self._streams.close()
        self._drawer.close()

    def prepare(self) -> None:
        """Open what clicks go by, so that the first one is quick."""
        self._session.prepare()
        self._ready = True
        self._worker.broadcast(messages.Ready())

    def join(self, client: Client) -> None:
        """Send a page all that it shows."""
        client.send(self.state(client))
        self._streams.tell(client)

    def state(self, client: Client) -> messages.State:
        """All that a page shows."""
        session, scene = self._session, self._session.scene
        return messages.State(
            scene=self._scene_info,
            views=self._views,
            layers=list(scene.layers),
            source=_or(None, lambda: session.source),
            words=_or(False, lambda: session.words),  # noqa: FBT003
            modes=self._modes(),
            features=list(messages.FEATURES),
            ramp=list(RAMP_STOPS),
            document=self._mirror.document(session.document),
            undo=session.history.undo_label,
            redo=session.history.redo_label,
            clients=len(self._worker.clients),
            me=client.id,
            ready=self._ready,
            fitting=self._fitting,
            stage=self._stage,
        )

    def _modes(self) -> list[str]:
        """What can be drawn of this scene: components need a layer of features."""
        layers = self._session.scene.layers
        for name in set(layers) - set(self._features):
            self._features[name] = _or(None, lambda name=name: type(layers[name])) is Features
        featured = any(self._features[name] for name in layers)
        return [mode for mode in _MODES if featured or mode != "pca"]

    def photograph(self, name: str, width: int) -> bytes:
        """A photograph as JPEG."""
        return self._drawer.photograph(name, width)

    def gaussians(self, version: int) -> Path:
        """A PLY file of the Gaussians that are drawn, for a page that draws them itself."""
        return self._streams.file(version)

    def _changed(self, old: Document, new: Document, author: str) -> None:
        """Tell all pages of a change, and draw it."""
        # First: what a page asks for once it knows of the change is meant as it is.
        self._worker.redraw(author)
        history = self._session.history
        self._worker.broadcast(
            self._mirror.patch(
                old, new, undo=history.undo_label, redo=history.redo_label, author=author
            )
        )
        for client in self._worker.clients:
            if client.welcomed:
                self._streams.tell(client)

    # Pictures.

    def draw(self, client: Client, request: messages.DrawRequest) -> None:
        """Send a picture, and at rest the id map."""
        self._send_picture(client, request, self._pictures.selection)
        if request.rest and request.ids:
            ids = self._pictures.id_map(request)
            client.send_bytes(messages.id_map_bytes(request.id, ids))

    def _send_picture(
        self, client: Client, request: messages.DrawRequest, selection: Confidence | None
    ) -> None:
        pace = _memory(client).pace
        scale = 1.0 if request.rest else pace.scale
        picture = self._pictures.picture(
            request,
            request.camera(),
            selection=selection,
            words=_memory(client).words,
            preview=self._preview(request),
            scale=scale,
        )
        if request.rest:
            self._drawing = picture.seconds
        else:
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
        legend = messages.Legend(mode=request.mode, ends=picture.ends)
        if request.rest and legend != _memory(client).legend:
            _memory(client).legend = legend
            client.send(legend)

    def _preview(self, request: messages.DrawRequest) -> Edit | None:
        """The move under way; None where what moves is not there any more.

        It is only looked at: the command that ends it says what is wrong.
        """
        if request.preview is None:
            return None
        given, session = request.preview, self._session
        return _or(None, lambda: edit_of("move", given, session, centre=self._mirror.middle))

    # Messages.

    def answer(self, client: Client, message: messages.Incoming) -> None:
        """Answer a message."""
        match message:
            case messages.SelectRequest():
                self._select(client, message)
            case messages.CommandRequest():
                self._command(client, message)
            case messages.StageRequest():
                client.stage = message.stage
                client.data.pop("streams", None)
                self._streams.tell(client)
            case messages.Undo():
                _memory(client).gesture = None
                self._session.undo(author=client.author)
            case messages.Redo():
                _memory(client).gesture = None
                self._session.redo(author=client.author)
            case messages.DepthRequest():
                place = [(message.x, message.y)]
                (found,) = self._pictures.surface(message.camera.camera(), place)
                point = None if found is None else [float(value) for value in found]
                client.send(messages.PointAnswer(gesture=message.gesture, point=point))
            case messages.Hello():
                raise InputError("hello: was said before.")
            case _:
                raise InputError("message: expected one that has an answer.")

    def hint(self, client: Client) -> None:
        """Say where the next click would help; nothing, if something is asked meanwhile."""
        selection = self._session.document.selection
        given_up: list[bool] = []

        def stop() -> bool:
            if self._worker.is_asked:
                given_up.append(True)
            return bool(given_up)

        found = None if selection is None else self._session.hint(selection, stop=stop)
        if given_up:
            return
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

        drafted: list[float] = []

        def draft(confidence: Confidence) -> None:
            stages["draft"] = _milliseconds(began)
            self._send_selected(client, request, "draft", confidence, stages=stages, began=began)
            # A picture that takes longer than the cleaning would only delay the final one.
            worth = self._cleaning * np.count_nonzero(confidence >= MEMBER) > self._drawing
            if worth and client.camera is not None and not client.busy:
                self._send_picture(client, client.camera, confidence)
            drafted.append(time.perf_counter())

        self._select_by(client, request, memory, draft)
        selection = self._pictures.selection
        if drafted and selection is not None:
            count = np.count_nonzero(selection >= MEMBER)
            self._cleaning = (time.perf_counter() - drafted[0]) / max(int(count), 1)
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
                words = request.text if request.kind == "words" else ""
                memory.words = words or memory.words
                session.select(
                    words
                    or prompts_of(
                        request,
                        session.scene,
                        surface=self._pictures.surface,
                        selection=session.selected,
                    ),
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
            if isinstance(layer, Labels):
                held = (layer.ids != UNLABELLED) & (layer.ids != layer.background)
                return np.where(held.cpu().numpy(), np.uint8(255), np.uint8(0))
            if not isinstance(layer, Selection):
                raise InputError(
                    "layer: expected a selection or labels, got another kind of layer."
                )
            return bytes_of(layer)
        whole = np.full(len(scene.gaussians), 255, dtype=np.uint8)
        before = self._pictures.selection if request.kind == "invert" else None
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
        kind = request.kind if isinstance(request, messages.SelectRequest) else "object"
        values = combined(confidence, base, request.mode)
        self._session.select_values(values, {"kind": kind}, author=client.author)

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

    # Commands.

    def _command(self, client: Client, request: messages.CommandRequest) -> None:
        given = messages.arguments(request)
        session, memory = self._session, _memory(client)
        memory.gesture = None
        if isinstance(given, messages.SelectObject | messages.SelectSuggestion):
            memory.base = session.document.selection
            self._select_mask(client, given, memory, confidence_of(given, session))
        elif isinstance(given, messages.Split):
            session.split(given.id, by=given.by, plane=given.plane, author=client.author)
        else:
            command = command_of(request.name, given, session, centre=self._mirror.middle)
            session.do(command, author=client.author, revision=request.revision)

    # Jobs.

    def run(self, job: Job) -> None:
        """Do a job, or begin it in a process of its own."""
        self._jobs.run(job)

    def _send_states(self) -> None:
        for client in self._worker.clients:
            if client.welcomed:
                client.send(self.state(client))


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


def opener(
    scene: Scene | Path,
    *,
    layer: str | None = None,
    backend: BackendName = "auto",
    stage: messages.Drawing = "server",
) -> Callable[[Worker], SceneAnswers]:
    """What opens a scene in the worker's thread.

    Args:
        scene: The scene, or its folder.
        layer: A layer whose objects are suggested at once.
        backend: Rendering backend.
        stage: Who draws while the camera moves, unless a page chooses otherwise.
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
                Drawer(session.scene, backend=backend, views=session.views),
                worker=worker,
                relay=relay,
                name="scene" if root is None else root.resolve().name,
                backend=backend,
                stage=stage,
            )
        except BaseException:
            session.close()
            raise

    return opened
