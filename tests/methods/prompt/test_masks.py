"""A mask of each view from points."""

from typing import ClassVar

import pytest
import torch

from methods.prompt.conftest import HEIGHT, WIDTH
from splatseg.core import MaskSet, Prompt, Rle
from splatseg.core.models import Embedding
from splatseg.errors import InputError, ShapeError
from splatseg.methods.prompt.masks import ModelMasks, RecordedMasks, holds


def rectangle(top: int, left: int, bottom: int, right: int) -> torch.Tensor:
    mask = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    mask[top:bottom, left:right] = True
    return mask


PART, THING, GROUP = rectangle(10, 10, 20, 15), rectangle(10, 10, 20, 20), rectangle(8, 5, 30, 40)


class Recorded:
    """Masks of every view alike."""

    def __init__(self, masks: torch.Tensor) -> None:
        self._masks = MaskSet.from_dense(masks)

    def masks(self, name: str) -> MaskSet:
        return self._masks


def chosen(fruit, points, signs=None, area=None, masks=(PART, THING, GROUP)) -> torch.Tensor | None:
    maker = RecordedMasks(Recorded(torch.stack(masks)))  # type: ignore[arg-type]
    positive = None if signs is None else torch.tensor(signs)
    prompt = Prompt(points=torch.tensor(points, dtype=torch.float32), positive=positive)
    found = maker.masks(fruit.views[0], [prompt], [area])[0]
    assert maker.calls == 1
    return None if found is None else found.decode()


def test_points_in_run_lengths_are_those_of_the_drawn_masks() -> None:
    generator = torch.Generator().manual_seed(1)
    dense = torch.rand(6, 13, 17, generator=generator) > 0.5
    dense[4], dense[5] = False, True
    columns = torch.randint(0, 17, (40,), generator=generator)
    rows = torch.randint(0, 13, (40,), generator=generator)
    points = torch.stack((columns, rows), dim=1) + 0.5
    assert torch.equal(holds(MaskSet.from_dense(dense), points), dense[:, rows, columns])


def test_without_anything_else_the_smallest_that_holds_the_points(fruit) -> None:
    assert torch.equal(chosen(fruit, [[12.5, 15.5]]), PART)
    assert torch.equal(chosen(fruit, [[12.5, 15.5], [18.5, 15.5]]), THING)


def test_negative_points_rule_out_what_is_too_large(fruit) -> None:
    points = [[12.5, 15.5], [18.5, 15.5], [30.5, 15.5]]
    signs = [True, True, False]
    assert torch.equal(chosen(fruit, points, signs), THING)
    assert chosen(fruit, points, signs, masks=(GROUP,)) is None


def test_more_than_half_of_the_points_are_held(fruit) -> None:
    half = [[12.5, 15.5], [50.5, 40.5]]
    assert chosen(fruit, half) is None
    most = [[12.5, 15.5], [18.5, 15.5], [50.5, 40.5]]
    assert torch.equal(chosen(fruit, most), THING)


def test_the_expected_area_decides_between_levels(fruit) -> None:
    for mask in (PART, THING, GROUP):
        area = float(mask.sum())
        assert torch.equal(chosen(fruit, [[12.5, 15.5]], area=area), mask)


def test_a_rendered_mask_takes_the_best_overlap(fruit) -> None:
    maker = RecordedMasks(Recorded(torch.stack((PART, THING, GROUP))))  # type: ignore[arg-type]
    shown = rectangle(10, 10, 20, 18)
    found = maker.masks(
        fruit.views[0], [Prompt(mask=shown), Prompt(mask=rectangle(40, 50, 44, 60))], [None, None]
    )
    assert found[0] is not None
    assert torch.equal(found[0].decode(), THING)
    assert found[1] is None


def test_recorded_masks_have_the_size_of_the_view(fruit) -> None:
    maker = RecordedMasks(Recorded(torch.ones(1, 5, 5, dtype=torch.bool)))  # type: ignore[arg-type]
    with pytest.raises(ShapeError, match="masks: expected 64x48 pixels as view v0 has, got 5x5"):
        maker.masks(fruit.views[0], [Prompt(points=torch.tensor([[1.0, 1.0]]))], [None])


class Disc:
    """A promptable model that answers with a disc around the first point."""

    name = "disc"
    settings: ClassVar[dict[str, int]] = {}
    note = ""

    def __init__(self, size: tuple[int, int] = (HEIGHT, WIDTH)) -> None:
        self.images = 0
        self.size = size

    def embed(self, image) -> Embedding:
        self.images += 1
        assert image.dtype == torch.uint8
        return Embedding(model=self.name, height=HEIGHT, width=WIDTH, arrays={})

    def prompted_masks(self, embedding, prompt) -> MaskSet:
        rows, columns = torch.meshgrid(*(torch.arange(n) for n in self.size), indexing="ij")
        x, y = prompt.points[0].tolist()
        if x > 60:
            return MaskSet.from_dense(torch.zeros(0, *self.size, dtype=torch.bool))
        return MaskSet.from_dense((torch.hypot(columns - x, rows - y) < 6)[None])


def test_a_model_sees_a_view_once_for_all_prompts(fruit) -> None:
    model = Disc()
    maker = ModelMasks(model, fruit.gaussians)  # type: ignore[arg-type]
    prompts = [Prompt(points=torch.tensor([[float(x), 20.0]])) for x in (10, 30, 62)]
    found = maker.masks(fruit.views[0], prompts, [None] * 3)
    assert (model.images, maker.calls) == (1, 3)
    assert isinstance(found[0], Rle)
    assert found[0].decode()[20, 10]
    assert found[2] is None
    assert maker.masks(fruit.views[0], [], []) == []
    with pytest.raises(InputError, match="prompter: expected masks of 64x48 pixels, got 10x9"):
        ModelMasks(Disc((9, 10)), fruit.gaussians).masks(fruit.views[0], prompts[:1], [None])  # type: ignore[arg-type]
