"""Words asked of a scene, from Python and from the command line."""

import importlib
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import imageio_ffmpeg
import pytest
import torch
from PIL import Image

from splatseg.cli import main
from splatseg.core import FeatureMap, Features, Labels, LayerInfo, Selection
from splatseg.errors import InputError, RangeError
from splatseg.io.evidence import (
    FeatureEvidence,
    TextEmbeddings,
    create_evidence,
    open_evidence,
    save_features,
    save_text_embeddings,
)
from splatseg.io.scene import load_scene, load_scene_layer, save_scene_layer
from splatseg.lift.vocabulary import Vocabulary, vocabulary_of
from splatseg.tasks import Found, QueryOptions, QuerySession, draw_heat, draw_query_result, query
from splatseg.tasks.pictures import write_query_report


@pytest.fixture(scope="module")
def folder(fitted_room, tmp_path_factory) -> Path:
    return Path(shutil.copytree(fitted_room, tmp_path_factory.mktemp("query") / "scene"))


@pytest.fixture(scope="module")
def scene(folder):
    return load_scene(folder)


@pytest.fixture(scope="module")
def vocabulary(scene) -> Vocabulary:
    evidence = open_evidence(scene.source / "features_text")
    assert isinstance(evidence, FeatureEvidence)
    return vocabulary_of(evidence)


@pytest.fixture(scope="module")
def words(vocabulary) -> tuple[str, str, str]:
    """Three classes that the features can tell apart."""
    labels, kinds = vocabulary.recorded.labels, vocabulary.recorded.kinds
    names = [label for label, kind in zip(labels, kinds, strict=True) if kind == "class"]
    vectors = vocabulary.vectors(names)
    shown = vectors @ torch.linalg.qr(vocabulary.space.basis.T).Q
    # The two that features show best, and the one that is least like both.
    first = int(shown.norm(dim=1).argmax())
    second = int((shown.norm(dim=1) - 2 * (vectors @ vectors[first]).clamp_min(0)).argmax())
    third = int((vectors[[first, second]] @ vectors.T).abs().sum(dim=0).argmin())
    return names[first], names[second], names[third]


def layer_of(scene, vocabulary, words) -> Features:
    """The left third of the Gaussians is the first word, the middle the second."""
    space = vocabulary.space
    vectors = vocabulary.vectors(words)
    values = (vectors - space.mean) @ space.basis.T if space.basis is not None else vectors
    place = scene.gaussians.means[:, 0].argsort().argsort() * 3 // len(scene.gaussians)
    kept = torch.cat((values[:2], torch.zeros(1, values.shape[1])))[place]
    return Features(
        values=kept,
        weights=(place < 2).float(),
        info=LayerInfo(method="objects", evidence="features_text"),
    )


@pytest.fixture(scope="module")
def layers(scene, vocabulary, words):
    return {"objects": layer_of(scene, vocabulary, words)}


LOW = QueryOptions(min_probability=0.3)


def test_things_that_a_word_means(scene, layers, words) -> None:
    found = query(scene, words, options=LOW, layers=layers)
    assert found.layer == "objects"
    assert [len(found.found[word]) for word in words] == [1, 1, 0]
    assert found.unknown == (words[2],)
    assert 0 <= found.surest[words[2]] < 0.3
    assert found.surest[words[0]] == pytest.approx(float(found.probabilities[:, 0].max()))
    first = found.found[words[0]][0]
    third = -(-len(scene.gaussians) // 3)
    assert abs(first.gaussians - third) <= 1
    assert first.probability > 0.3
    chosen = found.of_thing(words[0], first.thing)
    assert chosen.count == first.gaussians
    inside = scene.gaussians.means[chosen.mask].double()
    assert first.centre == pytest.approx(inside.median(dim=0).values.tolist(), abs=1e-5)
    assert first.size[0] < float(inside[:, 0].max() - inside[:, 0].min()) + 1e-5
    with pytest.raises(InputError, match="thing: expected one that answers"):
        found.of_thing(words[1], first.thing)


def test_phrases_are_asked_by_their_parts(scene, tmp_path) -> None:
    """Two mugs; as a whole "green mug" means the red one a little more."""
    place = scene.gaussians.means[:, 0].argsort().argsort() * 3 // len(scene.gaussians)
    mugs = torch.tensor([[1.0, 0.1, 0.0], [1.0, -0.1, 0.0], [0.0, 0.0, 0.0]])
    phrase = torch.tensor([[1.0, 0.12, 0.0]])
    folder = create_evidence(tmp_path / "features_mugs", kind="features")
    view = scene.train_views[0].camera
    cells = torch.rand(-(-view.height // 16), -(-view.width // 16), 3)
    grid = FeatureMap(features=cells, stride=16, height=view.height, width=view.width)
    save_features(grid, folder, scene.train_views[0].name)
    words = TextEmbeddings(
        labels=("mug", "desk", "green mug"),
        vectors=torch.nn.functional.normalize(torch.cat((torch.eye(3)[[0, 2]], phrase)), dim=1),
        kinds=("class", "class", "instance"),
        target_ids=(1, 2, 2),
    )
    save_text_embeddings(words, folder)
    colours = torch.tensor([[0.8, 0.1, 0.1], [0.2, 0.6, 0.25], [0.5, 0.5, 0.5]])
    sh = scene.gaussians.sh.clone()
    sh[:, 0] = ((colours - 0.5) / 0.28209479)[place]
    coloured = replace(scene, gaussians=scene.gaussians.replace(sh=sh))
    info = LayerInfo(method="objects", evidence=str(folder))
    layer = Features(values=mugs[place], weights=(place < 2).float(), info=info)
    for how, meant in (("whole", 0), ("parts", 1)):
        options = QueryOptions(features=str(folder), phrases=how)
        found = query(coloured, ["green mug"], options=options, layers={"objects": layer})
        first = found.found["green mug"][0]
        assert bool((place[found.of_thing("green mug", first.thing).mask] == meant).all()), how
        assert len(found.found["green mug"]) == (1 if how == "parts" else 2)
    with pytest.raises(InputError, match="phrases: expected one of parts, whole"):
        QueryOptions(phrases="half")


def test_layers_of_answers(scene, layers, words) -> None:
    found = query(scene, words, options=LOW, layers=layers)
    selection = query(scene, words[:1], options=LOW, layers=layers).selection()
    assert isinstance(selection, Selection)
    assert selection.count == found.found[words[0]][0].gaussians
    assert selection.info.method == "query"
    labels = found.labels()
    assert labels.present.tolist() == [1, 2]
    assert labels.info.names == dict(enumerate(words, start=1))
    every = query(
        scene, words, options=replace(LOW, every=True, min_probability=1.0), layers=layers
    )
    assert every.labels().ids.tolist() == labels.ids.tolist()
    with pytest.raises(InputError, match=f"answers to {words[2]}"):
        query(scene, words[2:], options=LOW, layers=layers).selection()


def test_of_equally_sure_things_the_larger_comes_first() -> None:
    at = (0.0, 0.0, 0.0)
    small, large, other = (
        Found(thing=thing, probability=p, cosine=0.5, gaussians=count, centre=at, size=at)
        for thing, p, count in ((1, 0.9999, 10), (2, 0.9996, 500), (3, 0.93, 900))
    )
    module: Any = importlib.import_module("splatseg.tasks.query")
    assert sorted((other, small, large), key=module._rank) == [large, small, other]


def test_a_higher_probability_is_asked_for(scene, layers, words) -> None:
    sure = query(scene, words[:1], options=LOW, layers=layers).found[words[0]][0].probability
    above = QueryOptions(min_probability=min(1.0, sure + 1e-3))
    assert query(scene, words[:1], options=above, layers=layers).unknown == (words[0],)


def test_components_count(scene, layers, words) -> None:
    base = query(scene, words, layers=layers)
    one = query(scene, words, options=QueryOptions(components=1), layers=layers)
    assert not torch.equal(one.cosines, base.cosines)


def test_features_of_each_gaussian_answer_in_connected_pieces(
    scene, vocabulary, words, monkeypatch
) -> None:
    layer = layer_of(scene, vocabulary, words)
    generator = torch.Generator().manual_seed(5)
    noise = 1e-4 * torch.randn(layer.values.shape, generator=generator)
    own = replace(
        layer,
        values=torch.where(
            layer.values.abs().amax(dim=1, keepdim=True) > 0, layer.values + noise, 0
        ),
        info=replace(layer.info, method="features"),
    )
    module: Any = importlib.import_module("splatseg.tasks.query")
    monkeypatch.setattr(module, "_THINGS", 100)
    session = QuerySession(scene, options=replace(LOW, from_layer="own"), layers={"own": own})
    assert len(session.index) > 1000
    found = session.ask(words)
    pieces = found.found[words[0]]
    assert 1 <= len(pieces) < 1000
    assert sum(one.gaussians for one in pieces) == int((found.things[:, 0] >= 0).sum())


def test_a_layer_of_objects_is_made_once_and_kept(folder, words, capsys) -> None:
    call = ["query", str(folder), *words, "--masks", "masks_sam", "--features", "features_text"]
    assert main([*call, "--json", "--layer", "answers", "--every"]) == 0
    captured = capsys.readouterr()
    facts = json.loads(captured.out)
    assert "finding objects by masks_sam" in captured.err
    assert facts["source"] == "objects"
    assert set(facts["words"]) == set(words)
    made = load_scene_layer(folder, "objects")
    assert isinstance(made, Features)
    assert made.info.method == "objects"
    assert isinstance(load_scene_layer(folder, "answers"), Labels)
    assert main([*call, "--json"]) == 0
    captured = capsys.readouterr()
    assert "finding objects" not in captured.err
    assert json.loads(captured.out)["words"] == facts["words"]


def test_what_the_command_prints_and_writes(folder, scene, layers, words, capsys, tmp_path) -> None:
    save_scene_layer(layers["objects"], folder, "drawn")
    name = scene.train_views[0].name
    call = ["query", str(folder), *words, "--from-layer", "drawn", "--min-probability", "0.3"]
    call += ["--picture", str(tmp_path / "p"), "--heat", str(tmp_path / "h"), "--views", name]
    assert main(call) == 0
    out = capsys.readouterr().out
    assert f"{words[0]}: 1 thing" in out
    assert re.search(rf"{words[2]}: unknown here \([\d.]+% at most\)", out)
    pictures = sorted(path.name for path in (tmp_path / "p").iterdir())
    assert len(pictures) == 2
    assert all(picture.endswith("_1.png") for picture in pictures)
    heat = sorted(path for path in (tmp_path / "h").rglob("*.png"))
    assert len(heat) == 3
    camera = scene.train_views[0].camera
    with Image.open(heat[0]) as picture:
        assert picture.size == (camera.width, camera.height)
    # One word becomes a selection.
    call = ["query", str(folder), words[0], "--from-layer", "drawn", "--min-probability", "0.3"]
    assert main([*call, "--layer", "one", "--quiet"]) == 0
    assert isinstance(load_scene_layer(folder, "one"), Selection)


def test_a_report_shows_what_answers(folder, scene, layers, words, capsys) -> None:
    save_scene_layer(layers["objects"], folder, "drawn")
    call = ["query", str(folder), *words, "--from-layer", "drawn", "--min-probability", "0.3"]
    assert main([*call, "--report", "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    page = Path(facts["report"]).read_text()
    assert Path(facts["report"]) == folder / "reports" / "query.html"
    assert "2 of 3" in page
    assert f"Unknown: {words[2]}." in page
    assert f"{facts['surest'][words[2]]:.1%}" in page
    # A cut-out of each thing, and for each of two words its view and the heat there.
    assert page.count("<img") == 2 + 2 * 2
    assert f"<h2>{words[0]}</h2>" in page
    record = json.loads((folder / "reports" / "query.json").read_text())
    assert record["found"][words[0]] == facts["words"][words[0]]
    assert record["surest"] == facts["surest"]


def test_no_more_things_are_reported_than_asked_for(scene, vocabulary, words, tmp_path) -> None:
    layer = layer_of(scene, vocabulary, words)
    # Another third that means the first word, less surely.
    mixed = torch.where(layer.values == 0, 0.9 * layer.values[:1] + 0.1, layer.values)
    left = scene.gaussians.means[:, 0].argmin()
    values = torch.where(layer.values.abs().sum(1, keepdim=True) > 0, layer.values, mixed[left])
    two = replace(layer, values=values, weights=torch.ones(len(values)))
    found = query(scene, words[:1], options=QueryOptions(min_probability=0.0), layers={"o": two})
    assert len(found.found[words[0]]) > 1
    (tmp_path / "reports").mkdir()
    all_of_them = write_query_report(found, scene, tmp_path).read_text()
    first = write_query_report(found, scene, tmp_path, top=1).read_text()
    assert all_of_them.count("<img") == 2 + len(found.found[words[0]])
    assert first.count("<img") == 2 + 1
    assert "The surest 1 of them." in first


def test_a_film_of_heat_along_a_path(folder, layers, words, capsys, tmp_path) -> None:
    save_scene_layer(layers["objects"], folder, "drawn")
    call = ["query", str(folder), words[0], "--from-layer", "drawn", "--heat", str(tmp_path)]
    assert main([*call, "--views", "path", "--frames", "6", "--video", "--fps", "3"]) == 0
    capsys.readouterr()
    assert len(list(tmp_path.rglob("path_*.png"))) == 6
    (film,) = tmp_path.glob("*.mp4")
    frames, seconds = imageio_ffmpeg.count_frames_and_secs(str(film))
    assert frames == 6
    assert seconds == pytest.approx(2.0, abs=0.1)
    assert main(["query", str(folder), words[0], "--video"]) == 2
    assert "video: expected --heat" in capsys.readouterr().err
    assert main(["query", str(folder), words[0], "--views", "train_0010"]) == 2
    assert "views: expected --heat" in capsys.readouterr().err


def test_pictures_from_python(scene, layers, words, tmp_path) -> None:
    found = query(scene, words, options=LOW, layers=layers)
    assert len(draw_query_result(found, scene, tmp_path / "a", top=1)) == 2
    assert len(draw_heat(found, scene, scene.train_views[:2], tmp_path / "b")) == 6


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (["zzz"], "recorded words, got 'zzz'"),
        ([""], "expected words or phrases"),
        (["A", "--top", "0"], "top: expected at least 1"),
        (["A", "--from-layer", "nothing"], "from-layer: expected one of"),
        (
            ["A", "--features", "masks_sam", "--masks", "masks_sam"],
            "expected features, 'masks_sam' has masks",
        ),
        (["A", "--masks", "nothing", "--features", "features_text"], "nothing"),
        (["A", "--model", "classical"], "expected a model that encodes words"),
    ],
)
def test_what_is_wrong_is_one_sentence(folder, words, call, said, capsys) -> None:
    asked = [words[0] if word == "A" else word for word in call]
    assert main(["query", str(folder), *asked]) == 2
    err = capsys.readouterr().err
    assert said in err
    assert err.count("\n") == 1


def test_twice_the_same_word_is_refused(scene, layers, words) -> None:
    with pytest.raises(InputError, match="distinct words"):
        query(scene, [words[0], f" {words[0]}"], layers=layers)
    with pytest.raises(RangeError, match="min_probability"):
        QueryOptions(min_probability=1.5)
    with pytest.raises(RangeError, match="components"):
        QueryOptions(components=0)


def twins(scene, vocabulary, words) -> Features:
    """As `layer_of`, but the left third is two things of one word."""
    layer = layer_of(scene, vocabulary, words)
    place = scene.gaussians.means[:, 0].argsort().argsort() * 6 // len(scene.gaussians)
    nudged = torch.where((place == 0)[:, None], layer.values * (1 + 1e-6), layer.values)
    return replace(layer, values=nudged)


def test_phrases_that_refer_among_words(scene, layers, words) -> None:
    """They get columns of their own; those of words stay as they are, to the bit."""
    first, second, _ = words
    phrases = (f"how many {first}s", f"the {first} nearest the {second}", f"two {first}s")
    plain = query(scene, words, options=LOW, layers=layers)
    found = query(scene, (phrases[0], *words, *phrases[1:]), options=LOW, layers=layers)
    assert torch.equal(found.vectors.cosines[:, 1:4], plain.vectors.cosines)
    assert torch.equal(found.vectors.probabilities[:, 1:4], plain.vectors.probabilities)
    assert torch.equal(found.things[:, 1:4], plain.things)
    assert not plain.references
    assert {word: one.status for word, one in found.references.items()} == dict(
        zip(phrases, ("found", "found", "nothing"), strict=True)
    )
    thing = found.found[first][0]
    assert found.found[phrases[1]][0].thing == thing.thing
    assert found.found[phrases[1]][0].probability == thing.probability
    assert found.unknown == (words[2], phrases[2])
    assert "expected 2, found 1" in found.references[phrases[2]].explanation
    one = query(scene, phrases[1:2], options=LOW, layers=layers)
    assert torch.equal(one.selection().mask, found.of_thing(first, thing.thing).mask)
    assert one.selection().info.details["references"][phrases[1]]["status"] == "found"
    # Also where everything is as likely as is asked for.
    all_of_it = query(scene, phrases[:1], options=QueryOptions(min_probability=0.0), layers=layers)
    assert len(all_of_it.found[phrases[0]]) == len(all_of_it.references[phrases[0]].things)


def test_the_view_decides_what_is_left(scene, layers, words) -> None:
    """Of two opposite cameras one sees the first word left of the second."""
    phrases = [f"the {words[0]} {side} of the {words[1]}" for side in ("left", "right")]
    said = set()
    for view in scene.train_views:
        found = query(scene, phrases, options=replace(LOW, view=view.name), layers=layers)
        left, right = (found.references[phrase] for phrase in phrases)
        assert "nothing" in (left.status, right.status)
        assert any(f"from view {view.name}" in one.explanation for one in (left, right))
        said.add((left.status, right.status))
    assert len(said) > 1
    default = query(scene, phrases, options=LOW, layers=layers)
    assert any(
        f"from view {scene.train_views[0].name}" in one.explanation
        for one in default.references.values()
    )
    with pytest.raises(InputError, match="there is no 'nothing' among"):
        query(scene, words, options=replace(LOW, view="nothing"), layers=layers)


def test_an_ambiguous_phrase_chooses_nothing(scene, vocabulary, words, folder, capsys) -> None:
    layer = twins(scene, vocabulary, words)
    phrase = f"the one {words[0]}"
    # By its name: earlier tests left layers of objects in the scene.
    options = replace(LOW, from_layer="twins")
    found = query(scene, [phrase, words[1]], options=options, layers={"twins": layer})
    assert found.ambiguous == (phrase,)
    assert found.unknown == ()
    assert found.found[phrase] == ()
    assert len(found.references[phrase].referents) == 2
    assert found.labels().present.tolist() == [2]
    with pytest.raises(InputError, match="ambiguous, 2 candidates"):
        found.selection()
    save_scene_layer(layer, folder, "twins")
    call = ["query", str(folder), phrase, "--from-layer", "twins", "--min-probability", "0.3"]
    assert main([*call, "--report"]) == 0
    assert f"{phrase}: ambiguous, 2 candidates: {words[0]} " in capsys.readouterr().out
    assert "ambiguous, 2 candidates" in (folder / "reports" / "query.html").read_text()
    assert main([*call, "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["words"][phrase] == []
    assert facts["unknown"] == []
    assert facts["references"][phrase]["status"] == "ambiguous"
    assert len(facts["references"][phrase]["candidates"]) == 2
    assert main([*call, "--layer", "one"]) == 2
    assert "ambiguous, 2 candidates" in capsys.readouterr().err


def test_the_command_explains_what_a_phrase_means(folder, scene, layers, words, capsys) -> None:
    save_scene_layer(layers["objects"], folder, "drawn")
    phrase = f"the {words[0]} nearest the {words[1]}"
    call = ["query", str(folder), phrase, "--from-layer", "drawn", "--min-probability", "0.3"]
    assert main([*call, "--layer", "one"]) == 0
    out = capsys.readouterr().out
    assert re.search(rf"{phrase}: {words[0]} \d: nearest {words[1]} \d\n", out)
    assert re.search(r"%  thing \d, \d+ Gaussians at", out)
    assert isinstance(load_scene_layer(folder, "one"), Selection)


def test_what_phrases_that_refer_need(scene, vocabulary, layers, words) -> None:
    phrase = f"two {words[0]}s"
    with pytest.raises(InputError, match="every: expected words"):
        query(scene, [phrase], options=replace(LOW, every=True), layers=layers)
    with pytest.raises(InputError, match=f"recorded words, got '{phrase}'"):
        query(scene, [phrase], options=replace(LOW, phrases="whole"), layers=layers)
    with pytest.raises(InputError, match="which is not understood at 'or"):
        query(scene, [f"{words[0]} or {words[1]}"], options=LOW, layers=layers)
    with pytest.raises(InputError, match="recorded words, got 'zzz'"):
        query(scene, [f"{words[0]} left of the zzz"], options=LOW, layers=layers)
    with pytest.raises(InputError, match="distinct words"):
        query(scene, [phrase, f" {phrase}"], options=LOW, layers=layers)


def test_phrases_that_refer_need_objects(scene, vocabulary, words, monkeypatch) -> None:
    layer = layer_of(scene, vocabulary, words)
    module: Any = importlib.import_module("splatseg.tasks.query")
    monkeypatch.setattr(module, "_THINGS", 1)
    with pytest.raises(InputError, match="refers to objects, and layer 'own' has none"):
        query(
            scene,
            [f"two {words[0]}s"],
            options=replace(LOW, from_layer="own"),
            layers={"own": layer},
        )
