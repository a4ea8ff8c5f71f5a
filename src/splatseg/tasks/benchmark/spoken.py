"""Words for the features of a scene under test: who encodes them, and what answers."""

from functools import cached_property

from splatseg.core import Features, Scene, Selection, VoxelFeatures
from splatseg.core.models import TextFeatures
from splatseg.errors import InputError
from splatseg.io.evidence import FeatureEvidence, open_evidence
from splatseg.lift.vocabulary import Vocabulary, vocabulary_of
from splatseg.lift.words import WordIndex
from splatseg.methods.voxels.words import VoxelWords
from splatseg.tasks.benchmark.job import Job
from splatseg.tasks.benchmark.sight import Seen

_SURE = 0.5


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


def word_index(layer: Features | VoxelFeatures, vocabulary: Vocabulary) -> WordIndex | VoxelWords:
    """Who answers words in the span of a layer's features, as `query` answers."""
    if isinstance(layer, VoxelFeatures):
        return VoxelWords(layer, vocabulary)
    return WordIndex(layer, vocabulary)


class SpokenLayer:
    """A method's features and the words for them, made when they are first asked for.

    Args:
        job: The method and the scene.
    """

    def __init__(self, job: Job) -> None:
        self._job = job

    @cached_property
    def layer(self) -> Features | VoxelFeatures:
        """The features.

        Raises:
            InputError: If the method gives others than features.
        """
        layer = self._job.whole_layer(self._seen.name)
        if not isinstance(layer, Features | VoxelFeatures):
            raise InputError(
                f"method {self._job.method.name}: expected one that gives features, as words are "
                f"asked for by features, got {self._job.method.returns}."
            )
        return layer

    @cached_property
    def vocabulary(self) -> Vocabulary:
        """The words."""
        return words_of(self._job.scene, self._seen)

    def selection(self, words: str) -> Selection:
        """What likelier is the thing than anything else, as `query` answers.

        Args:
            words: What is asked for.
        """
        index = self._index
        sure = index.of_gaussians(index.ask([words]).probabilities)[:, 0].clamp(0, 1)
        return Selection(mask=sure >= _SURE, confidence=sure)

    @cached_property
    def _seen(self) -> Seen:
        return self._job.seen(words=True)

    @cached_property
    def _index(self) -> WordIndex | VoxelWords:
        return word_index(self.layer, self.vocabulary)


def asks_for_all(words: str) -> bool:
    """Whether words ask for everything that they mean, such as "all of the flowers"."""
    return words.lower().split()[:1] == ["all"]
