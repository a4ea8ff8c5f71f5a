"""splatseg segments 3D Gaussian scenes.

With the geometry frozen, a view is a sparse linear map W from Gaussians to pixels. Rendering is
``W @ signal``, lifting what a 2D model sees into 3D is ``W.T @ image``, and everything else here
is built on those two.

The names below are the public surface. They load at first use, so that ``import splatseg`` costs
no torch; the packages do too. `render` and `fit` share their names with the packages that hold
them and are reached there, as ``splatseg.render.render`` and ``splatseg.fit.fit``; a name that is
now a package and now a function, depending on what was imported first, would be a trap.

Conventions (frames, pixel centres, units, ids): docs/conventions.md.
"""

import importlib
from typing import TYPE_CHECKING, Any

from splatseg.errors import InputError as InputError
from splatseg.errors import SplatsegError as SplatsegError

if TYPE_CHECKING:
    from splatseg import core as core
    from splatseg import edit as edit
    from splatseg import evaluate as evaluate
    from splatseg import fit as fit
    from splatseg import importing as importing
    from splatseg import io as io
    from splatseg import lift as lift
    from splatseg import methods as methods
    from splatseg import models as models
    from splatseg import neighbours as neighbours
    from splatseg import pose as pose
    from splatseg import render as render
    from splatseg import report as report
    from splatseg import synthetic as synthetic
    from splatseg import tasks as tasks
    from splatseg.core import Camera as Camera
    from splatseg.core import Capture as Capture
    from splatseg.core import FeatureMap as FeatureMap
    from splatseg.core import Features as Features
    from splatseg.core import Gaussians as Gaussians
    from splatseg.core import LabelMap as LabelMap
    from splatseg.core import Labels as Labels
    from splatseg.core import MaskSet as MaskSet
    from splatseg.core import Scene as Scene
    from splatseg.core import Selection as Selection
    from splatseg.core import Similarity as Similarity
    from splatseg.core import View as View
    from splatseg.io.captures import read_capture as read_capture
    from splatseg.io.evidence import open_evidence as open_evidence
    from splatseg.io.layers import load_layer as load_layer
    from splatseg.io.layers import save_layer as save_layer
    from splatseg.io.scene import load_scene as load_scene
    from splatseg.io.scene import save_scene as save_scene
    from splatseg.io.splats import read_splats as read_splats
    from splatseg.io.splats import write_splats as write_splats
    from splatseg.lift import uplift as uplift
    from splatseg.render import RenderOptions as RenderOptions
    from splatseg.render import back_project as back_project
    from splatseg.render import contributors as contributors
    from splatseg.render import get_backend as get_backend
    from splatseg.render import weights as weights
    from splatseg.tasks import segment as segment

# What the block above says to type checkers, for the interpreter; a test holds the two equal.
_HOMES = {
    "splatseg.core": (
        "Camera Capture FeatureMap Features Gaussians LabelMap Labels MaskSet Scene Selection "
        "Similarity View"
    ),
    "splatseg.io.captures": "read_capture",
    "splatseg.io.evidence": "open_evidence",
    "splatseg.io.layers": "load_layer save_layer",
    "splatseg.io.scene": "load_scene save_scene",
    "splatseg.io.splats": "read_splats write_splats",
    "splatseg.lift": "uplift",
    "splatseg.render": "RenderOptions back_project contributors get_backend weights",
    "splatseg.tasks": "segment",
}
_PACKAGES = frozenset(
    {
        "core",
        "edit",
        "evaluate",
        "fit",
        "importing",
        "io",
        "lift",
        "methods",
        "models",
        "neighbours",
        "pose",
        "render",
        "report",
        "synthetic",
        "tasks",
    }
)
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names.split()}


def __getattr__(name: str) -> Any:
    """Load a public name or a package at its first use."""
    if name in _PACKAGES:
        return importlib.import_module(f"splatseg.{name}")
    if name not in _HOME_OF:
        raise AttributeError(f"module 'splatseg' has no attribute {name!r}")
    value = getattr(importlib.import_module(_HOME_OF[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """The public names, loaded or not."""
    return sorted({"InputError", "SplatsegError", *_HOME_OF, *_PACKAGES})
