"""A session: clicks, objects and files of a small wall, by colour and by its layers."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from splatseg.core import (
    ClassInfo,
    ClassTable,
    FeatureMap,
    Features,
    InstanceTree,
    Labels,
    LayerInfo,
    Scene,
    Selection,
    Similarity,
    TreeNode,
    View,
)
from splatseg.errors import InputError, ShapeError
from splatseg.io.evidence import (
    TextEmbeddings,
    create_evidence,
    save_features,
    save_text_embeddings,
)
from splatseg.io.scene import load_scene, load_scene_layer, save_scene, save_scene_layer
from splatseg.io.splats import read_splats, write_splats
from splatseg.prompting.graph import build_graph, holes
from splatseg.prompting.prompts import AxisBox, Ball, Similar, ViewPrompt
from splatseg.tasks import SelectOptions, open_selector
from splatseg.viewer._selecting import bytes_of, front_view, selection_of
from splatseg.viewer._session import Session, open_session
from splatseg.viewer._shaping import combined
from splatseg.viewer._shown import Owners, similarity_of
from splatseg.viewer._state import Document
from splatseg.viewer.commands import (
    Accept,
    Apply,
    Edit,
    Isolate,
    Keep,
    Rename,
    Select,
    SetClass,
    SetColour,
    SetVisible,
)
from support.observers import Stopping
from support.viewing import COUNT, content, done, put, steps, stored
from support.wall import camera, field_ids, wall

COLOURS = torch.tensor([[0.9, 0.1, 0.1], [0.1, 0.8, 0.2], [0.2, 0.2, 0.9], [0.8, 0.8, 0.2]])
"""Of fields 1 to 4; what is in none is grey."""

IN = {1: (12.5, 15.5), 2: (26.5, 15.5), 3: (12.5, 25.5), 4: (26.5, 25.5)}
"""A pixel of each field in the front view."""

SKY = (20.5, 2.5)


def coloured_wall() -> Scene:
    gaussians = wall()
    ids = field_ids(gaussians)
    colours = torch.cat((COLOURS, torch.full((1, 3), 0.5)))[ids - (ids > 0).int()]
    sh = ((colours - 0.5) / 0.28209479177387814).unsqueeze(1)
    views = (View(name="front", camera=camera()), View(name="side", camera=camera(0.5)))
    return Scene(gaussians=gaussians.replace(sh=sh), views=views, up=(0.0, -1.0, 0.0))


def tree_of(gaussians) -> InstanceTree:
    """Group 10 of objects 5 (the left half, whose parts are 1 and 3) and 6 (whose part is 2)."""
    nodes = (
        TreeNode(id=10, level="group"),
        TreeNode(id=5, parent=10, name="left", support=0.75),
        TreeNode(id=6, parent=10, name="right/half"),
        TreeNode(id=1, parent=5, level="part"),
        TreeNode(id=3, parent=5, level="part"),
        TreeNode(id=2, parent=6, level="part"),
    )
    ids = field_ids(gaussians)
    ids = torch.where(ids == 4, 6, ids)
    return InstanceTree(nodes=nodes, labels=Labels(ids=ids, confidence=(ids > 0).float()))


@pytest.fixture(scope="module")
def scene() -> Scene:
    return coloured_wall()


@pytest.fixture(scope="module")
def ids(scene) -> np.ndarray:
    return field_ids(scene.gaussians).numpy()


@pytest.fixture(scope="module")
def saved(scene, tmp_path_factory) -> Path:
    """A scene folder with a tree, and labels of classes."""
    folder = tmp_path_factory.mktemp("wall") / "scene"
    classes = ClassTable(rows=(ClassInfo(id=3, name="cup"), ClassInfo(id=7, name="lamp")))
    save_scene(replace(scene, classes=classes), folder)
    save_scene_layer(tree_of(scene.gaussians), folder, "masks")
    return folder


@pytest.fixture
def folder(saved, tmp_path) -> Path:
    return Path(shutil.copytree(saved, tmp_path / "scene"))


@pytest.fixture
def session(scene):
    with open_session(scene, backend="cpu") as session:
        yield session


def click(session: Session, *points, negative=(), view: str = "front") -> ViewPrompt:
    signs = [True] * len(points) + [False] * len(negative)
    return ViewPrompt(
        view=session.scene.view(view),
        points=torch.tensor([*points, *negative]),
        positive=torch.tensor(signs),
    )


def chosen(session: Session) -> np.ndarray:
    mask = session.document.selection
    assert mask is not None
    return session.confidence(mask) >= 128


def keep(session: Session, name: str, which: np.ndarray, sure: int = 255) -> int:
    mask = session.masks.put(np.where(which, sure, 0).astype(np.uint8))
    session.do(Select(mask, {"source": "test"}))
    return session.do(Keep(name)).objects[-1].id


# Clicks where the scene knows nothing: colour, place and pieces.


@pytest.mark.parametrize("field", [1, 2, 3, 4])
def test_a_click_selects_the_piece_of_its_colour(session, ids, field) -> None:
    assert session.source is None
    document = session.select(click(session, IN[field]))
    assert np.array_equal(chosen(session), ids == field)
    assert document.revision == 1
    assert document.prompt == {
        "source": "colour",
        "prompts": [{"kind": "view", "view": "front", "points": [list(IN[field])], "level": 0.5}],
    }
    assert set(session.seconds) >= {"see", "filter", "fill_holes"}
    assert "next_click" not in session.seconds


def test_alike_is_less_for_parts_and_more_for_groups(scene) -> None:
    """Stripes whose colours are 0.25, 0.5 and 0.85 from the first."""
    column = ((scene.gaussians.means[:, 0] + 2.5) / 1.25).long().clamp(0, 3)
    red = torch.tensor([0.1, 0.35, 0.6, 0.95])[column]
    sh = scene.gaussians.sh.clone()
    sh[:, 0] = (torch.stack((red, red * 0, red * 0), 1) - 0.5) / 0.28209479
    striped = replace(scene, gaussians=scene.gaussians.replace(sh=sh))
    with open_session(striped, backend="cpu") as session:
        for level, columns in ((0.0, 1), (0.5, 2), (1.0, 3)):
            session.select(click(session, (3.5, 20.5)), level=level)
            assert np.array_equal(chosen(session), column.numpy() < columns), level


def test_what_is_of_the_colour_and_apart_is_not_selected(scene, ids) -> None:
    """Fields 1 and 4, of one colour, touch at a corner at most; take the rows there away."""
    means = scene.gaussians.means
    apart = (means[:, 0].abs() > 0.15) | ((means[:, 1] - 1).abs() > 0.15)
    sh = scene.gaussians.sh.clone()
    sh[ids == 4] = sh[ids == 1][0]
    gaussians = scene.gaussians.replace(sh=sh)[apart]
    with open_session(replace(scene, gaussians=gaussians), backend="cpu") as session:
        session.select(click(session, IN[1]))
        assert np.array_equal(chosen(session), ids[apart.numpy()] == 1)
        session.select(click(session, IN[1], IN[4]))
        assert np.array_equal(chosen(session), np.isin(ids[apart.numpy()], (1, 4)))


def test_negative_points_cut_what_has_one_colour(scene) -> None:
    grey = replace(scene, gaussians=wall())
    with open_session(grey, backend="cpu") as session:
        session.select(click(session, (5.5, 20.5)))
        assert chosen(session).all()
        session.select(click(session, (5.5, 20.5), negative=[(25.5, 20.5)]))
        x = scene.gaussians.means[:, 0].numpy()
        # The pixels show x = -1.45 and 0.55; what is nearer to the first belongs.
        assert chosen(session)[x < -0.6].all()
        assert not chosen(session)[x > -0.3].any()


def test_a_box_bounds_a_selection(scene) -> None:
    with open_session(replace(scene, gaussians=wall()), backend="cpu") as session:
        box = ViewPrompt(view=scene.view("front"), box=torch.tensor([10.0, 14.0, 20.0, 24.0]))
        session.select(box, level=0)
        means = scene.gaussians.means.numpy()
        inside = (means[:, 0] > -1) & (means[:, 0] < 0) & (means[:, 1] > 0.4) & (means[:, 1] < 1.4)
        assert (chosen(session) == inside).mean() > 0.98


def test_the_sky_is_nothing(session) -> None:
    with pytest.raises(InputError, match="the sky"):
        session.select(click(session, SKY))
    assert session.revision == 0


def test_places_need_no_source(session, scene) -> None:
    box = AxisBox(low=(-1.0, 0.0, 0.0), high=(1.0, 0.5, 9.0))
    document = session.select(box)
    assert np.array_equal(chosen(session), box.contains(scene.gaussians).numpy())
    assert document.prompt is not None
    assert document.prompt["source"] == ""
    ball = Ball(centre=(0.0, 0.0, 2.0), radius=0.7)
    session.select([box, ball])
    both = box.contains(scene.gaussians) & ball.contains(scene.gaussians)
    assert np.array_equal(chosen(session), both.numpy())


# Clicks on layers.


def test_a_tree_answers_as_select_does(folder) -> None:
    scene = load_scene(folder)
    with open_session(folder, backend="cpu") as session:
        assert session.source == "layer masks"
        for level, granularity in ((0.0, 1.0), (0.5, 0.5), (1.0, 0.0), (None, "auto")):
            document = session.select(click(session, IN[1]), level=level)
            options = SelectOptions(granularity=granularity)
            with open_selector(scene, options=options, backend="cpu") as selector:
                wanted = selector.select(click(session, IN[1])).selection
            assert document.selection is not None
            found = session.confidence(document.selection)
            assert np.array_equal(found, bytes_of(wanted)), level
            assert document.prompt is not None
            assert document.prompt["source"] == "layer masks"
        session.do(Keep("left"))
        assert session.document.objects[0].source == "layer masks"
        with pytest.raises(InputError, match="expected a class of id 5"):
            session.select(Similar(selection=Selection(mask=torch.ones(1000).bool())))


def test_a_layer_that_comes_later_answers_after_reopening(folder) -> None:
    layer = folder / "layers" / "masks.npz"
    kept = layer.read_bytes()
    layer.unlink()
    with open_session(folder, backend="cpu") as session:
        session.select(click(session, IN[1]))
        few = chosen(session).sum()
        layer.write_bytes(kept)
        assert session.source is None
        session.reopen()
        assert session.source == "layer masks"
        session.select(click(session, IN[1]))
        assert chosen(session).sum() > few


def test_a_layer_that_was_saved_here_answers_no_clicks(folder) -> None:
    (folder / "layers" / "masks.npz").unlink()
    with open_session(folder, backend="cpu") as session:
        session.select(click(session, IN[1]))
        session.do(Keep("left"))
        session.save_layer("by-hand")
        session.reopen()
        assert session.source is None
        session.select(click(session, IN[2]))
        assert chosen(session).any(), "what was not kept yet can be clicked"


def test_the_draft_comes_first_and_is_combined_alike(folder) -> None:
    with open_session(folder, backend="cpu") as session:
        drafts: list[tuple[int, np.ndarray]] = []

        def draft(confidence: np.ndarray) -> None:
            drafts.append((session.revision, confidence.copy()))

        session.select(click(session, IN[1]), draft=draft)
        session.select(click(session, IN[2]), mode="add", draft=draft)
        assert [revision for revision, _ in drafts] == [0, 1]
        ids = field_ids(session.scene.gaussians).numpy()
        for (_, values), wanted in zip(drafts, ((1, 3), (1, 2, 3, 4)), strict=True):
            assert values.dtype == np.uint8
            assert np.array_equal(values >= 128, np.isin(ids, wanted))


def test_a_draft_is_what_the_source_says_before_it_is_cleaned(scene) -> None:
    """A speck of the colour, in a touching row apart: cleaning takes it out."""
    ids = field_ids(scene.gaussians)
    labels = torch.where(ids == 1, 1, -1).int()
    far = int(torch.nonzero(ids == 4)[100])
    labels[far] = 1
    source = Labels(ids=labels, confidence=(labels > 0).float())
    drafts = []
    view = ViewPrompt(view=scene.view("front"), points=torch.tensor([IN[1]]))
    with open_selector(scene, layers={"a": source}, backend="cpu") as selector:
        made = selector.select(view, draft=drafts.append)
    (draft,) = drafts
    assert torch.equal(draft > 0.5, labels == 1)
    assert torch.equal(made.selection.mask, ids == 1)


def test_modes_are_those_of_sets_and_of_the_base_that_is_given(session, ids) -> None:
    session.select(click(session, IN[1]))
    first = session.document.selection
    session.select(click(session, IN[2]), mode="add")
    assert np.array_equal(chosen(session), np.isin(ids, (1, 2)))
    session.select(click(session, IN[1]), mode="remove")
    assert np.array_equal(chosen(session), ids == 2)
    document = session.select(click(session, IN[3]), mode="add", base=first)
    assert np.array_equal(chosen(session), np.isin(ids, (1, 3)))
    assert document.prompt is not None
    assert [p.get("mode") for p in document.prompt["prompts"]] == ["add"]
    document = session.select(click(session, IN[1]), mode="intersect")
    assert np.array_equal(chosen(session), ids == 1)
    assert document.prompt is not None
    assert [p.get("mode") for p in document.prompt["prompts"]] == ["add", "intersect"]
    document = session.select(click(session, IN[1]), mode="remove")
    assert document.selection is None
    for mode in ("remove", "intersect"):
        with pytest.raises(InputError, match=f"{mode}: expected a selection"):
            session.select(click(session, IN[1]), mode=mode)
    session.select(click(session, IN[4]), mode="add")
    assert np.array_equal(chosen(session), ids == 4)
    with pytest.raises(InputError, match="level: expected a number from 0 to 1"):
        session.select(click(session, IN[4]), level=1.1)


@given(st.lists(st.tuples(st.integers(0, 255), st.integers(0, 255)), min_size=1, max_size=20))
def test_modes_of_bytes_are_the_algebra_of_selections(pairs) -> None:
    base, new = (np.array(values, np.uint8) for values in zip(*pairs, strict=True))
    one, other = selection_of(base), selection_of(new)
    for mode, wanted in (("add", one | other), ("remove", one - other), ("intersect", one & other)):
        found = combined(new, base, mode)
        assert found.dtype == np.uint8
        assert np.array_equal(found >= 128, wanted.mask.numpy())
        assert np.array_equal(found, bytes_of(wanted))
    assert np.array_equal(combined(new, base, "set"), new)
    with pytest.raises(ShapeError):
        combined(new, np.append(base, base[:1]), "add")


@given(st.lists(st.floats(0, 1, width=32), min_size=1, max_size=20))
def test_bytes_keep_which_side_a_confidence_is_on(values) -> None:
    selection = Selection.of_confidence(torch.tensor(values))
    found = bytes_of(selection)
    assert np.array_equal(found >= 128, selection.mask.numpy())
    assert np.abs(found / 255 - np.array(values)).max() <= 0.51 / 255 + 1e-6
    assert np.array_equal(bytes_of(selection_of(found)), found)
    only = bytes_of(Selection(mask=selection.mask))
    assert np.array_equal(only, np.where(selection.mask.numpy(), 255, 0))


def test_the_record_of_many_prompts_is_bounded_and_of_free_cameras_whole(session) -> None:
    free = View(name="free", camera=camera(0.1))
    prompt = ViewPrompt(view=free, points=torch.tensor([IN[1]]))
    document = session.select(prompt)
    assert document.prompt is not None
    (record,) = document.prompt["prompts"]
    assert record["camera"]["width"] == 40
    assert record["camera"]["cam_from_world"][0][3] == pytest.approx(-0.1)
    for _ in range(70):
        document = session.select(prompt, mode="add")
    assert document.prompt is not None
    assert len(document.prompt["prompts"]) == 64


def test_preparing_selects_nothing_and_opens_everything(session, scene) -> None:
    session.prepare()
    assert session.document == Document()
    assert "open" in session.seconds
    first = session._selecting._selector
    session.select(click(session, IN[1]))
    assert session._selecting._selector is first
    assert first._neighbours is session._selecting.neighbours
    with open_session(replace(scene, views=()), backend="cpu") as alone:
        alone.prepare()
        assert alone.hint(put(alone.masks, 3)) is None


def test_a_scene_without_views_is_seen_from_the_front(scene) -> None:
    view = front_view(scene.gaussians)
    pixels, depth = view.camera.project(scene.gaussians.means.double())
    assert bool((depth > 0).all())
    middle = torch.tensor([view.camera.width / 2, view.camera.height / 2])
    assert float((pixels.median(dim=0).values - middle).abs().max()) < 1


def test_a_hint_is_where_the_selection_is_unsure(session, ids) -> None:
    assert session.hint() is None
    values = np.where(ids == 1, 255, np.where(ids == 2, 120, 0)).astype(np.uint8)
    session.do(Select(session.masks.put(values)))
    assert session.hint(stop=lambda: True) is None
    hint = session.hint()
    assert hint is not None
    x, y, view = hint
    seen = camera(0.0 if view == "front" else 0.5)
    pixels, _ = seen.project(session.scene.gaussians.means.double())
    nearest = int((pixels - torch.tensor([x, y])).norm(dim=1).argmin())
    assert ids[nearest] == 2
    assert session.hint(put(session.masks, *np.nonzero(ids == 1)[0])) != hint


# Words.


@pytest.fixture
def wordy(folder, ids) -> Path:
    """The scene with features of objects that words are compared with: mug is field 1."""
    evidence = create_evidence(folder / "evidence" / "features_mugs", kind="features")
    grid = FeatureMap(features=torch.rand(2, 3, 3), stride=16, height=30, width=40)
    save_features(grid, evidence, "front")
    words = TextEmbeddings(
        labels=("mug", "desk", "sky"),
        vectors=torch.eye(3),
        kinds=("class", "class", "class"),
        target_ids=(1, 2, 3),
    )
    save_text_embeddings(words, evidence)
    which = torch.from_numpy(np.where(ids == 1, 0, 1))
    info = LayerInfo(method="objects", evidence="features_mugs")
    layer = Features(values=torch.eye(3)[which], weights=torch.ones(1000), info=info)
    save_scene_layer(layer, folder, "objects")
    return folder


def test_words_select_what_answers(wordy, ids) -> None:
    with open_session(wordy, backend="cpu") as session:
        assert session.words
        drafts: list[np.ndarray] = []
        document = session.select("mug", draft=drafts.append)
        assert np.array_equal(chosen(session), ids == 1)
        assert np.array_equal(drafts[0] >= 128, ids == 1)
        record = {"kind": "words", "text": "mug"}
        assert document.prompt == {"source": "layer objects", "prompts": [record]}
        found = session.similarity("mug")
        assert found.dtype == np.float32
        assert found[ids == 1].min() > 0.5 > found[ids != 1].max()
        with pytest.raises(InputError, match="zebra"):
            session.select("zebra")


def test_a_scene_that_knows_no_words_says_so(session) -> None:
    assert not session.words
    with pytest.raises(InputError, match="words: expected a layer that answers them"):
        session.select("mug")
    with pytest.raises(InputError, match="words: expected a layer that answers them"):
        session.similarity("mug")


# Grow, shrink, fill.


def test_growing_and_shrinking_are_by_distance(session, scene) -> None:
    means = scene.gaussians.means.double()
    inside = ((means[:, 0].abs() < 0.8) & ((means[:, 1] - 1).abs() < 0.4)).numpy()
    session.do(Select(session.masks.put(np.where(inside, 200, 0).astype(np.uint8)), {"a": 1}))
    apart = torch.cdist(means, means).numpy()
    document = session.grow(2.0)
    near = apart[:, inside].min(axis=1) <= 0.2 + 1e-6
    assert np.array_equal(chosen(session), near)
    values = session.confidence(document.selection)
    assert set(np.unique(values[inside])) == {200}
    assert set(np.unique(values[near & ~inside])) == {255}
    assert document.prompt == {"a": 1, "prompts": [{"kind": "grow", "factor": 2.0}]}
    document = session.shrink(1.0)
    kept = near & (apart[:, ~near].min(axis=1) > 0.1 + 1e-6)
    assert np.array_equal(chosen(session), kept)
    assert 0 < kept.sum() < near.sum()
    assert [p["kind"] for p in document.prompt["prompts"]] == ["grow", "shrink"]
    with pytest.raises(InputError, match="nothing would be left"):
        session.shrink(90)
    for factor in (0, -1, 101, float("nan")):
        with pytest.raises(InputError, match="factor: expected more than 0"):
            session.grow(factor)


def test_one_gaussian_grows_to_its_neighbours(session) -> None:
    session.do(Select(put(session.masks, 505)))
    session.grow()
    assert sorted(np.nonzero(chosen(session))[0]) == [485, 504, 505, 506, 525]


def test_holes_are_filled(session, scene) -> None:
    means = scene.gaussians.means
    inside = (means[:, 0].abs() < 1) & ((means[:, 1] - 1).abs() < 0.6)
    gap = inside & (means[:, 0].abs() < 0.1) & ((means[:, 1] - 1).abs() < 0.1)
    mask = inside & ~gap
    assert int(gap.sum()) == 4
    session.do(Select(session.masks.put(np.where(mask, 200, 0).astype(np.uint8))))
    session.fill_holes()
    assert np.array_equal(chosen(session), inside.numpy())
    wanted = holes(build_graph(scene.gaussians), Selection(mask=mask)).mask
    assert torch.equal(wanted, gap)


def test_without_a_selection_there_is_nothing_to_grow(session) -> None:
    for change in (session.grow, session.shrink, session.fill_holes):
        with pytest.raises(InputError, match="selection: expected one, got none"):
            change()


# Objects.


def test_a_split_by_plane_by_pieces_and_by_the_tree(folder, ids) -> None:
    with open_session(folder, backend="cpu") as session:
        means = session.scene.gaussians.means.numpy()
        whole = keep(session, "wall", ids > 0, 200)
        session.split(whole, by="plane", plane=(0, 2, 0, -1.0))
        left, right = session.document.objects
        above = (ids > 0) & (means[:, 1] > 0.5)
        assert (left.id, left.name, right.name) == (whole, "wall", "wall 2")
        assert np.array_equal(session.confidence(left.mask), np.where(above, 200, 0))
        below = (ids > 0) & ~above
        assert np.array_equal(session.confidence(right.mask), np.where(below, 200, 0))
        session.undo()
        session.split(whole, by="tree")
        found = [session.confidence(one.mask) >= 128 for one in session.document.objects]
        assert [one.sum() for one in found] == sorted((one.sum() for one in found), reverse=True)
        wanted = {tuple(ids == field) for field in (1, 2, 3, 4)}
        assert {tuple(one) for one in found} == wanted
        session.undo()
        apart = keep(session, "two", np.abs(means[:, 0]) > 1)
        session.split(apart, by="parts")
        parts = [session.confidence(one.mask) >= 128 for one in session.document.objects[1:]]
        assert {tuple(one) for one in parts} == {tuple(means[:, 0] > 1), tuple(means[:, 0] < -1)}


def test_specks_of_a_split_go_to_the_nearest_part(session, scene) -> None:
    means = scene.gaussians.means.numpy()
    speck = np.abs(means[:, 0] - 0.75) + np.abs(means[:, 1] - 1.05) < 0.01
    id = keep(session, "two", (np.abs(means[:, 0]) > 1) | speck)
    session.split(id)
    right = session.confidence(session.document.objects[0].mask) >= 128
    other = session.confidence(session.document.objects[1].mask) >= 128
    if right[means[:, 0] < -1].any():
        right, other = other, right
    assert np.array_equal(right, (means[:, 0] > 1) | speck)
    assert np.array_equal(other, means[:, 0] < -1)


def test_a_split_that_cannot_be_is_said(session, ids) -> None:
    id = keep(session, "one", ids == 1)
    for how, said in (
        ({}, "parts gives one part only"),
        ({"by": "plane", "plane": (1, 0, 0, 9)}, "plane gives one part only"),
        ({"by": "tree"}, "a scene with a tree"),
        ({"by": "plane"}, "expected a plane with by plane"),
        ({"plane": (1, 0, 0, 0)}, "expected a plane with by plane"),
        ({"by": "plane", "plane": (0, 0, 0, 1)}, "plane: expected four numbers"),
        ({"by": "plane", "plane": (1, 0, 0)}, "plane: expected four numbers"),
        ({"by": "plane", "plane": (1, 0, 0, float("nan"))}, "plane: expected four numbers"),
    ):
        with pytest.raises(InputError, match=said):
            session.split(id, **how)
    with pytest.raises(InputError, match="object: there is none"):
        session.split(9)


def test_suggestions_are_the_things_of_a_layer(folder, ids) -> None:
    with open_session(folder, backend="cpu") as session:
        document = session.suggest("masks")
        found = {one.name: one for one in document.suggestions}
        assert list(found) == ["left", "right-half"]
        for name, fields, score in (("left", (1, 3), 0.75), ("right-half", (2, 4), 1.0)):
            assert found[name].score == score
            values = session.confidence(found[name].mask)
            assert np.array_equal(values, np.where(np.isin(ids, fields), 255, 0))
        session.do(Accept((found["left"].id,)))
        assert session.document.objects[0].name == "left"
        save_scene_layer(
            Labels(
                ids=torch.from_numpy(ids),
                confidence=torch.where(torch.from_numpy(ids) == 1, 0.25, 0.75),
                info=LayerInfo(names={2: "two"}),
            ),
            folder,
            "fields",
        )
        fields = {one.name: one for one in session.suggest("fields").suggestions}
        assert set(fields) == {"two", "fields 1", "fields 3", "fields 4"}
        assert fields["fields 1"].score == 0.25
        assert set(np.unique(session.confidence(fields["fields 1"].mask))) == {0, 128}
        assert set(np.unique(session.confidence(fields["two"].mask))) == {0, 191}
        for name, said in (("nothing", "expected one of"),):
            with pytest.raises(InputError, match=said):
                session.suggest(name)
        empty = Labels(ids=torch.full((1000,), -1), confidence=torch.zeros(1000))
        save_scene_layer(empty, folder, "empty")
        save_scene_layer(Selection(mask=torch.ones(1000).bool()), folder, "selection")
        with pytest.raises(InputError, match="'empty' has none"):
            session.suggest("empty")
        with pytest.raises(InputError, match="'selection' has no ids"):
            session.suggest("selection")


def test_a_gaussian_belongs_to_the_object_that_is_surest_of_it(session) -> None:
    rows = np.arange(1000)
    one = keep(session, "one", rows < 500, 200)
    two = keep(session, "two", (rows >= 400) & (rows < 600), 150)
    assert np.array_equal(
        session.shown.owners, np.where(rows < 500, one, np.where(rows < 600, two, -1))
    )
    three = keep(session, "three", (rows >= 300) & (rows < 450), 200)
    found = session.shown.owners
    assert set(found[300:450]) == {three}
    assert set(found[450:500]) == {one}
    assert set(found[500:600]) == {two}
    with pytest.raises(ValueError, match="read-only"):
        found[0] = 3


@given(st.lists(steps, max_size=25))
def test_owners_kept_are_owners_found_anew(given) -> None:
    session = memory_session()
    stored(session.masks)
    for step in given:
        if done(step, session.do, session):
            anew = Owners(COUNT, session.masks).of(session.document.objects)
            assert np.array_equal(session.shown.owners, anew[0])
            naive = np.full(COUNT, -1)
            best = np.full(COUNT, 127)
            for one in session.document.objects:
                values = session.confidence(one.mask).astype(int)
                for i in range(COUNT):
                    if values[i] >= 128 and values[i] >= best[i]:
                        naive[i], best[i] = one.id, values[i]
            assert np.array_equal(session.shown.owners, naive)


def test_what_is_hidden_removed_or_not_isolated_is_not_shown(session) -> None:
    rows = np.arange(1000)
    assert session.shown.visible.all()
    one = keep(session, "one", rows < 500, 200)
    two = keep(session, "two", (rows >= 400) & (rows < 600), 150)
    session.do(SetVisible((one,), False))
    assert np.array_equal(session.shown.visible, rows >= 500)
    session.do(Apply(Edit(kind="remove", mask=put(session.masks, *range(550, 700)))))
    removed = (rows >= 550) & (rows < 700)
    assert np.array_equal(session.shown.visible, (rows >= 500) & ~removed)
    session.do(Isolate((two,)))
    assert np.array_equal(session.shown.visible, (rows >= 500) & (rows < 550))
    session.do(Isolate((one, two)))
    session.do(SetVisible((one,), True))
    assert np.array_equal(session.shown.visible, (rows < 600) & ~removed)


# Several people.


def test_changes_are_told_to_who_asked(session) -> None:
    told: list[tuple[int, int, str]] = []
    end = session.subscribe(
        lambda old, new, author: told.append((old.revision, new.revision, author))
    )
    mask = put(session.masks, 1)
    session.do(Select(mask), author="anna")
    with pytest.raises(InputError):
        session.do(Rename(1, "a"), author="anna")
    session.undo("ben")
    session.redo("anna")
    end()
    end()
    session.undo()
    assert told == [(0, 1, "anna"), (1, 2, "ben"), (2, 3, "anna")]


def test_a_command_on_what_another_changed_is_refused(session) -> None:
    one = keep(session, "one", np.arange(1000) < 5)
    two = keep(session, "two", np.arange(1000) > 5)
    seen = session.revision
    session.do(Rename(one, "uno"), author="anna", revision=seen)
    session.do(SetColour((one,), (1, 2, 3)), author="anna", revision=seen)
    session.do(Rename(two, "due"), author="ben", revision=seen)
    with pytest.raises(InputError, match="object 1: it was changed since you saw it"):
        session.do(SetColour((two, one), (0, 0, 0)), author="ben", revision=seen)
    assert session.document.object(two).colour != (0, 0, 0)
    session.do(SetColour((one,), (0, 0, 0)), author="ben")
    session.do(SetColour((one,), (0, 0, 1)), author="ben", revision=session.revision)
    with pytest.raises(InputError, match="object 1: it was changed"):
        session.do(Rename(one, "a"), author="anna", revision=seen)
    session.do(Select(put(session.masks, 1)), author="anna")
    seen = session.revision
    session.do(Select(put(session.masks, 2)), author="ben")
    with pytest.raises(InputError, match="selection: it was changed"):
        session.do(Keep("a"), author="anna", revision=seen)
    session.do(Keep("a"), author="ben", revision=seen)
    session.undo("anna")
    with pytest.raises(InputError, match="selection: it was changed"):
        session.do(Keep("a"), author="ben", revision=session.revision - 1)
    for _ in range(2):
        session.do(Rename(two, f"{session.revision}"), revision=session.revision)
    with pytest.raises(InputError, match="object 2: it was changed"):
        session.do(Rename(two, "b"), revision=session.revision - 1)


def test_suggestions_that_were_exchanged_are_not_accepted_by_number(folder) -> None:
    with open_session(folder, backend="cpu") as session:
        seen = session.suggest("masks", author="anna").revision
        fields = field_ids(session.scene.gaussians)
        save_scene_layer(Labels(ids=fields, confidence=fields.float().clamp(0, 1)), folder, "other")
        session.suggest("other", author="anna")
        with pytest.raises(InputError, match="suggestion 0: it was changed"):
            session.do(Accept((0,)), author="ben", revision=seen)


def test_what_was_seen_before_a_restart_is_old(folder) -> None:
    with open_session(folder, backend="cpu") as session:
        keep(session, "one", np.arange(1000) < 5)
        seen = session.revision
    with open_session(folder, backend="cpu") as session:
        assert session.revision == seen
        with pytest.raises(InputError, match="object 1: it was changed"):
            session.do(Rename(1, "a"), author="anna", revision=seen - 1)
        session.do(Rename(1, "a"), author="anna", revision=seen)
        with pytest.raises(InputError, match="object 1: it was changed"):
            session.do(Rename(1, "b"), author="anna", revision=seen - 1)


# Undo, redo and the journal.


def test_labels_say_what_was_done(session) -> None:
    keep(session, "mug", np.arange(1000) < 5)
    session.do(Rename(1, "cup"))
    history = session.history
    labels = [entry.label for entry in history.entries]
    assert labels == ["Select 5 Gaussians", "Keep mug", "Rename mug"]
    assert (history.undo_label, history.redo_label) == ("Rename mug", None)
    session.undo()
    assert session.document.object(1).name == "mug"
    assert (history.undo_label, history.redo_label) == ("Keep mug", "Rename mug")
    assert [entry.label for entry in history.entries] == labels[:2]
    assert session.revision == 4
    session.redo()
    assert session.document.object(1).name == "cup"
    for _ in range(3):
        session.undo()
    with pytest.raises(InputError, match="undo: there is nothing"):
        session.undo()
    session.do(Select(None))
    with pytest.raises(InputError, match="redo: there is nothing"):
        session.redo()


def test_a_session_goes_on_where_the_last_one_ended(folder, ids) -> None:
    with open_session(folder, backend="cpu") as session:
        session.select(click(session, IN[1]), level=0.0)
        session.do(Keep("one", "cup"))
        session.select(click(session, IN[2]))
        session.undo()
        before, entries = session.document, session.history.entries
        with pytest.raises(InputError, match="open already"):
            open_session(folder, backend="cpu")
    assert (folder / "view" / "journal.jsonl").is_file()
    with open_session(folder, backend="cpu") as session:
        assert session.document == before
        assert session.history.entries == entries
        assert session.notes == ()
        session.redo()
        assert np.array_equal(chosen(session), np.isin(ids, (2, 4)))


def test_what_was_wrong_with_a_journal_is_told(folder) -> None:
    with open_session(folder, backend="cpu") as session:
        keep(session, "one", np.arange(1000) < 5)
    with (folder / "view" / "journal.jsonl").open("ab") as file:
        file.write(b'{"n": 3')
    observer = Stopping(stage=None)
    notes: list[str] = []
    observer.note = notes.append
    with open_session(folder, backend="cpu", observer=observer) as session:
        assert session.notes == ("the last line of the journal was torn, and dropped",)
        assert session.document.objects[0].name == "one"
    assert notes == list(session.notes)


def test_a_scene_whose_gaussians_changed_begins_anew(folder) -> None:
    with open_session(folder, backend="cpu") as session:
        keep(session, "one", np.arange(1000) < 5)
    scene = load_scene(folder)
    moved = scene.gaussians.replace(means=scene.gaussians.means + 1e-3)
    with open_session(replace(scene, gaussians=moved), backend="cpu") as session:
        assert session.document == Document()
        assert "other Gaussians" in session.notes[0]


def test_a_session_of_a_splat_file_or_a_folder_elsewhere(scene, tmp_path) -> None:
    write_splats(scene.gaussians, tmp_path / "a.ply")
    with open_session(tmp_path / "a.ply", backend="cpu") as session:
        assert len(session.scene.gaussians) == 1000
        keep(session, "one", np.arange(1000) < 5)
        with pytest.raises(InputError, match="a scene with a folder"):
            session.export("splat", "a.ply")
        assert session.save_layer("things").info.names == {1: "one"}
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.ply"]
    with open_session(scene, folder=tmp_path / "j", backend="cpu") as session:
        keep(session, "one", np.arange(1000) < 5)
        made = session.export("splat", "one", [1])
        assert made == tmp_path / "j" / "exports" / "one.ply"
    with open_session(scene, folder=tmp_path / "j", backend="cpu") as session:
        assert session.document.objects[0].name == "one"
    with pytest.raises(InputError):
        open_session(tmp_path / "nothing")


def test_a_view_folder_that_leads_elsewhere_is_refused(folder, tmp_path) -> None:
    (tmp_path / "elsewhere").mkdir()
    (folder / "view").symlink_to(tmp_path / "elsewhere", target_is_directory=True)
    with pytest.raises(InputError, match="leads out"):
        open_session(folder, backend="cpu")
    assert list((tmp_path / "elsewhere").iterdir()) == []


def memory_session() -> Session:
    gaussians = wall()[torch.arange(COUNT)]
    return open_session(Scene(gaussians=gaussians), backend="cpu")


@settings(max_examples=15)
@given(st.lists(steps, max_size=20))
def test_the_layer_is_what_the_same_commands_make_in_python(tmp_path_factory, given) -> None:
    folder = tmp_path_factory.mktemp("layer")
    scene = Scene(gaussians=wall()[torch.arange(COUNT)])
    save_scene(scene, folder / "scene")
    with open_session(folder / "scene", backend="cpu") as session:
        stored(session.masks)
        for step in given:
            done(step, session.do, session)
        document, commands = session.document, [e.command for e in session.history.entries]
    with open_session(folder / "scene", backend="cpu") as session:
        assert session.document == document
        alone = memory_session()
        stored(alone.masks)
        for command in commands:
            alone.do(command)
        assert content(alone.document) == content(document)
        if not document.objects:
            with pytest.raises(InputError, match="objects: expected at least one"):
                session.save_layer("things")
            return
        session.save_layer("things")
    found, wanted = load_scene_layer(folder / "scene", "things"), alone.save_layer("things")
    for name in ("ids", "confidence"):
        assert torch.equal(getattr(found, name), getattr(wanted, name))
    assert found.info == wanted.info


# What is taken away.


def test_a_layer_has_names_classes_colours_and_its_commands(folder) -> None:
    rows = np.arange(1000)
    with open_session(folder, backend="cpu") as session:
        keep(session, "mug", rows < 500, 200)
        keep(session, "cat", (rows >= 400) & (rows < 600), 150)
        keep(session, "dog", rows >= 900)
        session.do(SetClass((1,), "lamp"))
        session.do(SetClass((2,), "animal"))
        session.do(SetColour((2,), (1, 2, 3)))
        session.do(Rename(1, "no"))
        session.undo()
        made = session.save_layer("things")
        document = session.document
        session.save_layer("things")
        with pytest.raises(InputError, match="'masks' is there already and was not saved here"):
            session.save_layer("masks")
        with pytest.raises(InputError, match="layer"):
            session.save_layer("../things")
    found = load_scene_layer(folder, "things")
    assert isinstance(found, Labels)
    assert torch.equal(found.ids, made.ids)
    wanted = np.where(rows < 500, 1, np.where(rows < 600, 2, np.where(rows >= 900, 3, -1)))
    assert np.array_equal(found.ids.numpy(), wanted)
    sure = np.where(rows < 500, 200, np.where(rows < 600, 150, np.where(rows >= 900, 255, 0)))
    np.testing.assert_allclose(found.confidence.numpy(), sure / 255, atol=1e-6)
    info = found.info
    assert (info.method, info.names) == ("view", {1: "mug", 2: "cat", 3: "dog"})
    assert info.class_of == {1: 7, 2: 8}
    assert info.details["classes"] == {"7": "lamp", "8": "animal"}
    assert info.details["colours"]["2"] == [1, 2, 3]
    assert info.details["colours"]["1"] == list(document.object(1).colour)
    assert info.instances[1].details == {"source": "test"}
    commands = info.details["commands"]
    assert [one["do"] for one in commands][-3:] == ["set_class", "set_class", "set_colour"]
    assert commands[1] == {
        "do": "keep",
        "arguments": {"name": "mug", "class_name": "", "colour": None},
    }
    # A layer of instances answers clicks where there is no tree, unless it was saved here.
    (folder / "layers" / "masks.npz").unlink()
    save_scene_layer(replace(found, info=replace(info, method="hand")), folder, "all")
    with open_session(folder, backend="cpu") as session:
        assert session.source == "layer all"


def test_edits_are_those_of_edit_one_after_the_other(session, scene) -> None:
    rows = np.arange(1000)
    masks = session.masks
    turn = (0.0, 0.0, 0.0, 2.0)  # half a turn about z
    first = put(masks, *range(100))
    move = Edit(
        kind="move", mask=first, rotation=turn, translation=(0, 0, 1), scale=2, about=(1, 1, 2)
    )
    assert session.edited_scene() is scene
    session.do(Apply(move))
    session.do(Apply(Edit(kind="duplicate", mask=first, translation=(5, 0, 0))))
    session.do(Apply(Edit(kind="remove", mask=put(masks, *range(50, 150)))))
    session.do(Apply(Edit(kind="recolour", mask=put(masks, *range(200)), colour=(255, 0, 51))))
    made = session.edited_scene()
    kept = np.concatenate((rows[:50], rows[150:], rows[:100]))
    assert np.array_equal(session.shown.rows, kept)
    assert made.root is None
    assert [one["kind"] for one in made.provenance["view_edits"]] == [
        "move", "duplicate", "remove", "recolour",
    ]  # fmt: skip
    means = scene.gaussians.means.double().numpy().copy()
    means[:100] = np.array([1, 1, 2]) + 2 * (means[:100] - [1, 1, 2]) * [-1, -1, 1] + [0, 0, 1]
    copies = means[:100] + np.array([5, 0, 0])
    wanted = np.concatenate((means[:50], means[150:], copies))
    np.testing.assert_allclose(made.gaussians.means.numpy(), wanted, atol=1e-5)
    np.testing.assert_allclose(made.gaussians.scales[:50].numpy(), 0.08, atol=1e-6)
    colours = scene.gaussians.colours.numpy()[kept].copy()
    colours[:100] = [1, 0, 0.2]
    np.testing.assert_allclose(made.gaussians.colours.numpy(), colours, atol=1e-5)
    session.undo()
    assert len(session.edited_scene().gaussians) == 1000
    np.testing.assert_allclose(
        session.edited_scene().gaussians.colours.numpy(),
        scene.gaussians.colours.numpy()[kept],
        atol=1e-5,
    )


def test_edits_of_what_was_removed_do_nothing(session) -> None:
    mask = put(session.masks, *range(50))
    session.do(Apply(Edit(kind="remove", mask=mask)))
    session.do(Apply(Edit(kind="duplicate", mask=mask, translation=(1, 0, 0))))
    assert np.array_equal(session.shown.rows, np.arange(50, 1000))


def test_the_movement_of_an_edit_keeps_the_point_that_it_is_about() -> None:
    edit = Edit(
        kind="move",
        mask=put(memory_session().masks, 1),
        rotation=(0.5, 0.1, -0.7, 0.2),
        scale=3,
        about=(1, 2, 3),
    )
    moved = similarity_of(edit)
    assert isinstance(moved, Similarity)
    points = torch.tensor([[1.0, 2, 3], [2, 2, 3]], dtype=torch.float64)
    there = moved.apply(points)
    torch.testing.assert_close(there[0], points[0])
    assert float((there[1] - there[0]).norm()) == pytest.approx(3)


def test_one_object_becomes_a_file_with_its_edits(folder) -> None:
    rows = np.arange(1000)
    with open_session(folder, backend="cpu") as session:
        keep(session, "mug", rows < 100)
        keep(session, "1", (rows >= 200) & (rows < 350))
        lift = Edit(kind="move", mask=put(session.masks, *range(100)), translation=(0, 0, 9))
        session.do(Apply(lift))
        assert session.edited_scene().root is None
        path = session.export("splat", "mug", [1])
        assert path == folder / "exports" / "mug.ply"
        mug = read_splats(path)
        assert len(mug) == 100
        means = session.scene.gaussians.means[:100] + torch.tensor([0.0, 0.0, 9.0])
        torch.testing.assert_close(mug.means, means)
        everything = read_splats(session.export("splat", "all.ply"))
        assert len(everything) == 1000
        assert len(read_splats(session.export("splat", "both.spz", [1, 2]))) == 250
        small = session.export("splat", "small", [2], format="spz3")
        assert (small.name, len(read_splats(small))) == ("small.spz", 150)
        assert mug.extra["class_id"].unique().tolist() == [1]
        objects = session.export("objects", "things")
        assert {path.name for path in objects.iterdir()} > {"objects.json"}
        assert len(list(objects.glob("*.ply"))) == 2
        assert len(list(session.export("objects", "few", [2], format="splat").glob("*.splat"))) == 1
        table = session.export("table", "list").read_text()
        assert session.export("table", "list").name == "list.csv"
        assert "mug" in table
        assert session.export("points", "cloud", [2]).name == "cloud.ply"
        session.do(Apply(Edit(kind="remove", mask=put(session.masks, *range(100)))))
        with pytest.raises(InputError, match="nothing of these objects is left"):
            session.export("splat", "gone", [1])
        with pytest.raises(InputError, match="object: there is none with the id 9"):
            session.export("splat", "gone", [9])
        for name in ("../out", "/tmp/out", "a/b", "", ".hidden"):
            with pytest.raises(InputError, match="export: expected a name"):
                session.export("splat", name)
    assert not (folder.parent / "out.ply").exists()


def test_a_scene_without_objects_is_exported_as_it_is(folder) -> None:
    with open_session(folder, backend="cpu") as session:
        assert len(read_splats(session.export("splat", "all"))) == 1000
        with pytest.raises(InputError, match="expected the labels to export"):
            session.export("objects", "none")


def test_the_selection_comes_back_as_one(session, ids) -> None:
    assert session.selected is None
    session.select(click(session, IN[1]))
    found = session.selected
    assert isinstance(found, Selection)
    assert np.array_equal(found.mask.numpy(), ids == 1)
    assert found.confidence is not None


def test_the_package_gives_its_names_when_asked() -> None:
    import splatseg.viewer as viewer

    assert viewer.open_session is open_session
    assert viewer.Session is Session
    assert viewer.commands.Keep is Keep
