"""Ways to damage a file. Containers are opened, damaged within and closed with right check sums."""

import copy
import gzip
import io
import json
import math
import re
import struct
import zipfile
import zlib
from collections.abc import Callable
from random import Random
from typing import Any

Mutation = Callable[[Random, bytes], bytes | None]

INTEGERS = (0, 1, -1, 2, 127, 128, 255, 2**15, 2**16 - 1, 2**31 - 1, -(2**31), 2**32 - 1)
INTEGERS += (2**62, 2**63 - 1, -(2**63), 2**64 - 1)
REALS = (0.0, -0.0, 1e-45, 1e38, -1e38, 1e308, math.inf, -math.inf, math.nan)
WORDS = (b"0", b"-1", b"1e999", b"nan", b"-inf", b"4294967295", b"18446744073709551616", b"1e30")
WORDS += (b"9" * 400, b"9" * 5000, b"", b"\xff\xfe", b"x" * 5000, b"../../etc/passwd", b"0x10")
VALUES: tuple[Any, ...] = (None, True, False, 0, -1, 1, 2.5, 1e308, -1e308, 2**31, 2**63, -(2**70))
VALUES += (10**400, math.nan, math.inf, "", "x", "1", "\0", "\ud800", "a/../../b", "é" * 9, [], {})
VALUES += ("x" * 5000, "/" * 300, [0] * 70, [[]], {"": {}}, [math.nan] * 16, [[1e200] * 4] * 4)
_DIGITS = re.compile(rb"[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?|[A-Za-z_]{2,}")


def mutate(random: Random, data: bytes) -> tuple[str, bytes]:
    """A damaged copy, and the family of the damage."""
    opened = _open(random, data) if random.random() < 0.75 else None
    if opened is not None:
        part, close = opened
        family, damaged = mutate(random, part)
        return family, close(damaged)
    names = list(FAMILIES)
    random.shuffle(names)
    for family in names:
        damaged = FAMILIES[family](random, data)
        if damaged is not None and damaged != data:
            return family, damaged
    return "truncation", data[:-1]


def bits(random: Random, data: bytes) -> bytes | None:
    """One to eight bits flipped."""
    if not data:
        return None
    copy = bytearray(data)
    for _ in range(random.randint(1, 8)):
        copy[_place(random, len(copy))] ^= 1 << random.randrange(8)
    return bytes(copy)


def truncation(random: Random, data: bytes) -> bytes | None:
    """The end cut off, or more of it."""
    if random.random() < 0.2:
        return data + random.randbytes(random.choice((1, 4, 100)))
    return data[: random.randrange(len(data))] if data else None


def splice(random: Random, data: bytes) -> bytes | None:
    """A piece put elsewhere, left out or doubled."""
    if len(data) < 4:
        return None
    begin = random.randrange(len(data) - 1)
    piece = data[begin : begin + random.randint(1, min(64, len(data) - begin))]
    at, cut = random.randrange(len(data)), random.choice((0, 0, len(piece), 8))
    times = random.choice((1, 1, 1, 2, 50))
    return data[:at] + random.choice((piece, b"")) * times + data[at + cut :]


def numbers(random: Random, data: bytes) -> bytes | None:
    """A binary number replaced by an extreme one."""
    if len(data) < 8:
        return None
    size = random.choice((1, 2, 4, 4, 8, 8))
    if size >= 4 and random.random() < 0.4:
        value = struct.pack("<f" if size == 4 else "<d", _real(random, size))
    else:
        value = (random.choice(INTEGERS) % (1 << 8 * size)).to_bytes(size, "little")
    if random.random() < 0.1:
        value = value[::-1]
    at = _place(random, len(data) - size + 1)
    if random.random() < 0.7:
        at -= at % min(size, 4)
    return data[:at] + value + data[at + size :]


def words(random: Random, data: bytes) -> bytes | None:
    """A number or word of text replaced by an extreme one."""
    head = data[:20000]
    found = list(_DIGITS.finditer(head))
    if (
        not found
        or sum(32 <= c < 127 or c in b"\n\r\t" for c in head[:200]) < min(len(head), 200) * 0.6
    ):
        return None
    token = random.choice(found)
    return data[: token.start()] + random.choice(WORDS) + data[token.end() :]


def json_values(random: Random, data: bytes) -> bytes | None:
    """A value of a JSON document replaced, left out, renamed or wrapped."""
    if data.lstrip()[:1] not in (b"{", b"["):
        return None
    try:
        root = json.loads(data)
    except ValueError:
        return None
    try:
        for _ in range(random.choice((1, 1, 1, 2, 4))):
            _change(random, root)
        text = json.dumps(root)
    except (RecursionError, ValueError):  # deeper than Python writes, or in itself
        return None
    return (text + " " * (-len(text) % 4)).encode()


FAMILIES: dict[str, Mutation] = {
    "bits": bits,
    "truncation": truncation,
    "splice": splice,
    "numbers": numbers,
    "words": words,
    "json": json_values,
}


def _place(random: Random, size: int) -> int:
    """An offset, more often near the beginning, where headers are."""
    return random.randrange(min(size, 128)) if random.random() < 0.5 else random.randrange(size)


def _real(random: Random, size: int) -> float:
    value = random.choice(REALS)
    return value if size == 8 or not math.isfinite(value) else max(-3e38, min(3e38, value))


def _change(random: Random, root: Any) -> None:
    places = list(_places(root))
    if not places:
        return
    holder, key = random.choice(places)
    chance = random.random()
    if chance < 0.6:
        # A copy: later changes of the case must not reach the next one.
        holder[key] = copy.deepcopy(random.choice(VALUES))
    elif chance < 0.75:
        del holder[key]
    elif chance < 0.85 and isinstance(holder, dict):
        holder[random.choice(("", "x", "\ud800", "-1", "9" * 30, "y" * 3000))] = holder.pop(key)
    elif chance < 0.9:
        for _ in range(random.choice((1, 50, 900))):
            holder[key] = [holder[key]]
    elif isinstance(holder, list):
        holder.extend(copy.deepcopy([holder[key]]) * random.choice((1, 100)))
    else:
        other, name = random.choice(places)
        holder[key] = json.loads(json.dumps(other[name])) if other is not holder else None


def _places(root: Any) -> Any:
    """Every holder and key of a document, a few thousand at most."""
    pending, seen = [root], 0
    while pending and seen < 3000:
        holder = pending.pop()
        keys = list(holder) if isinstance(holder, dict) else list(range(min(len(holder), 50)))
        for key in keys:
            seen += 1
            yield holder, key
            if isinstance(holder[key], (dict, list)):
                pending.append(holder[key])


def _open(random: Random, data: bytes) -> tuple[bytes, Callable[[bytes], bytes]] | None:
    """A part of a container, and what closes the container around another part."""
    for magic, opener in _CONTAINERS:
        if data.startswith(magic):
            return opener(random, data)
    return None


def _zip(random: Random, data: bytes) -> tuple[bytes, Callable[[bytes], bytes]]:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    chosen = random.choice(list(members))
    method = random.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))

    def close(part: bytes) -> bytes:
        file = io.BytesIO()
        with zipfile.ZipFile(file, "w", method) as archive:
            for name, content in members.items():
                archive.writestr(name, part if name == chosen else content)
        return file.getvalue()

    return members[chosen], close


def _gzip(random: Random, data: bytes) -> tuple[bytes, Callable[[bytes], bytes]]:
    return gzip.decompress(data), lambda part: gzip.compress(part, 1, mtime=0)


def _glb(random: Random, data: bytes) -> tuple[bytes, Callable[[bytes], bytes]]:
    (size,) = struct.unpack_from("<I", data, 12)
    rest = data[20 + size :]

    def close(part: bytes) -> bytes:
        length = 20 + len(part) + len(rest)
        return data[:8] + struct.pack("<II", length, len(part)) + data[16:20] + part + rest

    return data[20 : 20 + size], close


def _array(random: Random, data: bytes) -> tuple[bytes, Callable[[bytes], bytes]] | None:
    """The bytes that an array of uint8 holds: headers of layers are JSON in such ones."""
    (size,) = struct.unpack_from("<H", data, 8)
    body = data[10 + size :]
    if not body.startswith(b"{"):
        return None

    def close(part: bytes) -> bytes:
        words = f"{{'descr': '|u1', 'fortran_order': False, 'shape': ({len(part)},), }}\n".encode()
        return data[:8] + struct.pack("<H", len(words)) + words + part

    return body, close


def _png(random: Random, data: bytes) -> tuple[bytes, Callable[[bytes], bytes]]:
    chunks, at = [], 8
    while at + 12 <= len(data):
        (size,) = struct.unpack_from(">I", data, at)
        chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + size]))
        at += 12 + size
    chosen = random.randrange(len(chunks))

    def close(part: bytes) -> bytes:
        out = data[:8]
        for i, (kind, content) in enumerate(chunks):
            body = part if i == chosen else content
            out += struct.pack(">I", len(body)) + kind + body
            out += struct.pack(">I", zlib.crc32(kind + body))
        return out

    return chunks[chosen][1], close


_CONTAINERS: tuple[tuple[bytes, Any], ...] = (
    (b"PK\x03\x04", _zip),
    (b"\x1f\x8b", _gzip),
    (b"glTF", _glb),
    (b"\x93NUMPY\x01", _array),
    (b"\x89PNG\r\n\x1a\n", _png),
)
