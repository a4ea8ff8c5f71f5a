"""What a scene offers to select by: masks associated on the way, features, layers; their order."""

import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from splatseg.cli import main
from splatseg.core import Features, InstanceTree, Labels, TreeNode, with_info
from splatseg.errors import InputError
from splatseg.io.scene import load_scene, load_scene_layer, save_scene_layer, scene_layer_names
from splatseg.lift.affinity import AffinityHead
from splatseg.prompting.prompts import ViewPrompt
from splatseg.tasks import SelectOptions, open_selector, select
from support.observers import Stopping


@pytest.fixture
def room(fitted_room: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(fitted_room, tmp_path / "room"))


def click(scene):
    view = scene.train_views[0]
    middle = torch.tensor([[view.camera.width / 2, view.camera.height / 2]])
    return ViewPrompt(view=view, points=middle)


def affinity(count: int) -> Features:
    from splatseg.core import LayerInfo

    values = torch.nn.functional.normalize(
        torch.stack((torch.linspace(0, 1, count), torch.linspace(1, 0, count)), 1), dim=1
    )
    return Features(
        values=values, info=LayerInfo(head=AffinityHead(channels=2, unit=True).to_json())
    )


def masks_of(room: Path) -> str:
    from splatseg.io.evidence import evidence_names, find_evidence, open_evidence

    scene = load_scene(room)
    folders = scene.evidence_folders
    names = [
        name
        for name in evidence_names(folders)
        if open_evidence(find_evidence(folders, name)).kind == "masks"
    ]
    return names[0]


def test_masks_are_associated_once_and_the_layer_is_handed_out(room) -> None:
    scene, name = load_scene(room), masks_of(room)
    options = SelectOptions(source="masks", evidence=name)
    made = select(scene, click(scene), options=options)
    assert made.source == "masks"
    assert list(made.made_layers) == [name]
    tree = made.made_layers[name]
    assert isinstance(tree, InstanceTree)
    assert scene_layer_names(room) == (), "select writes nothing"
    again = select(scene, click(scene), options=options, layers=made.made_layers)
    assert again.made_layers == {}
    assert torch.equal(again.selection.mask, made.selection.mask)
    info = again.selection.info
    assert (info.evidence, info.options["layer"]) == (name, name)


def test_the_command_keeps_the_layer_that_masks_became(room, capsys) -> None:
    name = masks_of(room)
    words = ["select", room, "--view", load_scene(room).train_views[0].name, "--point", "80,60"]
    words += ["--source", "masks", "--evidence", name, "--layer", "thing", "--json"]
    assert main([str(word) for word in words]) == 0
    assert isinstance(load_scene_layer(room, name), InstanceTree)
    assert "thing" in scene_layer_names(room)
    first = load_scene_layer(room, "thing")
    assert main([str(word) for word in words]) == 0
    assert torch.equal(load_scene_layer(room, "thing").mask, first.mask)
    capsys.readouterr()


def test_what_masks_became_is_kept_where_the_prompts_have_no_answer(room, capsys) -> None:
    name = masks_of(room)
    words = ["select", room, "--view", load_scene(room).train_views[0].name, "--point", "80,60"]
    words += ["--negative", "80,60", "--source", "masks", "--evidence", name, "--layer", "thing"]
    assert main([str(word) for word in words]) == 2
    assert "which contradict each other" in capsys.readouterr().err
    assert isinstance(load_scene_layer(room, name), InstanceTree)
    assert "thing" not in scene_layer_names(room)


def only_masks(room: Path, wanted: str, monkeypatch) -> None:
    """Let the scene have no other masks."""
    from splatseg.tasks import work as sources

    names = sources.evidence_names
    others = [name for name in ("masks_sam", "masks_nested") if name != wanted]
    monkeypatch.setattr(
        sources, "evidence_names", lambda folders: [n for n in names(folders) if n not in others]
    )


def test_trees_come_first_then_features_then_masks_and_labels_last(room, monkeypatch) -> None:
    scene = load_scene(room)
    count = len(scene.gaussians)
    labels = Labels(ids=torch.ones(count, dtype=torch.int32), confidence=torch.ones(count))
    tree = InstanceTree(nodes=(TreeNode(id=1),), labels=labels)
    layers = {"all": labels, "affinity": affinity(count), "things": tree}

    def taken(*names: str, **options) -> tuple[str, object]:
        having = {name: layers[name] for name in names}
        made = select(scene, click(scene), layers=having, options=SelectOptions(**options))
        return made.source, made.selection.info.options["layer"]

    assert taken("all", "affinity", "things") == ("layer", "things")
    assert taken("all", "affinity") == ("features", "affinity")
    assert taken("all") == ("layer", "all")
    name = masks_of(room)
    assert taken("all", "affinity", "things", evidence=name) == ("masks", name)
    with pytest.raises(InputError, match=r"sets of masks by name \(masks_nested, masks_sam\)"):
        taken()
    only_masks(room, name, monkeypatch)
    assert taken("all") == ("masks", name)


def test_each_file_is_read_once_to_choose_and_the_choice_is_said_once(room, monkeypatch) -> None:
    """Two masks and labels beside features that tell nothing: every opener of auto looks."""
    scene = load_scene(room)
    count = len(scene.gaussians)
    labels = Labels(ids=torch.arange(count).int() % 3 + 1, confidence=torch.ones(count))
    save_scene_layer(labels, room, "classes")
    save_scene_layer(Features(values=torch.ones(count, 2)), room, "plain")
    read: list[str] = []

    def counted(root, name):
        read.append(name)
        return load_scene_layer(root, name)

    monkeypatch.setattr("splatseg.tasks.work.load_scene_layer", counted)
    observer = Stopping()
    made = select(scene, click(scene), observer=observer)
    assert made.source == "layer"
    assert sorted(read) == ["classes", "classes", "plain"], "once to choose, once to use"
    assert [note for note in observer.heard if "selecting by" in note] == [
        "selecting by layer classes (see from_layer)"
    ]


def test_features_have_to_be_named_or_affinity_features(room) -> None:
    scene = load_scene(room)
    count = len(scene.gaussians)
    labels = Labels(ids=torch.ones(count, dtype=torch.int32), confidence=torch.ones(count))
    plain = {"dino": Features(values=affinity(count).values)}
    named = SelectOptions(source="features", from_layer="dino")
    assert select(scene, click(scene), layers=plain, options=named).source == "features"
    options = SelectOptions(source="features", from_layer="all")
    with pytest.raises(InputError, match="expected features, 'all' is of labels"):
        select(scene, click(scene), layers={"all": labels}, options=options)


def test_a_layer_that_is_not_there_and_a_tree_where_features_are_asked_for(room) -> None:
    scene = load_scene(room)
    count = len(scene.gaussians)
    labels = Labels(ids=torch.ones(count, dtype=torch.int32), confidence=torch.ones(count))
    layers = {"things": InstanceTree(nodes=(TreeNode(id=1),), labels=labels)}
    options = SelectOptions(source="features", from_layer="things")
    with pytest.raises(InputError, match="expected features, 'things' is of tree"):
        select(scene, click(scene), layers=layers, options=options)
    for source in ("features", "layer", "auto"):
        options = SelectOptions(source=source, from_layer="thinsg")
        with pytest.raises(InputError, match="from_layer: expected one of .* got 'thinsg'"):
            select(scene, click(scene), layers=layers, options=options)


def test_a_layer_named_decides_the_source(room) -> None:
    scene = load_scene(room)
    count = len(scene.gaussians)
    labels = Labels(ids=torch.ones(count, dtype=torch.int32), confidence=torch.ones(count))
    layers = {"all": labels, "affinity": affinity(count)}
    made = select(scene, click(scene), layers=layers, options=SelectOptions(from_layer="all"))
    assert made.source == "layer"


def test_evidence_that_is_no_masks_or_not_there_is_refused(room) -> None:
    scene = load_scene(room)
    for name, said in (("labels_semantic", "expected masks"), ("masks_sma", "masks_sma")):
        with pytest.raises(InputError, match=said):
            select(scene, click(scene), options=SelectOptions(source="masks", evidence=name))


def test_a_scene_without_anything_says_what_to_make(room) -> None:
    scene = load_scene(room)
    with pytest.raises(InputError, match="splatseg see"):
        select(scene, click(scene), options=SelectOptions(source="features"))


def test_features_of_the_scene_folder_are_found(room) -> None:
    scene = load_scene(room)
    save_scene_layer(affinity(len(scene.gaussians)), room, "affinity")
    made = select(load_scene(room), click(scene), advise=True)
    assert (made.source, made.selection.info.options["layer"]) == ("features", "affinity")
    assert "next_click" in made.seconds
    assert "next_click" not in select(load_scene(room), click(scene)).seconds


def test_features_trained_as_published_are_asked_as_published(room) -> None:
    """Section 3.4 and 3.5 by the record of the layer; both may be asked for, and refused."""
    scene = load_scene(room)
    count = len(scene.gaussians)
    own = affinity(count)
    details = {"published": True}
    paper = with_info(own, replace(own.info, method="saga", details=details))
    layers = {"own": own, "paper": paper}

    def record(layer: str, **changes: object) -> tuple[object, object, object]:
        options = SelectOptions(source="features", from_layer=layer, **changes)
        made = select(scene, click(scene), options=options, layers=layers).selection.info.options
        return made["threshold"], made.get("post_processing"), made["steps"]

    every = ["filter", "grow", "refine", "fill_holes", "hidden"]
    assert record("own") == ("fixed", None, every)
    assert record("paper") == ("adaptive", "published", ["filter", "grow"])
    assert record("paper", post_processing="none") == ("adaptive", None, [])
    assert record("own", threshold="adaptive") == ("adaptive", None, every)
    assert record("paper", post_processing="full", threshold="fixed") == ("fixed", None, every)
    assert record("own", post_processing="published")[1:] == ("published", ["filter", "grow"])
    tree = SelectOptions(post_processing="published", from_layer="all")
    labels = Labels(ids=torch.ones(count, dtype=torch.int32), confidence=torch.ones(count))
    with pytest.raises(InputError, match="post_processing: expected a source of features"):
        select(scene, click(scene), options=tree, layers={"all": labels})
    with pytest.raises(InputError, match="threshold: expected"):
        SelectOptions(threshold="some")
    with pytest.raises(InputError, match="post_processing: expected"):
        SelectOptions(post_processing="some")
    session = open_selector(
        scene, options=SelectOptions(source="features", from_layer="own"), layers=layers
    )
    other = SelectOptions(source="features", from_layer="own", threshold="adaptive")
    with pytest.raises(InputError, match="threshold: expected 'auto' as the session"):
        session.select([click(scene)], options=other)


def test_thresholds_change_what_is_selected(room) -> None:
    """Of features of one direction each but for noise: the mean is below 0.85."""
    scene = load_scene(room)
    count = len(scene.gaussians)
    angles = torch.linspace(0, 3, count)
    values = torch.stack((angles.cos(), angles.sin()), dim=1)
    layers = {"own": Features(values=values, info=affinity(count).info)}

    def selected(rule: str) -> int:
        options = SelectOptions(
            source="features", from_layer="own", threshold=rule, post_processing="none"
        )
        return select(scene, click(scene), options=options, layers=layers).selection.count

    assert selected("adaptive") > selected("fixed")
