"""The HTML page: whole, escaped, self-contained, and its images are the ones given."""

import base64
import io
import re
from html.parser import HTMLParser

import numpy as np
import pytest
import torch
from PIL import Image

from splatseg.core import ClassInfo, ClassTable
from splatseg.errors import InputError
from splatseg.report.html import (
    Bars,
    Commands,
    Figure,
    Legend,
    Report,
    Table,
    data_uri,
    report_html,
)
from splatseg.report.images import Gallery, GalleryImage

VOID_ELEMENTS = {"meta", "img", "br", "wbr"}
NASTY = "<script>alert('x')</script> & \"y\""


class Reader(HTMLParser):
    """Checks that elements nest, and collects text, tags and attributes."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[str] = []
        self.attributes: list[tuple[str, str | None]] = []
        self.words: list[str] = []
        self.feed(page)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += attrs
        if tag not in VOID_ELEMENTS:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if "style" not in self.open:
            self.words.append(data)


@pytest.fixture
def photo(rng) -> GalleryImage:
    smooth = np.linspace(0, 255, 40)[None, :, None] * np.ones((30, 1, 3))
    return GalleryImage(image=torch.from_numpy(smooth.astype(np.uint8)), caption="a gradient")


@pytest.fixture
def chart(rng) -> GalleryImage:
    noise = rng.integers(0, 256, size=(20, 30, 3), dtype=np.uint8)
    return GalleryImage(image=torch.from_numpy(noise), kind="chart")


@pytest.fixture
def everything(photo, chart) -> Report:
    classes = ClassTable(rows=(ClassInfo(id=1, name="wall", colour=(10, 20, 30)),))
    return Report(
        title="A title",
        summary="A summary.",
        figures=(Figure(value="29.4 dB", label="PSNR", note="twelve views"),),
        blocks=(
            Table(title="Steps", columns=("step", "seconds"), rows=(("fit", 1.5), ("go", None))),
            Bars(title="IoU", series=("a", "b"), rows=(("wall", (0.25, None)),), note="pooled"),
            Gallery(title="Views", columns=("x", "y"), rows=(("v1", (photo, chart)),)),
            Legend(classes=classes),
            Commands(title="Shell", lines=("one --flag", "two")),
        ),
        facts={"seed": 7, "share": 0.125},
    )


def test_the_page_holds_everything_and_nests(everything):
    page = report_html(everything)
    assert page.startswith("<!doctype html>")
    reader = Reader(page)
    text = "\n".join(reader.words)
    for words in (
        "A title",
        "A summary.",
        "29.4 dB",
        "twelve views",
        "Steps",
        "1.500",
        "\N{EN DASH}",
        "0.250",
        "pooled",
        "v1",
        "a gradient",
        "wall",
        "one --flag\ntwo",
        "seed",
        "0.125",
    ):
        assert words in text, words
    assert "rgb(10,20,30)" in page
    assert "width:25.0%" in page
    assert reader.tags.count("img") == 2
    assert [v for k, v in reader.attributes if k == "alt"] == ["v1: a gradient", "v1: y"]


def test_nothing_is_fetched_and_nothing_runs(everything):
    page = report_html(everything)
    reader = Reader(page)
    assert not {"script", "link", "iframe", "object", "base"} & set(reader.tags)
    for name, value in reader.attributes:
        assert not name.startswith("on")
        if name in {"src", "href"}:
            assert value is not None
            assert value.startswith(("data:image/", "#"))
    without_pictures = re.sub(r"data:image/[^\"]*", "", page)
    for sign in ("http:", "https:", "url(", "@import", "//"):
        assert sign not in without_pictures, sign


def test_both_colour_schemes_are_there(everything):
    page = report_html(everything)
    assert "color-scheme: light dark" in page
    names = set(re.findall(r"var\((--[a-z]+)\)", page))
    light, dark = page.split("prefers-color-scheme: dark")
    for name in names:
        assert f"{name}:" in light, name
        assert f"{name}:" in dark, name


def test_all_words_are_escaped(photo):
    page = report_html(
        Report(
            title=NASTY,
            summary=NASTY,
            figures=(Figure(value=NASTY, label=NASTY, note=NASTY),),
            blocks=(
                Table(title=NASTY, columns=(NASTY,), rows=((NASTY,),), note=NASTY),
                Bars(title=NASTY, series=(NASTY,), rows=((NASTY, (1.0,)),), note=NASTY),
                Gallery(
                    title=NASTY,
                    columns=(NASTY,),
                    rows=((NASTY, (GalleryImage(image=photo.image, caption=NASTY),)),),
                    note=NASTY,
                ),
                Legend(classes=ClassTable(rows=(ClassInfo(id=1, name=NASTY),)), title=NASTY),
                Commands(title=NASTY, lines=(NASTY,), note=NASTY),
            ),
            facts={NASTY: NASTY},
        )
    )
    assert "<script" not in page
    reader = Reader(page)
    assert "".join(reader.words).count(NASTY) >= 20
    assert not any(name.startswith("alert") for name, _ in reader.attributes)


def test_a_chart_comes_back_without_loss_and_a_photo_nearly(photo, chart):
    for picture, kind, tolerance in ((chart, "png", 0), (photo, "jpeg", 4)):
        head, _, body = data_uri(picture).partition(",")
        assert head == f"data:image/{kind};base64"
        back = np.array(Image.open(io.BytesIO(base64.b64decode(body)))).astype(int)
        assert np.abs(back - picture.image.numpy()).max() <= tolerance


def test_columns_of_numbers_stand_right():
    page = report_html(
        Report(
            title="t",
            blocks=(
                Table(title="u", columns=("name", "n"), rows=(("a", 1), ("b", None), ("c", 250.4))),
            ),
        )
    )
    assert '<th scope="col">name</th><th scope="col" class="number">n</th>' in page
    assert '<td class="number">250</td>' in page
    assert "<td>a</td>" in page


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda p: GalleryImage(image=p.image.float()), "8 bit values"),
        (lambda p: GalleryImage(image=p.image[0, 0]), r"expected an image \(height, width, 3\)"),
    ],
)
def test_what_does_not_fit_is_refused(make, said, photo):
    with pytest.raises(InputError, match=said):
        make(photo)
