"""Edits as pure functions: Gaussians and their layers change in step, and a history replays."""

from splatseg.edit._edited import Edited as Edited
from splatseg.edit._edited import apply_rows as apply_rows
from splatseg.edit.operations import duplicate as duplicate
from splatseg.edit.operations import extract as extract
from splatseg.edit.operations import merge as merge
from splatseg.edit.operations import recolour as recolour
from splatseg.edit.operations import remove as remove
from splatseg.edit.operations import transform as transform
from splatseg.edit.split import split as split
