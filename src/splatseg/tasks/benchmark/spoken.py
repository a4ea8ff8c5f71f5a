"""Words for the features of a scene under test: who encodes them."""

from splatseg.core import Scene
from splatseg.core.models import TextFeatures
from splatseg.errors import InputError
from splatseg.io.evidence import FeatureEvidence, open_evidence
from splatseg.lift.vocabulary import Vocabulary, vocabulary_of
from splatseg.tasks.benchmark.sight import Seen


def words_of(scene: Scene, seen: Seen) -> Vocabulary:
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
    return vocabulary_of(evidence, seen.made if isinstance(seen.made, TextFeatures) else None)
