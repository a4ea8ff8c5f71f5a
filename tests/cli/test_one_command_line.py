"""The commands agree: a flag means, takes and says the same in each; --json, --quiet, lists."""

import ast
import importlib
import json
import re
import shlex
from pathlib import Path
from typing import Any

import pytest

from splatseg import cli
from splatseg.cli import COMMANDS
from splatseg.cli._words import FOLDER
from splatseg.io.scene import load_scene_layer

CLI = Path(cli.__file__).parent
MAKE = {
    "attach", "chunks", "demo", "edit", "evaluate", "export", "fit", "import", "query", "render",
    "see", "segment", "select", "sharpen", "street", "view",
}  # fmt: skip
TELL = {"doctor", "info"}
OWN_HELP = {"data CAPTURE": ["chunks"], "frames": ["fit"], "seed": ["demo"]}


def help_of(page: str, flag: str) -> str | None:
    """What a page says of a flag, its type and default included."""
    lines = page.splitlines()
    for start, line in enumerate(lines):
        if re.match(rf" +(-\w \w+, )?--{flag}( |$)", line):
            end = start + 1
            while end < len(lines) and re.match(r" {6,}[^ -]", lines[end]):
                end += 1
            return " ".join(" ".join(lines[start:end]).split())
    return None


@pytest.mark.parametrize("name", COMMANDS)
def test_what_makes_something_prints_json_and_can_be_quiet(name) -> None:
    page = (FOLDER / f"{name}.txt").read_text(encoding="utf-8")
    assert (help_of(page, "json") is not None) == (name in MAKE | TELL)
    assert (help_of(page, "quiet") is not None) == (name in MAKE)


@pytest.mark.parametrize(
    "flag",
    ["backend", "cut", "data CAPTURE", "format", "frames", "json", "overwrite", "quiet", "seed"],
)
def test_shared_flags_say_the_same_on_every_page(flag) -> None:
    found = {
        path.stem: text
        for path in FOLDER.glob("*.txt")
        if (text := help_of(path.read_text(encoding="utf-8"), flag)) is not None
    }
    for command in OWN_HELP.get(flag, ()):
        del found[command]
    assert found
    assert len(set(found.values())) == 1, found


@pytest.mark.parametrize("name", COMMANDS)
def test_each_command_shows_three_examples_that_parse(name, monkeypatch) -> None:
    page = (FOLDER / f"{name}.txt").read_text(encoding="utf-8")
    examples = [line for line in page.splitlines() if line.startswith("splatseg ")]
    assert "For example:" in page
    assert len(examples) >= 3
    entry = COMMANDS[name]
    module: Any = importlib.import_module(entry.module)
    ran = []
    monkeypatch.setattr(module, f"run_{entry.part}" if entry.part else "run", ran.append)
    for line in examples:
        words = shlex.split(line.partition(" > ")[0])[1:]
        assert words[0] == name
        assert cli.main(words) == 0, line
    assert len(ran) == len(examples)


def test_no_command_runs_a_command() -> None:
    """Neither another's `run` nor the program itself: what they share are tasks."""
    modules = {entry.module.rsplit(".", 1)[1] for entry in COMMANDS.values()}
    for path in CLI.glob("*.py"):
        if path.stem in ("__init__", "__main__"):
            continue
        tree = ast.parse(path.read_text(encoding="utf-8"))
        assert run_calls(tree, modules - {path.stem}) == [], path.name


def run_calls(tree: ast.AST, modules: set[str]) -> list[str]:
    """Imports of other commands, calls of their `run`, of `main`, and of processes."""
    found: list[str] = []
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            names = {alias.name for alias in node.names}
            last = (node.module or "").rsplit(".", 1)[-1]
            if node.module == "splatseg.cli":
                found += sorted(names & (modules | {"main"}))
            elif node.module == f"splatseg.cli.{last}" and last in modules:
                found.append(last)
        elif isinstance(node, ast.Import):
            found += [a.name for a in node.names if a.name in ("subprocess", "runpy")]
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            target = node.func.value
            if node.func.attr == "run" and isinstance(target, ast.Name) and target.id in modules:
                found.append(f"{target.id}.run")
    return found


@pytest.mark.parametrize(
    ("line", "found"),
    [
        ("from splatseg.cli import fit, see", ["fit", "see"]),
        ("from splatseg.cli.fit import run", ["fit"]),
        ("from splatseg.cli import main", ["main"]),
        ("import subprocess", ["subprocess"]),
        ("fit.run(x)", ["fit.run"]),
        ("from splatseg.cli._shared import Json", []),
        ("job.run()", []),
    ],
)
def test_a_command_that_runs_one_is_found(line, found) -> None:
    assert run_calls(ast.parse(line), {"fit", "see"}) == found


def one_object(result: tuple[int, str, str]) -> dict[str, Any]:
    """What was printed: one JSON object on one line, and nothing else."""
    status, out, err = result
    assert status == 0, err
    assert out.endswith("}\n")
    assert out.count("\n") == 1
    return json.loads(out)


def test_json_of_the_main_job(small, splatseg, tmp_path) -> None:
    """Each command on what the one before it left; figures are those of the files."""
    scene, cpu = small.scene, ("--backend", "cpu")
    seen = one_object(
        splatseg("see", scene, "--model", "classical", "--evidence", "masks", "--json")
    )
    assert (seen["views"], seen["kind"], seen["model"]) == (3, "masks", "classical")
    assert Path(seen["evidence"]) == scene / "evidence" / "masks"
    segment = ("segment", scene, "--method", "uplift", "--evidence", "labels_semantic", *cpu)
    made = one_object(splatseg(*segment, "--layer", "classes", "--export", "--report", "--json"))
    layer = load_scene_layer(scene, "classes")
    assert (made["layer"], made["gaussians"]) == ("classes", len(layer))
    assert made["labelled"] == int((layer.ids >= 0).sum())
    assert Path(made["file"]).is_file()
    assert Path(made["report"]).is_file()
    assert all(Path(path).exists() for path in made["exports"])
    drawn = one_object(splatseg("render", scene, "-o", tmp_path / "drawn", *cpu, "--json"))
    assert (drawn["views"], drawn["entries"]) == (1, ["rgb"])
    out = tmp_path / "out.ply"
    exported = one_object(
        splatseg("export", scene, "-o", out, "--layer", "classes", *cpu, "--json")
    )
    assert Path(exported["output"]) == out
    assert Path(exported["table"]).is_file()
    figures = one_object(splatseg("evaluate", scene, *cpu, "--json"))
    assert figures["PSNR"] > 30
    quick = ("--sharpen-steps", 4)
    sharp = one_object(
        splatseg("sharpen", scene, "-o", tmp_path / "s", "--layer", "classes", *quick, "--json")
    )
    assert sharp["gaussians"] == len(layer)
    assert 0 < sharp["agreement_before"] <= 1
    assert sharp["psnr_after"] > 20
    edit = ("edit", scene, "-o", tmp_path / "e", "--remove", "--layer", "classes", "--ids", "2")
    edited = one_object(splatseg(*edit, "--cut", "off", "--json"))
    assert edited["operations"][0]["kind"] == "remove"
    assert edited["gaussians"] == len(layer) - edited["operations"][0]["selected"]
    imported = one_object(
        splatseg(
            "import", out, "-o", tmp_path / "i", "--max-views", 2, "--width", 32, *cpu, "--json"
        )
    )
    assert imported["train_views"] + imported["test_views"] == 2
    attached = one_object(splatseg("attach", scene, tmp_path / "i", "--json"))
    assert (attached["names"], attached["found"]) == (["classes"], len(layer))
    assert one_object(splatseg("info", scene, "--json"))["kind"] == "scene"


def test_json_of_a_fit(generated_room, splatseg, tmp_path) -> None:
    words = ("--steps", 6, "--max-gaussians", 300, "--backend", "cpu")
    made = one_object(splatseg("fit", generated_room, "-o", tmp_path / "f", *words, "--json"))
    assert (made["steps"], made["interrupted"]) == (6, False)
    assert made["psnr"] > 0
    assert Path(made["report"]).is_file()
    assert Path(made["scene"]) == tmp_path / "f"


def test_quiet_shows_results_alone(small, splatseg) -> None:
    (small.capture / "labels_semantic" / "train_1.png").unlink()
    command = ("segment", small.scene, "--method", "uplift", "--backend", "cpu")
    status, out, err = splatseg(*command)
    assert (status, "note: 1 of 3 views" in err) == (0, True)
    status, out, err = splatseg(*command, "--quiet")
    assert (status, err) == (0, "")
    assert "Gaussians labelled" in out
    see = ("see", small.scene, "--model", "classical", "--evidence", "masks")
    assert "stand-in" in splatseg(*see)[2]
    assert splatseg(*see, "--quiet")[2] == ""


@pytest.mark.parametrize(
    "words", [("train_0,train_3",), ("train_0", "train_3"), ("train_0,", "train_3")]
)
def test_names_by_comma_and_by_space(small, splatseg, words) -> None:
    command = ("--method", "uplift", "--backend", "cpu", "--views", *words)
    assert splatseg("segment", small.scene, *command)[0] == 0
    layer = load_scene_layer(small.scene, "labels_semantic")
    assert layer.info.views_asked == "train_0,train_3"
    assert sorted(layer.info.views) == ["train_0", "train_3"]
    see = ("see", small.scene, "--model", "classical", "--evidence", "masks", "--views", *words)
    assert splatseg(*see, "--json")[0] == 0


def test_ids_that_are_no_numbers_are_a_usage_error(small, splatseg, tmp_path) -> None:
    edit = ("edit", small.scene, "-o", tmp_path / "new", "--remove", "--layer", "x")
    status, _, err = splatseg(*edit, "--ids", "2,chair")
    assert status == 2
    assert "--ids" in err


def test_no_views_at_all_is_refused(small, splatseg) -> None:
    status, _, err = splatseg("segment", small.scene, "--method", "uplift", "--views", ",")
    assert status == 2
    assert "--views: expected train, all or names" in err
