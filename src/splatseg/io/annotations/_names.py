"""Which view a picture of an annotation file is, by its name."""

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from urllib.parse import unquote

from splatseg.core import View
from splatseg.errors import InputError, quoted

_ADDED = re.compile(r"^[0-9a-f]{8}-")
"""What Label Studio puts before the name of a file that is uploaded."""


def parts_of(name: str) -> tuple[str, ...]:
    r"""The folders and the file of a path or address of any system; nothing is opened by it.

    Example:
        >>> parts_of(r"..\images\000.jpg"), parts_of("/data/local-files/?d=left/a%20b.png")
        (('images', '000.jpg'), ('left', 'a b.png'))
    """
    path = unquote(name.rpartition("?d=")[2] if "?d=" in name else name.partition("?")[0])
    return tuple(part for part in re.split(r"[/\\]", path) if part not in ("", ".", ".."))


def view_name(name: str) -> str:
    """What a picture's view is called where no views are given: its path without its suffix."""
    return "/".join((*parts_of(name)[:-1], _stem(parts_of(name))))


def matched(names: Sequence[str], views: Sequence[View], *, where: str) -> Mapping[str, int]:
    """The picture of each view that has one, as its index in `names`.

    A picture is of the view whose photograph has its name; else of the view whose photograph, or
    name, has its name without the suffix; else without the eight letters that Label Studio puts
    before names. Where several views have, the one counts that shares most folders with it.

    Raises:
        InputError: If a picture may be of several views, or several are of one; `where` starts
            the message.
    """
    files: dict[str, list[tuple[tuple[str, ...], str]]] = {}
    stems: dict[str, list[tuple[tuple[str, ...], str]]] = {}
    for view in views:
        named = tuple(view.name.split("/"))
        stems.setdefault(named[-1], []).append((named, view.name))
        if view.image is not None:
            parts = view.image.parts
            files.setdefault(parts[-1], []).append((parts, view.name))
            stem = (*parts[:-1], _stem(parts))
            stems.setdefault(stem[-1], []).append((stem, view.name))
    found: dict[str, int] = {}
    for index, name in enumerate(names):
        view = _view_of(name, files, stems, where)
        if view is None:
            continue
        if view in found:
            raise InputError(
                f"{where}: expected one picture a view, got {quoted(names[found[view]])} and "
                f"{quoted(name)} of view {quoted(view)}."
            )
        found[view] = index
    return dict(sorted(found.items()))


def check_some(
    indices: Mapping[str, int], names: Sequence[str], views: Sequence[View], *, where: str
) -> None:
    """Refuse pictures none of which is of a view.

    Raises:
        InputError: With names of both.
    """
    if not indices:
        wanted, got = (
            ", ".join(quoted(name) for name in some[:3])
            for some in ([view.name for view in views], names)
        )
        raise InputError(
            f"{where}: expected pictures of the scene's views ({wanted}, ...), got none of them "
            f"but {len(names)} others ({got or 'none'})."
        )


def unmatched_note(names: Sequence[str], indices: Mapping[str, int]) -> tuple[str, ...]:
    """A sentence on the pictures that are of no view, if there are some."""
    used = set(indices.values())
    others = [quoted(name) for i, name in enumerate(names) if i not in used]
    if not others:
        return ()
    some = ", ".join(others[:3]) + (", ..." if len(others) > 3 else "")
    return (f"{len(others)} of {len(names)} annotated pictures are of no view ({some}).",)


def _view_of(
    name: str,
    files: Mapping[str, Sequence[tuple[tuple[str, ...], str]]],
    stems: Mapping[str, Sequence[tuple[tuple[str, ...], str]]],
    where: str,
) -> str | None:
    parts = parts_of(name)
    if not parts:
        return None
    stem = (*parts[:-1], _stem(parts))
    plain = (*stem[:-1], _ADDED.sub("", stem[-1], count=1))
    for known, wanted in ((files, parts), (stems, stem), (stems, parts), (stems, plain)):
        candidates = known.get(wanted[-1])
        if candidates:
            shared = Counter[str]()
            for other, view in candidates:
                shared[view] = max(shared[view], _shared(wanted, other))
            (best, count), *others = shared.most_common(2)
            if others and others[0][1] == count:
                raise InputError(
                    f"{where}: expected names that tell one view, got {quoted(name)}, which may be "
                    f"{quoted(best)} or {quoted(others[0][0])}."
                )
            return best
    return None


def _stem(parts: Sequence[str]) -> str:
    return parts[-1].rpartition(".")[0] or parts[-1] if parts else ""


def _shared(one: Sequence[str], other: Sequence[str]) -> int:
    """How many parts two paths share from their ends."""
    count = 0
    for left, right in zip(reversed(one), reversed(other), strict=False):
        if left != right:
            break
        count += 1
    return count
