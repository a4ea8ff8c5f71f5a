"""Whatever a library raises on a damaged file is one documented error; nothing else is."""

from pathlib import Path

import pytest

from splatseg.errors import FileFormatError, MissingFileError, RangeError
from splatseg.io.foreign import reading

# As decoders in Rust raise it: no module names the class.
PANIC = type("PanicException", (BaseException,), {})


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (PANIC("index out\nof range."), r"but it cannot be read \(index out of range\)\.$"),
        (KeyError("a"), r"but it cannot be read \('a'\)\.$"),
        (MemoryError(), "memory is too small for it"),
    ],
)
def test_damage(error, words) -> None:
    match = f"^a.laz: expected points.* {words}"
    with pytest.raises(FileFormatError, match=match), reading(Path("a.laz"), "points"):
        raise error


@pytest.mark.parametrize("error", [KeyboardInterrupt(), SystemExit(2), RangeError("x"), Warning()])
def test_what_is_no_damage_stays_what_it_is(error) -> None:
    with pytest.raises(type(error)) as caught, reading("a", "points"):
        raise error
    assert caught.value is error


def test_no_file() -> None:
    with pytest.raises(MissingFileError, match="a: there is no such file"), reading("a", "points"):
        Path("no such file").read_bytes()
