"""What a scene is asked for words by."""

from dataclasses import dataclass
from typing import Literal

from splatseg._check import check_choice, check_range
from splatseg.core.boundary import convert_fields
from splatseg.errors import RangeError


@dataclass(frozen=True, slots=True, kw_only=True)
class QueryOptions:
    """Who answers, and how sure is sure."""

    from_layer: str | None = None
    """Layer of features in the space of words that answers. None takes one that `segment --method
    objects` made, or makes it of the evidence; else one of voxels or of each Gaussian's own."""

    features: str | None = None
    """Evidence of features in the space of words, such as features_text. None takes the only one
    that there are words for."""

    masks: str | None = None
    """Evidence of masks that objects are found by. None takes the only one."""

    min_probability: float = 0.5
    """Probability, in [0, 1], from which on a thing answers to a word; where none does the word is
    unknown."""

    every: bool = False
    """In a layer of several words each Gaussian takes the likeliest one, however unlikely: a closed
    set of classes."""

    components: int = 32
    """Directions of the scene's features in which words are compared, at most."""

    phrases: Literal["parts", "whole"] = "parts"
    """How "red mug on the desk" is asked of objects. parts: its name, its colour, and what it is on
    or near count beside its cosine. whole: the cosine alone."""

    def __post_init__(self) -> None:
        convert_fields(self)
        check_range("min_probability", self.min_probability, 0.0, 1.0)
        check_choice("phrases", self.phrases, ("parts", "whole"))
        if self.components < 1:
            raise RangeError(f"components: expected at least 1, got {self.components}.")
