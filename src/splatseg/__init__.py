"""splatseg segments 3D Gaussian scenes.

With the geometry frozen, a view is a sparse linear map W from Gaussians to pixels. Rendering is
``W @ signal``, lifting what a 2D model sees into 3D is ``W.T @ image``, and everything else here
is built on those two.

The names below are the public surface. They load at first use, so that ``import splatseg`` costs
no torch; the packages do too. Every task has a verb that is no package's name: `fit_capture`,
`import_scene`, `see`, `segment`, `render_views`, `evaluate_scene`, `edit_scene`, `export_scene`. A
single image is ``splatseg.render.render``, and photographs become Gaussians without a folder by
``splatseg.fit.fit``; a name that is now a package and now a function, depending on what was
imported first, would be a trap.

Conventions (frames, pixel centres, units, ids): docs/conventions.md.
"""

import os
import sys

import lazy_loader

if "torch" not in sys.modules:
    # Idle threads of OpenMP would spin on the cores that the kernels need. It is read when torch
    # loads; who sets it otherwise keeps that.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

_MOVED = ("bench", "BenchOptions")

_load, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> object:
    if name in _MOVED:
        raise AttributeError(
            f"splatseg.{name} is now splatseg_bench.{name}; install splatseg-bench for it."
        )
    return _load(name)
