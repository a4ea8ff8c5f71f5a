"""SAM 2 and SAM 3 as trackers: as the library's own run over a whole video, in bounded memory."""

import shutil
import weakref
from types import SimpleNamespace

import pytest
import torch
import torch.nn.functional as F

from splatseg.core import LabelMap
from splatseg.core.models import MaskTracker, Prompt
from splatseg.errors import FileFormatError, MissingPackageError, RangeError, ShapeError
from splatseg.models import LoadOptions, find_family, find_model
from splatseg.models._images import IMAGENET, Normalisation, frame_of, network_input
from splatseg.models.networks import sam_video
from splatseg.models.networks.sam_video import SamVideoOptions, VideoMemory, highest, session_of

KINDS = [("sam2-video", "sam2_video", "Sam2Video"),
         ("sam3-video", "sam3_tracker_video", "Sam3TrackerVideo")]  # fmt: skip
HEIGHT, WIDTH = 64, 64


def made(checkpoints, family: str, kind: str, **options):
    loading = LoadOptions(weights=str(checkpoints(kind)), device="cpu")
    return find_model(family, SamVideoOptions(**options), loading=loading)


def video(rng, count: int, height: int = HEIGHT, width: int = WIDTH):
    base = torch.from_numpy(rng.integers(0, 256, (height, width, 3)).astype("uint8"))
    return [(f"v{i}", base.roll(3 * i, 1)) for i in range(count)]


def marked(**boxes: tuple[int, int, int, int]) -> LabelMap:
    ids = torch.full((HEIGHT, WIDTH), -1, dtype=torch.int32)
    for name, (top, bottom, left, right) in boxes.items():
        ids[top:bottom, left:right] = int(name.removeprefix("id"))
    return LabelMap(ids=ids)


TWO = marked(id5=(10, 30, 10, 30), id9=(36, 50, 40, 60))


def pixel_values(images, library_name: str = "Sam2Video") -> torch.Tensor:
    """To the bit what ours are: rounding comes back through the memories of bfloat16."""
    colours = IMAGENET if library_name == "Sam2Video" else ((0.5, 0.5, 0.5), (0.5, 0.5, 0.5))
    frame = frame_of(HEIGHT, WIDTH, size=64, shape="square")
    found = network_input(
        images,
        frame,
        Normalisation(mean=colours[0], std=colours[1]),
        device=torch.device("cpu"),
        dtype=torch.float32,
    )
    mean, std = (torch.tensor(values).view(3, 1, 1) for values in colours)
    wanted = (torch.stack(images).permute(0, 3, 1, 2) / 255 - mean) / std
    torch.testing.assert_close(found, wanted, rtol=0, atol=1e-5)
    return found


@pytest.mark.parametrize(("family", "kind", "library_name"), KINDS)
def test_it_is_what_the_library_makes_of_a_whole_video(
    checkpoints, rng, family, kind, library_name
) -> None:
    """Frames one at a time, with what is old dropped, against a session that holds them all."""
    model = made(checkpoints, family, kind)
    assert isinstance(model, MaskTracker)
    frames = video(rng, 9)
    ours = dict(model.track(iter(frames), {"v0": TWO}))
    session = session_of(
        library_name,
        video=pixel_values([image for _, image in frames], library_name),
        video_height=HEIGHT,
        video_width=WIDTH,
        dtype=torch.float32,
    )
    for id in (5, 9):
        mask = (TWO.ids == id).float()[None, None]
        session.add_mask_inputs(session.obj_id_to_idx(id), 0, mask)
    session.obj_with_new_inputs = [5, 9]
    with torch.inference_mode():
        model._network(inference_session=session, frame_idx=0)
    memory = VideoMemory(
        model._network, session_of(library_name, dtype=torch.float32), seeds_remembered=4
    )
    masks = {id: (TWO.ids == id).float()[None, None] for id in (5, 9)}
    present = 0
    for output in model._network.propagate_in_video_iterator(session):
        memory.next_frame()
        pixels = pixel_values([frames[output.frame_idx][1]], library_name)
        ids, logits, there = memory.follow(pixels, masks if output.frame_idx == 0 else {})
        assert ids == (5, 9)
        torch.testing.assert_close(logits, output.pred_masks[:, 0], rtol=0, atol=1e-6)
        torch.testing.assert_close(there, output.object_score_logits[:, 0], rtol=0, atol=1e-6)
        if output.frame_idx == 0:
            assert torch.equal(ours["v0"].ids, TWO.ids), "to the pixel, where it is seeded"
            continue
        full = F.interpolate(output.pred_masks, (HEIGHT, WIDTH), mode="bilinear")[:, 0]
        logits, winner = full.max(dim=0)
        wanted = torch.where(logits > 0, torch.tensor([5, 9])[winner], -1)
        assert torch.equal(ours[f"v{output.frame_idx}"].ids, wanted.int())
        present += len(torch.unique(wanted)) - 1
    assert len(ours) == 9
    assert present > 4, "the tracker finds something, or nothing is compared"


def numbers_kept(session) -> int:
    """Numbers in all tensors that a session holds, by storage."""
    seen, sizes, left = set(), 0, [vars(session), vars(session.cache)]
    while left:
        one = left.pop()
        if isinstance(one, torch.Tensor):
            key = one.untyped_storage().data_ptr()
            sizes += 0 if key in seen else one.untyped_storage().nbytes()
            seen.add(key)
        elif isinstance(one, dict):
            left += [*one.keys(), *one.values()]
            sizes += len(one)  # entries that grow would be a leak too, if a slow one
        elif isinstance(one, list | tuple):
            left += one
    return sizes


@pytest.mark.parametrize(("family", "kind", "_"), KINDS)
def test_memory_does_not_grow_with_the_frames(
    checkpoints, rng, monkeypatch, family, kind, _
) -> None:
    """Nor with seeds that say again where known objects are."""
    sessions, kept, alive = [], [], []

    def noted(*args, **options):
        sessions.append(session_of(*args, **options))
        return sessions[-1]

    monkeypatch.setattr(sam_video, "session_of", noted)
    model = made(checkpoints, family, kind, seeds_remembered=2)
    pictures = []

    def frames():
        for name, image in video(rng, 24):
            picture = image.clone()
            pictures.append(weakref.ref(picture))
            yield name, picture
            del picture

    seeds = {f"v{i}": TWO for i in (0, 3, 6, 9, 12, 15, 18, 21)}
    for _, ids in model.track(frames(), seeds):
        kept.append(numbers_kept(sessions[0]))
        del ids
        alive.append(sum(picture() is not None for picture in pictures))
    assert kept[11] == kept[14] == kept[20] == kept[23]
    assert max(kept) < 3 * kept[0]
    assert max(alive) <= 2


def test_what_is_kept_of_a_frame(checkpoints, rng) -> None:
    """Frame 7, of networks that look at the memories of 2 frames and the pointers of 3 before."""
    model = made(checkpoints, "sam2-video", "sam2_video")
    session = session_of("Sam2Video", dtype=torch.float32)
    memory = VideoMemory(model._network, session, seeds_remembered=4)
    masks = {id: (TWO.ids == id).float()[None, None] for id in (5, 9)}
    for i, (_, image) in enumerate(video(rng, 8)):
        memory.next_frame()
        memory.follow(pixel_values([image]), {} if i else masks)
    pointers = {"object_pointer", "object_score_logits"}
    memories = pointers | {"maskmem_features", "maskmem_pos_enc"}
    for outputs in session.output_dict_per_obj.values():
        tracked = outputs["non_cond_frame_outputs"]
        assert {i: set(one) for i, one in tracked.items()} == {
            4: pointers, 5: memories, 6: memories, 7: memories | {"pred_masks"},
        }  # fmt: skip
        assert set(outputs["cond_frame_outputs"][0]) == memories
        features = tracked[7]["maskmem_features"]
        assert features.untyped_storage().nbytes() == features.nbytes, "of one object, not of all"


def test_more_seeds_are_remembered_if_one_wants(checkpoints, rng) -> None:
    seeds = {f"v{i}": TWO for i in range(4)}
    frames = video(rng, 7)
    few, many = (
        dict(made(checkpoints, "sam2-video", "sam2_video", seeds_remembered=n).track(frames, seeds))
        for n in (1, 9)
    )
    assert torch.equal(few["v3"].ids, TWO.ids)
    assert any(not torch.equal(few[f"v{i}"].ids, many[f"v{i}"].ids) for i in (4, 5, 6))
    with pytest.raises(RangeError, match="seeds_remembered: expected at least 1, got 0"):
        SamVideoOptions(seeds_remembered=0)


def test_before_the_first_seed_there_is_nothing(checkpoints, rng, monkeypatch) -> None:
    model = made(checkpoints, "sam2-video", "sam2_video")
    frames = video(rng, 4)
    late = dict(model.track(frames, {"v2": TWO}))
    assert list(late) == ["v0", "v1", "v2", "v3"]
    assert all(bool((late[name].ids == -1).all()) for name in ("v0", "v1"))
    early = dict(model.track(frames[2:], {"v2": TWO}))
    assert torch.equal(late["v3"].ids, early["v3"].ids)
    none = dict(model.track(frames[:2], {}))
    assert all(bool((ids.ids == -1).all()) for ids in none.values())


def test_later_seeds_add_and_correct(checkpoints, rng) -> None:
    model = made(checkpoints, "sam3-video", "sam3_tracker_video")
    frames = video(rng, 5)
    one, other = marked(id5=(10, 30, 10, 30)), marked(id9=(36, 50, 40, 60), id5=(0, 10, 0, 10))
    other.ids[5, 5] = -1  # a hole that the network's coarser mask has not
    plain = dict(model.track(frames, {"v0": one}))
    found = dict(model.track(frames, {"v0": one, "v2": other}))
    assert torch.equal(found["v1"].ids, plain["v1"].ids)
    assert torch.equal(found["v2"].ids, other.ids), "5 is where the later seed says, and only there"
    assert not torch.equal(found["v3"].ids, plain["v3"].ids)
    later = torch.cat([found[f"v{i}"].ids for i in (3, 4)])
    assert set(later.unique().tolist()) == {-1, 5, 9}
    third = dict(model.track(frames, {"v0": one, "v2": marked(id9=(36, 50, 40, 60))}))
    assert torch.equal(third["v2"].ids == 9, TWO.ids == 9)
    rest = third["v2"].ids != 9
    assert torch.equal(third["v2"].ids[rest], plain["v2"].ids[rest]), "5 is followed beside it"


def test_a_frame_that_comes_again_is_answered_anew(checkpoints, rng) -> None:
    """With the seed that it has by then, as if it had come so at first."""
    model = made(checkpoints, "sam2-video", "sam2_video")
    frames, later = video(rng, 6), marked(id9=(36, 50, 40, 60), id5=(0, 10, 0, 10))
    wanted = dict(model.track(frames, {"v0": TWO, "v3": later}))
    seeds, seen = {"v0": TWO}, []

    def twice():
        for name, image in frames:
            yield name, image
            if name == "v3":
                seeds["v3"] = later
                yield name, image

    for name, ids in model.track(twice(), seeds):
        seen.append((name, ids))
    assert [name for name, _ in seen] == ["v0", "v1", "v2", "v3", "v3", "v4", "v5"]
    assert not torch.equal(seen[3][1].ids, later.ids)
    assert all(torch.equal(ids.ids, wanted[name].ids) for name, ids in seen[4:])
    again = [*frames[:4], frames[3], *frames[4:]]
    same = dict(model.track(again, {"v0": TWO, "v3": later}))
    assert all(torch.equal(same[name].ids, wanted[name].ids) for name in wanted)


def test_absent_objects_and_overlaps(checkpoints, rng, monkeypatch) -> None:
    """The highest logit has the pixel; an object that is not in the view has none."""
    left, right = torch.full((4, 4), -3.0), torch.full((4, 4), -3.0)
    left[:, :3], right[:, 1:] = 2.0, 1.0
    right[0] = 4.0
    found = highest([7, 4], torch.stack((left, right)), (4, 4))
    assert found.tolist() == [[4] * 4, *[[7, 7, 7, 4]] * 3]
    assert highest([7, 4], torch.ones(2, 2, 2), (1, 1)).item() == 4, "of equal ones the lower id"
    assert highest([], torch.zeros(0, 1, 1), (2, 3)).tolist() == [[-1] * 3] * 2
    model = made(checkpoints, "sam2-video", "sam2_video")
    run = sam_video.VideoMemory.follow
    scores = {5: 1.0, 9: 0.0}

    def scripted(memory, pixels, seeds):
        ids, logits, _ = run(memory, pixels, seeds)
        height = torch.tensor([3.0, 4.0])[:, None, None].expand_as(logits)
        return ids, height, torch.tensor([scores[id] for id in ids])

    monkeypatch.setattr(sam_video.VideoMemory, "follow", scripted)
    ids = dict(model.track(video(rng, 2), {"v0": TWO}))["v1"].ids
    assert bool((ids == 5).all()), "9 is said to be absent, as its logit is not above 0"


def test_views_of_any_size(checkpoints, rng) -> None:
    model = made(checkpoints, "sam2-video", "sam2_video")
    (_, small), (_, large) = video(rng, 2, 30, 40)[0], video(rng, 2, 50, 90)[1]
    ids = torch.full((30, 40), -1, dtype=torch.int32)
    ids[5:20, 5:20] = 1
    found = dict(model.track([("a", small), ("b", large)], {"a": LabelMap(ids=ids)}))
    assert tuple(found["b"].ids.shape) == (50, 90)
    with pytest.raises(ShapeError, match=r"seeds\['b'\]: expected shape \(50, 90\)"):
        dict(model.track([("b", large)], {"b": LabelMap(ids=ids)}))


def test_the_tracker_of_sam3_as_it_is_published(checkpoints, rng) -> None:
    """The detector is left aside; the backbone is the detector's, which both share."""
    from safetensors.torch import load_file

    model = made(checkpoints, "sam3-video", "sam3_whole")
    stored = load_file(checkpoints("sam3_whole") / "model.safetensors")
    loaded = model._network.state_dict()
    block = "backbone.layers.0.mlp.fc1.weight"
    for ours, theirs in (
        (f"vision_encoder.{block}", f"detector_model.vision_encoder.{block}"),
        ("vision_encoder.neck.fpn_layers.0.proj1.weight", "tracker_neck.fpn_layers.0.proj1.weight"),
        ("mask_decoder.conv_s0.weight", "tracker_model.mask_decoder.conv_s0.weight"),
    ):
        assert torch.equal(loaded[ours], stored[theirs])
    found = dict(model.track(video(rng, 3), {"v0": TWO}))
    assert torch.equal(found["v0"].ids, TWO.ids)


@pytest.mark.parametrize(
    ("image_family", "family", "kind", "library_name"),
    [("sam2", *KINDS[0]), ("sam3", "sam3-video", "sam3_whole", "Sam3TrackerVideo")],
)
def test_the_first_frame_of_a_video_is_an_image(
    checkpoints, rng, image_family, family, kind, library_name
) -> None:
    """A point on it gives the mask that the same weights give as a model of images."""
    tracker = made(checkpoints, family, kind)
    ((_, picture),) = video(rng, 1)
    loading = LoadOptions(weights=str(checkpoints(kind)), device="cpu")
    model = find_model(image_family, loading=loading)
    session = session_of(
        library_name, video=pixel_values([picture], library_name), dtype=torch.float32
    )
    point = {"point_coords": torch.tensor([[[[40.0, 20.0]]]]),
             "point_labels": torch.ones(1, 1, 1, dtype=torch.int32)}  # fmt: skip
    session.add_point_inputs(session.obj_id_to_idx(1), 0, point)
    session.obj_with_new_inputs = [1]
    with torch.inference_mode():
        output = tracker._network(inference_session=session, frame_idx=0)
    assert float(output.object_score_logits) > 0
    wanted = F.interpolate(output.pred_masks, (HEIGHT, WIDTH), mode="bilinear")[0, 0] > 0
    embedding = model.embed(picture)
    found = model.prompted_masks(embedding, Prompt(points=torch.tensor([[40.0, 20.0]])))
    assert bool(wanted.any())
    assert int((found.masks[0].decode() != wanted).sum()) <= 4, "rounding at the border at most"


def test_settings_and_refusals(checkpoints, monkeypatch, tmp_path) -> None:
    model = made(checkpoints, "sam2-video", "sam2_video", seeds_remembered=3)
    assert model.settings["seeds_remembered"] == 3
    assert model.default_settings["seeds_remembered"] == 4
    assert (model.settings["size"], find_family("sam2-video").gives) == (64, ("tracked",))
    with pytest.raises(FileFormatError, match="weights of sam2_video, got those of 'sam2'"):
        made(checkpoints, "sam2-video", "sam2")
    weights = str(checkpoints("sam2_video"))
    with pytest.raises(RangeError, match="size: sam2_video takes 64 alone, got 128"):
        find_model("sam2-video", loading=LoadOptions(weights=weights, size=128))
    broken = shutil.copytree(weights, tmp_path / "broken")
    (broken / "model.safetensors").write_bytes(b"no weights")
    with pytest.raises(FileFormatError, match="expected weights of Sam2VideoModel"):
        find_model("sam2-video", loading=LoadOptions(weights=str(broken)))


def test_a_library_whose_session_has_moved(monkeypatch) -> None:
    moved = SimpleNamespace(__version__="9.1")
    monkeypatch.setattr(sam_video, "library", lambda: moved)
    with pytest.raises(MissingPackageError, match=r"needs Sam2VideoInferenceSession .*\(9.1\) has"):
        session_of("Sam2Video")
    module = SimpleNamespace(Sam2VideoInferenceSession=lambda **options: options)
    moved.Sam2VideoModel = SimpleNamespace(__module__="beside")
    monkeypatch.setitem(sam_video.importlib.sys.modules, "beside", module)
    assert session_of("Sam2Video", dtype=1) == {"dtype": 1}
