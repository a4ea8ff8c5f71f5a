"""A run goes on, keeps apart what differs, and refuses what does not fit together."""

import shutil
from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Literal

import pytest
import torch

from splatseg.cli import main
from splatseg.core import (
    Embedding,
    Labels,
    MaskSet,
    Prompt,
    Selection,
)
from splatseg.core.models import TextMasks
from splatseg.errors import InputError, MissingFileError, RangeError
from splatseg.io.evidence import create_evidence, save_masks
from splatseg.io.scene import load_scene, save_scene
from splatseg.methods import Method, MethodInputs, _method, find_method, register_method
from splatseg.methods.uplift import UpliftMethodOptions
from splatseg.tasks import SILENT, Observer
from splatseg_bench.evidence import bench_model, companion_for, seen_for
from splatseg_bench.job import Job
from splatseg_bench.layouts import read_benchmark
from splatseg_bench.options import BenchOptions
from splatseg_bench.protocols import find_protocol
from splatseg_bench.results import load_result
from splatseg_bench.run import BenchRun, bench
from splatseg_bench.scenes import held_out_views
from splatseg_bench.tables import bench_table
from support.elsewhere import Elsewhere
from support.observers import Stopping
from support.red_square import NAMES, SIZE, save_strokes


@pytest.fixture
def run(tiny: tuple[Path, Path], tmp_path: Path) -> Callable[..., BenchRun]:
    """Runs a protocol on the wall with the fit at hand."""
    data, scenes = tiny

    def go(protocol: str = "spin-nerf", out: str = "out", **options) -> BenchRun:
        given = {"fitted": str(scenes / "{scene}"), **options}
        return bench(protocol, data, tmp_path / out, options=BenchOptions(**given), command="c")

    return go


def test_a_method_is_measured_once(run, tmp_path) -> None:
    first = run()
    (method,) = first.methods
    assert (first.kept, method.method) == (0, "uplift")
    assert method.scores["iou"] > 0.8
    path = tmp_path / "out/results/spin-nerf/uplift/wall.json"
    before = path.read_bytes()
    assert run().kept == 1
    assert path.read_bytes() == before
    # Anything that changes the result is another experiment.
    assert run(seed=1).kept == 0
    assert run(seed=1).kept == 1
    assert run(seed=1, published=True).kept == 0
    assert run(seed=1, published=True, switches=("boundary_ratio=none",)).kept == 0
    assert run(seed=1, published=True, switches=("boundary_ratio=none",), again=True).kept == 0
    made = load_result(path)
    assert "boundary_iou" not in made.scores
    assert made.made["command"] == "c"
    assert made.switches["boundary_ratio"] is None


def test_scenes_that_are_measured_elsewhere_have_the_same_results(tiny, run, tmp_path) -> None:
    data, scenes = tiny
    here = run().methods[0]
    options = BenchOptions(fitted=str(scenes / "{scene}"))
    executor, heard = Elsewhere(), Stopping()
    there = bench(
        "spin-nerf", data, tmp_path / "there", options=options, command="c",
        executor=executor, observer=heard,
    )  # fmt: skip
    assert [one.name for one in executor.items] == ["wall"]
    (running,) = executor.shared
    assert running.observer is not heard
    assert there.methods[0].scores == here.scores
    assert there.methods[0].scenes[0].rows == here.scenes[0].rows
    assert f"wall, uplift: iou {here.scores['iou']:.4f}" in heard.heard
    bench("spin-nerf", data, tmp_path / "there", options=options, executor=executor, observer=heard)
    assert heard.heard[-1] == "wall, uplift: as it was measured before"


def test_the_prompts_view_counts_where_the_protocol_says_so(run) -> None:
    rows = [row["view"] for row in run().methods[0].scenes[0].rows]
    assert rows == ["a", "b", "c"]
    other = run("spin-nerf-ludvig").methods[0].scenes[0]
    assert [row["view"] for row in other.rows] == ["b", "c"]


def test_gaussians_are_chosen_where_the_protocol_says_so(run) -> None:
    """Silhouettes are drawn alone, so what hides the thing takes nothing from it."""
    flat = run().methods[0].scores["iou"]
    solid = run(switches=("decided=gaussians",)).methods[0].scores["iou"]
    assert flat != solid
    assert solid > 0.5
    none = run(switches=("decided=gaussians", "silhouette_cut=1.0")).methods[0].scores["iou"]
    assert none == 0


def test_results_of_other_choices_do_not_go_into_one_table(run, tmp_path) -> None:
    run(out="other", switches=("reference_scored=no",))
    with pytest.raises(InputError, match=r"they differ in reference_scored True and False\."):
        run(beside=(tmp_path / "other",))
    run(out="same")
    found = run(beside=(tmp_path / "same",))
    assert [one.method for one in found.methods] == ["uplift", "uplift (same)"]
    columns, rows = bench_table(found)
    assert columns[0] == "method"
    assert rows[0][1:-1] == rows[1][1:-1]
    with pytest.raises(MissingFileError, match="expected results of spin-nerf, got none"):
        run(beside=(tmp_path / "nothing",))


def test_what_was_chosen_by_the_truth_is_marked(run, tmp_path) -> None:
    found = run(switches=("threshold=oracle",))
    assert found.methods[0].oracle == ("cut",)
    _, rows = bench_table(found)
    assert str(rows[0][-1]).endswith("oracle cut")
    assert "oracle" not in str(rows[-1][-1])


def first_quarter(inputs: MethodInputs, options: UpliftMethodOptions) -> Labels:
    """A method that a stranger brings: it looks at nothing."""
    count = len(inputs.gaussians)
    ids = torch.where(torch.arange(count) < 25, 1, 2)
    return Labels(ids=ids, confidence=torch.ones(count))


def test_any_registered_method_is_run(run) -> None:
    register_method(
        Method(
            name="stranger", summary="s", reference="r", evidence=("labels",),
            options=UpliftMethodOptions, run=first_quarter,
        )
    )  # fmt: skip
    try:
        found = run(methods=("stranger", "uplift"))
    finally:
        del _method._REGISTERED["stranger"]
    assert [one.method for one in found.methods] == ["stranger", "uplift"]
    assert found.methods[0].scores["iou"] > 0.9


def test_what_does_not_fit_is_refused(run, tmp_path) -> None:
    with pytest.raises(InputError, match="there is no protocol 'spin'"):
        run("spin")
    with pytest.raises(InputError, match="expected scenes wall, got 'door'"):
        run(scenes=("door",))
    with pytest.raises(InputError, match="method associate: expected a model that gives"):
        run(methods=("associate",))
    with pytest.raises(InputError, match="methods: expected each once"):
        BenchOptions(methods=("uplift", "uplift"))
    with pytest.raises(InputError, match="methods: expected at least one"):
        BenchOptions(methods=())
    with pytest.raises(MissingFileError, match="no such folder of a benchmark"):
        bench("spin-nerf", tmp_path / "none", tmp_path / "out")
    with pytest.raises(InputError, match=r"model classical: expected NAME=VALUE"):
        run(methods=("associate",), models=("classical,size",))
    with pytest.raises(InputError, match="models: classical has no weights"):
        run(methods=("associate",), models=("classical=weights",))


def test_a_fit_that_learned_from_held_out_views_is_refused(tiny, run, tmp_path) -> None:
    _, scenes = tiny
    with pytest.raises(InputError, match=r"holds out, got one that learned from 2 of them \(b\)"):
        run(switches=("scored_in_training=no", "reference_scored=no"))
    scene = load_scene(scenes / "wall")
    views = tuple(replace(one, split="train" if one.name == "a" else "test") for one in scene.views)
    save_scene(replace(scene, views=views), tmp_path / "wall")
    held_out = run(
        switches=("scored_in_training=no", "reference_scored=no"),
        fitted=str(tmp_path / "{scene}"),
    )
    assert held_out.methods[0].scores["iou"] > 0.8


def test_fits_go_on_and_are_kept_apart(run, tmp_path) -> None:
    fitted = {"fitted": None, "max_gaussians": 300}
    one = run(steps=4, **fitted)
    (scene,) = (tmp_path / "out/scenes").glob("*/wall")
    written = (scene / "gaussians.ply").stat().st_mtime_ns
    assert run(steps=4, methods=("uplift", "vote"), **fitted).kept == 1
    assert (scene / "gaussians.ply").stat().st_mtime_ns == written, "one fit for all methods"
    assert one.methods[0].scenes[0].made["gaussians"]
    with pytest.raises(InputError, match=r"expected a fit with these options.*steps 4 there, 5 no"):
        run(steps=5, **fitted)
    with pytest.raises(InputError, match="learned from 1 views, got one of another split, which"):
        run(steps=4, switches=("scored_in_training=no",), **fitted)


class StopsOnce(Observer):
    """Ctrl-C in the middle of the first fit."""

    stopped = False

    @contextmanager
    def stage(self, stage: str):
        def step(done: int, total: int, text: str = "") -> None:
            if stage == "fit" and text.startswith("step 3,") and not self.stopped:
                self.stopped = True
                raise KeyboardInterrupt

        yield step


def test_a_fit_that_was_stopped_is_not_measured_and_goes_on(tiny, tmp_path) -> None:
    options = BenchOptions(steps=6, max_gaussians=300)
    observer = StopsOnce()
    with pytest.raises(KeyboardInterrupt, match="goes on when the same is asked for again"):
        bench("spin-nerf", tiny[0], tmp_path / "out", options=options, observer=observer)
    assert not (tmp_path / "out/results").exists()
    found = bench("spin-nerf", tiny[0], tmp_path / "out", options=options)
    whole = bench("spin-nerf", tiny[0], tmp_path / "whole", options=options)
    made = [one.methods[0].scenes[0].made["gaussians"] for one in (found, whole)]
    assert made[0] == made[1], "as if it had not been stopped"


def test_what_is_held_out(tiny) -> None:
    """Scored views of things; the data set's split of maps, or every so many views without one."""
    (scene,) = read_benchmark("spin-nerf", tiny[0])
    spin = find_protocol("spin-nerf")
    assert held_out_views(scene, spin) == frozenset()
    assert held_out_views(scene, spin.with_switches({"scored_in_training": False})) == {"b", "c"}
    maps = find_protocol("scannet-views")
    assert held_out_views(scene, maps) == {"a"}
    assert held_out_views(scene, maps.with_switches({"hold_out_every": 2})) == {"a", "c"}
    views = tuple(
        replace(v, split="test" if v.name == "b" else "train") for v in scene.capture.views
    )
    own = replace(scene, capture=replace(scene.capture, views=views))
    assert held_out_views(own, maps) == {"b"}
    with pytest.raises(RangeError, match="hold_out_every: expected 2 or more"):
        maps.with_switches({"hold_out_every": 1})


def test_options_of_models() -> None:
    """What stands behind a model's name reaches it."""
    plain = bench_model("classical", BenchOptions(), SILENT)
    other = bench_model("classical,cuts=0.2,0.4", BenchOptions(), SILENT)
    assert plain.settings != other.settings
    assert "0.2, 0.4" in str(other.settings)


def test_one_model_that_is_asked_for_two_things(tiny, tmp_path) -> None:
    """What it is asked for second has a name of its own, and both are there the next time."""
    shutil.copytree(tiny[1] / "wall", tmp_path / "wall")
    scene = load_scene(tmp_path / "wall")
    (found,) = read_benchmark("spin-nerf", tiny[0])
    options = BenchOptions(models=("classical",), companions=("classical",))
    told = {"options": options, "backend": "auto", "observer": SILENT}
    for _ in range(2):
        masks = seen_for(find_method("associate"), scene, found, **told)
        features = companion_for(scene, found, "guidance", ("features",), **told)
        assert (masks.name, masks.kind) == ("classical", "masks")
        assert (features.name, features.kind) == ("classical.features", "features")


class Redness:
    """Finds what is red, if the words say so."""

    name, settings, note = "redness", {}, ""

    def grounded_masks(self, image, words) -> TextMasks:
        red = (image[..., 0].int() > image[..., 2].int())[None]
        if "red" not in words[0]:
            red = red[:0]
        return TextMasks(masks=MaskSet.from_dense(red), words=(0,) * len(red))


class Reds(Redness):
    """Gives what is red where a positive point is on it, and keeps the points."""

    def __init__(self) -> None:
        self.prompts: list[Prompt] = []

    def embed(self, image) -> Embedding:
        height, width = (int(side) for side in image.shape[:2])
        return Embedding(model=self.name, height=height, width=width, arrays={"image": image})

    def prompted_masks(self, embedding, prompt) -> MaskSet:
        self.prompts.append(prompt)
        image = embedding.arrays["image"].int()
        return MaskSet.from_dense((image[..., 0] > image[..., 2])[None])


def test_who_answers_strokes(tiny, tmp_path, monkeypatch) -> None:
    """Shares of the skeletons become points, the prompter's mask is what is lifted."""
    data, scenes = tiny
    folder = tmp_path / "nvos"
    shutil.copytree(data / "wall", folder / "llff" / "wall")
    save_strokes(folder / "scribbles/red/pos_0_wall.png", (slice(15, 18), slice(10, 22)))
    save_strokes(folder / "scribbles/red/neg_0_wall.png", (slice(2, 3), slice(2, 30)))
    (folder / "masks/red").mkdir(parents=True)
    (folder / "reference_image/red").mkdir(parents=True)
    shutil.copy(data / "wall/masks/b.png", folder / "masks/red/b_mask.png")
    shutil.copy(data / "wall/images/a.png", folder / "reference_image/red/a.png")
    model = Reds()
    monkeypatch.setattr("splatseg_bench.run.bench_model", lambda *_: model)
    given = {"fitted": str(scenes / "{scene}"), "prompter": "reds"}
    held = ("scored_in_training=yes",)
    done = bench("nvos", folder, tmp_path / "o", options=BenchOptions(switches=held, **given))
    assert done.methods[0].scores["iou"] > 0.8
    (few,) = model.prompts
    assert int(few.signs.sum()) >= 1
    assert bool((few.points[few.signs][:, 1] == 16.5).all()), "the middle row of the stroke"
    all_of_them = (*held, "positive_share=1.0", "negative_share=1.0")
    bench("nvos", folder, tmp_path / "o", options=BenchOptions(switches=all_of_them, **given))
    many = model.prompts[-1]
    assert int(many.signs.sum()) > int(few.signs.sum())
    assert int((~many.signs).sum()) > 10
    made = load_result(tmp_path / "o/results/nvos/uplift/wall.json").made
    assert made["prompter"]["name"] == "redness"
    monkeypatch.undo()
    with pytest.raises(InputError, match="expected one of"):
        bench("nvos", folder, tmp_path / "p", options=BenchOptions(prompter="nobody"))


def test_words_found_in_the_drawn_first_view(tiny, tmp_path, monkeypatch) -> None:
    data, scenes = tiny
    folder = tmp_path / "lerf"
    shutil.copytree(data / "wall", folder / "wall")
    for view in ("b", "c"):
        for words in ("red square", "green cube"):
            (folder / "wall/test_mask" / view).mkdir(parents=True, exist_ok=True)
            source = data / f"wall/masks/{view}.png"
            shutil.copy(source, folder / "wall/test_mask" / view / f"{words}.png")
    scene = load_scene(scenes / "wall")
    views = tuple(replace(one, split="train" if one.name == "a" else "test") for one in scene.views)
    save_scene(replace(scene, views=views), tmp_path / "wall")
    asked: list[str] = []

    def bench_model(named, options, observer):
        asked.append(named)
        return Redness()

    monkeypatch.setattr("splatseg_bench.run.bench_model", bench_model)
    options = BenchOptions(fitted=str(tmp_path / "{scene}"), grounder="redness")
    done = bench("lerf-mask", folder, tmp_path / "o", options=options)
    assert asked == ["redness"]
    rows = {(row["task"], row["view"]): row for row in done.methods[0].scenes[0].rows}
    assert rows["red square", "b"]["iou"] > 0.8
    assert rows["red square", "c"]["iou"] > 0.8
    # What is not found counts as wrong, in every view.
    assert not rows["green cube", "b"]["found"]
    assert done.methods[0].scores["iou"] < 0.55
    assert "green cube" in done.methods[0].scenes[0].notes[0]


@dataclass(frozen=True)
class Asked:
    words: tuple[str, ...] = ()
    objects: Literal["one", "all"] = "one"
    grounder: str | None = None


def test_words_of_scenes_come_from_a_file_or_a_switch(run, tiny, tmp_path, monkeypatch) -> None:
    """What a method is asked: the words of words.txt, or those of the experiment."""
    data, _ = tiny
    with pytest.raises(InputError, match=r"scene wall: expected the words .*words\.txt, or set"):
        run("spin-nerf-words")
    asked: list[Asked] = []

    def answered(inputs: MethodInputs, options: Asked) -> Selection:
        asked.append(options)
        return Selection(mask=torch.ones(len(inputs.gaussians), dtype=torch.bool))

    method = Method(
        name="asked", summary="what was asked", reference="test", evidence=("masks",),
        options=Asked, run=answered, returns="selection",
    )  # fmt: skip
    monkeypatch.setattr("splatseg_bench.run.find_method", lambda name: method)
    masks = tmp_path / "masks"
    create_evidence(masks, kind="masks")
    for name in NAMES:
        whole = MaskSet.from_dense(torch.ones(1, SIZE, SIZE, dtype=torch.bool))
        save_masks(whole, masks, name)
    shutil.copytree(data, tmp_path / "data")
    (tmp_path / "data/wall/words.txt").write_text("red square\n")

    def go(out: str, *switches: str) -> BenchRun:
        options = BenchOptions(
            methods=("asked",), models=(str(masks),), grounder="redness", switches=switches,
            fitted=str(tiny[1] / "{scene}"),
        )  # fmt: skip
        return bench("spin-nerf-words", tmp_path / "data", tmp_path / out, options=options)

    monkeypatch.setattr("splatseg_bench.run.bench_model", lambda *_: Redness())
    done = go("file")
    go("switch", "scene_words=wall:All of the squares")
    assert [(one.words, one.objects) for one in asked] == [
        (("red square",), "one"),
        (("All of the squares",), "all"),
    ]
    # All annotated views count, the first one as well.
    rows = done.methods[0].scenes[0].rows
    assert {row["view"] for row in rows} == set(NAMES)
    # No mean is published: figures of scenes stand beside, each named.
    columns, table = bench_table(done)
    assert columns[:3] == ("method", "iou", "accuracy")
    figures = {(row[0], str(row[-1]).split(";")[0]): row[1:3] for row in table}
    assert figures["Prompt SA-GS", "Prompt SA-GS, Table 4, orchids"] == (0.76, 0.957)
    assert figures["SA-GS", "Prompt SA-GS, Table 4, truck"] == (0.934, 0.978)


def test_words_are_asked_of_published_voxels_by_cosines() -> None:
    """As their paper asks, and not in the span of the features."""
    asked = [
        Job.words.fget(
            SimpleNamespace(method=find_method(name), options=BenchOptions(published=published))
        )
        for name in ("voxels", "objects", "features")
        for published in (False, True)
    ]
    assert asked == ["span", "cosines", "span", "span", "cosines", "cosines"]


def test_options_of_methods_are_another_experiment(run) -> None:
    """Also those that their options hold in an object of their own."""
    assert run().kept == 0
    done = run(method_options=("correct_confusion=no", "max_correlation=0.7"))
    assert done.kept == 0
    made = done.methods[0].scenes[0].made["options"]
    assert made["correct_confusion"] is False
    assert made["confusion"]["max_correlation"] == 0.7
    for wrong in ("view_share=0.5", "correct_confusion", "=1"):
        with pytest.raises(InputError, match="^option: expected NAME=VALUE with an option of up"):
            run(method_options=(wrong,))
    with pytest.raises(InputError, match="option: max_correlation: expected a number, got 'much'"):
        run(method_options=("max_correlation=much",))


def test_from_the_command(tiny, tmp_path, capsys) -> None:
    data, scenes = tiny
    words = ["bench", "spin-nerf", "--data", str(data), "-o", str(tmp_path / "o")]
    words += ["--fitted", str(scenes / "{scene}"), "--quiet"]
    assert main(words) == 0
    printed = capsys.readouterr().out
    assert "measured here" in printed
    assert "SAGA" in printed
    for kind in ("md", "csv", "tex", "html", "json"):
        text = (tmp_path / f"o/spin-nerf.{kind}").read_text()
        assert "uplift" in text
    page = (tmp_path / "o/spin-nerf.html").read_text()
    assert "not verified" in page
    assert "reference_scored" in page
    assert main([*words[:2], "--data", str(tmp_path / "none"), *words[4:]]) == 2
    assert "no such folder" in capsys.readouterr().err
