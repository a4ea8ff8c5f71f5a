"""Records and messages: checksums of any length, numbers of any size."""

import numpy as np
import pytest

from splatseg.errors import FileFormatError
from splatseg.io import tfrecord
from splatseg.io.tfrecord import crc32c, packed_integers, parse_message, read_records
from support.waymo_tfrecord import crc32c as bit_by_bit
from support.waymo_tfrecord import field, framed, varint


def test_the_check_values_of_rfc_3720() -> None:
    """Appendix B.4 of iSCSI, whose checksum it is."""
    assert crc32c(bytes(32)) == 0x8A9136AA
    assert crc32c(b"\xff" * 32) == 0x62A8AB43
    assert crc32c(bytes(range(32))) == 0x46DD794E


@pytest.mark.parametrize("length", [0, 1, 7, 8, 9, 63, 64, 200])
def test_pieces_side_by_side_are_the_whole(length, monkeypatch, rng) -> None:
    content = rng.bytes(length)
    for lanes in (1, 2, 8, 64):
        monkeypatch.setattr(tfrecord, "_LANES", lanes)
        assert crc32c(content) == bit_by_bit(content)


def test_records_of_a_file(tmp_path) -> None:
    records = [b"", b"a", b"b" * 10_000]
    (tmp_path / "a").write_bytes(b"".join(framed(record) for record in records))
    assert list(read_records(tmp_path / "a")) == records


def test_fields_of_a_message() -> None:
    content = field(1, 300) + field(2, b"ab") + field(1, 1) + b"\x1d" + bytes(4)
    assert parse_message(content, where="a") == {1: [300, 1], 2: [b"ab"], 3: [bytes(4)]}


def test_packed_numbers() -> None:
    values = [0, 1, 127, 128, 300, -1, 2**31 - 1, -(2**31), 2**62]
    content = b"".join(varint(value) for value in values)
    found = packed_integers(content, where="a")
    assert found.dtype == np.int64
    assert found.tolist() == values
    assert packed_integers(b"", where="a").tolist() == []
    for damaged in (b"\x80", b"\x01\x80", b"\x80" * 10 + b"\x01"):
        with pytest.raises(FileFormatError, match="expected"):
            packed_integers(damaged, where="a")
