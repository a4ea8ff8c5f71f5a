"""Labels of points of the world from what views of a field show at them, and from their shapes."""

from splatseg.lift.points.region import RegionOptions as RegionOptions
from splatseg.lift.points.region import region_labels as region_labels
from splatseg.lift.points.sight import points_in_sight as points_in_sight
from splatseg.lift.points.viewed import ViewedPointOptions as ViewedPointOptions
from splatseg.lift.points.viewed import ViewedPoints as ViewedPoints
