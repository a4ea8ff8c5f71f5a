"""Bare photographs against supplied poses: the same fit, the same held-out photographs.

    python benchmarks/bare.py ../shared/data/real/llff_fern --steps 2000
    python benchmarks/bare.py ../shared/data/real/replica_office0 --steps 2000 --poses FOLDER

``splatseg fit CAPTURE`` takes the capture's own cameras, ``splatseg fit CAPTURE/images --poses
sfm`` finds them. Both hold out every 8th photograph by name and score it. ``--poses FOLDER`` is
the ``capture`` folder of an earlier scene of the same photographs, whose poses are used again.
"""

import argparse
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path


def main() -> None:
    """Fit twice and print what each command said last."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("--steps", type=int, default=2000)
    parser.add_argument("--max-gaussians", type=int, default=150_000)
    parser.add_argument("--poses", type=Path)
    parser.add_argument("--work", type=Path, help="keep the scenes here")
    arguments = parser.parse_args()
    temporary = None if arguments.work else tempfile.mkdtemp()
    work = arguments.work or Path(temporary or "")
    work.mkdir(parents=True, exist_ok=True)
    length = ("--steps", str(arguments.steps), "--max-gaussians", str(arguments.max_gaussians))
    try:
        given, bare = work / f"{arguments.data.name}-given", work / f"{arguments.data.name}-bare"
        for scene in (given, bare):
            shutil.rmtree(scene, ignore_errors=True)
        if arguments.poses:
            bare.mkdir()
            shutil.copytree(arguments.poses, bare / "capture")
        images = arguments.data / "images"
        _fit("given", arguments.data, "-o", given, *length)
        _fit(
            "bare",
            images if images.is_dir() else arguments.data,
            "-o",
            bare,
            "--poses",
            "sfm",
            *length,
        )
    finally:
        if temporary:
            shutil.rmtree(temporary)


def _fit(name: str, *arguments: str | Path) -> None:
    command = [sys.executable, "-m", "splatseg.cli", "fit", *(str(part) for part in arguments)]
    begin = time.monotonic()
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True)
    if done.returncode:
        sys.exit(f"{' '.join(command)}: exit status {done.returncode}")
    said = [line for line in done.stdout.splitlines() if "placed" in line or "held-out" in line]
    print(f"{name}: {time.monotonic() - begin:.0f} s; {'; '.join(said)}", flush=True)


if __name__ == "__main__":
    main()
