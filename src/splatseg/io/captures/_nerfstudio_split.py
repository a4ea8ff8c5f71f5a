"""The split that a transforms.json gives: per frame, or as lists of file names."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from splatseg.io.json_files import read_json

_LISTS = ("train", "val", "test")


def frame_splits(
    content: Mapping[str, Any], frames: Sequence[Mapping[str, Any]]
) -> list[str | None]:
    """The split of each frame; None everywhere where the file gives none.

    A frame's own ``split`` comes before the lists ``train_filenames``, ``val_filenames`` and
    ``test_filenames``. A frame that no list names belongs to none of them (``unused``). A file
    in both val and test is a test view, and where there is no test split val stands for it.
    """
    listed: dict[str, str] = {}
    for split in _LISTS:
        names = content.get(f"{split}_filenames")
        if isinstance(names, list):
            listed |= {str(name): split for name in names}  # pyright: ignore[reportUnknownVariableType, reportUnknownArgumentType]
    splits: list[str | None] = []
    for frame in frames:
        own = frame.get("split")
        if own is not None:
            splits.append(str(own))
        elif listed:
            splits.append(listed.get(str(frame.get("file_path")), "unused"))
        else:
            splits.append(None)
    if "test" not in splits:
        splits = ["test" if split == "val" else split for split in splits]
    return splits


def splits_beside(folder: Path) -> dict[Path, str]:
    """Splits by photograph, from the transforms.json of a capture; empty where it has none."""
    path = folder / "transforms.json"
    if not path.is_file():
        return {}
    content = read_json(path)
    listed = content.get("frames")
    frames = [f for f in listed if isinstance(f, dict)] if isinstance(listed, list) else []  # pyright: ignore[reportUnknownVariableType]
    splits = frame_splits(content, frames)
    return {
        folder / str(frame.get("file_path")): split
        for frame, split in zip(frames, splits, strict=True)
        if split is not None
    }
