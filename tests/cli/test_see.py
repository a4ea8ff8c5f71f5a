"""splatseg see: a model or a folder -> evidence, resumable, and what is refused."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from splatseg.core import FeatureMap, LabelMap, MaskSet, Panoptic, Segment
from splatseg.errors import InputError
from splatseg.io.evidence import (
    PanopticEvidence,
    TrackedEvidence,
    evidence_header,
    open_evidence,
    save_features,
    save_masks,
)
from splatseg.io.scene import load_scene
from splatseg.models import EvidenceRequest, find_model, record_evidence
from support.shared import generated_and

WIDTH, HEIGHT = 28, 20
TRAIN = ("train_0", "train_1", "train_3")
CLASSICAL = ("--model", "classical", "--evidence", "masks")


def header(folder: Path) -> dict:
    return json.loads((folder / "evidence.json").read_text())


def half(rows: int = 10, height: int = HEIGHT, width: int = WIDTH) -> torch.Tensor:
    mask = torch.zeros(1, height, width, dtype=torch.bool)
    mask[:, rows:] = True
    return mask


@pytest.fixture
def recorded(tmp_path) -> Path:
    """A mask a view, of the train views."""
    folder = tmp_path / "masks_other"
    folder.mkdir()
    for name in TRAIN:
        save_masks(MaskSet.from_dense(half(), scores=[0.75]), folder, name)
    return folder


def refused(result: tuple[int, str, str]) -> str:
    """The one sentence of a refusal."""
    status, out, err = result
    assert (status, out) == (2, ""), err
    errors = [line for line in err.splitlines() if line.startswith("error: ")]
    assert len(errors) == 1, err
    return errors[0]


# The regions that come with the package


def test_regions_see_with_the_scene_s_depth_or_without(small, splatseg) -> None:
    see = ("see", small.scene, "--model", "regions", "--evidence")
    for name, flags in (("plain", ("--no-depth-from-scene",)), ("deep", ())):
        status, out, err = splatseg(*see, name, *flags)
        assert status == 0, err
        assert out.startswith("masks of 3 views by regions, ")
        assert "on no photograph" in err
    settings = [header(small.scene / "evidence" / name)["metadata"]["settings"]
                for name in ("plain", "deep")]  # fmt: skip
    assert "depth_from_scene" not in settings[0]
    assert settings[1]["depth_from_scene"] is True
    sentence = refused(splatseg(*see, "deep", "--no-depth-from-scene"))
    assert "depth_from_scene" in sentence
    status, _, err = splatseg("see", small.scene, *CLASSICAL, "--no-depth-from-scene")
    assert status == 2
    assert "Unrecognized options: --no-depth-from-scene" in err
    scene, folder = load_scene(small.scene), small.scene / "evidence" / "m"
    request = EvidenceRequest(depth_of=lambda view: torch.ones(HEIGHT, WIDTH))
    with pytest.raises(InputError, match="depth_from_scene: expected a model that takes depth"):
        record_evidence(find_model("classical"), scene.train_views, folder, request)
    assert not folder.exists()


# The classical stand-in


def test_the_command_of_the_readme(small, splatseg) -> None:
    status, out, err = splatseg("see", small.scene, *CLASSICAL)
    assert status == 0, err
    assert "stand-in" in err
    first, second = out.splitlines()
    assert first.startswith("masks of 3 views by classical, ")
    assert "masks a view, " in first
    assert " s an image, " in first
    assert first.endswith(" MB")
    folder = small.scene / "evidence" / "masks"
    assert second == str(folder)
    evidence = open_evidence(folder)
    assert (evidence.kind, evidence.view_names) == ("masks", TRAIN)
    masks = evidence.masks("train_0")
    assert (masks.height, masks.width) == (HEIGHT, WIDTH)
    metadata = header(folder)["metadata"]
    assert (metadata["model"], metadata["what"], metadata["views_asked"]) == (
        "classical",
        "masks",
        "train",
    )
    assert metadata["settings"]["regions"]["working_size"] == 640
    assert metadata["complete"] is True
    assert "stand-in" in metadata["note"]
    assert not list(folder.rglob(".*"))


def test_views_are_train_unless_others_are_asked_for(small, splatseg) -> None:
    folder = small.scene / "evidence" / "masks"
    assert splatseg("see", small.scene, *CLASSICAL, "--views", "test_2,train_1")[0] == 0
    assert open_evidence(folder).view_names == ("test_2", "train_1")
    assert header(folder)["metadata"]["views_asked"] == "test_2,train_1"
    assert splatseg("see", small.scene, *CLASSICAL, "--views", "all")[0] == 0
    assert open_evidence(folder).view_names == ("test_2", *TRAIN)
    assert header(folder)["metadata"]["views_asked"] == "all"
    sentence = refused(splatseg("see", small.scene, *CLASSICAL))
    assert "holds 1 views that are not asked for now (test_2)" in sentence
    assert header(folder)["metadata"]["views_asked"] == "all", "the record stays as it was"
    assert "nobody" in refused(splatseg("see", small.scene, *CLASSICAL, "--views", "nobody"))


def test_features_of_the_stand_in(small, splatseg) -> None:
    words = ("--model", "classical", "--evidence", "look", "--what", "features")
    assert splatseg("see", small.scene, *words)[0] == 0
    evidence = open_evidence(small.scene / "evidence" / "look")
    assert evidence.kind == "features"
    assert evidence.features("train_0").features.shape == (3, 4, 14)


def test_photographs_that_moved_are_found_with_data(small, splatseg) -> None:
    shutil.move(small.capture, small.capture.parent / "elsewhere")
    sentence = refused(splatseg("see", small.scene, *CLASSICAL))
    assert "--data" in sentence
    moved = small.capture.parent / "elsewhere"
    assert splatseg("see", small.scene, *CLASSICAL, "--data", moved)[0] == 0


# Stopping and going on


class Stopping:
    """A model that is stopped after some views, and counts what it was asked."""

    name = "stopping"
    note = ""

    def __init__(self, after: int | None = None) -> None:
        self.after = after
        self.settings: dict = {}
        self.asked = 0

    def masks(self, image) -> MaskSet:
        if self.asked == self.after:
            raise KeyboardInterrupt
        self.asked += 1
        return MaskSet.from_dense(half(), scores=[0.5])


def test_what_was_stopped_goes_on_where_it_was(small) -> None:
    scene = load_scene(small.scene)
    folder = small.scene / "evidence" / "m"
    with pytest.raises(KeyboardInterrupt):
        record_evidence(Stopping(after=2), scene.train_views, folder)
    assert open_evidence(folder, unfinished="allow").view_names == TRAIN[:2]
    assert evidence_header(folder)["metadata"]["complete"] is False
    before = (folder / "train_0.json").stat().st_mtime_ns
    model = Stopping()
    steps: list[tuple[int, int]] = []
    seen = record_evidence(
        model, scene.train_views, folder, progress=lambda done, total: steps.append((done, total))
    )
    assert (model.asked, seen.kept, seen.views, seen.masks) == (1, 2, 3, 1)
    assert steps == [(2, 3), (3, 3)]
    assert (folder / "train_0.json").stat().st_mtime_ns == before
    assert header(folder)["metadata"]["complete"] is True
    seen = record_evidence(model, scene.train_views, folder)
    assert (model.asked, seen.kept) == (1, 3)


def test_a_damaged_file_of_a_view_is_made_again(small) -> None:
    scene = load_scene(small.scene)
    folder = small.scene / "evidence" / "m"
    record_evidence(Stopping(), scene.train_views, folder)
    text = (folder / "train_1.json").read_text()
    (folder / "train_1.json").write_text(text[: len(text) // 2])
    model = Stopping()
    assert record_evidence(model, scene.train_views, folder).kept == 2
    assert model.asked == 1
    assert (folder / "train_1.json").read_text() == text


def test_other_settings_are_refused_and_named(small, splatseg) -> None:
    assert splatseg("see", small.scene, *CLASSICAL)[0] == 0
    folder = small.scene / "evidence" / "masks"
    before = {p.name: p.read_bytes() for p in folder.iterdir()}
    sentence = refused(splatseg("see", small.scene, *CLASSICAL, "--min-area", "0.1"))
    assert "made in another way (min_area 0.0005 there, 0.1 now)" in sentence
    sentence = refused(splatseg("see", small.scene, *CLASSICAL, "--what", "features"))
    assert "made in another way" in sentence
    assert {p.name: p.read_bytes() for p in folder.iterdir()} == before
    words = (*CLASSICAL, "--min-area", "0.1", "--overwrite")
    status, out, _ = splatseg("see", small.scene, *words)
    assert status == 0
    assert "were there" not in out
    assert header(folder)["metadata"]["settings"]["regions"]["min_area"] == 0.1


def recorded_otherwise(folder, change) -> None:
    """The evidence's header as if another build had written it."""
    path = folder / "evidence.json"
    content = json.loads(path.read_text())
    change(content["metadata"])
    path.write_text(json.dumps(content))


def test_settings_that_came_later_count_as_their_defaults(small, splatseg) -> None:
    words = ("see", small.scene, *CLASSICAL)
    assert splatseg(*words)[0] == 0
    folder = small.scene / "evidence" / "masks"

    def before_least_area(metadata) -> None:
        for key in ("settings", "default_settings"):
            del metadata[key]["regions"]["min_area"]

    recorded_otherwise(folder, before_least_area)
    sentence = refused(splatseg(*words, "--min-area", "0.1"))
    assert "made in another way (min_area 0.0005 there, 0.1 now)" in sentence
    status, out, _ = splatseg(*words)
    assert status == 0
    assert "3 of them were there" in out

    def with_a_setting_that_went(metadata) -> None:
        metadata["settings"]["cut"]["gone"] = 3
        metadata["default_settings"]["cut"]["gone"] = 4

    recorded_otherwise(folder, with_a_setting_that_went)
    assert "(gone 3 there, not known now)" in refused(splatseg(*words))
    recorded_otherwise(folder, lambda m: m["default_settings"]["cut"].update(gone=3))
    assert splatseg(*words)[0] == 0


def test_evidence_that_an_older_build_left_stopped(small, splatseg) -> None:
    words = ("see", small.scene, *CLASSICAL)
    assert splatseg(*words)[0] == 0
    recorded_otherwise(small.scene / "evidence" / "masks", lambda m: m.pop("settings"))
    sentence = refused(splatseg(*words))
    assert "cannot be gone on with, as it does not say how it was made" in sentence
    assert splatseg(*words, "--overwrite")[0] == 0


def test_a_folder_of_something_else_is_never_touched(small, splatseg) -> None:
    folder = small.scene / "evidence" / "masks"
    folder.mkdir(parents=True)
    (folder / "diary.txt").write_text("dear")
    for more in ((), ("--overwrite",)):
        sentence = refused(splatseg("see", small.scene, *CLASSICAL, *more))
        assert "got other files" in sentence
    assert (folder / "diary.txt").read_text() == "dear"
    assert [p.name for p in folder.iterdir()] == ["diary.txt"]


def test_a_second_scene_of_the_same_photographs_copies_evidence(small, splatseg) -> None:
    assert splatseg("see", small.scene, "--model", "classical", "--evidence", "a")[0] == 0
    folder = small.scene / "evidence" / "a"
    assert splatseg("see", small.scene, "--model", folder, "--evidence", "b")[0] == 0
    for name in TRAIN:
        a, b = (small.scene / "evidence" / e / f"{name}.json" for e in "ab")
        assert a.read_bytes() == b.read_bytes()
    status, _, err = splatseg(
        "see", small.scene, "--model", "classical", "--evidence", "c", "--cache", "folder"
    )
    assert status == 2
    assert "copies evidence that another scene of the photographs has" in err


# Models that give other things


class Segmenter:
    name = "segmenter"
    note = ""
    categories = None
    classes = None

    def __init__(self, after: int = 99, size: tuple[int, int] = (HEIGHT, WIDTH)) -> None:
        self.after, self.size, self.asked = after, size, 0
        self.settings: dict = {"pair": (1, 2)}

    def panoptic(self, image) -> Panoptic:
        if self.asked == self.after:
            raise KeyboardInterrupt
        self.asked += 1
        ids = half(10, *self.size)[0].int() + 1
        segments = tuple(
            Segment(id=id, category=id + 3, isthing=id == 2, score=0.5) for id in (1, 2)
        )
        return Panoptic(ids=LabelMap(ids=ids), segments=segments)


def test_panoptic_segments_are_kept_over_a_stop(small) -> None:
    scene = load_scene(small.scene)
    folder = small.scene / "evidence" / "p"
    with pytest.raises(KeyboardInterrupt):
        record_evidence(Segmenter(after=2), scene.train_views, folder)
    model = Segmenter()
    assert record_evidence(model, scene.train_views, folder).kept == 2
    assert model.asked == 1
    evidence = open_evidence(folder)
    assert isinstance(evidence, PanopticEvidence)
    for name in TRAIN:
        assert [s.category for s in evidence.segments(name)] == [4, 5]
        assert evidence.label_map(name).ids.unique().tolist() == [1, 2]
    assert not list(folder.rglob(".*"))
    record_evidence(model, scene.views, folder, EvidenceRequest(view_spec="all"))
    assert len(open_evidence(folder).segments("train_0")) == 2, "the table keeps older views"


def test_what_a_model_cannot_give_is_refused(small, splatseg) -> None:
    sentence = refused(splatseg("see", small.scene, *CLASSICAL, "--what", "labels"))
    assert "one of what it gives (masks, features), got 'labels'" in sentence
    assert not (small.scene / "evidence" / "masks").exists()
    scene = load_scene(small.scene)
    with pytest.raises(ValueError, match="28x20 pixels as the photograph has, got 5x4"):
        record_evidence(Segmenter(size=(4, 5)), scene.views, small.scene / "evidence" / "p")


# Recorded evidence


def test_recorded_masks_are_checked_and_copied(small, splatseg, recorded) -> None:
    words = ("see", small.scene, "--model", recorded, "--evidence", "masks")
    status, out, err = splatseg(*words)
    assert status == 0, err
    assert "1.0 masks a view" in out
    copy = open_evidence(small.scene / "evidence" / "masks")
    assert copy.view_names == TRAIN
    assert torch.equal(copy.masks("train_3").dense(0), half()[0])
    assert copy.masks("train_3").scores.tolist() == [0.75]
    assert header(copy.folder)["metadata"]["settings"]["folder"] == recorded.as_posix()
    shutil.rmtree(small.capture)  # no photograph is needed
    assert splatseg("see", small.scene, "--model", recorded, "--evidence", "again")[0] == 0


@pytest.mark.parametrize("kind", ["npz", "png"])
def test_masks_of_other_layouts_become_ours(small, splatseg, tmp_path, kind) -> None:
    folder = tmp_path / "other"
    folder.mkdir()
    for name in TRAIN:
        if kind == "npz":
            np.savez(folder / f"{name}.npz", masks=half().numpy())
        else:
            (folder / name).mkdir()
            Image.fromarray(half()[0].numpy().astype(np.uint8) * 255).save(folder / name / "0.png")
    words = ("see", small.scene, "--model", folder, "--evidence", "m", "--what", "masks")
    assert splatseg(*words)[0] == 0
    assert torch.equal(
        open_evidence(small.scene / "evidence" / "m").masks("train_1").dense(0), half()[0]
    )


def test_recorded_label_maps_keep_names_and_void(small, splatseg) -> None:
    labels = small.capture / "labels_semantic"
    words = ("see", small.scene, "--model", labels, "--evidence", "seen")
    assert splatseg(*words)[0] == 0
    copy, source = open_evidence(small.scene / "evidence" / "seen"), open_evidence(labels)
    assert copy.kind == "labels"
    assert copy.classes == source.classes
    for name in TRAIN:
        assert torch.equal(copy.label_map(name).ids, source.label_map(name).ids)
    status, _, err = splatseg(*words, "--overwrite", "--void", "2")
    assert status == 0
    assert 2 not in open_evidence(copy.folder).label_map("train_0").ids
    status, _, err = splatseg(*words, "--overwrite", "--zero-is-class")
    assert status == 0
    assert "Ids that the class table does not name" in err, "0 became 1, and sky 2 has no row 1"
    shifted = open_evidence(copy.folder)
    assert shifted.source_ids[2] == 1
    assert torch.equal(
        shifted.label_map("train_1").ids, source.label_map("train_1").ids.clamp(0) + 1
    )


@generated_and("toys")
def test_recorded_panoptic_tracked_and_features_of_other_programs(
    splatseg, rich_capture, tmp_path
) -> None:
    """A scene around two views: every kind is copied and reads back the same."""
    from splatseg.core import Gaussians, Scene
    from splatseg.io.captures import read_capture
    from splatseg.io.scene import save_scene

    views = read_capture(rich_capture).train_views[:2]
    one = Gaussians(
        means=torch.zeros(1, 3),
        rotations=torch.tensor([[1.0, 0, 0, 0]]),
        scales=torch.ones(1, 3),
        opacities=torch.ones(1),
        sh=torch.zeros(1, 1, 3),
    )
    save_scene(Scene(gaussians=one, views=views), tmp_path / "S")
    for name in ("labels_panoptic", "labels_tracked", "features_dino", "features_text"):
        source = open_evidence(rich_capture / name)
        words = ("see", tmp_path / "S", "--model", source.folder, "--evidence", name)
        assert splatseg(*words)[0] == 0
        copy = open_evidence(tmp_path / "S" / "evidence" / name)
        assert copy.kind == source.kind
        assert copy.view_names == tuple(view.name for view in views)
        assert copy.classes == source.classes
        for view in views:
            if source.kind == "features":
                assert torch.equal(
                    copy.features(view.name).features, source.features(view.name).features
                )
            else:
                assert torch.equal(copy.label_map(view.name).ids, source.label_map(view.name).ids)
        if isinstance(source, PanopticEvidence):
            assert copy.segments(views[0].name) == source.segments(views[0].name)
        if isinstance(source, TrackedEvidence):
            assert (copy.tracks, copy.order) == (source.tracks, source.order)
        if name == "features_dino":
            assert copy.blocks == source.blocks
        status, out, _ = splatseg(*words)
        assert status == 0
        assert "2 of them were there" in out
    assert (tmp_path / "S" / "evidence" / "features_text" / "text_embeddings.npz").is_file()


# Bad input: one clear sentence each


def see(splatseg, small, folder, *more):
    return splatseg("see", small.scene, "--model", folder, "--evidence", "x", *more)


def test_masks_of_the_wrong_size(small, splatseg, recorded) -> None:
    save_masks(MaskSet.from_dense(half(5, 10, 14)), recorded, "train_1")
    sentence = refused(see(splatseg, small, recorded))
    assert "view 'train_1': expected 28x20 pixels as the photograph has, got 14x10." in sentence


def test_a_class_map_given_as_a_coloured_picture(small, splatseg, tmp_path) -> None:
    folder = tmp_path / "labels"
    folder.mkdir()
    for name in TRAIN:
        Image.fromarray(np.zeros((HEIGHT, WIDTH, 3), np.uint8)).save(folder / f"{name}.png")
    sentence = refused(see(splatseg, small, folder))
    assert "train_0.png: expected one channel of ids, got RGB" in sentence


def test_ids_that_overflow(small, splatseg, tmp_path) -> None:
    folder = tmp_path / "labels"
    folder.mkdir()
    for name in TRAIN:
        Image.fromarray(np.full((HEIGHT, WIDTH), 70000, np.int32)).save(
            folder / f"{name}.png", format="TIFF"
        )
    sentence = refused(see(splatseg, small, folder))
    assert "train_0.png: expected ids in [0, 65535], got [70000, 70000]." in sentence


def test_views_that_are_missing(small, splatseg, recorded) -> None:
    (recorded / "train_1.json").unlink()
    sentence = refused(see(splatseg, small, recorded))
    assert "1 of the 3 views asked for are missing (train_1)" in sentence
    assert not (small.scene / "evidence" / "x").exists()
    status, _, err = see(splatseg, small, recorded, "--allow-missing")
    assert status == 0
    assert "note: 1 views have no evidence (train_1)." in err
    folder = small.scene / "evidence" / "x"
    assert header(folder)["metadata"]["views_missing"] == ["train_1"]
    sentence = refused(see(splatseg, small, recorded, "--views", "test_2", "--overwrite"))
    assert "evidence of the views asked for (test_2), got none of them but 2 others" in sentence
    assert folder.is_dir(), "what is refused deletes nothing"


def test_empty_masks(small, splatseg, recorded) -> None:
    nothing = torch.zeros(1, HEIGHT, WIDTH, dtype=torch.bool)
    save_masks(MaskSet.from_dense(torch.cat((nothing, half()))), recorded, "train_0")
    save_masks(MaskSet.from_dense(nothing), recorded, "train_1")
    status, _, err = see(splatseg, small, recorded)
    assert status == 0
    assert "note: 2 masks without a pixel were left out (in train_0, train_1)." in err
    assert "note: 1 views have no mask at all (train_1)." in err
    copy = open_evidence(small.scene / "evidence" / "x")
    assert [len(copy.masks(name)) for name in TRAIN] == [1, 0, 1]


def test_features_that_are_nan_or_do_not_cover_the_photograph(small, splatseg, tmp_path) -> None:
    folder = tmp_path / "features"
    folder.mkdir()
    for name in TRAIN:
        cells = torch.zeros(3, 4, 2)
        save_features(FeatureMap(features=cells, stride=8, height=20, width=28), folder, name)
    values = np.zeros((3, 4, 2), np.float16)
    values[0, 0, 0] = np.nan
    np.savez(folder / "train_1.npz", features=values, stride=8, size=[HEIGHT, WIDTH])
    assert "train_1.npz: expected finite features, got 1 of 24" in refused(
        see(splatseg, small, folder)
    )
    cells = torch.zeros(3, 9, 2)
    save_features(FeatureMap(features=cells, stride=8, height=20, width=72), folder, "train_1")
    sentence = refused(see(splatseg, small, folder))
    assert "cells of 8 pixels that cover a photograph of 28x20, got 9x3 cells" in sentence


def test_a_folder_cannot_be_copied_onto_itself(small, splatseg, recorded) -> None:
    assert see(splatseg, small, recorded)[0] == 0
    own = small.scene / "evidence" / "x"
    sentence = refused(see(splatseg, small, own, "--overwrite"))
    assert "another folder than that of the evidence that is read" in sentence
    assert open_evidence(own).view_names == TRAIN


def test_other_words_that_cannot_be_used(small, splatseg, recorded) -> None:
    sentence = refused(see(splatseg, small, "sammy"))
    assert "expected one of classical" in sentence
    assert "got 'sammy'" in sentence
    assert "expected evidence of labels, got masks" in refused(
        see(splatseg, small, recorded, "--what", "labels")
    )
    status, _, error = see(splatseg, small, recorded, "--min-area", "0.2")
    assert status == 2
    assert "Unrecognized options: --min-area" in error
    status, _, error = splatseg("see", small.scene, *CLASSICAL, "--weights", "x/y")
    assert status == 2
    assert "Unrecognized options: --weights" in error
    sentence = refused(splatseg("see", small.scene, *CLASSICAL, "--void", "3"))
    assert "--void" in sentence
    sentence = refused(splatseg("see", small.scene, "--model", "classical", "--evidence", "../up"))
    assert "--evidence" in sentence


def test_files_with_an_ending_of_their_own_are_told(small, splatseg, tmp_path) -> None:
    folder = tmp_path / "predictions"
    folder.mkdir()
    for view in load_scene(small.scene).views:
        np.save(folder / f"{view.name}_pred.npy", np.zeros((3, 3), int))
    words = ("see", small.scene, "--model", folder, "--evidence", "mine")
    assert "--suffix _pred reads them without it." in refused(splatseg(*words))
    np.save(folder / "other.npy", np.zeros((3, 3), int))
    assert "--suffix" not in refused(splatseg(*words)), "it would not read all of them"


def test_label_maps_as_people_have_them(small, splatseg, tmp_path) -> None:
    """Half-size soft maps in float16 with an ending in their names: named, enlarged, said."""
    folder = tmp_path / "predictions"
    folder.mkdir()
    views = [view for view in load_scene(small.scene).views if view.split == "train"]
    rng = np.random.default_rng(0)
    scores = {}
    for view in views:
        height, width = view.camera.height // 2, view.camera.width // 2
        scores[view.name] = rng.normal(size=(133, height, width)).astype(np.float16)
        np.save(folder / f"{view.name}_pred.npy", scores[view.name])
        np.save(folder / f"{view.name}.npy", np.zeros((3, 3), int))
    words = ("--suffix", "_pred", "--classes", "coco", "--json")
    status, text, err = splatseg(
        "see", small.scene, "--model", folder, "--evidence", "mine", *words
    )
    assert status == 0, err
    (note,) = [n for n in json.loads(text)["notes"] if "smaller" in n]
    assert note.startswith(f"{len(views)} label maps were smaller than their photographs")
    assert "nearest" in note
    evidence = open_evidence(small.scene / "evidence" / "mine")
    assert evidence.classes.name_of(1) == "person"
    name = views[0].name
    found = evidence.label_map(name)
    large = scores[name].argmax(axis=0).repeat(2, axis=0).repeat(2, axis=1) + 1
    assert np.array_equal(found.ids.numpy(), large)
    assert float(found.confidence.min()) > 0
    status, _, err = splatseg(
        "see", small.scene, "--model", "classical", "--evidence", "b", "--classes", "coco"
    )
    assert status == 2
    assert "expected with evidence recorded elsewhere" in " ".join(err.split())
