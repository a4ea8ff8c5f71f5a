"""Where evidence of views comes from: files, dictionaries, or what is computed when asked for."""

from collections.abc import Mapping, Sequence
from typing import Protocol, runtime_checkable

from splatseg.core.evidence import FeatureMap, LabelMap, MaskSet


@runtime_checkable
class ViewNames(Protocol):
    """Something recorded of views."""

    @property
    def view_names(self) -> Sequence[str]:
        """Views of which there is something."""
        ...


@runtime_checkable
class LabelSource(Protocol):
    """Label maps by view name, read when asked for: recorded evidence, or a dictionary's."""

    @property
    def view_names(self) -> Sequence[str]:
        """Views that have a label map."""
        ...

    def label_map(self, name: str) -> LabelMap:
        """The label map of one view."""
        ...


@runtime_checkable
class SegmentSource(Protocol):
    """Segments of views, each view with ids of its own."""

    @property
    def view_names(self) -> Sequence[str]:
        """Views that have segments."""
        ...

    @property
    def overlapping(self) -> bool:
        """Whether segments of one view may overlap."""
        ...

    @property
    def persistent(self) -> bool:
        """Whether ids are meant to go through all views, as those of a tracker."""
        ...

    def segments_of(self, name: str) -> LabelMap | MaskSet:
        """The segments of one view: a label map, or masks that may overlap."""
        ...

    def categories_of(self, name: str) -> Mapping[int, int]:
        """Category by segment, where it is known."""
        ...


@runtime_checkable
class FeatureSource(Protocol):
    """Feature maps by view name, read when asked for."""

    @property
    def view_names(self) -> Sequence[str]:
        """Views that have a feature map."""
        ...

    def features(self, name: str) -> FeatureMap:
        """The feature map of one view."""
        ...
