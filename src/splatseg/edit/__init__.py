"""Edits as pure functions: Gaussians and their layers change in step, and a history replays."""

from splatseg.edit.document import CutBy as CutBy
from splatseg.edit.document import Document as Document
from splatseg.edit.document import FillBy as FillBy
from splatseg.edit.document import Operation as Operation
from splatseg.edit.document import Recolour as Recolour
from splatseg.edit.document import load_document as load_document
from splatseg.edit.document import save_document as save_document
from splatseg.edit.history import apply as apply
from splatseg.edit.history import replay as replay
from splatseg.edit.history import undo as undo
from splatseg.edit.holes import Filled as Filled
from splatseg.edit.holes import exposed as exposed
from splatseg.edit.holes import fill as fill
from splatseg.edit.holes import filled_layer as filled_layer
from splatseg.edit.inpainting import find_inpainter as find_inpainter
from splatseg.edit.operations import duplicate as duplicate
from splatseg.edit.operations import extract as extract
from splatseg.edit.operations import merge as merge
from splatseg.edit.operations import merged_layers as merged_layers
from splatseg.edit.operations import recolour as recolour
from splatseg.edit.operations import remove as remove
from splatseg.edit.operations import transform as transform
from splatseg.edit.prepare import Prepared as Prepared
from splatseg.edit.prepare import prepare as prepare
from splatseg.edit.refit import refit as refit
