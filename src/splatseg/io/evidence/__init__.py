"""Recorded evidence: what 2D models saw, one file a view, read one view at a time.

A folder of evidence holds one of

- labels: a PNG of ids a view;
- panoptic: the same with segments.json, whose ids mean something in one view only;
- tracked: the same with tracks.json, whose ids go through all views;
- masks: a JSON of COCO run-length masks a view, an npz, or a folder of pictures;
- features: an npz a view;
- depth: an npz a view.

In files 0 is void; in memory it is -1. See ``docs/formats.md`` for every byte.
"""

from splatseg.io.evidence._base import RENDERS_FOLDER as RENDERS_FOLDER
from splatseg.io.evidence._base import Evidence as Evidence
from splatseg.io.evidence._base import EvidenceKind as EvidenceKind
from splatseg.io.evidence._base import view_files as view_files
from splatseg.io.evidence._features import TEXT_FILE as TEXT_FILE
from splatseg.io.evidence._features import DepthEvidence as DepthEvidence
from splatseg.io.evidence._features import FeatureEvidence as FeatureEvidence
from splatseg.io.evidence._features import TextEmbeddings as TextEmbeddings
from splatseg.io.evidence._features import load_text_embeddings as load_text_embeddings
from splatseg.io.evidence._labels import LabelEvidence as LabelEvidence
from splatseg.io.evidence._labels import read_id_map as read_id_map
from splatseg.io.evidence._masks import MaskEvidence as MaskEvidence
from splatseg.io.evidence._open import evidence_header as evidence_header
from splatseg.io.evidence._open import evidence_names as evidence_names
from splatseg.io.evidence._open import find_evidence as find_evidence
from splatseg.io.evidence._open import open_evidence as open_evidence
from splatseg.io.evidence._segments import SEGMENTS_FILE as SEGMENTS_FILE
from splatseg.io.evidence._segments import PanopticEvidence as PanopticEvidence
from splatseg.io.evidence._segments import TrackedEvidence as TrackedEvidence
from splatseg.io.evidence._segments import check_map_sizes as check_map_sizes
from splatseg.io.evidence._segments import without_masked as without_masked
from splatseg.io.evidence._write import create_evidence as create_evidence
from splatseg.io.evidence._write import save_depth_map as save_depth_map
from splatseg.io.evidence._write import save_features as save_features
from splatseg.io.evidence._write import save_label_map as save_label_map
from splatseg.io.evidence._write import save_masks as save_masks
from splatseg.io.evidence._write import save_render as save_render
from splatseg.io.evidence._write import save_segments as save_segments
from splatseg.io.evidence._write import save_text_embeddings as save_text_embeddings
from splatseg.io.evidence._write import save_tracks as save_tracks
