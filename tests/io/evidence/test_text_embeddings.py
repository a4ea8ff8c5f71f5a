"""Vectors of words in a file: written and read back, and what is refused."""

from dataclasses import replace

import pytest
import torch

from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.io.evidence import TextEmbeddings, load_text_embeddings, save_text_embeddings

WORDS = TextEmbeddings(
    labels=("chair", "Öl, rot", "stuff"),
    vectors=torch.tensor([[1.0, 0.0], [0.6, 0.8], [0.0, 1.0]]),
    kinds=("class", "synonym", "negative"),
    target_ids=(4, -1, -1),
)


def test_what_is_written_is_read(tmp_path) -> None:
    save_text_embeddings(WORDS, tmp_path)
    found = load_text_embeddings(tmp_path)
    assert torch.equal(found.vectors, WORDS.vectors)
    for name in ("labels", "kinds", "target_ids"):
        assert getattr(found, name) == getattr(WORDS, name)
    first = (tmp_path / "text_embeddings.npz").read_bytes()
    save_text_embeddings(WORDS, tmp_path)
    assert (tmp_path / "text_embeddings.npz").read_bytes() == first


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        ({"vectors": torch.ones(2, 2)}, ShapeError, r"vectors: expected shape \(3, any\)"),
        ({"vectors": torch.full((3, 2), torch.nan)}, RangeError, "vectors: 6 of 6 values"),
        ({"kinds": ("class",)}, ShapeError, "kinds: expected one for each of 3 words, got 1"),
        ({"target_ids": ()}, ShapeError, "target_ids: expected one for each of 3 words, got 0"),
        ({"labels": ("a", "b", "a")}, InputError, "labels: expected distinct words"),
    ],
)
def test_what_is_refused(tmp_path, change, error, words) -> None:
    with pytest.raises(error, match=words):
        save_text_embeddings(replace(WORDS, **change), tmp_path)
    assert not list(tmp_path.iterdir())
