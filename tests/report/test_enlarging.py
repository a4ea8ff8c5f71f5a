"""Pictures are enlarged without scripts, by pointer and by keys; names break at joints alone."""

import re

import torch

from splatseg.report.html import Notice, Report, Table, report_html
from splatseg.report.images import Gallery, GalleryImage
from splatseg.report.words import counted, name_text


def page_of(count: int) -> str:
    image = GalleryImage(image=torch.zeros(6, 8, 3, dtype=torch.uint8), caption="<x>")
    rows = tuple((f"v{i}", (image,)) for i in range(count))
    return report_html(
        Report(title="t", blocks=(Gallery(title="Views", columns=("photo",), rows=rows),))
    )


def test_each_picture_is_in_the_page_once_and_has_a_button() -> None:
    page = page_of(3)
    assert page.count("data:image") == 3
    shown = re.findall(r'popover id="(p\d+)"', page)
    assert len(set(shown)) == 3
    opened = re.findall(r'class="open" popovertarget="(p\d+)"', page)
    closed = re.findall(r'popovertarget="(p\d+)" popovertargetaction="hide"', page)
    assert opened == closed == shown
    assert page.count('aria-label="Enlarge v1: &lt;x&gt;"') == 1
    assert "<script" not in page


def test_long_names_break_after_their_joints() -> None:
    name = "second-floor_kitchen.left_0012"
    broken = name_text(name)
    assert broken.replace("<wbr>", "") == name
    assert broken.split("<wbr>") == ["second-", "floor_", "kitchen.", "left_", "0012"]
    assert name_text("train_0001") == "train_0001"
    assert "anywhere" not in page_of(1), "nothing breaks inside a word"


def test_what_scrolls_is_reached_by_keys_and_sections_by_links() -> None:
    rows = tuple((f"v{i}", i) for i in range(60))
    table = Table(title="Scores & so on", columns=("view", "n"), rows=rows)
    page = report_html(
        Report(
            title="t",
            blocks=(table, table, table),
            notices=(Notice(verdict="Too <short>", sentence="7 & more", warns=True),),
        )
    )
    assert page.count('class="wide tall" tabindex="0" role="region"') == 3
    for i in range(3):
        assert f'href="#s{i}">Scores &amp; so on</a>' in page
        assert f'id="s{i}"' in page
    assert '<p class="notice warn" role="note"><b>Too &lt;short&gt;.</b> 7 &amp; more' in page


def test_plurals() -> None:
    assert [counted(n, "view") for n in (0, 1, 2, 1200)] == [
        "0 views",
        "1 view",
        "2 views",
        "1\N{THIN SPACE}200 views",
    ]
