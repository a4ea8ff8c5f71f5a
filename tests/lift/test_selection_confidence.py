"""What a selection's confidence does in renders, exports, attached rows and merged scenes."""

import pytest
import torch

from splatseg.core import Camera, Edited, Gaussians, LayerInfo, Selection
from splatseg.edit.operations import merged_layers
from splatseg.io.export import label_columns
from splatseg.io.layers import save_layer
from splatseg.lift import GaussianField, label_map, match_gaussians
from splatseg.lift.field import selection_labels
from splatseg.tasks import describe
from splatseg.tasks.export_labels import _sure_selection, label_tables


def wall(opacities: list[float]) -> tuple[Gaussians, Camera]:
    """Gaussians behind each other on the axis of a camera of one pixel."""
    count = len(opacities)
    means = torch.zeros(count, 3)
    means[:, 2] = 2 + torch.arange(count)
    gaussians = Gaussians(
        means=means, rotations=torch.eye(4)[:1].expand(count, 4),
        scales=torch.full((count, 3), 9.0),
        opacities=torch.tensor(opacities), sh=torch.zeros(count, 1, 3),
    )  # fmt: skip
    camera = Camera(
        width=1, height=1, fx=9, fy=9, cx=0.5, cy=0.5, cam_from_world=torch.eye(4).double()
    )
    return gaussians, camera


@pytest.mark.parametrize(
    ("confidence", "inside"),
    # Weights are 0.5 and 0.4; a tenth of the light passes.
    [((0.9, 0.1), False), ((0.9, 0.2), True), ((0.1, 1.0), False), ((0.3, 0.95), True)],
)
def test_a_pixel_is_inside_where_the_blended_probability_is_over_half(confidence, inside) -> None:
    gaussians, camera = wall([0.5, 0.8])
    soft = Selection.of_confidence(torch.tensor(confidence))
    drawn = label_map(gaussians, camera, selection_labels(soft), backend="cpu")
    assert (int(drawn.ids[0, 0]) == 1) == inside
    field = GaussianField(gaussians, {"soft": soft}, backend="cpu")
    with field.view(camera) as view:
        assert torch.equal(view.label_map("soft").ids, drawn.ids)


def test_exports_have_the_probability() -> None:
    soft = Selection.of_confidence(torch.tensor([0.25, 0.75]))
    columns = label_columns(soft)
    assert columns["selected"].tolist() == [0, 1]
    assert columns["selected_confidence"].tolist() == [0.25, 0.75]
    assert list(label_columns(Selection(mask=soft.mask))) == ["selected"]
    assert label_tables(soft, "class", "a", None)["selected"]["confidence"] == "selected_confidence"
    kept = _sure_selection(Selection.of_confidence(torch.tensor([0.7, 0.9])), 0.8)
    assert kept.mask.tolist() == [False, True]
    assert kept.confidence.tolist() == pytest.approx([0.5, 0.9])


def test_info_says_how_sure_it_is(tmp_path) -> None:
    path = tmp_path / "a.npz"
    save_layer(Selection.of_confidence(torch.tensor([0.25, 0.75])), path)
    assert describe(path)["holds"] == "selection of 1, confidence 0.75"


def test_attached_and_merged_rows_keep_it() -> None:
    gaussians, _ = wall([0.5, 0.8, 0.9])
    soft = Selection.of_confidence(torch.tensor([0.25, 0.75, 1.0]), info=LayerInfo(method="a"))
    edited = gaussians[torch.tensor([2, 0])]
    carried = match_gaussians(gaussians, edited).transfer(soft)
    assert carried.confidence.tolist() == [1.0, 0.25]
    joined = merged_layers(
        {"a": soft[:1]},
        {"a": soft[1:]},
        Edited(gaussians=gaussians, rows=torch.tensor([0, -1, -1])),
    )["a"]
    assert joined.confidence.tolist() == [0.25, 0.75, 1.0]
    assert joined.info.method == "a"
