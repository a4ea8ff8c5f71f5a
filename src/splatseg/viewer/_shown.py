"""What is shown of a session's scene: edits are made, and what is hidden is left out.

Masks are of the Gaussians of the scene, whatever was done to them; rows of what is edited say
which of these each Gaussian is that is drawn.
"""

from collections.abc import Callable, Iterator, Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from splatseg.core import UNLABELLED, Edited, Gaussians, Scene, Selection, Similarity, View
from splatseg.core.rigid import rotation_from_quaternion
from splatseg.edit import duplicate, recolour, remove, transform
from splatseg.viewer._document import MEMBER, Confidence, Document, Edit, Masks, Object


class Shown:
    """What is shown of a scene.

    Args:
        scene: The scene, without edits.
        masks: The masks of documents.
        document: Gives the document as it is now.
    """

    def __init__(self, scene: Scene, masks: Masks, document: Callable[[], Document]) -> None:
        self._scene = scene
        self._masks = masks
        self._document = document
        self._photographed = frozenset(view.name for view in scene.views)
        self._made: tuple[tuple[Edit, ...], Edited, NDArray[np.bool_]] | None = None
        self._moved: tuple[tuple[Edit, ...], NDArray[np.float32]] | None = None
        self._seen: tuple[int, tuple[Edit, ...], NDArray[np.bool_], Edited | None] | None = None
        self._owners = Owners(len(scene.gaussians), masks)

    @property
    def owned(self) -> tuple[NDArray[np.int32], Confidence]:
        """(n,) the id of the object of each Gaussian, -1 for none, and its confidence, 0 to 255.

        Of several objects it is the one that is surest of it, of equally sure ones the later.
        """
        return self._owners.of(self._document().objects)

    @property
    def owners(self) -> NDArray[np.int32]:
        """(n,) the id of the object that each Gaussian belongs to, -1 for none."""
        return self.owned[0]

    @property
    def visible(self) -> NDArray[np.bool_]:
        """(n,) which Gaussians of the scene are shown.

        Not those of which edits left nothing, nor those of hidden objects; where objects are
        isolated, theirs alone.
        """
        document, ids = self._document(), self.owners
        found = ~np.isin(ids, [one.id for one in document.objects if not one.visible])
        if document.isolated:
            found &= np.isin(ids, document.isolated)
        return found & self.present

    @property
    def present(self) -> NDArray[np.bool_]:
        """(n,) of which Gaussians edits left something, if only a copy."""
        alive = np.ones(len(self._scene.gaussians), np.bool_)
        copied = ~alive
        for edit, chosen in self._changes():
            if edit.kind == "remove":
                alive[chosen] = False
            elif edit.kind == "duplicate":
                copied |= chosen
        return alive | copied

    @property
    def centres(self) -> NDArray[np.float32]:
        """(n, 3) where the Gaussians were moved to, world, scene units; copies are left aside.

        The same array while nothing else is moved.
        """
        edits = tuple(edit for edit in self._document().edits if edit.kind in ("move", "remove"))
        if self._moved is None or self._moved[0] != edits:
            means = self._scene.gaussians.means.detach().cpu().clone()
            for edit, chosen in self._changes():
                if edit.kind == "move":
                    rows = torch.from_numpy(np.flatnonzero(chosen))
                    means[rows] = similarity_of(edit).apply(means[rows])
            self._moved = edits, means.numpy()
        return self._moved[1]

    def _changes(self) -> Iterator[tuple[Edit, NDArray[np.bool_]]]:
        """Each edit, and which Gaussians of the scene it changes: those that are left."""
        left = np.ones(len(self._scene.gaussians), np.bool_)
        for edit in self._document().edits:
            chosen = (self._masks.get(edit.mask) >= MEMBER) & left
            yield edit, chosen
            if edit.kind == "remove":
                left &= ~chosen

    @property
    def edited(self) -> Edited:
        """The Gaussians after all edits."""
        return self._edits()[0]

    @property
    def rows(self) -> NDArray[np.int64]:
        """(m,) of each Gaussian after all edits, the one of the scene that it comes from."""
        return self.edited.rows.numpy()

    @property
    def copies(self) -> NDArray[np.bool_]:
        """(m,) which of the edited Gaussians are copies, that no later edit changes."""
        return self._edits()[1]

    def _edits(self) -> tuple[Edited, NDArray[np.bool_]]:
        edits = self._document().edits
        if self._made is None or self._made[0] != edits:
            self._made = edits, *edited(self._scene.gaussians, edits, self._masks)
        return self._made[1:]

    def in_view(self, view: View | None) -> Edited | None:
        """What a view shows instead of the scene; None where it shows the scene as it is.

        Photographs show it as it was. All else shows edits, and not what is hidden, which stays a
        row with an opacity of 0.

        Args:
            view: A photograph of the scene, by its name, or a camera; None is the world.
        """
        if view is not None and view.name in self._photographed:
            return None
        document, seen = self._document(), self._seen
        if seen is None or seen[0] != document.revision:
            visible = self.visible
            same = seen is not None and seen[1] == document.edits
            if seen is None or not same or not np.array_equal(seen[2], visible):
                found = self._without(~visible)
            else:
                found = seen[3]
            self._seen = seen = (document.revision, document.edits, visible, found)
        return seen[3]

    def _without(self, hidden: NDArray[np.bool_]) -> Edited | None:
        found = self.edited if changes_rows(self._document().edits) else None
        if not hidden.any():
            return found
        found = Edited.unchanged(self._scene.gaussians) if found is None else found
        gaussians = found.gaussians
        lit = ~torch.from_numpy(hidden)[found.rows].to(gaussians.opacities.device)
        return Edited(
            gaussians=gaussians.replace(opacities=gaussians.opacities * lit), rows=found.rows
        )


class Owners:
    """Which object each Gaussian belongs to: the surest, of equally sure ones the later.

    What was found is kept, and gone on with where objects were only added.

    Args:
        gaussians: Gaussians of the scene.
        masks: The masks of the objects.
    """

    def __init__(self, gaussians: int, masks: Masks) -> None:
        self._gaussians = gaussians
        self._masks = masks
        self._known: tuple[tuple[int, str], ...] = ()
        self._ids = np.full(gaussians, UNLABELLED, np.int32)
        self._sure = np.zeros(gaussians, np.uint8)

    def of(self, objects: Sequence[Object]) -> tuple[NDArray[np.int32], Confidence]:
        """The id of the object of each Gaussian, -1 for none, and its confidence, 0 to 255."""
        wanted = tuple((one.id, one.mask.id) for one in objects)
        done = len(self._known)
        if wanted[:done] != self._known:
            done = 0
            self._ids = np.full(self._gaussians, UNLABELLED, np.int32)
            self._sure = np.zeros(self._gaussians, np.uint8)
        if done < len(wanted):
            ids, sure = self._ids.copy(), self._sure.copy()
            for one in objects[done:]:
                confidence = self._masks.get(one.mask)
                better = (confidence >= MEMBER) & (confidence >= sure)
                ids[better] = one.id
                sure[better] = confidence[better]
            self._ids, self._sure = ids, sure
        self._known = wanted
        for array in (self._ids, self._sure):
            array.flags.writeable = False
        return self._ids, self._sure


def changes_rows(edits: Sequence[Edit]) -> bool:
    """Whether edits draw other Gaussians than the scene has; what is removed is left out alone."""
    return any(edit.kind != "remove" for edit in edits)


def similarity_of(edit: Edit) -> Similarity:
    """The movement of an edit: x becomes about + s R (x - about) + t."""
    rotation = rotation_from_quaternion(torch.tensor(edit.rotation, dtype=torch.float64))
    about = torch.tensor(edit.about, dtype=torch.float64)
    translation = torch.tensor(edit.translation, dtype=torch.float64)
    return Similarity(
        rotation=rotation,
        translation=about + translation - edit.scale * (rotation @ about),
        scale=edit.scale,
    )


def edited(
    gaussians: Gaussians, edits: Sequence[Edit], masks: Masks
) -> tuple[Edited, NDArray[np.bool_]]:
    """Gaussians after edits, each of which is of those that were there before the first.

    What was removed is not changed any more; copies stay as they were made.

    Returns:
        The Gaussians, and which of them are copies.
    """
    found = Edited.unchanged(gaussians)
    copied = torch.zeros(len(gaussians), dtype=torch.bool)
    for edit in edits:
        chosen = torch.from_numpy(masks.get(edit.mask) >= MEMBER)[found.rows] & ~copied
        if not bool(chosen.any()):
            continue
        step = _step(found.gaussians, Selection(mask=chosen), edit)
        copied = copied[step.rows]
        copied[len(found) :] = True
        found = found.then(step)
    return found, copied.numpy()


def _step(gaussians: Gaussians, selection: Selection, edit: Edit) -> Edited:
    match edit.kind:
        case "remove":
            return remove(gaussians, selection)
        case "duplicate":
            return duplicate(gaussians, selection, similarity_of(edit))
        case "move":
            return transform(gaussians, similarity_of(edit), selection=selection)
        case "recolour":
            colour = [value / 255 for value in edit.colour or (0, 0, 0)]
            return recolour(gaussians, selection, colour=colour)
