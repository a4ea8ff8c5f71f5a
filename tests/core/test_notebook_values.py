"""What a notebook does with values: shows them, opens their pictures and layers, moves them."""

from typing import Any, TypeVar

import numpy as np
import pytest
import torch
from typing_extensions import TypeAliasType

from splatseg.core import (
    Gaussians,
    InstanceTree,
    LabelMap,
    Labels,
    MaskSet,
    Scene,
    Selection,
    TreeNode,
)
from splatseg.core.boundary import boundary
from splatseg.errors import InputError
from splatseg.io.layers import load_layer
from splatseg.render import back_project, render
from support import poison


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> poison.World:
    return poison.World(tmp_path_factory.mktemp("world"))


def shown(world: poison.World) -> dict[str, object]:
    mask = torch.zeros(30, 40, dtype=torch.bool)
    mask[3:9] = True
    ids = torch.ones(6, dtype=torch.int32)
    labels = Labels(ids=ids, confidence=torch.ones(6))
    return {
        "Scene": world.scene,
        "View": world.views[0],
        "Gaussians": world.gaussians,
        "Labels": world.labels,
        "MaskSet": MaskSet.from_dense(mask.expand(50, 30, 40)),
        "LabelMap": LabelMap(ids=mask.int() + 1),
        "InstanceTree": InstanceTree(nodes=(TreeNode(id=1, name="<cup>"),), labels=labels),
    }


PICTURED = {"Scene", "View", "Gaussians", "MaskSet", "LabelMap"}


def test_values_are_shown_in_a_line_and_a_picture(world) -> None:
    for name, value in shown(world).items():
        assert repr(value).startswith(name), name
        assert len(repr(value)) < 160, name
        assert "\n" not in repr(value), name
        page = value._repr_html_()
        assert ("data:image/png;base64," in page) == (name in PICTURED), name
        assert len(page) < 400_000, name
        assert "<cup>" not in page, "names are escaped"
    assert repr(Selection(mask=torch.tensor([True, False]))) == "Selection(1 of 2)"


def test_layers_of_a_scene_are_a_mapping(world) -> None:
    layers = world.scene.layers
    assert list(layers) == ["things"]
    assert torch.equal(layers["things"].ids, world.labels.ids)
    assert "other" not in layers
    with pytest.raises(InputError, match=r"layer: expected one of .*\(things\), got 'other'"):
        layers["other"]
    unsaved = Scene(gaussians=world.gaussians)
    assert dict(unsaved.layers) == {}
    with pytest.raises(InputError, match="not saved"):
        unsaved.layers["things"]


def test_views_read_their_photographs(world) -> None:
    assert world.views[0].read_image().shape == (9, 12, 3)
    assert world.views[0].read_image(longest=6).shape[1] == 6


def test_paths_are_text_too(world) -> None:
    path = world.folder / "scene" / "layers" / "things.npz"
    assert torch.equal(load_layer(str(path)).ids, world.labels.ids)


def test_gaussians_move_as_tensors_do(world) -> None:
    assert world.gaussians.to("cpu").device.type == "cpu"
    assert world.gaussians.to(torch.float64).dtype == torch.float64
    assert world.gaussians.to(device="cpu", dtype=torch.float64).dtype == torch.float64
    for device in ("no such device", "meta", "cuda:99"):
        with pytest.raises(InputError, match="device: expected one that"):
            world.gaussians.to(device)


def test_arrays_are_taken_where_tensors_are(world) -> None:
    g = world.gaussians
    same = Gaussians(
        means=g.means.numpy(),
        rotations=g.rotations.tolist(),
        scales=g.scales.numpy()[::-1],
        opacities=g.opacities.numpy().astype(np.float32),
        sh=g.sh.numpy(),
    )
    drawn = render(same, poison.CAMERA, g.opacities.numpy())
    assert torch.equal(drawn.image, render(g, poison.CAMERA, g.opacities[:, None]).image)
    grey = np.linspace(0, 1, 108, dtype=np.float32).reshape(9, 12)
    sums = back_project(g, poison.CAMERA, grey).sums
    assert torch.equal(sums, back_project(g, poison.CAMERA, torch.from_numpy(grey)[..., None]).sums)
    with pytest.raises(InputError, match=r"image: .* got torch.uint8; .* x / 255 for pixels"):
        back_project(g, poison.CAMERA, np.zeros((9, 12), np.uint8))
    with pytest.raises(InputError, match=r"means: expected a tensor or an array .* got None"):
        g.replace(means=None)


def test_annotations_that_are_named_are_checked_as_what_they_name() -> None:
    """NumPy 2.5 made `NDArray` such a name, and nothing that it annotates was checked there."""
    element = TypeVar("element", bound=np.generic)
    array = TypeAliasType("array", np.ndarray[Any, np.dtype[element]], type_params=(element,))
    count = TypeAliasType("count", int)

    def taken(runs: Any, height: Any) -> tuple[Any, Any]:
        return runs, height

    taken.__annotations__.update(runs=array[np.uint32], height=count)
    taken = boundary(taken)
    runs, height = taken([3, 4], np.int64(7))
    assert (runs.dtype, runs.tolist(), type(height)) == (np.uint32, [3, 4], int)
    with pytest.raises(InputError, match="runs"):
        taken(None, 7)
    with pytest.raises(InputError, match="height: expected a whole number"):
        taken([3, 4], "seven")


def test_rows_are_chosen_by_masks_lists_and_arrays(world) -> None:
    g = world.gaussians
    assert len(g[[0, 2]]) == len(g[np.array([0, 2])]) == len(g[torch.tensor([0, -1])]) == 2
    assert len(g[np.arange(6) < 4]) == 4
    for index in (3, "a", None, 2.5, [99], [[1]], np.zeros(4, bool)):
        with pytest.raises(InputError, match="index: expected"):
            g[index]
