"""One document that several people change: every change is written down, then made, then told."""

from collections.abc import Callable

from splatseg.errors import InputError
from splatseg.viewer._journal import Journal
from splatseg.viewer._masks import MaskStore
from splatseg.viewer._state import Command, Document, History, Key, changed_keys, keys_of

Callback = Callable[[Document, Document, str], None]
"""Is told of the document before a change, the document after it, and the author."""


class Editor:
    """Changes a document, by commands alone.

    Args:
        gaussians: Gaussians of the scene.
        journal: Where changes are written, and what there is already; None keeps all in memory.
    """

    def __init__(self, gaussians: int, journal: Journal | None = None) -> None:
        self._journal = journal
        self.masks = MaskStore(gaussians) if journal is None else journal.masks
        self.history = History() if journal is None else journal.history
        self._opened_at = self.document.revision
        self._changes: dict[Key, dict[str, int]] = {}
        self._callbacks: list[Callback] = []

    @property
    def document(self) -> Document:
        """As it is now."""
        return self.history.document

    @property
    def notes(self) -> tuple[str, ...]:
        """What should be known of how the journal was opened."""
        return () if self._journal is None else self._journal.notes

    def close(self) -> None:
        """Give the lock of the journal back, and forget masks that are in no folder."""
        self.masks.close()
        if self._journal is not None:
            self._journal.close()

    def subscribe(self, callback: Callback) -> Callable[[], None]:
        """Be told of each change; gives a function that ends it."""
        self._callbacks.append(callback)

        def end() -> None:
            if callback in self._callbacks:
                self._callbacks.remove(callback)

        return end

    def do(self, command: Command, *, author: str, revision: int | None) -> Document:
        """Do a command, see `Session.do`."""
        if revision is not None:
            self._check_unchanged(command, author, revision)
        entry = self.history.checked(command, self.masks, author)
        return self._change(lambda: self.history.do(entry), entry.after, author, command)

    def undo(self, author: str) -> Document:
        """Take the last command back, whoever did it."""
        return self._change(self.history.undo, self.history.next_undo.before, author)

    def redo(self, author: str) -> Document:
        """Do again what was undone last."""
        return self._change(self.history.redo, self.history.next_redo.after, author, redo=True)

    def _change(
        self,
        change: Callable[[], Document],
        after: Document,
        author: str,
        command: Command | None = None,
        *,
        redo: bool = False,
    ) -> Document:
        before, after = self.document, self.history.numbered(after)
        if self._journal is not None:
            self._journal.write(command, author=author, after=after, redo=redo)
        change()
        for key in changed_keys(before, after):
            self._changes.setdefault(key, {})[author] = after.revision
        for callback in tuple(self._callbacks):
            callback(before, self.document, author)
        return self.document

    def _check_unchanged(self, command: Command, author: str, revision: int) -> None:
        """Refuse a command on what another author changed after a revision.

        An author may send a second command before hearing of the first; nobody (the empty author)
        is always another. Of what was changed before the session was opened only that is known.
        """
        for key in sorted(keys_of(command)):
            changes = self._changes.get(key, {})
            others = [at for who, at in changes.items() if not who or who != author]
            if max([self._opened_at, *others]) > revision:
                kind, id = key
                name = "" if kind == "selection" else f" {id}"
                raise InputError(
                    f"{kind}{name}: it was changed since you saw it; look at it and try again."
                )
