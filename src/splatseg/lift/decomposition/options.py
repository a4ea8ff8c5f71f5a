"""Switches of the decomposition."""

from dataclasses import dataclass

from splatseg._check import check_range
from splatseg.core.boundary import convert_fields
from splatseg.errors import RangeError


@dataclass(frozen=True, slots=True, kw_only=True)
class DecomposeOptions:
    """How features are decomposed into instances."""

    sample: int = 20000
    """Gaussians that are clustered, drawn by how much of them the views show."""

    part_sample: int = 500
    """Gaussians of an object among which its parts are looked for; 0 looks for none."""

    neighbours: int = 12
    """Other samples nearest in space that a sample may be joined with."""

    group_increase: float = 0.005
    """How much joining two clusters may raise the mean squared distance of directions from the
    mean of their cluster, at the scale of groups; 0 looks for none."""

    object_increase: float = 0.00005
    """The same at the scale of objects; above 0. Smaller ones are told apart the smaller it is."""

    part_increase: float = 0.02
    """The same at the scale of parts, of the Gaussians of one object."""

    voters: int = 8
    """Samples nearest in space that vote for the object of a Gaussian."""

    temperature: float = 0.1
    """How quickly votes fall with the similarity of directions."""

    candidates: int = 4
    """Nodes of which a Gaussian has shares; 0 gives each all of its own node."""

    def __post_init__(self) -> None:
        convert_fields(self)
        for name, least in (
            ("sample", 1), ("part_sample", 0), ("neighbours", 1), ("voters", 1), ("candidates", 0),
        ):  # fmt: skip
            if getattr(self, name) < least:
                raise RangeError(f"{name}: expected at least {least}, got {getattr(self, name)}.")
        for name in ("group_increase", "object_increase", "part_increase"):
            check_range(name, getattr(self, name), 0.0, 1.0)
        if self.object_increase == 0:
            raise RangeError("object_increase: expected above 0, got 0.")
        if not 0 < self.temperature < float("inf"):
            raise RangeError(f"temperature: expected above 0, got {self.temperature}.")
