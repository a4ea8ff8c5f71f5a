"""A generated room with exact truth: look at it, then write it as a capture.

Everything that the five commands need is in the folder that this writes:

    splatseg fit room-capture -o room-scene --preset quick
"""

from pathlib import Path

import torch

from splatseg.synthetic import cameras, render_truth, room, write_capture

scene = room(seed=3)
print(f"{len(scene.objects)} objects of {len(scene.classes.rows)} classes")

# What one camera sees: colour over four rays a pixel, ids and depth exact through pixel centres.
views = cameras(scene, train=8, test=2, width=96, height=72)
truth = render_truth(scene, views[0].camera)
ids, counts = torch.unique(truth.semantic, return_counts=True)
for id, count in sorted(zip(ids.tolist(), counts.tolist(), strict=True), key=lambda row: -row[1]):
    print(f"{scene.classes.name_of(id):>8} {100 * count / truth.semantic.numel():5.1f} %")
print(f"depth {truth.depth.min():.2f} to {truth.depth.max():.2f} m")

# The same room as a capture on disk, with label maps that a network could have made.
write_capture(scene, Path("room-capture"), views=views, points=1000)
print(*sorted(path.name for path in Path("room-capture").iterdir()))
