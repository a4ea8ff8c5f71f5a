"""What a person asks for, as functions that take and return values and print nothing.

The command line, the viewer, notebooks and benchmarks call these. Progress and remarks go to an
`Observer`, which can also cancel.
"""

from splatseg.tasks._observer import SILENT as SILENT
from splatseg.tasks._observer import Observer as Observer
from splatseg.tasks.attach import AttachedLayers as AttachedLayers
from splatseg.tasks.attach import AttachLayersOptions as AttachLayersOptions
from splatseg.tasks.attach import attach_layers as attach_layers
from splatseg.tasks.benchmark import BenchOptions as BenchOptions
from splatseg.tasks.benchmark import bench as bench
from splatseg.tasks.checkpoint_options import CheckpointOptions as CheckpointOptions
from splatseg.tasks.demo import Demo as Demo
from splatseg.tasks.demo import DemoOptions as DemoOptions
from splatseg.tasks.demo import make_demo as make_demo
from splatseg.tasks.describe import describe as describe
from splatseg.tasks.edit import EditedScene as EditedScene
from splatseg.tasks.edit import edit_scene as edit_scene
from splatseg.tasks.edit_options import EditOptions as EditOptions
from splatseg.tasks.evaluate import EvaluationOptions as EvaluationOptions
from splatseg.tasks.evaluate import evaluate_scene as evaluate_scene
from splatseg.tasks.examine import Examination as Examination
from splatseg.tasks.examine import examine_capture as examine_capture
from splatseg.tasks.export import Exported as Exported
from splatseg.tasks.export import export_scene as export_scene
from splatseg.tasks.export_options import ExportOptions as ExportOptions
from splatseg.tasks.import_scene import ImportedScene as ImportedScene
from splatseg.tasks.import_scene import ImportOptions as ImportOptions
from splatseg.tasks.import_scene import import_scene as import_scene
from splatseg.tasks.make_scene import MadeScene as MadeScene
from splatseg.tasks.make_scene import MakeSceneOptions as MakeSceneOptions
from splatseg.tasks.make_scene import fit_capture as fit_capture
from splatseg.tasks.outputs import check_layer_exports as check_layer_exports
from splatseg.tasks.outputs import export_layer as export_layer
from splatseg.tasks.outputs import report_layer as report_layer
from splatseg.tasks.query import Answers as Answers
from splatseg.tasks.query import Found as Found
from splatseg.tasks.query import QuerySession as QuerySession
from splatseg.tasks.query import query as query
from splatseg.tasks.query_options import QueryOptions as QueryOptions
from splatseg.tasks.query_outputs import draw_answers as draw_answers
from splatseg.tasks.query_outputs import draw_heat as draw_heat
from splatseg.tasks.query_report import write_query_report as write_query_report
from splatseg.tasks.render import Rendering as Rendering
from splatseg.tasks.render import RenderingOptions as RenderingOptions
from splatseg.tasks.render import render_views as render_views
from splatseg.tasks.render_truth import render_truth as render_truth
from splatseg.tasks.see import SeeOptions as SeeOptions
from splatseg.tasks.see import see as see
from splatseg.tasks.segment import Segmentation as Segmentation
from splatseg.tasks.segment import SegmentOptions as SegmentOptions
from splatseg.tasks.segment import save_segmentation as save_segmentation
from splatseg.tasks.segment import segment as segment
from splatseg.tasks.select import open_selector as open_selector
from splatseg.tasks.select import select as select
from splatseg.tasks.select_options import SelectMode as SelectMode
from splatseg.tasks.select_options import SelectOptions as SelectOptions
from splatseg.tasks.select_outputs import check_selection_file as check_selection_file
from splatseg.tasks.select_outputs import draw_selection as draw_selection
from splatseg.tasks.select_outputs import save_selected_splats as save_selected_splats
from splatseg.tasks.select_session import Selected as Selected
from splatseg.tasks.select_session import SelectionSession as SelectionSession
from splatseg.tasks.sharpen import SharpenedScene as SharpenedScene
from splatseg.tasks.sharpen import SharpenSceneOptions as SharpenSceneOptions
from splatseg.tasks.sharpen import sharpen_scene as sharpen_scene
