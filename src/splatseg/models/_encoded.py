"""What a network made of the last images, so that several questions cost one pass."""

from collections.abc import Callable, Sequence
from typing import Generic, TypeVar

import torch

from splatseg.core.models import Image
from splatseg.errors import BackendError
from splatseg.models._content import image_digest

_A = TypeVar("_A")


def is_lack_of_memory(error: BaseException) -> bool:
    """Whether an error says that there is no memory for a tensor."""
    return isinstance(error, torch.OutOfMemoryError | MemoryError) or (
        isinstance(error, RuntimeError) and "allocate memory" in str(error)
    )


class LastImages(Generic[_A]):
    """Encodes images, several at a time if they are announced, and keeps the last ones.

    What is kept is found by the content of the image, so it changes no answer.
    """

    def __init__(
        self, run: Callable[[Sequence[Image]], Sequence[_A]], *, resizable: bool = True
    ) -> None:
        """Keep what a network makes of images.

        Args:
            run: The network.
            resizable: Whether it takes inputs of another size, which saves memory.
        """
        self._run = run
        self._resizable = resizable
        self._kept: dict[str, _A] = {}

    def encode(self, images: Sequence[Image]) -> None:
        """Encode images of one size together; what was kept before is forgotten."""
        digests = [image_digest(image) for image in images]
        if all(digest in self._kept for digest in digests):
            return
        self._kept = {}  # before the run: the two together may not fit
        self._kept = dict(zip(digests, self._fitting(images), strict=True))

    def _fitting(self, images: Sequence[Image]) -> list[_A]:
        """As many together as memory holds, half as many where they do not fit."""
        try:
            return list(self._run(images))
        except (torch.OutOfMemoryError, MemoryError, RuntimeError) as error:
            if not is_lack_of_memory(error):
                raise
            height, width = (int(side) for side in images[0].shape[:2])
            if len(images) == 1:
                smaller = "--size N makes it smaller for the network, " * self._resizable
                raise BackendError(
                    f"there is not enough memory for an image of {width}x{height}; {smaller}"
                    "--dtype bfloat16 halves the network."
                ) from error
        half = len(images) // 2
        return [*self._fitting(images[:half]), *self._fitting(images[half:])]

    def of(self, image: Image) -> _A:
        """What the network makes of an image."""
        self.encode([image])
        return self._kept[image_digest(image)]
