"""The evidence that is meant by label maps: named, or the only ones there are."""

from collections.abc import Sequence
from pathlib import Path

from splatseg.errors import InputError
from splatseg.io.evidence import evidence_names, find_evidence, open_evidence


def find_label_maps(folders: Sequence[Path], name: str | None, *, option: str = "evidence") -> Path:
    """The folder of evidence of this name; without one, that of the only label maps.

    Args:
        folders: Folders of scenes and captures, the one to prefer first.
        name: The folder's name. None takes the only evidence of labels: there may be other kinds,
            such as depth of scans, which a fit puts into its scene itself.
        option: What names it, for messages.

    Raises:
        InputError: If there is none, or no name and not just one.
    """
    if name is not None:
        return find_evidence(folders, name, option=option)
    kinds = {
        each: open_evidence(find_evidence(folders, each), unfinished="allow").kind
        for each in evidence_names(folders)
    }
    labels = [each for each, kind in kinds.items() if kind == "labels"]
    if len(labels) != 1:
        known = ", ".join(labels) or "there are none; `splatseg see` makes some"
        raise InputError(f"{option}: expected label maps by name ({known}), got none.")
    return find_evidence(folders, labels[0])
