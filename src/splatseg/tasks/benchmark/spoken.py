"""Words for the features of a scene: who encodes them, and what they are relevant to."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg.core import Scene
from splatseg.core.models import TextFeatures
from splatseg.errors import InputError
from splatseg.io.evidence import FeatureEvidence, load_text_embeddings, open_evidence
from splatseg.lift import TextSpace
from splatseg.tasks.benchmark.sight import Seen


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Vocabulary:
    """Vectors of words in the space of a scene's features."""

    space: TextSpace
    encode: Callable[[Sequence[str]], Float[Tensor, "n width"]]
    known: Callable[[str], bool]
    """Whether a word can be encoded."""


def vocabulary_of(scene: Scene, seen: Seen) -> Vocabulary:
    """The words of a model, or those that were recorded with its features.

    Raises:
        InputError: If the evidence is of no words.
    """
    if scene.root is None:
        raise InputError("scene: expected one that was read from its folder, got one without.")
    folder = scene.root / "evidence" / seen.name
    evidence = open_evidence(folder)
    if not isinstance(evidence, FeatureEvidence):
        raise InputError(f"{folder}: expected features, got {evidence.kind}.")
    basis = None if evidence.basis is None else torch.from_numpy(evidence.basis)
    mean = None if evidence.mean is None else torch.from_numpy(evidence.mean)
    model = seen.made
    if isinstance(model, TextFeatures):
        width = int(model.encode_text(["object"]).shape[1])
        space = TextSpace(width=width, basis=basis, mean=mean)
        return Vocabulary(space=space, encode=model.encode_text, known=lambda word: True)
    recorded = load_text_embeddings(folder)
    space = TextSpace(width=int(recorded.vectors.shape[1]), basis=basis, mean=mean)
    return Vocabulary(
        space=space,
        encode=lambda words: torch.stack([recorded.vector(word) for word in words]),
        known=lambda word: word in recorded.labels,
    )
