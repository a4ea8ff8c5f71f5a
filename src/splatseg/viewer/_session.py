"""A session: one scene segmented by hand, from Python and from the page by the same methods.

    with splatseg.viewer.open_session("toys") as session:
        session.select(ViewPrompt(view=session.scene.views[0], points=[[400, 300]]))
        session.do(commands.Keep("mug"))
        session.save_layer("things")

What is done is in the journal when the method returns. A session is for one thread.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from types import EllipsisType
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray

from splatseg.core import Labels, Scene, Selection, apply_rows
from splatseg.errors import InputError
from splatseg.io.scene import load_scene
from splatseg.io.scene_folder import scene_path
from splatseg.io.splats import WritableFormat, read_splats
from splatseg.prompting.prompts import SelectionPrompt
from splatseg.prompting.seen import ViewCache
from splatseg.render import BackendName
from splatseg.tasks.work import SILENT, Observer
from splatseg.viewer import _products as products
from splatseg.viewer import _shaping as shaping
from splatseg.viewer._editor import Callback, Editor
from splatseg.viewer._journal import Journal
from splatseg.viewer._selecting import (
    Selecting,
    bytes_of,
    joined_record,
    recorded_after,
    selection_of,
)
from splatseg.viewer._shaping import Mode, SplitBy
from splatseg.viewer._shown import Shown
from splatseg.viewer._state import (
    Command,
    Confidence,
    Document,
    Mask,
    Select,
    Split,
    Suggest,
)

VIEW_FOLDER = "view"
"""Folder of a scene that holds the journal."""


def open_session(
    scene: Scene | Path | str,
    *,
    folder: Path | str | None = None,
    backend: BackendName = "auto",
    observer: Observer = SILENT,
) -> "Session":
    """Open a scene to segment it by hand; what was done before is there again.

    Args:
        scene: A scene, its folder, or a splat file.
        folder: Where the journal lies. None takes the folder ``view`` of the scene; of a scene
            without a folder everything stays in memory.
        backend: Rendering backend.
        observer: Is told of what is opened, and of what was wrong with the journal.

    Raises:
        InputError: If there is no such scene, or another process has it open.
        OutputError: If the journal cannot be written.
    """
    if not isinstance(scene, Scene):
        path = Path(scene)
        scene = Scene(gaussians=read_splats(path)) if path.is_file() else load_scene(path)
    place = None if folder is None else Path(folder)
    if place is None and scene.root is not None:
        place = scene_path(scene.root, VIEW_FOLDER)
    journal = None
    if place is not None:
        digest = products.digest_of(scene)
        journal = Journal(place, gaussians=len(scene.gaussians), digest=digest)
        for note in journal.notes:
            observer.note(note)
    return Session(scene, journal=journal, folder=place, backend=backend, observer=observer)


class Session:
    """A scene, its document, and what can be done with both; a context that closes it.

    `open_session` makes it. Its `masks` are found by their content, its `history` is what was done
    and undone, and `shown` is what is shown of the scene: edits made, without what is hidden.

    Args:
        scene: The scene; it stays as it is.
        journal: Where commands are written; None keeps them in memory.
        folder: Where exports go of a scene without a folder of its own.
        backend: Rendering backend.
        observer: Is told of what is opened.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        journal: Journal | None = None,
        folder: Path | None = None,
        backend: BackendName = "auto",
        observer: Observer = SILENT,
    ) -> None:
        self._scene = scene
        self._folder = folder
        self._backend: BackendName = backend
        self._observer = observer
        self._editor = Editor(len(scene.gaussians), journal)
        self.masks, self.history = self._editor.masks, self._editor.history
        self.shown = Shown(scene, self.masks, lambda: self.document)
        self._selecting = Selecting(
            scene, shown=self.shown.in_view, backend=backend, observer=observer
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Release what it holds, and the lock of the journal."""
        self._selecting.close()
        self._editor.close()

    @property
    def scene(self) -> Scene:
        """The scene, without edits."""
        return self._scene

    @property
    def document(self) -> Document:
        """As it is now."""
        return self.history.document

    @property
    def revision(self) -> int:
        """Of the document."""
        return self.document.revision

    @property
    def notes(self) -> tuple[str, ...]:
        """What should be known of how the journal was opened."""
        return self._editor.notes

    @property
    def source(self) -> str | None:
        """What of the scene answers clicks, such as ``layer masks``; None where nothing does.

        Clicks then select what is connected and of about the same colour.
        """
        return self._selecting.source

    @property
    def views(self) -> ViewCache:
        """Views that are prepared for selecting; whoever draws may share them."""
        return self._selecting.views

    @property
    def words(self) -> bool:
        """Whether the scene has a layer that answers words."""
        return self._selecting.words is not None

    @property
    def seconds(self) -> Mapping[str, float]:
        """Of the last selection by stage, see `splatseg.tasks.Selected`."""
        return self._selecting.seconds

    @property
    def selected(self) -> Selection | None:
        """What is selected; None where nothing is."""
        mask = self.document.selection
        return None if mask is None else selection_of(self.masks.get(mask))

    @property
    def things(self) -> NDArray[np.int32]:
        """(n,) the thing of each Gaussian that a click would select, from 0, -1 for none.

        That of the layer that answers clicks, of a tree its objects.
        """
        return self._selecting.things

    def confidence(self, mask: Mask) -> Confidence:
        """(n,) uint8 confidences of a mask, 0 to 255; from 128 on a Gaussian belongs to it."""
        return self.masks.get(mask)

    def subscribe(self, callback: Callback) -> Callable[[], None]:
        """Be told of each change: the document before, the document after, the author.

        Returns:
            A function that ends it.
        """
        return self._editor.subscribe(callback)

    # Commands.

    def do(self, command: Command, *, author: str = "", revision: int | None = None) -> Document:
        """Do a command, and write it down.

        Args:
            command: See `splatseg.viewer.commands`.
            author: Who does it.
            revision: The document that the author saw. Where another author changed what the
                command is about since, it is refused. None does not ask.

        Raises:
            InputError: If it cannot be done; a sentence says why.
            OutputError: If it cannot be written down; nothing was done.
        """
        return self._editor.do(command, author=author, revision=revision)

    def undo(self, author: str = "") -> Document:
        """Take the last command back, whoever did it.

        Raises:
            InputError: If there is nothing to undo.
        """
        return self._editor.undo(author)

    def redo(self, author: str = "") -> Document:
        """Do again what was undone last.

        Raises:
            InputError: If there is nothing to redo.
        """
        return self._editor.redo(author)

    # Selecting.

    def prepare(self) -> None:
        """Open all that a click needs, so that the first one takes no longer than others."""
        self._selecting.prepare()

    def reopen(self) -> None:
        """Let go of what answers clicks and words; the next one opens what is there then."""
        self._selecting.close()

    def select(
        self,
        prompts: SelectionPrompt | Sequence[SelectionPrompt] | str,
        *,
        mode: Mode = "set",
        level: float | None = 0.5,
        base: Mask | EllipsisType | None = ...,
        draft: Callable[[Confidence], None] | None = None,
        author: str = "",
    ) -> Document:
        """Select what prompts mean.

        Args:
            prompts: What is shown in views, places, more of the same; or words.
            mode: What becomes of what was selected: set replaces it, add adds to it, remove takes
                from it, intersect keeps what is in both.
            level: 0 for the finest parts, 0.5 for objects, 1 for groups; None lets the source
                choose.
            base: What was selected, for the mode; left out it is the present selection.
            draft: Is called with confidences (n,) before they are cleaned, 0 to 255.
            author: Who does it.

        Returns:
            The document; without a selection, where nothing is left of it.

        Raises:
            InputError: If prompts show nothing, or there is nothing to take from.
        """
        if level is not None and not 0 <= level <= 1:
            raise InputError(f"level: expected a number from 0 to 1, got {level:g}.")
        under = self.document.selection if isinstance(base, EllipsisType) else base
        if under is None and mode in ("remove", "intersect"):
            raise InputError(f"{mode}: expected a selection, got none; select something first.")
        below = None if under is None or mode == "set" else self.masks.get(under)

        def tell(selection: Selection) -> None:
            if draft is not None:
                draft(shaping.combined(bytes_of(selection), below, mode))

        made, record = self._selecting.select(prompts, level=level, draft=tell)
        earlier = self.document.prompt if under == self.document.selection else None
        record = joined_record(record, None if below is None else earlier, mode)
        values = shaping.combined(bytes_of(made), below, mode)
        return self.select_values(values, record, author=author)

    def select_values(
        self, values: Confidence, record: Mapping[str, Any], *, author: str = ""
    ) -> Document:
        """Select by confidences; Gaussians that were removed are left out.

        Args:
            values: (n,) from 0 to 255, from 128 on for what is selected.
            record: What selected it, in values that JSON holds.
            author: Who does it.
        """
        mask = self.masks.put(np.where(self.shown.present, values, 0).astype(np.uint8))
        return self.do(Select(mask if mask.count else None, dict(record)), author=author)

    def similarity(self, words: str) -> NDArray[np.float32]:
        """(n,) how likely words mean each Gaussian, in [0, 1].

        Raises:
            InputError: If no layer answers words, or nothing is known of these.
        """
        return self._selecting.similarity(words).numpy()

    def hint(
        self, selection: Mask | None = None, *, stop: Callable[[], bool] | None = None
    ) -> tuple[float, float, str] | None:
        """Where the next click would help most: x and y in pixels of a view, and its name.

        Args:
            selection: Of what; None takes the present selection.
            stop: Is asked now and then whether to give it up.

        Returns:
            None where it was given up, nothing is selected, nothing is uncertain, or the scene has
            no views.
        """
        mask = selection or self.document.selection
        if mask is None:
            return None
        confidence = torch.from_numpy(np.array(self.confidence(mask))) / 255
        return self._selecting.hint(confidence, stop=stop)

    def grow(self, factor: float = 1.0, *, author: str = "") -> Document:
        """Add what is near to the selection.

        Args:
            factor: How near, in median distances of its Gaussians to the next one.
            author: Who does it.

        Raises:
            InputError: If nothing is selected.
        """
        near = self._selecting.neighbours
        step = {"kind": "grow", "factor": factor}
        return self._reshape(lambda values: shaping.grown(values, near, factor), step, author)

    def shrink(self, factor: float = 1.0, *, author: str = "") -> Document:
        """Take what is near to the outside off the selection; `factor` as in `grow`.

        Raises:
            InputError: If nothing is selected, or nothing would be left.
        """
        near, gaussians = self._selecting.neighbours, self._scene.gaussians
        step = {"kind": "shrink", "factor": factor}
        return self._reshape(
            lambda values: shaping.shrunk(values, gaussians, near, factor), step, author
        )

    def fill_holes(self, *, author: str = "") -> Document:
        """Add small gaps within the selection.

        Raises:
            InputError: If nothing is selected.
        """
        near, step = self._selecting.neighbours, {"kind": "fill_holes"}
        return self._reshape(lambda values: shaping.filled(values, near), step, author)

    def _reshape(
        self, shaped: Callable[[Confidence], Confidence], step: dict[str, Any], author: str
    ) -> Document:
        if self.document.selection is None:
            raise InputError("selection: expected one, got none; select something first.")
        values = shaped(self.masks.get(self.document.selection))
        record = recorded_after(self.document.prompt, [step])
        return self.select_values(values, record, author=author)

    # Objects.

    def suggest(self, layer: str, *, author: str = "") -> Document:
        """Suggest the things of a layer: the objects of a tree, or the ids of labels.

        Raises:
            InputError: If there is no such layer, or it has no things.
        """
        found = self._selecting.layer(layer)
        made = shaping.suggestions_of(found, self.masks, name=layer)
        return self.do(Suggest(made), author=author)

    def split(
        self,
        id: int,
        *,
        by: SplitBy = "parts",
        plane: Sequence[float] | None = None,
        author: str = "",
        revision: int | None = None,
    ) -> Document:
        """Make several objects of one; the largest keeps the id, and all get names of their own.

        Args:
            id: Of the object.
            by: parts: its connected pieces. tree: the parts that the scene's tree has of it. plane:
                the two sides of a plane.
            plane: a, b, c, d of the plane a x + b y + c z + d = 0, world, scene units.
            author: Who does it.
            revision: As in `do`.

        Raises:
            InputError: If it has no two parts.
        """
        parts = shaping.parts_of(
            self.confidence(self.document.object(id).mask),
            self._scene.gaussians,
            by,
            tree=self._selecting.tree() if by == "tree" else None,
            plane=plane,
        )
        masks = tuple(self.masks.put(values) for values in parts)
        names = shaping.names_of_parts(self.document, id, len(masks))
        return self.do(Split(id, masks, names), author=author, revision=revision)

    # What is taken away.

    def labels(self, ids: Iterable[int] | None = None) -> Labels:
        """The objects as labels: their ids, names, classes and colours, and how they were made.

        Args:
            ids: Only these objects; None takes all.

        Raises:
            InputError: If there are none.
        """
        return products.labels_of(
            self.document,
            self.shown.owned,
            self._scene,
            [entry.command for entry in self.history.entries],
            ids=None if ids is None else tuple(ids),
        )

    def save_layer(self, name: str) -> Labels:
        """Save the objects as a layer of the scene; of a scene without a folder, give it only.

        Raises:
            InputError: If there are no objects, or a layer of this name is there that was not
                saved here.
            OutputError: If it cannot be written.
        """
        labels = self.labels()
        if self._scene.root is not None:
            products.save(labels, self._scene.root, name)
        return labels

    def export(
        self,
        what: products.ExportWhat,
        name: str,
        ids: Iterable[int] | None = None,
        *,
        format: WritableFormat | None = None,
    ) -> Path:
        """Write the scene with its edits, or objects of it, into its folder ``exports``.

        Args:
            what: splat, objects (a file each), points, coco or table.
            name: Of the file or folder; its ending says the format.
            ids: Only these objects; None takes everything.
            format: Of splats, where the name does not say it; None is PLY. Other formats hold no
                labels.

        Returns:
            What was written.

        Raises:
            InputError: If there is no such object, or a name is none.
            OutputError: If it cannot be written.
        """
        only = None if ids is None else tuple(ids)
        labels = None
        if self.document.objects or only is not None:
            labels = apply_rows(self.labels(only), self.shown.edited)
        return products.export(
            self.edited_scene(),
            labels,
            products.exports_folder(self._scene, self._folder),
            what=what,
            name=name,
            format=format,
            only=only,
            backend=self._backend,
            observer=self._observer,
        )

    def edited_scene(self) -> Scene:
        """The scene with its edits; without a folder, unless there are none."""
        return products.edited_scene(self._scene, self.shown.edited, self.document.edits)
