"""Lists of objects in JSON: the same rows whatever piece is in memory, and what is refused."""

import json

import pytest

from splatseg.errors import FileFormatError, MissingFileError
from splatseg.io.json_files import read_json_rows


def test_rows_of_json_come_one_by_one(tmp_path, monkeypatch) -> None:
    """Whatever piece of the file is in memory."""
    file = tmp_path / "a.json"
    rows = [{"text": 'a "]}, [{" \\ é', "n": [1, {"a": None}]}, {}, {"x": "😀" * 9}]
    for chunk in (1, 2, 3, 7, 1 << 20):
        monkeypatch.setattr("splatseg.io.json_files._CHUNK", chunk)
        for indent in (None, 2):
            for ascii_only in (True, False):
                text = json.dumps(rows, indent=indent, ensure_ascii=ascii_only)
                file.write_text(f" {text}\n", encoding="utf-8")
                assert list(read_json_rows(file)) == rows
        file.write_text(" [ ] ")
        assert list(read_json_rows(file)) == []


@pytest.mark.parametrize(
    "text",
    ["", "{}", "[", "[{}", "[{},", "[{},]", "[{}] 1", "[{} {}]", '[{"a": "\\ud800"}]', "[{]"],
)
def test_rows_of_broken_json(tmp_path, text) -> None:
    file = tmp_path / "a.json"
    file.write_text(text)
    with pytest.raises(FileFormatError, match=r"a\.json: expected"):
        list(read_json_rows(file))


def test_a_row_without_an_end(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("splatseg.io.json_files._MAX_ROW", 100)
    monkeypatch.setattr("splatseg.io.json_files._CHUNK", 64)
    file = tmp_path / "a.json"
    file.write_text('[{"a": "' + "x" * 1000)
    with pytest.raises(FileFormatError, match="a row cannot be parsed"):
        list(read_json_rows(file))
    file.write_bytes(b'[{"a": "\xff"}]')
    with pytest.raises(FileFormatError, match="expected a JSON file"):
        list(read_json_rows(file))


def test_no_file(tmp_path) -> None:
    with pytest.raises(MissingFileError, match="there is no such file"):
        list(read_json_rows(tmp_path / "nowhere.json"))
