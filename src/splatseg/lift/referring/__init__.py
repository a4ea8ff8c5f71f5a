"""Referring expressions: "the mug left of the laptop" among the objects of a scene."""

from splatseg.lift.referring.geometry import ObjectGeometry as ObjectGeometry
from splatseg.lift.referring.geometry import Viewer as Viewer
from splatseg.lift.referring.geometry import object_geometry as object_geometry
from splatseg.lift.referring.geometry import viewer_of as viewer_of
from splatseg.lift.referring.grammar import NounPhrase as NounPhrase
from splatseg.lift.referring.grammar import parse_referring as parse_referring
from splatseg.lift.referring.names import ObjectNames as ObjectNames
from splatseg.lift.referring.names import name_list as name_list
from splatseg.lift.referring.names import referring_readings as referring_readings
from splatseg.lift.referring.resolve import NameMatch as NameMatch
from splatseg.lift.referring.resolve import Reference as Reference
from splatseg.lift.referring.resolve import Referent as Referent
from splatseg.lift.referring.resolve import Resolver as Resolver
