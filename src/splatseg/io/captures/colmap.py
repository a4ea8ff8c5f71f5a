"""Reads COLMAP captures: a sparse model, binary or text, with three files or with five."""

from collections.abc import Iterable
from pathlib import Path

from splatseg.core import Capture
from splatseg.errors import InputError, MissingFileError, quoted
from splatseg.io.captures import _colmap_binary, _colmap_text
from splatseg.io.captures._nerfstudio_split import splits_beside
from splatseg.io.captures.build import MIN_THERE, RawView, build_capture
from splatseg.io.captures.colmap_model import ColmapModel, intrinsics_of, poses_of
from splatseg.io.foreign import is_file

_MODEL_FOLDERS = ("sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse", ".", "0")
_IMAGE_FOLDERS = ("images", "input", "rgb", "images_2", "images_4", "images_8", ".")
# A model may be named itself: capture/colmap/sparse/0 lies three folders below its capture.
_LEVELS_UP = 3


def find_colmap(folder: Path) -> Path | None:
    """The folder of the sparse model of a capture, or None."""
    for name in _MODEL_FOLDERS:
        model = folder / name
        for suffix in (".bin", ".txt"):
            if all((model / f"{stem}{suffix}").is_file() for stem in ("cameras", "images")):
                return model
    return None


def read_colmap(folder: Path, *, strict: bool = False) -> Capture:
    """Read a capture with a COLMAP model; see `read_capture`.

    The model is sought in ``sparse/0``, ``sparse``, ``colmap/sparse/0``, ``colmap/sparse`` and
    the folder itself, binary before text; photographs in ``images``, ``input``, ``rgb``,
    ``images_2``, ``images_4``, ``images_8`` and the folder itself, then in the same places of
    up to three folders above. Where a ``transforms.json``
    beside it has a split for the same photographs, that split is the capture's own.

    Raises:
        MissingFileError: If there is no model, or photographs of it are missing.
        InputError: If the model is corrupt or cannot be used.
    """
    model_folder = find_colmap(folder)
    if model_folder is None:
        raise MissingFileError(
            f"{folder}: expected a COLMAP model (cameras and images as .bin or .txt) in "
            f"{', '.join(_MODEL_FOLDERS)}, got none."
        )
    model = read_colmap_model(model_folder)
    root, images = _image_folder(folder, [image.name for image in model.images.values()])
    splits = splits_beside(root)
    poses = poses_of(model, where=str(model_folder))
    raw: list[RawView] = []
    for id, image in model.images.items():
        if image.camera_id not in model.cameras:
            raise InputError(
                f"{model_folder}: image {quoted(image.name)} names camera {image.camera_id}, "
                "which is not there."
            )
        relative = image.name.replace("\\", "/")
        raw.append(
            RawView(
                image=images / relative,
                relative=relative,
                intrinsics=intrinsics_of(
                    model.cameras[image.camera_id],
                    where=f"{model_folder}: camera {image.camera_id}",
                ),
                cam_from_world=poses[id],
                split=splits.get(images / relative),
            )
        )
    return build_capture(
        root,
        raw,
        format="colmap",
        points=model.points,
        notes=_notes(model_folder),
        strict=strict,
    )


def read_colmap_model(folder: Path) -> ColmapModel:
    """Read a sparse model; points, rigs and frames may lack.

    Raises:
        FileFormatError: If a file is cut short, corrupt or cannot be parsed.
    """
    binary = (folder / "cameras.bin").is_file() and (folder / "images.bin").is_file()
    reader, suffix = (_colmap_binary, ".bin") if binary else (_colmap_text, ".txt")
    points, rigs, frames = (folder / f"{stem}{suffix}" for stem in ("points3D", "rigs", "frames"))
    five = rigs.is_file() and frames.is_file()
    return ColmapModel(
        cameras=reader.read_cameras(folder / f"cameras{suffix}"),
        images=reader.read_images(folder / f"images{suffix}"),
        points=reader.read_points(points) if points.is_file() else None,
        rigs=reader.read_rigs(rigs) if five else {},
        frames=reader.read_frames(frames) if five else (),
    )


def _image_folder(folder: Path, names: Iterable[str]) -> tuple[Path, Path]:
    """The capture's folder and the one its photographs lie in.

    The first that has enough of them; a complete one comes after, if it is of another size.
    """
    images = [name.replace("\\", "/") for name in names]
    # The folder may be the model itself, or one between it and the capture.
    roots = [folder, *list(folder.resolve().parents)[:_LEVELS_UP]]
    for root in roots:
        best, most = root, 0
        for candidate in (root / name for name in _IMAGE_FOLDERS):
            there = sum(is_file(candidate / image) for image in images)
            if there > most:
                best, most = candidate, there
            if most >= MIN_THERE * len(images) > 0:
                break
        if most:
            return root, best
    # None is there: the complaint about missing photographs names where they belong.
    return folder, folder / _IMAGE_FOLDERS[0]


def _notes(model: Path) -> list[str]:
    parent = model.parent
    if parent.name != "sparse":
        return []
    others = sorted(
        p.name for p in parent.iterdir() if p.is_dir() and p.name != model.name and find_colmap(p)
    )
    if not others:
        return []
    return [f"{parent.name} holds further models ({', '.join(others)}); {model.name} was read"]
