"""Methods: evidence to layers, each named as its paper or the field names it."""

from splatseg.methods._method import ANY_COMPANION as ANY_COMPANION
from splatseg.methods._method import ENTRY_POINT_GROUP as ENTRY_POINT_GROUP
from splatseg.methods._method import Method as Method
from splatseg.methods._method import MethodInputs as MethodInputs
from splatseg.methods._method import Refined as Refined
from splatseg.methods._method import find_method as find_method
from splatseg.methods._method import keeps_boundaries as keeps_boundaries
from splatseg.methods._method import keeps_ids as keeps_ids
from splatseg.methods._method import method_names as method_names
from splatseg.methods._method import methods as methods
from splatseg.methods._method import register_method as register_method
