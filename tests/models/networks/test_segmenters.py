"""Mask classification networks: names of classes, queries, and tiny checkpoints."""

import itertools
import json
import shutil

import pytest
import torch
import torch.nn.functional as F

from splatseg.core import ClassInfo, ClassTable
from splatseg.core.models import BatchedModel, PanopticSegments, SemanticLabels
from splatseg.errors import FileFormatError, InputError, RangeError
from splatseg.io.label_tables import label_table
from splatseg.models import LoadOptions, find_model
from splatseg.models._images import IMAGENET
from splatseg.models.networks import segmenters
from splatseg.models.networks.segmenters import (
    NetworkClasses,
    Queries,
    SegmenterOptions,
    SemanticOptions,
    enlarged,
    map_of_scores,
    network_classes,
    panoptic_segments,
    semantic_map,
    window_starts,
)
from support.checkpoints_labels import save_tokenizer


def names_of(table: str) -> dict[str, str]:
    rows = label_table(f"{table}-train").classes.rows
    return {str(row.id): row.name for row in rows}


def test_a_known_table_tells_things_and_colours() -> None:
    """Half the names may be synonyms; colours and things come by the place in the order."""
    labels = names_of("ade20k")
    labels |= {"8": "window ", "13": "earth, ground", "43": "signboard, sign"}
    found = network_classes({"id2label": labels}, count=150, things=True)
    assert found.note == "things and stuff as in ade20k"
    assert found.table.name_of(1) == "wall"
    assert found.table.name_of(9) == "window"
    assert found.table.name_of(14) == "earth"
    assert not found.is_thing(1)
    assert found.is_thing(9)
    assert found.table.rows[0].colour == (120, 120, 120)
    for name, count in (("coco", 133), ("cityscapes", 19)):
        found = network_classes({"id2label": names_of(name)}, count=count, things=True)
        assert found.note.endswith(name)
        assert {row.isthing for row in found.table.rows} == {True, False}


def test_other_classes_are_what_the_head_is_for() -> None:
    labels = {"0": "cup", "1": "spoon, ladle", "2": "spoon, tea", "4": "plate"}
    found = network_classes({"id2label": labels}, count=5, things=True)
    assert [row.name for row in found.table.rows] == [
        "cup", "spoon, ladle", "spoon, tea", "class 3", "plate",
    ]  # fmt: skip
    assert [row.id for row in found.table.rows] == [1, 2, 3, 4, 5]
    assert all(row.isthing for row in found.table.rows)
    assert "all taken for things" in found.note
    found = network_classes({"id2label": labels}, count=5, things=False)
    assert not any(row.isthing for row in found.table.rows)
    assert "all taken for stuff" in found.note
    shuffled = dict(zip(names_of("cityscapes"), reversed(names_of("cityscapes").values())))  # noqa: B905
    found = network_classes({"id2label": shuffled}, count=19, things=True)
    assert "no known table" in found.note
    assert network_classes({}, count=2, things=True).table.name_of(2) == "class 1"


def test_a_background_is_no_class() -> None:
    labels = {"0": "Background", "1": "skin"}
    found = network_classes({"id2label": labels}, count=2, things=False)
    assert found.void == 0
    assert [(row.id, row.name) for row in found.table.rows] == [(2, "skin")]
    assert network_classes({"id2label": {"0": "wall", "1": "b"}}, count=2, things=True).void is None


# Queries of mask classification networks: scenes solved by hand, and the library's own way.


SURE = 20.0


def classes_of(count: int, *, stuff=(), void: int | None = None) -> NetworkClasses:
    rows = [ClassInfo(id=c + 1, name=f"c{c}", isthing=c not in stuff) for c in range(count)]
    rows = [row for row in rows if row.id - 1 != void]
    return NetworkClasses(table=ClassTable(rows=tuple(rows)), count=count, void=void, note="")


def queries_of(probabilities, masks) -> Queries:
    """Of probabilities of classes and none, and of probabilities of masks."""
    masks = torch.as_tensor(masks, dtype=torch.float32).clamp(1e-6, 1 - 1e-6)
    return Queries(classes=torch.tensor(probabilities).log(), masks=masks.logit())


def random_queries(rng, *, count: int, classes: int, size: tuple[int, int]) -> Queries:
    """Blobs, of queries that are mostly sure."""
    logits = torch.from_numpy(rng.normal(size=(count, classes + 1))).float() * 4
    coarse = torch.from_numpy(rng.normal(size=(1, count, 5, 6))).float() * 6
    return Queries(classes=logits, masks=F.interpolate(coarse, size, mode="bicubic")[0])


def whole(maps, height: int, width: int, **more) -> torch.Tensor:
    return torch.cat([strip for _, strip in enlarged(maps, height, width, **more)], dim=1)


@pytest.mark.parametrize("size", [(33, 40), (7, 9), (5, 6)])
@pytest.mark.parametrize("values", [1 << 25, 100])
def test_strips_are_the_whole(rng, monkeypatch, size, values) -> None:
    monkeypatch.setattr(segmenters, "_VALUES", values)
    maps = torch.from_numpy(rng.normal(size=(3, 5, 6))).float()
    wanted = F.interpolate(maps[None], size, mode="bilinear")[0]
    torch.testing.assert_close(whole(maps, *size), wanted, rtol=0, atol=1e-5)
    count = len(list(enlarged(maps, *size, beside=3)))
    assert (count > 1) == (values == 100), "little memory takes several strips"


def test_padding_is_left_out() -> None:
    """A ramp over 4 of 6 rows and 5 of 10 columns at twice the size is the ramp."""
    rows = torch.arange(6.0)[:, None].expand(6, 10)
    columns = torch.arange(10.0)[None].expand(6, 10)
    found = whole(torch.stack((rows, columns)), 8, 10, covered=(4 / 6, 5 / 10))
    torch.testing.assert_close(found[0, 1:, 0], (torch.arange(1, 8) + 0.5) / 2 - 0.5)
    torch.testing.assert_close(found[1, 0, 1:], (torch.arange(1, 10) + 0.5) / 2 - 0.5)


def test_a_label_map_by_hand() -> None:
    """Two queries share a class and together beat a third that is surer of another one."""
    queries = queries_of(
        [[0.6, 0.0001, 0.3999], [0.6, 0.0001, 0.3999], [0.0001, 0.9, 0.0999]],
        [[[0.9, 0.9, 0.1]], [[0.9, 0.1, 0.1]], [[0.9, 0.9, 0.2]]],
    )
    found = semantic_map(queries, 1, 3, classes=classes_of(2), options=SemanticOptions())
    assert found.ids.tolist() == [[1, 2, 2]]
    expected = torch.tensor([[1.0, 0.81, 0.18]])  # 1.08, clamped
    torch.testing.assert_close(found.confidence, expected, rtol=0, atol=1e-3)
    sure = SemanticOptions(min_confidence=0.5)
    found = semantic_map(queries, 1, 3, classes=classes_of(2), options=sure)
    assert found.ids.tolist() == [[1, 2, -1]]
    found = semantic_map(queries, 1, 3, classes=classes_of(2, void=0), options=sure)
    assert found.ids.tolist() == [[-1, 2, -1]]


def test_scores_are_logits_or_are_not() -> None:
    scores = torch.tensor([[[2.0, 0.3]], [[0.0, 0.5]]])
    more = {"classes": classes_of(2), "options": SemanticOptions()}
    found = map_of_scores(scores, 1, 2, logits=True, **more)
    assert found.ids.tolist() == [[1, 2]]
    torch.testing.assert_close(found.confidence, scores.softmax(0).max(0).values)
    found = map_of_scores(scores, 1, 2, logits=False, **more)
    torch.testing.assert_close(found.confidence, torch.tensor([[1.0, 0.5]]))


def row(*runs: tuple[int, float]) -> list[list[float]]:
    return [[value for count, value in runs for _ in range(count)]]


def test_segments_by_hand() -> None:
    """A chair, half of it behind a table; a wall in two queries; a query that is not sure."""
    queries = queries_of(
        [
            [0.98, 0.005, 0.005, 0.01],  # chair, on the first 10; the table takes 5 of them
            [0.005, 0.99, 0.001, 0.004],  # table, on 5 to 15
            [0.004, 0.001, 0.99, 0.005],  # wall, on 15 to 25
            [0.003, 0.001, 0.995, 0.001],  # wall, on 25 to 30
            [0.79, 0.1, 0.1, 0.01],  # chair, not sure
            [0.005, 0.004, 0.001, 0.99],  # none, on everything
        ],
        [
            row((5, 0.95), (5, 0.6), (20, 0.0)),
            row((5, 0.0), (10, 0.9), (15, 0.0)),
            row((15, 0.0), (10, 0.9), (5, 0.0)),
            row((25, 0.0), (5, 0.9)),
            row((30, 0.999)),
            row((30, 0.999)),
        ],
    )
    classes = classes_of(3, stuff={2})
    found = panoptic_segments(queries, 1, 30, classes=classes, options=SegmenterOptions())
    assert found.ids.ids.tolist() == [[-1] * 5 + [1] * 10 + [2] * 15], "the chair is hidden"
    rows = [(s.id, s.category, s.isthing, round(s.score, 3)) for s in found.segments]
    assert rows == [(1, 2, True, 0.99), (2, 3, False, 0.995)]
    more = SegmenterOptions(min_visible=0.4)
    found = panoptic_segments(queries, 1, 30, classes=classes, options=more)
    assert found.ids.ids.tolist() == [[1] * 5 + [2] * 10 + [3] * 15]
    assert [s.category for s in found.segments] == [1, 2, 3]
    all_things = panoptic_segments(queries, 1, 30, classes=classes_of(3), options=more)
    assert [s.category for s in all_things.segments] == [1, 2, 3, 3], "two walls"
    unsure = SegmenterOptions(min_score=0.7, min_visible=0.0)
    found = panoptic_segments(queries, 1, 30, classes=classes, options=unsure)
    assert int((found.ids.ids == -1).sum()) == 0
    strict = SegmenterOptions(mask_threshold=0.92, min_visible=0.4)
    found = panoptic_segments(queries, 1, 30, classes=classes, options=strict)
    assert [s.category for s in found.segments] == [1], "others have no pixel that sure"
    void = classes_of(3, stuff={2}, void=1)
    found = panoptic_segments(queries, 1, 30, classes=void, options=more)
    assert found.ids.ids.tolist() == [[1] * 10 + [-1] * 5 + [2] * 15], "nothing hides nothing"
    none = SegmenterOptions(min_score=1.0)
    found = panoptic_segments(queries, 1, 30, classes=classes, options=none)
    assert found.segments == ()
    assert found.ids.ids.unique().tolist() == [-1]


def library_output(queries: Queries, **more):
    from types import SimpleNamespace

    return SimpleNamespace(
        class_queries_logits=queries.classes[None], masks_queries_logits=queries.masks[None], **more
    )


def test_label_maps_agree_with_the_library(rng) -> None:
    """Its size of 384 is taken, at which it enlarges nothing."""
    transformers = pytest.importorskip("transformers")
    queries = random_queries(rng, count=9, classes=5, size=(384, 384))
    processor = transformers.Mask2FormerImageProcessorPil()
    wanted = processor.post_process_semantic_segmentation(library_output(queries))[0]
    found = semantic_map(queries, 384, 384, classes=classes_of(5), options=SemanticOptions())
    assert len(wanted.unique()) > 2
    assert float((found.ids - 1 == wanted).float().mean()) > 0.9999


def test_segments_agree_with_the_library(rng) -> None:
    """EoMT's is the published recipe: masks above the threshold, padding cropped first."""
    transformers = pytest.importorskip("transformers")
    size = {"shortest_edge": 64, "longest_edge": 64}
    processor = transformers.EomtImageProcessorPil(size=size)
    several = 0
    for _ in range(20):
        queries = random_queries(rng, count=8, classes=4, size=(64, 64))
        cropped = Queries(classes=queries.classes, masks=queries.masks, covered=(0.75, 1.0))
        wanted = processor.post_process_panoptic_segmentation(
            library_output(queries), target_sizes=[(48, 64)], stuff_classes=[0, 1], threshold=0.6,
            overlap_mask_area_threshold=0.5,
        )[0]  # fmt: skip
        found = panoptic_segments(
            cropped, 48, 64, classes=classes_of(4, stuff={0, 1}),
            options=SegmenterOptions(min_score=0.6, min_visible=0.5),
        )  # fmt: skip
        ids = torch.where(found.ids.ids > 0, found.ids.ids - 1, -1)
        assert torch.equal(ids, wanted["segmentation"].to(torch.int32))
        assert [s.category - 1 for s in found.segments] == [
            one["label_id"] for one in wanted["segments_info"]
        ]
        several += len(found.segments) > 1
    assert several > 8


def test_segments_agree_with_those_of_mask2former(rng) -> None:
    """It holds masks times scores against the threshold, so all scores are near 1 here."""
    transformers = pytest.importorskip("transformers")
    queries = random_queries(rng, count=8, classes=4, size=(384, 384))
    sure = Queries(classes=queries.classes * 100, masks=queries.masks)
    wanted = transformers.Mask2FormerImageProcessorPil().post_process_panoptic_segmentation(
        library_output(sure), threshold=0.8, overlap_mask_area_threshold=0.1, label_ids_to_fuse={0}
    )[0]
    options = SegmenterOptions(min_score=0.8, min_visible=0.1)
    found = panoptic_segments(sure, 384, 384, classes=classes_of(4, stuff={0}), options=options)
    labels = [one["label_id"] for one in wanted["segments_info"]]
    fused = [c for i, c in enumerate(labels) if c != 0 or c not in labels[:i]]
    assert len(fused) > 1
    assert [s.category - 1 for s in found.segments] == fused
    inside = found.ids.ids > 0  # the library gives a segment pixels that are not in its mask
    assert torch.equal(found.ids.ids[inside], wanted["segmentation"][inside])


@pytest.mark.parametrize("name", ["min_score", "mask_threshold", "min_visible", "min_confidence"])
def test_options_are_shares(name: str) -> None:
    with pytest.raises(RangeError, match=name):
        SegmenterOptions(**{name: 1.5})


# MaskFormer, Mask2Former, OneFormer and EoMT: their own classes from tiny checkpoints.


KINDS = [("maskformer", "maskformer"), ("mask2former", "mask2former"), ("oneformer", "oneformer"),
         ("eomt", "eomt"), ("eomt", "eomt_dinov3")]  # fmt: skip
MANY = {"min_score": 0.2, "min_visible": 0.05, "mask_threshold": 0.3}
SIZE = 64


def made(folder, family: str, *, batch: int | None = None, size: int | None = SIZE, **options):
    if family == "oneformer":
        save_tokenizer(folder)
    loading = LoadOptions(weights=str(folder), batch=batch, size=size, device="cpu")
    return find_model(family, SegmenterOptions(**MANY | options), loading=loading)


def image(rng, height: int, width: int) -> torch.Tensor:
    coarse = torch.from_numpy(rng.uniform(0, 255, (1, 3, 5, 6))).float()
    smooth = F.interpolate(coarse, (height, width), mode="bilinear")[0]
    return smooth.permute(1, 2, 0).to(torch.uint8).contiguous()


def normalised(picture: torch.Tensor) -> torch.Tensor:
    mean, std = (torch.tensor(values).view(3, 1, 1) for values in IMAGENET)
    return ((picture.permute(2, 0, 1) / 255 - mean) / std)[None]


@pytest.mark.parametrize(("family", "kind"), KINDS)
def test_it_is_what_the_network_gives(checkpoints, rng, family: str, kind: str) -> None:
    """Of an image of the input's size nothing is resized; EoMT's is padded with black below."""
    model = made(checkpoints(kind), family)
    for protocol in (SemanticLabels, PanopticSegments, BatchedModel):
        assert isinstance(model, protocol)
    assert "no known table" in model.note
    picture = image(rng, 32, 64)
    found = model.label_map(picture)
    batch = normalised(picture)
    if family == "eomt":
        batch = normalised(F.pad(picture, (0, 0, 0, 0, 0, 32)))
    words = {}
    if family == "oneformer":  # the, task, is, semantic
        words["task_inputs"] = torch.tensor([[2, 3, 4, 6] + [0] * 73])
    with torch.inference_mode():
        output = model._network(batch, **words)
    masks = F.interpolate(output.masks_queries_logits, batch.shape[-2:], mode="bilinear")[0, :, :32]
    shares = output.class_queries_logits[0].softmax(-1)[:, :-1]
    scores = torch.einsum("qc,qhw->chw", shares, masks.sigmoid())
    best = scores.max(0)
    assert float((found.ids == best.indices + 1).float().mean()) > 0.995
    torch.testing.assert_close(found.confidence, best.values.clamp(0, 1), rtol=0, atol=1e-3)
    assert float(found.confidence.std()) > 1e-3
    names = [row.name for row in model.classes.rows]
    assert names == ["wall", "floor", "chair", "table", "lamp", "lamp, desk"]
    assert model.categories is model.classes


@pytest.mark.parametrize(("family", "kind"), KINDS)
def test_segments(checkpoints, rng, family: str, kind: str) -> None:
    model = made(checkpoints(kind), family)
    counts = []
    for _ in range(4):
        found = model.panoptic(image(rng, 40, 70))
        assert (found.ids.height, found.ids.width) == (40, 70)
        ids = sorted({int(i) for i in found.ids.ids.unique()} - {-1})
        assert ids == [segment.id for segment in found.segments]
        assert all(1 <= one.category <= 6 and one.isthing for one in found.segments)
        counts.append(len(ids))
    assert max(counts) > 1
    fewer = made(checkpoints(kind), family, min_score=1.0).panoptic(image(rng, 40, 70))
    assert fewer.segments == ()


def test_options_count(checkpoints, rng) -> None:
    picture = image(rng, 48, 64)
    plain = made(checkpoints("mask2former"), "mask2former")
    before = plain.label_map(picture)
    half = float(before.confidence.median())
    found = made(checkpoints("mask2former"), "mask2former", min_confidence=half).label_map(picture)
    assert torch.equal(found.ids == -1, before.confidence < half)
    for name, value in {"min_visible": 1.0, "mask_threshold": 0.99, "min_score": 0.99}.items():
        other = made(checkpoints("mask2former"), "mask2former", **{name: value})
        assert other.settings != plain.settings
        assert not torch.equal(other.panoptic(picture).ids.ids, plain.panoptic(picture).ids.ids)
    assert plain.default_settings["min_score"] == 0.8
    assert plain.default_settings | MANY == plain.settings


def test_the_sizes_of_the_weights_and_of_the_user(checkpoints, rng, monkeypatch, tmp_path) -> None:
    folder = tmp_path / "weights"
    shutil.copytree(checkpoints("mask2former"), folder)
    content = {"size": {"shortest_edge": 64, "longest_edge": 90}, "size_divisor": 32}
    (folder / "preprocessor_config.json").write_text(json.dumps(content))
    sizes = []
    for size in (None, 96):
        model = made(folder, "mask2former", size=size)
        run = model._network.forward
        monkeypatch.setattr(
            model._network, "forward",
            lambda x, run=run, **more: sizes.append(tuple(x.shape[-2:])) or run(x, **more),
        )  # fmt: skip
        model.label_map(image(rng, 60, 80))
        assert model.settings["size"] == (size or 0)
    assert sizes == [(64, 96), (64, 96)]
    bare = made(checkpoints("mask2former"), "mask2former", size=None)
    assert bare._frame(600, 800).inner_height == 800, "the published size"


def test_one_pass_serves_both_questions(checkpoints, rng, monkeypatch) -> None:
    pictures = [image(rng, 32, 64) for _ in range(2)]
    passes = {"mask2former": [2], "oneformer": [2, 2]}  # OneFormer is told its task
    for family, wanted in passes.items():
        model = made(checkpoints(family), family, batch=2)
        assert model.batch_size == 2
        alone = [model.panoptic(one) for one in pictures]
        calls: list[int] = []
        run = model._network.forward

        def counted(batch, calls=calls, run=run, **words):
            calls.append(len(batch))
            return run(batch, **words)

        monkeypatch.setattr(model._network, "forward", counted)
        model.encode(pictures)
        together = [model.panoptic(one) for one in pictures]
        for one in pictures:
            model.label_map(one)
        assert calls == wanted
        for one, other in zip(alone, together, strict=True):
            assert float((one.ids.ids == other.ids.ids).float().mean()) > 0.99


def test_oneformer_is_told_its_task(checkpoints, rng) -> None:
    """Label maps and segments come of different passes, and so of different queries."""
    model = made(checkpoints("oneformer"), "oneformer")
    assert {k: v[0, :4].tolist() for k, v in model._tokens.items()} == {
        "semantic": [2, 3, 4, 6], "panoptic": [2, 3, 4, 5],
    }  # fmt: skip
    assert all(tokens.shape == (1, 77) for tokens in model._tokens.values())
    assert not model._tokens["semantic"][0, 4:].any()
    picture = image(rng, 32, 64)
    semantic, panoptic = (model._of(task, picture) for task in ("semantic", "panoptic"))
    assert not torch.equal(semantic.classes, panoptic.classes)


def test_oneformer_without_its_tokenizer(checkpoints, tmp_path) -> None:
    folder = tmp_path / "weights"
    names = shutil.ignore_patterns("tokenizer*", "special*")
    shutil.copytree(checkpoints("oneformer"), folder, ignore=names)
    with pytest.raises(FileFormatError, match="expected a tokenizer beside the weights"):
        find_model("oneformer", loading=LoadOptions(weights=str(folder), device="cpu"))
    (folder / "tokenizer.json").write_text("{}")
    with pytest.raises(
        FileFormatError, match="expected the tokenizer of the weights, but it cannot be read"
    ):
        find_model("oneformer", loading=LoadOptions(weights=str(folder), device="cpu"))


def test_eomt_looks_through_windows_where_its_weights_say_so(
    checkpoints, rng, monkeypatch, tmp_path
) -> None:
    """Windows are averaged where they overlap, and each is what the network says of it alone."""
    folder = tmp_path / "weights"
    shutil.copytree(checkpoints("eomt"), folder)
    content = {"do_split_image": True, "size": {"shortest_edge": 64, "longest_edge": None}}
    (folder / "preprocessor_config.json").write_text(json.dumps(content))
    model = made(folder, "eomt")
    picture = image(rng, 100, 64)
    found = model.label_map(picture)
    parts = []
    for start in (0, 36):
        with torch.inference_mode():
            output = model._network(normalised(picture[start : start + 64]))
        masks = F.interpolate(output.masks_queries_logits, (64, 64), mode="bilinear")[0]
        shares = output.class_queries_logits[0].softmax(-1)[:, :-1]
        parts.append(torch.einsum("qc,qhw->chw", shares, masks.sigmoid()))
    total = torch.cat(
        (parts[0][:, :36], (parts[0][:, 36:] + parts[1][:, :28]) / 2, parts[1][:, 28:]), 1
    )
    torch.testing.assert_close(found.confidence, total.max(0).values.clamp(0, 1), rtol=0, atol=1e-4)
    assert float((found.ids == total.argmax(0) + 1).float().mean()) > 0.99
    wide = model.label_map(picture.transpose(0, 1).contiguous())
    assert (wide.height, wide.width) == (64, 100)
    assert float((found.ids == wide.ids.T).float().mean()) < 1, "the network is no symmetric one"
    plain = made(checkpoints("eomt"), "eomt").label_map(picture)
    assert not torch.equal(plain.confidence, found.confidence)
    assert model.panoptic(picture).ids.height == 100
    square = model.label_map(image(rng, 70, 70))
    assert (square.height, square.width) == (70, 70)


@pytest.mark.parametrize("length", [64, 65, 100, 128, 129, 700])
def test_windows_cover_all_of_an_axis(length: int) -> None:
    starts = window_starts(length, 64)
    assert starts[0] == 0
    assert starts[-1] + 64 == max(length, 64)
    gaps = [later - earlier for earlier, later in itertools.pairwise(starts)]
    assert all(0 < gap <= 64 for gap in gaps)
    assert len(starts) == -(-length // 64)


def test_what_is_refused(checkpoints, tmp_path) -> None:
    with pytest.raises(
        InputError, match=r"size: expected 64, the only one that eomt takes, got 96"
    ):
        made(checkpoints("eomt"), "eomt", size=96)
    with pytest.raises(FileFormatError, match=r"expected weights of mask2former, got those of"):
        made(checkpoints("maskformer"), "mask2former")
    folder = tmp_path / "weights"
    shutil.copytree(checkpoints("mask2former"), folder)
    (folder / "model.safetensors").write_bytes(b"nothing")
    with pytest.raises(FileFormatError, match="expected weights of Mask2FormerForUniversal"):
        made(folder, "mask2former")
