"""What a checkpoint costs: time to write and read one, and its size.

    python benchmarks/checkpoint.py FOLDER --gaussians 1000000

FOLDER is where a scene would be; the file is removed again. The state is that of a fit with
harmonics of degree 3: parameters and two moments, 59 numbers each.
"""

import argparse
import resource
import time
from pathlib import Path

import torch

from splatseg.fit._checkpoint import FitState, read_checkpoint, write_checkpoint
from splatseg.io.arrays import discard_checkpoint_file

_WIDTHS = {"means": 3, "log_scales": 3, "rotations": 4, "logits": 1, "sh": 48}


def main() -> None:
    """Write three times, read once."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--gaussians", type=int, default=1_000_000)
    arguments = parser.parse_args()
    tensors = {
        f"{group}/{name}": torch.rand(arguments.gaussians, width)
        for group in ("parameters", "first", "second")
        for name, width in _WIDTHS.items()
    }
    checkpoint = FitState(tensors=tensors, content={})
    path = arguments.folder / "checkpoint.npz"
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for _ in range(3):
        wall, cpu = time.monotonic(), time.process_time()
        write_checkpoint(checkpoint, path)
        wall, cpu = time.monotonic() - wall, time.process_time() - cpu
        megabytes = path.stat().st_size / 1e6
        print(f"write: {megabytes:.0f} MB in {wall:.2f} s, {cpu:.2f} s of them CPU", flush=True)
    more = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1e3
    print(f"memory beyond the state itself: {more:.0f} MB")
    wall = time.monotonic()
    read_checkpoint(path)
    print(f"read: {time.monotonic() - wall:.2f} s")
    discard_checkpoint_file(path)


if __name__ == "__main__":
    main()
