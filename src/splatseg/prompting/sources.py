"""What a source of selections offers: which Gaussians belong together."""

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from splatseg.core import Selection
from splatseg.prompting.seen import SeenPrompt


@runtime_checkable
class MembershipSource(Protocol):
    """Knows which Gaussians belong together: from masks, features or a layer."""

    def membership(
        self, prompts: Sequence[SeenPrompt], *, granularity: float | None
    ) -> Float[Tensor, "n"]:
        """How likely each Gaussian belongs to what the prompts show.

        Args:
            prompts: What was shown, at least one pixel of it on the thing.
            granularity: 0 asks for groups, 0.5 for objects, 1 for the finest parts; None lets
                the source choose.

        Returns:
            Probabilities in [0, 1], one a Gaussian; above 0.5 it belongs to it.

        Raises:
            InputError: If the prompts show nothing that the source knows.
        """
        ...


@runtime_checkable
class SimilaritySource(Protocol):
    """A source that also knows which things are alike."""

    def similar(self, selection: Selection) -> Float[Tensor, "n"]:
        """How likely each Gaussian belongs to something like what is selected, itself included.

        Args:
            selection: Rows of the same Gaussians, at least one selected.

        Raises:
            InputError: If the source cannot tell.
        """
        ...
