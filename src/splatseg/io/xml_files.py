"""XML of other programs, read piece by piece; and OpenCV's storage in it, an object at a time.

A document type is refused: entities are declared there, and with them a few bytes may stand for
gigabytes, or for other files.
"""

import re
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol
from xml.parsers import expat

import numpy as np
from numpy.typing import NDArray

from splatseg.core.json_values import MAX_NUMBER
from splatseg.errors import FileFormatError, quoted, reason
from splatseg.io.foreign import expect, malformed, reading
from splatseg.io.text_numbers import numbers_of

_CHUNK = 1 << 16


class XmlReader(Protocol):
    """What is told of the elements of a file, in their order."""

    def start(self, name: str, attributes: dict[str, str], /) -> None:
        """An element begins."""

    def end(self, name: str, /) -> None:
        """An element ends."""

    def text(self, text: str, /) -> None:
        """Text, within the element that began last and has not ended."""


def read_xml(path: Path, kind: str, reader: XmlReader) -> Iterator[None]:
    """Tell a reader of the elements of a file; after each piece of it comes None.

    Args:
        path: The file, in UTF-8 whatever encoding it names.
        kind: What it should be, for messages.
        reader: Told of elements.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it is no XML, ends early or has a document type.
    """

    def refuse(*_: object) -> None:
        raise FileFormatError(f"{path}: expected XML without a document type, got one.")

    parser = expat.ParserCreate("utf-8")
    parser.buffer_text = True
    parser.StartElementHandler = reader.start
    parser.EndElementHandler = reader.end
    parser.CharacterDataHandler = reader.text
    parser.StartDoctypeDeclHandler = refuse
    with reading(path, kind):
        stream = path.open("rb")
    with stream:
        while True:
            with reading(path, kind):
                piece = stream.read(_CHUNK)
            try:
                parser.Parse(piece, not piece)
            except expat.ExpatError as error:
                raise malformed(path, f"{kind}, but it cannot be read ({reason(error)})") from error
            yield
            if not piece:
                return


# XML as OpenCV's FileStorage writes it, an object at a time.
#
#     <?xml version="1.0"?>
#     <opencv_storage>
#     <object1>
#       <label>car</label>
#       <transform type_id="opencv-matrix">
#         <rows>4</rows><cols>4</cols><dt>f</dt><data>1. 0. ...</data>
#       </transform>
#     </object1>
#     ...
#
# What is not asked for is not kept.


_KIND = "XML of OpenCV"
_ROOT = "opencv_storage"
_DEEPEST = 8
"""Elements within each other; four are used."""

_LONGEST = 1 << 22
"""Characters of what is kept of one object."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredObject:
    """One object: text by the names of its elements, those within each other joined by dots."""

    where: str
    """The file and the object; starts messages."""

    texts: dict[str, str]

    def has(self, name: str) -> bool:
        """Whether it has an element, or one within it."""
        return any(key == name or key.startswith(f"{name}.") for key in self.texts)

    def text(self, name: str) -> str:
        """The text of an element, empty where it has none."""
        return self.texts.get(name, "").strip().strip('"')

    def whole(self, name: str) -> int:
        """The whole number of an element.

        Raises:
            FileFormatError: If there is none.
        """
        word = self.text(name)
        sound = re.fullmatch(r"[-+]?[0-9]{1,18}", word)
        expect(sound, f"{self.where}: {name}", "a whole number", word)
        return int(word)

    def matrix(self, name: str) -> NDArray[np.float64]:
        """The matrix of an element.

        Raises:
            FileFormatError: If there is none, it has more or fewer numbers than its rows and
                columns say, or one of them is NaN or infinite.
        """
        rows, columns = self.whole(f"{name}.rows"), self.whole(f"{name}.cols")
        where, values = (
            f"{self.where}: {name}",
            numbers_of(self.texts.get(f"{name}.data", "").split()),
        )
        if values is None:
            raise malformed(where, "numbers, got other words")
        fits = min(rows, columns) >= 1 and len(values) == rows * columns
        expect(fits, where, f"{rows} x {columns} numbers, got {len(values)}")
        finite = (np.abs(values) <= MAX_NUMBER).all()
        expect(finite, where, f"finite numbers up to {MAX_NUMBER:g}, got others")
        return values.reshape(rows, columns)


def stored_objects(path: Path, wanted: Collection[str]) -> Iterator[StoredObject]:
    """The objects of a file in their order, one in memory.

    Args:
        path: The file.
        wanted: Names of elements of objects whose text is kept, such as ``transform.data``.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it is no such XML, ends early, has a document type, or an object is
            too large.
    """
    found = _Found(path, wanted)
    for _ in read_xml(path, _KIND, found):
        yield from found.taken()


class _Found:
    """What Expat tells of a file, gathered into objects."""

    def __init__(self, path: Path, wanted: Collection[str]) -> None:
        self._path, self._wanted = path, wanted
        self._names: list[str] = []
        self._key: str | None = None
        self._texts: dict[str, list[str]] = {}
        self._kept = 0
        self._objects: list[StoredObject] = []

    def taken(self) -> list[StoredObject]:
        """The objects that ended since this was last asked."""
        objects, self._objects = self._objects, []
        return objects

    @property
    def _where(self) -> str:
        return f"{self._path}: {quoted(self._names[1])}" if self._names[1:] else str(self._path)

    def start(self, name: str, attributes: dict[str, str]) -> None:
        self._names.append(name)
        known = self._names[0] == _ROOT and len(self._names) <= _DEEPEST
        expect(known, self._where, f"{_KIND}, got other elements")
        if len(self._names) == 2:
            self._texts, self._kept = {}, 0
        key = ".".join(self._names[2:])
        expect(key not in self._texts, self._where, f"{key} once, got it twice")
        self._key = key if key in self._wanted else None
        if self._key is not None:
            self._texts[key] = []

    def text(self, text: str) -> None:
        if self._key is None:
            return
        self._kept += len(text)
        what = f"at most {_LONGEST} characters of an object, got more"
        expect(self._kept <= _LONGEST, self._where, what)
        self._texts[self._key].append(text)

    def end(self, name: str) -> None:
        if len(self._names) == 2:
            texts = {key: "".join(parts) for key, parts in self._texts.items()}
            self._objects.append(StoredObject(where=self._where, texts=texts))
        self._key = None
        self._names.pop()
