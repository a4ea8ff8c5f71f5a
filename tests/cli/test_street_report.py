"""``splatseg street --report``: pages of fields, of blocks, and of labelled points."""

import json
import shutil
from pathlib import Path

import pytest

FAST = ("--voxels", "2,4", "--geometry-iterations", "1", "--iterations", "3", "--rays", "64")


@pytest.fixture(scope="module")
def reported(generated_drive, tmp_path_factory) -> Path:
    """A scene with a field and its page; not to be changed."""
    from splatseg.cli import main

    root = tmp_path_factory.mktemp("street") / "scene"
    words = ("street", generated_drive, "--new-scene", root, "--scans", generated_drive, *FAST)
    assert main([str(word) for word in (*words, "--report", "--quiet")]) == 0
    return root


def test_the_page_is_in_the_scene(reported) -> None:
    page = (reported / "reports/street.html").read_text()
    assert "Error of depth" in page
    assert "Labelled points" not in page
    record = json.loads((reported / "reports/street.json").read_text())
    assert record["field"] == "street"
    assert record["primitives"] == sum(row["kept"] for row in record["levels"])


def test_labels_of_scans_are_on_the_page_of_the_field_that_gave_them(
    reported, generated_drive, splatseg, tmp_path
) -> None:
    scene = shutil.copytree(reported, tmp_path / "scene")
    words = ("street", scene, "--label-scans", generated_drive, "-o", tmp_path / "labels")
    status, out, _ = splatseg(*words, "--by", "mesh", "--report", "--json", "--quiet")
    assert status == 0
    facts = json.loads(out)
    assert facts["report"] == str(scene / "reports/street.html")
    page = (scene / "reports/street.html").read_text()
    assert "Labelled points from above" in page
    assert "Error of depth" not in page, "the field was there"
    record = json.loads((scene / "reports/street.json").read_text())
    assert record["points"]["ids"] == facts["labels"]["ids"]
    assert record["points"]["unlabelled"] == facts["labels"]["unlabelled"]
    assert record["points"]["vertex_rule"] is None
    whole, seen, unseen = record["points"]["scores"]
    assert [row["points"] for row in (whole, seen, unseen)] == ["all", "seen", "unseen"]
    assert whole["count"] == seen["count"] + unseen["count"] == facts["labels"]["points"]
    assert seen["count"] > 0 < unseen["count"]
    assert whole["undefined"] == facts["labels"]["unlabelled"] / facts["labels"]["points"]
    assert "Points against their truth" in page


def test_a_drive_in_blocks_has_a_page_of_its_name(reported, generated_drive, splatseg) -> None:
    words = ("street", reported, "--scans", generated_drive, "--field", "blocks", *FAST)
    status, out, _ = splatseg(*words, "--block-length", "30", "--report", "--json", "--quiet")
    assert status == 0
    record = json.loads(Path(json.loads(out)["report"]).with_suffix(".json").read_text())
    assert record["field"] == "blocks"
    assert record["blocks"] == json.loads(out)["blocks"] >= 1
    assert record["levels"] == []
    assert record["psnr"]


def test_no_page_unless_it_is_asked_for(reported, generated_drive, splatseg, tmp_path) -> None:
    scene = shutil.copytree(reported, tmp_path / "scene")
    shutil.rmtree(scene / "reports")
    words = ("street", scene, "--label-scans", generated_drive, "-o", tmp_path / "labels")
    status, out, _ = splatseg(*words, "--by", "mesh", "--json", "--quiet")
    assert status == 0
    assert "report" not in json.loads(out)
    assert not list(scene.glob("reports/*"))
