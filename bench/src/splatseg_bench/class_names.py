"""Classes of rooms by their names: of the truth, and of what a layer's ids stand for."""

from collections.abc import Mapping
from dataclasses import replace

from splatseg.core import ClassTable, Layer
from splatseg.errors import InputError
from splatseg.io.evidence import Evidence, TrackedEvidence, open_evidence
from splatseg_bench.job import Job
from splatseg_bench.layouts.replica_classes import REPLICA_CLASSES
from splatseg_bench.layouts.scannet import NYU40
from splatseg_bench.protocols import RoomSwitches
from splatseg_bench.scene import BenchmarkScene
from splatseg_bench.sight import Seen

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
