"""CoSSegGaussians' experiments in one room: classes or panoptic segments, and what they cost."""

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import torch

from splatseg.core import (
    UNLABELLED,
    ClassTable,
    Features,
    InstanceTree,
    LabelMap,
    Layer,
    Selection,
    View,
    map_ids,
    with_info,
)
from splatseg.core.benchmark import BenchmarkScene, TrueMaps
from splatseg.errors import InputError, MissingFileError
from splatseg.evaluate import (
    Confusion,
    PanopticReport,
    evaluate_panoptic,
    frames_per_second,
    learned_bytes,
)
from splatseg.evaluate.frame_rate import TimedMaps, timed_label_maps
from splatseg.evaluate.protocols import Protocol, RoomSwitches
from splatseg.lift import GaussianField
from splatseg.lift.label_maps import has_classifier
from splatseg.render import get_backend
from splatseg.tasks.benchmark.class_names import ids_in_truth, room_table
from splatseg.tasks.benchmark.job import Job
from splatseg.tasks.benchmark.maps import Scores, TrueMapSource, class_scores, keep_map
from splatseg.tasks.benchmark.points import read_by_words
from splatseg.tasks.benchmark.sight import evidence_wanted
from splatseg.tasks.benchmark.walks import walk_splits

_LAYER = "layer"
_MEGABYTE = 1e6
_FOLDERS = {
    "replica": ("semantic_class", "semantic_instance"),
    "scannet": ("label-filt, with scannetv2-labels.combined.tsv", "instance-filt"),
}
"""Where the classes and the instances of a layout lie."""


def check_room(protocol: Protocol, bench: BenchmarkScene) -> None:
    """Refuse a scene that cannot be scored, before anything is fitted.

    Raises:
        MissingFileError: If it lacks true classes, or true instances where these are scored.
        InputError: If it has too few frames, or there is no class of a name of `stuff`.
    """
    switches = cast(RoomSwitches, protocol.switches)
    places = _FOLDERS.get(bench.layout, ("true classes", "true instances"))
    wanted = [(bench.semantic, places[0])]
    if switches.task == "panoptic":
        wanted.append((bench.instances, places[1]))
    for maps, place in wanted:
        if maps is None:
            raise MissingFileError(
                f"{bench.capture.path}: expected maps in {place}, which {protocol.name} is scored "
                "by, got none."
            )
    walk_splits(bench.capture, switches.train_every)
    room_table(bench, switches)


def room_scores(job: Job) -> Scores:
    """Figures of a method in a room.

    Returns:
        ``miou``, of panoptic segments with ``ap50`` and ``pq_scene``; ``fps``, the rate of label
        maps; ``learned_mb``, what the method learned, and ``scene_mb``, that with the Gaussians.
        A row a view, or of panoptic segments a row a class.

    Raises:
        InputError: If the method gives no classes, or the classes of its instances are not known.
    """
    switches = cast(RoomSwitches, job.protocol.switches)
    table = room_table(job.bench, switches)
    seen = job.seen(words=evidence_wanted(job.protocol, job.method, job.options) == "words")
    layer = job.layer(seen.name)
    size = learned_bytes(layer, job.scene.gaussians)
    layer = layer.cut() if isinstance(layer, InstanceTree) else layer
    if isinstance(layer, Selection):
        raise InputError(f"method {job.method.name}: expected labels, got a selection.")
    if isinstance(layer, Features) and not has_classifier(layer):
        ids = [row.id for row in table.rows]
        layer, class_of, notes = read_by_words(job, seen, layer, table, ids), None, list[str]()
    else:
        class_of, notes = ids_in_truth(job, seen, layer, table)
    views, lacking = _scored(job)
    room = _Room(job=job, table=table, views=views, layer=layer, class_of=class_of)
    scores, rows, seconds = room.semantic() if switches.task == "semantic" else room.panoptic()
    costs = {
        "fps": frames_per_second(seconds),
        "learned_mb": size.layer / _MEGABYTE,
        "scene_mb": size.total / _MEGABYTE,
    }
    return scores | costs, rows, [*notes, *lacking, _rate_note(job, views)]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Room:
    """A layer in a room, and what it is held against."""

    job: Job
    table: ClassTable
    views: Sequence[View]
    layer: Layer
    class_of: Mapping[int, int] | None
    """The truth's class by id of the layer; None where the ids are the truth's."""

    def semantic(self) -> tuple[dict[str, float], list[dict[str, Any]], list[float]]:
        """Scores, a row a view, and seconds of each view."""
        confusions: list[Confusion] = []
        seconds: list[float] = []
        for one in self._drawn():
            classes = self._classes(one.drawn)
            keep_map(self.job, "classes", one.view, classes)
            confusions.append(Confusion.of(classes, one.true.ids))
            seconds.append(one.seconds)
        scores, rows = class_scores(self.views, confusions)
        return {name: scores[name] for name in ("miou", "accuracy")}, rows, seconds

    def panoptic(self) -> tuple[dict[str, float], list[dict[str, Any]], list[float]]:
        """Scores, a row a class, and seconds of each view."""
        seconds: list[float] = []
        for one in self._drawn():
            keep_map(self.job, "instances", one.view, one.drawn.ids)
            keep_map(self.job, "classes", one.view, self._classes(one.drawn))
            seconds.append(one.seconds)
        report = self._report()
        scores = {
            "miou": report.semantic.miou,
            "ap50": report.precision.mean,
            "pq_scene": report.score.pq,
        }
        rows: list[dict[str, Any]] = [
            {
                "class": id,
                "name": self.table.name_of(id),
                "pq": one.pq,
                "sq": one.sq,
                "rq": one.rq,
                "ap50": report.precision.per_class.get(id),
                "iou": report.semantic.per_class.get(id),
            }
            for id, one in report.score.per_class.items()
        ]
        return scores, rows, seconds

    def _report(self) -> PanopticReport:
        with self.job.observer.stage("score segments") as step:
            return evaluate_panoptic(
                self._field(),
                self.views,
                classes=None,
                instances=_LAYER,
                true_classes=TrueMapSource(maps=_maps(self.job.bench.semantic)),
                true_instances=TrueMapSource(maps=_maps(self.job.bench.instances)),
                table=self.table,
                progress=step,
            )

    def _drawn(self) -> Iterator[TimedMaps]:
        truth = TrueMapSource(maps=_maps(self.job.bench.semantic))
        with self.job.observer.stage("score") as step:
            yield from timed_label_maps(self._field(), self.views, _LAYER, truth, progress=step)

    def _field(self) -> GaussianField:
        layer = self.layer
        if self.class_of is not None:
            layer = with_info(layer, replace(layer.info, class_of=dict(self.class_of)))
        gaussians = self.job.scene.gaussians
        return GaussianField(gaussians, {_LAYER: layer}, backend=self.job.backend)

    def _classes(self, drawn: LabelMap) -> torch.Tensor:
        if self.class_of is None:
            return drawn.ids
        return map_ids(drawn.ids, self.class_of, default=UNLABELLED)


def _maps(maps: TrueMaps | None) -> TrueMaps:
    """True maps that `check_room` found to be there."""
    return TrueMaps(read={}) if maps is None else maps


def _scored(job: Job) -> tuple[list[View], list[str]]:
    """All test views that have a truth, by name, and a note of those that have none."""
    splits = walk_splits(job.bench.capture, cast(RoomSwitches, job.protocol.switches).train_every)
    tests = [view for view in job.scene.views if splits.get(view.name) == "test"]
    known = _maps(job.bench.semantic).read
    views = sorted((view for view in tests if view.name in known), key=lambda view: view.name)
    if not views:
        raise InputError(
            f"scene {job.bench.name}: expected true classes of one of its {len(tests)} test views, "
            "got none."
        )
    lacking = len(tests) - len(views)
    return views, [f"{lacking} of {len(tests)} test views have no truth."] if lacking else []


def _rate_note(job: Job, views: Sequence[View]) -> str:
    """What the rate is a rate of: it is this machine's, and no property of the method."""
    camera, means = views[0].camera, job.scene.gaussians.means
    backend = get_backend(job.backend, like=means).name
    where = (
        torch.cuda.get_device_name(means.device)
        if means.is_cuda
        else f"{os.cpu_count()} cores, {torch.get_num_threads()} threads of torch"
    )
    return (
        f"fps: label maps of {camera.width}x{camera.height} pixels drawn per second on this "
        f"machine (backend {backend}, {where}), by the median of {len(views)} views after one."
    )
