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
    from splatseg import prompting as prompting
    from splatseg import raycast as raycast
    from splatseg import render as render
    from splatseg import report as report
    from splatseg import selection as selection
    from splatseg import street as street
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
    from splatseg.fit import FitOptions as FitOptions
    from splatseg.io.captures import read_capture as read_capture
    from splatseg.io.evidence import create_evidence as create_evidence
    from splatseg.io.evidence import open_evidence as open_evidence
    from splatseg.io.evidence import save_label_map as save_label_map
    from splatseg.io.evidence import save_masks as save_masks
    from splatseg.io.layers import load_layer as load_layer
    from splatseg.io.layers import save_layer as save_layer
    from splatseg.io.scene import load_scene as load_scene
    from splatseg.io.scene import load_scene_layer as load_scene_layer
    from splatseg.io.scene import save_scene as save_scene
    from splatseg.io.scene import save_scene_layer as save_scene_layer
    from splatseg.io.splats import read_splats as read_splats
    from splatseg.io.splats import write_splats as write_splats
    from splatseg.lift import label_map as label_map
    from splatseg.lift import uplift as uplift
    from splatseg.methods import Method as Method
    from splatseg.methods import MethodInputs as MethodInputs
    from splatseg.methods import find_method as find_method
    from splatseg.methods import register_method as register_method
    from splatseg.render import RenderOptions as RenderOptions
    from splatseg.render import back_project as back_project
    from splatseg.render import contributors as contributors
    from splatseg.render import get_backend as get_backend
    from splatseg.render import weights as weights
    from splatseg.synthetic import write_capture as write_capture
    from splatseg.tasks import AttachLayersOptions as AttachLayersOptions
    from splatseg.tasks import BenchOptions as BenchOptions
    from splatseg.tasks import CheckpointOptions as CheckpointOptions
    from splatseg.tasks import DemoOptions as DemoOptions
    from splatseg.tasks import EditOptions as EditOptions
    from splatseg.tasks import EvaluationOptions as EvaluationOptions
    from splatseg.tasks import ExportOptions as ExportOptions
    from splatseg.tasks import ImportOptions as ImportOptions
    from splatseg.tasks import MakeSceneOptions as MakeSceneOptions
    from splatseg.tasks import QueryOptions as QueryOptions
    from splatseg.tasks import RenderingOptions as RenderingOptions
    from splatseg.tasks import ScanLabelOptions as ScanLabelOptions
    from splatseg.tasks import SeeOptions as SeeOptions
    from splatseg.tasks import SegmentOptions as SegmentOptions
    from splatseg.tasks import SelectOptions as SelectOptions
    from splatseg.tasks import SharpenSceneOptions as SharpenSceneOptions
    from splatseg.tasks import StreetOptions as StreetOptions
    from splatseg.tasks import attach_layers as attach_layers
    from splatseg.tasks import bench as bench
    from splatseg.tasks import describe as describe
    from splatseg.tasks import edit_scene as edit_scene
    from splatseg.tasks import evaluate_scene as evaluate_scene
    from splatseg.tasks import examine_capture as examine_capture
    from splatseg.tasks import export_scene as export_scene
    from splatseg.tasks import fit_capture as fit_capture
    from splatseg.tasks import import_scene as import_scene
    from splatseg.tasks import label_scans as label_scans
    from splatseg.tasks import make_demo as make_demo
    from splatseg.tasks import make_street_field as make_street_field
    from splatseg.tasks import open_drive as open_drive
    from splatseg.tasks import open_selector as open_selector
    from splatseg.tasks import query as query
    from splatseg.tasks import render_truth as render_truth
    from splatseg.tasks import render_views as render_views
    from splatseg.tasks import save_segmentation as save_segmentation
    from splatseg.tasks import save_street_field as save_street_field
    from splatseg.tasks import see as see
    from splatseg.tasks import segment as segment
    from splatseg.tasks import select as select
    from splatseg.tasks import sharpen_scene as sharpen_scene
    from splatseg.tasks import street_field as street_field

# What the block above says to type checkers, for the interpreter; a test holds the two equal.
_HOMES = {
    "splatseg.core": (
        "Camera Capture FeatureMap Features Gaussians LabelMap Labels MaskSet Scene "
        "Selection Similarity View"
    ),
    "splatseg.fit": "FitOptions",
    "splatseg.io.captures": "read_capture",
    "splatseg.io.evidence": "create_evidence open_evidence save_label_map save_masks",
    "splatseg.io.layers": "load_layer save_layer",
    "splatseg.io.scene": "load_scene load_scene_layer save_scene save_scene_layer",
    "splatseg.io.splats": "read_splats write_splats",
    "splatseg.lift": "label_map uplift",
    "splatseg.methods": "Method MethodInputs find_method register_method",
    "splatseg.render": "RenderOptions back_project contributors get_backend weights",
    "splatseg.synthetic": "write_capture",
    "splatseg.tasks": (
        "AttachLayersOptions BenchOptions CheckpointOptions DemoOptions EditOptions "
        "EvaluationOptions ExportOptions ImportOptions MakeSceneOptions QueryOptions "
        "RenderingOptions ScanLabelOptions SeeOptions SegmentOptions SelectOptions "
        "SharpenSceneOptions StreetOptions "
        "attach_layers bench describe edit_scene "
        "evaluate_scene examine_capture export_scene fit_capture import_scene "
        "label_scans make_demo make_street_field open_drive open_selector query render_truth "
        "render_views save_segmentation save_street_field see segment select sharpen_scene "
        "street_field"
    ),
}
_PACKAGES = frozenset(
    {
        "core",
        "edit",
        "evaluate",
        "selection",
        "fit",
        "importing",
        "io",
        "lift",
        "methods",
        "models",
        "neighbours",
        "pose",
        "prompting",
        "raycast",
        "render",
        "report",
        "street",
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
