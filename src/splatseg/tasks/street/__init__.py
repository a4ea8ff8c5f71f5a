"""Mesh fields of drives: made whole or block by block, written into scenes, and their page."""

from splatseg.tasks.street.drive import StreetDrive as StreetDrive
from splatseg.tasks.street.field import StreetField as StreetField
from splatseg.tasks.street.field import open_drive as open_drive
from splatseg.tasks.street.field import save_street_field as save_street_field
from splatseg.tasks.street.field import street_field as street_field
from splatseg.tasks.street.make import made_street_field as made_street_field
from splatseg.tasks.street.make import make_street_field as make_street_field
from splatseg.tasks.street.options import StreetOptions as StreetOptions
from splatseg.tasks.street.report import LabelledScans as LabelledScans
from splatseg.tasks.street.report import report_street as report_street
