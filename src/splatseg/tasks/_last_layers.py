"""Features that were kept before the last layers of their model, which come when words are asked.

The open-vocabulary voxel paper keeps embeddings so (section 3.3) and applies the last layers of the
image encoder to each voxel at query time (section 3.5.1).
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, cast

import torch

from splatseg.core import Features
from splatseg.core.models import LateTextFeatures, TextFeatures
from splatseg.errors import InputError, quoted
from splatseg.io.evidence import TEXT_FILE, FeatureEvidence, evidence_header
from splatseg.methods.voxels.words import LastLayers

_AT_ONCE = 8192
"""Rows that are widened at a time."""

_DIGITS = 12
"""Of a digest in a message."""


def last_layers(evidence: FeatureEvidence, encoder: TextFeatures | None) -> LastLayers | None:
    """What leads from features to the space of words; None where they lie in it.

    Args:
        evidence: The features. Those that ``see --what features`` wrote lie before the last layers.
        encoder: Who encodes words.

    Raises:
        InputError: If there is no model, another one, or one whose last layers cannot come later.
    """
    made = _made(evidence)
    if made.get("what") != "features":
        return None
    name = made.get("model")
    features = f"features {evidence.folder.name!r} of {name} lie before its last layers"
    if encoder is None:
        if (evidence.folder / TEXT_FILE).is_file():
            return None
        raise InputError(
            f"model: {features}; expected that model, which leads from them to words (--model "
            f"{name}=WEIGHTS), got none."
        )
    if encoder.name != name:
        raise InputError(
            f"model: {features}; expected that model, which leads from them to words, got "
            f"{encoder.name}."
        )
    if not isinstance(encoder, LateTextFeatures):
        raise InputError(
            f"model: {features}, which {name} cannot apply later; ask with features in the space "
            "of words (`splatseg see --what text`)."
        )
    there = _weights(cast("Mapping[str, Any]", made.get("settings") or {}))
    now = _weights(encoder.settings)
    if there != now:
        raise InputError(
            f"model: {features}; expected its weights {there}, which made them, got {now}."
        )
    return encoder.in_word_space


def in_word_space(features: Features, layers: LastLayers) -> Features:
    """Features of Gaussians after the last layers; rows of zeros, which know nothing, stay so.

    Args:
        features: From before the last layers.
        layers: The last layers.
    """
    parts = [
        torch.where((rows.abs().amax(dim=1) > 0)[:, None], layers(rows).float(), 0.0)
        for rows in features.values.detach().cpu().float().split(_AT_ONCE)
    ]
    return replace(features, values=torch.cat(parts)) if parts else features


def _made(evidence: FeatureEvidence) -> Mapping[str, Any]:
    """How evidence was made, where it says so."""
    header = evidence_header(evidence.folder)
    made = None if header is None else header.get("metadata")
    return cast("Mapping[str, Any]", made) if isinstance(made, Mapping) else {}


def _weights(settings: Mapping[str, Any]) -> str:
    return quoted(str(settings.get("weights", "unknown"))[:_DIGITS])
