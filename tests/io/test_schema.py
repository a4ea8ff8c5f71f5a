"""Values of files held to declared types: places, words and numbers of messages."""

import math
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
import pytest
from msgspec import Meta

from splatseg.core.options import MAY_BE_INFINITE, NonNegative
from splatseg.errors import FileFormatError
from splatseg.io.schema import check_array, read_structured, structured


@dataclass(frozen=True, slots=True)
class Part:
    share: Annotated[float, Meta(ge=0, le=1)] = 0.5
    votes: dict[str, int] | None = None


@dataclass(frozen=True, slots=True)
class Form:
    name: Annotated[str, Meta(min_length=1)]
    side: Annotated[int, Meta(ge=1)] | None = None
    far: Annotated[float, Meta(gt=0, extra=MAY_BE_INFINITE)] = 1.0
    row: tuple[float, float] = (0.0, 0.0)
    parts: list[Part] | None = None
    either: list[float] | str = ""
    rest: Any = None


def read(**values: object) -> Form:
    return structured({"name": "a", **values}, Form, where="f.json")


def test_what_fits() -> None:
    found = read(side=3.0, far=math.inf, row=[1, 2], parts=[{"votes": {"a": 2.0}}], more=[1])
    assert found == Form("a", 3, math.inf, (1.0, 2.0), [Part(votes={"a": 2})])
    assert read(rest=float("nan")).rest is not None
    assert structured({"name": "a", "side": "3"}, Form, where="x", strict=False).side == 3


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"side": 0}, "f.json: side: expected a whole number of at least 1, got 0."),
        ({"side": 2.5}, "f.json: side: expected a whole number or null, got 2.5."),
        ({"side": True}, "f.json: side: expected a whole number or null, got True."),
        ({"far": 0}, "f.json: far: expected a number above 0, got 0."),
        ({"name": ""}, "f.json: name: expected text of length at least 1, got ''."),
        ({"name": None}, "f.json: name: expected text, got None."),
        ({"row": [1]}, "f.json: row: expected a list of length 2, got a list of 1."),
        ({"row": [1, math.nan]}, "f.json: row[1]: expected a finite number up to 1e+30, got nan."),
        ({"row": [1, 1e31]}, "f.json: row[1]: expected a finite number up to 1e+30, got 1e+31."),
        ({"either": [math.inf]}, "f.json: either[0]: expected a finite number up to 1e+30, got"),
        ({"either": 3}, "f.json: either: expected text or a list, got 3."),
        ({"parts": [{}, {"share": -1}]}, "f.json: parts[1].share: expected a number of at least 0"),
        ({"parts": [{}, {"share": math.nan}]}, "f.json: parts[1].share: expected a number of at"),
        ({"parts": [3]}, "f.json: parts[0]: expected an object, got 3."),
        ({"parts": 10**400}, "f.json: parts: expected a list or null, got a number of"),
    ],
)
def test_what_does_not(values, words) -> None:
    with pytest.raises(FileFormatError) as caught:
        read(**values)
    assert str(caught.value).startswith(words)


@pytest.mark.parametrize("count", [1, 2, 7, 1000])
@pytest.mark.parametrize("wrong", [0, 0.4, 0.999])
def test_the_key_of_a_mapping_is_named(count, wrong) -> None:
    votes: dict[str, object] = {f"k{i}": i for i in range(count)}
    key = f"k{int(wrong * count)}"
    votes[key] = "x"
    with pytest.raises(FileFormatError, match=rf"parts.0..votes.{key}: expected a whole number"):
        read(parts=[{"votes": votes}])


def test_fields_that_lack() -> None:
    with pytest.raises(FileFormatError, match=r"f: expected a field name, got none\."):
        structured({}, Form, where="f")
    with pytest.raises(FileFormatError, match=r"f: expected an object, got a list of 1\."):
        structured([1], Form, where="f")
    with pytest.raises(FileFormatError, match=r"f\[0\]: expected an object, got 1\."):
        structured([1], list[Form], where="f")
    with pytest.raises(FileFormatError, match="f: expected a number of at least 0, got -1"):
        structured(-1, NonNegative, where="f")  # pyright: ignore[reportArgumentType]


def test_depth_is_no_crash(tmp_path) -> None:
    path = tmp_path / "a.json"
    path.write_text('{"name": "a", "side": 1.5, "rest": ' + "[" * 900 + "1" + "]" * 900 + "}")
    with pytest.raises(FileFormatError, match=r"a\.json: "):
        read_structured(path, Form)


@pytest.mark.parametrize(
    ("shape", "kinds", "words"),
    [
        ((3, 3), "iuf", "a of shape (3, 3) in numbers, got float64 of (3, 2)"),
        (("n",), "iuf", "a of shape (n,) in numbers, got float64 of (3, 2)"),
        (("n", 2), "iu", "a of shape (n, 2) in whole numbers, got float64 of (3, 2)"),
    ],
)
def test_arrays(shape, kinds, words) -> None:
    array = np.zeros((3, 2))
    assert check_array("f", "a", array, ("n", 2)) is array
    with pytest.raises(FileFormatError) as caught:
        check_array("f", "a", array, shape, kinds)
    assert str(caught.value) == f"f: expected {words}."
