"""A scene opened for work: what tasks resolve once and pass on, and who is told of the progress."""

import importlib.metadata
from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import torch

from splatseg.core import (
    LOCAL,
    Capture,
    Executor,
    Features,
    FlatLayer,
    Gaussians,
    InstanceTree,
    Labels,
    Layer,
    LayerInfo,
    Renderable,
    Scene,
    View,
    flat_layer,
    layer_address,
)
from splatseg.core.gaussians import no_gaussians
from splatseg.errors import InputError, RangeError
from splatseg.evaluate.photographs import MaskUse
from splatseg.io.atomic import atomic_file, check_utf8, check_writable, is_vacant, sweep
from splatseg.io.evidence import Evidence, evidence_names, find_evidence, open_evidence
from splatseg.io.json_files import write_json
from splatseg.io.scene import load_scene_layer, scene_layer_names
from splatseg.io.scene_fields import scene_field_path
from splatseg.io.scene_folder import check_unlocked, is_scene, is_unfinished
from splatseg.lift import GaussianField
from splatseg.lift.affinity import KIND
from splatseg.render import BackendName
from splatseg.render.paths import camera_path, is_forward_facing
from splatseg.report.html import Report, report_html

if TYPE_CHECKING:
    from splatseg.street.field import VertexRule

EVIDENCE_FOLDER = "evidence"
EXPORTS_FOLDER = "exports"
REPORTS_FOLDER = "reports"

_FOCUS_PIXELS = 128


class Step(Protocol):
    """Tells how far a stage is; `text` says it in words, for who wants more than numbers."""

    def __call__(self, done: int, total: int, text: str = "") -> None:
        """So many of so many steps are done; of 0 where the number is not known."""
        ...


class Observer:
    """Hears nothing. A command line, a notebook or a server overrides what it wants to hear.

    A task calls every method from the thread that it runs in. An exception raised by any of
    them ends the task, and is how a task is cancelled: what a task writes appears whole or not
    at all, and work that can be resumed is left so that it can.
    """

    def started(self, stage: str) -> None:
        """A stage of the work begins, such as ``render``."""

    def progress(self, stage: str, done: int, total: int) -> None:
        """So many of so many steps of a stage are done; of 0 where the number is not known."""

    def finished(self, stage: str) -> None:
        """A stage has ended, by an exception too."""

    def note(self, message: str) -> None:
        """Something a person should know; a sentence without a full stop."""

    def info(self, message: str) -> None:
        """What was found or decided on the way; a line without a full stop."""

    @contextmanager
    def stage(self, stage: str) -> Generator[Step]:
        """Tell of a stage from its start to its end; gives a function of (done, total, text)."""
        self.started(stage)
        try:
            yield lambda done, total, text="": self.progress(stage, done, total)
        finally:
            self.finished(stage)


SILENT = Observer()
"""For callers that want to hear nothing."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LayerFacts:
    """What a layer is chosen by."""

    kind: type[Layer]
    info: LayerInfo

    @property
    def rank(self) -> int | None:
        """0 for trees, 1 for labels of instances, 2 for other labels; None for what has no ids."""
        if self.kind is InstanceTree:
            return 0
        if self.kind is not Labels:
            return None
        return 1 if self.info.instances else 2

    @property
    def is_affinity(self) -> bool:
        """Whether it is of features that tell what belongs together."""
        return self.kind is Features and (self.info.head or {}).get("kind") == KIND


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Work:
    """A scene opened for work; a task makes it of its arguments, and passes it on.

    Layers, evidence and views are found by the names that people give them, when they are asked
    for; what was learnt of a layer or of evidence is kept.
    """

    scene: Scene
    layers: Mapping[str, Layer] | None = None
    """Layers at hand; others are read from the scene's folder."""

    backend: BackendName = "auto"
    observer: Observer = SILENT
    executor: Executor = LOCAL
    _facts: dict[str, LayerFacts] = field(default_factory=dict[str, LayerFacts])
    _evidence: dict[str, Evidence] = field(default_factory=dict[str, Evidence])

    @property
    def gaussians(self) -> Gaussians:
        """Those of the scene."""
        return self.scene.gaussians

    @property
    def root(self) -> Path:
        """The scene's folder.

        Raises:
            InputError: If it has none.
        """
        if self.scene.root is None:
            raise InputError("scene: expected one that was read from its folder, got one without.")
        return self.scene.root

    @property
    def layer_names(self) -> tuple[str, ...]:
        """Of all layers, at hand and in the folder."""
        there = () if self.scene.root is None else scene_layer_names(self.scene.root)
        return tuple(sorted({*(self.layers or ()), *there}))

    def layer(self, name: str, *, option: str = "layer") -> Layer:
        """A layer by name with all its levels; `option` names it in messages."""
        if self.layers is not None and name in self.layers:
            return self.layers[name]
        if self.scene.root is None:
            raise InputError(f"{option} {name!r}: the scene has no folder to read it from.")
        names = scene_layer_names(self.scene.root)
        if name not in names:
            known = ", ".join(names) or "it has none"
            raise InputError(
                f"{option}: expected one of {self.scene.root} ({known}), got {name!r}."
            )
        return load_scene_layer(self.scene.root, name)

    def flat_layer(self, address: str) -> FlatLayer:
        """A layer by NAME; of a tree its objects, NAME@part, NAME@group or NAME@0.3."""
        name, level = layer_address(address)
        return flat_layer(self.layer(name), level, name=name)

    def facts(self, name: str) -> LayerFacts:
        """What a layer is, without keeping it."""
        if name not in self._facts:
            layer = self.layer(name)
            self._facts[name] = LayerFacts(kind=type(layer), info=layer.info)
        return self._facts[name]

    def field(self, addresses: Iterable[str] = ()) -> GaussianField:
        """The Gaussians with some of the layers, each read once."""
        names = dict.fromkeys(address.partition("@")[0] for address in addresses)
        layers = {name: self.layer(name) for name in names}
        return GaussianField(self.gaussians, layers, backend=self.backend)

    @property
    def evidence_names(self) -> tuple[str, ...]:
        """Of the evidence of the scene and of its capture."""
        return evidence_names(self.scene.evidence_folders)

    def evidence(self, name: str, *, option: str = "evidence") -> Evidence:
        """Evidence by name, opened once; `option` names it in messages."""
        if name not in self._evidence:
            folder = find_evidence(self.scene.evidence_folders, name, option=option)
            self._evidence[name] = open_evidence(folder)
        return self._evidence[name]

    def known_evidence(self, name: str, *, option: str) -> Evidence:
        """Evidence by name, which must be one of `evidence_names`."""
        if name not in (names := self.evidence_names):
            known = ", ".join(names) or "there is none; `splatseg see` makes some"
            raise InputError(f"{option}: expected one of those at hand ({known}), got {name!r}.")
        return self.evidence(name)

    def evidence_of(self, *kinds: str) -> Iterator[str]:
        """Names of the evidence of some kinds, each opened when it is asked for."""
        return (name for name in self.evidence_names if self.evidence(name).kind in kinds)

    def views_of_split(self, split: str) -> tuple[View, ...]:
        """The views of a split, or of all."""
        views = tuple(view for view in self.scene.views if split in ("all", view.split))
        if views:
            return views
        known = ", ".join(sorted({view.split for view in self.scene.views}))
        known = known or "none: it has no views"
        raise InputError(f"split: expected all or a split of the scene ({known}), got {split!r}.")

    def views(self, requested: Sequence[str], *, frames: int | None = None) -> tuple[View, ...]:
        """The views of ``train`` or ``all``, or by name; with `frames` also ``path``."""
        if not requested:
            raise InputError("views: expected train, all or names of views, got none.")
        if frames is not None and tuple(requested) == ("path",):
            return self.path(frames=frames)
        if len(requested) > 1 or requested[0] not in ("train", "all"):
            return tuple(self.scene.view(name) for name in requested)
        views = self.scene.views if requested[0] == "all" else self.scene.train_views
        if not views:
            raise InputError(f"views: the scene has no view that {requested[0]} allows.")
        return views

    def split_or_path(
        self, split: str, *, frames: int, shown: Renderable | None = None
    ) -> tuple[tuple[View, ...], bool]:
        """The views of a split, or along a path, and whether these are along a path."""
        if split != "path" or any(view.split == "path" for view in self.scene.views):
            return self.views_of_split(split), False
        return self.path(frames=frames, shown=shown), True

    def path(self, *, frames: int, shown: Renderable | None = None) -> tuple[View, ...]:
        """Views ``path_0000`` and on, along `camera_path` of the training views, or of all."""
        along = self.scene.train_views or self.scene.views
        if not along:
            raise InputError("split: a path goes along the scene's views, and this scene has none.")
        if frames < 1:
            raise RangeError(f"frames: expected at least 1, got {frames}.")
        focus = _focus(shown or self.field(), along) if is_forward_facing(along) else None
        cameras = camera_path(along, frames=frames, up=self.scene.up, focus=focus)
        digits = max(4, len(str(frames - 1)))
        return tuple(
            View(name=f"path_{i:0{digits}d}", camera=camera, split="path")
            for i, camera in enumerate(cameras)
        )


def _focus(shown: Renderable, views: Sequence[View]) -> float | None:
    """Median over some views of the median depth of what they show; None where that is nothing."""
    depths: list[float] = []
    for view in views[:: max(1, len(views) // 5)]:
        longest = max(view.camera.width, view.camera.height)
        share = min(1.0, _FOCUS_PIXELS / longest)
        width, height = (
            max(1, round(side * share)) for side in (view.camera.width, view.camera.height)
        )
        with shown.view(view.camera.resized(width, height)) as looked_at:
            signals = looked_at.signals(colour=False)
        depth = signals.depth if signals.median_depth is None else signals.median_depth
        if bool((depth > 0).any()):
            depths.append(float(depth[depth > 0].median()))
    return sorted(depths)[len(depths) // 2] if depths else None


def view_spec(requested: Sequence[str]) -> str:
    """Which views were requested, as it is recorded beside what was made."""
    return ",".join(requested)


def scene_field(scene: Scene, name: str, *, vertex_rule: "VertexRule | None" = None) -> Renderable:
    """A field of the scene that is no Gaussians, by name: what `tasks.make_street_field` made.

    Of a drive in blocks few are held; they are read when they are asked for.

    Args:
        scene: The scene.
        name: Of the field.
        vertex_rule: Which vertices points ask; None is the rule that the field was made with.

    Raises:
        InputError: If the scene has none of this name, or the field does not know what the rule
            needs.
        MissingFileError: If it is a drive in blocks that was stopped.
        FileFormatError: If its file is damaged.
    """
    # Here, as most commands need no street.
    from splatseg.street.files import load_mesh_field, open_blocks

    if scene.root is None:
        raise InputError(f"field {name!r:.80}: the scene has no folder to read it from.")
    path = scene_field_path(scene.root, name)
    if path.is_dir():
        return open_blocks(path, vertex_rule=vertex_rule)
    return load_mesh_field(path).with_layer(vertex_rule=vertex_rule)


def check_streams(scene: Scene, what: str) -> None:
    """Refuse for a scene in chunks what would read all of its Gaussians.

    Args:
        scene: The scene.
        what: What was asked for, as people write it, and how to do without; begins the sentence.

    Raises:
        InputError: If its Gaussians are in chunks.
    """
    if scene.gaussians.chunks is not None:
        raise InputError(
            f"{what}: needs all Gaussians at once, and these are in chunks; `splatseg chunks "
            "SCENE -o NEW --whole` makes a scene that is read as a whole."
        )


def source_views(scene: Scene, info: LayerInfo, evidence: Evidence) -> tuple[View, ...]:
    """Views with evidence that made a layer, where it says which; else the training views."""
    known = set(evidence.view_names)
    names = None if info.views is None else set(info.views)
    return tuple(
        view
        for view in scene.views
        if view.name in known and (view.split == "train" if names is None else view.name in names)
    )


def photographed(views: Iterable[View]) -> list[View]:
    """The views whose photographs are there."""
    return [view for view in views if view.image is not None and view.image.is_file()]


def mask_use(scene: Scene) -> MaskUse:
    """What the masks of the photographs meant when the scene was fitted."""
    options = scene.provenance.get("options")
    said = options.get("masks") if isinstance(options, Mapping) else None  # pyright: ignore[reportUnknownMemberType]
    return "alpha" if said == "alpha" else "ignore" if said == "ignore" else "off"


def find_label_maps(folders: Sequence[Path], name: str | None, *, option: str = "evidence") -> Path:
    """The folder of evidence of this name; without one, that of the only label maps.

    There may be evidence of other kinds, such as depth of scans, which a fit puts into its scene.
    """
    if name is not None:
        return find_evidence(folders, name, option=option)
    found = {each: find_evidence(folders, each) for each in evidence_names(folders)}
    labels = [
        each
        for each, folder in found.items()
        if open_evidence(folder, unfinished="allow").kind == "labels"
    ]
    if len(labels) != 1:
        known = ", ".join(labels) or "there are none; `splatseg see` makes some"
        raise InputError(f"{option}: expected label maps by name ({known}), got none.")
    return found[labels[0]]


def scene_of_capture(capture: Capture, gaussians: Gaussians | None = None, **more: Any) -> Scene:
    """A scene with what a capture knows of its world; `more` are further fields.

    Args:
        capture: The capture.
        gaussians: Its Gaussians; None is none, a scene of views alone.
        more: Further fields of the scene.
    """
    known = Scene(
        gaussians=no_gaussians() if gaussians is None else gaussians,
        views=capture.views,
        classes=capture.classes,
        up=capture.up,
        metres_per_unit=capture.metres_per_unit,
        source=capture.path,
    )
    return replace(known, **more)


def versions(*names: str) -> dict[str, str]:
    """What a result depends on besides its inputs: versions of packages."""
    return {name: importlib.metadata.version(name) for name in names}


def layer_versions() -> dict[str, str]:
    """The versions that a layer records."""
    return versions("splatseg") | {"torch": str(torch.__version__)}


def write_page(page: Report, path: Path, *, record: Mapping[str, Any]) -> Path:
    """Write a page, and the record of what it shows as JSON beside it."""
    with atomic_file(path) as temporary:
        temporary.write_text(report_html(page), encoding="utf-8", newline="\n")
    write_json(record, path.with_suffix(".json"))
    return path


def check_new_folder(folder: Path) -> None:
    """Refuse, before the work, a place where no folder can be made, or where one with files is."""
    check_parent(folder)
    if folder.exists() and not (folder.is_dir() and is_vacant(folder)):
        raise InputError(f"{folder}: expected a new folder, got one that is there.")


def check_replaceable_scene(root: Path, *, unfinished: bool = False) -> None:
    """Refuse a place that holds anything but a scene without layers.

    Args:
        root: The scene folder to be.
        unfinished: Whether a fit that was stopped there is no obstacle.
    """
    if root.exists() and not root.is_dir():
        raise InputError(f"{root}: expected a folder to write to, got a file.")
    check_unlocked(root)
    check_parent(root)
    if is_scene(root):
        layers = scene_layer_names(root)
        if layers:
            raise InputError(
                f"{root}: expected a new folder, got a scene with layers ({', '.join(layers)}), "
                "which belong to its Gaussians; remove it or choose another name."
            )
    elif root.is_dir() and not is_vacant(root) and not (unfinished and is_unfinished(root)):
        raise InputError(f"{root}: expected an empty folder or a new one, got one with files.")


def check_parent(path: Path) -> None:
    """Refuse a path whose folder is not there, or where nothing can be written.

    What processes that were killed were writing there is cleared.
    """
    check_utf8(path)
    parent = path.resolve().parent
    if not parent.is_dir():
        raise InputError(f"{path}: expected a place in a folder that is there, got none.")
    check_writable(parent)
    sweep(parent)
    if path.is_dir():
        check_writable(path)


def check_parent_writable(path: Path) -> None:
    """Refuse a folder that is to be made, with the folders it lies in, where it cannot be."""
    check_utf8(path)
    there = next(place for place in (path, *path.absolute().parents) if place.exists())
    if not there.is_dir():
        raise InputError(f"{path}: expected a folder to write to, got a file in its way: {there}.")
    check_writable(there)
