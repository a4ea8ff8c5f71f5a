"""Photographs with cameras and start points become Gaussians.

`fit` runs the optimisation with `FitOptions`. `refine` optimises existing Gaussians further, from
photographs and from any other differentiable loss.
"""

from splatseg.core.checkpoints import Checkpoints as Checkpoints
from splatseg.fit._adding import added_gaussians as added_gaussians
from splatseg.fit._block_fits import fit_blocks as fit_blocks
from splatseg.fit._checkpoint import CheckpointSummary as CheckpointSummary
from splatseg.fit._checkpoint import checkpoint_gaussians as checkpoint_gaussians
from splatseg.fit._checkpoint import checkpoint_summary as checkpoint_summary
from splatseg.fit._objects import ObjectSupervision as ObjectSupervision
from splatseg.fit._options import FitOptions as FitOptions
from splatseg.fit._options import Preset as Preset
from splatseg.fit._options import Strategy as Strategy
from splatseg.fit._options import sensible_steps as sensible_steps
from splatseg.fit._photographs import reduction_note as reduction_note
from splatseg.fit._refine import EXPOSURES as EXPOSURES
from splatseg.fit._refine import Refinement as Refinement
from splatseg.fit._refine import exposures_record as exposures_record
from splatseg.fit._refine import recorded_exposures as recorded_exposures
from splatseg.fit._refine import refine as refine
from splatseg.fit._refine import refinement_options as refinement_options
from splatseg.fit._run import FitProgress as FitProgress
from splatseg.fit._run import FitRecord as FitRecord
from splatseg.fit._run import FitResult as FitResult
from splatseg.fit._run import fit as fit
from splatseg.fit._start import random_point_count as random_point_count
from splatseg.fit._step import ExtraLoss as ExtraLoss
from splatseg.fit._views import Exposure as Exposure
from splatseg.fit.blocks import BlockCount as BlockCount
from splatseg.fit.blocks import CaptureBlock as CaptureBlock
from splatseg.fit.blocks import CaptureBlocks as CaptureBlocks
from splatseg.fit.blocks import Cells as Cells
from splatseg.fit.blocks import cut_capture as cut_capture
from splatseg.fit.depth import SCAN_SPACING as SCAN_SPACING
from splatseg.fit.depth import DepthPoints as DepthPoints
from splatseg.fit.depth import aligned_inverse as aligned_inverse
from splatseg.fit.depth import scan_depths as scan_depths
from splatseg.io.checkpoint_files import CheckpointVersionError as CheckpointVersionError
