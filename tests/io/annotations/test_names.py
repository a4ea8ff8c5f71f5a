"""Which view a picture is: by name, by stem, by what shares most folders."""

import pytest

from splatseg.errors import InputError
from splatseg.io.annotations._base import matched, parts_of, view_name
from support.annotations import views_of

VIEWS = views_of("left/000", "right/000", "left/001", "night.v2")


@pytest.mark.parametrize(
    ("name", "view"),
    [
        ("left/000.png", "left/000"),
        ("export/images/right/000.png", "right/000"),
        ("right/000.jpg", "right/000"),
        ("001.png", "left/001"),
        ("001.jpg", "left/001"),
        ("001", "left/001"),
        (r"C:\labels\left\001.bmp", "left/001"),
        ("../../001.png", "left/001"),
        ("/data/upload/3/5e2f0a1b-001.jpg", "left/001"),
        ("/data/local-files/?d=left%2F001.jpg", "left/001"),
        ("s3://bucket/left/001.jpg?signature=1", "left/001"),
        ("night.v2.jpg", "night.v2"),
        ("night.v2", "night.v2"),
        ("002.png", None),
        ("0001.png", None),
        ("5e2f0a1-001.jpg", None),
        ("", None),
        ("..", None),
    ],
)
def test_names(name: str, view: str | None) -> None:
    assert matched(["other.png", name], VIEWS, where="file") == ({} if view is None else {view: 1})


def test_a_photograph_s_own_name_comes_before_its_stem() -> None:
    views = (*views_of("a", suffix=".jpg"), *views_of("b/a", suffix=".png"))
    assert matched(["a.png"], views, where="file") == {"b/a": 0}
    assert matched(["a.jpg"], views, where="file") == {"a": 0}


def test_what_is_not_told_is_refused() -> None:
    with pytest.raises(InputError, match="file: .* '000.png', which may be 'left/000' or 'right/0"):
        matched(["000.png"], VIEWS, where="file")
    with pytest.raises(InputError, match="file: .* '001.png' and '001.jpg' of view 'left/001'"):
        matched(["001.png", "001.jpg"], VIEWS, where="file")


def test_names_without_views() -> None:
    assert view_name(r"..\images\a.b.jpg") == "images/a.b"
    assert view_name(".hidden") == ".hidden"
    assert parts_of("a%2Fb/c.png") == ("a", "b", "c.png")
