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
from splatseg.errors import InputError, MissingFileError
from splatseg.evaluate import Confusion, PanopticReport, evaluate_panoptic
from splatseg.io.evidence import Evidence, TrackedEvidence, open_evidence
from splatseg.lift import GaussianField
from splatseg.lift.label_maps import has_classifier
from splatseg.render import get_backend
from splatseg_bench.evidence import Seen, evidence_wanted
from splatseg_bench.job import Job
from splatseg_bench.layouts.replica import REPLICA_CLASSES
from splatseg_bench.layouts.scannet import NYU40
from splatseg_bench.maps import Scores, TrueMapSource, class_scores, keep_map
from splatseg_bench.measures import TimedMaps, frames_per_second, learned_bytes, timed_label_maps
from splatseg_bench.points import read_by_words
from splatseg_bench.protocols import Protocol, RoomSwitches
from splatseg_bench.scene import BenchmarkScene, TrueMaps
from splatseg_bench.scenes import walk_splits

_PUBLISHED = {"replica": REPLICA_CLASSES, "scannet": NYU40}
"""The table of a data set, where a scene tells none."""


def room_table(bench: BenchmarkScene, switches: RoomSwitches) -> ClassTable:
    """The classes of the truth, of which those of `stuff` are stuff and all others things.

    They are those that the scene tells, else those that the data set publishes. 0 of the maps is
    none and is left out of everything, so that classes need not be numbered anew for a scene: what
    does not occur in its truth is not scored.

    Raises:
        InputError: If neither the scene nor the data set has a class of one of these names.
    """
    published = _PUBLISHED.get(bench.layout, ClassTable(rows=()))
    told = None if bench.semantic is None else bench.semantic.table
    table = published if told is None else told
    stuff = {name.lower() for name in switches.stuff}
    known = {row.name.lower() for row in (*table.rows, *published.rows)}
    if stuff - known:
        raise InputError(
            f"stuff: expected names of classes of {bench.layout}, got {min(stuff - known)!r}, "
            "which is none."
        )
    return ClassTable(
        rows=tuple(replace(row, isthing=row.name.lower() not in stuff) for row in table.rows)
    )


def ids_in_truth(
    job: Job, seen: Seen, layer: Layer, table: ClassTable
) -> tuple[dict[int, int] | None, list[str]]:
    """The truth's class by id of a layer, told by names; None where ids are taken as they are.

    Args:
        job: The method and the scene.
        seen: The evidence that the layer was made of.
        layer: Its ids are classes, or instances whose classes its info or the tracks tell.
        table: The classes of the truth.

    Returns:
        The classes, and notes.

    Raises:
        InputError: If the layer has instances whose classes nobody tells.
    """
    if job.scene.root is None:
        raise InputError("scene: expected one that was read from its folder, got one without.")
    evidence = open_evidence(job.scene.root / "evidence" / seen.name)
    names = _names(job, evidence, layer)
    if names is None:
        return (
            dict(layer.info.class_of) or None,
            [f"ids of classes are taken as they are: {seen.model} has no names of them."],
        )
    switches = job.protocol.switches
    aliases = switches.named_alike if isinstance(switches, RoomSwitches) else {}
    known = {row.name.lower(): row.id for row in table.rows}
    found = {id: known[own] for id, name in names.items() if (own := _own(name, aliases)) in known}
    lacking = sorted({name for name in names.values() if _own(name, aliases) not in known})
    if not lacking:
        return found, []
    classes = len(set(names.values()))
    return found, [
        f"{len(lacking)} of {classes} classes of {seen.model} are none of the truth's "
        f"({', '.join(lacking[:3])}{', ...' if len(lacking) > 3 else ''}); the switch aliases says "
        "what they are called there."
    ]


def _own(name: str, aliases: Mapping[str, str]) -> str:
    return aliases.get(name.lower(), name.lower())


def _names(job: Job, evidence: Evidence, layer: Layer) -> dict[int, str] | None:
    """The name of the class of each id of a layer; None where there are no names."""
    if evidence.kind == "labels":
        table = evidence.classes
        return None if table is None else {row.id: row.name for row in table.rows}
    tracked = evidence if isinstance(evidence, TrackedEvidence) else None
    if layer.info.class_of:
        table = evidence.classes if tracked is None else tracked.maps.table
        if table is None:
            return None
        return {id: table.name_of(one) for id, one in layer.info.class_of.items()}
    tracks = () if tracked is None or not job.method.keeps_ids else tracked.tracks
    names = {track.id: track.category for track in tracks if track.category is not None}
    if not names:
        raise InputError(
            f"method {job.method.name}: expected instances whose classes are known, by the layer "
            f"or by the tracks that its ids are, got {evidence.folder} without them."
        )
    return names


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
