"""Features against queries: the kernel and its reference, thresholds, what is refused."""

import math
from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from splatseg import _native
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.prompting import retrieval
from splatseg.prompting.retrieval import (
    StoredFeatures,
    deviation_threshold,
    mean_threshold,
    scores,
)
from support import retrieval as reference


@dataclass
class Retrieved:
    mask: Tensor
    positive: Tensor
    negative: Tensor | None


def retrieve(stored, asked, against=None, *, threshold, gate=None) -> Retrieved:
    """Members in one pass of the kernel, which has what one needs for that."""
    positive = retrieval._folded(stored, asked, gate)
    negative = positive[:0] if against is None else retrieval._folded(stored, against, gate)
    above, mask = torch.empty(len(stored)), torch.empty(len(stored), dtype=torch.uint8)
    below = torch.empty(len(stored)) if len(negative) else None
    squared = gate.square() if gate is not None and stored.similarity == "cosine" else None
    half = stored.panels.dtype == torch.float16
    panels = stored.panels.view(torch.int16) if half else stored.panels
    _native.match_features(
        panels, stored.rows, stored.scales, positive, negative, squared, threshold,
        above, below, mask,
    )  # fmt: skip
    return Retrieved(mask.view(torch.bool), above, below)


# Largest difference of a cosine that rounding of the stored features makes.
LOSS = {"float32": 2e-6, "float16": 1e-3, "int8": 2e-2}


def random(*shape: int, seed: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


@pytest.mark.usefixtures("every_isa")
@pytest.mark.parametrize("count", [0, 1, 15, 16, 17, 500])
@pytest.mark.parametrize("channels", [1, 3, 32, 33])
@pytest.mark.parametrize("precision", list(LOSS))
@pytest.mark.parametrize("similarity", ["cosine", "dot"])
def test_scores_match_the_reference(
    count: int, channels: int, precision: str, similarity: str
) -> None:
    values = random(count, channels, seed=1)
    gate = torch.rand(channels, generator=torch.Generator().manual_seed(2)) + 0.1
    stored = StoredFeatures.of(values, precision=precision, similarity=similarity)
    for queries in (1, 2, 3, 4, 5, 9):
        asked = random(queries, channels, seed=queries)
        for factors in (None, gate):
            got = scores(stored, asked, gate=factors).double()
            want = reference.scores(values, asked, similarity=similarity, gate=factors)
            scale = 1.0 if similarity == "cosine" else 5 * channels
            assert got.shape == (count,)
            torch.testing.assert_close(got, want, rtol=0, atol=LOSS[precision] * scale)


@pytest.mark.usefixtures("every_isa")
@pytest.mark.parametrize("precision", list(LOSS))
def test_the_kernel_rounds_only_as_the_features_are_stored(precision: str) -> None:
    """Against the features as they are stored nothing is lost."""
    stored = StoredFeatures.of(random(300, 24, seed=3), precision=precision, similarity="dot")
    asked = random(6, 24, seed=4)
    kept = stored.panels.transpose(1, 2).reshape(-1, 24)[:300].float()
    kept = kept if stored.scales is None else kept * stored.scales.unsqueeze(1)
    want = reference.scores(kept, asked, similarity="dot")
    torch.testing.assert_close(scores(stored, asked).double(), want, rtol=1e-5, atol=1e-5)


@pytest.mark.usefixtures("every_isa")
@pytest.mark.parametrize("negatives", [None, 0, 1, 6])
def test_members_are_above_the_negative_score_and_the_threshold(negatives: int | None) -> None:
    values, asked = random(700, 8, seed=5), random(2, 8, seed=6)
    against = None if negatives is None else random(negatives, 8, seed=7)
    stored = StoredFeatures.of(values, precision="float32")
    for threshold in (-math.inf, 0.0, 0.5, math.inf):
        found = retrieve(stored, asked, against, threshold=threshold)
        want = reference.retrieve(values, asked, against, threshold=threshold)
        assert torch.equal(found.mask, want)
        assert torch.equal(found.positive, scores(stored, asked))
        if negatives:
            assert found.negative is not None
            assert against is not None
            assert torch.equal(found.negative, scores(stored, against))
        else:
            assert found.negative is None


@pytest.mark.parametrize("precision", list(LOSS))
@pytest.mark.parametrize("threshold", [0.25, 0.3])
def test_thresholds_that_float32_does_not_have(precision: str, threshold: float) -> None:
    """0.3 has to be rounded on its way to the kernel, which nothing else may be."""
    values, asked = random(2000, 8, seed=15), random(2, 8, seed=16)
    found = retrieve(StoredFeatures.of(values, precision=precision), asked, threshold=threshold)
    far = (reference.scores(values, asked) - threshold).abs() > LOSS[precision]
    want = reference.retrieve(values, asked, threshold=threshold)
    assert torch.equal(found.mask[far], want[far])


def test_a_gate_is_the_same_as_gated_features() -> None:
    values, asked = random(90, 16, seed=8), random(3, 16, seed=9)
    gate = torch.sigmoid(random(16, seed=10) * 3)
    plain = StoredFeatures.of(values * gate, precision="float32")
    gated = StoredFeatures.of(values, precision="float32")
    got = retrieve(gated, asked, -asked, threshold=0.3, gate=gate)
    want = retrieve(plain, asked * gate, -asked * gate, threshold=0.3)
    torch.testing.assert_close(got.positive, want.positive, rtol=1e-5, atol=1e-6)
    assert got.negative is not None
    assert want.negative is not None
    torch.testing.assert_close(got.negative, want.negative, rtol=1e-5, atol=1e-6)


def test_lengths_matter_to_products_only() -> None:
    values = torch.tensor([[1.0, 0.0], [4.0, 0.0]])
    asked = torch.tensor([[2.0, 0.0]])
    assert scores(StoredFeatures.of(values), asked).tolist() == [1, 1]
    assert scores(StoredFeatures.of(values, similarity="dot"), asked).tolist() == [2, 8]


def test_nothing_is_like_a_feature_of_zeros() -> None:
    values = torch.tensor([[0.0, 0.0], [0.0, 1e-30], [3e30, 0.0]])
    for precision in LOSS:
        stored = StoredFeatures.of(values, precision=precision)
        got = scores(stored, torch.tensor([[-1.0, -1.0]]))
        torch.testing.assert_close(got, torch.tensor([0, -(0.5**0.5), -(0.5**0.5)]))
        gated = scores(stored, torch.tensor([[-1.0, -1.0]]), gate=torch.tensor([0.0, 1.0]))
        assert gated.tolist() == [0, -1, 0]


def test_memory_is_as_said() -> None:
    values = random(160, 32, seed=11)
    sizes = [StoredFeatures.of(values, precision=p).nbytes for p in LOSS]
    assert sizes == [160 * 128, 160 * 64, 160 * (32 + 4)]


@pytest.mark.bits
@pytest.mark.parametrize("threads", [2, 5])
def test_threads_do_not_matter(threads: int) -> None:
    stored = StoredFeatures.of(random(20_000, 8, seed=12))
    asked = random(5, 8, seed=13)
    before = _native.threads()
    try:
        _native.set_threads(1)
        want = scores(stored, asked)
        _native.set_threads(threads)
        assert torch.equal(scores(stored, asked), want)
    finally:
        _native.set_threads(before)


def test_thresholds_by_hand() -> None:
    found = torch.tensor([0.0, 0.2, 0.4, 0.6, 0.8])
    assert mean_threshold(found) == pytest.approx(0.4)
    assert deviation_threshold(found) == pytest.approx(0.4 + 0.08**0.5)
    assert mean_threshold(found[:0]) == deviation_threshold(found[:0]) == 0


def test_what_is_refused() -> None:
    values = random(4, 3, seed=14)
    stored = StoredFeatures.of(values)
    with pytest.raises(ShapeError, match="values: expected shape"):
        StoredFeatures.of(torch.zeros(3, 0))
    with pytest.raises(ShapeError, match="1 to 1024"):
        StoredFeatures.of(torch.zeros(3, 1025))
    with pytest.raises(RangeError, match="not finite"):
        StoredFeatures.of(torch.tensor([[math.nan]]))
    with pytest.raises(RangeError, match="65504"):
        StoredFeatures.of(torch.tensor([[1e5]]), similarity="dot")
    with pytest.raises(InputError, match="precision"):
        StoredFeatures.of(values, precision="int4")
    with pytest.raises(InputError, match="similarity"):
        StoredFeatures.of(values, similarity="l2")
    with pytest.raises(ShapeError, match="queries: expected shape"):
        scores(stored, values[:, :2])
    with pytest.raises(ShapeError, match="at least one"):
        scores(stored, values[:0])
    with pytest.raises(ShapeError, match="gate"):
        scores(stored, values, gate=torch.ones(2))
    with pytest.raises(RangeError, match="gate"):
        scores(stored, values, gate=torch.tensor([1.0, math.inf, 0]))
