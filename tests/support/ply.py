"""PLY files as other programs write them."""

import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

_CODES = {"uchar": "B", "ushort": "H", "int": "i", "uint": "I", "float": "f", "double": "d"}
Column = tuple[str, str, Sequence[Any]]
"""Type (``float``, or ``list uchar int``), name, and a number or a list a row."""


def write_ply(elements: dict[str, Sequence[Column]], path: Path, *, order: str = "little") -> Path:
    """Elements as ``little`` or ``big`` endian binary, or as ``ascii``."""
    kind = "ascii" if order == "ascii" else f"binary_{order}_endian"
    lines = ["ply", f"format {kind} 1.0", "comment made by a test"]
    body = bytearray()
    for name, columns in elements.items():
        lines.append(f"element {name} {len(columns[0][2])}")
        lines += [f"property {column_type} {column}" for column_type, column, _ in columns]
        for row in range(len(columns[0][2])):
            words: list[str] = []
            for column_type, _, values in columns:
                types = column_type.split()[1:]
                many = list(values[row]) if types else [values[row]]
                codes = [types[0], *[types[1]] * len(many)] if types else [column_type]
                numbers = [len(many), *many] if types else many
                words += [repr(number) for number in numbers]
                if order != "ascii":
                    sign = "<" if order == "little" else ">"
                    body += struct.pack(sign + "".join(_CODES[c] for c in codes), *numbers)
            if order == "ascii":
                body += " ".join(words).encode() + b"\n"
    path.write_bytes("\n".join([*lines, "end_header", ""]).encode() + body)
    return path
