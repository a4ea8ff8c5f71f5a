"""Records of TensorFlow's TFRecord files, one at a time, and messages of Protocol Buffers in them.

A record is its length (u64), the checksum of that, its bytes and their checksum; a checksum is
CRC-32C (Castagnoli), masked: turned right by 15 bits, plus 0xa282ead8. A message is fields: a key
(number times 8 plus kind) and a value. Which number means what, the reader of a message knows.
"""

import struct
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splatseg.io.foreign import expect, malformed, reading

_POLYNOMIAL = 0x82F63B78
_MASK = 0xA282EAD8
_WORD = (1 << 32) - 1
_HEAD = struct.Struct("<QI")
_LANES = 1 << 12
"""Pieces of a record whose checksums are computed side by side."""

Value = int | bytes
Message = dict[int, list[Value]]
"""Values of the fields of a message by their numbers, in the order in which they came: whole
numbers, or bytes (text, messages, packed lists, and numbers of 4 or 8 bytes)."""


def read_records(path: Path) -> Iterator[bytes]:
    """The records of a file in their order.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it ends early, or a checksum is not that of its bytes.
    """
    with reading(path, "a TFRecord file"):
        stream = path.open("rb")
        size = path.stat().st_size
    with stream:
        number = 0
        while True:
            where = f"{path}: record {number}"
            with reading(path, "a TFRecord file"):
                head = stream.read(_HEAD.size)
            if not head:
                return
            whole = "a whole record, but the file ends early"
            expect(len(head) == _HEAD.size, where, whole)
            length, check = _HEAD.unpack(head)
            wanted = "the checksum of its length, got another; the file is damaged, or no TFRecord "
            wanted += "file"
            expect(masked_crc32c(head[:8]) == check, where, wanted)
            expect(length <= size - stream.tell() - 4, where, whole)
            with reading(path, "a TFRecord file"):
                content = stream.read(length)
                (check,) = struct.unpack("<I", stream.read(4))
            what = f"the checksum of its {length} bytes, got another; the file is damaged"
            expect(masked_crc32c(content) == check, where, what)
            yield content
            number += 1


def masked_crc32c(content: bytes) -> int:
    """The checksum of bytes as a record has it.

    Example:
        >>> hex(masked_crc32c(b"123456789"))
        '0xc78ab0e5'
    """
    value = crc32c(content)
    return (((value >> 15) | (value << 17)) + _MASK) & _WORD


def crc32c(content: bytes) -> int:
    """CRC-32C of bytes: pieces of one length side by side, then put together one by one.

    Example:
        >>> hex(crc32c(b"123456789"))  # the check value that catalogues of CRCs give
        '0xe3069283'
    """
    length = len(content) // _LANES
    state = _WORD
    if length:
        lanes = np.frombuffer(content, np.uint8, length * _LANES).reshape(_LANES, length)
        table = _table()
        states = np.zeros(_LANES, np.uint32)
        for i in range(length):
            states = table[(states ^ lanes[:, i]) & 255] ^ (states >> np.uint32(8))
        shift = _zeros(length)
        for piece in states.tolist():
            state = (
                shift[0][state & 255]
                ^ shift[1][state >> 8 & 255]
                ^ shift[2][state >> 16 & 255]
                ^ shift[3][state >> 24]
                ^ piece
            )
    rest = _table().tolist()
    for byte in content[length * _LANES :]:
        state = rest[(state ^ byte) & 255] ^ (state >> 8)
    return state ^ _WORD


def parse_message(content: bytes, *, where: object) -> Message:
    """The fields of a message.

    Raises:
        FileFormatError: If it ends early, or is none.
    """
    fields: Message = {}
    at, end = 0, len(content)
    while at < end:
        key, at = _varint(content, at, where)
        kind = key & 7
        value: Value
        if kind == 0:
            value, at = _varint(content, at, where)
        else:
            expect(kind in (1, 2, 5), where, f"a message, got a field of kind {kind}")
            length, at = _varint(content, at, where) if kind == 2 else (8 if kind == 1 else 4, at)
            expect(length <= end - at, where, "a whole message, but it ends early")
            value, at = content[at : at + length], at + length
        fields.setdefault(key >> 3, []).append(value)
    return fields


def packed_integers(content: bytes, *, where: object) -> NDArray[np.int64]:
    """Whole numbers of a packed list, of any length each; negative ones have ten bytes.

    Raises:
        FileFormatError: If the last of them ends early, or one has more than 64 bits.
    """
    raw = np.frombuffer(content, np.uint8)
    ends = np.flatnonzero(raw < 128)
    if not raw.size:
        return np.zeros(0, np.int64)
    whole = ends.size and ends[-1] == len(raw) - 1
    expect(whole, where, "whole numbers, but the last ends early")
    starts = np.concatenate(([0], ends[:-1] + 1))
    lengths = ends - starts + 1
    expect(lengths.max() <= 10, where, "numbers of 64 bits, got longer ones")
    values = np.zeros(len(ends), np.uint64)
    for i in range(int(lengths.max())):
        has = lengths > i
        part = (raw[starts[has] + i] & 127).astype(np.uint64)
        values[has] |= part << np.uint64(7 * i)
    return values.view(np.int64)


def _varint(content: bytes, at: int, where: object) -> tuple[int, int]:
    value = shift = 0
    while at < len(content) and shift < 70:
        byte = content[at]
        at += 1
        value |= (byte & 127) << shift
        if byte < 128:
            return value, at
        shift += 7
    raise malformed(where, "a whole message, but a number in it is damaged")


@cache
def _table() -> NDArray[np.uint32]:
    """What each byte does to a checksum."""
    values = np.arange(256, dtype=np.uint32)
    for _ in range(8):
        odd = np.where(values & 1, np.uint32(_POLYNOMIAL), np.uint32(0))
        values = (values >> np.uint32(1)) ^ odd
    return values


@cache
def _zeros(count: int) -> tuple[list[int], ...]:
    """What `count` zero bytes do to each byte of a checksum: squares of a linear map of bits."""
    table = _table().tolist()
    step = [table[bit & 255] ^ (bit >> 8) for bit in (1 << i for i in range(32))]
    whole = [1 << i for i in range(32)]
    while count:
        if count & 1:
            whole = [_applied(step, column) for column in whole]
        step = [_applied(step, column) for column in step]
        count >>= 1
    return tuple([_applied(whole, byte << 8 * place) for byte in range(256)] for place in range(4))


def _applied(columns: list[int], value: int) -> int:
    found = 0
    for i, column in enumerate(columns):
        if value >> i & 1:
            found ^= column
    return found
