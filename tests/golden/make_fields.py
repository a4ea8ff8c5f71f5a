"""Makes the golden mesh field of the current format version in tests/golden.

Run from the project's root: ``python tests/golden/make_fields.py``. It makes what is not there:
field-v1, a mesh field of three primitives on two levels with tiny networks and a full record, and
``shown.json``, what it showed through one camera and said of points when it was made. A version's
files are made once and then kept: later versions of splatseg must read them, and show the same.
"""

import json
from pathlib import Path

import torch
from torch import Tensor

from splatseg.core import Camera, LayerEdit, LayerInfo
from splatseg.street.field import MeshField
from splatseg.street.files import VERSION, load_mesh_field, save_mesh_field
from splatseg.street.primitives import PrimitiveMesh
from splatseg.street.radiance import RadianceModel, RadianceOptions

ROOT = Path(__file__).parent / f"field-v{VERSION}"
FIELD = "street.safetensors"
SHOWN = "shown.json"
IDS = (7, 2, 11)
LAYER = "labels_semantic"
OPTIONS = RadianceOptions(  # all of them, so that other defaults change nothing
    feature_size=3,
    feature_frequencies=1,
    position_frequencies=1,
    view_frequencies=1,
    width=6,
    depth=2,
    skip=2,
    semantic_width=5,
    colour_widths=(4,),
    background_widths=(4,),
    order="distance",
    max_hits=5,
    fine_hits=4,
    coarse_hits=None,
    sides="both",
    rays=32,
    iterations=100,
    rate=2e-3,
    feature_rate=2e-2,
    semantic_weight=0.1,
)
POINTS = torch.tensor(
    [
        [0.5, 0.0, 2.0],
        [-0.25, 0.125, 2.25],
        [0.75, 0.25, 2.0],
        [1.0, -0.375, 2.5],
        [0.0, 0.0, 3.0],
        [0.625, 0.5, 3.5],
        [0.0, 0.0, -9.0],
    ]
)
"""Inside and beside primitives; the last is far from all."""


def golden_mesh() -> PrimitiveMesh:
    """Two small boxes of 42 vertices before a large one, all numbers in closed form."""
    steps = torch.arange(42)
    unit = torch.stack([steps % 4, steps // 4 % 4, steps // 16], dim=1) / 4 - 0.5
    primitives = [
        unit / 2 + torch.tensor([-0.25, 0.0, 2.0]),
        unit / 2 + torch.tensor([0.75, 0.25, 2.0]),
        unit * 2 + torch.tensor([0.25, 0.0, 3.5]),
    ]
    return PrimitiveMesh(
        vertices=torch.cat(primitives), levels=torch.tensor([0, 0, 1]), sizes=(0.5, 1.0)
    )


def golden_field() -> MeshField:
    """A field whose weights and features are in closed form."""
    mesh = golden_mesh()
    model = RadianceModel(mesh, IDS, OPTIONS)
    state = {
        name: _numbers(tensor, first=17 * place) if tensor.ndim else tensor
        for place, (name, tensor) in enumerate(sorted(model.state.items()))
    }
    # A third is nothing that float16 holds: matrices stay float32, features are float16.
    state = {name: tensor if name == "features" else tensor / 3 for name, tensor in state.items()}
    state |= {"centre": model.state["centre"], "scale": torch.tensor(2.0)}
    # Half transparent, with classes that depend on the place.
    state["opacity.weight"] /= 128
    state["opacity.bias"] = torch.tensor([-0.25])
    state["semantic.layers.1.weight"] *= 2
    state["semantic.layers.1.bias"] = torch.tensor([12.0, 0.0, 0.0])
    info = LayerInfo(
        method="dnmp",
        options={"voxels": [0.5, 1.0], "radius": None},
        evidence=LAYER,
        views=("left/1", "left/2"),
        views_asked="train",
        seed=7,
        versions={"splatseg": "0.1.0", "torch": "2.6.0"},
        names={7: "Straße", 2: "car", 11: "sky"},
        source_ids={7: 6, 2: 1, 11: 10},
        edits=(LayerEdit(name="complete", details={"inferred": 1}),),
        details={"iterations": 100},
    )
    model = RadianceModel.with_state(mesh, IDS, OPTIONS, state)
    return MeshField(mesh, model, layer=LAYER, info=info, radius=0.625)


def golden_camera() -> Camera:
    """Before the primitives, a little turned and above."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.tensor([[0.96, 0.0, -0.28], [0.0, 1.0, 0.0], [0.28, 0.0, 0.96]])
    pose[:3, 3] = torch.tensor([0.5, 0.125, 0.25])
    return Camera(width=9, height=6, fx=7.5, fy=7.25, cx=4.5, cy=3.25, cam_from_world=pose)


def shown_of(field: MeshField) -> dict[str, object]:
    """Colours, alphas, depths and labels of the view, and labels of points by eq. 9."""
    with field.view(golden_camera()) as view:
        signals = view.signals()
        labels = view.label_map(LAYER)
    points = field.labels_at(POINTS, LAYER)
    return {
        "colour": _numbers_of(signals.colour),
        "alpha": signals.alpha.tolist(),
        "depth": signals.depth.tolist(),
        "label_map": labels.ids.tolist(),
        "label_map_confidence": _numbers_of(labels.confidence),
        "point_ids": points.ids.tolist(),
        "point_confidence": points.confidence.tolist(),
    }


def _numbers_of(values: Tensor | None) -> list[object]:
    assert values is not None
    return values.tolist()


def _numbers(like: Tensor, *, first: int) -> Tensor:
    """Sixteenths in [-3, 3] without a pattern, which float16 holds."""
    steps = torch.arange(first, first + like.numel())
    return ((steps * 61 + steps**2 * 7) % 97 - 48).reshape(like.shape).float() / 16


def main() -> None:
    """Make what is not there."""
    if ROOT.exists():
        return
    ROOT.mkdir()
    save_mesh_field(golden_field(), ROOT / FIELD)
    shown = shown_of(load_mesh_field(ROOT / FIELD))
    (ROOT / SHOWN).write_text(json.dumps(shown, indent=1) + "\n")


if __name__ == "__main__":
    main()
