"""Lists of numbers on a command line: by comma or space, and one sentence for what is none."""

from dataclasses import dataclass

import pytest

from splatseg.cli._parse import parse
from splatseg.cli._words import default_config
from splatseg.errors import InputError

STREET = ("street", "CAPTURE")
SEGMENT = ("segment", "SCENE", "--method", "dnmp", "--evidence", "labels")


@pytest.mark.parametrize("command", [STREET, SEGMENT], ids=lambda words: words[0])
@pytest.mark.parametrize(
    ("words", "got"),
    [
        (("0",), "expected positive lengths in metres, got (0.0,)"),
        (("-1",), "expected positive lengths in metres, got (-1.0,)"),
        (("nan",), "expected positive lengths in metres, got (nan,)"),
        (("1e999",), "expected positive lengths in metres, got (inf,)"),
        (("0.5,0",), "expected positive lengths in metres, got (0.5, 0.0)"),
        ((), "expected positive lengths in metres, got ()"),
        (("wide",), "expected numbers, got 'wide'"),
        (("0.5", "wide"), "expected numbers, got 'wide'"),
    ],
)
def test_sides_of_voxels_that_are_none(command, words, got, splatseg) -> None:
    status, out, err = splatseg(*command, "--voxels", *words)
    assert (status, out) == (2, "")
    assert err == f"error: --voxels: {got}.\n"


@pytest.mark.parametrize(
    ("flag", "value", "got"),
    [
        ("--radius", "-1", "expected more than 0, got -1"),
        ("--radius", "nan", "expected more than 0, got nan"),
        ("--iterations", "0", "expected at least 1, got 0"),
        ("--semantic-weight", "nan", "expected at least 0, got nan"),
    ],
)
def test_other_numbers_of_nested_options(flag, value, got, splatseg) -> None:
    status, _, err = splatseg(*STREET, flag, value)
    assert (status, err) == (2, f"error: {flag}: {got}.\n")


@dataclass(frozen=True, slots=True, kw_only=True)
class Lists:
    """Two lists."""

    sides: tuple[float, ...] = (0.5, 1.0)
    """Lengths."""

    ids: tuple[int, ...] = ()
    """Ids."""


@pytest.mark.parametrize("words", [("0.25,2",), ("0.25", "2"), ("0.25,", "2")])
def test_by_comma_and_by_space(words) -> None:
    made = parse(Lists, ("--sides", *words), prog="x", config=default_config())
    assert made == Lists(sides=(0.25, 2.0))


def test_ids_are_whole() -> None:
    with pytest.raises(InputError, match=r"ids: expected whole numbers, got '2\.5'\."):
        parse(Lists, ("--ids", "1,2.5"), prog="x", config=default_config())
