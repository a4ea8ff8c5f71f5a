"""Records of how layers were made: checks, JSON, and records of earlier versions."""

import json
from dataclasses import fields, replace

import pytest
import torch

from splatseg.core import (
    LAYER_INFO_VERSION,
    Features,
    InstanceFacts,
    InstanceTree,
    Labels,
    LayerEdit,
    LayerInfo,
    Selection,
    TreeNode,
    layer_info_from_json,
    layer_info_from_metadata,
    layer_info_to_json,
    plain_json,
    with_info,
)
from splatseg.errors import FileFormatError, InputError, RangeError

VALUES = {
    "method": "uplift",
    "options": {"candidates": 2, "sizes": [1, 2.5, None, True]},
    "evidence": "labels_semantic",
    "views": ("left/1", "left/2"),
    "views_asked": "train",
    "seed": 7,
    "versions": {"splatseg": "0.1.0"},
    "names": {0: "void", 7: "Stuhl — chair"},
    "source_ids": {1: 0, 7: 6},
    "class_of": {7: 3},
    "instances": {7: InstanceFacts(segments=9, views=2, stuff=True, details={"track": 4})},
    "cut": 0.25,
    "view_correlation": -0.5,
    "head": {"blend": "features", "ids": [1, 7]},
    "edits": (LayerEdit(name="complete", details={"inferred": 1}), LayerEdit(name="painted")),
    "details": {"largest_error_bound": 0.125},
}
"""A value of each field."""


def again(info: LayerInfo) -> LayerInfo:
    """Through a file's text and back."""
    return layer_info_from_json(json.loads(json.dumps(layer_info_to_json(info))), where="f")


def test_values_are_of_every_field() -> None:
    assert set(VALUES) == {field.name for field in fields(LayerInfo)}


@pytest.mark.parametrize("name", VALUES)
def test_every_field_comes_back_by_itself(name) -> None:
    info = LayerInfo(**{name: VALUES[name]})
    assert info != LayerInfo()
    record = layer_info_to_json(info)
    assert set(record) == {"version", name}
    assert again(info) == info
    assert getattr(again(info), name) == VALUES[name]


def test_all_fields_come_back_together() -> None:
    info = LayerInfo(**VALUES)
    assert again(info) == info
    assert layer_info_to_json(again(info)) == layer_info_to_json(info)


def test_a_record_without_a_word_is_its_version() -> None:
    assert layer_info_to_json(LayerInfo()) == {"version": LAYER_INFO_VERSION}
    assert again(LayerInfo()) == LayerInfo()


def test_none_and_nothing_differ_where_that_means_something() -> None:
    """No view at all is not the same as not known; nor are ids that are all the same."""
    for name in ("views", "source_ids"):
        empty = LayerInfo(**{name: () if name == "views" else {}})
        assert getattr(again(empty), name) is not None
        assert again(empty) == empty != LayerInfo()


def test_levels_are_cuts() -> None:
    assert again(LayerInfo(cut="part")).cut == "part"


def test_what_is_given_is_copied_as_json_gives_it_back() -> None:
    options, names = {"sizes": (1, 2)}, {3: "cup"}
    info = LayerInfo(options=options, names=names, views=["a"])  # type: ignore[arg-type]
    assert info.options == {"sizes": [1, 2]}
    assert info.views == ("a",)
    options["more"] = (3,)
    names[4] = "lamp"
    assert info == LayerInfo(options={"sizes": [1, 2]}, names={3: "cup"}, views=("a",))


def test_a_record_that_is_written_cannot_be_changed_by_what_was_written() -> None:
    info = LayerInfo(options={"a": {"b": 1}})
    layer_info_to_json(info)["options"]["a"]["b"] = 2  # type: ignore[index]
    assert info.options == {"a": {"b": 1}}


def test_edits_stand_in_the_order_they_were_made() -> None:
    info = LayerInfo(method="vote")
    assert info.edit("complete") is None
    info = info.with_edit("complete", {"inferred": 1}).with_edit("attach", {})
    info = info.with_edit("complete", {"inferred": 2})
    assert [edit.name for edit in info.edits] == ["complete", "attach", "complete"]
    assert info.edit("complete") == {"inferred": 2}
    assert info.edit("attach") == {}
    assert info.method == "vote"


@pytest.mark.parametrize(
    ("values", "error", "text"),
    [
        ({"method": 3}, InputError, "^method: expected text"),
        ({"seed": "7"}, InputError, "^seed: expected a whole number"),
        ({"views": "left"}, InputError, "^views: expected a sequence"),
        ({"options": ["a"]}, InputError, "^options: expected a mapping, got list"),
        ({"options": {1: 2}}, InputError, "^options: expected keys that are strings, got 1"),
        ({"options": {"a": float("nan")}}, InputError, "^options.a: expected a finite number"),
        ({"details": {"a": [float("inf")]}}, InputError, r"^details.a\[0\]: expected a finite"),
        ({"details": {"t": torch.ones(1)}}, InputError, "^details.t: expected a value .* Tensor"),
        ({"head": [1]}, InputError, "^head: expected a mapping, got list"),
        ({"head": {"w": {1, 2}}}, InputError, "^head.w: expected a value that JSON holds"),
        ({"versions": {"a": 1}}, InputError, r"^versions\['a'\]: expected text"),
        ({"versions": {1: "a"}}, InputError, "^versions: expected keys that are strings, got 1"),
        ({"names": {"7": "cup"}}, InputError, "^names: expected ids of 0 or more as keys, got '7'"),
        ({"names": {True: "cup"}}, InputError, "^names: expected ids of 0 or more as keys"),
        ({"names": {-1: "cup"}}, InputError, "^names: expected ids of 0 or more as keys, got -1"),
        ({"names": {7: 5}}, InputError, r"^names\[7\]: expected text"),
        ({"class_of": {1: -1}}, RangeError, r"^class_of\[1\]: expected at least 0, got -1"),
        (
            {"instances": {1: {}}},
            InputError,
            r"^instances\[1\]: expected an InstanceFacts, got a dict",
        ),
        ({"cut": "things"}, InputError, "^cut: expected one of group, object, part or a number"),
        ({"cut": 1.5}, RangeError, "^cut: expected a granularity from 0 to 1, got 1.5"),
        ({"cut": float("nan")}, RangeError, "^cut: "),
        (
            {"cut": True},
            InputError,
            "^cut: expected one of group, object, part or a number, got True",
        ),
        ({"view_correlation": 1.5}, RangeError, "^view_correlation: expected at most 1, got 1.5"),
        ({"view_correlation": float("nan")}, RangeError, "^view_correlation: "),
        ({"view_correlation": -float("inf")}, RangeError, "^view_correlation: "),
        ({"edits": ({"name": "a"},)}, InputError, r"^edits\[0\]: expected a LayerEdit, got a dict"),
        (
            {"edits": LayerEdit(name="a")},
            InputError,
            "^edits: expected a sequence, got a LayerEdit",
        ),
    ],
)
def test_what_is_no_record_is_refused(values, error, text) -> None:
    with pytest.raises(error, match=text):
        LayerInfo(**values)


@pytest.mark.parametrize(
    ("make", "error", "text"),
    [
        (lambda: InstanceFacts(segments=-1), RangeError, "^segments: expected at least 0, got -1"),
        (lambda: LayerEdit(name=""), InputError, "^name: expected what was done"),
        (lambda: LayerEdit(name="a", details={"b": object()}), InputError, "^details.b: .* object"),
    ],
)
def test_facts_and_edits_are_checked(make, error, text) -> None:
    with pytest.raises(error, match=text):
        make()


def nested(depth: int) -> list:
    value: list = []
    for _ in range(depth):
        value = [value]
    return value


def test_values_that_are_nested_too_deep_are_refused() -> None:
    assert plain_json("a", nested(100)) == nested(100)
    with pytest.raises(InputError, match="expected values at most 100 deep"):
        plain_json("a", nested(101))
    with pytest.raises(InputError, match="expected values at most 90 deep"):
        LayerInfo(details={"a": nested(90)})
    own: list = []
    own.append(own)
    with pytest.raises(InputError, match="expected values at most 100 deep"):
        plain_json("a", own)


@pytest.mark.parametrize(
    "make",
    [
        lambda info: Labels(ids=torch.tensor([1]), confidence=torch.ones(1), info=info),
        lambda info: Features(values=torch.ones(1, 2), info=info),
        lambda info: Selection(mask=torch.ones(1).bool(), info=info),
    ],
)
def test_layers_take_records_only(make) -> None:
    info = LayerInfo(method="by hand")
    layer = make(info)
    assert layer.info is info
    assert layer[:1].info is info
    assert with_info(layer, LayerInfo()).info == LayerInfo()
    with pytest.raises(InputError, match="^info: expected a LayerInfo, got a dict"):
        make({"method": "by hand"})


def test_a_tree_has_the_record_of_its_labels() -> None:
    labels = Labels(ids=torch.tensor([1]), confidence=torch.ones(1))
    tree = InstanceTree(nodes=(TreeNode(id=1, segments=4, views=3, class_id=2),), labels=labels)
    tree = with_info(tree, LayerInfo(method="associate", class_of={9: 9}))
    assert tree.info.method == tree.labels.info.method == "associate"
    cut = tree.cut(0.75).info
    assert cut.instances == {1: InstanceFacts(segments=4, views=3)}
    assert (cut.method, cut.cut, cut.class_of) == ("associate", 0.75, {1: 2})


# Files: the documented error, with the name of the file.


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"method": 3}, "method: expected text"),
        ({"views": "left"}, "views: expected a sequence"),
        ({"options": []}, "options: expected a mapping, got list"),
        ({"details": {"a": float("nan")}}, "details.a: expected a finite number, got nan"),
        ({"details": {"a": nested(200)}}, r"details.a\[0\].*: expected values at most 90 deep"),
        ({"names": ["cup"]}, "names: expected an object, got list"),
        ({"names": {"cup": "7"}}, "names: expected ids of 0 or more as keys, got 'cup'"),
        ({"names": {"07": "cup"}}, "names: expected ids of 0 or more as keys, got '07'"),
        ({"names": {"1" * 5000: "cup"}}, "names: expected ids of 0 or more as keys, got '111"),
        ({"names": {"²": "cup"}}, "names: expected ids of 0 or more as keys, got '²'"),
        ({"names": {"٣": "cup"}}, "names: expected ids of 0 or more as keys, got '٣'"),
        ({"names": {"-1": "cup"}}, "names: expected ids of 0 or more as keys, got '-1'"),
        ({"names": {"7": 5}}, r"names\[7\]: expected text"),
        ({"class_of": {"7": -2}}, r"class_of\[7\]: expected at least 0, got -2"),
        ({"instances": [{"id": 7}]}, "instances: expected an object, got list"),
        ({"instances": {"7": 3}}, r"instances\[7\]: expected an object, got int"),
        (
            {"instances": {"7": {"segments": "9"}}},
            r"instances\[7\]: segments: expected a whole number",
        ),
        ({"instances": {"7": {"size": 9}}}, r"instances\[7\]: expected segments, .*got 'size'"),
        ({"cut": "things"}, "cut: expected one of group, object, part or a number"),
        ({"cut": 2}, "cut: expected a granularity from 0 to 1, got 2"),
        ({"edits": {}}, "edits: expected a list, got dict"),
        ({"edits": ["complete"]}, r"edits\[0\]: expected an object, got str"),
        ({"edits": [{"details": {}}]}, r"edits\[0\]: name: expected what was done"),
        ({"edits": [{"name": "a", "details": 1}]}, r"edits\[0\]: details: expected a mapping"),
        ({"edits": [{"name": "a", "at": 1}]}, r"edits\[0\]: expected name, details, got 'at'"),
        ({"version": 2}, "version 1 or less, got version 2; a later splatseg wrote it"),
        ({"version": 0}, "expected a version of 1 or more, got 0"),
        ({"version": "1"}, "expected a version of 1 or more, got '1'"),
        ({"version": True}, "expected a version of 1 or more, got True"),
    ],
)
def test_wrong_types_in_files_are_refused_with_the_name_of_the_file(change, text) -> None:
    record = {"version": 1, "method": "uplift"} | change
    with pytest.raises(FileFormatError, match=f"^a.npz: info: .*{text}"):
        layer_info_from_json(record, where="a.npz: info")


def test_keys_that_this_version_does_not_know_are_kept_among_the_details() -> None:
    record = {"version": 1, "method": "m", "digest": "ab", "details": {"a": 1}}
    info = layer_info_from_json(record, where="f")
    assert info == LayerInfo(method="m", details={"a": 1, "digest": "ab"})
    assert again(info) == info
    twice = record | {"details": {"digest": "cd"}}
    with pytest.raises(FileFormatError, match="^f: digest: expected it once"):
        layer_info_from_json(twice, where="f")
    with pytest.raises(FileFormatError, match="^f: details.digest: expected a finite number"):
        layer_info_from_json(record | {"digest": float("nan")}, where="f")


# Version 0: the flat dictionary that layers had.


VERSION_0 = {
    "method": "uplift",
    "options": {"candidates": 8},
    "evidence": "labels_semantic",
    "views": ["v0", "v1"],
    "views_asked": "train",
    "seed": 0,
    "versions": {"splatseg": "0.1.0"},
    "names": {"7": "Stuhl"},
    "source_ids": {"7": 6},
    "view_correlation": 0.25,
    "background_votes": {"7": 0.5},
    "merged_ids": {"2": 5},
    "completion": {"inferred": 3},
    "confusion": {"changed": 2},
    "attached": {"found": 9},
    "sharpened": {"agreement": [0.5, 0.75]},
}


def test_labels_of_version_0() -> None:
    info = layer_info_from_json(VERSION_0, where="f")
    assert info == LayerInfo(
        method="uplift",
        options={"candidates": 8},
        evidence="labels_semantic",
        views=("v0", "v1"),
        views_asked="train",
        seed=0,
        versions={"splatseg": "0.1.0"},
        names={7: "Stuhl"},
        source_ids={7: 6},
        view_correlation=0.25,
        edits=(
            LayerEdit(name="correct_confusion", details={"changed": 2}),
            LayerEdit(name="complete", details={"inferred": 3}),
            LayerEdit(name="sharpen", details={"agreement": [0.5, 0.75]}),
            LayerEdit(name="attach", details={"found": 9}),
            LayerEdit(name="merge", details={"ids": {"2": 5}}),
        ),
        details={"background_votes": {"7": 0.5}},
    )
    assert again(info) == info
    assert layer_info_from_metadata({"view_correlation": None}, where="f") == LayerInfo()


def test_instances_of_version_0_have_one_table_for_each_thing_that_is_known() -> None:
    rows = [
        {"id": 1, "name": "cup 1", "class": 3, "segments": 4, "views": 0},
        {"id": 2, "name": "object 2", "class": 0, "segments": 2, "views": 2, "track": 8},
        {"id": 5, "name": "floor", "class": 9, "stuff": True},
    ]
    known = {"names": {"1": "cup 1", "2": "mug"}, "class_of": {"1": 3, "5": 9}}
    panoptic = {"things": 2}
    info = layer_info_from_metadata(
        known | {"instances": rows, "panoptic": panoptic, "associate": {"segments": 9}}, where="f"
    )
    assert info == LayerInfo(
        names={1: "cup 1", 2: "mug", 5: "floor"},
        class_of={1: 3, 5: 9},
        instances={
            1: InstanceFacts(segments=4, views=0),
            2: InstanceFacts(segments=2, views=2, details={"track": 8}),
            5: InstanceFacts(stuff=True),
        },
        edits=(LayerEdit(name="merge_panoptic", details=panoptic),),
        details={"associate": {"segments": 9}},
    )
    assert again(info) == info
    # The class of rows alone: what scoring went by.
    assert layer_info_from_metadata({"instances": rows}, where="f").class_of == {1: 3, 5: 9}


def test_features_and_cuts_of_version_0() -> None:
    head = {"blend": "features", "ids": [1], "weight": [[0.5]], "bias": None}
    info = layer_info_from_metadata({"head": head, "loss": 0.5, "scores": [[1, 0.5]]}, where="f")
    assert info == LayerInfo(head=head, details={"loss": 0.5, "scores": [[1, 0.5]]})
    for cut in ("part", 0.25):
        assert layer_info_from_metadata({"cut": cut}, where="f") == LayerInfo(cut=cut)


@pytest.mark.parametrize(
    "own",
    [
        {"by": "point", "clicks": [[1, 2]]},
        {"version": 3},
        {"details": {"a": 1}},
        {"edits": [1]},
        {"method": 3},
        {"options": "all"},
        {"evidence": {"a": 1}},
        {"views": 3},
        {"views": ["a", 1]},
        {"views_asked": ["train"]},
        {"seed": "x"},
        {"seed": True},
        {"versions": {"a": 1}},
        {"versions": "1"},
        {"names": ["cup"]},
        {"names": {"cup": 1}},
        {"source_ids": {"1": -1}},
        {"class_of": {"1": "cup"}},
        {"instances": 5},
        {"instances": ["odd", {"id": "x"}, {"id": -1}]},
        {"cut": "things"},
        {"cut": 2},
        {"cut": True},
        {"view_correlation": 2},
        {"view_correlation": "high"},
        {"head": [1]},
        {"confusion": "said"},
        {"completion": 3},
        {"merged_ids": [1]},
    ],
)
def test_what_splatseg_did_not_write_into_version_0_is_kept_among_the_details(own) -> None:
    info = layer_info_from_metadata({"method": "m"} | own, where="f")
    assert info.details == own
    assert replace(info, method=None, details={}) == LayerInfo()
    assert again(info) == info


def test_rows_that_are_no_instances_are_kept_beside_those_that_are() -> None:
    rows = [{"id": 1, "views": 2}, "odd", {"id": 2, "views": -2}, {"id": 1, "views": 3}]
    info = layer_info_from_metadata({"instances": rows}, where="f")
    assert info.instances == {
        1: InstanceFacts(views=3),
        2: InstanceFacts(details={"views": -2}),
    }
    assert info.details == {"instances": ["odd", {"id": 1, "views": 2}]}


def test_words_of_version_0_that_were_read_as_numbers_and_numbers_as_words() -> None:
    info = layer_info_from_metadata({"names": {"7": 5}, "class_of": {"7": "3"}}, where="f")
    assert (info.names, info.class_of) == ({7: "5"}, {7: 3})


@pytest.mark.parametrize(
    "poison",
    [
        {"a": float("nan")},
        {"seed": float("inf")},
        {"options": {"a": float("-inf")}},
        {"head": {"weight": [[float("nan")]]}},
        {"instances": [{"id": 1, "size": float("nan")}]},
        {"completion": {"inferred": float("nan")}},
        {"view_correlation": float("nan")},
        {"a": nested(200)},
    ],
)
def test_poison_in_version_0_is_refused_with_the_name_of_the_file(poison) -> None:
    with pytest.raises(FileFormatError, match=r"^a.npz: .*(finite|deep)"):
        layer_info_from_metadata(poison, where="a.npz")
