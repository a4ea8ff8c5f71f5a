"""The cache: found by content, the same answer every time, and damaged entries."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
import torch

from splatseg.core import DeepFeatures, Embedding, FeatureMap, LabelMap, MaskSet, Panoptic, Segment
from splatseg.errors import InputError, RangeError
from splatseg.models import ModelCache
from splatseg.models._cache import METHODS


@dataclass
class Counting:
    """A model that counts how often it is asked."""

    name: str = "counting"
    note: str = ""
    settings: Mapping[str, Any] = field(default_factory=dict)
    asked: int = 0
    scale: float = 1.0

    def _values(self, image) -> torch.Tensor:
        self.asked += 1
        rng = np.random.default_rng(int(image.sum()))
        return torch.from_numpy(rng.normal(size=(6, 8, 5)).astype(np.float32)) * self.scale

    def masks(self, image) -> MaskSet:
        values = self._values(image)
        dense = values.permute(2, 0, 1) > 0
        return MaskSet.from_dense(dense, scores=[0.1, 0.2, 0.3, 0.4, 0.5], levels=range(5))

    def label_map(self, image) -> LabelMap:
        values = self._values(image)
        ids = values[..., 0].gt(0).int() * 2 - 1
        return LabelMap(ids=ids, confidence=torch.full((6, 8), 0.25))

    classes = None
    categories = None

    def panoptic(self, image) -> Panoptic:
        segments = (Segment(id=1, category=3, isthing=True, score=0.75),)
        return Panoptic(ids=self.label_map(image), segments=segments)

    def text_features(self, image) -> FeatureMap:
        return FeatureMap(features=self._values(image), stride=4, height=23, width=32)

    def encode_text(self, words) -> torch.Tensor:
        return torch.zeros(len(words), 5)

    def features(self, image) -> DeepFeatures:
        one = self.text_features(image)
        return DeepFeatures(maps=(one, one), depths=("a", "b"), class_token=one.features[0, 0])

    def embed(self, image) -> Embedding:
        arrays = {"deep": self._values(image), "ids": torch.arange(3)}
        return Embedding(model=self.name, height=24, width=32, arrays=arrays, view="v")

    def prompted_masks(self, embedding, prompt) -> MaskSet:
        return MaskSet.from_dense(torch.zeros(0, 6, 8, dtype=torch.bool))


def picture(value: int = 0) -> torch.Tensor:
    return torch.full((6, 8, 3), value, dtype=torch.uint8)


@pytest.fixture
def cache(tmp_path):
    return ModelCache(folder=tmp_path / "cache")


def flat(answer: Any) -> list[Any]:
    """Everything an answer holds, for comparison."""
    if isinstance(answer, MaskSet):
        counts = [m.counts.tolist() for m in answer.masks]
        return [answer.height, answer.width, counts, answer.scores.tolist(), answer.levels.tolist()]
    if isinstance(answer, LabelMap):
        return [answer.ids.tolist(), answer.confidence.tolist()]
    if isinstance(answer, Panoptic):
        return [*flat(answer.ids), answer.segments]
    if isinstance(answer, FeatureMap):
        return [answer.features.tolist(), answer.stride, answer.height, answer.width]
    if isinstance(answer, DeepFeatures):
        return [[flat(m) for m in answer.maps], answer.depths, answer.class_token.tolist()]
    arrays = {name: tensor.tolist() for name, tensor in answer.arrays.items()}
    return [answer.model, answer.height, answer.width, answer.view, arrays]


ASKED = ["masks", "labels", "panoptic", "features", "text", "embedding"]


@pytest.mark.parametrize("what", ASKED)
def test_a_second_question_is_answered_from_disk_with_the_same(cache, what) -> None:
    model = Counting()
    first = cache.ask(what, model, picture())
    asked = model.asked
    second = ModelCache(folder=cache.folder).ask(what, Counting(), picture())
    assert flat(second) == flat(first)
    cache.ask(what, model, picture())
    assert model.asked == asked
    direct = getattr(Counting(), METHODS[what])(picture())
    if what in ("masks", "labels", "panoptic"):
        assert flat(first) == flat(direct), "only floats of features are rounded"


def test_features_are_rounded_no_more_than_their_precision_says(tmp_path) -> None:
    direct = Counting().text_features(picture()).features
    half = ModelCache(folder=tmp_path / "half").ask("text", Counting(), picture()).features
    assert float((half - direct).abs().max()) <= 2**-10
    whole = ModelCache(folder=tmp_path / "int8", precision="int8")
    eighth = whole.ask("text", Counting(), picture()).features
    span = direct.reshape(-1, 5).max(0).values - direct.reshape(-1, 5).min(0).values
    assert bool(((eighth - direct).abs() <= span / 254 / 2 + 1e-6).all())
    assert not torch.equal(eighth, half)


def test_int8_keeps_constant_channels_and_needs_less_room(tmp_path, rng) -> None:
    class Wide(Counting):
        def text_features(self, image) -> FeatureMap:
            values = rng.normal(size=(32, 32, 32)).astype(np.float32)
            values[..., 3] = 7.25
            return FeatureMap(features=torch.from_numpy(values), stride=1, height=32, width=32)

    sizes = {}
    for precision in ("float16", "int8"):
        cache = ModelCache(folder=tmp_path / precision, precision=precision)
        given = cache.ask("text", Wide(), picture()).features
        assert torch.equal(given[..., 3], torch.full((32, 32), 7.25))
        assert cache.size().entries == 1
        sizes[precision] = cache.size().bytes
        files = [p for p in cache.folder.rglob("*") if p.is_file()]
        assert sizes[precision] == sum(p.stat().st_size for p in files)
        assert str(cache.size()) == f"1 entries, {sizes[precision] / 1e3:.1f} kB"
    assert sizes["int8"] < 0.65 * sizes["float16"]
    assert str(ModelCache(folder=tmp_path / "none").size()) == "0 entries, 0.0 kB"


def test_whatever_changes_the_answer_changes_the_entry(cache, tmp_path) -> None:
    model = Counting()
    one = picture()
    one[0, 0, 0] = 1
    questions = [
        ("masks", model, picture()),
        ("features", model, picture()),
        ("masks", model, one),
        ("masks", model, picture().reshape(8, 6, 3)),
        ("masks", Counting(settings={"a": 1}), picture()),
        ("masks", Counting(settings={"a": 2}), picture()),
        ("masks", Counting(name="other"), picture()),
    ]
    entries = {cache.entry(*question) for question in questions}
    entries.add(ModelCache(folder=cache.folder, precision="int8").entry(*questions[0]))
    assert len(entries) == len(questions) + 1
    turned = Counting(settings={"b": 1, "a": {"y": 1, "x": 2}})
    same = Counting(settings={"a": {"x": 2, "y": 1}, "b": 1})
    assert cache.entry("masks", turned, one) == cache.entry("masks", same, one)
    strided = torch.zeros(6, 16, 3, dtype=torch.uint8)[:, ::2]
    assert cache.entry("masks", model, strided) == cache.entry("masks", model, picture())


@pytest.mark.parametrize(
    "damage",
    [
        lambda data: data[: len(data) // 2],
        lambda data: b"",
        lambda data: data[:10],
        lambda data: data[:-1] + bytes([data[-1] ^ 1]),
        lambda data: b"something else, longer than the line and the digest" * 3,
    ],
)
def test_a_damaged_entry_is_named_and_computed_again(cache, damage) -> None:
    told: list[str] = []
    cache = ModelCache(folder=cache.folder, report=told.append)
    model = Counting()
    first = cache.ask("masks", model, picture())
    path = cache.entry("masks", model, picture())
    path.write_bytes(damage(path.read_bytes()))
    again = cache.ask("masks", model, picture())
    assert (flat(again), model.asked) == (flat(first), 2)
    assert len(told) == 1
    assert told[0].startswith(f"{path}: ")
    assert told[0].endswith("the entry is computed again.")
    cache.ask("masks", model, picture())
    assert (model.asked, len(told)) == (2, 1), "the new entry is whole"


def test_a_whole_entry_with_other_content_is_damaged_too(cache) -> None:
    """The digest fits, but the entry does not hold what was asked."""
    import hashlib

    import zstandard

    told: list[str] = []
    cache = ModelCache(folder=cache.folder, report=told.append)
    model = Counting()
    cache.ask("masks", model, picture())
    path = cache.entry("masks", model, picture())
    payload = zstandard.ZstdCompressor().compress(b"no archive")
    head = path.read_bytes().split(b"\n")[0] + b"\n"
    path.write_bytes(head + hashlib.sha256(payload).digest() + payload)
    cache.ask("masks", model, picture())
    assert model.asked == 2
    assert "does not hold what a model gives" in told[0]


def test_a_model_that_fails_leaves_nothing_behind(cache) -> None:
    model = Counting(scale=float("nan"))
    with pytest.raises(RangeError, match="features: .* not finite"):
        cache.ask("text", model, picture())
    with pytest.raises(RangeError, match="as float16"):
        cache.ask("text", Counting(scale=1e6), picture())
    assert cache.size().entries == 0
    assert not list(cache.folder.rglob("*")) or all(p.is_dir() for p in cache.folder.rglob("*"))


def test_where_a_cache_cannot_be(tmp_path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="got a file"):
        ModelCache(folder=tmp_path / "file")
    with pytest.raises(InputError, match="folder that is there"):
        ModelCache(folder=tmp_path / "a" / "b")
    with pytest.raises(InputError, match="precision"):
        ModelCache(folder=tmp_path / "c", precision="float8")
    cache = ModelCache(folder=tmp_path / "c")
    with pytest.raises(InputError, match="settings of model 'counting'"):
        cache.entry("masks", Counting(settings={"a": float("nan")}), picture())
