"""Queries of mask classification networks: scenes solved by hand, and the library's own way."""

import pytest
import torch
import torch.nn.functional as F

from splatseg.core import ClassInfo, ClassTable
from splatseg.errors import RangeError
from splatseg.models.networks import segmenters
from splatseg.models.networks.segmenters import (
    NetworkClasses,
    Queries,
    SegmenterOptions,
    SemanticOptions,
    enlarged,
    map_of_scores,
    panoptic_segments,
    semantic_map,
)

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
