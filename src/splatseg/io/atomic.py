"""Writing files and folders so that nothing half-written is ever seen under the target's name.

Everything is written under a temporary name beside the target (same file system, so that the
rename is one step) and renamed only when the block ended well.
"""

import os
import shutil
import tempfile
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

from splatseg.errors import InputError, MissingFileError

TEMPORARY = ".splatseg-"
"""How the names of folders begin that hold what is being written."""


@contextmanager
def atomic_file(path: str | os.PathLike[str]) -> Generator[Path]:
    """Give a temporary path to write a file to; it becomes `path` when the block ends well.

    The temporary name ends with the target's whole name, so writers that look at the suffix
    see the right one. An existing file is replaced in one step. If the block raises, the
    target is untouched and the temporary file is gone.

    Args:
        path: The file to write. Its folder must exist.

    Raises:
        MissingFileError: If the folder of `path` does not exist.
        InputError: If `path` is a folder, or if the block ended without writing the file.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     with atomic_file(Path(folder) / "a.txt") as temporary:
        ...         _ = temporary.write_text("whole")
        ...     print((Path(folder) / "a.txt").read_text())
        whole
    """
    target = _checked_target(path)
    if target.is_dir():
        raise InputError(f"{target}: expected a file to write, got a folder.")
    holder = Path(tempfile.mkdtemp(prefix=TEMPORARY, dir=target.parent))
    try:
        temporary = holder / target.name
        yield temporary
        if not temporary.is_file():
            raise InputError(f"{target}: expected the file to be written, but nothing was.")
        temporary.replace(target)
    finally:
        shutil.rmtree(holder, ignore_errors=True)


@contextmanager
def atomic_folder(path: str | os.PathLike[str]) -> Generator[Path]:
    """Give an empty temporary folder to fill; it becomes `path` when the block ends well.

    An existing folder is replaced as a whole: what the block did not write is gone afterwards.
    Between two renames the target is missing for an instant, but both the old and the new
    folder are complete at every moment, and the old one comes back if the second rename fails.

    Args:
        path: The folder to write. Its parent must exist.

    Raises:
        MissingFileError: If the parent of `path` does not exist.
        InputError: If `path` is a file.
    """
    target = _checked_target(path)
    if target.exists() and not target.is_dir():
        raise InputError(f"{target}: expected a folder to write, got a file.")
    holder = Path(tempfile.mkdtemp(prefix=TEMPORARY, dir=target.parent))
    try:
        temporary = holder / target.name
        temporary.mkdir()
        yield temporary
        _replace_folder(temporary, target, holder / "previous")
    finally:
        shutil.rmtree(holder, ignore_errors=True)


def _replace_folder(new: Path, target: Path, aside: Path) -> None:
    """Rename `new` to `target`; what was there before goes to `aside`."""
    if not target.exists():
        new.replace(target)
        return
    if aside == new:  # the target itself is called "previous"
        aside = aside.with_name("previous.old")
    try:
        target.replace(aside)
        new.replace(target)
    except BaseException:  # Ctrl-C between the two too: what is aside would be gone
        if aside.exists() and not target.exists():
            aside.replace(target)
        raise


def _checked_target(path: str | os.PathLike[str]) -> Path:
    """The path as written, symlinks followed, after a check that its folder is there."""
    target = Path(path)
    if target.is_symlink():  # replace what the link points to, not the link
        target = target.resolve()
    if not target.parent.is_dir():
        raise MissingFileError(
            f"{target}: expected an existing folder to write in, but {target.parent} is missing."
        )
    return target
