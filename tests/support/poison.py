"""Values that no function should choke on, and arguments that each function takes."""

import inspect
import typing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from splatseg import core, edit, evaluate, pose, selection, synthetic
from splatseg.core import Camera, Gaussians, LabelMap, Labels, Selection, Similarity, View
from splatseg.io.evidence import TextEmbeddings
from splatseg.lift import GaussianField
from splatseg.neighbours import NeighbourIndex
from splatseg.prompting.prompts import AxisBox

COUNT, WIDTH, HEIGHT = 6, 12, 9


def poisons() -> dict[str, Any]:
    """What a notebook may hand over by mistake, or on purpose."""
    return {
        "None": None,
        "True": True,
        "zero": 0,
        "negative": -3,
        "huge": 10**30,
        "float": 2.5,
        "nan": float("nan"),
        "inf": float("inf"),
        "complex": 1 + 2j,
        "empty text": "",
        "text": "no such thing",
        "long text": "a" * 5000,
        "long path": Path("a" * 5000),
        "long words": ["b/" + "a" * 5000],
        "null byte": "a\0b",
        "surrogate": "\udcff",
        "bytes": b"x",
        "empty list": [],
        "list": [1.5, -2],
        "ragged": [[1], [2, 3]],
        "words": ["a", "b"],
        "nothings": [None],
        "dict": {},
        "other dict": {"a": None},
        "set": {1},
        "object": object(),
        "class": dict,
        "function": lambda *words: None,
        "path": Path("no/such/thing"),
        "doubles": np.zeros((HEIGHT, WIDTH)),
        "booleans": np.ones((HEIGHT, WIDTH), bool),
        "read-only": np.broadcast_to(np.float32(0.5), (COUNT, 3)),
        "backwards": np.arange(COUNT, dtype=">i4")[::-1],
        "texts": np.array(["a"]),
        "objects": np.array([None, {}], dtype=object),
        "dates": np.zeros(2, "datetime64[s]"),
        "long doubles": np.zeros(3, np.longdouble),
        "complex array": np.zeros((COUNT, 3), complex),
        "scalar": np.float64(0.5),
        "of none": np.zeros((0, 3)),
        "five axes": np.zeros((1, 1, 1, 1, 1)),
        "sparse": torch.eye(COUNT).to_sparse(),
        "meta": torch.zeros(COUNT, 3, device="meta"),
        "complex tensor": torch.zeros(COUNT, dtype=torch.complex64),
        "uint16": torch.zeros(HEIGHT, WIDTH, dtype=torch.uint16),
        "uint64": torch.full((COUNT,), 2**63, dtype=torch.uint64),
        "half": torch.zeros(COUNT, 3, dtype=torch.bfloat16),
        "gradient": torch.zeros(COUNT, 3, requires_grad=True),
        "not finite": torch.full((COUNT, 3), float("nan")),
    }


def gaussians() -> Gaussians:
    rng = np.random.default_rng(4)
    means = torch.from_numpy(rng.uniform(-0.4, 0.4, (COUNT, 3)).astype(np.float32))
    means[:, 2] += 2.0
    return Gaussians(
        means=means,
        rotations=torch.tensor([[1.0, 0, 0, 0]]).repeat(COUNT, 1),
        scales=torch.full((COUNT, 3), 0.1),
        opacities=torch.full((COUNT,), 0.8),
        sh=torch.zeros(COUNT, 1, 3),
    )


CAMERA = Camera(width=WIDTH, height=HEIGHT, fx=10, fy=10, cx=6, cy=4.5, cam_from_world=torch.eye(4))
NAMES = ("a", "b")


class Maps:
    """Label maps of two views, as a source of evidence."""

    view_names = NAMES

    def label_map(self, name: str) -> LabelMap:
        ids = torch.ones(HEIGHT, WIDTH, dtype=torch.int32)
        ids[:, 6:] = 2
        return LabelMap(ids=ids)


class World:
    """A scene on disk and in memory of which every argument is a part."""

    def __init__(self, folder: Path) -> None:
        from splatseg.io.evidence import (
            create_evidence,
            open_evidence,
            save_label_map,
            save_masks,
        )
        from splatseg.io.images import save_png
        from splatseg.io.scene import (
            GaussiansToWrite,
            save_scene,
            save_scene_in_chunks,
            save_scene_layer,
        )

        self.folder = folder
        self.made = 0
        (folder / "photographs").mkdir()
        pixels = torch.linspace(0, 1, HEIGHT * WIDTH * 3).reshape(HEIGHT, WIDTH, 3)
        for name in NAMES:
            save_png(pixels, folder / "photographs" / f"{name}.png")
        self.views = tuple(
            View(
                name=name, camera=CAMERA, image=folder / "photographs" / f"{name}.png", split=split
            )
            for name, split in zip(NAMES, ("train", "test"), strict=True)
        )
        self.gaussians = gaussians()
        ids = torch.tensor([1, 1, 2, 2, -1, 1], dtype=torch.int32)
        self.labels = Labels(ids=ids, confidence=torch.ones(COUNT))
        scene = core.Scene(gaussians=self.gaussians, views=self.views, up=(0.0, 0.0, 1.0))
        self.scene = save_scene(scene, folder / "scene")
        save_scene_layer(self.labels, folder / "scene", "things")
        evidence = create_evidence(folder / "scene" / "evidence" / "labels", kind="labels")
        for name in NAMES:
            save_label_map(Maps().label_map(name), evidence, name)
        self.evidence = open_evidence(evidence)
        masks = create_evidence(folder / "scene" / "evidence" / "masks", kind="masks")
        for name in NAMES:
            left = Maps().label_map(name).ids == 1
            save_masks(core.MaskSet.from_dense(left[None]), masks, name)
        self.masks = open_evidence(masks)
        chunked = core.Scene(gaussians=self.gaussians, views=self.views)
        made = GaussiansToWrite(count=COUNT, write=self.write_chunks)
        save_scene_in_chunks(chunked, made, folder / "chunked")
        self.benchmark = self._benchmark()
        self.room = synthetic.room(seed=0)
        self.truth = synthetic.render_truth(self.room, CAMERA)

    def _benchmark(self) -> Path:
        """A scene in the layout of SPIn-NeRF."""
        from support.benchmark_layouts.source import save_mask
        from support.benchmark_layouts.sparse import write_sparse

        scene = self.folder / "benchmark"
        write_sparse(scene / "sparse/0", self.views, [f"{name}.png" for name in NAMES], None)
        (scene / "images").mkdir()
        for view in self.views:
            (scene / "images" / f"{view.name}.png").write_bytes(view.image.read_bytes())
        save_mask(np.ones((HEIGHT, WIDTH), bool), scene / "masks/a.png")
        return scene

    def write_chunks(self, folder: Path) -> None:
        """The Gaussians in chunks."""
        from splatseg.io.chunks import write_chunks

        write_chunks(lambda first, end: self.gaussians[first:end], COUNT, folder, memory=1)

    def path(self) -> Path:
        """A path of nothing yet."""
        self.made += 1
        return self.folder / f"new-{self.made}"


def valid(world: World) -> dict[str, Any]:
    """An argument that is taken, by ``function.parameter``, by parameter, or by type."""
    mask = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    ids = Maps().label_map("a").ids
    scene = world.scene
    node = core.TreeNode(id=1)
    tree_labels = Labels(ids=torch.ones(COUNT, dtype=torch.int32), confidence=torch.ones(COUNT))
    tree = core.InstanceTree(nodes=(node,), labels=tree_labels)
    edited = core.Edited(gaussians=world.gaussians, rows=torch.arange(COUNT))
    info = core.LayerInfo()
    splat = world.folder / "scene" / "gaussians.ply"
    image = torch.zeros(HEIGHT, WIDTH, 3)
    where = selection.Where(layer="things", ids=(1,))
    overlaps = evaluate.Overlaps(pairs=torch.tensor([[1, 1]]), counts=torch.tensor([4]))
    capture = core.Capture(path=world.folder, format="test", views=world.views)
    rle = core.Rle.encode(mask)
    table = core.ClassTable(
        rows=(core.ClassInfo(id=1, name="one"), core.ClassInfo(id=2, name="two"))
    )
    by_type = {
        Gaussians: world.gaussians,
        Camera: CAMERA,
        View: world.views[0],
        Labels: world.labels,
        Selection: Selection(mask=world.labels.ids == 1),
        Similarity: Similarity.identity(),
        core.Scene: scene,
        core.Capture: capture,
        core.Features: core.Features(values=torch.ones(COUNT, 2)),
        core.MaskSet: core.MaskSet.from_dense(mask[None]),
        core.LabelMap: LabelMap(ids=ids),
        core.DepthMap: core.DepthMap(values=torch.ones(6, 8), kind="metric"),
        core.FeatureMap: core.FeatureMap(
            features=torch.ones(3, 4, 2), stride=3, height=9, width=12
        ),
        core.InstanceTree: tree,
        core.TreeNode: node,
        core.Edited: edited,
        core.LayerInfo: info,
        core.ClassTable: table,
        core.PointCloud: core.PointCloud(points=torch.rand(20, 3)),
        core.Prompt: core.Prompt(points=torch.tensor([[3.0, 3.0]])),
        core.LabelledMesh: core.LabelledMesh(
            vertices=torch.eye(3),
            faces=torch.tensor([[0, 1, 2]]),
            face_labels={"things": torch.tensor([1])},
        ),
        core.LabelledPoints: core.LabelledPoints(
            points=torch.rand(9, 3), labels={"things": torch.ones(9, dtype=torch.int32)}
        ),
        TextEmbeddings: TextEmbeddings(
            labels=("chair",), vectors=torch.ones(1, 4), kinds=("class",), target_ids=(-1,)
        ),
        core.Renderable: GaussianField(world.gaussians, {"things": world.labels}),
        core.LabelSource: Maps(),
        core.ScanSource: OneScan(),
        evaluate.Overlaps: overlaps,
        evaluate.Confusion: evaluate.Confusion.of(ids, ids),
        edit.Document: edit.Document(scene=scene, layers={"things": world.labels}),
        edit.Operation: edit.Operation(
            kind="remove", where=selection.Where(layer="things", ids=(1,))
        ),
        selection.Where: where,
        synthetic.SyntheticScene: world.room,
        Path: splat,
        str: "things",
        int: 2,
        float: 0.5,
        bool: False,
        torch.dtype: torch.int64,
    }
    by_name = {
        "folder": world.folder / "scene" / "evidence" / "labels",
        "output": world.path(),
        "root": world.folder / "scene",
        "path": splat,
        "backend": "cpu",
        "confidence": torch.ones(COUNT),
        "ids": torch.ones(COUNT, dtype=torch.int32),
        "rows": (),
        "points": torch.rand(5, 3),
        "pixels": torch.zeros(2, 2, dtype=torch.int64),
        "image": image,
        "truth": image,
        "height": HEIGHT,
        "width": WIDTH,
        "layers": {"things": world.labels},
        "views": world.views,
        "layer": "things",
        "name": "things",
        "evidence": "labels",
        "classes": table,
        "masks": (rle,),
        "things": (1,),
        "steps": 1,
        "report": {},
        "level": "object",
        "format": "auto",
        "max_views": 4,
        "longest": 64,
        "up": (0.0, 0.0, 1.0),
    }
    return {"by_type": by_type, "by_name": by_name, "special": special(world, by_type)}


def answers() -> Any:
    from splatseg.core import Features
    from splatseg.lift import TextSpace
    from splatseg.lift.vocabulary import Vocabulary
    from splatseg.lift.words import WordIndex, WordMatches
    from splatseg.tasks import QueryOptions, QueryResult

    none = torch.zeros(COUNT, 1)
    values = torch.rand(COUNT, 4, generator=torch.Generator().manual_seed(0))
    vocabulary = Vocabulary(space=TextSpace(width=4))
    return QueryResult(
        words=("cup",), found={"cup": ()}, surest={"cup": 0.0},
        vectors=WordMatches(words=("cup",), cosines=none, probabilities=none),
        index=WordIndex(Features(values=values), vocabulary), layer="objects",
        options=QueryOptions(),
    )  # fmt: skip


class OneScan:
    """A source of one scan."""

    scan_names = ("a",)

    def scan(self, name: str) -> core.Scan:
        return core.Scan(name=name, points=torch.ones(3, 3))


def voxels() -> core.VoxelGrid:
    cells = torch.tensor([[0, 0, 0], [1, 0, 0]])
    return core.VoxelGrid(cells=cells, size=1.0, origin=torch.zeros(3))


def special(world: World, by_type: dict[type, Any]) -> dict[str, Any]:
    ids = Maps().label_map("a").ids
    mask = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    byte = torch.zeros(HEIGHT, WIDTH, 3, dtype=torch.uint8)
    return {
        **inner(world, by_type),
        "tasks.select.prompts": [AxisBox(low=(-9, -9, -9), high=(9, 9, 9))],
        "tasks.draw_query_result.answers": answers(),
        "tasks.draw_heat.answers": answers(),
        "tasks.write_query_report.answers": answers(),
        "tasks.draw_selection.prompts": [AxisBox(low=(-9, -9, -9), high=(9, 9, 9))],
        "core.apply_rows.layer": world.labels,
        "core.StoredTable.codes": torch.ones(2, 4),
        "core.VoxelFeatures.grid": voxels(),
        "core.VoxelFeatures.table": core.StoredTable(codes=torch.ones(2, 4)),
        "core.VoxelFeatures.weights": torch.ones(2),
        "core.VoxelFeatures.rows": torch.zeros(COUNT, 1, dtype=torch.int32),
        "core.VoxelFeatures.shares": None,
        "core.map_ids.ids": ids,
        "core.map_ids.values": {1: 2},
        "core.map_ids.default": None,
        "core.flat_layer.layer": world.labels,
        "core.with_info.layer": world.labels,
        "core.layer_info_from_json.record": {},
        "core.layer_info_from_metadata.metadata": {},
        "core.LabelMap.ids": ids,
        "core.MaskSet.scores": torch.ones(1),
        "core.MaskSet.levels": torch.zeros(1, dtype=torch.int32),
        "core.Camera.cam_from_world": torch.eye(4),
        "core.Gaussians.means": by_type[Gaussians].means,
        "core.Gaussians.rotations": by_type[Gaussians].rotations,
        "core.Gaussians.scales": by_type[Gaussians].scales,
        "core.Gaussians.opacities": by_type[Gaussians].opacities,
        "core.Gaussians.sh": by_type[Gaussians].sh,
        "core.Rle.counts": np.array([0, HEIGHT * WIDTH], np.uint32),
        "core.Rle.height": HEIGHT,
        "core.Similarity.rotation": torch.eye(3),
        "core.Similarity.translation": torch.zeros(3),
        "core.Selection.mask": torch.ones(COUNT, dtype=torch.bool),
        "core.Features.values": torch.ones(COUNT, 2),
        "core.FeatureMap.features": torch.ones(3, 4, 2),
        "core.FeatureMap.stride": 3,
        "core.Edited.rows": torch.arange(COUNT),
        "core.Capture.path": world.folder,
        "core.LabelledMesh.vertices": torch.eye(3),
        "core.LabelledMesh.faces": torch.tensor([[0, 1, 2]]),
        "core.LabelledPoints.points": torch.rand(9, 3),
        "core.LabelledPoints.labels": {"things": torch.ones(9, dtype=torch.int32)},
        "core.TrueMask.read": lambda: mask,
        "core.TruePoints.points": torch.rand(COUNT, 3),
        "render.contributors.k": 1,
        "io.images.write_png.array": np.zeros((3, 3), np.uint8),
        "io.images.write_png.path": world.folder / "made.png",
        "io.evidence.save_render.image": torch.zeros(HEIGHT, WIDTH, 3, dtype=torch.uint8),
        "io.images.save_png.path": world.folder / "made.png",
        "io.splats.write_splats.path": world.folder / "made.ply",
        "io.splats.write_splats.format": None,
        "io.layers.save_layer.path": world.folder / "made.npz",
        "io.layers.save_layer.layer": world.labels,
        "io.layers.load_layer.path": world.folder / "scene" / "layers" / "things.npz",
        "io.scene.save_scene_layer.layer": world.labels,
        "io.scene.save_scene.root": world.folder / "saved",
        "io.evidence.save_label_map.folder": world.folder / "scene" / "evidence" / "labels",
        "io.evidence.create_evidence.kind": "labels",
        "splatseg_bench.layouts.find_layout.folder": world.benchmark,
        "splatseg_bench.layouts.read_benchmark.folder": world.benchmark,
        "splatseg_bench.layouts.read_benchmark.layout": "spin-nerf",
        "io.captures.read_capture.path": world.folder,
        "io.images.write_video.frames": [byte],
        "io.images.write_video.path": world.folder / "made.mp4",
        "models.find_model.name": "classical",
        "methods.find_method.name": "uplift",
        "models.classical.colour_gradient_features.image": byte,
        "models.classical.region_masks.image": byte,
        "models.regions.learned_masks.image": byte,
        "models.classical.grab_cut.image": byte.numpy(),
        "models.classical.grab_cut.size": (HEIGHT, WIDTH),
        "models.classical.partition.level": 0,
        "lift.cut_box.low": (-1.0, -1.0, -1.0),
        "lift.cut_box.high": (1.0, 1.0, 1.0),
        "lift.cut_masks.ids": (1,),
        "lift.split.selection": by_type[Selection],
        "lift.merge_panoptic.classes": world.labels,
        "lift.merge_panoptic.table": by_type[core.ClassTable],
        "evaluate.boundary_overlap.predicted": mask,
        "evaluate.boundary_overlap.truth": mask,
        "evaluate.binary_score.pairs": [(mask, mask)],
        "evaluate.per_image_miou.confusions": [by_type[evaluate.Confusion]],
        "evaluate.evaluate_points.truth": torch.ones(5, dtype=torch.int32),
        "evaluate.segment_keys.classes": ids,
        "evaluate.segment_keys.instances": ids,
        "evaluate.evaluate_panoptic.classes": "things",
        "evaluate.image_panoptic_score.counts": evaluate.PanopticCounts.of_image(ids, ids),
        "evaluate.SurfaceField.points": None,
        "raycast.RayCaster.vertices": torch.eye(3),
        "raycast.RayCaster.faces": torch.tensor([[0, 1, 2]]),
        "evaluate.evaluate_panoptic.instances": "things",
        "synthetic.look_at.eye": (0.0, 0.0, 0.0),
        "synthetic.look_at.target": (1.0, 0.0, 0.0),
        "synthetic.cast.origin": torch.zeros(3),
        "synthetic.cast.directions": torch.tensor([[1.0, 0, 0]]),
        "synthetic.machine_labels.truths": {"a": world.truth},
        "synthetic.start_points.truths": {"a": world.truth, "b": world.truth},
        "synthetic.write_capture.folder": world.folder / "capture",
        "edit.filled_layer.filled": edit.Filled(
            gaussians=world.gaussians[:0],
            replaced=Selection(mask=torch.zeros(len(world.gaussians), dtype=torch.bool)),
            holes=torch.zeros(0, dtype=torch.int64),
            rims=(),
        ),
        "edit.filled_layer.layer": world.labels,
        "edit.layer_called.address": "things",
        "edit.merged_layers.others": {"things": world.labels},
        "edit.replay.history": (),
        "edit.save_document.root": world.folder / "document",
        "neighbours.NeighbourIndex.points": torch.rand(9, 3),
        "neighbours.Subset.index": NeighbourIndex(torch.rand(9, 3)),
        "neighbours.Subset.members": torch.ones(9, dtype=torch.bool),
        "pose.PoseReport.left_out": (pose.LeftOut(name="c", why="dark"),),
        "pose.PoseReport.tries": (),
        "pose.PoseReport.lenses": (),
        "pose.PoseReport.seconds": {"match": 1.5},
        "tasks.segment.method": "uplift",
        "tasks.segment.evidence": "labels",
        "io.evidence.open_evidence.kind": None,
        "io.export.write_coco_panoptic.frames": (),
        "io.export.write_coco_panoptic.folder": world.folder / "coco",
        "io.export.write_coco_panoptic.segments": {},
        "io.export.write_coco_panoptic.categories": (),
        "io.export.write_labelled_splats.path": world.folder / "labelled.ply",
        "io.export.write_labelled_splats.columns": {"class_id": world.labels.ids},
        "io.export.write_points.path": world.folder / "points.ply",
        "io.export.write_object_table.path": world.folder / "table.json",
        "io.export.write_node_table.path": world.folder / "nodes.json",
        "io.export.write_column_table.path": world.folder / "columns.json",
        "io.export.write_column_table.content": {},
        "io.export.write_object_splats.folder": world.folder / "objects",
        "io.export.write_object_meshes.folder": world.folder / "meshes",
        "io.export.label_columns.layer": world.labels,
        "io.export.label_columns.kind": "class",
        "io.export.write_scan_points.path": world.folder / "scan.ply",
        "io.export.write_scan_points.columns": {},
        "io.export.write_scan_labels.found": (),
        "io.export.write_scan_labels.folder": world.folder / "scan_labels",
        "neighbours.ball_means.index": NeighbourIndex(torch.rand(3, 3)),
        "neighbours.ball_means.values": torch.ones(3, 2),
        "neighbours.ball_means.queries": torch.rand(5, 3),
    }


def inner(world: World, by_type: dict[type, Any]) -> dict[str, Any]:
    """Of functions whose arguments other functions of ours make."""
    from splatseg.evaluate import BoundaryCounts, Detections
    from splatseg.fit import FitOptions, cut_capture
    from splatseg.io.export import objects_of
    from splatseg.io.scene import GaussiansToWrite, load_scene
    from splatseg.lift import EvidenceSegments, UpliftOptions, uplift
    from splatseg.lift.training import AdamConstants, LabelTargets
    from splatseg.methods import find_method
    from splatseg.models import find_model
    from splatseg.pose.doctor import Diagnosis, PointCorrection
    from splatseg.tasks import EditOptions, SegmentOptions, SharpenSceneOptions, segment

    two = UpliftOptions(candidates=2)
    soft = uplift(
        world.gaussians,
        world.views,
        world.evidence,
        options=two,
        backend="cpu",
    )
    made = segment(world.scene, options=SegmentOptions(evidence="labels"), backend="cpu")
    rows = torch.tensor([0, 1, 2])
    method = find_method("uplift")
    row = objects_of(world.gaussians, world.labels)[0]
    return {
        "core.plain_json.value": {},
        "core.plain_object.value": {},
        "core.Panoptic.segments": (),
        "core.tree_level.text": "object",
        "core.Track.votes": {"a": 1},
        "core.InstanceTree.labels": by_type[core.InstanceTree].labels,
        "core.flat_layer.level": None,
        "core.Prompt.points": torch.tensor([[3.0, 3.0]]),
        "core.Boxes.words": (0,),
        "core.Pointmap.points": torch.rand(2, 3, 3),
        "core.Pointmap.confidence": torch.ones(2, 3),
        "render.SparseWeights.gaussians": COUNT,
        "render.SparseWeights.weights": torch.zeros(6),
        "io.evidence.save_tracks.tracks": (),
        "io.evidence.save_tracks.folder": world.path().parent,
        "io.evidence.save_segments.segments": {},
        "io.evidence.save_segments.folder": world.path().parent,
        "io.export.object_content.row": row,
        "io.export.write_object_table.rows": (row,),
        "io.export.write_object_meshes.objects": (_mesh_of(row),),
        "io.export.check_replaceable.path": world.path(),
        "methods.Method.options": method.options,
        "methods.Method.run": method.run,
        "methods.Method.evidence": ("labels",),
        "methods.keeps_boundaries.method": "uplift",
        "methods.keeps_ids.method": "uplift",
        "methods.register_method.method": replace(method, name="own"),
        "models.record_evidence.model": find_model("classical"),
        "models.record_evidence.folder": world.path(),
        "lift.MatchedMaps.source": EvidenceSegments(evidence=world.masks),
        "evaluate.contested.labels": soft,
        "lift.correct_confusion.labels": soft,
        "lift.EvidenceSegments.evidence": world.masks,
        "lift.training.RowAdam.constants": AdamConstants(),
        "lift.training.RowSampler.source": LabelTargets(world.evidence, NAMES),
        "lift.training.LabelTargets.evidence": world.evidence,
        "lift.training.LabelTargets.names": NAMES,
        "lift.training.MaskTargets.evidence": world.masks,
        "lift.training.MaskTargets.names": NAMES,
        "lift.training.Ragged.starts": torch.tensor([0, 3]),
        "lift.training.Ragged.values": rows,
        "evaluate.boundary_score.counts": BoundaryCounts(
            ids=torch.tensor([1]), counts=torch.tensor([[1, 1, 1]])
        ),
        "evaluate.average_precision.detections": Detections(),
        "evaluate.contested.ratio": 0.5,
        "evaluate.ssim.image": torch.zeros(12, 12, 3),
        "evaluate.ssim.truth": torch.zeros(12, 12, 3),
        "evaluate.Confusion.counts": torch.ones(2, 2, dtype=torch.int64),
        "synthetic.SyntheticScene.primitives": world.room.primitives,
        "synthetic.SyntheticScene.objects": world.room.objects,
        "synthetic.SyntheticScene.classes": world.room.classes,
        "synthetic.Primitive.centre": (0.0, 0.0, 0.0),
        "synthetic.Primitive.half_size": (1.0, 1.0, 1.0),
        "edit.Operation.kind": "transform",
        "edit.Operation.transform": Similarity.identity(),
        "edit.ids_named.names": ("one",),
        "edit.ids_named.classes": by_type[core.ClassTable],
        "fit.random_point_count.options": FitOptions(),
        "fit.fit_blocks.cut": cut_capture(
            replace(by_type[core.Capture], points=by_type[core.PointCloud]),
            1,
            options=FitOptions(minutes=None, steps=1, max_gaussians=9),
        ),
        "fit.added_gaussians.options": FitOptions(),
        "fit.Refinement.options": FitOptions(),
        "fit.exposures_record.exposures": {},
        "edit.refit.provenance": {},
        "fit.recorded_exposures.provenance": {},
        "fit.refinement_options.provenance": {},
        "pose.doctor.write_corrected.diagnosis": Diagnosis(
            capture=by_type[core.Capture], faults=(), doubts=(), unchecked=(), figures={}
        ),
        "pose.doctor.describe_move.correction": PointCorrection(matrix=np.eye(3)),
        "tasks.attach_layers.source": world.folder / "scene",
        "tasks.describe.path": world.folder / "scene",
        "tasks.edit_scene.options": EditOptions(remove=True, layer="things", ids=(1,)),
        "tasks.edit_scene.folder": world.path(),
        "tasks.edit_chunks.scene": load_scene(world.folder / "chunked", memory=10**9),
        "tasks.edit_chunks.options": EditOptions(remove=True, sphere=(0, 0, 2, 0.5)),
        "tasks.edit_chunks.folder": world.path(),
        "tasks.chunk_scene.source": world.folder / "scene",
        "tasks.chunk_scene.folder": world.path(),
        "io.scene.save_scene_in_chunks.root": world.path(),
        "io.scene.save_scene_in_chunks.gaussians": GaussiansToWrite(
            count=COUNT, write=world.write_chunks
        ),
        "tasks.export_scene.output": world.folder / "exported.ply",
        "tasks.export_layer.layer": world.labels,
        "tasks.report_layer.result": made,
        "tasks.save_segmentation.made": made,
        "tasks.sharpen_scene.options": SharpenSceneOptions(layer="things"),
        "tasks.see.model": "classical",
        "tasks.see.evidence": "seen",
        "tasks.EditOptions.remove": True,
        "tasks.EditOptions.layer": "things",
        "tasks.EditOptions.ids": (1,),
    }


def _mesh_of(row: Any) -> Any:
    """A tetrahedron."""
    from splatseg.io.export import ImageTexture, ObjectMesh, TriangleMesh

    corners = torch.cat((torch.zeros(1, 3), torch.eye(3))).double()
    faces = torch.tensor([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
    colour = ImageTexture(uv=corners[:, :2], image=torch.zeros(4, 4, 3, dtype=torch.uint8))
    mesh = TriangleMesh(vertices=corners, faces=faces)
    return ObjectMesh(row=row, mesh=mesh, normals=corners + 0.1, colour=colour, facts={})


def argument(known: dict[str, Any], key: str, parameter: inspect.Parameter, hint: Any) -> Any:
    """A valid argument for a parameter; ValueError where nobody knows one."""
    if f"{key}.{parameter.name}" in known["special"]:
        return known["special"][f"{key}.{parameter.name}"]
    if isinstance(hint, type) and hint in known["by_type"] and hint not in (str, int, float, Path):
        return known["by_type"][hint]
    if parameter.name in known["by_name"]:
        return known["by_name"][parameter.name]
    if hint in known["by_type"]:
        return known["by_type"][hint]
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if origin is typing.Literal:
        return args[0]
    for arg in args:
        if isinstance(arg, type) and arg in known["by_type"]:
            one = known["by_type"][arg]
            return one if origin in (typing.Union, None) or "Union" in str(origin) else (one,)
    if isinstance(hint, type) and hasattr(hint, "dim_str"):
        sizes = [int(axis) if axis.isdecimal() else 1 for axis in hint.dim_str.split()]
        return torch.zeros(sizes, dtype=getattr(torch, str(hint.dtypes[-1]).rstrip("_")))
    raise ValueError(f"{key}.{parameter.name}: {hint}")
