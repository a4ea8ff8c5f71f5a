"""What a person asks for, as functions that take and return values and print nothing.

The command line, the viewer, notebooks and benchmarks call these. Progress and remarks go to an
`Observer`, which can also cancel.
"""

from splatseg.tasks._observer import SILENT as SILENT
from splatseg.tasks._observer import Observer as Observer
from splatseg.tasks.evaluate import EvaluationOptions as EvaluationOptions
from splatseg.tasks.evaluate import evaluate as evaluate
from splatseg.tasks.export import Exported as Exported
from splatseg.tasks.export import ExportOptions as ExportOptions
from splatseg.tasks.export import export as export
from splatseg.tasks.outputs import check_layer_exports as check_layer_exports
from splatseg.tasks.outputs import export_layer as export_layer
from splatseg.tasks.outputs import report_layer as report_layer
from splatseg.tasks.render import Rendering as Rendering
from splatseg.tasks.render import RenderingOptions as RenderingOptions
from splatseg.tasks.render import render_views as render_views
from splatseg.tasks.segment import Segmentation as Segmentation
from splatseg.tasks.segment import SegmentOptions as SegmentOptions
from splatseg.tasks.segment import segment as segment
