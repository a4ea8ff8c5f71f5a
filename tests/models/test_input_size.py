"""Sizes of networks' inputs, as the files of real checkpoints tell them."""

import json

import pytest

from splatseg.errors import FileFormatError
from splatseg.models._images import InputSize, Normalisation

PUBLISHED = InputSize(shortest=800, longest=1333, multiple=32)


def told(tmp_path, content, otherwise=PUBLISHED) -> InputSize:
    (tmp_path / "preprocessor_config.json").write_text(json.dumps(content))
    return InputSize.of(tmp_path, otherwise=otherwise)


def inner(wanted: InputSize, height: int, width: int, **more) -> tuple[int, int]:
    frame = wanted.frame(height, width, **more)
    assert (frame.height, frame.width) == (height, width)
    assert (frame.outer_height, frame.outer_width) == (frame.inner_height, frame.inner_width)
    return frame.inner_height, frame.inner_width


def test_what_files_tell(tmp_path) -> None:
    assert InputSize.of(tmp_path, otherwise=PUBLISHED) == PUBLISHED
    assert told(tmp_path, {"image_mean": [0, 0, 0]}) == PUBLISHED
    edges = {"shortest_edge": 640, "longest_edge": 2560}
    assert told(tmp_path, {"size": edges, "size_divisor": 16}) == InputSize(
        shortest=640, longest=2560, multiple=16
    )
    assert told(tmp_path, {"size": 640, "max_size": 2560, "size_divisibility": 8}) == InputSize(
        shortest=640, longest=2560, multiple=8
    )
    assert told(tmp_path, {"size": {"height": 512, "width": 640}}, InputSize()).sides == (512, 640)
    assert told(tmp_path, {"size": 512}, InputSize(sides=(1, 1))).sides == (512, 512)
    dpt = {"size": {"height": 518, "width": 518}, "keep_aspect_ratio": True}
    found = told(tmp_path, dpt | {"ensure_multiple_of": 14})
    assert found == InputSize(sides=(518, 518), keeps_proportions=True, multiple=14)
    single = {"size": {"shortest_edge": 512, "longest_edge": None}}
    assert told(tmp_path, single, InputSize()) == InputSize(shortest=512)
    assert told(tmp_path, {"image_mean": [0.5] * 3}, InputSize()).shortest is None
    assert Normalisation.of(tmp_path).mean == (0.5, 0.5, 0.5)


@pytest.mark.parametrize(
    "content", [{"size": "large"}, {"size": {"height": 0.5, "width": 8}}, {"size": {"depth": 3}},
                {"size_divisor": -2}, {"size": 1 << 20}, {"size": True}],
)  # fmt: skip
def test_sizes_that_are_none(tmp_path, content) -> None:
    with pytest.raises(FileFormatError, match=r"preprocessor_config.json: size"):
        told(tmp_path, content)


def test_frames() -> None:
    assert inner(PUBLISHED, 600, 800) == (800, 1056)  # 1066.7 to whole cells of 32
    assert inner(PUBLISHED, 600, 1600) == (512, 1344), "the longer side holds it back"
    assert inner(InputSize(longest=640), 480, 320) == (640, 427)
    assert inner(InputSize(shortest=512), 480, 640) == (512, 683)
    square = InputSize(sides=(384, 384), multiple=16)
    assert inner(square, 300, 400) == (384, 384)
    kept = InputSize(sides=(518, 518), keeps_proportions=True, multiple=14)
    assert inner(kept, 960, 1280) == (518, 686), "shrunk as little as it may be"
    assert inner(kept, 240, 320) == (392, 518), "enlarged as little as it may be"
    assert inner(PUBLISHED, 600, 800, size=640) == (480, 640)
    assert inner(InputSize(sides=(9, 9), takes_squares=True), 30, 40, size=20) == (20, 20)
