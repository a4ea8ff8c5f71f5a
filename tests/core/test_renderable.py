"""Values of fields: what a view and a layer say is checked where it is made."""

import pytest
import torch

from splatseg.core import Labels, PointLabels, RenderableLayer, Selection, ViewSignals
from splatseg.errors import InputError, ShapeError


def test_layers_of_labels_and_selections() -> None:
    labels = Labels(ids=torch.tensor([7, -1, 3]), confidence=torch.ones(3), background=5)
    layer = RenderableLayer.of(labels)
    assert (layer.kind, layer.ids, layer.background) == ("labels", (3, 5, 7), 5)
    chosen = RenderableLayer.of(Selection(mask=torch.tensor([True, False])))
    assert (chosen.kind, chosen.ids, chosen.background) == ("selection", (1,), -1)


@pytest.mark.parametrize("ids", [(3, 2), (2, 2), (-1, 2)])
def test_ids_ascend_and_are_there(ids) -> None:
    with pytest.raises(InputError, match="ids: expected distinct ids, ascending"):
        RenderableLayer(ids=ids)


def test_kinds_are_known() -> None:
    with pytest.raises(InputError, match="kind"):
        RenderableLayer(kind="masks")


def test_images_of_a_view_have_one_size() -> None:
    one, other = torch.zeros(2, 3), torch.zeros(3, 2)
    ViewSignals(alpha=one, depth=one, colour=torch.zeros(2, 3, 3), median_depth=one)
    for wrong in (
        {"depth": other},
        {"colour": torch.zeros(2, 3)},
        {"colour": torch.zeros(3, 2, 3)},
        {"median_depth": other},
    ):
        with pytest.raises(ShapeError, match=next(iter(wrong))):
            ViewSignals(**{"alpha": one, "depth": one, **wrong})
    with pytest.raises(ShapeError, match="confidence"):
        PointLabels(ids=torch.zeros(2, dtype=torch.int32), confidence=torch.zeros(3))
