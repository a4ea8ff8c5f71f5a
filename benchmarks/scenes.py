"""Whole commands on captures, scored by the independent scorer; the prototype beside them.

    python benchmarks/scenes.py ../shared/data/office --minutes 2 10 --work /tmp/scenes
    python benchmarks/scenes.py ../shared/data/toys --minutes 10 --prototype
    python benchmarks/scenes.py ../shared/data/frontal --minutes 10 --fit --strategy classic

For each number of minutes: ``splatseg fit`` with that budget, ``splatseg render --split test
--what rgb``, then ``score.py image`` on what was written. The seconds of each command are wall
time of the process. ``--prototype`` fits the same scene for as long with
``shared/prototype/fit`` and prints the PSNR that it reports on the test views. It is compiled for
AVX2, with which it was measured (its AVX-512 form does not compile); its minutes are process CPU
time over two threads. What follows ``--fit`` goes to ``splatseg fit`` as it stands.
"""

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

_SHARED = Path(__file__).resolve().parents[1] / ".." / "shared"
_PROTOTYPE_SETTINGS = {
    "mode": "2",
    "oreg": "0.01",
    "sreg": "0.01",
    "noise": "1.5e5",
    "deg": "2",
    "lrm": "8e-4",
    "lrmend": "8e-6",
    "lrs": "1e-2",
    "lrdec": ".2",
    "r4": ".02",
    "r2": ".07",
}
_PROTOTYPE_CAP = {"toys": 150_000}


def main() -> None:
    """Fit, render and score, one line a budget."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("--minutes", type=float, nargs="+", default=[10.0])
    parser.add_argument("--work", type=Path, help="keep scenes and pictures here")
    parser.add_argument("--prototype", action="store_true")
    parser.add_argument("--fit", nargs=argparse.REMAINDER, default=[])
    arguments = parser.parse_args()
    temporary = None if arguments.work else tempfile.mkdtemp()
    work = arguments.work or Path(temporary or "")
    work.mkdir(parents=True, exist_ok=True)
    try:
        for minutes in arguments.minutes:
            print(_ours(arguments.data, minutes, work, arguments.fit), flush=True)
            if arguments.prototype:
                print(_theirs(arguments.data, minutes, work), flush=True)
    finally:
        if temporary:
            shutil.rmtree(temporary)


def _run(*command: str | Path) -> tuple[float, str]:
    """Seconds and standard output of a command that succeeds."""
    begin = time.monotonic()
    done = subprocess.run([str(part) for part in command], stdout=subprocess.PIPE, text=True)
    if done.returncode:
        sys.exit(f"{' '.join(map(str, command))}: exit status {done.returncode}")
    return time.monotonic() - begin, done.stdout


def _ours(data: Path, minutes: float, work: Path, extra: list[str]) -> str:
    scene, pictures = work / f"{data.name}-{minutes:g}", work / f"{data.name}-{minutes:g}-pictures"
    for folder in (scene, pictures):
        shutil.rmtree(folder, ignore_errors=True)
    splatseg = (sys.executable, "-m", "splatseg.cli")
    length = () if "--steps" in extra else ("--minutes", f"{minutes:g}")
    fitted, said = _run(*splatseg, "fit", data, "-o", scene, *length, *extra)
    drawn, _ = _run(*splatseg, "render", scene, "--split", "test", "--what", "rgb", "-o", pictures)
    _, scores = _run(
        sys.executable,
        _SHARED / "score" / "score.py",
        "image",
        "--pred",
        pictures / "rgb",
        "--truth",
        data / "images",
        "--views",
        "test_*",
    )
    found = json.loads(scores)
    return (
        f"{data.name} {minutes:g} min: PSNR {found['PSNR']:.2f} SSIM {found['SSIM']:.4f}; "
        f"fit {fitted:.0f} s, render {drawn:.0f} s; {said.splitlines()[-2]}"
    )


def _theirs(data: Path, minutes: float, work: Path) -> str:
    source = _SHARED / "prototype" / "fit"
    binary, packed = work / "prototype-fit", work / f"{data.name}.bin"
    _run("g++", "-O3", "-march=x86-64-v3", "-fopenmp", source / "fit.cpp", "-o", binary)
    _run(sys.executable, source / "prep.py", data, packed)
    seconds, said = _run(
        "env",
        "OMP_PROC_BIND=true",
        "OMP_NUM_THREADS=2",
        binary,
        packed,
        f"minutes={minutes:g}",
        f"cap={_PROTOTYPE_CAP.get(data.name, 200_000)}",
        f"evals={minutes:g}",
        *(f"{name}={value}" for name, value in _PROTOTYPE_SETTINGS.items()),
    )
    marks = [line for line in said.splitlines() if line.startswith("EVAL")]
    return f"{data.name} {minutes:g} min, prototype: {seconds:.0f} s; {marks[-1]}"


if __name__ == "__main__":
    main()
