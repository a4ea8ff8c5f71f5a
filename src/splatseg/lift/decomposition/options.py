"""Switches of the decomposition."""

from dataclasses import dataclass

from splatseg._check import check_range
from splatseg.core.boundary import convert_fields
from splatseg.errors import RangeError


@dataclass(frozen=True, slots=True, kw_only=True)
class DecomposeOptions:
    """How features are decomposed into instances."""

    sample: int = 8000
    """Gaussians that are clustered at a time, drawn by how much of them the views show. Time
    grows with its square."""

    rounds: int = 3
    """Samples of objects, each of the Gaussians that are like no centre found so far."""

    min_cluster: int = 10
    """Gaussians of a sample that a cluster needs."""

    epsilon: float = 0.3
    """Clusters whose directions, as points, are nearer than this are one; at most 2."""

    similarity: float = 0.5
    """Least similarity in [-1, 1] of a Gaussian with the centre of its cluster."""

    part_sample: int = 500
    """Gaussians of an object among which its parts are looked for; 0 looks for none."""

    min_part: float = 0.05
    """Least share that a part has of its object, by what the views show of it, in [0, 1]."""

    groups: bool = True
    """Look for groups of objects."""

    candidates: int = 4
    """Nodes of which a Gaussian has shares; 0 gives each all of its own node."""

    temperature: float = 0.05
    """Tau: how quickly shares fall with similarity."""

    def __post_init__(self) -> None:
        convert_fields(self)
        for name, least in (
            ("sample", 2), ("rounds", 1), ("min_cluster", 2), ("part_sample", 0),
            ("candidates", 0),
        ):  # fmt: skip
            if getattr(self, name) < least:
                raise RangeError(f"{name}: expected at least {least}, got {getattr(self, name)}.")
        check_range("epsilon", self.epsilon, 0.0, 2.0)
        check_range("similarity", self.similarity, -1.0, 1.0)
        check_range("min_part", self.min_part, 0.0, 1.0)
        if not 0 < self.temperature < float("inf"):
            raise RangeError(f"temperature: expected above 0, got {self.temperature}.")
