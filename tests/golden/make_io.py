"""Makes the golden files of the current format versions in tests/golden.

Run from the project's root: ``python tests/golden/make_io.py``. It makes what is not there:
scene-v1, a scene folder with one view of each lens and evidence of each kind that is written; and
layers-v3, a layer of each kind, with a record that says something in every field; layers-v4, a
selection with confidence, and layers-v5, voxels in each precision, which alone are of these
versions; and
evidence-v2, features of three blocks with a class token. A version's
files are made once and then kept: later versions of splatseg must read them. The layers in
scene-v1 are of version 1 and the one in layers-v2 of version 2, as the scripts of then made them;
their records are of version 0.
"""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from splatseg.core import (
    Camera,
    ClassInfo,
    ClassTable,
    DeepFeatures,
    FeatureMap,
    Features,
    Gaussians,
    InstanceFacts,
    InstanceTree,
    LabelMap,
    Labels,
    Layer,
    LayerEdit,
    LayerInfo,
    MaskSet,
    Scene,
    Selection,
    StoredTable,
    TreeNode,
    View,
    VoxelFeatures,
    VoxelGrid,
    with_info,
)
from splatseg.io.evidence import create_evidence, save_features, save_label_map, save_masks
from splatseg.io.evidence._open import VERSION as EVIDENCE_VERSION
from splatseg.io.layers import save_layer
from splatseg.io.scene import VERSION, save_scene, save_scene_layer
from splatseg.io.scene_folder import CAMERAS_FILE, SCENE_FILE

ROOT = Path(__file__).parent / f"scene-v{VERSION}"
LAYERS_3 = Path(__file__).parent / "layers-v3"
LAYERS_4 = Path(__file__).parent / "layers-v4"
LAYERS_5 = Path(__file__).parent / "layers-v5"
EVIDENCE = Path(__file__).parent / f"evidence-v{EVIDENCE_VERSION}"
CLASSES = ClassTable(
    rows=(
        ClassInfo(id=1, name="wall", isthing=False, colour=(10, 20, 30)),
        ClassInfo(id=7, name="Stuhl", isthing=True),
    )
)


def _even(first: float, last: float, count: int) -> torch.Tensor:
    """Numbers at even distances, to the bit as `torch.linspace` gave them with AVX-512.

    Without fused products, on other processors, it gives others in their last bits.
    """
    step = float(torch.tensor((last - first) / (count - 1)))
    i = torch.arange(count, dtype=torch.float64)
    halves = torch.where(i < count // 2, first + step * i, last - step * (count - 1 - i))
    return halves.float()


def golden_scene() -> Scene:
    """Three Gaussians and three views, all numbers in closed form."""
    n = 3
    steps = torch.arange(n, dtype=torch.float32)
    gaussians = Gaussians(
        means=torch.stack([steps, -steps, steps / 4], dim=1),
        rotations=torch.tensor([[1, 0, 0, 0], [0.5, 0.5, 0.5, 0.5], [0, 0, 1, 0]]).float(),
        scales=torch.full((n, 3), 0.25) * (1 + steps[:, None]),
        opacities=torch.tensor([0.25, 0.5, 0.75]),
        sh=_even(-1, 1, n * 4 * 3).reshape(n, 4, 3),
        extra={"mark": torch.tensor([5, 6, 7], dtype=torch.int32)},
    )
    lenses = {
        "left/1": ("pinhole", (), "train"),
        "left/2": ("opencv", (-0.1, 0.02, 0.003, -0.004, 0.005, 0.0, 0.0, 0.0), "train"),
        "right/1": ("fisheye", (0.1, -0.02, 0.003, -0.0004), "test"),
    }
    views = []
    for i, (name, (model, distortion, split)) in enumerate(lenses.items()):
        angle = 0.1 + i
        pose = torch.eye(4, dtype=torch.float64)
        turn = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        pose[:2, :2] = torch.tensor(turn, dtype=torch.float64)
        pose[:3, 3] = torch.tensor([0.1, -0.2, 1 / 3 + i], dtype=torch.float64)
        camera = Camera(
            width=8,
            height=6,
            fx=10 + 1 / 3,
            fy=11,
            cx=4.25,
            cy=2.75,
            cam_from_world=pose,
            model=model,
            distortion=distortion,
        )
        image = ROOT.parent / "capture-that-moved" / "images" / f"{name}.png"
        views.append(View(name=name, camera=camera, image=image, split=split))
    return Scene(
        gaussians=gaussians,
        views=tuple(views),
        classes=CLASSES,
        up=(0.0, 0.0, 1.0),
        metres_per_unit=0.5,
        source=ROOT.parent / "capture-that-moved",
        provenance={"command": "fit", "steps": 100, "options": {"seed": 0}},
    )


def golden_layers() -> dict[str, Labels | Features | Selection]:
    """Layers as they are in scene-v1."""
    return {
        "semantic": Labels(
            ids=torch.tensor([7, -1, 1]),
            confidence=torch.tensor([0.5, 0.0, 1.0]),
            background=1,
            candidates=torch.tensor([[7, 1], [-1, -1], [1, -1]], dtype=torch.int32),
            shares=torch.tensor([[0.5, 0.25], [0.0, 0.0], [1.0, 0.0]]),
            info=LayerInfo(method="uplift", names={7: "Stuhl"}),
        ),
        "features": Features(
            values=torch.tensor([[0.5, -1.0], [2.0, 0.0], [0.125, 3.0]]),
            weights=torch.tensor([1.5, 0.0, 3.0]),
            info=LayerInfo(method="uplift"),
        ),
        "chosen": Selection(
            mask=torch.tensor([True, False, True]), info=LayerInfo(details={"by": "point"})
        ),
    }


def golden_tree() -> InstanceTree:
    """A group of two objects, one of which has two parts, beside an object by itself."""
    return InstanceTree(
        nodes=(
            TreeNode(id=1, parent=4, name="Stuhl 1", class_id=7, support=0.75, segments=9, views=3),
            TreeNode(id=2, parent=4, name="object 2", support=0.5, segments=2, views=2),
            TreeNode(id=3, name="object 3", segments=1, views=1),
            TreeNode(id=4, level="group", name="group 4", support=0.25, segments=4, views=4),
            TreeNode(id=5, parent=1, level="part", name="part 5", support=0.125),
            TreeNode(id=9, parent=1, level="part", name="Fuß"),
        ),
        labels=Labels(
            ids=torch.tensor([9, -1, 4, 5, 2, 3], dtype=torch.int32),
            confidence=torch.tensor([0.5, 0.0, 1.0, 0.25, 0.75, 0.125]),
            background=3,
            evidence=torch.tensor([3.0, 0.0, 1.5, 2.0, 0.5, 8.0]),
            effective_views=torch.tensor([1.0, 0.0, 2.5, 1.25, 1.0, 4.0]),
            inferred=torch.tensor([False, False, True, False, True, False]),
            info=LayerInfo(method="associate", views=("left/1",)),
        ),
    )


def full_info() -> LayerInfo:
    """A record that says something in every field."""
    return LayerInfo(
        method="uplift",
        options={"candidates": 2, "label_rule": "share", "sizes": [1, 2.5, None, True]},
        evidence="labels_semantic",
        views=("left/1", "left/2"),
        views_asked="train",
        seed=7,
        versions={"splatseg": "0.1.0", "torch": "2.6.0"},
        names={1: "Wand", 7: "Stuhl — chair"},
        source_ids={1: 0, 7: 6},
        class_of={7: 3},
        instances={
            1: InstanceFacts(stuff=True),
            7: InstanceFacts(segments=9, views=2, details={"track": 4}),
        },
        cut=0.25,
        view_correlation=0.5,
        head={"blend": "features", "ids": [1, 7], "weight": [[0.5, -1.0], [0.0, 2.0]]},
        edits=(
            LayerEdit(name="complete", details={"inferred": 1, "options": {"smooth": True}}),
            LayerEdit(name="merge", details={"ids": {"2": 5}}),
        ),
        details={"largest_error_bound": 0.125, "by": "point"},
    )


def golden_layers_of_version_3() -> dict[str, Layer]:
    """A layer of each kind with a full record."""
    layers: dict[str, Layer] = {**golden_layers(), "tree": golden_tree()}
    return {name: with_info(layer, full_info()) for name, layer in layers.items()}


def golden_soft_selection() -> Selection:
    """A selection that says how likely each Gaussian belongs to it, the border among them."""
    return Selection(
        mask=torch.tensor([True, False, True, False]),
        confidence=torch.tensor([0.875, 0.25, 0.5, 0.5]),
        info=full_info(),
    )


def golden_voxels() -> dict[str, VoxelFeatures]:
    """Three voxels of four channels in each precision, read by five Gaussians one at a time, and
    by two at a time."""
    values = torch.tensor([[0.5, -1.0, 0.0, 2.0], [0.25, 3.0, -0.125, 1.0], [-4.0, 0.0, 0.75, 8.0]])
    steps = torch.arange(256, dtype=torch.float32)[None, :, None]
    tables = {
        "float32": StoredTable(codes=values),
        "float16": StoredTable(codes=values.half()),
        "int8": StoredTable(
            codes=torch.tensor([[127, -127, 0, 1], [-1, 127, 64, 2], [3, 0, 0, 127]]).to(
                torch.int8
            ),
            scales=torch.tensor([0.5, 0.25, 0.125]),
        ),
        "product": StoredTable(
            codes=torch.tensor([[0, 255], [7, 1], [128, 64]], dtype=torch.uint8),
            codebooks=torch.cat([steps / 8 - 16, steps / -4], dim=0).expand(2, 256, 2).clone(),
        ),
    }
    grid = VoxelGrid(
        cells=torch.tensor([[-9, -1, 0], [1, 0, 2], [0, 1, 2]], dtype=torch.int32),
        size=0.1,
        origin=torch.tensor([1 / 3, -2.0, 0.25], dtype=torch.float64),
    )
    weights = torch.tensor([1.5, 8.0, 0.25])
    rows = torch.tensor([[2], [-1], [0], [1], [1]], dtype=torch.int32)
    made = {
        name: VoxelFeatures(grid=grid, table=table, weights=weights, rows=rows, info=full_info())
        for name, table in tables.items()
    }
    made["shares"] = replace(
        made["float16"],
        rows=torch.tensor([[2, 0], [-1, -1], [0, -1], [1, 2], [1, 0]], dtype=torch.int32),
        shares=torch.tensor([[0.75, 0.25], [0, 0], [1, 0], [0.5, 0.5], [0.125, 0.875]]),
    )
    return made


def golden_evidence() -> tuple[LabelMap, MaskSet, FeatureMap]:
    """A label map, masks and features of the view left/1."""
    ids = torch.full((6, 8), -1, dtype=torch.int32)
    ids[:2] = 7
    ids[2:, :3] = 1
    dense = torch.zeros(2, 6, 8, dtype=torch.bool)
    dense[0, 1:4, 2:5] = True
    dense[1, :, 0] = True
    return (
        LabelMap(ids=ids, confidence=_even(0, 1, 48).reshape(6, 8)),
        MaskSet.from_dense(dense, scores=[0.75, 0.5], levels=[2, 0]),
        FeatureMap(
            features=torch.arange(24, dtype=torch.float32).reshape(3, 4, 2) / 8,
            stride=2,
            height=6,
            width=8,
        ),
    )


def golden_deep_features() -> DeepFeatures:
    """Three blocks, the shallowest on finer cells and wider, and a class token."""
    _, _, deepest = golden_evidence()
    middle = replace(deepest, features=deepest.features.flip(0) - 1)
    finest = torch.arange(96, dtype=torch.float32).reshape(6, 8, 2) / 16
    shallow = replace(deepest, features=finest, stride=1)
    return DeepFeatures(
        maps=(shallow, middle, deepest),
        depths=("block4", "block8", "block12"),
        class_token=torch.tensor([0.5, -2.0]),
    )


def main() -> None:
    if not ROOT.exists():
        make_scene()
    if not EVIDENCE.exists():
        EVIDENCE.mkdir()
        create_evidence(EVIDENCE / "features", kind="features", metadata={"model": "a"})
        save_features(golden_deep_features(), EVIDENCE / "features", "left/1")
    if not LAYERS_3.exists():
        LAYERS_3.mkdir()
        for name, layer in golden_layers_of_version_3().items():
            save_layer(layer, LAYERS_3 / f"{name}.npz")
    if not LAYERS_4.exists():
        LAYERS_4.mkdir()
        save_layer(golden_soft_selection(), LAYERS_4 / "chosen.npz")
    if not LAYERS_5.exists():
        LAYERS_5.mkdir()
        for name, layer in golden_voxels().items():
            save_layer(layer, LAYERS_5 / f"{name}.npz")


def make_scene() -> None:
    save_scene(golden_scene(), ROOT)
    # The path of the machine that made it is nobody's business.
    path = ROOT / SCENE_FILE
    content = json.loads(path.read_text())
    content["source"]["absolute"] = "/captures/that-moved"
    path.write_text(json.dumps(content, indent=1) + "\n")
    assert str(ROOT.parent) not in (ROOT / CAMERAS_FILE).read_text()
    for name, layer in golden_layers().items():
        save_scene_layer(layer, ROOT, name)
    labels, masks, features = golden_evidence()
    evidence = ROOT / "evidence"
    create_evidence(evidence / "labels", kind="labels", classes=CLASSES, metadata={"model": "a"})
    save_label_map(labels, evidence / "labels", "left/1")
    create_evidence(evidence / "masks", kind="masks")
    save_masks(masks, evidence / "masks", "left/1")
    create_evidence(evidence / "features", kind="features")
    save_features(features, evidence / "features", "left/1")
    # Git does not keep empty folders; readers must not need them.
    (ROOT / "reports").rmdir()


if __name__ == "__main__":
    main()
