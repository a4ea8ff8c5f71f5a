"""CLIP and SigLIP: patches and words in one space, held to the networks' own answers."""

import json
import shutil
from pathlib import Path

import pytest
import torch
import torch.nn.functional as F

from splatseg.core.models import BatchedModel, TextFeatures, TextFeaturesWithWords
from splatseg.errors import FileFormatError, InputError, RangeError
from splatseg.io.evidence import load_text_embeddings, open_evidence
from splatseg.models import EvidenceRequest, LoadOptions, find_model, record_evidence
from splatseg.models.networks.clip import ClipOptions, SiglipOptions, in_patches
from support.checkpoints_text import COLOURS

KINDS = [("clip", "clip"), ("siglip2", "siglip"), ("siglip2", "siglip2")]
OPTIONS = {"clip": ClipOptions, "siglip2": SiglipOptions}
NEGATIVES = ("object", "things", "stuff", "texture")


def made(checkpoints, family: str, kind: str, *, size=None, batch=None, **options):
    place = LoadOptions(weights=str(checkpoints(kind)), size=size, batch=batch, device="cpu")
    return find_model(family, OPTIONS[family](**options), loading=place)


def image(rng, height: int, width: int) -> torch.Tensor:
    return torch.from_numpy(rng.integers(0, 256, (height, width, 3)).astype("uint8"))


def coloured(picture: torch.Tensor) -> torch.Tensor:
    """A picture as the checkpoint's preprocessor_config.json wants it."""
    mean, std = (torch.tensor(COLOURS[name]).view(3, 1, 1) for name in ("image_mean", "image_std"))
    return ((picture.permute(2, 0, 1) / 255 - mean) / std)[None]


def network_of(model):
    return model._network


def rows_of(found) -> torch.Tensor:
    return found.features.reshape(-1, found.channels)


def test_a_patch_of_clip_attends_to_itself_alone(checkpoints, rng) -> None:
    """MaskCLIP is the last block with a mask that leaves every token to itself."""
    model = made(checkpoints, "clip", "clip", size=80)
    picture = image(rng, 48, 80)
    vision = network_of(model).vision_model
    with torch.inference_mode():
        first = vision(
            coloured(picture), interpolate_pos_encoding=True, output_hidden_states=True
        ).hidden_states[-2]
        alone = torch.full((16, 16), -torch.inf).fill_diagonal_(0)
        block = vision.encoder.layers[-1]
        tokens = block(first, attention_mask=alone[None, None])
        tokens = tokens if isinstance(tokens, torch.Tensor) else tokens[0]
        wanted = network_of(model).visual_projection(vision.post_layernorm(tokens[0, 1:]))
    found = model.text_features(picture)
    assert (found.stride, tuple(found.features.shape[:2])) == (16, (3, 5))
    torch.testing.assert_close(rows_of(found), F.normalize(wanted, dim=-1), rtol=0, atol=1e-4)
    assert float(rows_of(found).std(dim=0).mean()) > 0.01, "patches differ"


def test_plain_patches_of_clip_are_its_last_tokens(checkpoints, rng) -> None:
    picture = image(rng, 48, 80)
    model = made(checkpoints, "clip", "clip", size=80, patches="plain")
    network = network_of(model)
    with torch.inference_mode():
        output = network.vision_model(coloured(picture), interpolate_pos_encoding=True)
        tokens = network.vision_model.post_layernorm(output.last_hidden_state[0, 1:])
        wanted = F.normalize(network.visual_projection(tokens), dim=-1)
    found = rows_of(model.text_features(picture))
    torch.testing.assert_close(found, wanted, rtol=0, atol=1e-4)
    value = made(checkpoints, "clip", "clip", size=80)
    assert not torch.allclose(found, rows_of(value.text_features(picture)), atol=1e-2)
    assert value.settings != model.settings
    with pytest.raises(InputError, match="patches: expected one of value, plain, got 'query'"):
        ClipOptions(patches="query")


@pytest.mark.parametrize("kind", ["siglip", "siglip2"])
def test_the_only_patch_of_an_image_is_the_image(checkpoints, rng, kind: str) -> None:
    """Pooling over one token is that token, whatever the query is."""
    model = made(checkpoints, "siglip2", kind, size=16)
    picture = image(rng, 16, 16)
    if kind == "siglip":
        more = {"pixel_values": coloured(picture), "interpolate_pos_encoding": True}
    else:
        more = {
            "pixel_values": in_patches(coloured(picture), 16),
            "pixel_attention_mask": torch.ones(1, 1, dtype=torch.int32),
            "spatial_shapes": torch.tensor([[1, 1]]),
        }
    with torch.inference_mode():
        wanted = network_of(model).get_image_features(**more).pooler_output
    found = model.text_features(picture).features
    assert tuple(found.shape[:2]) == (1, 1)
    torch.testing.assert_close(found[0], F.normalize(wanted, dim=-1), rtol=0, atol=1e-5)


@pytest.mark.parametrize("kind", ["siglip", "siglip2"])
def test_patches_of_siglip_pass_the_head_one_by_one(checkpoints, rng, kind: str) -> None:
    model = made(checkpoints, "siglip2", kind, size=80)
    picture = image(rng, 48, 80)
    vision = network_of(model).vision_model
    if kind == "siglip":
        more = {"pixel_values": coloured(picture), "interpolate_pos_encoding": True}
    else:
        more = {
            "pixel_values": in_patches(coloured(picture), 16),
            "pixel_attention_mask": torch.ones(1, 15, dtype=torch.int32),
            "spatial_shapes": torch.tensor([[3, 5]]),
        }
    with torch.inference_mode():
        tokens = vision(**more).last_hidden_state[0]
        wanted = F.normalize(vision.head(tokens[:, None]), dim=-1)
    found = rows_of(model.text_features(picture))
    torch.testing.assert_close(found, wanted, rtol=0, atol=1e-4)
    assert float(found.std(dim=0).mean()) > 0.01, "patches differ"


def test_patches_are_cut_as_the_library_cuts_them(rng) -> None:
    from transformers.models.siglip2.image_processing_pil_siglip2 import convert_image_to_patches

    batch = torch.from_numpy(rng.normal(size=(1, 3, 32, 48)))
    wanted = torch.from_numpy(convert_image_to_patches(batch[0].numpy(), 16))
    assert torch.equal(in_patches(batch, 16)[0], wanted)


@pytest.mark.parametrize(("family", "kind"), KINDS)
def test_words_are_what_the_text_encoder_gives(checkpoints, family, kind) -> None:
    model = made(checkpoints, family, kind, template="look, {}")
    assert isinstance(model, TextFeatures)
    assert isinstance(model, TextFeaturesWithWords)
    words = ["a chair", "Table"]
    found = model.encode_text(words)
    tokenizer = model._tokens._tokenizer
    with torch.inference_mode():
        for word, vector in zip(words, found, strict=True):
            if family == "clip":
                ids = tokenizer(f"look, {word}", return_tensors="pt").input_ids
            else:
                text = f"look, {word}".lower()
                ids = tokenizer(
                    text, return_tensors="pt", padding="max_length", max_length=40
                ).input_ids
            wanted = network_of(model).get_text_features(input_ids=ids).pooler_output[0]
            torch.testing.assert_close(vector, F.normalize(wanted, dim=0), rtol=0, atol=1e-5)
    assert not torch.allclose(found[0], found[1], atol=1e-2)
    other = made(checkpoints, family, kind)
    assert not torch.allclose(other.encode_text(words), found, atol=1e-3)
    assert other.settings != model.settings
    assert tuple(model.encode_text([]).shape) == (0, found.shape[1])
    with pytest.raises(RangeError, match=r"expected at most 40 tokens, got \d+ for 'look, zzz"):
        model.encode_text(["z" * 50])
    assert found.shape[1] == model.text_features(torch.zeros(20, 20, 3).byte()).channels


def test_siglip_reads_lower_case_whatever_its_tokenizer_does(checkpoints, monkeypatch) -> None:
    model = made(checkpoints, "siglip2", "siglip", template="Look, {}")
    tokens, read = model._tokens, []
    of = tokens.of
    monkeypatch.setattr(tokens, "of", lambda texts, **more: read.extend(texts) or of(texts, **more))
    model.encode_text(["A Chair"])
    assert read == ["look, a chair"]


@pytest.mark.parametrize(("family", "kind"), KINDS)
def test_cells_lie_on_whole_pixels_and_feel_their_patch(checkpoints, rng, family, kind) -> None:
    model = made(checkpoints, family, kind, size=96)
    picture = image(rng, 33, 61) // 8 + 100
    found = model.text_features(picture)
    assert found.stride == 10  # 16 * 61 / 96
    assert (tuple(found.features.shape[:2]), found.height, found.width) == ((4, 7), 33, 61)
    torch.testing.assert_close(found.features.norm(dim=2), torch.ones(4, 7))
    other = picture.clone()
    other[10:20, 40:50] = 255
    change = (model.text_features(other).features - found.features).norm(dim=2)
    assert divmod(int(change.argmax()), 7) == (1, 4)
    assert made(checkpoints, family, kind).text_features(image(rng, 64, 64)).stride == 16


@pytest.mark.parametrize(("family", "kind"), KINDS)
def test_images_together_are_as_one_by_one(checkpoints, rng, family, kind) -> None:
    model = made(checkpoints, family, kind, batch=3)
    assert isinstance(model, BatchedModel)
    pictures = [image(rng, 40, 50) for _ in range(3)]
    alone = [model.text_features(one).features for one in pictures]
    model.encode(pictures)
    assert len(model._last._kept) == 3
    for one, picture in zip(alone, pictures, strict=True):
        together = model.text_features(picture).features
        torch.testing.assert_close(one, together, rtol=0, atol=1e-5)


def test_words_are_written_beside_the_features(checkpoints, views, tmp_path, monkeypatch) -> None:
    words = ("red chair", "texture")
    model = made(checkpoints, "clip", "clip", words=words)
    folder = tmp_path / "clip"
    record_evidence(model, views, folder)
    evidence = open_evidence(folder)
    assert (evidence.kind, evidence.view_names) == ("features", ("v0", "v1", "v2"))
    found = load_text_embeddings(folder)
    assert found.labels == ("red chair", "texture", "object", "things", "stuff")
    assert found.kinds == ("class", "class", "negative", "negative", "negative")
    assert set(found.target_ids) == {-1}
    torch.testing.assert_close(found.vectors, model.encode_text(found.labels))
    again = made(checkpoints, "clip", "clip", words=("sofa",))
    monkeypatch.setattr(again._last, "_run", lambda images: pytest.fail("it looks again"))
    assert record_evidence(again, views, folder, EvidenceRequest(what="text")).kept == 3, (
        "no feature changes"
    )
    assert load_text_embeddings(folder).labels == ("sofa", *NEGATIVES)
    torch.testing.assert_close(
        load_text_embeddings(folder).vector("sofa"), again.encode_text(["sofa"])[0]
    )


def test_without_words_there_is_no_file_of_them(checkpoints, views, tmp_path) -> None:
    record_evidence(made(checkpoints, "clip", "clip"), views, tmp_path / "clip")
    assert not list((tmp_path / "clip").glob("text*"))


@pytest.mark.parametrize("options", [ClipOptions, SiglipOptions])
def test_words_and_sentences_that_are_refused(options) -> None:
    with pytest.raises(InputError, match=r"template: expected a sentence with {} once"):
        options(template="a photo")
    with pytest.raises(InputError, match=r"template: expected a sentence with {} once"):
        options(template="{} and {}")
    with pytest.raises(InputError, match="words: expected words or phrases, got an empty one"):
        options(words=("chair", " "))
    with pytest.raises(InputError, match="distinct words, got 'chair' more than once"):
        options(words=("chair", " chair"))


@pytest.mark.parametrize(("family", "kind"), KINDS)
def test_settings_tell_answers_apart(checkpoints, tmp_path, family, kind) -> None:
    model = made(checkpoints, family, kind)
    assert model.settings == made(checkpoints, family, kind, words=("chair",)).settings
    assert model.settings == model.default_settings
    assert model.settings != made(checkpoints, family, kind, size=96).settings
    folder = Path(shutil.copytree(checkpoints(kind), tmp_path / "copy"))
    path = folder / "tokenizer.json"
    content = json.loads(path.read_text())
    path.write_text(json.dumps(content))  # the same in other bytes: another tokenizer to us
    other = find_model(family, loading=LoadOptions(weights=str(folder)))
    assert other.settings["weights"] == model.settings["weights"]
    assert other.settings["tokenizer"] != model.settings["tokenizer"]


def test_tokenizers_that_are_not_there_or_broken(checkpoints, tmp_path) -> None:
    folder = Path(shutil.copytree(checkpoints("clip"), tmp_path / "copy"))
    (folder / "tokenizer.json").write_text("{}")
    with pytest.raises(
        FileFormatError,
        match=f"{folder}: expected the tokenizer of the weights, but it cannot be read",
    ):
        find_model("clip", loading=LoadOptions(weights=str(folder)))
    (folder / "tokenizer.json").unlink()
    with pytest.raises(FileFormatError, match=f"{folder}: expected a tokenizer beside the weights"):
        find_model("clip", loading=LoadOptions(weights=str(folder)))


def test_the_weights_of_another_network_are_refused(checkpoints, tmp_path) -> None:
    with pytest.raises(FileFormatError, match=r"expected weights of clip, got those of 'siglip'"):
        made(checkpoints, "clip", "siglip")
    with pytest.raises(FileFormatError, match=r"expected weights of siglip or siglip2, got those"):
        made(checkpoints, "siglip2", "clip")


def test_a_siglip_without_its_head_is_refused(checkpoints, tmp_path) -> None:
    folder = Path(shutil.copytree(checkpoints("siglip2"), tmp_path / "headless"))
    content = json.loads((folder / "config.json").read_text())
    content["vision_config"]["vision_use_head"] = False
    (folder / "config.json").write_text(json.dumps(content))
    with pytest.raises(FileFormatError, match=f"{folder}: expected a network with a pooling head"):
        find_model("siglip2", loading=LoadOptions(weights=str(folder)))
