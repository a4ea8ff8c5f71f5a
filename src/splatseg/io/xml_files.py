"""XML of other programs, an element at a time; and OpenCV's storage in it.

    <?xml version="1.0"?>
    <opencv_storage>
    <object1>
      <label>car</label>
      <transform type_id="opencv-matrix">
        <rows>4</rows><cols>4</cols><dt>f</dt><data>1. 0. ...</data>
      </transform>
    </object1>
    ...

A document type is refused: entities are declared there, and with them a few bytes may stand for
gigabytes, or for other files.
"""

import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splatseg.core.json_values import MAX_NUMBER
from splatseg.errors import quoted, reason
from splatseg.io.foreign import expect, malformed, reading
from splatseg.io.text_numbers import numbers_of

_PIECE = 1 << 16
"""Characters that are parsed at once."""


def xml_elements(path: Path, kind: str, root: str, *, hint: str = "") -> Iterator[ET.Element]:
    """The elements just below the root of a file, each whole, one in memory.

    Args:
        path: The file, in UTF-8 whatever encoding it names.
        kind: What it should be, for messages.
        root: Name of its root.
        hint: What to say where the root is another.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it is no XML, ends early, has a document type or another root.
    """
    with reading(path, kind):
        text = path.read_text("utf-8")
    expect("<!DOCTYPE" not in text, path, "XML without a document type, got one")
    parser = ET.XMLPullParser(("start", "end"))
    above: list[ET.Element] = []
    try:
        for at in range(0, len(text) + 1, _PIECE):
            parser.feed(text[at : at + _PIECE])
            if at + _PIECE > len(text):
                parser.close()
            events: Iterator[tuple[str, ET.Element]] = parser.read_events()  # pyright: ignore[reportAssignmentType]
            for event, element in events:
                if event == "start":
                    named = above or element.tag == root
                    expect(named, path, f"{kind}, got XML of {quoted(element.tag)}{hint}")
                    above.append(element)
                    continue
                above.pop()
                if len(above) == 1:
                    yield element
                    above[0].clear()
    except ET.ParseError as error:
        raise malformed(path, f"{kind}, but it cannot be read ({reason(error)})") from error


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredObject:
    """One object of OpenCV's storage; names of elements within each other are joined by dots."""

    where: str
    """The file and the object; starts messages."""

    element: ET.Element

    def has(self, name: str) -> bool:
        """Whether it has an element."""
        return self.element.find(name) is not None

    def text(self, name: str) -> str:
        """The text of an element, empty where it has none."""
        return self.element.findtext(name.replace(".", "/"), "").strip().strip('"')

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
        where = f"{self.where}: {name}"
        rows, columns = self.whole(f"{name}.rows"), self.whole(f"{name}.cols")
        values = numbers_of(self.text(f"{name}.data").split())
        if values is None:
            raise malformed(where, "numbers, got other words")
        fits = min(rows, columns) >= 1 and len(values) == rows * columns
        expect(fits, where, f"{rows} x {columns} numbers, got {len(values)}")
        finite = (np.abs(values) <= MAX_NUMBER).all()
        expect(finite, where, f"finite numbers up to {MAX_NUMBER:g}, got others")
        return values.reshape(rows, columns)


def stored_objects(path: Path) -> Iterator[StoredObject]:
    """The objects of a file of OpenCV in their order, one in memory.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it is no such XML, ends early or has a document type.
    """
    for element in xml_elements(path, "XML of OpenCV", "opencv_storage"):
        yield StoredObject(where=f"{path}: {quoted(element.tag)}", element=element)
