"""Our own files: scenes, layers, states of what was stopped; and weights."""

import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch

from splatseg.core import (
    Features,
    InstanceTree,
    Labels,
    LayerInfo,
    Scene,
    Selection,
    StoredTable,
    TreeNode,
    VoxelFeatures,
    VoxelGrid,
)
from splatseg.fit._checkpoint import FitState, read_checkpoint, write_checkpoint
from splatseg.io.chunks import open_chunks, write_chunks
from splatseg.io.export import column_table_of, write_column_table
from splatseg.io.layers import load_layer, save_layer
from splatseg.io.moving import read_moving
from splatseg.io.scene import load_scene, save_scene
from splatseg.io.tensors import read_tensors
from splatseg.lift.training import _state as training
from splatseg.pose import _saved as saved
from splatseg.pose._photographs import LeftOut
from splatseg.pose._saved import Lens, MapperTry, PoseReport
from splatseg.street.blocks import DriveBlockOptions, cut_drive
from splatseg.street.files import load_drive, load_mesh_field, save_drive, save_mesh_field
from splatseg.tasks.figures import read_points
from support.fuzz.targets.base import (
    Target,
    gaussians,
    photographs,
    target,
    view_of,
    whole,
)
from support.mesh_fields import balls, random_field


def _scene(name: str, file: str) -> None:
    @target(name)
    def make(folder: Path) -> Target:
        view = view_of(photographs(folder / "capture", 1)[0])
        scene = Scene(gaussians=gaussians(), views=(view,), source=folder / "capture", up=(0, 0, 1))
        save_scene(scene, folder / "scene")
        return Target(file=folder / "scene" / file, read=lambda: load_scene(folder / "scene"))


_scene("scene.json", "scene.json")
_scene("scene-cameras", "cameras/transforms.json")


def _chunks(file: str) -> None:
    @target(f"chunks-{file.partition('.')[0]}")
    def make(folder: Path) -> Target:
        chunks = folder / "gaussians"
        chunks.mkdir()
        write_chunks(lambda first, end: gaussians()[first:end], 4, chunks, memory=1)

        def read() -> None:
            found = open_chunks(chunks, memory=1)
            if found.chunks is not None:
                found.chunks.read([(0, len(found))])

        return Target(file=chunks / file, read=read)


_chunks("chunks.json")
_chunks("means.npy")
_chunks("sh.npy")


def _layer(name: str, make_layer: Callable[[], Any]) -> None:
    @target(name)
    def make(folder: Path) -> Target:
        file = folder / "a.npz"
        save_layer(make_layer(), file)
        return Target(file=file, read=lambda: load_layer(file))


def _labels() -> Labels:
    info = LayerInfo(method="vote", names={1: "cup"}, class_of={1: 3}, views=("a",), seed=1)
    return Labels(
        ids=torch.tensor([1, 2, -1, 1], dtype=torch.int32),
        confidence=torch.rand(4, generator=torch.Generator().manual_seed(0)),
        evidence=torch.ones(4),
        inferred=torch.zeros(4, dtype=torch.bool),
        info=info.with_edit("complete", {"inferred": 2}),
    )


def _tree() -> InstanceTree:
    nodes = (TreeNode(id=1, level="group"), TreeNode(id=2, parent=1, name="cup", support=0.5))
    return InstanceTree(nodes=nodes, labels=_labels())


def _voxels(table: StoredTable) -> VoxelFeatures:
    return VoxelFeatures(
        grid=VoxelGrid(
            cells=torch.tensor([[-1, 0, 0], [0, 0, 0], [2, 0, 0]], dtype=torch.int32),
            size=0.5,
            origin=torch.zeros(3),
        ),
        table=table,
        weights=torch.tensor([1.0, 2.0, 3.0]),
        rows=torch.tensor([[0, 1], [1, -1], [-1, -1], [2, 0]], dtype=torch.int32),
        shares=torch.tensor([[0.5, 0.5], [1, 0], [0, 0], [0.25, 0.75]]),
        info=LayerInfo(method="voxels", views=("a",), seed=1),
    )


def _voxels_of_bytes() -> VoxelFeatures:
    codes = torch.tensor([[1, -2], [127, 0], [-127, 3]]).to(torch.int8)
    return _voxels(StoredTable(codes=codes, scales=torch.tensor([0.5, 0.25, 1.0])))


def _voxels_of_products() -> VoxelFeatures:
    codes = torch.tensor([[0, 255], [3, 4], [5, 6]], dtype=torch.uint8)
    codebooks = torch.arange(512, dtype=torch.float32).reshape(2, 256, 1) / 512
    return _voxels(StoredTable(codes=codes, codebooks=codebooks))


_layer("layer-voxels", lambda: _voxels(StoredTable(codes=torch.arange(12).reshape(3, 4).half())))
_layer("layer-voxels-int8", _voxels_of_bytes)
_layer("layer-voxels-product", _voxels_of_products)
_layer("layer-labels", _labels)
_layer("layer-tree", _tree)
_layer("layer-features", lambda: Features(values=torch.rand(4, 3), weights=torch.ones(4)))
_layer("layer-selection", lambda: Selection(mask=torch.tensor([True, False, True, False])))


@target("mesh-field")
def mesh_field(folder: Path) -> Target:
    """A field of one primitive."""
    file = folder / "field.safetensors"
    save_mesh_field(random_field(balls([[0, 0, 2]])), file)
    return Target(file=file, read=lambda: load_mesh_field(file))


@target("drive")
def drive_in_blocks(folder: Path) -> Target:
    """How a drive of two blocks was cut."""
    file = folder / "drive.json"
    road = torch.tensor([[3.0 * i, 0.1 * i * i, 0.0] for i in range(12)], dtype=torch.float64)
    drive = cut_drive(road, options=DriveBlockOptions(length=25.0, overlap=5.0))
    save_drive(drive, file, about={"seed": 1})
    return Target(file=file, read=lambda: load_drive(file))


@target("safetensors")
def safetensors(folder: Path) -> Target:
    """Weights."""
    header = {"a": {"dtype": "F32", "shape": [2, 3], "data_offsets": [0, 24]}}
    header |= {"b": {"dtype": "I64", "shape": [1], "data_offsets": [24, 32]}}
    words = json.dumps(header).encode()
    content = len(words).to_bytes(8, "little") + words + bytes(32)
    return whole(folder / "a.safetensors", content, read_tensors)


@target("weights.npz")
def weights(folder: Path) -> Target:
    """Weights of NumPy."""
    np.savez(folder / "a.npz", **{"a.b": np.eye(3), "c": np.arange(4, dtype=np.float16)})
    return Target(file=folder / "a.npz", read=lambda: read_tensors(folder / "a.npz"))


@target("fit-checkpoint")
def fit_checkpoint(folder: Path) -> Target:
    """A fit that was stopped."""
    file = folder / "checkpoint.npz"
    content = {"steps": 3, "progress": 0.5, "seconds": 1.0, "gaussians": 4}
    state = FitState(tensors={"a/b": torch.ones(3)}, content=content, identity={"data": {}})
    write_checkpoint(state, file)
    return Target(file=file, read=lambda: read_checkpoint(file))


@target("training")
def training_state(folder: Path) -> Target:
    """A training that was stopped."""
    file = folder / "a.npz"

    def start() -> Any:
        return training.TrainingState.started({"rows": torch.ones(4, 2)}, {"w": torch.ones(3)}, 4)

    identity = {"data": {"rows": "x"}, "options": {"steps": 9}, "defaults": {}}
    training.write_state(start(), file, identity)

    def read() -> None:
        training.training_summary(file)
        training.read_state(file, start(), identity)

    return Target(file=file, read=read)


@target("poses.json")
def poses(folder: Path) -> Target:
    """The report of poses that were found."""
    made = PoseReport(
        photographs=3,
        registered=("a", "b"),
        left_out=(LeftOut(name="c", why="too dark"),),
        mapper="glomap",
        tries=(
            MapperTry(mapper="glomap", registered=2, error=0.5, points=9, models=(2,), seconds=1.0),
        ),
        error=0.5,
        longest=1600,
        points=9,
        track_length=2.5,
        lenses=(Lens(width=8, height=6, photographs=2, focal=9.0, k1=0.01, start="EXIF"),),
        seconds={"match": 1.5},
    )
    content = {"format": saved.FORMAT, "version": saved.VERSION, "made_of": "x"}
    (folder / saved.FILE).write_text(json.dumps(content | {"report": asdict(made)}))
    return Target(
        file=folder / saved.FILE, read=lambda: saved.load_pose_report(folder, made_of="x")
    )


@target("columns.json")
def columns(folder: Path) -> Target:
    """What columns of an exported splat file mean."""
    file = folder / "a.ply"
    write_column_table({"columns": {"kind": {"names": {"1": "cup"}}}}, folder / "a.json")
    return Target(file=folder / "a.json", read=lambda: column_table_of(file))


@target("points.npz")
def points(folder: Path) -> Target:
    """Points with true ids."""
    np.savez(folder / "a.npz", xyz=np.ones((5, 3), np.float32), instance=np.arange(5))
    return Target(file=folder / "a.npz", read=lambda: read_points(folder / "a.npz", "instance"))


@target("moving.json")
def moving(folder: Path) -> Target:
    """Boxes around moving things."""
    box = {"centre": [0, 1.5, 2], "size": [4, 2, 1.5], "rotation": [1, 0, 0, 0]}
    rows = [box | {"start": 1, "end": 2.5, "name": "car 3"}, box | {"time": 7}]
    return whole(folder / "moving.json", json.dumps({"boxes": rows}).encode(), read_moving)
