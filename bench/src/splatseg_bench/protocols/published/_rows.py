"""Rows of figures as tables print them: shares in percent, under a heading of measures."""

from dataclasses import dataclass

from splatseg.core.boundary import convert_fields
from splatseg.errors import ShapeError
from splatseg_bench.protocols._protocol import AMOUNTS, PublishedFigure

SECOND_HAND = "second-hand"
"""Source of figures that were read in somebody else's table or text."""

LOWER = f"{SECOND_HAND}, lower figure"
"""Source of the lower end, where second-hand sources differ."""

HIGHER = f"{SECOND_HAND}, higher figure"
"""Source of the higher end, where second-hand sources differ."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Table:
    """Where rows stand, and the measures of their columns."""

    protocol: str
    """The protocol that they belong to."""

    measures: tuple[str, ...]
    """By column."""

    source: str = SECOND_HAND
    """Where they stand."""

    verified: bool = False
    """Whether they were read in the original table."""

    def __post_init__(self) -> None:
        convert_fields(self)

    def row(
        self,
        method: str,
        *cells: float | None,
        scene: str | None = None,
        source: str | None = None,
        note: str = "",
    ) -> PublishedFigure:
        """One row.

        Args:
            method: As the table calls it.
            cells: By column: percent, amounts (decibels, frames, megabytes) as they are, None
                where a cell is empty. Those at the end may be left out.
            scene: None for the mean over scenes.
            source: Where this row stands, if not where the others do.
            note: In what it differs from the protocol, and what contradicts it.

        Raises:
            ShapeError: If there are more cells than columns.
        """
        if len(cells) > len(self.measures):
            raise ShapeError(
                f"{method}: expected at most {len(self.measures)} cells, got {len(cells)}."
            )
        scores = {
            measure: float(cell) if measure in AMOUNTS else round(cell / 100, 6)
            for measure, cell in zip(self.measures, cells, strict=False)
            if cell is not None
        }
        return PublishedFigure(
            protocol=self.protocol,
            method=method,
            scores=scores,
            scene=scene,
            source=self.source if source is None else source,
            verified=self.verified,
            note=note,
        )
