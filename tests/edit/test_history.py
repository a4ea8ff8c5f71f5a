"""Documents, their histories, and the operations as values that JSON holds."""

import json
import math

import pytest
import torch

from splatseg.core import (
    Features,
    Labels,
    LayerInfo,
    Scene,
    Selection,
    Similarity,
    View,
)
from splatseg.edit import (
    CutBy,
    Document,
    Operation,
    Recolour,
    apply,
    load_document,
    merge,
    merged_layers,
    prepare,
    replay,
    save_document,
    undo,
)
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.io.scene import load_scene
from splatseg.lift import CutOptions
from splatseg.lift.boundaries import cut
from splatseg.render import render
from splatseg.selection import Where, ids_named, select_where

from .conftest import BACKEND, camera, layers_of, random_gaussians
from .test_operations import same, turned


@pytest.fixture
def document(rng, some) -> Document:
    views = tuple(View(name=f"v{i}", camera=camera(turn=0.3 * i), depth_unit=0.5) for i in range(3))
    scene = Scene(
        gaussians=some,
        views=views,
        up=(0.0, 0.0, 1.0),
        metres_per_unit=2.0,
        provenance={"command": "fit"},
    )
    return Document(scene=scene, layers=layers_of(rng, len(some)))


def with_number(document: Document) -> Document:
    """The same, with the number of each row as a layer too."""
    numbers = document.scene.gaussians.extra["number"].float()[:, None]
    return Document(
        scene=document.scene, layers={**document.layers, "number": Features(values=numbers)}
    )


OBJECT = Where(layer="objects", ids=(3,))
EVERY = [
    Operation(kind="extract", where=Where(layer="objects", ids=(2, 3, 4))),
    Operation(kind="remove", where=OBJECT),
    Operation(kind="duplicate", where=OBJECT, transform=turned(shift=(1.0, 0.0, 0.0))),
    Operation(kind="transform", where=OBJECT, transform=turned(scale=1.5)),
    Operation(kind="transform", transform=turned(scale=0.5, shift=(0.0, 2.0, 0.0))),
    Operation(kind="recolour", where=OBJECT, recolour=Recolour(colour=(1.0, 0.0, 0.5))),
    Operation(kind="recolour", recolour=Recolour(scale=(0.5, 1.0, 1.0), view_dependent=False)),
    Operation(
        kind="remove",
        where=Where(box=(-0.5, -0.5, -0.5, 0.5, 0.5, 0.5)),
        cut=CutBy(by="box", options=CutOptions(min_pixels=0)),
    ),
    Operation(
        kind="extract",
        where=OBJECT,
        cut=CutBy(by="layer", views=("v0", "v2"), options=CutOptions(min_pixels=0)),
    ),
    Operation(
        kind="split",
        where=Where(layer="picked", box=(-1.0, -1.0, -1.0, 0.0, 0.5, 0.5), invert=True),
        cut=CutBy(by="layer", views=("v1",), options=CutOptions(min_pixels=0)),
    ),
]


@pytest.mark.parametrize("operation", EVERY, ids=lambda o: o.kind)
def test_an_operation_survives_json(operation) -> None:
    text = json.dumps(operation.to_json(), allow_nan=False)
    back = Operation.from_json(json.loads(text))
    assert back.to_json() == operation.to_json()
    assert back.where == operation.where
    assert back.recolour == operation.recolour
    assert back.cut == operation.cut


@pytest.mark.parametrize("operation", EVERY, ids=lambda o: o.kind)
def test_layers_stay_in_step_with_every_operation(document, operation) -> None:
    after = apply(with_number(document), operation, backend=BACKEND)
    number = after.layers["number"].values[:, 0].long()
    assert torch.equal(number, after.scene.gaussians.extra["number"])
    colours = document.layers["colours"].values[number]
    assert torch.equal(after.layers["colours"].values, colours)
    objects = after.layers["objects"]
    assert objects.background == 7
    whole = torch.bincount(number, minlength=24)[number] == 1
    kept = objects.ids == document.layers["objects"].ids[number]
    assert bool(kept[whole].all()), "only parts of what was split may change their label"


def test_a_history_gives_the_same_scene_again(document, tmp_path) -> None:
    save_document(document, tmp_path / "start")
    now = start = load_document(tmp_path / "start")
    boxed = Operation(
        kind="remove",
        where=Where(box=(-9.0, -9.0, -9.0, 0.1, 9.0, 9.0)),
        cut=CutBy(by="box", options=CutOptions(min_pixels=0)),
    )
    steps = [EVERY[2], EVERY[8], EVERY[3], EVERY[6], EVERY[4], boxed]
    states = [now]
    for operation in steps:
        now = apply(now, operation, backend=BACKEND)
        states.append(now)
    assert [edit["kind"] for edit in now.history] == [step.kind for step in steps]
    save_document(now, tmp_path / "end")
    told = json.loads((tmp_path / "end" / "scene.json").read_text())["provenance"]["edits"]
    assert told == json.loads(json.dumps(list(now.history)))
    again = replay(load_document(tmp_path / "start"), told, backend=BACKEND)
    same(again.scene.gaussians, now.scene.gaussians)
    assert again.history == now.history
    for name, layer in now.layers.items():
        for column in ("ids", "confidence", "evidence", "values", "weights", "mask"):
            if getattr(layer, column, None) is not None:
                assert torch.equal(getattr(layer, column), getattr(again.layers[name], column))
    back = undo(load_document(tmp_path / "start"), now, backend=BACKEND)
    same(back.scene.gaussians, states[-2].scene.gaussians)
    assert back.history == states[-2].history
    assert back.scene.provenance["command"] == "fit"
    with pytest.raises(InputError, match="undo: expected a scene with an edit, got one without"):
        undo(start, start)


def test_a_whole_scene_moves_with_its_cameras(document) -> None:
    move = turned(scale=0.5, shift=(0.0, 2.0, 0.0))
    after = apply(document, Operation(kind="transform", transform=move), backend=BACKEND).scene
    for before, view in zip(document.scene.views, after.views, strict=True):
        was = render(document.scene.gaussians, before.camera, backend=BACKEND).image
        now = render(after.gaussians, view.camera, backend=BACKEND).image
        assert float((was - now).abs().max()) < 2e-3
        assert view.depth_unit == 0.25
    assert after.metres_per_unit == 4.0
    torch.testing.assert_close(
        torch.tensor(after.up).double(), move.rotation @ torch.tensor([0.0, 0, 1]).double()
    )


def test_parts_take_the_label_of_their_side(rng, monkeypatch) -> None:
    """A long Gaussian of object 1 reaches into object 2: its far part becomes 2."""
    for name, value in (("_ROUNDS", 1), ("_MIN_WEIGHT", 0), ("BORDER_WEIGHT", 1)):
        monkeypatch.setattr(cut, name, value)
    from .test_cut import gaussians_at

    row = gaussians_at(
        [[-0.9, 0, 0], [-0.25, 0, 0], [0.5, 0, 0], [1.1, 0, 0]],
        [[0.3, 0.3, 0.3], [0.5, 0.2, 0.2], [0.3, 0.3, 0.3], [0.3, 0.3, 0.3]],
    )
    row = row.replace(opacities=torch.tensor([0.8, 0.4, 0.8, 0.8]))
    ids = torch.tensor([1, 1, 2, 2]).int()
    views = (View(name="a", camera=camera()), View(name="b", camera=camera(turn=0.1)))
    soft = Labels(
        ids=ids,
        confidence=torch.full((4,), 0.7),
        candidates=torch.stack((ids, 3 - ids), dim=1),
        shares=torch.tensor([[0.7, 0.3]]).expand(4, 2).clone(),
    )
    hard = Labels(ids=ids, confidence=torch.full((4,), 0.7))
    picked = Selection(mask=ids == 1)
    document = Document(
        scene=Scene(gaussians=row, views=views),
        layers={"soft": soft, "hard": hard, "picked": picked},
    )
    options = CutOptions(min_pixels=0)
    for layer, wanted in (("soft", (1,)), ("hard", (1,)), ("picked", ())):
        operation = Operation(
            kind="split",
            where=Where(layer=layer, ids=wanted),
            cut=CutBy(by="layer", views=("a", "b"), options=options),
        )
        ready = prepare(document, operation, backend=BACKEND)
        assert ready.split >= 1
        after = apply(document, operation, prepared=ready, backend=BACKEND)
        gaussians, changed = after.scene.gaussians, after.layers[layer]
        far = (gaussians.means[:, 0] > 0.1) & (gaussians.means[:, 0] < 0.4)
        assert int(far.sum()) == 1, "the far part of the long one"
        if isinstance(changed, Selection):
            assert not bool(changed.mask[far])
        else:
            assert int(changed.ids[far]) == (2 if layer == "soft" else -1)
            assert torch.equal(ready.selection.mask, changed.ids == 1)
        if layer == "soft":
            assert int(changed.candidates[far][0, 0]) == 2
            assert changed.candidates[far][0].tolist() == [2, -1]


def test_merged_ids_keep_out_of_each_others_way(rng, some) -> None:
    own = Labels(
        ids=torch.tensor([1, 2] * 12).int(),
        confidence=torch.ones(24),
        info=LayerInfo(names={1: "floor", 2: "cup"}),
    )
    ids = torch.tensor([1, 2, 3, 4]).int()
    other = Labels(
        ids=ids,
        confidence=torch.ones(4),
        candidates=torch.stack((ids, torch.tensor([2, -1, -1, -1]).int()), dim=1),
        shares=torch.tensor([[1.0, 0.0]]).expand(4, 2).clone(),
        info=LayerInfo(names={1: "floor", 2: "plate", 3: "cup"}),
    )
    edited = merge(some, random_gaussians(rng, 4))
    joined = merged_layers({"objects": own}, {"objects": other}, edited)["objects"]
    # 1 is the same thing in both, 2 is not, 3 and 4 are free.
    assert joined.ids[24:].tolist() == [1, 5, 3, 4]
    assert joined.info.names == {1: "floor", 2: "cup", 5: "plate", 3: "cup"}
    assert joined.info.edit("merge") == {"ids": {"2": 5}}
    assert joined.candidates[24].tolist() == [1, 5]
    assert joined.candidates[1].tolist() == [2, -1]
    assert joined.shares[1].tolist() == [1.0, 0.0]
    assert torch.equal(joined.ids[:24], own.ids)


def test_merged_layers_that_only_one_scene_has(rng, some) -> None:
    layers = layers_of(rng, 24)
    others = {name: layer[:4] for name, layer in layers.items()}
    edited = merge(some, some[:4])
    both = merged_layers(layers, {"more": others["picked"], "colours": others["colours"]}, edited)
    assert set(both) == {"objects", "colours", "picked", "more"}
    assert not both["picked"].mask[24:].any()
    assert torch.equal(both["more"].mask[24:], layers["picked"].mask[:4])
    assert not both["more"].mask[:24].any()
    assert torch.equal(both["colours"].values[24:], layers["colours"].values[:4])
    assert torch.equal(both["colours"].weights[24:], layers["colours"].weights[:4])
    with pytest.raises(InputError, match="layer 'picked': expected the same kind"):
        merged_layers(layers, {"picked": others["objects"]}, edited)


def test_a_merge_reads_the_other_scene(document, rng, tmp_path) -> None:
    other = Document(
        scene=Scene(gaussians=random_gaussians(rng, 5)),
        layers={"objects": Labels(ids=torch.full((5,), 3).int(), confidence=torch.ones(5))},
    )
    save_document(other, tmp_path / "other")
    operation = Operation(
        kind="merge", other=str(tmp_path / "other"), transform=turned(shift=(3.0, 0.0, 0.0))
    )
    after = apply(document, operation, backend=BACKEND)
    moved = other.scene.gaussians.transformed(turned(shift=(3.0, 0.0, 0.0)))
    torch.testing.assert_close(after.scene.gaussians.means[24:], moved.means)
    assert after.layers["objects"].ids[24:].tolist() == [6] * 5  # 3 is another thing here
    assert after.scene.views == document.scene.views
    assert after.history[-1]["result"] == {"before": 24, "after": 29, "split": 0, "added": 0}


def test_what_is_selected(document) -> None:
    gaussians, layers = document.scene.gaussians, document.layers
    box = (-1.0, -1.0, -1.0, 0.0, 1.0, 1.0)
    left = gaussians.means[:, 0] <= 0
    three = layers["objects"].ids == 3
    picked = layers["picked"].mask
    for where, expected in (
        (OBJECT, three),
        (Where(layer="picked"), picked),
        (Where(box=box), left),
        (Where(layer="objects", ids=(3,), box=box), three & left),
        (Where(layer="picked", box=box, invert=True), ~(picked & left)),
    ):
        assert torch.equal(select_where(gaussians, layers, where).mask, expected)
    assert ids_named(layers["objects"], ["chair"]) == (3,)
    with pytest.raises(InputError, match=r"names: expected names of the layer \(chair\), got 'x'"):
        ids_named(layers["objects"], ["x"])


@pytest.mark.parametrize(
    ("where", "message"),
    [
        (Where(layer="objects", ids=(3, 99)), "has no Gaussian with id 99; it has 1, 2, 3, 4, 5"),
        (Where(layer="objects"), "expected at least one id of layer 'objects'"),
        (Where(layer="picked", ids=(1,)), "layer 'picked' is a selection, which has no ids"),
        (Where(layer="colours"), "expected labels or a selection, got features"),
        (
            Where(layer="none"),
            r"expected one of the scene \(objects, colours, picked\), got 'none'",
        ),
        (Where(box=(5.0, 5.0, 5.0, 6.0, 6.0, 6.0)), "expected at least one Gaussian, got none of"),
    ],
)
def test_what_is_not_there_is_refused(document, where, message) -> None:
    with pytest.raises(InputError, match=message):
        apply(document, Operation(kind="remove", where=where))


def test_masks_are_refused_after_things_moved(document) -> None:
    moved = apply(document, EVERY[3], backend=BACKEND)
    cut = CutBy(by="masks", evidence="labels", views=("v0",))
    with pytest.raises(InputError, match="the masks show the scene before it was edited"):
        apply(moved, Operation(kind="remove", where=OBJECT, cut=cut), backend=BACKEND)


@pytest.mark.parametrize(
    ("content", "error", "message"),
    [
        ({"kind": "explode"}, InputError, "expected one of extract, remove"),
        ({"kind": "remove"}, InputError, "remove: expected where, got none"),
        ({"kind": "merge", "other": 3}, InputError, "other: expected .*, got 3"),
        ({"kind": "remove", "where": {"layer": "a"}, "other": "b"}, InputError, "takes no other"),
        ({"kind": "remove", "where": {"layer": "a", "x": 1}}, InputError, "got 'x'"),
        (
            {"kind": "remove", "where": {"box": [0, 0, 0]}},
            InputError,
            "box: expected a list of length 6",
        ),
        ({"kind": "remove", "where": {"ids": [1]}}, InputError, "or another condition"),
        (
            {"kind": "remove", "where": {"layer": "a", "ids": [1.5]}},
            InputError,
            "whole number, got 1.5",
        ),
        (
            {"kind": "remove", "where": {"layer": "a"}, "specks": 1.5},
            InputError,
            "specks: .* got 1.5",
        ),
        ({"kind": "remove", "where": {"layer": "a"}, "specks": -1}, RangeError, "at least 0"),
        ({"kind": "extract", "where": {"layer": "a"}, "specks": 9}, InputError, "takes no specks"),
        ({"kind": "remove", "where": 3}, InputError, "where: expected an object or null, got 3"),
        ({"kind": "remove", "why": 3}, InputError, "expected the keys of an edit, got 'why'"),
        (
            {"kind": "transform", "transform": {"rotation": [[1, 0, 0]], "translation": [0, 0, 0]}},
            InputError,
            "rotation: expected a list of length 3",
        ),
        (
            {
                "kind": "transform",
                "transform": {
                    "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
                    "translation": [0, math.nan, 0],
                },
            },
            InputError,
            r"translation\[1\]: expected a finite number up to 1e\+30, got nan",
        ),
        (
            {
                "kind": "transform",
                "transform": {
                    "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
                    "translation": [0, 0, 0],
                    "scale": 0,
                },
            },
            RangeError,
            "scale: expected more than 0, got 0",
        ),
        (
            {"kind": "recolour", "recolour": {"colour": [1, 2]}},
            InputError,
            "colour: expected a list of length 3",
        ),
        (
            {"kind": "split", "where": {"layer": "a"}, "cut": {"by": "hand"}},
            InputError,
            "cut.by: .* got 'hand'",
        ),
        (
            {
                "kind": "split",
                "where": {"layer": "a"},
                "cut": {"by": "box", "options": {"min_side": True}},
            },
            InputError,
            "min_side: expected a number, got True",
        ),
    ],
)
def test_a_hostile_history_is_refused(content, error, message) -> None:
    with pytest.raises(error, match=message):
        Operation.from_json(content)


def test_documents_are_written_once_and_in_step(document, tmp_path) -> None:
    saved = save_document(document, tmp_path / "a")
    assert saved.scene.root == tmp_path / "a"
    back = load_document(tmp_path / "a")
    assert list(back.layers) == sorted(document.layers)
    assert torch.equal(back.layers["objects"].ids, document.layers["objects"].ids)
    with pytest.raises(InputError, match="expected a new folder, got one that is there"):
        save_document(document, tmp_path / "a")
    with pytest.raises(ShapeError, match=r"layers\['picked'\]: expected 23 rows"):
        Document(
            scene=Scene(gaussians=document.scene.gaussians[:23]),
            layers={"picked": document.layers["picked"]},
        )
    bad = Document(scene=document.scene, layers={"no/name": document.layers["picked"]})
    with pytest.raises(InputError, match="expected a name of letters"):
        save_document(bad, tmp_path / "b")
    assert not (tmp_path / "b").exists()
    zero = Labels(ids=torch.zeros(24).int(), confidence=torch.ones(24))
    with pytest.raises(InputError, match="got 0, which is void"):
        save_document(Document(scene=document.scene, layers={"zero": zero}), tmp_path / "c")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a"]
    assert len(load_scene(tmp_path / "a").gaussians) == 24


def test_a_similarity_stays_exact_in_a_history() -> None:
    move = Similarity(
        rotation=turned(0.1234567).rotation,
        translation=torch.tensor([1 / 3, 2 / 3, 1e-17], dtype=torch.float64),
        scale=1 / 7,
    )
    content = json.loads(json.dumps(Operation(kind="transform", transform=move).to_json()))
    back = Operation.from_json(content).transform
    assert torch.equal(back.rotation, move.rotation)
    assert torch.equal(back.translation, move.translation)
    assert back.scale == move.scale


def test_a_wrong_name_is_answered_with_those_most_like_it() -> None:
    """Of more names than a sentence holds, those that share words come first."""
    names = {i: f"book {i}" for i in range(1, 12)} | {12: "navy train on the table"}
    labels = Labels(
        ids=torch.arange(1, 13).int(), confidence=torch.ones(12), info=LayerInfo(names=names)
    )
    with pytest.raises(InputError) as caught:
        ids_named(labels, ["Train"])
    told = str(caught.value)
    assert told.startswith("names: expected names of the layer (navy train on the table, book 1, ")
    assert told.endswith(", ...), got 'Train'.")
    assert told.count("book") == 7
    with pytest.raises(InputError, match=r"\(book 2, book 1, book 10"):
        ids_named(labels, ["2"])
