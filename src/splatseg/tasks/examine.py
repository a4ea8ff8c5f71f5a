"""What is wrong with the cameras and points of a capture, and a corrected copy."""

from dataclasses import dataclass
from pathlib import Path

from splatseg.core.boundary import boundary
from splatseg.errors import InputError
from splatseg.io.atomic import is_vacant
from splatseg.pose.doctor import (
    Diagnosis,
    DoctorOptions,
    diagnose,
    read_for_doctor,
    write_corrected,
)
from splatseg.tasks.new_scene import check_parent


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Examination:
    """What was found, and where a corrected capture was written."""

    diagnosis: Diagnosis
    written: Path | None
    """None where nothing was to be corrected, or no correction helps, or none was asked for."""


@boundary
def examine_capture(
    data: Path,
    *,
    fix: Path | None = None,
    options: DoctorOptions | None = None,
    format: str = "auto",
) -> Examination:
    """Find the usual faults of a capture with poses, and write a corrected one.

    Args:
        data: The capture.
        fix: Folder to write the corrected capture to; nothing of `data` is changed.
        options: How many photographs are looked at.
        format: How the capture is read.

    Raises:
        InputError: If the capture cannot be read, or something is in the way of `fix`.
    """
    options = options or DoctorOptions()
    if options.max_views < 2:
        raise InputError(f"max_views: expected at least 2, got {options.max_views}.")
    if fix is not None:
        if fix.exists() and not (fix.is_dir() and is_vacant(fix)):
            raise InputError(f"{fix}: expected a new or empty folder to write to.")
        check_parent(fix)
    read = read_for_doctor(data, format=format)
    diagnosis = diagnose(read.capture, options=options, found=read.faults, declared=read.declared)
    if fix is None or diagnosis.corrected is None:
        return Examination(diagnosis=diagnosis, written=None)
    write_corrected(diagnosis, fix)
    return Examination(diagnosis=diagnosis, written=fix)
