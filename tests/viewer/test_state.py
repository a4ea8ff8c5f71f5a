"""Commands and what they make of a document; undo and redo of any sequence of them."""

import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from splatseg.errors import InputError
from splatseg.report.colours import colour_of
from splatseg.viewer._journal import command_from_json, command_to_json
from splatseg.viewer._masks import MaskStore
from splatseg.viewer._state import (
    COMMANDS,
    Command,
    Document,
    History,
    apply,
    changed_keys,
    checked_name,
    free_name,
    keys_of,
    label_of,
    mean_confidence,
)
from splatseg.viewer.commands import (
    Accept,
    Apply,
    Delete,
    Edit,
    Isolate,
    Join,
    Keep,
    Mask,
    Refine,
    Reject,
    Rename,
    Select,
    SetClass,
    SetColour,
    SetLocked,
    SetVisible,
    Split,
    Subtract,
    Suggest,
    Suggestion,
)
from support.viewing import COUNT, commands, content, put, steps, stored, take


@pytest.fixture
def masks() -> MaskStore:
    return MaskStore(COUNT)


@pytest.fixture
def three(masks: MaskStore) -> Document:
    """Three objects: mug of rows 0 to 3, lamp of 4 to 7, chair of 8 to 11."""
    document = Document()
    for i, name in enumerate(("mug", "lamp", "chair")):
        rows = range(4 * i, 4 * i + 4)
        document = done(document, masks, Select(put(masks, *rows), {"source": "layer a"}))
        document = done(document, masks, Keep(name))
    return document


def done(document: Document, masks: MaskStore, *given: Command) -> Document:
    for command in given:
        after = apply(document, command, masks)
        assert after.revision == document.revision + 1
        document = after
    return document


def members(document: Document, masks: MaskStore, id: int) -> list[int]:
    return np.nonzero(masks.get(document.object(id).mask) >= 128)[0].tolist()


def names(document: Document) -> list[str]:
    return [one.name for one in document.objects]


def test_the_state_loads_no_torch_and_no_network() -> None:
    code = (
        "import sys, numpy as np\n"
        "from splatseg.viewer._state import Document, apply, History\n"
        "from splatseg.viewer.commands import Select, Keep\n"
        "from splatseg.viewer._masks import MaskStore\n"
        "masks = MaskStore(3)\n"
        "mask = masks.put(np.array([0, 255, 0], np.uint8))\n"
        "kept = apply(apply(Document(), Select(mask), masks), Keep('mug'), masks)\n"
        "assert kept.objects[0].name == 'mug'\n"
        "heavy = {'torch', 'socket', 'starlette', 'uvicorn', 'websockets', 'PIL', 'scipy'}\n"
        "print(sorted(heavy & set(sys.modules)))\n"
    )
    made = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert made.stdout.strip() == "[]"


def test_keeping_makes_an_object_of_the_selection_and_clears_it(masks) -> None:
    mask = masks.put(np.array([255] * 3 + [128] + [127] * 8, np.uint8))
    document = done(Document(), masks, Select(mask, {"source": "layer masks"}))
    assert document.selection == mask
    assert document.prompt == {"source": "layer masks"}
    document = done(document, masks, Keep(" mug ", "cup"))
    (mug,) = document.objects
    assert (mug.id, mug.name, mug.class_name) == (1, "mug", "cup")
    assert (mug.visible, mug.locked) == (True, False)
    assert (mug.source, mug.mask) == ("layer masks", mask)
    assert mug.colour == colour_of(1)
    assert mug.confidence == pytest.approx((3 * 255 + 128) / 4 / 255, abs=1e-6)
    assert document.selection is None
    assert document.prompt is None
    with pytest.raises(InputError, match="keep: expected a selection"):
        apply(document, Keep("lamp"), masks)


def test_names_that_are_taken_get_numbers_and_missing_ones_are_made_up(masks, three) -> None:
    mask = put(masks, 1)
    document = three
    for name in ("mug", "mug", "", ""):
        document = done(document, masks, Select(mask), Keep(name))
    assert names(document)[3:] == ["mug 2", "mug 3", "object 6", "object 7"]
    long = "x" * 80
    document = done(document, masks, Select(mask), Keep(long), Select(mask), Keep(long))
    assert names(document)[-2:] == [long, "x" * 78 + " 2"]


def test_ids_are_never_used_twice(masks, three) -> None:
    document = done(three, masks, Delete((3, 2)), Select(put(masks, 5)), Keep("new"))
    assert [one.id for one in document.objects] == [1, 4]
    assert document.object(4).colour == colour_of(4)


def test_an_empty_mask_selects_nothing(masks) -> None:
    document = done(Document(), masks, Select(put(masks, 1)), Select(put(masks), {"a": 1}))
    assert document.selection is None
    assert document.prompt is None
    assert done(document, masks, Select(None)).selection is None


@pytest.mark.parametrize(
    "name",
    ["", "  ", "a/b", "a\\b", ".", "..", "x" * 81, "a\nb", "a\x1bb", "a\u202eb", "\u200b"],
)
def test_bad_names_are_refused(masks, three, name) -> None:
    with pytest.raises(InputError, match="^name: expected"):
        apply(three, Rename(1, name), masks)
    with pytest.raises(InputError, match="^class_name: expected"):
        checked_name(name, "class_name")


@pytest.mark.parametrize("name", ["x" * 80, "椅子", "<b>&amp;", "a. b", "mug 2", "🫖"])
def test_good_names_are_taken(masks, three, name) -> None:
    assert apply(three, Rename(2, f" {name} "), masks).object(2).name == name
    assert checked_name(name) == name


def test_renaming_keeps_names_apart(masks, three) -> None:
    with pytest.raises(InputError, match="another object is called 'lamp'"):
        apply(three, Rename(1, "lamp"), masks)
    assert names(done(three, masks, Rename(1, "mug"), Rename(3, "sofa"))) == ["mug", "lamp", "sofa"]


def test_properties_of_several_objects(masks, three) -> None:
    document = done(
        three,
        masks,
        SetClass((1, 3), "thing"),
        SetColour((2, 3), (1, 2, 3)),
        SetVisible((1, 2), False),
        SetLocked((3,), True),
    )
    assert [one.class_name for one in document.objects] == ["thing", "", "thing"]
    assert [one.colour == (1, 2, 3) for one in document.objects] == [False, True, True]
    assert [one.visible for one in document.objects] == [False, False, True]
    assert [one.locked for one in document.objects] == [False, False, True]
    assert done(document, masks, SetClass((1,), " ")).object(1).class_name == ""


def test_locked_objects_are_refused_what_would_change_them(masks, three) -> None:
    document = done(three, masks, SetLocked((1,), True))
    mask = put(masks, 0)
    for command in (
        Rename(1, "a"),
        SetClass((2, 1), "a"),
        SetColour((1,), (0, 0, 0)),
        Join((2, 1)),
        Split(1, (put(masks, 0), put(masks, 1, 2, 3)), ("a", "b")),
        Subtract(1, mask),
        Refine(1, mask),
        Delete((2, 1)),
    ):
        with pytest.raises(InputError, match="mug: it is locked; unlock it first"):
            apply(document, command, masks)
    shown = done(document, masks, SetVisible((1,), False), Isolate((1,)), SetLocked((1,), False))
    assert done(shown, masks, Rename(1, "a")).object(1).name == "a"


@pytest.mark.parametrize(
    "command",
    [
        Rename(9, "a"), SetClass((1, 9), "a"), SetColour((9,), (0, 0, 0)), SetVisible((9,), True),
        SetLocked((9,), True), Isolate((9,)), Join((1, 9)), Delete((9,)),
    ],
)  # fmt: skip
def test_an_unknown_object_is_said(masks, three, command) -> None:
    with pytest.raises(InputError, match="object: there is none with the id 9"):
        apply(three, command, masks)


def test_commands_of_no_object_are_refused(masks, three) -> None:
    for command in (SetClass((), "a"), SetVisible((), True), Delete(()), Join(())):
        with pytest.raises(InputError, match="ids: expected at least one object"):
            apply(three, command, masks)
    for command in (Accept(()), Reject(())):
        with pytest.raises(InputError, match="ids: expected at least one suggestion"):
            apply(three, command, masks)


@pytest.mark.parametrize(
    "colour", [(0, 0), (0, 0, 256), (-1, 0, 0), (0.5, 0, 0), (True, 0, 0), (0, 0, 0, 0)]
)
def test_bad_colours_are_refused(masks, three, colour) -> None:
    with pytest.raises(InputError, match="colour: expected red, green, blue"):
        apply(three, SetColour((1,), colour), masks)
    selected = done(three, masks, Select(put(masks, 1)))
    with pytest.raises(InputError, match="colour: expected red, green, blue"):
        apply(selected, Keep("a", "", colour), masks)


def test_masks_that_no_store_has_are_refused(masks, three) -> None:
    other = Mask(id="0" * 32, count=1)
    suggestion = Suggestion(id=0, name="a", mask=other, score=1)
    for command in (
        Select(other),
        Subtract(1, other),
        Refine(1, other),
        Split(1, (other, other), ("a", "b")),
        Suggest((suggestion,)),
        Apply(Edit(kind="remove", mask=other)),
    ):
        with pytest.raises(InputError, match="mask: expected one that was stored"):
            apply(three, command, masks)


def test_isolation_ends_and_follows_its_objects(masks, three) -> None:
    document = done(three, masks, Isolate((3, 1)))
    assert document.isolated == (3, 1)
    assert done(document, masks, Delete((3,))).isolated == (1,)
    assert done(document, masks, Join((2, 3))).isolated == (1,)
    assert done(document, masks, Isolate(())).isolated == ()
    parts = (put(masks, 8), put(masks, 9, 10, 11))
    assert done(document, masks, Split(3, parts, ("a", "b"))).isolated == (3, 1, 4)
    others = (put(masks, 4), put(masks, 5, 6, 7))
    assert done(document, masks, Split(2, others, ("a", "b"))).isolated == (3, 1)


def test_joining_keeps_the_first_with_what_either_is_surest_of(masks) -> None:
    one = masks.put(np.array([255, 200, 100, 0] + [0] * 8, np.uint8))
    other = masks.put(np.array([0, 210, 120, 130] + [0] * 8, np.uint8))
    document = done(Document(), masks, Select(one), Keep("a"), Select(other), Keep("b"))
    joined = done(document, masks, Join((2, 1)))
    assert [(o.id, o.name) for o in joined.objects] == [(2, "b")]
    assert masks.get(joined.objects[0].mask)[:4].tolist() == [255, 210, 120, 130]
    assert joined.objects[0].confidence == pytest.approx((255 + 210 + 130) / 3 / 255, abs=1e-6)
    assert names(done(document, masks, Join((1, 2), "b"))) == ["b"]
    with pytest.raises(InputError, match="two objects or more, got 1"):
        apply(document, Join((1, 1)), masks)


def test_joining_refuses_the_name_of_a_third(masks, three) -> None:
    with pytest.raises(InputError, match="another object is called 'chair'"):
        apply(three, Join((1, 2), "chair"), masks)


def test_splitting_puts_the_parts_in_its_place(masks, three) -> None:
    parts = (put(masks, 4), put(masks, 5, 6), put(masks, 7, sure=128))
    document = done(three, masks, Select(put(masks, 1)), Split(2, parts, ("lamp", "foot", "c")))
    assert [(o.id, o.name) for o in document.objects] == [
        (1, "mug"), (2, "lamp"), (4, "foot"), (5, "c"), (3, "chair"),
    ]  # fmt: skip
    assert [o.mask for o in document.objects[1:4]] == list(parts)
    assert document.object(2).colour == three.object(2).colour
    assert document.object(5).colour == colour_of(5)
    assert document.object(5).confidence == pytest.approx(128 / 255, abs=1e-6)
    assert document.next_id == 6


@pytest.mark.parametrize(
    ("rows", "names", "said"),
    [
        (((4, 5), (6,)), ("a", "b"), "share out"),
        (((4, 5), (5, 6, 7)), ("a", "b"), "share out"),
        (((4, 5), (6, 7, 8)), ("a", "b"), "share out"),
        (((4, 5, 6, 7), ()), ("a", "b"), "no part empty"),
        (((4, 5, 6, 7),), ("a",), "two parts or more"),
        (((4, 5), (6, 7)), ("a",), "a name for each"),
        (((4, 5), (6, 7)), ("a", "a"), "names that differ"),
        (((4, 5), (6, 7)), ("a", "chair"), "another object is called"),
        (((4, 5), (6, 7)), ("a", "b/c"), "no slash"),
    ],
)
def test_parts_that_do_not_share_out_an_object_are_refused(masks, three, rows, names, said) -> None:
    parts = tuple(put(masks, *own) for own in rows)
    with pytest.raises(InputError, match=said):
        apply(three, Split(2, parts, names), masks)


def test_subtracting_and_refining_change_the_mask(masks, three) -> None:
    document = done(three, masks, Subtract(1, put(masks, 0, 1, 9, sure=200)))
    assert masks.get(document.object(1).mask)[:4].tolist() == [55, 55, 255, 255]
    assert document.object(1).confidence == 1
    document = done(document, masks, Refine(1, put(masks, 11, sure=130)))
    assert members(document, masks, 1) == [11]
    assert document.object(1).confidence == pytest.approx(130 / 255, abs=1e-6)
    for command in (Subtract(2, put(masks, *range(12))), Refine(2, put(masks))):
        with pytest.raises(InputError, match="lamp: nothing would be left of it"):
            apply(three, command, masks)


def test_suggestions_are_accepted_and_rejected(masks, three) -> None:
    made = tuple(
        Suggestion(id=i, name=name, mask=put(masks, i), score=0.25 * i)
        for i, name in enumerate((" mug", "mug", "plant"))
    )
    document = done(three, masks, Suggest(made))
    assert [one.name for one in document.suggestions] == ["mug", "mug", "plant"]
    document = done(document, masks, Accept((1, 0)))
    assert [(o.id, o.name, o.source) for o in document.objects[3:]] == [
        (4, "mug 2", "suggestion"), (5, "mug 3", "suggestion"),
    ]  # fmt: skip
    assert [o.mask for o in document.objects[3:]] == [made[1].mask, made[0].mask]
    assert [o.confidence for o in document.objects[3:]] == [0.25, 0]
    assert [o.colour for o in document.objects[3:]] == [colour_of(4), colour_of(5)]
    assert [one.id for one in document.suggestions] == [2]
    assert document.next_id == 6
    with pytest.raises(InputError, match="suggestion: there is none with the id 1 any more"):
        apply(document, Accept((2, 1)), masks)
    with pytest.raises(InputError, match="suggestion: there is none with the id 0 any more"):
        apply(document, Reject((0,)), masks)
    assert done(document, masks, Reject((2,))).suggestions == ()
    assert done(document, masks, Suggest(())).suggestions == ()


def test_bad_suggestions_are_refused(masks) -> None:
    good = Suggestion(id=0, name="a", mask=put(masks, 0), score=1)
    empty = Suggestion(id=1, name="a", mask=put(masks), score=1)
    sure = Suggestion(id=1, name="a", mask=put(masks, 0), score=1.5)
    unsure = Suggestion(id=1, name="a", mask=put(masks, 0), score=float("nan"))
    for one in (empty, sure, unsure):
        with pytest.raises(InputError, match=r"a score in \[0, 1\]"):
            apply(Document(), Suggest((good, one)), masks)
    with pytest.raises(InputError, match="ids that differ, got 0 twice"):
        apply(Document(), Suggest((good, good)), masks)


def test_edits_are_kept_in_their_order(masks) -> None:
    remove = Edit(kind="remove", mask=put(masks, 1))
    move = Edit(kind="move", mask=put(masks, 2), translation=(1, 0, 0), scale=0.5)
    paint = Edit(kind="recolour", mask=put(masks, 3), colour=(9, 8, 7))
    document = done(Document(), masks, Apply(remove), Apply(move), Apply(paint))
    assert document.edits == (remove, move, paint)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"scale": 0.0}, "a scale above 0"),
        ({"scale": -1.0}, "a scale above 0"),
        ({"rotation": (0.0, 0.0, 0.0, 0.0)}, "a rotation that is not zero"),
        ({"translation": (float("inf"), 0.0, 0.0)}, "finite numbers"),
        ({"about": (0.0, float("nan"), 0.0)}, "finite numbers"),
        ({"scale": 1e13}, "finite numbers"),
        ({"colour": (1, 2, 3)}, "a colour with recolour"),
        ({"kind": "recolour"}, "a colour with recolour"),
        ({"kind": "recolour", "colour": (1, 2, 300)}, "colour: expected red"),
    ],
)
def test_bad_edits_are_refused(masks, change, said) -> None:
    edit = Edit(**{"kind": "move", "mask": put(masks, 1), **change})
    with pytest.raises(InputError, match=said):
        apply(Document(), Apply(edit), masks)


def test_an_edit_of_nothing_is_refused(masks) -> None:
    with pytest.raises(InputError, match="move: expected Gaussians to change"):
        apply(Document(), Apply(Edit(kind="move", mask=put(masks))), masks)


def test_removing_leaves_something(masks) -> None:
    document = done(Document(), masks, Apply(Edit(kind="remove", mask=put(masks, *range(7)))))
    done(document, masks, Apply(Edit(kind="remove", mask=put(masks, *range(5, 11)))))
    with pytest.raises(InputError, match="remove: expected to leave Gaussians"):
        apply(document, Apply(Edit(kind="remove", mask=put(masks, *range(5, 12)))), masks)


def test_labels_say_what_undo_takes_back(masks, three) -> None:
    two = put(masks, 1, 2)
    said = {
        Select: (Select(two), "Select 2 Gaussians"),
        Keep: (Keep("cup"), "Keep cup"),
        Rename: (Rename(1, "a"), "Rename mug"),
        SetClass: (SetClass((1, 2), "a"), "Set class of 2 objects"),
        SetColour: (SetColour((2,), (0, 0, 0)), "Set colour of lamp"),
        SetVisible: (SetVisible((1,), False), "Hide mug"),
        SetLocked: (SetLocked((3,), True), "Lock chair"),
        Isolate: (Isolate((2,)), "Isolate lamp"),
        Join: (Join((1, 2, 3)), "Join 3 objects"),
        Split: (Split(1, (), ()), "Split mug"),
        Subtract: (Subtract(1, two), "Subtract from mug"),
        Refine: (Refine(1, two), "Refine mug"),
        Delete: (Delete((1,)), "Delete mug"),
        Suggest: (Suggest((Suggestion(id=0, name="a", mask=two, score=1),)), "Suggest 1 object"),
        Accept: (Accept((0, 1)), "Accept 2 suggestions"),
        Reject: (Reject((0,)), "Reject 1 suggestion"),
        Apply: (Apply(Edit(kind="remove", mask=put(masks, 1))), "Remove 1 Gaussian"),
    }
    assert set(said) == set(COMMANDS.values())
    for command, words in said.values():
        assert label_of(command, three) == words
    assert label_of(Keep(), three) == "Keep object 4"
    assert label_of(SetVisible((1,), True), three) == "Show mug"
    assert label_of(SetLocked((1,), False), three) == "Unlock mug"
    assert label_of(Isolate(), three) == "Show everything"


def test_prompts_are_held_as_json_gives_them_back() -> None:
    assert Select(None, {"points": ((1, 2.5),)}).prompt == {"points": [[1, 2.5]]}
    assert Select().prompt is None
    for bad in ({"a": float("nan")}, {"a": object()}):
        with pytest.raises(InputError, match="prompt: expected values that JSON holds"):
            Select(None, bad)


def test_a_free_name_is_the_first_that_is() -> None:
    assert free_name("a", ()) == "a"
    assert free_name("a", {"a", "a 3"}) == "a 2"
    assert free_name("a", {"a", "a 2", "a 3"}) == "a 4"


def test_the_mean_is_of_members_alone() -> None:
    assert mean_confidence(np.array([127, 128, 255], np.uint8)) == pytest.approx(0.75098, abs=1e-5)
    assert mean_confidence(np.array([127, 0], np.uint8)) == 0


# Any sequence of commands.


@given(st.lists(commands, max_size=25))
def test_any_commands_leave_a_document_that_holds_together(given) -> None:
    masks = MaskStore(COUNT)
    stored(masks)
    document, count = Document(), 0
    for command in given:
        before = content(document)
        try:
            after = apply(document, command, masks)
        except InputError:
            assert content(document) == before
            continue
        count += 1
        changed = changed_keys(document, after)
        for one in after.objects:
            assert (("object", one.id) in changed) == (one not in document.objects)
        for one in document.objects:
            assert after.objects.count(one) or ("object", one.id) in changed
        document = after
    assert document.revision == count
    ids = [one.id for one in document.objects]
    assert len(set(ids)) == len(ids)
    assert all(1 <= id < document.next_id for id in ids)
    assert len(set(names(document))) == len(ids)
    assert set(document.isolated) <= set(ids)
    assert len({one.id for one in document.suggestions}) == len(document.suggestions)
    for one in document.objects:
        values = masks.get(one.mask)
        assert int((values >= 128).sum()) == one.mask.count > 0
        assert checked_name(one.name) == one.name
        assert 0 <= one.confidence <= 1
    assert document.selection is None or document.selection.count


@given(st.lists(steps, max_size=40))
def test_undo_and_redo_go_through_the_documents_as_a_person_saw_them(given) -> None:
    masks = MaskStore(COUNT)
    stored(masks)
    history = History()
    seen, at, revisions = [content(Document())], 0, [0]
    for step in given:
        if not take(history, step, masks):
            continue
        if step == "undo":
            at -= 1
        elif step == "redo":
            at += 1
        else:
            at += 1
            del seen[at:]
            seen.append(content(history.document))
        revisions.append(history.document.revision)
        assert content(history.document) == seen[at]
        assert (history.undo_label is None) == (at == 0)
        assert (history.redo_label is None) == (at == len(seen) - 1)
        assert len(history.entries) == at
    assert revisions == list(range(len(revisions)))
    while history.undo_label is not None:
        history.undo()
    assert content(history.document) == content(Document())
    with pytest.raises(InputError, match="nothing to undo"):
        history.undo()
    while history.redo_label is not None:
        history.redo()
    assert content(history.document) == seen[-1]
    with pytest.raises(InputError, match="nothing to redo"):
        history.redo()


@given(commands)
def test_a_command_is_the_same_after_json(command) -> None:
    name, arguments = command_to_json(command)
    assert COMMANDS[name] is type(command)
    assert command_from_json(name, arguments) == command


@given(commands)
def test_what_a_command_needs_is_what_it_names(command) -> None:
    needed = keys_of(command)
    for kind in ("object", "suggestion"):
        named = {id for key, id in needed if key == kind}
        wants = (Accept, Reject) if kind == "suggestion" else ()
        if isinstance(command, Accept | Reject) != (kind == "suggestion"):
            assert not named
        elif not wants or isinstance(command, wants):
            ids = getattr(command, "ids", ())
            id = getattr(command, "id", None)
            assert named == (set(ids) if id is None else {id})
    assert (("selection", 0) in needed) == isinstance(command, Keep)
