"""LSeg as a model: cells of images and words in one space, from a file of weights."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from splatseg.core.models import BatchedModel, DenseFeatures, TextFeatures
from splatseg.errors import FileFormatError, InputError, MissingFileError, ShapeError
from splatseg.io.evidence import open_evidence
from splatseg.models import EvidenceRequest, LoadOptions, find_family, find_model, record_evidence
from splatseg.models.lseg import LSegOptions
from support.checkpoints_lseg import DECODER, EMBEDDING


def image(rng, height: int, width: int) -> torch.Tensor:
    return torch.from_numpy(rng.integers(0, 256, (height, width, 3)).astype("uint8"))


def made(
    weights: Path | str, *, size: int = 64, report=None, dtype="float32", batch=None, **options
):
    loading = LoadOptions(weights=str(weights), size=size, device="cpu", dtype=dtype, batch=batch)
    return find_model("lseg", LSegOptions(**options), loading=loading, report=report)


def test_it_is_what_the_network_gives(weights: Path, rng) -> None:
    """An image whose cells are the network's own is not resized, padded or averaged."""
    model = made(weights, cell=2)
    assert isinstance(model, TextFeatures)
    assert isinstance(model, DenseFeatures)
    picture = image(rng, 64, 32)
    with torch.inference_mode():
        batch = (picture.permute(2, 0, 1)[None] / 255 - 0.5) / 0.5
        decoded = model._network.image(batch)
        wanted = F.normalize(model._network.head(decoded), dim=1)[0].permute(1, 2, 0)
    found = model.text_features(picture)
    assert (found.stride, found.height, found.width) == (2, 64, 32)
    assert found.features.shape == (32, 16, EMBEDDING)
    torch.testing.assert_close(found.features, wanted, rtol=0, atol=1e-3)
    deep = model.features(picture)
    assert deep.depths == ("decoder",)
    wide = decoded[0].permute(1, 2, 0)
    torch.testing.assert_close(
        deep.maps[0].features, wide, rtol=1e-4, atol=1e-3 * float(wide.std())
    )
    assert float(found.features.std(dim=(0, 1)).mean()) > 0.02, "cells differ"


def test_larger_cells_are_means_of_the_finest(weights: Path, rng) -> None:
    picture = image(rng, 64, 64)
    fine = made(weights, cell=2).features(picture).maps[0].features
    found = made(weights, cell=8).features(picture).maps[0]
    assert found.stride == 8
    wanted = fine.reshape(8, 4, 8, 4, DECODER).mean(dim=(1, 3))
    torch.testing.assert_close(found.features, wanted, rtol=1e-5, atol=1e-3)
    with pytest.raises(InputError, match="cell: expected one of 2, 4, 8, 16, 32, got 3"):
        LSegOptions(cell=3)


def test_cells_lie_on_whole_pixels_of_images_of_any_size(weights: Path, rng) -> None:
    for height, width, stride in ((33, 61, 4), (7, 5, 1), (130, 200, 12)):
        model = made(weights)
        found = model.text_features(image(rng, height, width))
        assert (found.stride, found.height, found.width) == (stride, height, width)
        assert found.features.shape[:2] == (-(-height // stride), -(-width // stride))
        norms = found.features.norm(dim=2)
        torch.testing.assert_close(norms, torch.ones_like(norms))


def test_beyond_the_border_the_image_is_continued(weights: Path, rng) -> None:
    """Of the continued image, which needs no padding, the cells of the image are the same."""
    picture = image(rng, 40, 56)
    whole = torch.cat([picture, picture[-1:].expand(24, -1, -1)])
    whole = torch.cat([whole, whole[:, -1:].expand(-1, 8, -1)], dim=1)
    found = made(weights, size=56).features(picture).maps[0].features
    wanted = made(weights, size=64).features(whole).maps[0].features
    assert wanted.shape[:2] == (16, 16)
    torch.testing.assert_close(found, wanted[:10, :14], rtol=1e-5, atol=1e-4)


def test_the_head_comes_after_what_is_linear(weights: Path, rng) -> None:
    model = made(weights)
    picture = image(rng, 40, 48)
    decoded = model.features(picture).maps[0].features
    torch.testing.assert_close(model.in_word_space(decoded), model.text_features(picture).features)
    weight, bias = (one.detach() for one in model._network.head.parameters())
    mean = decoded.mean(dim=(0, 1))
    wanted = F.normalize(weight[:, :, 0, 0] @ mean + bias, dim=0)
    torch.testing.assert_close(model.in_word_space(mean), wanted)
    assert not model.in_word_space(mean).is_inference()
    with pytest.raises(ShapeError, match="decoded"):
        model.in_word_space(torch.zeros(3, EMBEDDING))


def test_words_are_unit_vectors_by_what_they_say(weights: Path) -> None:
    model = made(weights)
    words = ["chair", "a chair", "lamp"]
    found = model.encode_text(words)
    assert found.shape == (3, EMBEDDING)
    torch.testing.assert_close(found.norm(dim=1), torch.ones(3))
    assert float((found[0] - found[1]).norm()) > 0.01
    torch.testing.assert_close(model.encode_text(["chair"])[0], found[0], msg="alone as together")
    assert torch.equal(model.encode_text(["CHAIR"]), model.encode_text(["chair"]))
    assert model.encode_text([]).shape == (0, EMBEDDING)
    with pytest.raises(InputError, match=r"at most 12 tokens, got 14 for 'a b c"):
        model.encode_text(["a b c d e f g h i j k l"])


def test_where_words_are_looked_for(weights: Path, tmp_path, rng) -> None:
    alone = tmp_path / "alone"
    alone.mkdir()
    shutil.copy(weights / "demo_e200.ckpt", alone)
    model = made(alone / "demo_e200.ckpt")
    assert model.note == "weights demo_e200.ckpt"
    model.text_features(image(rng, 20, 20))  # needs no words
    with pytest.raises(MissingFileError, match="expected CLIP's vocabulary beside the weights"):
        model.encode_text(["chair"])
    other = made(alone, tokenizer=str(weights))
    wanted = made(weights).encode_text(["chair"])
    assert torch.equal(other.encode_text(["chair"]), wanted)
    assert other.settings == model.settings, "where the vocabulary lies changes no answer"
    for none in (str(alone), "openai/clip-vit-base-patch32", "nowhere"):
        with pytest.raises(MissingFileError, match="tokenizer: expected a folder with tokenizer"):
            made(alone, tokenizer=none)
    parts = tmp_path / "hub" / "models--tiny--clip"
    (parts / "refs").mkdir(parents=True)
    (parts / "refs" / "main").write_text("abc")
    shutil.copytree(weights, parts / "snapshots" / "abc")
    assert torch.equal(made(alone, tokenizer="tiny/clip").encode_text(["chair"]), wanted)


def test_vocabularies_of_other_networks(weights: Path, tmp_path) -> None:
    from transformers import CLIPTokenizer

    CLIPTokenizer.from_pretrained(weights).save_pretrained(tmp_path / "whole")
    (tmp_path / "whole" / "vocab.json").unlink(missing_ok=True)
    whole = made(weights, tokenizer=str(tmp_path / "whole")).encode_text(["chair"])
    assert torch.equal(whole, made(weights).encode_text(["chair"]))
    folder = Path(shutil.copytree(weights, tmp_path / "other"))
    numbers = json.loads((folder / "vocab.json").read_text())
    (folder / "vocab.json").write_text(json.dumps(numbers | {"extra": len(numbers)}))
    count = len(numbers)
    with pytest.raises(FileFormatError, match=f"vocabulary of {count} tokens, .* got {count + 1}"):
        made(weights, tokenizer=str(folder))
    (folder / "vocab.json").write_text("{")
    with pytest.raises(
        FileFormatError, match="expected the tokenizer of the weights, but it cannot be"
    ):
        made(weights, tokenizer=str(folder))


def test_files_and_folders_of_weights(weights: Path, tmp_path) -> None:
    file = made(weights / "demo_e200.ckpt")
    assert file.settings == made(weights).settings, "the file of a folder"
    copy = shutil.copy(weights / "demo_e200.ckpt", tmp_path / "renamed.ckpt")
    assert made(copy).settings == file.settings, "by content, not by name"
    tensors = torch.load(copy, weights_only=True)
    tensors["state_dict"]["net.scratch.head1.bias"] += 1
    torch.save(tensors, tmp_path / "other.ckpt")
    assert made(tmp_path / "other.ckpt").settings != file.settings
    with pytest.raises(MissingFileError, match=r"one file of weights .*, got other.ckpt, renamed"):
        made(tmp_path)
    (tmp_path / "empty").mkdir()
    with pytest.raises(MissingFileError, match=r"one file of weights .*, got none"):
        made(tmp_path / "empty")


def test_weights_that_are_not_there_name_what_serves() -> None:
    for asked in (None, "gone.ckpt", "isl-org/lseg"):
        with pytest.raises(MissingFileError) as caught:
            find_model("lseg", loading=LoadOptions(weights=asked))
        sentence = str(caught.value)
        assert "demo_e200.ckpt (1620 MB, licence MIT; on Google Drive, linked from" in sentence
        assert "dense CLIP or SigLIP 2 (--model clip, siglip2)" in sentence
        assert "\n" not in sentence
        assert sentence.count(". ") == 0


def test_tensors_that_nothing_is_known_of_are_told(weights: Path, tmp_path) -> None:
    content = torch.load(weights / "demo_e200.ckpt", weights_only=True)
    content["state_dict"] |= {f"net.more.{i}": torch.ones(1) for i in range(4)}
    torch.save(content, tmp_path / "more.ckpt")
    told: list[str] = []
    made(tmp_path / "more.ckpt", report=told.append)
    (sentence,) = told
    assert "4 tensors are not of LSeg and not used (more.0, more.1, more.2, ...)." in sentence
    made(weights, report=told.append)
    assert len(told) == 1


def test_images_together_are_as_one_by_one(weights: Path, rng) -> None:
    model = made(weights, batch=3)
    assert isinstance(model, BatchedModel)
    assert model.batch_size == 3
    pictures = [image(rng, 40, 50) for _ in range(3)]
    alone = [model.text_features(one).features for one in pictures]
    model.encode(pictures)
    for one, other in zip(pictures, alone, strict=True):
        torch.testing.assert_close(model.text_features(one).features, other, rtol=0, atol=1e-4)


def test_settings_tell_answers_apart(weights: Path, rng) -> None:
    model = made(weights)
    assert model.settings["cell"] == 4
    assert model.default_settings == model.settings
    for other in (made(weights, size=96), made(weights, cell=8), made(weights, dtype="bfloat16")):
        assert other.settings != model.settings
    half = made(weights, dtype="bfloat16")
    picture = image(rng, 64, 64)
    exact, rounded = (one.text_features(picture).features for one in (model, half))
    assert rounded.dtype == torch.float32
    assert 0 < float((exact - rounded).abs().max()) < 0.3
    assert half.encode_text(["chair"]).dtype == torch.float32


def test_see_writes_text_features_and_the_decoders_map(weights: Path, views, tmp_path) -> None:
    assert find_family("lseg").gives == ("text", "features")
    seen = record_evidence(
        made(weights), views, tmp_path / "lseg", EvidenceRequest(what=("text", "features"))
    )
    widths = [one.folder for one in (seen, *seen.further)]
    first, second = (open_evidence(folder).features(views[0].name) for folder in widths)
    assert first.channels == EMBEDDING
    assert second.channels == DECODER
    norms = first.features.norm(dim=2)
    np.testing.assert_allclose(norms, 1, atol=2e-3)
