"""The main job on a generated room, of which the truth is known."""

import shlex
import shutil
import time
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta

from splatseg.core import Scene
from splatseg.core.boundary import boundary
from splatseg.core.options import options as options_class
from splatseg.errors import InputError
from splatseg.evaluate import Confusion, SemanticScore, semantic_score
from splatseg.fit import FitOptions
from splatseg.io.atomic import is_vacant
from splatseg.io.evidence import open_evidence
from splatseg.io.json_files import read_json, write_json
from splatseg.io.scene import load_scene, save_scene_layer
from splatseg.io.scene_folder import check_unlocked, work_on_scene
from splatseg.render import BackendName
from splatseg.report.fit_report import scored_of
from splatseg.synthetic import cameras, room, write_capture
from splatseg.tasks.evaluate import EvaluationOptions, Metric, evaluate_scene
from splatseg.tasks.export import Exported, export_layer, export_scene, report_layer
from splatseg.tasks.export_labels import ExportOptions
from splatseg.tasks.make_scene import MadeScene, fit_capture
from splatseg.tasks.render import RenderingOptions, render_views
from splatseg.tasks.see import see
from splatseg.tasks.segment import SegmentOptions, segment
from splatseg.tasks.work import SILENT, Observer, check_parent

_RECORD = "demo.json"
_MADE_BY = "splatseg demo"
# Everything that the demo writes besides its record; a second run removes these and no more.
_FOLDERS = ("capture", "scene", "render")
_FILES = ("labelled.ply", "labelled.json")
_POINTS = 15_000
_LAYER = "semantic"
_EVIDENCE = "labels_semantic"
_OBJECTS = "objects"
_MASKS = "masks"


@options_class
class DemoOptions:
    """Room, number of photographs, and length of the fit."""

    minutes: float | None = None
    """Length of the fit, minutes. None takes 1, unless `steps` is given."""

    steps: int | None = None
    """Length of the fit in steps instead: same seed, same result."""

    max_gaussians: int = 60_000
    """Largest number of Gaussians of the scene."""

    train_views: Annotated[int, Meta(ge=4)] = 48
    """Number of training photographs; a quarter as many are held out."""

    width: Annotated[int, Meta(ge=32)] = 320
    """Width of the photographs, pixels; they are three quarters as high."""

    seed: int = 0
    """Seed of the room and of all other random choices."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Demo:
    """What a demo left in its folder, and what it measured."""

    folder: Path
    came: SemanticScore
    """Of the machine's labels as they came, in train views."""

    figures: Mapping[tuple[str, str], Mapping[str, Any]]
    """What `evaluate_scene` gave, by layer (semantic, objects) and split."""

    record: dict[str, Any]
    """What its demo.json holds: scores, seconds by step, commands that do the same."""

    @property
    def reports(self) -> tuple[Path, ...]:
        """The pages of its layers."""
        return tuple(self.folder / f"scene/reports/{layer}.html" for layer in (_LAYER, _OBJECTS))


@boundary
def make_demo(
    folder: Path,
    *,
    options: DemoOptions | None = None,
    backend: BackendName = "auto",
    observer: Observer = SILENT,
) -> Demo:
    """Generate a room with a network's label maps, and do with it all that the main job is.

    Args:
        folder: Where everything goes. One that an earlier demo made is replaced.
        options: Which room.
        backend: Rendering backend.
        observer: Is told of each step by the command that does the same.

    Raises:
        InputError: If the folder holds anything but an earlier demo.
    """
    started = time.monotonic()
    options = options or DemoOptions()
    _check_folder(folder)
    folder.mkdir(exist_ok=True)
    with work_on_scene(folder, "demo"):
        return _made(folder, options, started, backend, observer)


def _made(
    folder: Path, options: DemoOptions, started: float, backend: BackendName, observer: Observer
) -> Demo:
    _prepare(folder, observer)
    observer.info("Generating a room with photographs, truth and machine labels")
    capture = folder / "capture"
    _photograph(capture, options, observer)
    job = _MainJob(folder, options, backend, observer)
    job.steps["generate"] = time.monotonic() - started
    job.run()
    came = _machine_score(capture)
    record = {
        "made_by": _MADE_BY,
        "finished": True,
        "psnr_test": job.figures[_LAYER, "test"]["PSNR"],
        "miou_labels_as_they_came_train": came.miou,
        "miou_lifted_train": job.figures[_LAYER, "train"]["mIoU"],
        "miou_lifted_test": job.figures[_LAYER, "test"]["mIoU"],
        "miou_objects_test": job.figures[_OBJECTS, "test"]["mIoU"],
        "seconds": {name: round(seconds, 2) for name, seconds in job.steps.items()},
        "seconds_total": round(time.monotonic() - started, 2),
        "commands": job.lines,
    }
    write_json(record, folder / _RECORD)
    return Demo(folder=folder, came=came, figures=job.figures, record=record)


def _machine_score(capture: Path) -> SemanticScore:
    """Of the recorded labels in the views that have them, pooled."""
    labels, truth = open_evidence(capture / _EVIDENCE), open_evidence(capture / "semantic")
    pairs = ((labels.label_map(name).ids, truth.label_map(name).ids) for name in labels.view_names)
    return semantic_score(sum((Confusion.of(*pair) for pair in pairs), Confusion.none()))


def _photograph(capture: Path, options: DemoOptions, observer: Observer) -> None:
    scene = room(seed=options.seed)
    views = cameras(
        room(seed=options.seed),
        train=options.train_views,
        test=max(1, options.train_views // 4),
        width=options.width,
        height=options.width * 3 // 4,
    )
    with observer.stage("photograph") as step:
        write_capture(scene, capture, views=views, points=_POINTS, seed=options.seed, progress=step)


class _MainJob:
    """The steps of the main job; each tells the command that does the same from the shell."""

    def __init__(
        self, folder: Path, options: DemoOptions, backend: BackendName, observer: Observer
    ) -> None:
        self.folder, self.options = folder, options
        self.backend: BackendName = backend
        self.observer = observer
        self.steps: dict[str, float] = {}
        """Seconds by step."""
        self.lines: list[str] = []
        """The commands."""
        self.figures: dict[tuple[str, str], dict[str, Any]] = {}
        """Scores by layer and split."""

    def run(self) -> None:
        """Do all steps."""
        folder, backend, observer = self.folder, self.backend, self.observer
        capture, root = folder / "capture", folder / "scene"
        with self._step("fit", capture, "-o", root, *self._fit_words()):
            self._fit(capture, root)
        scene = load_scene(root)
        truth = {_LAYER: capture / "semantic", _OBJECTS: capture / "instance"}
        self._segment(scene, "uplift", _EVIDENCE, _LAYER, truth[_LAYER])
        with self._step("see", root, "--model", "regions", "--evidence", _MASKS):
            see(scene, "regions", _MASKS, observer=observer)
        self._segment(scene, "associate", _MASKS, _OBJECTS, truth[_OBJECTS])
        what = ("rgb", "depth", _LAYER, _OBJECTS)
        with self._step("render", root, "--what", ",".join(what), "-o", folder / "render"):
            render_views(
                scene,
                folder / "render",
                options=RenderingOptions(what=what),
                backend=backend,
                observer=observer,
            )
        for split in ("train", "test"):
            self._evaluate(scene, _LAYER, split, truth[_LAYER], "semantic")
        self._evaluate(scene, _OBJECTS, "test", truth[_OBJECTS], "instances")
        labelled = folder / "labelled.ply"
        with self._step("export", root, "--layer", _LAYER, "--instances", _OBJECTS, "-o", labelled):
            export_scene(scene, labelled, options=ExportOptions(layer=_LAYER, instances=_OBJECTS))

    def _fit(self, capture: Path, root: Path) -> None:
        options = replace(FitOptions.preset("default"), seed=self.options.seed)
        options = options.with_length(minutes=self._minutes(), steps=self.options.steps)
        options = replace(options, max_gaussians=self.options.max_gaussians)
        made = fit_capture(
            capture,
            root,
            fit_options=options,
            backend=self.backend,
            command=self.lines[-1],
            observer=self.observer,
        )
        if made.interrupted:
            raise KeyboardInterrupt
        self.observer.info(_fitted(made))

    def _segment(self, scene: Scene, method: str, evidence: str, layer: str, truth: Path) -> None:
        backend, observer = self.backend, self.observer
        root = self.folder / "scene"
        with self._step(
            *("segment", root, "--method", method, "--evidence", evidence, "--layer", layer),
            *(("--export",) if layer == _OBJECTS else ()),
            *("--report", "--truth", truth),
            what=layer,
        ):
            options = SegmentOptions(evidence=evidence, layer=layer)
            made = segment(scene, method, options=options, backend=backend, observer=observer)
            save_scene_layer(made.layer, root, made.name)
            files: tuple[Exported, ...] = ()
            if layer == _OBJECTS:
                files, _ = export_layer(
                    scene, root, layer, made.layer, backend=backend, observer=observer
                )
            report_layer(
                scene,
                root,
                made,
                truth=open_evidence(truth),
                exported=files,
                command=self.lines[-1],
                backend=backend,
            )

    def _evaluate(self, scene: Scene, layer: str, split: str, truth: Path, metric: Metric) -> None:
        with self._step(
            *("evaluate", self.folder / "scene", "--layer", layer, "--truth", truth),
            *("--split", split, "--metric", metric),
            what=f"{layer}, {split}",
        ):
            found = evaluate_scene(
                scene,
                options=EvaluationOptions(layer=layer, truth=truth, split=split, metric=metric),
                backend=self.backend,
                observer=self.observer,
            )
        self.figures[layer, split] = found
        shown = {key: value for key, value in found.items() if isinstance(value, float)}
        self.observer.info("  ".join(f"{key} {value:.3f}" for key, value in shown.items()))

    @contextmanager
    def _step(self, name: str, *words: object, what: str = "") -> Generator[None]:
        """Tell a command, and time what does the same; `what` tells commands of one name apart."""
        chosen = [] if self.backend == "auto" or name == "see" else ["--backend", self.backend]
        line = shlex.join(["splatseg", name, *map(str, words), *chosen])
        self.lines.append(line)
        self.observer.info("")
        self.observer.info(f"$ {line}")
        begin = time.monotonic()
        yield
        self.steps[f"{name} {what}".strip()] = time.monotonic() - begin

    def _minutes(self) -> float | None:
        options = self.options
        return 1.0 if options.minutes is None and options.steps is None else options.minutes

    def _fit_words(self) -> list[object]:
        options, minutes = self.options, self._minutes()
        words: list[object] = [] if minutes is None else ["--minutes", minutes]
        if options.steps is not None:
            words += ["--steps", options.steps]
        return [*words, "--max-gaussians", options.max_gaussians, "--seed", options.seed]


def _fitted(made: MadeScene) -> str:
    scores = ""
    if made.scores is not None:
        scores = f"; PSNR {made.scores.psnr:.2f} dB on {scored_of(made.scores, made.held_out)}"
    return f"{len(made.result.gaussians)} Gaussians in {made.result.steps} steps{scores}"


def _check_folder(folder: Path) -> None:
    """Refuse a folder of anything but an earlier demo, or one that another process works on."""
    check_unlocked(folder)
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: expected a folder to write to, got a file.")
    check_parent(folder)
    record = folder / _RECORD
    if not folder.is_dir() or is_vacant(folder):
        return
    if not record.is_file() or read_json(record).get("made_by") != _MADE_BY:
        raise InputError(
            f"{folder}: expected a new or empty folder or one that an earlier demo made, got one "
            "with other files; choose another."
        )


def _prepare(folder: Path, observer: Observer) -> None:
    """Leave a folder with the record of an unfinished demo in it.

    The record comes first and goes last, so that whatever an interrupted run leaves is known
    to be a demo's and may be replaced by the next.
    """
    record = folder / _RECORD
    if record.is_file():
        observer.info(f"Replacing the earlier demo in {folder}")
    write_json({"made_by": _MADE_BY, "finished": False}, record)
    for name in _FOLDERS:
        if (folder / name).is_dir():
            shutil.rmtree(folder / name)
    for name in _FILES:
        (folder / name).unlink(missing_ok=True)
