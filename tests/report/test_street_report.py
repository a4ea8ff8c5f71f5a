"""The page of a mesh field of a drive, from values alone."""

import json
import re

import pytest
import torch

from splatseg.core import ClassInfo, ClassTable
from splatseg.report.html import Notice, report_html
from splatseg.report.images import Gallery, GalleryImage
from splatseg.report.street_report import (
    LevelFacts,
    PointCounts,
    StreetReportData,
    street_record,
    street_report,
)
from splatseg.street.geometry import GeometryRecord
from splatseg.street.radiance_training import RadianceRecord

CLASSES = ClassTable(
    rows=(ClassInfo(id=1, name="road", colour=(9, 9, 9)), ClassInfo(id=7, name="car & van"))
)
BARE = StreetReportData(scene="drive", name="street", layer="classes", classes=CLASSES)


def trained(steps: int) -> tuple[RadianceRecord, ...]:
    return tuple(
        RadianceRecord(
            iteration=i, iterations=steps, colour_loss=1 / i, semantic_loss=2 / i, loss=1.2 / i
        )
        for i in range(1, steps + 1)
    )


def whole(**changes) -> StreetReportData:
    shaped = tuple(
        GeometryRecord(level=level, step=step, loss=0.5 / step, hit_share=0.9, progress=0.5)
        for level in (0, 1)
        for step in (1, 2)
    )
    values = {
        "scene": "drive", "name": "street", "layer": "classes", "classes": CLASSES,
        "primitives": 1234, "metres_per_unit": 2.0,
        "levels": (
            LevelFacts(side=0.5, started=1300, kept=1200), LevelFacts(side=1, started=34, kept=34),
        ),
        "shaping": shaped, "training": trained(3), "psnr": {"a": 20.0, "b": 23.0},
        "points": PointCounts(
            folder="labels", by="the vertices of the mesh field", vertex_rule="weighed",
            scans=2, points=1000,
            unlabelled=100, ids={1: 300, 7: 600},
        ),
        "timings": {"points": 1.0, "field": 2.5}, "command": "splatseg street drive --report",
        "notices": (Notice(verdict="Moving things", sentence="Left out."),),
        "facts": {"evidence": "labels_semantic"},
    }  # fmt: skip
    return StreetReportData(**(values | changes))


def cells(page: str, title: str) -> list[list[str]]:
    section = page[page.index(f"<h2>{title}</h2>") :].partition("</table>")[0]
    rows = re.findall(r"<tr>(.*?)</tr>", section)[1:]
    return [re.findall(r"<td.*?>(.*?)</td>", row) for row in rows]


def test_all_that_is_known_is_told() -> None:
    page = report_html(street_report(whole()))
    assert "Field street: 1\N{THIN SPACE}234 primitives with 2 classes." in page
    assert "points of 2 scans labelled by the vertices of the mesh field" in page
    assert cells(page, "Primitives") == [["0", "0.5", "1300", "1200"], ["1", "1", "34", "34"]]
    assert cells(page, "Points by class") == [
        ["car &amp; van", "7", "600", "0.600"],
        ["road", "1", "300", "0.300"],
        ["without a label", "\N{EN DASH}", "100", "0.100"],
    ]
    assert cells(page, "Time") == [["points", "1.000"], ["field", "2.500"], ["together", "3.500"]]
    for words in (
        "0.50 m", "1.00 m in its first steps", "21.5 dB", "90.0%", "Moving things",
        "labels_semantic",
        "splatseg street drive", "Error of depth, m", "Squared error of colours",
        "Cross-entropy of classes", "level 1",
    ):  # fmt: skip
        assert words in page, words


def test_losses_of_shapes_are_metres() -> None:
    blocks = street_report(whole()).blocks
    charts = next(block for block in blocks if block.title == "How it went").charts
    assert charts[0].lines[0].points == ((1.0, 1.0), (2.0, 0.5))


def test_what_is_not_known_is_left_out() -> None:
    page = street_report(BARE)
    assert page.blocks == ()
    assert [figure.label for figure in page.figures] == ["primitives"]
    assert "<h1>Street drive</h1>" in report_html(page)
    labels_alone = street_report(whole(name="", levels=(), shaping=(), training=()))
    assert "Field" not in labels_alone.summary
    assert "primitives" not in [figure.label for figure in labels_alone.figures]
    blocks = street_report(whole(name="street", blocks=3)).summary
    assert "in 3 blocks" in blocks


def test_pictures_come_first_and_have_one_legend() -> None:
    picture = GalleryImage(image=torch.zeros(4, 5, 3, dtype=torch.uint8))
    views = Gallery(title="Training views", columns=("a",), rows=(("v", (picture,)),))
    above = Gallery(title="Labelled points from above", columns=("",), rows=(("", (picture,)),))
    for shown in ({"views": views, "above": above}, {"views": views}, {"above": above}):
        page = report_html(street_report(whole(), **shown))
        titles = re.findall(r"<h2>(.*?)</h2>", page)
        assert titles[: len(shown)] == [gallery.title for gallery in shown.values()]
        assert page.count("car &amp; van</span>") == 1


def test_a_long_training_is_a_curve_of_means() -> None:
    record = street_record(whole(training=trained(1001)))
    rows = record["training"]
    assert len(rows) == 167
    assert rows[0]["iteration"] == 6
    assert rows[0]["colour_loss"] == pytest.approx(sum(1 / i for i in range(1, 7)) / 6)
    assert rows[-1]["iteration"] == 1001
    assert street_record(BARE)["training"] == []


def test_the_record_is_json() -> None:
    record = json.loads(json.dumps(street_record(whole()), allow_nan=False))
    assert record["depth_error"] == {"first": 1.0, "last": 0.5}
    assert record["points"]["ids"] == {"1": 300, "7": 600}
    assert record["levels"][0] == {"side": 0.5, "started": 1300, "kept": 1200}
    assert record["classes"] == {"1": "road", "7": "car & van"}
    assert street_record(BARE)["depth_error"] is None
    assert "points" not in street_record(BARE)
