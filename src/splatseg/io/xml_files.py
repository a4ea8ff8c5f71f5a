"""XML of other programs, read piece by piece.

A document type is refused: entities are declared there, and with them a few bytes may stand for
gigabytes, or for other files.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Protocol
from xml.parsers import expat

from splatseg.errors import FileFormatError, reason
from splatseg.io.foreign import reading

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
                raise FileFormatError(
                    f"{path}: expected {kind}, but it cannot be read ({reason(error)})."
                ) from error
            yield
            if not piece:
                return
