"""Methods by name: help, refusals, and the ten lines of docs/methods.md, outside and inside."""

import shutil
import subprocess
import sys
import types
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest
import torch

import splatseg as package
from splatseg.core import Labels, LayerInfo, with_info
from splatseg.errors import InputError, MissingPackageError
from splatseg.io.evidence import open_evidence
from splatseg.io.scene import load_scene, load_scene_layer
from splatseg.methods import (
    ENTRY_POINT_GROUP,
    Method,
    _method,
    find_method,
    keeps_boundaries,
    keeps_ids,
    method_names,
    methods,
)
from support.packages import blocks, install, run

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "methods.md"


def block(language: str, index: int) -> str:
    return blocks(PAGE, language)[index]


MAJORITY = block("python", 1)


@pytest.fixture
def installed(monkeypatch):
    """Entry points as if another package had been installed with them."""

    def install(**values: str) -> None:
        entries = [EntryPoint(name=n, value=v, group=ENTRY_POINT_GROUP) for n, v in values.items()]
        monkeypatch.setattr(_method, "entry_points", lambda group: entries)

    return install


def test_a_method_of_another_package_is_installed_and_runs(small, tmp_path) -> None:
    site = install(tmp_path, module="majority", code=MAJORITY, project=block("toml", 0))
    words = ["segment", small.scene, "--method", "majority", "--min-share", "0.6"]
    done = run(site, *words, "--evidence", "labels_semantic")
    assert done.returncode == 0, done.stderr
    listed = run(site, "segment", "--help")
    assert listed.returncode == 0
    assert "majority: the id with most votes" in " ".join(listed.stdout.split())
    layer = load_scene_layer(small.scene, "labels_semantic")
    assert layer.info.method == "uplift"
    assert layer.info.options["min_share"] == 0.6


def test_the_same_file_is_a_method_of_ours(small, splatseg, monkeypatch) -> None:
    module = types.ModuleType("splatseg.methods.majority")
    exec(compile(MAJORITY, "majority.py", "exec"), module.__dict__)
    monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.setattr(_method, "_OWN", {**_method._OWN, "majority": "majority:METHOD"})
    status, _, error = splatseg(
        *("segment", small.scene, "--method", "majority", "--min-share", "0.6"),
        *("--evidence", "labels_semantic"),
    )
    assert status == 0, error
    assert load_scene_layer(small.scene, "labels_semantic").info.options["min_share"] == 0.6
    assert "the id with most votes" in splatseg("segment", "--method", "majority", "--help")[1]
    assert not keeps_ids("majority")
    assert keeps_ids("vote")
    assert keeps_boundaries("vote")
    # Its labels are not those of the label maps that they are from.
    for repairs in ("cosseg", "object-classes"):
        assert keeps_ids(repairs)
        assert not keeps_boundaries(repairs)
    assert not keeps_boundaries("majority")


def test_no_more_than_ten_lines_of_code() -> None:
    """Of the method itself; imports and blank lines aside."""
    lines = [line for line in MAJORITY.splitlines() if line.strip()]
    assert sum(not line.startswith(("from ", "import ")) for line in lines) <= 10, MAJORITY


def test_help_shows_the_flags_of_one_method_only(splatseg) -> None:
    status, text, _ = splatseg("segment", "--method", "vote", "--help")
    assert status == 0
    assert "--occlusion" in text
    assert "--evidence" in text
    assert "--complete" in text
    for foreign in ("--label-rule", "--agreement", "--identity"):
        assert foreign not in text
    assert "SA-GS" in text


def test_flags_of_completion_say_that_they_went(small, splatseg) -> None:
    words = ("segment", small.scene, "--method", "vote", "--completion.neighbours", "3")
    status, _, error = splatseg(*words)
    assert status == 2
    assert "--completion.neighbours: this option was removed; labels are completed in one" in error


def test_help_without_a_method_lists_them_all(splatseg) -> None:
    status, text, _ = splatseg("segment", "--help")
    assert status == 0
    flat = " ".join(text.replace("│", " ").split())
    for method in methods():
        assert f"{method.name}: {method.summary}" in flat
    assert "--occlusion" not in text


def test_flags_of_another_method_are_refused(small, splatseg) -> None:
    words = ("segment", small.scene, "--evidence", "labels_semantic")
    status, _, error = splatseg(*words, "--method", "uplift", "--occlusion", "depth")
    assert status == 2
    assert "--occlusion" in error
    assert not (small.scene / "layers" / "labels_semantic.npz").exists()


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("uplit", "did you mean uplift"),
        ("asociate", "did you mean associate"),
        ("xyzzy", "known: uplift, features, objects, voxels, vote, associate, object-classes"),
    ],
)
def test_an_unknown_method_gets_the_nearest_names(small, splatseg, name, said) -> None:
    status, _, error = splatseg("segment", small.scene, "--method", name)
    assert status == 2
    assert f"there is no method '{name}'" in error
    assert said in error
    assert splatseg("segment", small.scene, f"--method={name}")[0] == 2


def test_published_takes_the_options_of_the_publication(small, splatseg) -> None:
    words = ("segment", small.scene, "--evidence", "labels_semantic", "--method", "vote")
    assert splatseg(*words, "--published", "--layer", "published")[0] == 0
    assert splatseg(*words, "--layer", "default")[0] == 0
    assert splatseg(*words, "--published", "--share", "0.6", "--layer", "other")[0] == 0
    options = {
        name: load_scene_layer(small.scene, name).info.options
        for name in ("published", "default", "other")
    }
    assert options["published"]["rule"] == "published"
    assert options["default"]["rule"] == "visible"
    assert (options["other"]["rule"], options["other"]["share"]) == ("published", 0.6)
    inferred = load_scene_layer(small.scene, "published").inferred
    assert inferred is None or not inferred.any(), "published layers are not completed"


def test_every_method_has_a_published_setting() -> None:
    for method in methods():
        assert isinstance(method.published_options, method.options)


def test_python_gives_what_the_command_gives(small, splatseg) -> None:
    words = ("segment", small.scene, "--method", "uplift", "--evidence", "labels_semantic")
    assert splatseg(*words)[0] == 0
    scene = load_scene(small.scene, data=small.capture)
    made = package.segment(
        scene, "uplift", options=package.tasks.SegmentOptions(evidence="labels_semantic")
    )
    saved = load_scene_layer(small.scene, "labels_semantic")
    assert made.name == "labels_semantic"
    assert made.labels.ids.equal(saved.ids)
    assert made.labels.confidence.equal(saved.confidence)
    assert made.layer.info == saved.info


@pytest.mark.parametrize("told", [True, False])
def test_a_method_need_not_tell_its_name_and_views(small, told) -> None:
    own = LayerInfo(method="mine", views=("train_3",), seed=9, details={"loss": 0.5})

    def run(inputs, options) -> Labels:
        count = len(inputs.gaussians)
        labels = Labels(ids=torch.ones(count).int(), confidence=torch.ones(count))
        return with_info(labels, own) if told else labels

    method = Method(
        name="ones",
        summary="all of them are 1",
        reference="tests",
        evidence=("labels",),
        options=find_method("uplift").options,
        run=run,
    )
    scene = load_scene(small.scene, data=small.capture)
    options = package.tasks.SegmentOptions(evidence="labels_semantic", seed=3, views=("all",))
    info = package.segment(scene, method, options=options).layer.info
    assert (info.evidence, info.views_asked, info.seed) == ("labels_semantic", "all", 3)
    assert set(info.versions) == {"splatseg", "torch"}
    if told:
        assert (info.method, info.views, info.details) == ("mine", ("train_3",), {"loss": 0.5})
    else:
        known = open_evidence(small.capture / "labels_semantic").view_names
        assert info.method == "ones"
        assert sorted(info.views or ()) == sorted(v.name for v in scene.views if v.name in known)


def test_options_of_another_method_are_refused_in_python(small) -> None:
    scene = load_scene(small.scene, data=small.capture)
    options = package.tasks.SegmentOptions(evidence="labels_semantic")
    vote = find_method("vote").options()
    with pytest.raises(InputError, match="expected UpliftMethodOptions for method uplift"):
        package.segment(scene, "uplift", options=options, method_options=vote)


def test_ours_come_first_and_cannot_be_replaced(installed) -> None:
    installed(uplift="json:loads", other="splatseg.methods.vote:METHOD")
    assert method_names() == (*_method._OWN, *_method._ABOVE, "other")
    assert find_method("uplift").name == "uplift"


@pytest.mark.parametrize(
    ("value", "error", "said"),
    [
        ("nowhere:METHOD", MissingPackageError, "cannot be loaded"),
        ("json:nothing", MissingPackageError, "cannot be loaded"),
        ("json:loads", InputError, "expected a splatseg.methods.Method, got function"),
        ("splatseg.methods.vote:METHOD", InputError, "expected a method of this name, got 'vote'"),
    ],
)
def test_what_is_no_method_is_refused(installed, value, error, said) -> None:
    installed(theirs=value)
    with pytest.raises(error, match=said):
        find_method("theirs")


def test_a_method_must_have_options_with_defaults() -> None:
    import dataclasses

    class Plain:
        pass

    needs = dataclasses.make_dataclass("Needs", [("count", int)], frozen=True)
    thawed = dataclasses.make_dataclass("Thawed", [("count", int, 3)])
    about = {"name": "m", "summary": "", "reference": "", "evidence": (), "run": print}
    for options, said in (
        (Plain, "in a frozen dataclass"),
        (thawed, "in a frozen dataclass"),
        (needs, "a default for every option"),
    ):
        with pytest.raises(InputError, match=said):
            Method(options=options, **about)


def test_the_table_of_methods_is_what_they_declare(tmp_path) -> None:
    (tmp_path / "scripts").mkdir()
    (tmp_path / "docs").mkdir()
    script = shutil.copy(ROOT / "scripts" / "methods_table", tmp_path / "scripts")
    pages = ("README.md", "docs/methods.md")
    for page in pages:
        shutil.copy(ROOT / page, tmp_path / page)
    subprocess.run([sys.executable, script], check=True)
    for page in pages:
        made = (tmp_path / page).read_text()
        assert made == (ROOT / page).read_text(), "run scripts/methods_table"
    (tmp_path / "README.md").write_text("no marks")
    done = subprocess.run([sys.executable, script], check=False, capture_output=True, text=True)
    assert "README.md: expected the marks" in done.stderr
    assert done.returncode == 1


def test_a_method_that_went_says_what_to_use_and_its_layers_keep_their_ids() -> None:
    for name in ("logits", "probabilities"):
        assert name not in method_names()
        with pytest.raises(InputError, match=f"method '{name}' was removed; identity with as many"):
            find_method(name)
        assert keeps_ids(name)
        assert keeps_boundaries(name)
