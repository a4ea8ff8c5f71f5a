"""Methods: evidence to layers, each named as its paper or the field names it."""

from splatseg.methods._method import ANY_COMPANION as ANY_COMPANION
from splatseg.methods._method import Method as Method
from splatseg.methods._method import MethodInputs as MethodInputs
from splatseg.methods._method import Refined as Refined
from splatseg.methods._registry import ENTRY_POINT_GROUP as ENTRY_POINT_GROUP
from splatseg.methods._registry import find_method as find_method
from splatseg.methods._registry import keeps_boundaries as keeps_boundaries
from splatseg.methods._registry import keeps_ids as keeps_ids
from splatseg.methods._registry import method_names as method_names
from splatseg.methods._registry import methods as methods
from splatseg.methods._registry import register_method as register_method
from splatseg.methods._table import methods_table as methods_table
from splatseg.methods._table import with_table as with_table
