"""Annotations of other tools as evidence: COCO, CVAT, labelme, Label Studio, class colours."""

from splatseg.io.annotations._base import AREA_KINDS as AREA_KINDS
from splatseg.io.annotations._base import AnnotationEvidence as AnnotationEvidence
from splatseg.io.annotations._base import AreaKind as AreaKind
from splatseg.io.annotations._open import open_annotations as open_annotations
