"""Classes of objects from the votes of all their pixels and from what alike objects are voted."""

from splatseg.lift.object_classes.categories import with_categories as with_categories
from splatseg.lift.object_classes.classify import ObjectClassOptions as ObjectClassOptions
from splatseg.lift.object_classes.classify import classify_objects as classify_objects
from splatseg.lift.object_classes.heterogeneity import heterogeneity as heterogeneity
from splatseg.lift.object_classes.pooling import PooledObjects as PooledObjects
from splatseg.lift.object_classes.pooling import pool_objects as pool_objects
