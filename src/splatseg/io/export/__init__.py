"""Labelled Gaussians in files that other tools read; see ``docs/exports.md``."""

from splatseg.io.export._boxes import BoxMethod as BoxMethod
from splatseg.io.export._boxes import OrientedBox as OrientedBox
from splatseg.io.export._boxes import oriented_box as oriented_box
from splatseg.io.export._coco import Category as Category
from splatseg.io.export._coco import Frame as Frame
from splatseg.io.export._coco import SegmentInfo as SegmentInfo
from splatseg.io.export._coco import write_coco_panoptic as write_coco_panoptic
from splatseg.io.export._columns import check_beside as check_beside
from splatseg.io.export._columns import column_table_of as column_table_of
from splatseg.io.export._columns import label_columns as label_columns
from splatseg.io.export._columns import write_column_table as write_column_table
from splatseg.io.export._columns import write_labelled_splats as write_labelled_splats
from splatseg.io.export._folders import check_parent as check_parent
from splatseg.io.export._folders import check_replaceable as check_replaceable
from splatseg.io.export._objects import ObjectRow as ObjectRow
from splatseg.io.export._objects import classes_of as classes_of
from splatseg.io.export._objects import objects_of as objects_of
from splatseg.io.export._points import write_points as write_points
from splatseg.io.export._splats import write_object_splats as write_object_splats
from splatseg.io.export._tables import object_content as object_content
from splatseg.io.export._tables import write_object_table as write_object_table
from splatseg.io.export._tree import node_rows as node_rows
from splatseg.io.export._tree import write_node_table as write_node_table
