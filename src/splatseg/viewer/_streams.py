"""What a page needs to draw the Gaussians itself: their file, and what is known of each.

A page that draws (``stage`` "gpu") loads the Gaussians once, as PLY, in the order of the scene.
What changes comes as two streams: the object of each Gaussian, and whether it is selected. Edits
that move, copy or recolour make other Gaussians: they get another version, which the page loads.
Removed ones are marked as left out.
"""

import secrets
import tempfile
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from splatseg.errors import InputError
from splatseg.io.scene_folder import GAUSSIANS_FILE, current_file
from splatseg.io.splats import write_splats
from splatseg.viewer import _messages as messages
from splatseg.viewer._client import Client
from splatseg.viewer._document import MEMBER, Document, Edit
from splatseg.viewer._session import Session
from splatseg.viewer._shown import changes_rows

LEFT_OUT = 4095
"""The code of Gaussians that are not drawn. The page's palette has 4096 colours, by code: 0 is of
no object, others are an object's id + 1."""

_VERSIONS = 1 << 32

Number = TypeVar("Number", bound=np.generic)


class Streams:
    """Tells pages that draw what they draw.

    Args:
        session: The scene and what was made of it.
    """

    def __init__(self, session: Session) -> None:
        self._session = session
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        # By chance, so that a page knows Gaussians of another server or checkpoint from these.
        self._own = secrets.randbelow(_VERSIONS)
        self._edited: tuple[tuple[Edit, ...], int] = ((), self._own)
        self._codes: tuple[Document, NDArray[np.uint16]] | None = None

    def close(self) -> None:
        """Remove what was written."""
        if self._folder is not None:
            self._folder.cleanup()
        self._folder = None

    @property
    def version(self) -> int:
        """Of the Gaussians that are drawn now."""
        edits = self._session.document.edits
        if not changes_rows(edits):
            return self._own
        if self._edited[0] != edits:
            self._edited = edits, (self._edited[1] + 1) % _VERSIONS
        return self._edited[1]

    def file(self, version: int) -> Path:
        """A PLY file of the Gaussians that are drawn now.

        Raises:
            InputError: If they are of another version by now.
        """
        if version != self.version:
            raise InputError("gaussians: they have changed since.")
        scene = self._session.scene
        if version == self._own and scene.root is not None:
            return current_file(scene.root, GAUSSIANS_FILE)
        if self._folder is None:
            self._folder = tempfile.TemporaryDirectory(prefix="splatseg-view-")
        path = Path(self._folder.name) / f"{version}.ply"
        if not path.is_file():
            for old in path.parent.glob("*.ply"):
                old.unlink()
            edited = scene if version == self._own else self._session.edited_scene()
            write_splats(edited.gaussians, path)
        return path

    def tell(self, client: Client) -> None:
        """Send a page that draws what it does not know yet."""
        if client.stage != "gpu":
            return
        version, codes = self.version, self._current_codes()
        told = client.data.get("streams", (None, None, False))
        selection = self._session.document.selection
        if told[0] != version or told[1] is not codes:
            client.send_bytes(messages.codes_bytes(version, codes))
        if told[0] != version or told[2] != selection:
            members = np.zeros(len(codes), np.bool_)
            if selection is not None:
                members = self._drawn(self._session.confidence(selection) >= MEMBER)
            client.send_bytes(messages.selection_bytes(version, members))
        client.data["streams"] = version, codes, selection

    def _current_codes(self) -> NDArray[np.uint16]:
        """The code of each Gaussian that is drawn; the same array while they are the same."""
        document = self._session.document
        if self._codes is None or not _same(self._codes[0], document):
            codes = self._codes_now()
            before = None if self._codes is None else self._codes[1]
            if before is not None and np.array_equal(before, codes):
                codes = before
            self._codes = document, codes
        return self._codes[1]

    def _codes_now(self) -> NDArray[np.uint16]:
        shown = self._session.shown
        owners = shown.owners
        known = (owners >= 0) & (owners + 1 < LEFT_OUT)
        codes = np.where(known, owners + 1, 0).astype(np.uint16)
        # The page hides objects by their colour; what has none, it cannot.
        codes[~shown.visible & (owners >= 0) & ~known] = LEFT_OUT
        codes[~shown.present] = LEFT_OUT
        return self._drawn(codes)

    def _drawn(self, values: NDArray[Number]) -> NDArray[Number]:
        """Values of the scene's Gaussians as those of the Gaussians that are drawn."""
        edits = self._session.document.edits
        return values[self._session.shown.rows] if changes_rows(edits) else values


def _same(one: Document, other: Document) -> bool:
    """Whether the same codes come of two documents."""
    return (one.objects, one.isolated, one.edits) == (
        other.objects, other.isolated, other.edits,
    )  # fmt: skip
