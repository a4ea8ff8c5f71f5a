"""Reads COLMAP captures: a sparse model, binary or text, with three files or with five."""

from collections.abc import Iterable
from pathlib import Path

from splatseg.core import Capture
from splatseg.errors import InputError, MissingFileError, brief, quoted
from splatseg.io.captures.build import MIN_THERE, Photographs, build_capture
from splatseg.io.captures.colmap_model import (
    ColmapModel,
    intrinsics_of,
    is_binary_model,
    poses_of,
    read_colmap_model,
    read_images,
)
from splatseg.io.captures.nerfstudio import splits_beside
from splatseg.io.captures.raw_views import RawView
from splatseg.io.foreign import is_folder

_MODEL_PARENTS = ("sparse", "colmap/sparse", "distorted/sparse")
_MODEL_FOLDERS = (
    *(name for parent in _MODEL_PARENTS[:2] for name in (f"{parent}/0", parent)),
    *(".", "0", "distorted/sparse/0", "distorted/sparse"),
)
_IMAGE_FOLDERS = ("images", "input", "rgb", "images_2", "images_4", "images_8", ".")
# What convert.py of 3DGS starts from: `images` beside it is undistorted, its model is not.
_DISTORTED, _DISTORTED_IMAGES = "distorted", ("input", ".")
# A model may be named itself: capture/colmap/sparse/0 lies three folders below its capture.
_LEVELS_UP = 3


def find_colmap(folder: Path) -> Path | None:
    """The folder of a sparse model of a capture, or None."""
    for name in _MODEL_FOLDERS:
        if _is_model(folder / name):
            return folder / name
    for name in _MODEL_PARENTS:
        for model in _models(folder / name):
            return model
    return None


def read_colmap(folder: Path, *, strict: bool = False) -> Capture:
    """Read a capture with a COLMAP model; see `read_capture`.

    The model is sought in ``sparse/0``, ``sparse``, ``colmap/sparse/0``, ``colmap/sparse``, the
    folder itself and ``distorted/sparse/0``, binary before text; of several beside each other the
    one with the most photographs is read, unless one is named. Photographs are sought in
    ``images``, ``input``, ``rgb``, ``images_2``, ``images_4``, ``images_8`` and the folder itself,
    then in the same places of up to three folders above; those of ``distorted`` in ``input``, and
    it is read where nothing else goes with them. Where a ``transforms.json`` beside it has a split
    for the same photographs, that split is the capture's own.

    Raises:
        MissingFileError: If there is no model, or photographs of it are missing.
        InputError: If the model is corrupt or cannot be used.
        MissingPackageError: If a lens needs pycolmap, and that is not installed.
    """
    found = find_colmap(folder)
    if found is None:
        raise MissingFileError(
            f"{folder}: expected a COLMAP model (cameras and images as .bin or .txt) in "
            f"{', '.join(_MODEL_FOLDERS)}, got none."
        )
    model_folder, notes = _largest(found, named=found.resolve() == folder.resolve())
    model = read_colmap_model(model_folder)
    root, images = _image_folder(folder, model_folder, model)
    distorted = root / _DISTORTED
    if images == root / "input" and not _is_distorted(model_folder, root):
        others = [distorted / "sparse" / "0", distorted / "sparse", *_models(distorted / "sparse")]
        if other := next((one for one in others if _is_model(one)), None):
            model_folder, notes = _largest(other, named=False)
            model = read_colmap_model(model_folder)
            root, images = _image_folder(folder, model_folder, model)
    splits = splits_beside(root)
    poses = poses_of(model, where=str(model_folder))
    used = {image.camera_id for image in model.images.values()}
    lenses = {
        id: intrinsics_of(camera, where=f"{model_folder}: camera {id}")
        for id, camera in model.cameras.items()
        if id in used
    }
    raw: list[RawView] = []
    for id, image in model.images.items():
        if image.camera_id not in lenses:
            raise InputError(
                f"{model_folder}: image {quoted(image.name)} names camera "
                f"{quoted(image.camera_id)}, which is not there."
            )
        relative = image.name.replace("\\", "/")
        raw.append(
            RawView(
                image=images / relative,
                relative=relative,
                intrinsics=lenses[image.camera_id],
                cam_from_world=poses[id],
                split=splits.get(images / relative),
            )
        )
    return build_capture(
        root, raw, format="colmap", points=model.points, notes=notes, strict=strict
    )


def _is_model(folder: Path) -> bool:
    return any(
        all((folder / f"{stem}{suffix}").is_file() for stem in ("cameras", "images"))
        for suffix in (".bin", ".txt")
    )


def _models(parent: Path) -> list[Path]:
    """Models in the folders of a folder, sorted by name."""
    return sorted(p for p in parent.iterdir() if _is_model(p)) if is_folder(parent) else []


def _largest(found: Path, *, named: bool) -> tuple[Path, list[str]]:
    """Of a model and those beside it the one with the most photographs, and what to say of it."""
    models = _models(found.parent) if found.parent.name == "sparse" else [found]
    if len(models) < 2:
        return found, []
    counts = {model: _photograph_count(model) for model in models}
    chosen = found if named else max(models, key=lambda model: (counts[model], model == found))
    others = ", ".join(f"{m.name} of {counts[m]}" for m in models if m.name != chosen.name)
    return chosen, [
        f"{found.parent.name} holds {len(models)} models; {chosen.name}, of {counts[chosen]} "
        f"photographs, was read{'' if named else ' as the largest'} ({brief(others)} were not)"
    ]


def _photograph_count(model: Path) -> int:
    """Photographs of a model; 0 where it is damaged, so that it is never the largest."""
    try:
        return len(read_images(model / ("images.bin" if is_binary_model(model) else "images.txt")))
    except InputError:
        return 0


def _is_distorted(model: Path, root: Path) -> bool:
    inside = model.resolve().is_relative_to(root.resolve())
    return inside and model.resolve().relative_to(root.resolve()).parts[:1] == (_DISTORTED,)


def _image_folder(folder: Path, model_folder: Path, model: ColmapModel) -> tuple[Path, Path]:
    """The capture's folder and the one its photographs lie in.

    The first that has enough of them; a complete one comes after, if it is of another size.
    """
    images = [image.name.replace("\\", "/") for image in model.images.values()]
    photographs = Photographs()

    def there(candidate: Path, names: Iterable[str]) -> int:
        return photographs.count(candidate / name for name in names)

    # The folder may be the model itself, or one between it and the capture.
    roots = [folder, *list(folder.resolve().parents)[:_LEVELS_UP]]
    for root in roots:
        best, most = root, 0
        names = _DISTORTED_IMAGES if _is_distorted(model_folder, root) else _IMAGE_FOLDERS
        for candidate in (root / name for name in names):
            count = there(candidate, images)
            if count > most:
                best, most = candidate, count
            if most >= MIN_THERE * len(images) > 0:
                break
        if most:
            return root, best
    # None is there: the complaint about missing photographs names where they belong.
    names = _DISTORTED_IMAGES if _is_distorted(model_folder, folder) else _IMAGE_FOLDERS
    return folder, folder / names[0]
