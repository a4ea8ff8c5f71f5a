"""The models of docs/own-models.md as packages: installed by pip, found by see, run on a scene."""

from pathlib import Path

import pytest
import torch

from splatseg.io.evidence import evidence_header, open_evidence
from splatseg.io.images import load_image
from splatseg.io.scene import load_scene
from support.packages import blocks, install, run

PAGE = Path(__file__).parents[2] / "docs" / "own-models.md"


def code_of(word: str) -> str:
    """The block of Python that defines this."""
    (found,) = (block for block in blocks(PAGE, "python") if f"\nclass {word}" in block)
    return found


def project_of(name: str) -> str:
    """The page's pyproject.toml, for a model of this name."""
    (text,) = blocks(PAGE, "toml")
    module = name.replace("-", "_")
    return text if name == "bright-side" else (
        text.replace("bright-side", name).replace("bright_side:BrightSide", f"{module}:BRIGHTER")
        .replace("bright_side", module)
    )  # fmt: skip


def lines_of(code: str) -> int:
    """Lines of code; imports and blank ones aside."""
    lines = [line for line in code.splitlines() if line.strip()]
    return sum(not line.startswith(("from ", "import ")) for line in lines)


def test_a_model_of_ten_lines_is_installed_and_sees(small, tmp_path, splatseg, monkeypatch) -> None:
    code = code_of("BrightSide")
    assert lines_of(code) <= 10
    site = install(tmp_path, module="bright_side", code=code, project=project_of("bright-side"))
    done = run(site, "see", small.scene, "--model", "bright-side", "--evidence", "bright")
    assert done.returncode == 0, done.stderr
    evidence = open_evidence(small.scene / "evidence" / "bright")
    views = {view.name: view for view in load_scene(small.scene).views}
    assert evidence.view_names
    for name in evidence.view_names:
        wanted = load_image(views[name]).float().mean(-1) > 128
        masks = evidence.masks(name)
        found = masks.dense(0) if len(masks) else torch.zeros_like(wanted)
        assert torch.equal(found, wanted), name
    monkeypatch.syspath_prepend(str(site))  # the rest in this process, which is quicker
    _, shown, _ = splatseg("see", "--help")
    assert "bright-side: of another package" in " ".join(shown.split())
    words = ("see", small.scene, "--model", "bright-side", "--evidence", "x")
    status, _, error = splatseg(*words, "--weights", "w")
    assert status == 2
    assert "--weights" in error


@pytest.fixture
def weights(tmp_path) -> Path:
    """A folder with the weights of the classifier of colours."""
    folder = tmp_path / "weights"
    folder.mkdir()
    torch.save({"weight": torch.tensor([9.0, -3.0, -3.0])}, folder / "brighter.pt")
    return folder


def test_a_family_with_options_and_weights_is_installed_and_sees(
    small, tmp_path, weights, splatseg, monkeypatch
) -> None:
    code = code_of("Brighter")
    assert lines_of(code) <= 16
    site = install(tmp_path, module="brighter", code=code, project=project_of("brighter"))
    words = ("see", small.scene, "--model", "brighter")
    asked = ("--weights", weights, "--evidence")
    done = run(site, *words, *asked, "e0.9", "--threshold", "0.9")
    assert done.returncode == 0, done.stderr
    monkeypatch.syspath_prepend(str(site))
    status, _, error = splatseg(*words, *asked, "e0.5")
    assert status == 0, error
    views = {view.name: view for view in load_scene(small.scene).views}
    areas = {0.5: 0, 0.9: 0}
    for threshold in areas:
        folder = small.scene / "evidence" / f"e{threshold}"
        settings = evidence_header(folder)["metadata"]["settings"]
        assert settings["threshold"] == threshold
        assert len(settings["weights"]) == 64
        evidence = open_evidence(folder)
        for name in evidence.view_names:
            score = load_image(views[name]) / 255 @ torch.tensor([9.0, -3.0, -3.0])
            wanted = score.sigmoid() > threshold
            masks = evidence.masks(name)
            found = masks.dense(0) if len(masks) else torch.zeros_like(wanted)
            assert torch.equal(found, wanted), name
            areas[threshold] += int(wanted.sum())
    assert areas[0.5] > areas[0.9] > 0
    shown = " ".join(splatseg(*words, "--help")[1].replace("│", " ").split())
    assert "--threshold" in shown
    assert "How sure it must be of a pixel" in shown
    assert "Published weights, of which --weights takes a copy" in shown
    assert "brighter.pt (1 MB, MIT)" in shown
    status, _, error = splatseg(*words, "--evidence", "x")
    assert status == 2
    assert "model brighter needs brighter.pt (1 MB, licence MIT)" in error
    assert "--weights FILE_OR_FOLDER takes a copy" in error
    assert not (small.scene / "evidence" / "x").exists()
