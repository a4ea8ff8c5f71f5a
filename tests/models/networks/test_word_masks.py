"""Masks of what words mean: by hand, by Grounding DINO with SAM, and by SAM 3."""

import shutil
from pathlib import Path

import pytest
import torch
import torch.nn.functional as F

from splatseg.core import MaskSet
from splatseg.core.models import (
    AutomaticMasks,
    BatchedModel,
    GroundedMasks,
    PanopticSegments,
    Prompt,
    SemanticLabels,
    TextMasks,
)
from splatseg.errors import FileFormatError, InputError, MissingFileError, RangeError
from splatseg.models import LoadOptions, find_model, record_evidence
from splatseg.models.networks import grounding_dino
from splatseg.models.networks.grounding_dino import GroundingDinoOptions, LangSamOptions
from splatseg.models.networks.word_masks import (
    ClipSegOptions,
    Sam3TextOptions,
    segments_of,
    text_masks,
)
from support.checkpoints_text import COLOURS
from support.hub import in_place_of_the_real, local_hub

WORDS = ("chair", "red mug", "table")
ALL = {"box_threshold": 0.0, "text_threshold": 0.0}


@pytest.fixture(autouse=True)
def every_box(monkeypatch) -> None:
    """Boxes that overlap are kept."""
    monkeypatch.setattr(grounding_dino, "MAX_OVERLAP", 1.0)


def image(rng, height: int, width: int) -> torch.Tensor:
    return torch.from_numpy(rng.integers(0, 256, (height, width, 3)).astype("uint8"))


def langsam(checkpoints, *, sam: str = "sam", batch=None, **options):
    family = {"sam_hq": "sam-hq", "sam3_tracker": "sam3"}.get(sam, sam)
    chosen = {"words": WORDS, "sam_model": family, "sam_weights": str(checkpoints(sam))}
    place = LoadOptions(weights=str(checkpoints("grounding_dino")), device="cpu", batch=batch)
    return find_model("langsam", LangSamOptions(**chosen | ALL | options), loading=place)


def sam3(checkpoints, kind: str = "sam3", *, batch=None, size=None, **options):
    place = LoadOptions(weights=str(checkpoints(kind)), device="cpu", batch=batch, size=size)
    chosen = {"words": WORDS, "threshold": 0.0} | options
    return find_model("sam3-text", Sam3TextOptions(**chosen), loading=place)


# By hand


def rows(*ranges: tuple[int, int]) -> torch.Tensor:
    masks = torch.zeros(len(ranges), 6, 4, dtype=torch.bool)
    for mask, (first, last) in zip(masks, ranges, strict=True):
        mask[first:last] = True
    return masks


def test_the_surest_of_overlapping_masks_shows() -> None:
    masks = MaskSet.from_dense(rows((0, 3), (2, 5), (3, 4)), scores=[0.5, 0.9, 0.2])
    found = segments_of(TextMasks(masks=masks, words=(1, 0, 1)))
    assert found.ids.ids[:, 0].tolist() == [1, 1, 2, 2, 2, -1]
    assert [(s.id, s.category, s.isthing) for s in found.segments] == [(1, 2, True), (2, 1, True)]
    assert [s.score for s in found.segments] == pytest.approx([0.5, 0.9])


def test_of_equally_sure_masks_the_first_shows() -> None:
    masks = MaskSet.from_dense(rows((0, 3), (2, 5)), scores=[0.5, 0.5])
    found = segments_of(TextMasks(masks=masks, words=(0, 1)))
    assert found.ids.ids[:, 0].tolist() == [1, 1, 1, 2, 2, -1]


def test_masks_come_surest_first_and_have_a_pixel() -> None:
    masks = MaskSet.from_dense(rows((0, 1), (0, 0), (2, 4))).masks
    found = text_masks(masks, [0.3, 0.9, 0.7], [4, 5, 6], (6, 4))
    assert found.words == (6, 4)
    assert found.masks.scores.tolist() == pytest.approx([0.7, 0.3])
    assert [mask.area for mask in found.masks.masks] == [8, 4]
    with pytest.raises(InputError, match="words: expected one for each of the 2 masks, got 1"):
        TextMasks(masks=found.masks, words=(1,))


# Grounding DINO and SAM


@pytest.mark.parametrize("sam", ["sam", "sam_hq", "sam2", "sam3_tracker"])
def test_langsam_is_a_mask_of_each_box(checkpoints, rng, sam: str) -> None:
    model = langsam(checkpoints, sam=sam)
    for protocol in (AutomaticMasks, PanopticSegments, GroundedMasks, BatchedModel):
        assert isinstance(model, protocol)
    picture = image(rng, 48, 70)
    found = model.grounded_masks(picture, WORDS)
    detector = find_model(
        "grounding-dino",
        GroundingDinoOptions(**ALL),
        loading=LoadOptions(weights=str(checkpoints("grounding_dino")), device="cpu"),
    )
    family = {"sam_hq": "sam-hq", "sam3_tracker": "sam3"}.get(sam, sam)
    segmenter = find_model(family, loading=LoadOptions(weights=str(checkpoints(sam)), device="cpu"))
    boxes = detector.boxes(picture, WORDS)
    embedding = segmenter.embed(picture)
    wanted = [segmenter.prompted_masks(embedding, Prompt(box=b)).masks[0] for b in boxes.boxes]
    kept = [i for i, mask in enumerate(wanted) if mask.area]
    assert len(kept) > 1
    assert found.words == tuple(boxes.words[i] for i in kept)
    torch.testing.assert_close(found.masks.scores, boxes.scores[kept])
    assert [m.area for m in found.masks.masks] == [wanted[i].area for i in kept]
    assert model.masks(picture) is found.masks, "one pass serves all questions"
    assert [(row.id, row.name) for row in model.categories.rows] == list(enumerate(WORDS, start=1))
    segments = model.panoptic(picture)
    assert (segments.ids.height, segments.ids.width) == (48, 70)
    assert {s.id for s in segments.segments} == set(segments.ids.ids.unique().tolist()) - {-1}


def test_langsam_finds_other_words_than_its_own(checkpoints, rng) -> None:
    model = langsam(checkpoints)
    picture = image(rng, 48, 70)
    found = model.grounded_masks(picture, ["table"])
    assert set(found.words) == {0}
    assert not torch.equal(found.masks.scores, model.grounded_masks(picture, WORDS).masks.scores)
    assert len(model.grounded_masks(picture, []).masks) == 0
    assert len(langsam(checkpoints, box_threshold=1.0).masks(picture)) == 0
    silent = langsam(checkpoints, text_threshold=1.0)
    assert len(silent.masks(picture)) == 0
    assert silent.panoptic(picture).segments == ()


def test_langsam_without_words_is_refused_where_it_needs_them(
    checkpoints, rng, views, tmp_path
) -> None:
    model = langsam(checkpoints, words=())
    with pytest.raises(InputError, match="langsam looks for what words name, so expected at least"):
        record_evidence(model, views, tmp_path / "e")
    assert not (tmp_path / "e").exists()
    assert len(model.grounded_masks(image(rng, 40, 50), ["chair"]).masks) > 0
    with pytest.raises(InputError, match="sam_model: expected one of sam, sam-hq, sam2, sam3, got"):
        LangSamOptions(sam_model="fast")
    with pytest.raises(RangeError, match="box_threshold: expected a value in"):
        LangSamOptions(box_threshold=3)
    with pytest.raises(InputError, match="distinct words"):
        LangSamOptions(words=("a", "a"))


def test_images_together_are_as_one_by_one(checkpoints, rng) -> None:
    pictures = [image(rng, 40, 50) for _ in range(3)]
    for make in (langsam, sam3):
        model = make(checkpoints, batch=3)
        assert model.batch_size == 3
        alone = [model.masks(one) for one in pictures]
        model.encode(pictures)
        assert len(model._last._kept) == 3
        for one, picture in zip(alone, pictures, strict=True):
            together = model.masks(picture)
            torch.testing.assert_close(one.scores, together.scores, rtol=0, atol=1e-4)
            areas = [[mask.area for mask in of.masks] for of in (one, together)]
            assert sum(abs(a - b) for a, b in zip(*areas, strict=True)) < 20


def test_the_second_weights_go_by_what_they_hold(checkpoints, tmp_path) -> None:
    model = langsam(checkpoints)
    copy = Path(shutil.copytree(checkpoints("sam"), tmp_path / "elsewhere"))
    assert langsam(checkpoints, sam_weights=str(copy)).settings == model.settings
    segmenter = find_model("sam", loading=LoadOptions(weights=str(copy), device="cpu"))
    assert model.settings["sam_weights"] == segmenter.settings["weights"]
    for name, value in (
        ("words", ("chair",)), ("box_threshold", 0.1), ("text_threshold", 0.1),
    ):  # fmt: skip
        assert langsam(checkpoints, **{name: value}).settings != model.settings
    assert langsam(checkpoints, sam="sam2").settings != model.settings
    with pytest.raises(FileFormatError, match="expected weights of sam2 or sam2_video, got those"):
        langsam(checkpoints, sam_model="sam2")


@pytest.mark.parametrize(
    ("weights", "words"),
    [
        (
            None,
            r"sam2.1-hiera-small is not on this machine \(184 MB.*or --sam-weights FOLDER takes",
        ),
        ("no-such-folder", "there is no such folder of weights"),
    ],
)
def test_second_weights_that_are_not_there(
    checkpoints, monkeypatch, tmp_path, weights, words
) -> None:
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path))
    with pytest.raises(MissingFileError, match=words):
        langsam(checkpoints, sam_model="sam2", sam_weights=weights)


def test_second_weights_are_fetched_by_the_leave_for_the_first(checkpoints, tmp_path) -> None:
    options = LangSamOptions(words=("chair",), sam_model="sam", sam_weights="tiny/sam")
    loading = LoadOptions(weights="tiny/detector", download=True, device="cpu")
    both = {"tiny/detector": checkpoints("grounding_dino"), "tiny/sam": checkpoints("sam")}
    said: list[str] = []
    with local_hub(both) as hub, in_place_of_the_real(hub, tmp_path / "home"):
        model = find_model("langsam", options, loading=loading, report=said.append)
    assert [line.partition(" ")[0] for line in said] == ["tiny/detector:", "tiny/sam:"]
    assert all(": fetching " in line for line in said)
    assert model.note == "weights tiny/detector"


# SAM 3


def test_sam3_finds_what_its_network_finds(checkpoints, rng) -> None:
    model = sam3(checkpoints, threshold=0.3)
    for protocol in (AutomaticMasks, PanopticSegments, GroundedMasks, BatchedModel):
        assert isinstance(model, protocol)
    picture = image(rng, 56, 112)
    batch = F.interpolate(
        picture.permute(2, 0, 1)[None].float(), (112, 112), mode="bilinear", antialias=True
    ).round()
    from support.checkpoints_text import COLOURS

    mean, std = (torch.tensor(COLOURS[name]).view(3, 1, 1) for name in ("image_mean", "image_std"))
    finder = model
    wanted: list[tuple[float, int, int]] = []
    for i, word in enumerate(WORDS):
        asked = finder._tokens._tokenizer(
            word, return_tensors="pt", padding="max_length", max_length=32
        )
        with torch.inference_mode():
            output = finder._network(pixel_values=(batch / 255 - mean) / std, **asked)
        fits = output.pred_logits[0].sigmoid() * output.presence_logits[0].sigmoid()
        for query in (fits >= 0.3).nonzero()[:, 0].tolist():
            mask = F.interpolate(output.pred_masks.sigmoid()[:, query][None], (56, 112),
                                 mode="bilinear")[0, 0] > 0.5  # fmt: skip
            wanted.append((float(fits[query]), i, int(mask.sum())))
    assert 0 < len(wanted) < 30, "some are sure enough and some are not"
    found = model.grounded_masks(picture, WORDS)
    wanted.sort(key=lambda row: -row[0])
    assert found.masks.scores.tolist() == pytest.approx([row[0] for row in wanted], abs=1e-3)
    assert sorted(found.words) == sorted(row[1] for row in wanted)
    areas = sorted(mask.area for mask in found.masks.masks)
    assert areas == pytest.approx(sorted(row[2] for row in wanted), abs=5)
    assert model.masks(picture) is found.masks
    assert (found.masks.height, found.masks.width) == (56, 112)


def test_sam3_encodes_an_image_once(checkpoints, rng, monkeypatch) -> None:
    model = sam3(checkpoints)
    calls: list[int] = []
    last = model._seen
    run = last._run
    monkeypatch.setattr(last, "_run", lambda images: calls.append(len(images)) or run(images))
    picture = image(rng, 40, 50)
    model.masks(picture), model.panoptic(picture), model.grounded_masks(picture, ["mug", "chair"])
    assert calls == [1]
    assert len(model.grounded_masks(picture, []).masks) == 0


def test_sam3_thresholds_and_settings(checkpoints, rng) -> None:
    model = sam3(checkpoints)
    picture = image(rng, 40, 50)
    assert len(sam3(checkpoints, threshold=1.0).masks(picture)) == 0
    sure = sam3(checkpoints, mask_threshold=0.9).masks(picture)
    assert sum(m.area for m in sure.masks) < sum(m.area for m in model.masks(picture).masks)
    others = [{"words": ("chair",)}, {"threshold": 0.2}, {"mask_threshold": 0.2}]
    assert all(sam3(checkpoints, **one).settings != model.settings for one in others)
    with pytest.raises(RangeError, match="mask_threshold: expected a value in .*, got 2"):
        Sam3TextOptions(mask_threshold=2)
    with pytest.raises(RangeError, match="size: sam3 takes 112 alone, got 64"):
        sam3(checkpoints, size=64)
    with pytest.raises(InputError, match="sam3-text looks for what words name"):
        sam3(checkpoints, words=()).masks(picture)
    with pytest.raises(RangeError, match="expected at most 32 tokens, got 42"):
        model.grounded_masks(picture, ["z" * 40])
    with pytest.raises(FileFormatError, match="expected weights of sam3 or sam3_video, got those"):
        sam3(checkpoints, "sam3_tracker")


def test_sam3_as_it_is_published_holds_both(checkpoints, rng) -> None:
    assert len(sam3(checkpoints, "sam3_video").masks(image(rng, 40, 50))) > 0


# CLIPSeg: the likeliest word of every pixel, held to the network's own logits.


def made(checkpoints, *, size=None, batch=None, **options):
    place = LoadOptions(weights=str(checkpoints("clipseg")), size=size, batch=batch, device="cpu")
    return find_model("clipseg", ClipSegOptions(**{"words": WORDS} | options), loading=place)


def own_logits(model, picture: torch.Tensor, sentence: str) -> torch.Tensor:
    """Logits of one sentence by the library's whole network."""
    mean, std = (torch.tensor(COLOURS[name]).view(3, 1, 1) for name in ("image_mean", "image_std"))
    batch = ((picture.permute(2, 0, 1) / 255 - mean) / std)[None]
    from transformers import AutoTokenizer

    ids = AutoTokenizer.from_pretrained(model._place.folder)(sentence, return_tensors="pt")
    with torch.inference_mode():
        return model._network(pixel_values=batch, **ids).logits


def test_every_pixel_has_its_likeliest_word(checkpoints, rng) -> None:
    model = made(checkpoints, threshold=0.4)
    assert isinstance(model, SemanticLabels)
    picture = image(rng, 64, 64)
    logits = torch.cat([own_logits(model, picture, f"a photo of a {word}") for word in WORDS])
    probability, index = logits.sigmoid().max(dim=0)
    wanted = torch.where(probability >= 0.4, index + 1, -1)
    found = model.label_map(picture)
    torch.testing.assert_close(found.confidence, probability, rtol=0, atol=1e-3)
    assert float((found.ids == wanted).float().mean()) > 0.99, "all but ties"
    assert set(found.ids.unique().tolist()) == {-1, 1, 2, 3}, "the test shows all of them"
    assert [(row.id, row.name) for row in model.classes.rows] == list(enumerate(WORDS, start=1))


def test_maps_have_the_size_of_the_photograph(checkpoints, rng) -> None:
    picture = image(rng, 37, 90)
    found = made(checkpoints, threshold=0.0).label_map(picture)
    assert (found.height, found.width) == (37, 90)
    assert int(found.ids.min()) >= 1, "at 0 every pixel has a word"
    none = made(checkpoints, threshold=1.0).label_map(picture)
    assert bool((none.ids == -1).all())
    larger = made(checkpoints, threshold=0.0, size=96).label_map(picture)
    assert not torch.equal(larger.ids, found.ids)


def test_images_together_and_what_is_asked_count(checkpoints, rng) -> None:
    model = made(checkpoints, batch=3)
    assert model.batch_size == 3
    pictures = [image(rng, 30, 40) for _ in range(3)]
    alone = [model.label_map(one).confidence for one in pictures]
    model.encode(pictures)
    assert len(model._last._kept) == 3
    for one, picture in zip(alone, pictures, strict=True):
        torch.testing.assert_close(one, model.label_map(picture).confidence, rtol=0, atol=1e-4)
    others = [
        made(checkpoints, words=("chair",)),
        made(checkpoints, threshold=0.5),
        made(checkpoints, size=96),
    ]
    assert all(other.settings != model.settings for other in others)
    assert model.settings["tokenizer"]


def test_what_is_refused(checkpoints) -> None:
    with pytest.raises(InputError, match="clipseg looks for what words name, so expected at least"):
        made(checkpoints, words=())
    with pytest.raises(RangeError, match="threshold: expected a value in .*, got 1.5"):
        ClipSegOptions(threshold=1.5)
    with pytest.raises(InputError, match="template: this option was removed; words stand in"):
        ClipSegOptions(template="a photo")
    with pytest.raises(RangeError, match="size: expected a multiple of 16, got 100"):
        made(checkpoints, size=100)
    with pytest.raises(FileFormatError, match=r"expected weights of clipseg, got those of 'clip'"):
        find_model(
            "clipseg",
            ClipSegOptions(words=WORDS),
            loading=LoadOptions(weights=str(checkpoints("clip"))),
        )
