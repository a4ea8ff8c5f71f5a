"""Which Gaussians: by layer, place, value or nearness, in words that a file can hold.

`Where` describes a set of Gaussians and `select_where` finds it; editing, the viewer and queries
share them, so that a selection means the same everywhere.
"""

from splatseg.selection.components import components as components
from splatseg.selection.components import leftovers as leftovers
from splatseg.selection.components import pieces as pieces
from splatseg.selection.components import touching as touching
from splatseg.selection.where import Where as Where
from splatseg.selection.where import box_corners as box_corners
from splatseg.selection.where import ids_named as ids_named
from splatseg.selection.where import layer_called as layer_called
from splatseg.selection.where import select_where as select_where
