"""The process that works with pycolmap: features, matches, mapping, and what came of it.

Run as ``python -m splatseg.pose._worker JOB.json`` by `splatseg.pose._recover`. It is a process
of its own because calls into pycolmap cannot be interrupted, and because pycolmap and Pillow
cannot live in one process: each brings its own copy of the image libraries, and a PNG saved
after ``import pycolmap`` ends in heap corruption (seen with pycolmap 4.2.1 and Pillow 12).
Nothing here imports torch or Pillow.

Progress goes to the standard output, one JSON object a line; the result to a file. Features and
matches stay in COLMAP's database, so that a second run goes on where the first was stopped.
"""

import json
import os
import shutil
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from splatseg.pose._pairs import (
    all_pairs,
    connected_groups,
    likeness,
    linking_pairs,
    selected_pairs,
)

# Features of a photograph, those of the largest scales.
_MAX_FEATURES = 8192
# Photographs up to which "auto" compares every pair; else each with so many that follow it by
# name, and so many that look most like it.
_EXHAUSTIVE_UP_TO, _OVERLAP, _NEIGHBOURS = 60, 6, 16
_IMAGES_AT_ONCE = 8
_PAIRS_AT_ONCE = 256
# Photographs with fewer verified matches in all are looked at again, at seconds a pair.
_WEAK = 150
_MAX_GUIDED_PAIRS = 12
# COLMAP's own threshold for a verified pair.
_MIN_INLIERS = 15
# Without a second try: a model that has all photographs and fits them like this, in pixels.
_GOOD_ERROR = 1.0
# With fewer than this share of the photographs, the guess of the focal length is doubted too.
_POOR_SHARE = 0.8


def main() -> int:
    """Do one job."""
    _end_with_parent()
    # Warnings of COLMAP go to the standard error stream, which the parent keeps in a file.
    pycolmap.logging.minloglevel = 1
    job = json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))
    result = WorkerJob(job).run()
    out = Path(job["result"])
    temporary = out.with_suffix(".tmp")
    temporary.write_text(json.dumps(result), encoding="utf-8")
    temporary.replace(out)
    return 0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FoundModel:
    """What one mapper made: its largest model, and the smaller ones."""

    mapper: str
    reconstructions: tuple[Any, ...]
    """The largest first."""

    registered: int
    error: float
    """Mean reprojection error of the largest, pixels of the working copies."""

    seconds: float

    @staticmethod
    def of(mapper: str, found: Sequence[Any], seconds: float) -> "FoundModel":
        """The result of a mapper, without photographs that see too few points."""
        for reconstruction in found:
            _drop_doubtful(reconstruction)
        kept = [r for r in found if r.num_reg_images() >= 2 and r.num_points3D() > 0]
        kept.sort(key=lambda r: (-r.num_reg_images(), r.compute_mean_reprojection_error()))
        return FoundModel(
            mapper=mapper,
            reconstructions=tuple(kept),
            registered=int(kept[0].num_reg_images()) if kept else 0,
            error=float(kept[0].compute_mean_reprojection_error()) if kept else 0.0,
            seconds=seconds,
        )

    def facts(self) -> dict[str, Any]:
        """In values that JSON holds."""
        return {
            "mapper": self.mapper,
            "registered": self.registered,
            "error": self.error,
            "points": int(self.reconstructions[0].num_points3D()) if self.registered else 0,
            "models": [int(r.num_reg_images()) for r in self.reconstructions],
            "seconds": self.seconds,
        }


class WorkerJob:
    """One set of photographs."""

    def __init__(self, job: dict[str, Any]) -> None:
        self._database = Path(job["database"])
        self._images = Path(job["images"])
        self._folder = Path(job["folder"])
        self._lenses: list[dict[str, Any]] = job["lenses"]
        self._options: dict[str, Any] = job["options"]
        self._names = sorted(name for lens in self._lenses for name in lens["images"])
        self._seconds: dict[str, float] = {}

    def run(self) -> dict[str, Any]:
        """All stages; what is to be told of them."""
        self._timed("features", self._extract)
        self._timed("matches", self._match)
        tries, best = self._timed("mapping", self._map)
        result: dict[str, Any] = {
            "seconds": self._seconds,
            "tries": [attempt.facts() for attempt in tries],
            "photographs": self._photographs(),
            "best": None,
        }
        if best is not None:
            # Asked before it is finished: finishing gives the photographs their own names.
            result["models"] = _members(best)
            result["best"] = tries.index(best)
            result["model"] = self._timed("finish", lambda: self._finish(best))
        return result

    def _timed(self, stage: str, work: Any) -> Any:
        begin = time.monotonic()
        _tell(stage, 0, 0)
        result = work()
        self._seconds[stage] = time.monotonic() - begin
        return result

    # -- features ---------------------------------------------------------------------------

    def _extract(self) -> None:
        ids = self._write_lenses()
        options = pycolmap.FeatureExtractionOptions()
        options.num_threads = self._options["threads"]
        options.use_gpu = False
        options.sift.max_num_features = _MAX_FEATURES
        done = 0
        for lens, id in zip(self._lenses, ids, strict=True):
            reader = pycolmap.ImageReaderOptions(
                camera_model="SIMPLE_RADIAL", existing_camera_id=id
            )
            for names in _chunks(sorted(lens["images"]), _IMAGES_AT_ONCE):
                pycolmap.extract_features(
                    self._database,
                    self._images,
                    image_names=list(names),
                    camera_mode=pycolmap.CameraMode.SINGLE,
                    reader_options=reader,
                    extraction_options=options,
                    device=pycolmap.Device.cpu,
                )
                done += len(names)
                _tell("features", done, len(self._names))

    def _write_lenses(self) -> list[int]:
        """Ids of the lenses in the database, which gets them in the first run."""
        with closing(pycolmap.Database.open(self._database)) as database:
            there = sorted(camera.camera_id for camera in database.read_all_cameras())
            if len(there) == len(self._lenses):
                return there
            # New, or stopped while they were written: no feature was found before they were.
            database.clear_all_tables()
            return [database.write_camera(_camera(lens)) for lens in self._lenses]

    # -- matches ----------------------------------------------------------------------------

    def _match(self) -> None:
        count = len(self._names)
        exhaustive = self._options["matching"] == "exhaustive" or (
            self._options["matching"] == "auto" and count <= _EXHAUSTIVE_UP_TO
        )
        if exhaustive:
            self._match_pairs(all_pairs(count))
        else:
            self._match_likely(count)
        self._look_again()

    def _match_likely(self, count: int) -> None:
        """Pairs by name and by looks, and then what may join parts that do not hang together."""
        alike = likeness(self._descriptors(), seed=self._options["seed"])
        self._match_pairs(selected_pairs(alike, overlap=_OVERLAP, neighbours=_NEIGHBOURS))
        groups = connected_groups(count, list(self._verified()))
        if len(set(groups)) > 1:
            self._match_pairs(linking_pairs(alike, groups, neighbours=_NEIGHBOURS))

    def _look_again(self) -> None:
        """Search along epipolar lines where a photograph hardly hangs on the rest.

        Knowing how two photographs lie to each other, a feature has few candidates left, and
        many more matches are sure; but on the CPU that costs seconds a pair.
        """
        verified = self._verified()
        strength = [0] * len(self._names)
        for pair, inliers in verified.items():
            for i in pair:
                strength[i] += inliers
        weak = [pair for pair in verified if min(strength[i] for i in pair) < _WEAK]
        weak = sorted(sorted(weak, key=lambda pair: -verified[pair])[:_MAX_GUIDED_PAIRS])
        with closing(pycolmap.Database.open(self._database)) as database:
            ids = {image.name: image.image_id for image in database.read_all_images()}
            for pair in weak:
                a, b = (ids[self._names[i]] for i in pair)
                database.delete_matches(a, b)
                database.delete_two_view_geometry(a, b)
        # Should this be stopped now, the next run finds them missing and matches them anew.
        self._match_pairs(weak, guided=True)

    def _match_pairs(self, pairs: Sequence[tuple[int, int]], *, guided: bool = False) -> None:
        matching = pycolmap.FeatureMatchingOptions()
        matching.guided_matching = guided
        matching.num_threads = self._options["threads"]
        matching.use_gpu = False
        verification = pycolmap.TwoViewGeometryOptions()
        verification.ransac.random_seed = self._options["seed"]
        listed = self._folder / "pairs.txt"
        pairing = pycolmap.ImportedPairingOptions()
        pairing.match_list_path = listed
        done = 0
        for chunk in _chunks(pairs, _IMAGES_AT_ONCE if guided else _PAIRS_AT_ONCE):
            lines = (f"{self._names[i]} {self._names[j]}\n" for i, j in chunk)
            listed.write_text("".join(lines), encoding="utf-8")
            pycolmap.match_image_pairs(
                self._database,
                matching_options=matching,
                pairing_options=pairing,
                verification_options=verification,
                device=pycolmap.Device.cpu,
            )
            done += len(chunk)
            _tell("matches", done, len(pairs))

    def _descriptors(self) -> list[np.ndarray[Any, np.dtype[np.uint8]]]:
        with closing(pycolmap.Database.open(self._database)) as database:
            ids = {image.name: image.image_id for image in database.read_all_images()}
            return [np.asarray(database.read_descriptors(ids[n]).data) for n in self._names]

    def _verified(self) -> dict[tuple[int, int], int]:
        """How many matches say that two photographs show the same, by their places."""
        with closing(pycolmap.Database.open(self._database)) as database:
            index_of = {name: i for i, name in enumerate(self._names)}
            index_of_id = {i.image_id: index_of[i.name] for i in database.read_all_images()}
            pair_ids, inliers = database.read_two_view_geometry_num_inliers()
        verified: dict[tuple[int, int], int] = {}
        for pair_id, count in zip(pair_ids, inliers, strict=True):
            a, b = (index_of_id[id] for id in pycolmap.pair_id_to_image_pair(pair_id))
            if count >= _MIN_INLIERS:
                verified[min(a, b), max(a, b)] = int(count)
        return verified

    # -- mapping ----------------------------------------------------------------------------

    def _map(self) -> tuple[list[FoundModel], FoundModel | None]:
        """Every try, and the one with the most photographs and then the least error."""
        plain = self._copied("plain")
        guessed = any(not lens["prior"] for lens in self._lenses)
        database = self._calibrated() if guessed else plain
        mapper = self._options["mapper"]
        tries: list[FoundModel] = []
        if mapper in ("auto", "global"):
            tries.append(self._global(database))
        if mapper == "incremental" or (mapper == "auto" and not self._good(tries)):
            tries.append(self._incremental(database, "incremental"))
            registered = max(attempt.registered for attempt in tries)
            if mapper == "auto" and guessed and registered < _POOR_SHARE * len(self._names):
                tries.append(self._incremental(plain, "incremental, other focal length"))
        found = [attempt for attempt in tries if attempt.registered]
        best = min(found, key=lambda a: (-a.registered, a.error), default=None)
        return tries, best

    def _good(self, tries: Sequence[FoundModel]) -> bool:
        return any(a.registered == len(self._names) and a.error <= _GOOD_ERROR for a in tries)

    def _copied(self, name: str) -> Path:
        """A database of its own: calibration changes what it works on."""
        copy = self._folder / f"{name}.db"
        # What SQLite has not moved into the file yet lies in a second one beside it.
        for ending in ("", "-wal"):
            part = self._database.with_name(self._database.name + ending)
            copy.with_name(copy.name + ending).unlink(missing_ok=True)
            if part.is_file():
                shutil.copyfile(part, copy.with_name(copy.name + ending))
        return copy

    def _calibrated(self) -> Path:
        """A copy whose focal lengths come from the pairs of photographs, where that works."""
        database = self._copied("calibrated")
        options = pycolmap.ViewGraphCalibrationOptions()
        options.random_seed = self._options["seed"]
        pycolmap.calibrate_view_graph(database, options)
        return database

    def _global(self, database: Path) -> FoundModel:
        options = pycolmap.GlobalPipelineOptions()
        options.num_threads = self._options["threads"]
        options.random_seed = self._options["seed"]
        begin = time.monotonic()
        _tell("global mapper", 0, 0)
        found = pycolmap.global_mapping(database, self._images, self._empty("global"), options)
        return FoundModel.of("global", list(found.values()), time.monotonic() - begin)

    def _incremental(self, database: Path, name: str) -> FoundModel:
        options = pycolmap.IncrementalPipelineOptions()
        options.num_threads = self._options["threads"]
        options.random_seed = self._options["seed"]
        options.min_model_size = 3
        begin = time.monotonic()
        placed = 0

        def next_image() -> None:
            nonlocal placed
            placed += 1
            _tell("incremental mapper", min(placed, len(self._names)), len(self._names))

        found = pycolmap.incremental_mapping(
            database,
            self._images,
            self._empty("incremental"),
            options,
            next_image_callback=next_image,
        )
        return FoundModel.of(name, list(found.values()), time.monotonic() - begin)

    def _empty(self, name: str) -> Path:
        folder = self._folder / name
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        return folder

    # -- what came of it --------------------------------------------------------------------

    def _finish(self, best: FoundModel) -> dict[str, Any]:
        reconstruction = best.reconstructions[0]
        facts = model_facts(reconstruction)
        facts["without_distortion"] = finish_model(
            reconstruction, self._lenses, threads=self._options["threads"]
        )
        out = self._empty("model")
        reconstruction.write_binary(out)
        return facts

    def _photographs(self) -> dict[str, dict[str, int]]:
        """Features and verified pairs of every photograph."""
        pairs = self._verified()
        with closing(pycolmap.Database.open(self._database)) as database:
            return {
                image.name: {
                    "features": int(database.num_keypoints_for_image(image.image_id)),
                    "pairs": sum(
                        self._names[a] == image.name or self._names[b] == image.name
                        for a, b in pairs
                    ),
                }
                for image in database.read_all_images()
            }


def _members(best: FoundModel) -> list[list[str]]:
    """Names of the photographs of each model of a try, the largest first."""
    return [
        sorted(model.image(id).name for id in model.reg_image_ids())
        for model in best.reconstructions
    ]


def _camera(lens: dict[str, Any]) -> pycolmap.Camera:
    camera = pycolmap.Camera.create_from_model_name(
        1, "SIMPLE_RADIAL", lens["focal"], lens["width"], lens["height"]
    )
    camera.has_prior_focal_length = lens["prior"]
    return camera


def _chunks(items: Sequence[Any], size: int) -> list[Sequence[Any]]:
    return [items[i : i + size] for i in range(0, len(items), size)]


def _tell(stage: str, done: int, total: int) -> None:
    line = json.dumps({"stage": stage, "done": done, "total": total})
    print(line, flush=True)  # noqa: T201  (the pipe to the parent)


def _end_with_parent() -> None:
    """End this process when the parent is gone: its end of the standard input closes then."""

    def wait() -> None:
        # A blocked os.read does not hold the interpreter's lock, and neither does pycolmap.
        while os.read(0, 1):
            pass
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


# A reconstruction of pycolmap: judged, freed of what is doubtful, and scaled to photographs.


# A photograph that sees fewer of the points than this has no pose worth keeping.
_MIN_POINTS = 12
# Where the lens model folds over within this factor of the corner, it is given up.
_FOLD_MARGIN = 1.1
# Extent of the cameras (10th to 90th percentile) in the world that is written.
_EXTENT = 10.0


def model_facts(reconstruction: Any) -> dict[str, Any]:
    """Points, errors and lenses, before the model is scaled to the photographs."""
    return {
        "points": int(reconstruction.num_points3D()),
        "error": float(reconstruction.compute_mean_reprojection_error()),
        "track_length": float(reconstruction.compute_mean_track_length()),
    }


def finish_model(
    reconstruction: Any, lenses: Sequence[Mapping[str, Any]], *, threads: int
) -> list[int]:
    """Scale a model to the photographs' own pixels and names, and the world to a usual size.

    Each axis is scaled by its own ratio, which makes OPENCV of SIMPLE_RADIAL. Pixel centres are
    at halves in COLMAP as in splatseg, so nothing is shifted.

    Returns:
        Indices, in `lenses`, of those whose distortion was given up since it folded over.
    """
    of_image = {name: i for i, lens in enumerate(lenses) for name in lens["images"]}
    ids = list(reconstruction.reg_image_ids())
    lens_of = {
        reconstruction.image(id).camera_id: of_image[reconstruction.image(id).name] for id in ids
    }
    without_distortion = [id for id in lens_of if _folds(reconstruction.camera(id))]
    if without_distortion:
        _remove_distortion(reconstruction, without_distortion, threads)
    reconstruction.normalize(extent=_EXTENT)
    for id in ids:
        image = reconstruction.image(id)
        lens = lenses[of_image[image.name]]
        scale = np.array([lens["full_width"] / lens["width"], lens["full_height"] / lens["height"]])
        for point in image.points2D:
            point.xy = point.xy * scale
        image.name = lens["images"][image.name]
    for camera_id, index in lens_of.items():
        _scale_camera(reconstruction.camera(camera_id), lenses[index])
    return sorted(lens_of[id] for id in without_distortion)


def _drop_doubtful(reconstruction: Any) -> None:
    """Take out photographs that see too few points."""
    for id in list(reconstruction.reg_image_ids()):
        image = reconstruction.image(id)
        if image.num_points3D < _MIN_POINTS:
            reconstruction.deregister_frame(image.frame_id)


def _scale_camera(camera: Any, lens: Mapping[str, Any]) -> None:
    focal, cx, cy, k1 = (float(v) for v in camera.params)
    sx = lens["full_width"] / lens["width"]
    sy = lens["full_height"] / lens["height"]
    camera.model = pycolmap.CameraModelId.OPENCV
    camera.width, camera.height = lens["full_width"], lens["full_height"]
    camera.params = [focal * sx, focal * sy, cx * sx, cy * sy, k1, 0.0, 0.0, 0.0]


def _folds(camera: Any) -> bool:
    r"""Whether r (1 + k r^2) has its maximum inside the image, so that it has no inverse.

    The maximum lies at r = 1 / sqrt(-3 k) and is 2/3 of that.
    """
    focal, cx, cy, k1 = (float(v) for v in camera.params)
    if k1 >= 0:
        return False
    corner = np.hypot(max(cx, camera.width - cx), max(cy, camera.height - cy)) / focal
    return bool(2.0 / 3.0 / np.sqrt(-3.0 * k1) < _FOLD_MARGIN * corner)


def _remove_distortion(reconstruction: Any, camera_ids: Sequence[int], threads: int) -> None:
    """Give up the distortion of lenses and fit everything else to that."""
    for id in camera_ids:
        camera = reconstruction.camera(id)
        camera.params = [*(float(v) for v in camera.params[:3]), 0.0]
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_extra_params = False
    options.ceres.solver_options.num_threads = threads
    pycolmap.bundle_adjustment(reconstruction, options)


if __name__ == "__main__":
    sys.exit(main())
