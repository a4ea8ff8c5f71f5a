"""How good a result is: pure measures, and scenes held against truth on chosen views."""

from splatseg.evaluate.agreement import contested as contested
from splatseg.evaluate.agreement import views_that_show as views_that_show
from splatseg.evaluate.boundary import BoundaryCounts as BoundaryCounts
from splatseg.evaluate.boundary import BoundaryScore as BoundaryScore
from splatseg.evaluate.boundary import boundary_overlap as boundary_overlap
from splatseg.evaluate.boundary import boundary_score as boundary_score
from splatseg.evaluate.held_out import BinaryReport as BinaryReport
from splatseg.evaluate.held_out import PhotographReport as PhotographReport
from splatseg.evaluate.held_out import SemanticReport as SemanticReport
from splatseg.evaluate.held_out import ViewScore as ViewScore
from splatseg.evaluate.held_out import evaluate_binary as evaluate_binary
from splatseg.evaluate.held_out import evaluate_photographs as evaluate_photographs
from splatseg.evaluate.held_out import evaluate_semantic as evaluate_semantic
from splatseg.evaluate.held_out import picture_and_photograph as picture_and_photograph
from splatseg.evaluate.held_out_segments import InstanceReport as InstanceReport
from splatseg.evaluate.held_out_segments import PanopticReport as PanopticReport
from splatseg.evaluate.held_out_segments import PointReport as PointReport
from splatseg.evaluate.held_out_segments import evaluate_instances as evaluate_instances
from splatseg.evaluate.held_out_segments import evaluate_panoptic as evaluate_panoptic
from splatseg.evaluate.held_out_segments import evaluate_points as evaluate_points
from splatseg.evaluate.metrics import BinaryScore as BinaryScore
from splatseg.evaluate.metrics import Confusion as Confusion
from splatseg.evaluate.metrics import SemanticScore as SemanticScore
from splatseg.evaluate.metrics import binary_score as binary_score
from splatseg.evaluate.metrics import per_image_miou as per_image_miou
from splatseg.evaluate.metrics import psnr as psnr
from splatseg.evaluate.metrics import semantic_score as semantic_score
from splatseg.evaluate.metrics import ssim as ssim
from splatseg.evaluate.overlaps import InstanceScore as InstanceScore
from splatseg.evaluate.overlaps import Overlaps as Overlaps
from splatseg.evaluate.overlaps import instance_score as instance_score
from splatseg.evaluate.panoptic import Detections as Detections
from splatseg.evaluate.panoptic import PanopticScore as PanopticScore
from splatseg.evaluate.panoptic import PrecisionScore as PrecisionScore
from splatseg.evaluate.panoptic import average_precision as average_precision
from splatseg.evaluate.panoptic import panoptic_score as panoptic_score
from splatseg.evaluate.panoptic import segment_keys as segment_keys
from splatseg.evaluate.segment_report import (
    write_segmentation_report as write_segmentation_report,
)
from splatseg.evaluate.solid import gaussian_score as gaussian_score
from splatseg.evaluate.solid import gaussian_weights as gaussian_weights
from splatseg.evaluate.solid import labels_from_points as labels_from_points
from splatseg.evaluate.solid import labels_of_points as labels_of_points
