"""Clicks, strokes, places and words become confidences.

The source is opened once and kept, and so are the neighbours of the Gaussians, which cleaning,
growing and filling holes look at too.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from splatseg.core import (
    UNLABELLED,
    Camera,
    Edited,
    Features,
    Gaussians,
    InstanceTree,
    Labels,
    Layer,
    Scene,
    Selection,
    View,
    VoxelFeatures,
)
from splatseg.errors import InputError
from splatseg.prompting.next_click import next_click
from splatseg.prompting.pipeline import SceneIndex
from splatseg.prompting.prompts import (
    Lasso,
    SelectionPrompt,
    Solid,
    ViewPrompt,
    prompt_record,
)
from splatseg.prompting.seen import ViewCache
from splatseg.render import BackendName
from splatseg.tasks.query import QuerySession
from splatseg.tasks.select import SelectionSession, open_selector
from splatseg.tasks.sources import SelectOptions
from splatseg.tasks.word_sources import QueryOptions
from splatseg.tasks.work import Observer, Work
from splatseg.viewer._colour_source import ColourSource
from splatseg.viewer._products import METHOD
from splatseg.viewer._shaping import Mode
from splatseg.viewer._state import MEMBER, Confidence

COLOUR = "colour"
"""What selections by our own source are recorded as made by."""

Draft = Callable[[Confidence], None]

_ANSWERING = ("objects", "voxels", "features")
"""Methods whose layers answer words, the best first."""

_MAX_PROMPTS = 64
"""Most prompts of a selection that are recorded, the last."""


class Selecting:
    """Selects in one scene, again and again.

    Args:
        scene: The scene.
        shown: What a view shows instead of the scene, see `ViewCache`.
        backend: Rendering backend.
        observer: Is told of what is opened.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        shown: Callable[[View | None], Edited | None],
        backend: BackendName,
        observer: Observer,
    ) -> None:
        self._scene = scene
        self._backend: BackendName = backend
        self._observer = observer
        self._selector: SelectionSession | None = None
        self._words: QuerySession | None = None
        self._chosen: tuple[SelectOptions | None, str | None] | None = None
        self._work = Work(scene=scene, backend=backend, observer=observer)
        self._things: NDArray[np.int32] | None = None
        self.neighbours = SceneIndex(scene.gaussians)
        self.views = ViewCache(scene.gaussians, backend=backend, edited=shown)
        self.seconds: Mapping[str, float] = {}

    def close(self) -> None:
        """Release what it holds; it is opened again when it is needed."""
        self.views.close()
        self._selector, self._words, self._chosen, self._things = None, None, None, None
        self._work = Work(scene=self._scene, backend=self._backend, observer=self._observer)

    @property
    def source(self) -> str | None:
        """What of the scene says which Gaussians belong together; None where nothing does."""
        return self._choice()[1]

    @property
    def words(self) -> str | None:
        """The layer that answers words; None where none does."""
        found: dict[str, str] = {}
        for name in self._work.layer_names:
            facts = self._work.facts(name)
            if issubclass(facts.kind, Features | VoxelFeatures):
                found.setdefault(facts.info.method or "", name)
        return next((found[method] for method in _ANSWERING if method in found), None)

    def tree(self) -> InstanceTree | None:
        """The first layer that is a tree; None without one."""
        for name in self._work.layer_names:
            if self._work.facts(name).rank == 0:
                layer = self._work.layer(name)
                return layer if isinstance(layer, InstanceTree) else None
        return None

    def layer(self, name: str) -> Layer:
        """A layer by name.

        Raises:
            InputError: If there is none.
        """
        return self._work.layer(name)

    @property
    def things(self) -> NDArray[np.int32]:
        """(n,) the thing of each Gaussian in the layer that answers clicks, from 0, -1 for none.

        Of a tree its objects. Features know no things before they are asked: all are -1.
        """
        if self._things is None:
            options = self._choice()[0]
            layer = None if options is None else self._work.layer(options.from_layer or "")
            labels = layer.cut() if isinstance(layer, InstanceTree) else layer
            self._things = np.full(len(self._scene.gaussians), UNLABELLED, np.int32)
            if isinstance(labels, Labels):
                ids = labels.ids.numpy()
                known = ids != UNLABELLED
                self._things[known] = np.unique(ids[known], return_inverse=True)[1]
        return self._things

    def prepare(self) -> None:
        """Open all that a click needs, and select once, so that the first click is no slower."""
        gaussians = self._scene.gaussians
        if not len(gaussians):
            return
        self.neighbours.graph  # noqa: B018  (made when it is asked for)
        self.neighbours.index  # noqa: B018
        views = self._scene.train_views or self._scene.views
        view = views[0] if views else front_view(gaussians)
        middle = [[view.camera.width / 2, view.camera.height / 2]]
        try:
            prompt = ViewPrompt(view=view, points=torch.tensor(middle))
            self.select(prompt, level=None, draft=lambda _: None)
        except InputError:
            # The middle of the view is sky: all that takes long was opened.
            return

    def select(
        self,
        prompts: SelectionPrompt | Sequence[SelectionPrompt] | str,
        *,
        level: float | None,
        draft: Callable[[Selection], None],
    ) -> tuple[Selection, dict[str, Any]]:
        """What prompts mean, and the record of it.

        Args:
            prompts: What is shown; at least one. Or words.
            level: 0 asks for the finest parts, 0.5 for objects, 1 for groups; None lets the source
                choose.
            draft: Is called with what the source says, before it is cleaned.

        Raises:
            InputError: If nothing is shown, or what is shown is nothing; no layer answers words,
                or nothing answers to these.
        """
        if isinstance(prompts, str):
            answers = self._asked().ask([prompts])
            draft(answers.selection())
            record = {"kind": "words", "text": prompts}
            return answers.selection(), {"source": f"layer {answers.layer}", "prompts": [record]}
        given = (prompts,) if isinstance(prompts, SelectionPrompt) else tuple(prompts)
        selector = self._opened()
        options = replace(self._options(), granularity="auto" if level is None else 1 - level)

        def tell(confidence: Tensor) -> None:
            draft(Selection.of_confidence(confidence.cpu()))

        made = selector.select(given, options=options, advise=False, draft=tell)
        self.seconds = dict(made.seconds)
        places = all(isinstance(prompt, Solid) for prompt in given)
        source = "" if places else (self.source or COLOUR)
        return made.selection, {"source": source, "prompts": self._records(given, level)}

    def similarity(self, words: str) -> Float[Tensor, "n"]:
        """How likely words mean each Gaussian, in [0, 1].

        Raises:
            InputError: If no layer answers words, or nothing is known of these.
        """
        return self._asked().ask([words]).probabilities[:, 0].float().cpu()

    def hint(
        self, confidence: Float[Tensor, "n"], *, stop: Callable[[], bool] | None
    ) -> tuple[float, float, str] | None:
        """Column and row in a view where a click would help most, and its name."""
        views = self._scene.train_views or self._scene.views
        if not views:
            return None
        found = next_click(
            self._scene.gaussians, views, confidence, backend=self._backend, stop=stop
        )
        return None if found is None else (*found.point, found.view.name)

    def _records(self, prompts: Sequence[SelectionPrompt], level: float | None) -> list[Any]:
        known = {view.name for view in self._scene.views}
        records: list[Any] = []
        for prompt in prompts:
            record: dict[str, Any] = dict(prompt_record(prompt))
            if isinstance(prompt, ViewPrompt | Lasso) and prompt.view.name not in known:
                record["camera"] = _camera_record(prompt.view.camera)
            if level is not None:
                record["level"] = level
            records.append(record)
        return records

    def _choice(self) -> tuple[SelectOptions | None, str | None]:
        """Options of the source that is there already, and its name; None where there is none.

        Masks that no layer was made of are left alone: to associate them takes minutes. So are
        layers that were saved here: they know nothing but what was kept by hand.
        """
        if self._chosen is None:
            facts = {name: self._work.facts(name) for name in self._work.layer_names}
            facts = {name: one for name, one in facts.items() if one.info.method != METHOD}
            names = tuple(facts)
            ranks = ((facts[name].rank, name) for name in names)
            best = min(((rank, name) for rank, name in ranks if rank is not None), default=None)
            affinity = next((name for name in names if facts[name].is_affinity), None)
            if affinity is not None and (best is None or best[0] > 0):
                options = SelectOptions(source="features", from_layer=affinity)
                self._chosen = options, f"layer {affinity}"
            elif best is not None:
                options = SelectOptions(source="layer", from_layer=best[1])
                self._chosen = options, f"layer {best[1]}"
            else:
                self._chosen = None, None
        return self._chosen

    def _options(self) -> SelectOptions:
        return self._choice()[0] or SelectOptions()

    def _opened(self) -> SelectionSession:
        if self._selector is None:
            gaussians, own = self._scene.gaussians, None
            if self._choice()[0] is None:
                own = ColourSource(gaussians, self.neighbours, self.views)
            self._selector = open_selector(
                self._scene,
                options=self._options(),
                source=own,
                neighbours=self.neighbours,
                views=self.views,
                backend=self._backend,
                observer=self._observer,
            )
        return self._selector

    def _asked(self) -> QuerySession:
        if self._words is None:
            name = self.words
            if name is None:
                raise InputError(
                    "words: expected a layer that answers them, got none; `splatseg segment "
                    "--method objects` makes one of masks and features of text."
                )
            self._words = QuerySession(
                self._scene,
                options=QueryOptions(from_layer=name),
                backend=self._backend,
                observer=self._observer,
            )
        return self._words


def joined_record(
    record: dict[str, Any], earlier: dict[str, Any] | None, mode: Mode
) -> dict[str, Any]:
    """The record of prompts behind those that they were combined with."""
    how = {} if mode == "set" else {"mode": mode}
    joined = recorded_after(earlier, [{**prompt, **how} for prompt in record["prompts"]])
    return joined | {"source": record["source"] or joined.get("source", "")}


def recorded_after(
    earlier: dict[str, Any] | None, prompts: Sequence[dict[str, Any]]
) -> dict[str, Any]:
    """An earlier record with further prompts; of very many the last."""
    before = earlier or {}
    return {**before, "prompts": [*before.get("prompts", []), *prompts][-_MAX_PROMPTS:]}


def front_view(gaussians: Gaussians, *, width: int = 320, height: int = 240) -> View:
    """A view of all Gaussians from along y, for scenes that have none."""
    means = gaussians.means.detach().cpu().double()
    centre = means.median(dim=0).values
    away = torch.linalg.vector_norm(means - centre, dim=1)
    distance = 2.5 * max(float(away.quantile(0.9) if len(away) < 1 << 20 else away.median()), 1e-3)
    rotation = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = rotation
    pose[:3, 3] = torch.tensor([0, 0, distance], dtype=torch.float64) - rotation @ centre
    camera = Camera(
        width=width,
        height=height,
        fx=width,
        fy=width,
        cx=width / 2,
        cy=height / 2,
        cam_from_world=pose,
    )
    return View(name="front", camera=camera)


def bytes_of(selection: Selection) -> Confidence:
    """Confidences of 0 to 255, from 128 on for what is selected."""
    # In NumPy: torch would wait for its threads, which costs more than it saves here.
    mask = selection.mask.cpu().numpy()
    if selection.confidence is None:
        return np.where(mask, np.uint8(255), np.uint8(0))
    values = np.rint(255 * selection.confidence.detach().cpu().numpy()).astype(np.uint8)
    return np.where(mask, np.maximum(values, MEMBER), np.minimum(values, MEMBER - 1))


def selection_of(confidence: Confidence) -> Selection:
    """The selection of confidences of 0 to 255. Inverse of `bytes_of`, up to a 255th."""
    values = confidence.astype(np.float32) / 255
    return Selection.of_confidence(torch.from_numpy(values))


def _camera_record(camera: Camera) -> dict[str, Any]:
    names = ("width", "height", "fx", "fy", "cx", "cy")
    return {name: getattr(camera, name) for name in names} | {
        "cam_from_world": camera.cam_from_world.tolist()
    }
