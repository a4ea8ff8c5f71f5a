"""Class tables as JSON rows."""

import pytest

from splatseg.errors import FileFormatError
from splatseg.io.tables import class_rows, class_table


def test_rows_come_back_and_void_is_no_class() -> None:
    rows = [
        {"id": 1, "name": "cup", "isthing": True, "colour": [1, 2, 255]},
        {"id": 7, "name": "floor", "isthing": False},
    ]
    assert class_rows(class_table([{"id": 0, "name": "void"}, *rows], where="f")) == rows


@pytest.mark.parametrize(
    "row",
    [
        {"id": 1, "name": "\0"},
        {"id": 1, "name": "\ud800"},
        {"id": True, "name": "a"},
        {"id": 2**31, "name": "a"},
        {"id": 1, "name": "a", "colour": [1, 2, True]},
        {"id": 1, "name": "a", "colour": [1, 2, 256]},
        {"id": 1, "name": "a", "colour": [1, 2]},
        "cup",
    ],
)
def test_other_rows_are_refused_by_the_files_name(row) -> None:
    with pytest.raises(FileFormatError, match=r"f\.json: classes\[1\].*: expected"):
        class_table([{"id": 3, "name": "b"}, row], where="f.json")
